"""From a result to the texts of files for a simulator: each has a template in this folder and a line in `TARGETS`."""

import functools
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from .._templates import in_xml, templates
from .._version import __version__
from ..errors import InputError, printable
from ..results import meaning
from .result import Identified
from .vehicle import RigidVehicle

_FRAME = "SI units. x forward, y left, z up. The origin is the centre of mass. Rotor 1 is the airframe's first."


class Assumed(NamedTuple):
    """Constants that simulators need and no flight shows.

    - `lag`: for RotorPy and Gazebo, which need one: too short to notice [s].
    - `radius`, `thickness`: of a drawn rotor, in arms. `rotor_mass`: of its link in Gazebo, as a share of the
      vehicle's.
    - `shortest`: MuJoCo keeps enough past controls for the delay in scenes with time steps down to this [s].
    - `slowdown`: links of rotors in Gazebo turn this many times slower than the rotors, for long time steps.
    """

    lag: float = 1e-3
    radius: float = 0.5
    thickness: float = 0.02
    shortest: float = 0.0002
    rotor_mass: float = 1e-3
    slowdown: float = 10.0


_ASSUMED = Assumed()


class Target(NamedTuple):
    """A simulator's format: its name, the suffix of its files, and what its template needs besides the vehicle."""

    label: str
    suffix: str
    values: Callable[[RigidVehicle], dict[str, Any]]


class Exported(NamedTuple):
    """Files for a simulator, as texts.

    - `text`: the estimated vehicle. `samples`: vehicles drawn from its uncertainty.
    - `impossible`: the number of impossible draws, which were repeated.
    - `notes`: the effects that the simulator does not have, or has differently, as in each file; one line each.
    """

    text: str
    samples: tuple[str, ...]
    impossible: int
    notes: tuple[str, ...]


def export_vehicle(found: Identified, to: str, *, samples: int = 0, seed: int = 0) -> Exported:
    """Write the texts of files for a simulator.

        found = jaxos4.export.read_result("found.json")
        jaxos4.export.export_vehicle(found, "mujoco").text

    - `found`: a result, from `read_result`.
    - `to`: the simulator, a name in `TARGETS`.
    - `samples`: the number of vehicles to draw from the covariance of the estimate. Constants that were not estimated,
      such as the mass, do not change. `seed`: for the draws. Sample i does not depend on the number of samples.

    **Raises:** `InputError` for an unknown simulator, if `samples` or `seed` is not an integer of at least 0, or if
    hardly any draw is a possible vehicle.
    """
    if to not in TARGETS:
        raise InputError(f"`to`: must be one of {', '.join(TARGETS)}, got {to!r}.")
    for name, value in (("samples", samples), ("seed", seed)):
        if not isinstance(value, int) or value < 0:
            raise InputError(f"`{name}`: must be an integer of at least 0, got {value!r}.")
    target = TARGETS[to]
    warning = (
        () if found.successful else (f"NOT TO BE TRUSTED: {found.result}: {meaning(found.result)}.", *found.doubts)
    )

    def text(vehicle: RigidVehicle, *lines: str) -> str:
        made = f"Made by jaxos4 {__version__} from {found.source}."
        notes = (f"Note: {note}" for note in found.notes)
        comments = [made, *lines, *warning, _FRAME, *notes]
        sizes = {"radius": _ASSUMED.radius * vehicle.arm, "thickness": _ASSUMED.thickness * vehicle.arm}
        sizes["lag"] = vehicle.lag or _ASSUMED.lag
        values = {"vehicle": vehicle, "comments": comments, **sizes, **target.values(vehicle)}
        return _templates(target.suffix).get_template(f"{to}{target.suffix}.j2").render(values)

    draws, estimated = [found.draw(number, seed=seed) for number in range(samples)], text(found.vehicle)
    limits = re.findall(r"^\W*Note: (.*)$", estimated, re.MULTILINE)[len(found.notes) :]
    return Exported(
        text=estimated,
        samples=tuple(text(vehicle, f"Sample {i}, seed {seed}.") for i, (vehicle, _) in enumerate(draws, start=1)),
        impossible=sum(impossible for _, impossible in draws),
        notes=(*found.notes, *limits),
    )


def _mujoco(vehicle: RigidVehicle) -> dict[str, Any]:
    """The controls are the thrusts of the rotors [N]. Constant forces of the rotors make the constant torque."""
    constant = vehicle._replace(torque=np.zeros(3)).hover_thrust - vehicle.hover_thrust
    delayed = math.ceil(vehicle.delay / _ASSUMED.shortest) + 1
    return {"constant": constant, "delayed": delayed, "shortest": _ASSUMED.shortest}


def _sdf(vehicle: RigidVehicle) -> dict[str, Any]:
    """Inertia and mass of all links together are the vehicle's."""

    def steiner(place: np.ndarray) -> np.ndarray:
        """The inertia of a unit mass at a place about the origin [m^2]."""
        return place @ place * np.eye(3) - np.outer(place, place)

    share = _ASSUMED.rotor_mass * vehicle.mass
    # The link of a rotor is a thin disc.
    about_axis = vehicle.rotor_inertia or share * (_ASSUMED.radius * vehicle.arm) ** 2 / 2
    rotor = np.diag([about_axis / 2, about_axis / 2, about_axis])
    places = np.column_stack([vehicle.rotor_positions, np.zeros(4)])
    mass = vehicle.mass - 4 * share
    center = -share * places.sum(axis=0) / mass
    rest = np.diag(vehicle.inertia) - 4 * rotor - mass * steiner(center)
    body = mass, center, rest - share * sum(steiner(place) for place in places)
    return {"body": body, "rotor": (share, np.zeros(3), rotor), "slowdown": _ASSUMED.slowdown}


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
