"""The share of a battery's sag under load that a logged voltage does not show."""

import math

import numpy as np

from ..logs import Recording

_MANOEUVRE = 0.2  # s; the load of the rotors changes within about this time
_SAG = 0.04  # the share of the voltage that a load takes: a coarser voltage does not show it
_LEAST = 0.1  # even a voltage in each row has noise, and is measured before or after the load


def unseen_sag(recording: Recording) -> float:
    """The share of the sag that the logged voltage does not show, 0 to 1, from its rate and its resolution.

    A slowly logged voltage is held or interpolated between its measurements. The measurements are counted by the steps
    of a held voltage, or by the changes of slope of an interpolated one.
    """
    voltage = np.empty(0) if recording.voltage is None else recording.voltage[recording.voltage > 0]
    if voltage.size < 3:
        return 1.0
    steps, usual = np.diff(voltage), float(np.median(voltage))
    changes = np.abs(np.diff(steps)) > 1e-9 * usual
    is_held = np.count_nonzero(steps) <= np.count_nonzero(changes) / 2 + 1
    measured = np.count_nonzero(steps if is_held else changes)
    if not measured:
        return 1.0
    period = float(recording.time[-1] - recording.time[0]) / measured
    resolution = float(np.abs(steps[steps != 0]).min()) / usual
    return float(np.clip(max(1 - math.exp(-period / _MANOEUVRE), resolution / _SAG), _LEAST, 1.0))
