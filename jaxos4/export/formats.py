"""From a result to the texts of files for a simulator: each has a template in this folder and a line in `TARGETS`."""

import functools
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray

from .._files import in_xml, templates
from .._version import __version__
from ..errors import InputError, check_choice, printable
from ..result_file import ResultSource
from ..results import meaning
from .result import Identified, read_result
from .vehicle import RigidVehicle

_FRAME = "SI units. x forward, y left, z up. The origin is the centre of mass. Rotor 1 is the airframe's first."


# Constants that simulators need and no flight shows.
LAG = 1e-3  # s; too short to notice, for RotorPy and Gazebo, which need one
RADIUS, THICKNESS = 0.5, 0.02  # of a drawn rotor, in arms
ROTOR_MASS = 1e-3  # of its link in Gazebo, as a share of the vehicle's
SHORTEST = 0.0002  # s; MuJoCo keeps enough past controls for the delay in scenes with time steps down to this
SLOWDOWN = 10.0  # times that links of rotors in Gazebo turn slower than the rotors, for long time steps


class Target(NamedTuple):
    """A simulator's format: its name, the suffix of its files, and what its template needs besides the vehicle."""

    label: str
    suffix: str
    values: Callable[[RigidVehicle], dict[str, Any]]


class Exported(NamedTuple):
    """Files for a simulator, as texts.

    - `text`: the estimated vehicle. `samples`: vehicles drawn from its uncertainty.
    - `impossible`: the number of impossible draws, which were repeated.
    - `notes`: the effects that the simulator does not have, or has differently, as in each file; then, of samples, why
      they differ by more than the estimate's uncertainty; one line each.
    - `manifest`: of the samples, ready for JSON: the Gaussian from which they are drawn, and the name of the file and
      the constants of each vehicle (the fields of `RigidVehicle`).
    """

    text: str
    samples: tuple[str, ...]
    impossible: int
    notes: tuple[str, ...]
    manifest: dict[str, Any]


def export_vehicle(found: Identified, to: str, *, samples: int = 0, seed: int = 0) -> Exported:
    """Write the texts of files for a simulator.

        found = jaxos4.export.read_result("found.json")
        jaxos4.export.export_vehicle(found, "mujoco").text

    - `found`: a result, from `read_result`.
    - `to`: the simulator, a name in `TARGETS`.
    - `samples`: the number of vehicles to draw from the uncertainty of the estimate, the reservations of its verdicts,
      and the width of guesses. Constants that were weighed or measured, such as the mass, do not change.
    - `seed`: for the draws. Sample i does not depend on the number of samples.

    **Raises:** `InputError` for an unknown simulator, if `samples` or `seed` is not an integer of at least 0, or if
    hardly any draw is a possible vehicle.
    """
    check_choice("to", to, TARGETS)
    _check_draws(samples, seed)
    target, own, warning = TARGETS[to], found.identification, tuple[str, ...]()
    if not own.successful:
        warning = (f"NOT TO BE TRUSTED: {own.result}: {meaning(own.result)}.", *own.warnings)

    def text(vehicle: RigidVehicle, *lines: str) -> str:
        made = f"Made by jaxos4 {__version__} from {found.source}."
        notes = (f"Note: {note}" for note in found.notes)
        comments = [made, *lines, *warning, _FRAME, *notes]
        sizes = {"radius": RADIUS * vehicle.arm, "thickness": THICKNESS * vehicle.arm}
        sizes["lag"] = vehicle.lag or LAG
        values = {"vehicle": vehicle, "comments": comments, **sizes, **target.values(vehicle)}
        return _templates(target.suffix).get_template(f"{to}{target.suffix}.j2").render(values)

    draws, estimated = [found.draw(number, seed=seed) for number in range(samples)], text(found.vehicle)
    limits = re.findall(r"^\W*Note: (.*)$", estimated, re.MULTILINE)[len(found.notes) :]
    vehicles, notes = [vehicle for vehicle, _ in draws], (*found.notes, *limits)
    impossible = sum(impossible for _, impossible in draws)
    manifest = {"version": __version__, "source": found.source, "simulator": to, "seed": seed, "impossible": impossible}
    manifest |= {"warnings": list(warning), "notes": [*notes, *found.notes_on_draws], "gaussian": found.gaussian}
    manifest["vehicles"] = [
        {"file": f"{number:06}{target.suffix}"} | {name: np.asarray(x).tolist() for name, x in each._asdict().items()}
        for number, each in enumerate(vehicles, start=1)
    ]
    return Exported(
        text=estimated,
        samples=tuple(text(vehicle, f"Sample {i}, seed {seed}.") for i, vehicle in enumerate(vehicles, start=1)),
        impossible=impossible,
        notes=(*notes, *found.notes_on_draws * bool(samples)),
        manifest=manifest,
    )


def sample_vehicles(found: ResultSource, samples: int, *, key: PRNGKeyArray) -> dict[str, Float[Array, "samples ..."]]:
    """Vehicles drawn from the uncertainty of an estimate, the reservations of its verdicts, and the width of guesses.

        vehicles = found.sample(64, key=jax.random.key(0))
        jax.vmap(step, in_axes=(0, None))(vehicles, state)

    **Returns:** the fields of `RigidVehicle` by name, with the vehicles along the leading axis of each.

    Vehicle i depends on the key and on i alone. `jaxos4 export --samples` writes the same vehicles with `--seed` n as
    `jax.random.key(n)` gives.

    **Raises:** `InputError` as `read_result` and `export_vehicle` do.
    """
    words = np.asarray(jax.random.key_data(key), dtype=np.uint32).ravel().tolist()
    seed = functools.reduce(lambda high, low: (high << 32) | low, words)
    _check_draws(samples, seed, least=1)
    vehicle = read_result(found)
    drawn = [vehicle.draw(number, seed=seed)[0] for number in range(samples)]
    return {name: jnp.array([getattr(each, name) for each in drawn]) for name in RigidVehicle._fields}


def _check_draws(samples: int, seed: int, *, least: int = 0) -> None:
    for name, value, limit in (("samples", samples, least), ("seed", seed, 0)):
        if not isinstance(value, int) or value < limit:
            raise InputError(f"`{name}`: must be an integer of at least {limit}, got {value!r}.")


def _mujoco(vehicle: RigidVehicle) -> dict[str, Any]:
    """The controls are the thrusts of the rotors [N]. Constant forces of the rotors make the constant torque."""
    constant = vehicle._replace(torque=np.zeros(3)).hover_thrust - vehicle.hover_thrust
    delayed = math.ceil(vehicle.delay / SHORTEST) + 1
    return {"constant": constant, "delayed": delayed, "shortest": SHORTEST}


def _sdf(vehicle: RigidVehicle) -> dict[str, Any]:
    """Inertia and mass of all links together are the vehicle's."""

    def steiner(place: np.ndarray) -> np.ndarray:
        """The inertia of a unit mass at a place about the origin [m^2]."""
        return place @ place * np.eye(3) - np.outer(place, place)

    share = ROTOR_MASS * vehicle.mass
    # The link of a rotor is a thin disc.
    about_axis = vehicle.rotor_inertia or share * (RADIUS * vehicle.arm) ** 2 / 2
    rotor = np.diag([about_axis / 2, about_axis / 2, about_axis])
    places = np.column_stack([vehicle.rotor_positions, np.zeros(4)])
    mass = vehicle.mass - 4 * share
    center = -share * places.sum(axis=0) / mass
    rest = np.diag(vehicle.inertia) - 4 * rotor - mass * steiner(center)
    body = mass, center, rest - share * sum(steiner(place) for place in places)
    return {"body": body, "rotor": (share, np.zeros(3), rotor), "slowdown": SLOWDOWN}


def _drone_models(vehicle: RigidVehicle) -> dict[str, Any]:
    """The mixing matrix turns thrusts over `length` into torques, and in its last row drag torques of the rotors."""
    length = vehicle.arm / math.sqrt(2)  # so that the entries of an X are 1 and -1
    x, y = vehicle.rotor_positions.T
    mixing = [(y / length).tolist(), (0 - x / length).tolist(), (-vehicle.rotor_spins).tolist()]
    return {"length": length, "mixing": mixing, "rpm": 60 / (2 * math.pi)}


@functools.cache
def _templates(suffix: str) -> Any:
    made = templates("jaxos4.export", printable if suffix in (".py", ".toml") else in_xml)
    made.filters["short"] = lambda values: ", ".join(f"{value:.3g}" for value in np.atleast_1d(values))

    def numbers(*values: float) -> str:
        return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)  # 0 has no sign

    made.globals |= {"number": lambda value: repr(float(value)), "numbers": numbers, "zip": zip}
    return made


TARGETS: dict[str, Target] = {
    "mujoco": Target("MJCF for MuJoCo", ".xml", _mujoco),
    "rotorpy": Target("parameters for RotorPy", ".py", lambda _: {}),
    "sdf": Target("SDF model for Gazebo", ".sdf", _sdf),
    "drone-models": Target("parameters for drone_models and crazyflow", ".toml", _drone_models),
    "urdf": Target("URDF", ".urdf", lambda _: {}),
}
