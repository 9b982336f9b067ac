"""From a result to the texts of files for a simulator. A new simulator has two functions, and a line in `TARGETS`."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from .._version import __version__
from ..errors import InputError
from .result import Identified
from .rotorpy import rotorpy_limits, rotorpy_text
from .vehicle import RigidVehicle
from .xml_formats import mujoco_limits, mujoco_text, sdf_limits, sdf_text

_FRAME = "SI units. x forward, y left, z up. The origin is the centre of mass. Rotor 1 is the airframe's first."


class Target(NamedTuple):
    """A simulator's format.

    - `label`: the name of the format. `suffix`: that of its files.
    - `text`: the file for a vehicle, with lines of comment at its top.
    - `limits`: the effects that the simulator does not have, or has differently; one line each.
    """

    label: str
    suffix: str
    text: Callable[[RigidVehicle, Sequence[str]], str]
    limits: Callable[[RigidVehicle], tuple[str, ...]]


TARGETS: dict[str, Target] = {
    "mujoco": Target("MJCF for MuJoCo", ".xml", mujoco_text, mujoco_limits),
    "rotorpy": Target("parameters for RotorPy", ".py", rotorpy_text, rotorpy_limits),
    "sdf": Target("SDF model for Gazebo", ".sdf", sdf_text, sdf_limits),
}


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

    def text(vehicle: RigidVehicle, *lines: str) -> str:
        made = f"Made by jaxos4 {__version__} from {found.source}."
        notes = (f"Note: {note}" for note in (*found.notes, *target.limits(vehicle)))
        comments = (made, *lines, *_warning(found), _FRAME, *notes)
        # A file's name can have line breaks.
        return target.text(vehicle, [" ".join(line.split()) for line in comments])

    draws = [found.draw(number, seed=seed) for number in range(samples)]
    return Exported(
        text=text(found.vehicle),
        samples=tuple(text(vehicle, f"Sample {i}, seed {seed}.") for i, (vehicle, _) in enumerate(draws, start=1)),
        impossible=sum(impossible for _, impossible in draws),
        notes=(*found.notes, *target.limits(found.vehicle)),
    )


def _warning(found: Identified) -> tuple[str, ...]:
    return () if found.successful else (f"NOT TO BE TRUSTED: {found.result}: {found.reason}.", *found.doubts)
