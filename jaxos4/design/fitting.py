"""The largest amplitude of an input that all vehicles of a bracket can fly, and the bounds that it reaches."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, RotorSpeeds, Scalar, as_float
from ..bracket import Bracket
from ..models.abstract import AbstractModel
from ..simulation import simulate
from .criterion import bounds_of
from .envelope import Envelope, largest
from .information import sense
from .steering import amplified, hover_squares

# Vehicles that must stay within the envelope, and the finer step at which they are flown.
VEHICLES, FINER = 200, 10
# The share of a limit that an input uses at most: other vehicles from the bracket may need a little more.
_TARGET, _PRECISION = 0.95, 0.005
_MOST_TRIALS, _MOST_CORRECTIONS, _MOST_AMPLIFIED = 15, 5, 100.0


class DesignedInput(NamedTuple):
    """An input, and what a flight with it tells.

    - `omega`: rotor speeds [rad/s], held from sample to sample. `dt`: the sample time [s].
    - `bounds`: the smallest standard deviation that each parameter can have after each sample of the flight, for a
      vehicle with the airframe's constants. Infinite as long as a parameter is not excited.
    - `uses`: by the name of the limit, the largest share of it that any vehicle of the bracket uses; at most 1.
    """

    omega: Float[np.ndarray, "samples 4"]
    dt: float
    bounds: Float[np.ndarray, "samples parameters"]
    uses: dict[str, float]

    def first_time(self, wanted: Float[Numeric, " parameters"]) -> float:
        """The time [s] after which every parameter can have a standard deviation of at most `wanted`.

        Infinite if the flight is too short.
        """
        enough = (self.bounds <= np.asarray(wanted)).all(axis=1)
        return float(self.dt * np.argmax(enough)) if enough.any() else math.inf


class Plan(eqx.Module):
    """What inputs of one length are compared by.

    - `vehicles`: the parameters of those that must stay within the envelope.
    - `weights`: 1 / sigma of each channel, in cascade order.
    - `start_is_known`: whether the flight starts exactly at rest.
    """

    model: AbstractModel
    envelope: Envelope
    vehicles: Float[Array, "vehicles parameters"]
    weights: Float[Array, " sensors"]
    dt: Scalar
    start_is_known: bool = eqx.field(static=True)


def fitted(plan: Plan, omega: RotorSpeeds) -> DesignedInput:
    """The input with the largest amplitude that all vehicles can fly.

    It is found at the sample time, and corrected until the limits hold at a tenth of it.
    """
    hover, own = hover_squares(plan.model.airframe, plan.envelope), np.asarray(omega)

    def used(factor: float, finer: int = 1) -> dict[str, float]:
        shares = _largest(plan, as_float(amplified(own, hover, factor)), finer)
        return {name: float(np.max(share)) for name, share in shares.items()}

    target = _TARGET
    for _ in range(_MOST_CORRECTIONS):
        factor = _largest_factor(lambda factor: max(used(factor).values()), target)
        uses = used(factor, FINER)
        if max(uses.values()) <= 1:
            break
        target *= _TARGET / max(uses.values())
    else:
        factor, uses = 0.0, used(0.0, FINER)
    scaled = amplified(own, hover, factor)
    return DesignedInput(scaled, float(plan.dt), np.asarray(_histories(plan, as_float(scaled))), uses)


def _largest_factor(used: Callable[[float], float], target: float) -> float:
    """The factor of an amplitude at which `used` is `target`, or a little less. By regula falsi."""
    low, high, factor = (0.0, used(0.0)), None, 1.0
    for _ in range(_MOST_TRIALS):
        share = used(factor)
        if share > target:
            high = factor, share
        else:
            low = factor, share
            if share >= target - _PRECISION or factor > _MOST_AMPLIFIED:
                break
        factor = 2 * factor if high is None else _between(low, high, target)
    return low[0]


def _between(low: tuple[float, float], high: tuple[float, float], target: float) -> float:
    """Where a line from `low` to `high` meets the target, less half the precision; or the middle."""
    share = (target - _PRECISION / 2 - low[1]) / (high[1] - low[1])
    share = share if math.isfinite(high[1]) and share > 0 else 0.5
    return low[0] + min(max(share, 0.05), 0.95) * (high[0] - low[0])


@eqx.filter_jit
def fly_finely(
    model: AbstractModel,
    vehicles: Float[Array, "vehicles parameters"],
    omega: RotorSpeeds,
    dt: Scalar,
    finer: int = FINER,
) -> Float[Array, "vehicles times 12"]:
    """The states of all vehicles from rest, at a `finer` step than the sample time."""
    held = jnp.concatenate([jnp.repeat(omega[:-1], finer, axis=0), omega[-1:]])
    return jax.vmap(lambda a: simulate(model, a, held, dt=dt / finer).states)(vehicles)


@eqx.filter_jit
def _largest(plan: Plan, omega: RotorSpeeds, finer: int) -> dict[str, Float[Array, " columns"]]:
    """The largest share of each limit that one of the vehicles uses."""
    flown = fly_finely(plan.model, plan.vehicles, omega, plan.dt, finer)
    of_states = jax.vmap(lambda states: largest(plan.envelope.uses_of_states(states)))(flown)
    return largest(plan.envelope.uses_of_rotors(omega, plan.dt)) | jax.tree.map(lambda x: x.max(axis=0), of_states)


@eqx.filter_jit
def _histories(plan: Plan, omega: RotorSpeeds) -> Float[Array, "samples parameters"]:
    """The bounds after each sample of a flight of the airframe's vehicle."""
    parameters = plan.model.alpha
    slopes = sense(plan.model, omega, parameters, plan.dt, plan.weights, plan.start_is_known).slopes

    def add(total: Float[Array, "unknowns unknowns"], slopes: Float[Array, "sensors unknowns"]):
        total = total + slopes.T @ slopes
        return total, jnp.sqrt(jnp.diagonal(bounds_of(total, parameters.shape[0])[0]))

    nothing = jnp.zeros((slopes.shape[-1],) * 2, dtype=float)
    return jax.lax.scan(add, nothing, slopes)[1]


@functools.partial(jax.jit, static_argnums=2)
def drawn(bracket: Bracket, key: Key, count: int) -> Float[Array, "count parameters"]:
    """Vehicles drawn uniformly from the bracket."""
    lower, upper = bracket.lower, bracket.upper
    return lower + (upper - lower) * jax.random.uniform(key, (count, lower.shape[0]), dtype=float)
