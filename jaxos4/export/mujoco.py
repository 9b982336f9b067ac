"""MuJoCo: a free body with a site and a thrust actuator for each rotor (MJCF)."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

from . import notes
from .vehicle import AXES, RigidVehicle
from .xml_text import add, document, numbers

_TIMESTEP = 0.002  # [s]
# The delayed controls of the past are enough for a scene with time steps down to this [s].
_SHORTEST_TIMESTEP = 0.0002
# Height of the keyframe "hover" [m], and the sizes of the drawn parts in arms.
_HEIGHT, _ARM, _ROTOR, _FLAT = 1.0, 0.05, 0.5, 0.02
_DIRECTIONS = ("1 0 0 0 0 0", "0 1 0 0 0 0", "0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1")


def limits(vehicle: RigidVehicle) -> tuple[str, ...]:
    """What MuJoCo cannot have, or has differently."""
    lines = []
    if vehicle.rotor_inertia:
        lines.append(notes.NO_ROTOR_INERTIA)
    if vehicle.thrust_share:
        lines.append(
            f"thrust_curve: for the u-th part of a full command, control = ctrlrange x ({vehicle.thrust_share})"
        )
    if vehicle.lag:
        lines.append("rotor_lag: acts on the thrust and not on the rotor speed; the same for small changes")
    if vehicle.delay:
        lines.append(
            f"rotor_delay: right for time steps of {_SHORTEST_TIMESTEP:g} s or longer; it needs MuJoCo 3.5 or newer: "
            "older versions refuse `delay`, `nsample` and `interp`: remove them"
        )
    return tuple(lines)


def text(vehicle: RigidVehicle, comments: Sequence[str]) -> str:
    """The MJCF. Controls 1 to 4 are the thrusts of the rotors [N]; the others have no effect."""
    root = ElementTree.Element("mujoco", model="vehicle")
    add(root, "option", timestep=numbers(_TIMESTEP), gravity=numbers(0, 0, -vehicle.gravity))
    body = add(add(root, "worldbody"), "body", name="vehicle")
    add(body, "freejoint", name="free")
    add(body, "inertial", pos="0 0 0", mass=numbers(vehicle.mass), diaginertia=numbers(*vehicle.inertia))
    add(body, "site", name="center_of_mass")
    arm = vehicle.arm
    for number, (x, y) in enumerate(vehicle.rotor_positions, start=1):
        add(body, "site", name=f"rotor{number}", pos=numbers(x, y, 0))
        add(body, "geom", type="capsule", fromto=numbers(0, 0, 0, x, y, 0), size=numbers(_ARM * arm))
        add(body, "geom", type="cylinder", pos=numbers(x, y, 0), size=numbers(_ROTOR * arm, _FLAT * arm))
    actuators = add(root, "actuator")
    _add_rotors(actuators, vehicle)
    passive = _add_passive(actuators, vehicle)
    thrust = vehicle.hover_thrust
    state = {"act": numbers(*thrust)} if vehicle.lag else {}
    add(
        add(root, "keyframe"),
        "key",
        name="hover",
        qpos=numbers(0, 0, _HEIGHT, 1, 0, 0, 0),
        ctrl=numbers(*thrust, *(passive * [0])),
        **state,
    )
    controls = "Controls 1 to 4: thrust of each rotor [N] = thrust coefficient x speed^2; the others have no effect."
    return document(root, [*comments, f"{controls} Thrust coefficient: {vehicle.thrust_coefficient:.6g} N s^2/rad^2."])


def _add_rotors(actuators: ElementTree.Element, vehicle: RigidVehicle) -> None:
    dynamics = {}
    if vehicle.lag:
        dynamics |= {"dyntype": "filterexact", "dynprm": numbers(vehicle.lag)}
    if vehicle.delay:
        samples = math.ceil(vehicle.delay / _SHORTEST_TIMESTEP) + 1
        # Without interpolation, MuJoCo rounds the delay up to whole time steps.
        dynamics |= {"delay": numbers(vehicle.delay), "nsample": str(samples), "interp": "linear"}
    ratio = vehicle.drag_coefficient / vehicle.thrust_coefficient
    for number, spin in enumerate(vehicle.rotor_spins, start=1):
        add(
            actuators,
            "general",
            name=f"thrust{number}",
            site=f"rotor{number}",
            gear=numbers(0, 0, 1, 0, 0, -spin * ratio),
            ctrllimited="true",
            ctrlrange=numbers(0, vehicle.full_thrust),
            **dynamics,
        )


def _add_passive(actuators: ElementTree.Element, vehicle: RigidVehicle) -> int:
    """Adds constant torques, and forces and torques proportional to a velocity. Returns the number of actuators."""
    names = ("x_drag", "y_drag", *(f"{axis}_torque" for axis in AXES))
    constants = (0.0, 0.0, *vehicle.torque)
    slopes = (*vehicle.drag, *vehicle.damping)
    count = 0
    for name, direction, constant, slope in zip(names, _DIRECTIONS, constants, slopes, strict=True):
        if constant or slope:
            count += 1
            bias = numbers(constant, 0, -slope)
            fixed = {"gainprm": "0", "biastype": "affine", "biasprm": bias}
            add(actuators, "general", name=name, site="center_of_mass", gear=direction, **fixed)
    return count
