"""Rotor speeds or commands of a ULog file.

A command becomes a share of full rotor speed in two steps.

1. The share u of the motor's signal. `actuator_outputs` holds the signal in the unit of its protocol. u is 0 at the
   output's smallest value with a turning motor, and 1 at its largest.
2. The thrust of that signal. PX4's model is: share of thrust = f u^2 + (1 - f) u, with the parameter f = THR_MDL_FAC.
   Speed is the square root of thrust.

`actuator_motors` holds the share of thrust, before PX4 turns it into a signal; `actuator_outputs` holds the signal.
If f is 0, its default, nobody measured the thrust, and both topics hold u. Speed then counts as proportional to u, and
the term `curve` of a vehicle's model fits the thrust.

| protocol | smallest | largest |
| --- | --- | --- |
| PWM | `PWM_MAIN_MIN1`, ..., or `PWM_MIN`; 1000 us if the log does not say it | the same with `MAX`; 2000 us |
| DShot | 1999 times `DSHOT_MIN`; 0 if the log does not say it | 1999 |
| UAVCAN | `UAVCAN_EC_MIN1`, ...; 1 | `UAVCAN_EC_MAX1`, ...; 8191 |

Reference: `FunctionMotors::updateValues` and `MixingOutput` of PX4, and the description of THR_MDL_FAC.
"""

import math
from typing import NamedTuple

import numpy as np

from .sampling import Series, logged_rate
from .table import fast_enough
from .ulog_file import Topics

TOPICS = ("esc_status", "actuator_motors", "actuator_outputs")

_FIRST_MOTOR = 101  # PX4's number of the output function "Motor 1"
_RPM = 2 * math.pi / 60
_OUTPUTS = 16  # of one driver
_BANKS = ("PWM_MAIN", "PWM_AUX", "PWM_EXTRA", "UAVCAN_EC")
_OTHER_BANKS = ("SIM_GZ_EC", "HIL_ACT")  # simulators, whose outputs have other units
_LEAST_PWM, _HIGHEST_PWM = 800.0, 2200.0  # [us]
_PWM, _DSHOT, _UAVCAN = (1000.0, 2000.0), 1999.0, (1.0, 8191.0)
_CAN, _DSHOT_LINK = 4, 5  # ESC_CONNECTION_TYPE_CAN, ESC_CONNECTION_TYPE_DSHOT
_DSHOT_TIMERS = range(-5, -1)  # DShot150 to DShot1200, as values of PWM_MAIN_TIM0 and so on
_TIMERS = 8


class Rotors(NamedTuple):
    """Measured speeds [rad/s] or commands [0..1] of the four rotors, and their topic and fields in the log.

    `note`: what was assumed; empty for measured speeds.
    """

    series: Series
    topic: str
    fields: tuple[str, ...]
    note: str = ""

    @property
    def measured(self) -> bool:
        """Whether these are measured speeds, and not commands."""
        return self.topic == "esc_status"

    @property
    def names(self) -> tuple[str, ...]:
        """The log's names of the four columns."""
        return tuple(f"{self.topic}.{field}" for field in self.fields)

    @property
    def rate(self) -> float:
        """How often they were logged [Hz]."""
        return logged_rate(self.series.t)


def rotors_of(log: Topics) -> Rotors | None:
    """Measured speeds, or the motors' commands, or the outputs: the first that was logged often enough.

    If none was, the one that was logged most often.
    """
    every = [found for find in (_speeds, _motors, _outputs) if (found := find(log)) is not None]
    fast = [each for each in every if fast_enough(each.rate)]
    chosen = fast[0] if fast else max(every, key=lambda each: each.rate, default=None)
    if chosen is not None and chosen is not every[0] and every[0].measured:
        log.notes.append(f"measured speeds (esc_status) were logged at {every[0].rate:.2g} Hz only: commands are used")
    return chosen


def _speeds(log: Topics) -> Rotors | None:
    names = tuple(f"esc[{i}].esc_rpm" for i in range(4))
    series = log.series("esc_status", names)
    if series is None or series.t.size < 2:
        return None
    if not (np.abs(series.values) > 0).any(axis=0).all():
        log.notes.append("esc_status holds no speed of at least one rotor: commands are used")
        return None
    fields = log.fields("esc_status")
    functions = [np.unique(fields.get(f"esc[{i}].actuator_function", np.zeros(1))) for i in range(4)]
    order = _motor_order([int(f[-1]) for f in functions]) or range(4)
    measured = np.isfinite(series.values).all(axis=1)
    if np.count_nonzero(measured) < 2:
        return None
    speeds = Series(series.t[measured], np.abs(series.values[measured])[:, order] * _RPM)
    return Rotors(speeds, "esc_status", tuple(names[i] for i in order))


def _motors(log: Topics) -> Rotors | None:
    names = tuple(f"control[{i}]" for i in range(4))
    series = log.series("actuator_motors", names)
    if series is None or series.t.size < 2 or not np.isfinite(series.values).any():
        return None
    shares = np.clip(np.nan_to_num(series.values), 0.0, 1.0)  # NaN means not armed
    curve, what = _thrust_curve(log)
    speeds = np.sqrt(shares) if curve else shares
    note = f"commands are actuator_motors.control, {what}"
    return Rotors(Series(series.t, speeds), "actuator_motors", names, note)


def _outputs(log: Topics) -> Rotors | None:
    place = _bank_of_motors(log)
    if place is None:
        return None
    bank, channels = place
    names = tuple(f"output[{i}]" for i in channels)
    instances = range(len(log.topics.get("actuator_outputs", [])))
    found = [log.series("actuator_outputs", names, i) for i in instances]
    found = [s for s in found if s is not None and s.t.size > 1 and np.isfinite(s.values).all()]
    if not found:
        return None
    series = max(found, key=lambda each: float(each.values.std(axis=0).min()))
    kind, ends = _limits(log, series.values, bank, channels)
    low, high = ends.T
    shares = np.clip((series.values - low) / (high - low), 0.0, 1.0)
    curve, what = _thrust_curve(log)
    speeds = np.sqrt(curve * shares**2 + (1 - curve) * shares) if curve else shares
    note = f"commands are actuator_outputs.output, {kind} {low.min():g}..{high.max():g}, {what}"
    return Rotors(Series(series.t, speeds), "actuator_outputs", names, note)


def _thrust_curve(log: Topics) -> tuple[float, str]:
    """THR_MDL_FAC, 0 if it is not known, and what follows for the speeds."""
    curve = log.parameters.get("THR_MDL_FAC", 0.0)
    if 0 < curve <= 1:
        return curve, f"taken as fractions of full-scale rotor speed by THR_MDL_FAC = {curve:.3g}"
    return 0.0, (
        "taken as fractions of full-scale rotor speed, because THR_MDL_FAC is 0: the thrust curve was not measured "
        "(the term curve of a vehicle fits it, if the accelerometer was logged)"
    )


def _bank_of_motors(log: Topics) -> tuple[str, list[int]] | None:
    """The outputs of motors 1 to 4, and the beginning of their parameters' names. Old PX4: the first four of MAIN.

    None if the log says which motor an output drives, but no driver has all four motors.
    """
    for bank in _BANKS:
        functions = [int(log.parameters.get(f"{bank}_FUNC{i + 1}", 0.0)) for i in range(_OUTPUTS)]
        order = _motor_order(functions)
        if order is not None:
            return bank, order
    known = any(f"{bank}_FUNC1" in log.parameters for bank in (*_BANKS, *_OTHER_BANKS))
    return None if known else ("PWM_MAIN", [0, 1, 2, 3])


def _motor_order(functions: list[int]) -> list[int] | None:
    """Where motors 1 to 4 are among the outputs with these functions; None if one of them is not."""
    motors = range(_FIRST_MOTOR, _FIRST_MOTOR + 4)
    return [functions.index(motor) for motor in motors] if set(motors) <= set(functions) else None


def _limits(log: Topics, values: np.ndarray, bank: str, channels: list[int]) -> tuple[str, np.ndarray]:
    """The protocol, and the values of each output at which a motor idles and is at full speed, shape (4, 2)."""
    turning = values[values > 1]
    small, link = bool((turning < _LEAST_PWM).any()), log.latest("esc_status", "esc_connectiontype")
    if bank == "UAVCAN_EC" or (turning > _HIGHEST_PWM).any() or (small and link == _CAN):
        return "UAVCAN", _ends(log, [("UAVCAN_EC_MIN", "UAVCAN_EC_MAX")], channels, (0.0, 8191.0), _UAVCAN)
    timers = [log.parameters.get(f"{bank}_TIM{i}") for i in range(_TIMERS)]
    dshot = link == _DSHOT_LINK or log.parameters.get("DSHOT_CONFIG", 0.0) > 0
    if small or dshot or any(timer in _DSHOT_TIMERS for timer in timers):
        least = log.parameters.get("DSHOT_MIN", 0.0)
        return "DShot", np.tile([_DSHOT * least if 0 <= least < 0.5 else 0.0, _DSHOT], (4, 1))
    names = [(f"{bank}_MIN", f"{bank}_MAX"), ("PWM_MIN", "PWM_MAX")]
    return "PWM", _ends(log, names, channels, (_LEAST_PWM, _HIGHEST_PWM), _PWM)


def _ends(
    log: Topics,
    names: list[tuple[str, str]],
    channels: list[int],
    possible: tuple[float, float],
    default: tuple[float, float],
) -> np.ndarray:
    """The smallest and the largest value of each output: by number, else of the bank, else the default."""

    def known(channel: int, end: int) -> float:
        candidates = [f"{pair[end]}{number}" for pair in names for number in (channel + 1, "")]
        values = (log.parameters.get(name, math.nan) for name in candidates)
        return next((value for value in values if possible[0] <= value <= possible[1]), default[end])

    ends = np.array([[known(channel, 0), known(channel, 1)] for channel in channels])
    return np.where(ends[:, :1] < ends[:, 1:], ends, default)
