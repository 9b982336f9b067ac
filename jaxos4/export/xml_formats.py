"""The two formats in XML: MuJoCo's MJCF, and SDF for Gazebo.

MJCF: a free body with a site and a thrust actuator for each rotor. SDF: links for the body and the rotors, and a
`MulticopterMotorModel` plugin of Gazebo for each rotor.
"""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np

from .vehicle import AXES, DRAG_OF_ROTORS, NO_ROTOR_INERTIA, RigidVehicle, differences

# Sizes of the drawn parts in arms: a rotor's radius and thickness.
_ROTOR, _FLAT = 0.5, 0.02

# MuJoCo.
_TIMESTEP = 0.002  # [s]
# The delayed controls of the past are enough for a scene with time steps down to this [s].
_SHORTEST_TIMESTEP = 0.0002
# Height of the keyframe "hover" [m], and the radius of a drawn arm in arms.
_HEIGHT, _ARM = 1.0, 0.05
_DIRECTIONS = ("1 0 0 0 0 0", "0 1 0 0 0 0", "0 0 0 1 0 0", "0 0 0 0 1 0", "0 0 0 0 0 1")

# SDF.
_VERSION = "1.9"
# Gazebo needs links with a mass: that of a rotor's link, as a share of the vehicle's.
_ROTOR_MASS = 1e-3
# Links of rotors turn this many times slower than the rotors, so that long time steps can follow them.
_SLOWDOWN = 10.0
# A lag that is too short to notice [s]; Gazebo's own default would be longer.
_NO_LAG = 1e-3
_TENSOR = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
_BODY = 0.3  # the size of the drawn body in arms
_PLUGIN = "gz-sim-multicopter-motor-model-system", "gz::sim::systems::MulticopterMotorModel"


def mujoco_limits(vehicle: RigidVehicle) -> tuple[str, ...]:
    """The effects that MuJoCo does not have, or has differently."""
    return differences(
        (vehicle.rotor_inertia, NO_ROTOR_INERTIA),
        (vehicle.thrust_share, vehicle.curve("control = ctrlrange x ({})")),
        (vehicle.lag, "rotor_lag: acts on the thrust and not on the rotor speed; the same for small changes"),
        (
            vehicle.delay,
            f"rotor_delay: right for time steps of {_SHORTEST_TIMESTEP:g} s or longer; it needs MuJoCo 3.5 or newer: "
            "older versions refuse `delay`, `nsample` and `interp`: remove them",
        ),
    )


def mujoco_text(vehicle: RigidVehicle, comments: Sequence[str]) -> str:
    """The MJCF. Controls 1 to 4 are the thrusts of the rotors [N]; the others have no effect."""
    arm, thrust, passive = vehicle.arm, vehicle.hover_thrust, _mujoco_passive(vehicle)
    parts = [
        _element("freejoint", name="free"),
        _element("inertial", pos="0 0 0", mass=_numbers(vehicle.mass), diaginertia=_numbers(*vehicle.inertia)),
        _element("site", name="center_of_mass"),
    ]
    for number, (x, y) in enumerate(vehicle.rotor_positions, start=1):
        parts += [
            _element("site", name=f"rotor{number}", pos=_numbers(x, y, 0)),
            _element("geom", type="capsule", fromto=_numbers(0, 0, 0, x, y, 0), size=_numbers(_ARM * arm)),
            _element("geom", type="cylinder", pos=_numbers(x, y, 0), size=_numbers(_ROTOR * arm, _FLAT * arm)),
        ]
    hover = {"qpos": _numbers(0, 0, _HEIGHT, 1, 0, 0, 0), "ctrl": _numbers(*thrust, *(len(passive) * [0]))}
    hover |= {"act": _numbers(*thrust)} if vehicle.lag else {}
    root = _element(
        "mujoco",
        _element("option", timestep=_numbers(_TIMESTEP), gravity=_numbers(0, 0, -vehicle.gravity)),
        _element("worldbody", _element("body", *parts, name="vehicle")),
        _element("actuator", *_mujoco_rotors(vehicle), *passive),
        _element("keyframe", _element("key", name="hover", **hover)),
        model="vehicle",
    )
    controls = "Controls 1 to 4: thrust of each rotor [N] = thrust coefficient x speed^2; the others have no effect."
    return _document(root, [*comments, f"{controls} Thrust coefficient: {vehicle.thrust_coefficient:.6g} N s^2/rad^2."])


def _mujoco_rotors(vehicle: RigidVehicle) -> list[ElementTree.Element]:
    """The actuators of the rotors."""
    dynamics = {"ctrllimited": "true", "ctrlrange": _numbers(0, vehicle.full_thrust)}
    if vehicle.lag:
        dynamics |= {"dyntype": "filterexact", "dynprm": _numbers(vehicle.lag)}
    if vehicle.delay:
        samples = math.ceil(vehicle.delay / _SHORTEST_TIMESTEP) + 1
        # Without interpolation, MuJoCo rounds the delay up to whole time steps.
        dynamics |= {"delay": _numbers(vehicle.delay), "nsample": str(samples), "interp": "linear"}
    ratio, actuators = vehicle.drag_coefficient / vehicle.thrust_coefficient, []
    for number, spin in enumerate(vehicle.rotor_spins, start=1):
        names = {"name": f"thrust{number}", "site": f"rotor{number}", "gear": _numbers(0, 0, 1, 0, 0, -spin * ratio)}
        actuators.append(_element("general", **names, **dynamics))
    return actuators


def _mujoco_passive(vehicle: RigidVehicle) -> list[ElementTree.Element]:
    """Actuators with constant torques, and with forces and torques proportional to a velocity."""
    names = ("x_drag", "y_drag", *(f"{axis}_torque" for axis in AXES))
    constants, slopes, actuators = (0.0, 0.0, *vehicle.torque), (*vehicle.drag, *vehicle.damping), []
    for name, direction, constant, slope in zip(names, _DIRECTIONS, constants, slopes, strict=True):
        if constant or slope:
            place = {"name": name, "site": "center_of_mass", "gear": direction}
            bias = {"gainprm": "0", "biastype": "affine", "biasprm": _numbers(constant, 0, -slope)}
            actuators.append(_element("general", **place, **bias))
    return actuators


def sdf_limits(vehicle: RigidVehicle) -> tuple[str, ...]:
    """The effects that Gazebo does not have, or has differently."""
    return differences(
        (True, f"gravity: the world's; the vehicle was identified with {vehicle.gravity:g} m/s^2"),
        (
            vehicle.rotor_inertia,
            f"rotor inertia: the links of the rotors have it, and turn {_SLOWDOWN:g} times slower than the rotors, so "
            "that their gyroscopic torque (alpha2, alpha5) is too small by this factor",
        ),
        (vehicle.thrust_share, vehicle.curve("rotor speed = maxRotVelocity x sqrt({})")),
        (vehicle.torque.any(), "offsets: not carried: SDF has no constant torque"),
        (vehicle.damping.any(), "damping: not carried: SDF has no torque against the body rates of one axis"),
        (vehicle.drag.any(), DRAG_OF_ROTORS),
        (vehicle.delay, f"rotor_delay: not carried: send commands {vehicle.delay:.4g} s late"),
    )


def sdf_text(vehicle: RigidVehicle, comments: Sequence[str]) -> str:
    """The SDF. Inertia and mass of all links together are the vehicle's."""
    arm = vehicle.arm
    box = {"size": _numbers(_BODY * arm, _BODY * arm, _BODY * arm / 2)}
    disc = {"radius": _numbers(_ROTOR * arm), "length": _numbers(_FLAT * arm)}
    shapes = [_element(part, _element("geometry", _element("box", box)), name=part) for part in ("visual", "collision")]
    parts = [_element("link", _sdf_inertial(*_sdf_body(vehicle)), *shapes, name="body")]
    for number, (x, y) in enumerate(vehicle.rotor_positions):
        link = f"rotor_{number}"
        axis = _element("axis", {"xyz": "0 0 1"}, _element("limit", {"lower": "-1e16", "upper": "1e16"}))
        parts += [
            _element(
                "link",
                {"pose": _numbers(x, y, 0, 0, 0, 0)},
                _sdf_inertial(_ROTOR_MASS * vehicle.mass, np.zeros(3), _sdf_rotor(vehicle)),
                _element("visual", _element("geometry", _element("cylinder", disc)), name="visual"),
                name=link,
            ),
            _element("joint", {"parent": "body", "child": link}, axis, name=f"{link}_joint", type="revolute"),
        ]
    parts += [_sdf_motor(vehicle, number, spin) for number, spin in enumerate(vehicle.rotor_spins)]
    return _document(_element("sdf", _element("model", *parts, name="vehicle"), version=_VERSION), comments)


def _sdf_rotor(vehicle: RigidVehicle) -> np.ndarray:
    """The inertia of a rotor's link about its own centre [kg m^2]: a thin disc."""
    about_axis = vehicle.rotor_inertia or _ROTOR_MASS * vehicle.mass * (_ROTOR * vehicle.arm) ** 2 / 2
    return np.diag([about_axis / 2, about_axis / 2, about_axis])


def _sdf_body(vehicle: RigidVehicle) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia of the body's link: the vehicle's without the links of the rotors."""

    def steiner(place: np.ndarray) -> np.ndarray:
        """The inertia of a unit mass at a place about the origin [m^2]."""
        return place @ place * np.eye(3) - np.outer(place, place)

    share = _ROTOR_MASS * vehicle.mass
    places = np.column_stack([vehicle.rotor_positions, np.zeros(4)])
    mass = vehicle.mass - 4 * share
    center = -share * places.sum(axis=0) / mass
    rest = np.diag(vehicle.inertia) - 4 * _sdf_rotor(vehicle) - mass * steiner(center)
    return mass, center, rest - share * sum(steiner(place) for place in places)


def _sdf_inertial(mass: float, center: np.ndarray, tensor: np.ndarray) -> ElementTree.Element:
    inertia = {name: _numbers(tensor[place]) for name, place in _TENSOR.items()}
    place = {"pose": _numbers(*center, 0, 0, 0), "mass": _numbers(mass)}
    return _element("inertial", place, _element("inertia", inertia))


def _sdf_motor(vehicle: RigidVehicle, number: int, spin: float) -> ElementTree.Element:
    settings = {
        "jointName": f"rotor_{number}_joint",
        "linkName": f"rotor_{number}",
        "turningDirection": "ccw" if spin > 0 else "cw",
        "timeConstantUp": _numbers(vehicle.lag or _NO_LAG),
        "timeConstantDown": _numbers(vehicle.lag or _NO_LAG),
        "maxRotVelocity": _numbers(vehicle.max_rotor_speed),
        "motorConstant": _numbers(vehicle.thrust_coefficient),
        "momentConstant": _numbers(vehicle.drag_coefficient / vehicle.thrust_coefficient),
        "commandSubTopic": "command/motor_speed",
        "motorNumber": str(number),
        "rotorDragCoefficient": _numbers(vehicle.rotor_drag),
        "rollingMomentCoefficient": "0",
        "rotorVelocitySlowdownSim": _numbers(_SLOWDOWN),
        "motorType": "velocity",
    }
    return _element("plugin", settings, filename=_PLUGIN[0], name=_PLUGIN[1])


def _element(tag: str, *contents: ElementTree.Element | dict[str, str], **attributes: str) -> ElementTree.Element:
    """An element with `contents`: elements, and tables of the tags and texts of elements without children."""
    made = ElementTree.Element(tag, attributes)
    for content in contents:
        if isinstance(content, dict):
            for name, text in content.items():
                ElementTree.SubElement(made, name).text = text
        else:
            made.append(content)
    return made


def _document(root: ElementTree.Element, comments: Sequence[str]) -> str:
    """The text of an XML file."""
    ElementTree.indent(root)
    # A comment must not contain two hyphens in a row.
    lines = "\n".join(f"  {line.replace('--', '- -')}" for line in comments)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n<!--\n{lines}\n-->\n{body}\n'


def _numbers(*values: float) -> str:
    """Numbers with all their digits; 0 has no sign."""
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)
