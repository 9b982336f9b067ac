"""From a result to the texts of files for a simulator.

A new simulator has a template in this folder, a function for what it does not have, and a line in `TARGETS`.
"""

import functools
import math
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import jinja2
import numpy as np

from .._version import __version__
from ..errors import InputError
from .result import Identified
from .vehicle import AXES, RigidVehicle

_FRAME = "SI units. x forward, y left, z up. The origin is the centre of mass. Rotor 1 is the airframe's first."
# RotorPy and Gazebo need a lag: this one is too short to notice [s].
_NO_LAG = 1e-3
# Radius and thickness of a drawn rotor, in arms.
_ROTOR, _FLAT = 0.5, 0.02
# MuJoCo keeps enough past controls for the delay in scenes with time steps down to this [s].
_SHORTEST_TIMESTEP = 0.0002
# The gravity that RotorPy has [m/s^2].
_GRAVITY = 9.81
# Gazebo needs links with a mass: that of a rotor's link, as a share of the vehicle's.
_ROTOR_MASS = 1e-3
# Gazebo's links of rotors turn this many times slower than the rotors, so that long time steps can follow them.
_SLOWDOWN = 10.0


class Target(NamedTuple):
    """A simulator's format.

    - `label`: the name of the format. `suffix`: the suffix of its files.
    - `values`: what its template needs besides the vehicle.
    - `curve`: the formula of a command, for a share {} of the thrust.
    - `limits`: the effects that this simulator alone does not have, or has differently, each if it applies.
    """

    label: str
    suffix: str
    values: Callable[[RigidVehicle], dict[str, Any]]
    curve: str
    limits: Callable[[RigidVehicle], tuple[tuple[object, str], ...]]


class Exported(NamedTuple):
    """Files for a simulator, as texts.

    - `text`: the estimated vehicle.
    - `samples`: vehicles drawn from the uncertainty of the estimate.
    - `impossible`: the number of impossible draws, which were repeated.
    - `notes`: the effects that the simulator does not have, or has differently; one line each. They stand in the file
      too, and each sample has its own.
    """

    text: str
    samples: tuple[str, ...]
    impossible: int
    notes: tuple[str, ...]


def export_vehicle(found: Identified, to: str, *, samples: int = 0, seed: int = 0) -> Exported:
    """Write the texts of files for a simulator.

        found = jaxos4.export.read_result("found.json")
        jaxos4.export.export_vehicle(found, "mujoco").text

    **Arguments:**

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
    warning = () if found.successful else (f"NOT TO BE TRUSTED: {found.result}: {found.reason}.", *found.doubts)

    def text(vehicle: RigidVehicle, *lines: str) -> str:
        made = f"Made by jaxos4 {__version__} from {found.source}."
        notes = (f"Note: {note}" for note in (*found.notes, *_limits(vehicle, to)))
        # A file's name can have line breaks.
        comments = [" ".join(line.split()) for line in (made, *lines, *warning, _FRAME, *notes)]
        sizes = {"radius": _ROTOR * vehicle.arm, "thickness": _FLAT * vehicle.arm, "lag": vehicle.lag or _NO_LAG}
        values = {"vehicle": vehicle, "comments": comments, **sizes, **target.values(vehicle)}
        return _templates().get_template(f"{to}{target.suffix}.j2").render(values)

    draws = [found.draw(number, seed=seed) for number in range(samples)]
    return Exported(
        text=text(found.vehicle),
        samples=tuple(text(vehicle, f"Sample {i}, seed {seed}.") for i, (vehicle, _) in enumerate(draws, start=1)),
        impossible=sum(impossible for _, impossible in draws),
        notes=(*found.notes, *_limits(found.vehicle, to)),
    )


def _limits(vehicle: RigidVehicle, to: str) -> tuple[str, ...]:
    """The notes on what a simulator does not have, or has differently."""
    curve = vehicle.thrust_share, vehicle.curve(TARGETS[to].curve)
    return tuple(line for applies, line in (curve, *TARGETS[to].limits(vehicle)) if applies)


def _inertia_of_rotors(vehicle: RigidVehicle, lost: str) -> tuple[object, str]:
    inertia = f"{vehicle.rotor_inertia:.3g} kg m^2"
    return (
        vehicle.rotor_inertia,
        f"rotor inertia: not carried: {lost}no yaw torque of rotors that accelerate: {inertia}",
    )


def _in_plane(vehicle: RigidVehicle, what: str) -> str:
    roll, pitch = vehicle.flapping
    return (
        f"flapping: {what}: {roll:.3g} N m about x for each m/s along y, {pitch:.3g} N m about y for each m/s along x"
    )


def _mujoco_limits(vehicle: RigidVehicle) -> tuple[tuple[object, str], ...]:
    late = (
        f"rotor_delay: right for time steps of {_SHORTEST_TIMESTEP:g} s or longer; it needs MuJoCo 3.5 or newer: "
        "older versions refuse `delay`, `nsample` and `interp`: remove them"
    )
    lag = "rotor_lag: acts on the thrust and not on the rotor speed; the same for small changes"
    flapping = _in_plane(vehicle, "the numeric `flapping`, for a callback as in docs/into_your_simulator.md")
    rotors = _inertia_of_rotors(vehicle, "no gyroscopic torque (alpha2, alpha5), ")
    return rotors, (vehicle.flapping.any(), flapping), (vehicle.lag, lag), (vehicle.delay, late)


def _mujoco(vehicle: RigidVehicle) -> dict[str, Any]:
    """Controls 1 to 4 are the thrusts of the rotors [N]; the others have no effect."""
    names = ("x_drag", "y_drag", "z_drag", *(f"{axis}_torque" for axis in AXES))
    constants, slopes = (0.0, 0.0, 0.0, *vehicle.torque), (*vehicle.drag, *vehicle.damping)
    rows = zip(names, np.eye(6), constants, slopes, strict=True)
    delayed = math.ceil(vehicle.delay / _SHORTEST_TIMESTEP) + 1
    return {"passive": [row for row in rows if row[2] or row[3]], "delayed": delayed}


def _rotorpy_limits(vehicle: RigidVehicle) -> tuple[tuple[object, str], ...]:
    lag = f"rotor_lag: none was identified; tau_m is {_NO_LAG:g} s, because RotorPy needs one"
    alone = (
        "quad_params: without the class `Vehicle` of this file, RotorPy has no offsets, no damping, no flapping, no "
        f"gyroscopic torque, {_GRAVITY:g} m/s^2 of gravity, and x_drag, y_drag, z_drag by k_d and k_z: right at the "
        "hover speed, and damping the rates"
    )
    return (True, alone), _inertia_of_rotors(vehicle, ""), (not vehicle.lag, lag), _late(vehicle, "give")


def _sdf_limits(vehicle: RigidVehicle) -> tuple[tuple[object, str], ...]:
    slow = (
        f"rotor inertia: the links of the rotors have it, and turn {_SLOWDOWN:g} times slower than the rotors, so "
        "that their gyroscopic torque (alpha2, alpha5) is too small by this factor"
    )
    gravity = f"gravity: the world's; the vehicle was identified with {vehicle.gravity:g} m/s^2"
    torque, damping = (", ".join(f"{x:.3g}" for x in row) for row in (vehicle.torque, vehicle.damping))
    x, y, z = vehicle.drag
    drag = "as drag of the rotors, the mean of x and y, right at the hover speed; it also damps yaw"
    return (
        (vehicle.torque.any(), f"offsets: not carried: SDF has no constant torque: {torque} N m about x, y, z"),
        (vehicle.damping.any(), f"damping: not carried: SDF has no torque against one body rate: {damping} N m s"),
        (x or y, f"x_drag, y_drag: {drag}: {x:.3g}, {y:.3g} N s/m"),
        (z, f"z_drag: not carried: SDF has no force against the velocity along z: {z:.3g} N s/m"),
        (vehicle.flapping.any(), _in_plane(vehicle, "not carried: SDF has no such moment")),
        _late(vehicle, "send"),
        (True, gravity),
        (vehicle.rotor_inertia, slow),
    )


def _late(vehicle: RigidVehicle, verb: str) -> tuple[object, str]:
    return vehicle.delay, f"rotor_delay: not carried: {verb} commands {vehicle.delay:.4g} s late"


def _sdf(vehicle: RigidVehicle) -> dict[str, Any]:
    """Inertia and mass of all links together are the vehicle's."""

    def steiner(place: np.ndarray) -> np.ndarray:
        """The inertia of a unit mass at a place about the origin [m^2]."""
        return place @ place * np.eye(3) - np.outer(place, place)

    share = _ROTOR_MASS * vehicle.mass
    # The link of a rotor is a thin disc.
    about_axis = vehicle.rotor_inertia or share * (_ROTOR * vehicle.arm) ** 2 / 2
    rotor = np.diag([about_axis / 2, about_axis / 2, about_axis])
    places = np.column_stack([vehicle.rotor_positions, np.zeros(4)])
    mass = vehicle.mass - 4 * share
    center = -share * places.sum(axis=0) / mass
    rest = np.diag(vehicle.inertia) - 4 * rotor - mass * steiner(center)
    body = mass, center, rest - share * sum(steiner(place) for place in places)
    return {"body": body, "rotor": (share, np.zeros(3), rotor), "slowdown": _SLOWDOWN}


@functools.cache
def _templates() -> jinja2.Environment:
    made = jinja2.Environment(undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    made.loader, made.keep_trailing_newline = jinja2.PackageLoader("jaxos4.export", "."), True
    # An XML comment must not contain two hyphens in a row.
    made.filters["hyphens_apart"] = lambda line: re.sub("-(?=-)", "- ", line)
    made.globals |= {"number": lambda value: repr(float(value)), "numbers": _numbers, "zip": zip}
    return made


def _numbers(*values: float) -> str:
    """Numbers with all their digits; 0 has no sign."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)


_SPEED = "rotor speed = {} x sqrt({{}})"
TARGETS: dict[str, Target] = {
    "mujoco": Target("MJCF for MuJoCo", ".xml", _mujoco, "control = ctrlrange x ({})", _mujoco_limits),
    "rotorpy": Target("parameters for RotorPy", ".py", lambda _: {}, _SPEED.format("rotor_speed_max"), _rotorpy_limits),
    "sdf": Target("SDF model for Gazebo", ".sdf", _sdf, _SPEED.format("maxRotVelocity"), _sdf_limits),
}
