"""SDF: links for the body and the rotors, and a `MulticopterMotorModel` plugin of Gazebo for each rotor."""

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence

import numpy as np

from . import notes
from .vehicle import RigidVehicle
from .xml_text import add, add_texts, document, numbers

_VERSION = "1.9"
# Gazebo needs links with a mass: that of a rotor's link, as a share of the vehicle's.
_ROTOR_MASS = 1e-3
# Links of rotors turn this many times slower than the rotors, so that long time steps can follow them.
_SLOWDOWN = 10.0
# A lag that is too short to notice [s]; Gazebo's own default would be longer.
_NO_LAG = 1e-3
_TENSOR = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
# Sizes of the drawn parts in arms.
_BODY, _ROTOR, _FLAT = 0.3, 0.5, 0.02


def limits(vehicle: RigidVehicle) -> tuple[str, ...]:
    """What Gazebo cannot have, or has differently."""
    lines = [f"gravity: the world's; the vehicle was identified with {vehicle.gravity:g} m/s^2"]
    if vehicle.rotor_inertia:
        lines.append(
            f"rotor inertia: the links of the rotors have it, and turn {_SLOWDOWN:g} times slower than the rotors, so "
            "that their gyroscopic torque (alpha2, alpha5) is too small by this factor"
        )
    if vehicle.thrust_share:
        lines.append(notes.curve_of_speed(vehicle, "maxRotVelocity"))
    if vehicle.torque.any():
        lines.append("offsets: not carried: SDF has no constant torque")
    if vehicle.damping.any():
        lines.append("damping: not carried: SDF has no torque against the body rates of one axis")
    if vehicle.drag.any():
        lines.append(notes.DRAG_OF_ROTORS)
    if vehicle.delay:
        lines.append(f"rotor_delay: not carried: send commands {vehicle.delay:.4g} s late")
    return tuple(lines)


def text(vehicle: RigidVehicle, comments: Sequence[str]) -> str:
    """The SDF. Inertia and mass of all links together are the vehicle's."""
    root = ElementTree.Element("sdf", version=_VERSION)
    model = add(root, "model", name="vehicle")
    arm = vehicle.arm
    mass, center, tensor = _body(vehicle)
    body = add(model, "link", name="body")
    _add_inertial(body, mass, center, tensor)
    for part in ("visual", "collision"):
        add(add(_geometry(body, part), "box"), "size", numbers(_BODY * arm, _BODY * arm, _BODY * arm / 2))
    for number, (x, y) in enumerate(vehicle.rotor_positions):
        link = add(model, "link", name=f"rotor_{number}")
        add(link, "pose", numbers(x, y, 0, 0, 0, 0))
        _add_inertial(link, _ROTOR_MASS * vehicle.mass, np.zeros(3), _rotor(vehicle))
        disc = add(_geometry(link, "visual"), "cylinder")
        add_texts(disc, (("radius", numbers(_ROTOR * arm)), ("length", numbers(_FLAT * arm))))
        joint = add(model, "joint", name=f"rotor_{number}_joint", type="revolute")
        add_texts(joint, (("parent", "body"), ("child", f"rotor_{number}")))
        axis = add(joint, "axis")
        add(axis, "xyz", "0 0 1")
        add_texts(add(axis, "limit"), (("lower", "-1e16"), ("upper", "1e16")))
    for number, spin in enumerate(vehicle.rotor_spins):
        _add_motor(model, vehicle, number, spin)
    return document(root, comments)


def _rotor(vehicle: RigidVehicle) -> np.ndarray:
    """The inertia of a rotor's link about its own centre [kg m^2]: a thin disc."""
    about_axis = vehicle.rotor_inertia or _ROTOR_MASS * vehicle.mass * (_ROTOR * vehicle.arm) ** 2 / 2
    return np.diag([about_axis / 2, about_axis / 2, about_axis])


def _body(vehicle: RigidVehicle) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia of the body's link: the vehicle's without the links of the rotors."""
    share = _ROTOR_MASS * vehicle.mass
    places = np.column_stack([vehicle.rotor_positions, np.zeros(4)])
    mass = vehicle.mass - 4 * share
    center = -share * places.sum(axis=0) / mass
    rest = np.diag(vehicle.inertia) - 4 * _rotor(vehicle) - mass * _steiner(center)
    return mass, center, rest - share * sum(_steiner(place) for place in places)


def _steiner(place: np.ndarray) -> np.ndarray:
    """The inertia of a unit mass at a place about the origin [m^2]."""
    return place @ place * np.eye(3) - np.outer(place, place)


def _add_inertial(link: ElementTree.Element, mass: float, center: np.ndarray, tensor: np.ndarray) -> None:
    inertial = add(link, "inertial")
    add_texts(inertial, (("pose", numbers(*center, 0, 0, 0)), ("mass", numbers(mass))))
    add_texts(add(inertial, "inertia"), ((name, numbers(tensor[place])) for name, place in _TENSOR.items()))


def _geometry(link: ElementTree.Element, part: str) -> ElementTree.Element:
    """The geometry of a link: what is drawn (`visual`), or what touches the ground (`collision`)."""
    return add(add(link, part, name=part), "geometry")


def _add_motor(model: ElementTree.Element, vehicle: RigidVehicle, number: int, spin: float) -> None:
    plugin = add(
        model,
        "plugin",
        filename="gz-sim-multicopter-motor-model-system",
        name="gz::sim::systems::MulticopterMotorModel",
    )
    add_texts(
        plugin,
        (
            ("jointName", f"rotor_{number}_joint"),
            ("linkName", f"rotor_{number}"),
            ("turningDirection", "ccw" if spin > 0 else "cw"),
            ("timeConstantUp", numbers(vehicle.lag or _NO_LAG)),
            ("timeConstantDown", numbers(vehicle.lag or _NO_LAG)),
            ("maxRotVelocity", numbers(vehicle.max_rotor_speed)),
            ("motorConstant", numbers(vehicle.thrust_coefficient)),
            ("momentConstant", numbers(vehicle.drag_coefficient / vehicle.thrust_coefficient)),
            ("commandSubTopic", "command/motor_speed"),
            ("motorNumber", str(number)),
            ("rotorDragCoefficient", numbers(vehicle.rotor_drag)),
            ("rollingMomentCoefficient", "0"),
            ("rotorVelocitySlowdownSim", numbers(_SLOWDOWN)),
            ("motorType", "velocity"),
        ),
    )
