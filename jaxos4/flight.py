"""What a flight recorded: rotor speeds in, rates, attitude, velocity and position out."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from ._custom_types import RotorSpeeds, Scalar, States, as_float
from .results import RESULTS

STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz", "phi", "p", "theta", "q", "psi", "r")
STATE_UNITS = ("m", "m/s", "m", "m/s", "m", "m/s", "rad", "rad/s", "rad", "rad/s", "rad", "rad/s")
FORCE_NAMES = ("ax", "ay", "az")
CHANNEL_NAMES = (*STATE_NAMES, *FORCE_NAMES)
CHANNEL_UNITS = (*STATE_UNITS, *("m/s^2",) * 3)
"""All that a flight can have measured: the states, then the specific force."""


def _optional_float(x: ArrayLike | None) -> Array | None:
    return None if x is None else as_float(x)


def _success() -> RESULTS:
    return RESULTS.successful


class Stretches(NamedTuple):
    """For each sample of joined flights: the `number` of its uninterrupted stretch, and that one's ends.

    Numbers count from 0, in order. `first`, `last`: samples.
    """

    number: Int[Array, " samples"]
    first: Int[Array, " samples"]
    last: Int[Array, " samples"]

    @classmethod
    def of(cls, number: Int[Array, " samples"]) -> "Stretches":
        """With the ends found."""
        return cls(number, jnp.searchsorted(number, number), jnp.searchsorted(number, number, side="right") - 1)


class Inputs(NamedTuple):
    """What drives a vehicle, on the time grid of its flight.

    - `omega`: rotor speeds, measured or commanded [rad/s].
    - `dt`: the sample time [s].
    - `velocity`: along the body's axes [m/s], where that is known.
    - `force`: the measured specific force along the body's axes [m/s^2], where a model takes it as an input.
    - `stretches`: which uninterrupted stretch each sample belongs to; `None`: all to one.
    """

    omega: RotorSpeeds
    dt: Scalar
    velocity: Float[Array, "samples 3"] | None = None
    force: Float[Array, "samples 3"] | None = None
    stretches: Stretches | None = None


class Flight(eqx.Module):
    """A recorded or simulated flight on a uniform time grid.

    **Arguments:**

    - `time`: sample times [s], uniform.
    - `omega`: rotor speeds [rad/s]; row k is held from `time[k]` to `time[k+1]`, the last row drives nothing.
    - `states`: in the order of `STATE_NAMES` (Eq. (14)) and the units of `STATE_UNITS`. NaN: not measured.
    - `specific_force`: what an accelerometer measures along the body axes [m/s^2]. `None` or NaN: not measured.
    - `result`: how a simulation ended; rows from a failure on are NaN.
    - `body_velocity`: along the body's axes [m/s], where a model takes it as an input; no NaN. `None`: not known.
    - `stretch`: which uninterrupted stretch each sample belongs to, counted from 0, where several are joined
      (`jaxos4.join`): time then is a count of samples. `None`: all belong to one.
    - `commanded`: whether the rotor speeds are commands, which rotors follow with a lag, and were not measured.
    """

    time: Float[Array, " samples"] = eqx.field(converter=as_float)
    omega: RotorSpeeds = eqx.field(converter=as_float)
    states: States = eqx.field(converter=as_float)
    specific_force: Float[Array, "samples 3"] | None = eqx.field(converter=_optional_float, default=None)
    result: RESULTS = eqx.field(default_factory=_success)
    body_velocity: Float[Array, "samples 3"] | None = eqx.field(converter=_optional_float, default=None)
    stretch: Int[Array, " samples"] | None = None
    commanded: bool = eqx.field(static=True, default=False)

    def __check_init__(self):
        samples = self.time.shape
        if len(samples) != 1 or self.omega.shape != (*samples, 4) or self.states.shape != (*samples, 12):
            raise ValueError(
                "`time`, `omega` and `states` must have shapes (samples,), (samples, 4) and (samples, 12), got "
                f"{samples}, {self.omega.shape} and {self.states.shape}; a batch of flights is made by `vmap`."
            )
        for name, shape in (
            ("specific_force", (*samples, 3)),
            ("body_velocity", (*samples, 3)),
            ("stretch", samples),
        ):
            value = getattr(self, name)
            if value is not None and value.shape != shape:
                raise ValueError(f"`{name}` must have shape {shape}, got {value.shape}.")
        if samples[0] < 2:
            raise ValueError(f"A flight needs at least two samples, got {samples[0]}.")

    @property
    def dt(self) -> Scalar:
        """The sample time [s]."""
        return (self.time[-1] - self.time[0]) / (self.time.shape[0] - 1)

    @property
    def inputs(self) -> Inputs:
        """What drives the vehicle."""
        stretches = None if self.stretch is None else Stretches.of(self.stretch)
        force = None if self.specific_force is None else held_values(self.specific_force, stretches)
        return Inputs(self.omega, self.dt, self.body_velocity, force, stretches)

    @property
    def channels(self) -> Float[Array, "samples 15"]:
        """All that was measured, in the order of `CHANNEL_NAMES`; NaN where not."""
        force = self.specific_force
        nothing = jnp.full((*self.states.shape[:-1], len(FORCE_NAMES)), jnp.nan, self.states.dtype)
        return jnp.concatenate([self.states, nothing if force is None else force], axis=-1)


def channel_indices(*names: str) -> Array:
    """Columns of `Flight.states` of the states `names`."""
    return jnp.array([STATE_NAMES.index(name) for name in names])


def held_values(
    values: Float[Array, "samples columns"], stretches: Stretches | None = None
) -> Float[Array, "samples columns"]:
    """Each column with what was not measured at the value before it, or after it, in its stretch; 0 where none is."""
    count = values.shape[0]
    index, measured = jnp.arange(count)[:, None], ~jnp.isnan(values)
    first, last = (0, count - 1) if stretches is None else (stretches.first[:, None], stretches.last[:, None])
    before = jax.lax.cummax(jnp.where(measured, index, -1))
    after = jax.lax.cummin(jnp.where(measured, index, count), reverse=True)
    known = (before >= first) | (after <= last)
    taken = jnp.where(before >= first, before, jnp.minimum(after, count - 1))
    return jnp.where(known, jnp.nan_to_num(jnp.take_along_axis(values, taken, axis=0)), 0.0)
