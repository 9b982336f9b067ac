"""A flight: the recorded rotor speeds, and the measured rates, attitude, velocity and position."""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from ._custom_types import Count, Numeric, RotorSpeeds, Scalar, States, as_float
from .results import RESULTS

STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz", "phi", "p", "theta", "q", "psi", "r")
STATE_UNITS = ("m", "m/s", "m", "m/s", "m", "m/s", "rad", "rad/s", "rad", "rad/s", "rad", "rad/s")
ANGLE_NAMES, RATE_NAMES = ("phi", "theta", "psi"), ("p", "q", "r")
ANGLES, RATES, POSITION, VELOCITY = (
    np.array([STATE_NAMES.index(name) for name in names])
    for names in (ANGLE_NAMES, RATE_NAMES, ("x", "y", "z"), ("vx", "vy", "vz"))
)
"""The places of some states in `STATE_NAMES`."""
SPEED_NAMES = ("omega1", "omega2", "omega3", "omega4")
COMMAND_NAMES = ("command1", "command2", "command3", "command4")
"""The columns of measured rotor speeds [rad/s], and of commands [0..1]."""
FORCE_NAMES = ("ax", "ay", "az")
CHANNEL_NAMES = (*STATE_NAMES, *FORCE_NAMES)
"""Every channel that a flight can measure: the states, then the specific force."""


class Signal(NamedTuple):
    """A field of `Flight` with one row a sample. All code that cuts, joins, averages, reads or writes flights uses it.

    - `shape`: the shape of a row; `None`: any.
    - `columns`: its columns in a log, by name, with their units; none if it follows from other signals.
    - `is_input`: whether models read it in all samples, so that it has no NaN. In other signals, NaN is not measured.
    """

    shape: tuple[int, ...] | None
    columns: Mapping[str, str] = MappingProxyType({})
    is_input: bool = False


def _optional_float(x: ArrayLike | None) -> Array | None:
    return None if x is None else as_float(x)


def _signal(*signal: Any, is_input: bool = False, converter: Any = _optional_float) -> Any:
    """A field of `Flight` that is `None` if it is not known. Arguments as of `Signal`."""
    return eqx.field(converter=converter, default=None, metadata={"signal": Signal(*signal, is_input=is_input)})


class Stretches(NamedTuple):
    """The number of the uninterrupted stretch of each sample, and the first and the last sample of that stretch."""

    number: Int[Array, " samples"]
    first: Int[Array, " samples"]
    last: Int[Array, " samples"]

    @classmethod
    def of(cls, number: Int[Array, " samples"]) -> "Stretches":
        """The stretches with these numbers, which are counted from 0 in order."""
        return cls(number, jnp.searchsorted(number, number), jnp.searchsorted(number, number, side="right") - 1)


class Inputs(NamedTuple):
    """The inputs of a vehicle on the time grid of its flight: rotor speeds [rad/s], and the sample time [s].

    - `velocity`: along the body's axes [m/s]. `None`: unknown.
    - `stretches`: `None`: the flight is one stretch.
    - `voltage`: the battery's voltage [V]. `None`: not logged.
    - `length`: the number of samples that count; the others are padding. `None`: all count.
    - `within`, `averaging_time`: see `Flight`.
    """

    omega: RotorSpeeds
    dt: Scalar
    velocity: Float[Array, "samples 3"] | None = None
    stretches: Stretches | None = None
    voltage: Float[Array, " samples"] | None = None
    length: Count | None = None
    within: Float[Array, "samples parts 4"] | None = None
    averaging_time: Scalar | float = 0.0

    @property
    def divided(self) -> "Inputs":
        """The inputs in the parts of each sample, as samples of their own."""
        if self.within is None:
            raise ValueError("`within` must be known.")
        (_, parts, _), voltage, stretches = self.within.shape, self.voltage, self.stretches
        if stretches is not None:
            first, last = (jnp.repeat(parts * place, parts) for place in stretches[1:])
            stretches = Stretches(jnp.repeat(stretches.number, parts), first, last + parts - 1)
        return self._replace(
            omega=self.within.reshape(-1, 4),
            dt=self.dt / parts,
            velocity=None,
            stretches=stretches,
            voltage=None if voltage is None else jnp.repeat(voltage, parts),
            length=None if self.length is None else parts * self.length,
            within=None,
        )


_STATES = Signal((len(STATE_NAMES),), dict(zip(STATE_NAMES, STATE_UNITS, strict=True)))


class Flight(eqx.Module):
    """A recorded or simulated flight on a uniform time grid. A new signal is a field here and in `Recording`.

    Its unit must be in `jaxos4.logs.values`. `report.log_figures` says where it is drawn. Fits compare states and
    specific force only (`CHANNEL_NAMES`). A signal that drives a model is also in `Inputs`, `Flight.inputs`, and what
    `recording.prepared` offers to terms.

    - `time`: sample times [s], uniform.
    - `omega`: rotor speeds [rad/s]; row k acts from `time[k]` to `time[k+1]`, the last row drives nothing. Unless they
      are `held`, measured speeds are those at `time[k]`.
    - `states`: in the order of `STATE_NAMES` (Eq. (14)) and the units of `STATE_UNITS`. NaN: not measured.
    - `specific_force`: the signal of an accelerometer along the body's axes [m/s^2]. `None` or NaN: not measured.
    - `result`: how a simulation ended. Rows after a failure are NaN.
    - `body_velocity`: along the body's axes [m/s], an input of some models; no NaN. `None`: unknown.
    - `stretch`: the number of the uninterrupted stretch of each sample, counted from 0. Joined flights have several
      (`jaxos4.join`), and their time counts samples. `None`: the flight is one stretch.
    - `commanded`: whether `omega` holds commands, which the rotors follow with a lag, and not measured speeds.
    - `voltage`: the battery's voltage [V], an input of some models; no NaN. `None`: not logged.
    - `held`: whether a row of `omega` acts over its whole sample (zero-order hold), and is not the speed at an instant.
    - `within`: the root mean square of each rotor's speed in equal parts of the sample, from `time[k]` - dt/2 to
      `time[k]` + dt/2 [rad/s]. `None`: unknown.
    - `averaging_time`: how long measurements are averaged around `time[k]` [s]; 0: they are those at this instant. The
      mean of n instants counts as a mean over sqrt(1 - 1/n^2) of the sample: their times have equal variance.

    **Raises:** `ValueError` for arrays whose shapes do not agree, or fewer than two samples.
    """

    time: Float[Array, " samples"] = eqx.field(converter=as_float)
    omega: RotorSpeeds = eqx.field(converter=as_float, metadata={"signal": Signal((4,), is_input=True)})
    states: States = eqx.field(converter=as_float, metadata={"signal": _STATES})
    specific_force: Float[Array, "samples 3"] | None = _signal((3,), dict.fromkeys(FORCE_NAMES, "m/s^2"))
    result: RESULTS = eqx.field(default_factory=lambda: RESULTS.successful)
    body_velocity: Float[Array, "samples 3"] | None = _signal((3,), is_input=True)
    stretch: Int[Array, " samples"] | None = _signal((), is_input=True, converter=None)
    commanded: bool = eqx.field(static=True, default=False)
    voltage: Float[Array, " samples"] | None = _signal((), {"voltage": "V"}, is_input=True)
    held: bool = eqx.field(static=True, default=True)
    within: Float[Array, "samples parts 4"] | None = _signal(None, is_input=True)
    averaging_time: Scalar = eqx.field(converter=as_float, default=0.0)

    def __check_init__(self):
        samples = self.time.shape
        if len(samples) != 1 or self.omega.shape != (*samples, 4) or self.states.shape != (*samples, 12):
            raise ValueError(
                "`time`, `omega` and `states` must have shapes (samples,), (samples, 4) and (samples, 12), got "
                f"{samples}, {self.omega.shape} and {self.states.shape}; a batch of flights is made by `vmap`."
            )
        for name, signal in SIGNALS.items():
            value = getattr(self, name)
            if value is not None and signal.shape is not None and value.shape != (*samples, *signal.shape):
                raise ValueError(f"`{name}` must have shape {(*samples, *signal.shape)}, got {value.shape}.")
        if samples[0] < 2:
            raise ValueError(f"A flight needs at least two samples, got {samples[0]}.")

    @property
    def dt(self) -> Scalar:
        """The sample time [s]."""
        # A recorded flight's sample time needs no compiled program.
        time = self.time if isinstance(self.time, Tracer) else np.asarray(self.time)
        return as_float((time[-1] - time[0]) / (time.shape[0] - 1))

    @property
    def stretch_numbers(self) -> Int[Numeric, " samples"]:
        """`stretch`, also of a flight that is one; NumPy unless it is traced."""
        if isinstance(self.stretch, Tracer):
            return self.stretch
        return np.zeros(self.time.shape[0], dtype=int) if self.stretch is None else np.asarray(self.stretch)

    @property
    def inputs(self) -> Inputs:
        """The inputs of the vehicle."""
        stretches = None if self.stretch is None else Stretches.of(self.stretch)
        own = self.omega, self.dt, self.body_velocity, stretches, self.voltage
        return Inputs(*own, within=self.within, averaging_time=self.averaging_time)

    @property
    def channels(self) -> Float[Array, "samples 15"]:
        """Every channel in the order of `CHANNEL_NAMES`; NaN: not measured."""
        return with_force(self.states, self.specific_force, jnp)

    @property
    def recorded(self) -> Float[np.ndarray, "samples 15"]:
        """`channels` of a recorded flight as NumPy, without a compiled program."""
        force = self.specific_force
        return with_force(np.asarray(self.states), None if force is None else np.asarray(force), np)


SIGNALS: dict[str, Signal] = {
    field.name: field.metadata["signal"] for field in dataclasses.fields(Flight) if "signal" in field.metadata
}
"""The fields of `Flight` with one row a sample, besides the time."""
UNITS = {name: unit for signal in SIGNALS.values() for name, unit in signal.columns.items()}
"""The unit of each column of a signal in a log."""


def with_force(states: Any, force: Any, numpy: Any) -> Any:
    """The channels of a flight as one array of `numpy` or `jax.numpy`; NaN: not measured."""
    nothing = numpy.full((*states.shape[:-1], len(FORCE_NAMES)), numpy.nan, states.dtype)
    return numpy.concatenate([states, nothing if force is None else force], axis=-1)


def last_measured(measured: Bool[np.ndarray, "samples *columns"]) -> Int[np.ndarray, "samples *columns"]:
    """The last measured sample up to each sample; before the first one, the first."""
    own = np.arange(len(measured)).reshape(-1, *[1] * (measured.ndim - 1))
    return np.maximum(np.maximum.accumulate(np.where(measured, own, -1), axis=0), measured.argmax(axis=0))


def filled(values: Float[np.ndarray, "samples *columns"]) -> Float[np.ndarray, "samples *columns"]:
    """Each gap gets the value before it, or the first one."""
    return np.take_along_axis(values, last_measured(~np.isnan(values)), axis=0)
