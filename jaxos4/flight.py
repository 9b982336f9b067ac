"""What a flight recorded: rotor speeds in, rates, attitude, velocity and position out."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._custom_types import RotorSpeeds, Scalar, States, as_float
from .results import RESULTS

STATE_NAMES = ("x", "vx", "y", "vy", "z", "vz", "phi", "p", "theta", "q", "psi", "r")
STATE_UNITS = ("m", "m/s", "m", "m/s", "m", "m/s", "rad", "rad/s", "rad", "rad/s", "rad", "rad/s")


def _success() -> RESULTS:
    return RESULTS.successful


class Flight(eqx.Module):
    """A recorded or simulated flight on a uniform time grid.

    **Arguments:**

    - `time`: sample times [s], uniform.
    - `omega`: rotor speeds [rad/s]; row k is held from `time[k]` to `time[k+1]`, the last row drives nothing.
    - `states`: in the order of `STATE_NAMES` (Eq. (14)) and the units of `STATE_UNITS`. NaN: not measured.
    - `specific_force`: what an accelerometer measures along the body axes [m/s^2]. `None` or NaN: not measured.
    - `result`: how a simulation ended; rows from a failure on are NaN.
    """

    time: Float[Array, " samples"] = eqx.field(converter=as_float)
    omega: RotorSpeeds = eqx.field(converter=as_float)
    states: States = eqx.field(converter=as_float)
    specific_force: Float[Array, "samples 3"] | None = eqx.field(
        converter=lambda x: None if x is None else as_float(x), default=None
    )
    result: RESULTS = eqx.field(default_factory=_success)

    def __check_init__(self):
        samples = self.time.shape
        if len(samples) != 1 or self.omega.shape != (*samples, 4) or self.states.shape != (*samples, 12):
            raise ValueError(
                "`time`, `omega` and `states` must have shapes (samples,), (samples, 4) and (samples, 12), got "
                f"{samples}, {self.omega.shape} and {self.states.shape}; a batch of flights is made by `vmap`."
            )
        if self.specific_force is not None and self.specific_force.shape != (*samples, 3):
            raise ValueError(f"`specific_force` must have shape {(*samples, 3)}, got {self.specific_force.shape}.")
        if samples[0] < 2:
            raise ValueError(f"A flight needs at least two samples, got {samples[0]}.")

    @property
    def dt(self) -> Scalar:
        """The sample time [s]."""
        return (self.time[-1] - self.time[0]) / (self.time.shape[0] - 1)


def channel_indices(*names: str) -> Array:
    """Columns of `Flight.states` of the states `names`."""
    return jnp.array([STATE_NAMES.index(name) for name in names])
