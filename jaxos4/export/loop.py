"""An identified vehicle in closed loop: what `jaxos4 design` flies to find the most informative references."""

import os
from typing import Any

import equinox as eqx
import numpy as np

from .._custom_types import as_constant
from ..closed_loop import ClosedLoop
from ..flight import RATES, STATE_NAMES
from ..result_file import vehicle_result
from .result import read_result

_FOUND = ("inertia", "rotor_inertia", "thrust_coefficient", "drag_coefficient")
_MOTOR = ("rotor_lag", "rotor_delay", "thrust_curve", "motor_braking")


def found_loop(path: str | os.PathLike[str], **settings: Any) -> ClosedLoop:
    """The vehicle of a file of `jaxos4 estimate --out`, with its rotors, damping and gusts, and a controller.

    `settings`: of a `ClosedLoop`, instead of those that were found. Raises as `read_result` does.
    """
    found = read_result(path)
    vehicle, gusts = found.vehicle, vehicle_result(path).disturbances
    airframe = eqx.tree_at(
        lambda airframe: tuple(getattr(airframe, name) for name in _FOUND),
        found.airframe,
        tuple(as_constant(getattr(vehicle, name)) for name in _FOUND),
    )
    known: dict[str, Any] = {name: found.values[name] for name in _MOTOR if found.values.get(name, 0.0) > 0}
    if not airframe.has_full_scale:
        known = {name: value for name, value in known.items() if name.startswith("rotor_")}
    rates = [gusts[name] for name in (STATE_NAMES[column] for column in RATES) if name in gusts]
    if len(rates) == 3:
        known |= {"gust": [each.strength for each in rates], "gust_time": np.mean([x.time_constant for x in rates])}
    known |= {"damping": vehicle.damping / vehicle.inertia}
    known |= {"logged": "commands" if "rotor_lag" in found.values and airframe.has_full_scale else "speeds"}
    return ClosedLoop(airframe, **known | settings)
