"""The table of simulators. A new one is a file with `text` and `limits`, and a line here."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from . import mujoco, rotorpy, sdf
from .vehicle import RigidVehicle


class Target(NamedTuple):
    """A simulator's format.

    - `label`: what is written.
    - `suffix`: of its files.
    - `text`: the file for a vehicle, with lines of comment at its top.
    - `limits`: what of a vehicle the simulator cannot have, or has differently; one line each.
    """

    label: str
    suffix: str
    text: Callable[[RigidVehicle, Sequence[str]], str]
    limits: Callable[[RigidVehicle], tuple[str, ...]]


TARGETS: dict[str, Target] = {
    "mujoco": Target("MJCF for MuJoCo", ".xml", mujoco.text, mujoco.limits),
    "rotorpy": Target("parameters for RotorPy", ".py", rotorpy.text, rotorpy.limits),
    "sdf": Target("SDF model for Gazebo", ".sdf", sdf.text, sdf.limits),
}
