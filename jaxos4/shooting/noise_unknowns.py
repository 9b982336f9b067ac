"""The unknowns of filter error, in their order: the parameters, then noise and gains of each channel, with brackets."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Numeric, Scalar
from ..bracket import PROPER_PRIOR
from ..flight import FORCE_NAMES
from .abstract import Unknowns
from .gains import RATE_COUNT, LogNoise, is_rate

if TYPE_CHECKING:
    from .innovations import InnovationsProblem

PRECISION = 1e-2  # of a weak prior on each logarithm of a noise level, as the reciprocal of a variance
TIMES = 0.2, 0.03  # s; time constants of the disturbance at which searches start: the likelihood has several maxima
_STRIDE = 1.0  # the cost is roughly quadratic in a logarithm over such a step
_REACH = 1e8  # factor to either side of the first noise levels; large, as simulated flights have no disturbance
_SHORTEST, _LONGEST = 0.25, 3.0  # time constants, in samples and in seconds
_SHORTEST_OF_FORCE = 0.25  # s; faster disturbances of specific force are vibration, a noise of the sensor
# Time constants of a force's low-pass filter [s]: the start of a search, and the largest, which is shorter than that of
# any disturbance of a force. The smallest is `_SHORTEST`.
_SMOOTHING, _LONGEST_SMOOTHING = 0.05, 0.2


@jax.jit  # traced once for all callers
def first_noise(measured: Float[Array, "samples channels"], dt: Scalar, time_constant: Scalar) -> LogNoise:
    """Rough noise levels from differences of the measurements. `time_constant`: of all disturbances [s]."""

    def power(values: Float[Array, "rows channels"]) -> Float[Array, " channels"]:
        known = ~jnp.isnan(values)
        return jnp.where(known, jnp.square(values), 0.0).sum(axis=0) / jnp.maximum(known.sum(axis=0), 1)

    def logarithm(values: Float[Array, " channels"]) -> Float[Array, " channels"]:
        return jnp.log(jnp.where((values > 0) & jnp.isfinite(values), values, 1.0))

    # White noise has second differences of 6 times its variance.
    sensor = jnp.sqrt(power(jnp.diff(measured, n=2, axis=0)) / 6)
    change = jnp.sqrt(power(jnp.diff(measured, axis=0))) / dt / 2
    mean = jnp.nansum(measured, axis=0) / jnp.maximum((~jnp.isnan(measured)).sum(axis=0), 1)
    spread = jnp.sqrt(power(measured - mean)) / 2
    strength = jnp.where(is_rate(change), change, spread)
    return LogNoise(logarithm(strength), jnp.full(strength.shape, jnp.log(time_constant)), logarithm(sensor))


def levels(channels: int) -> int:
    """The number of noise levels of each channel; 4 instead of 3 if there are specific forces, see `LogNoise`."""
    return 4 if channels > RATE_COUNT else 3


def with_noise(problem: "InnovationsProblem") -> Unknowns:
    """The parameters, then noise, gains and feedthroughs of each channel, in brackets from the measurements.

    The unknowns of the noise are the logarithms of its levels, see `LogNoise`.
    """
    own, measured, dt = problem.problem.unknowns, problem.problem.measured(), problem.flight.dt
    has_input = (problem.input_innovations != 0).any(axis=0).T  # by channel and feedthrough
    first = jnp.stack(first_noise(measured, dt, TIMES[0])[:3], axis=1)
    count, rate, shortest = levels(first.shape[0]), is_rate(first), jnp.log(_SHORTEST * dt)
    smoothing = jnp.full((first.shape[0], count - first.shape[1]), np.log(_SMOOTHING))
    first = jnp.concatenate([first, jnp.maximum(smoothing, shortest)], axis=1)
    lowest, highest = first - np.log(_REACH), first + np.log(_REACH)
    lowest = lowest.at[:, 1].set(jnp.where(rate[:, 0], shortest, np.log(_SHORTEST_OF_FORCE)))
    highest = highest.at[:, 1].set(np.log(_LONGEST))
    # A rate has no filter: its `smoothing` is fixed.
    lowest = lowest.at[:, 3:].set(jnp.where(rate, first[:, 3:], shortest))
    highest = highest.at[:, 3:].set(jnp.where(rate, first[:, 3:], np.log(_LONGEST_SMOOTHING)))
    lowest = lowest.at[:, 2].max(jnp.log(jnp.maximum(problem.least_noise, jnp.finfo(float).tiny)))
    free = jnp.ones(first.shape, dtype=bool).at[:, 3:].set(~rate)
    more = 3 * has_input.shape[1]
    first, lowest, highest = (
        jnp.pad(x, ((0, 0), (0, more)), constant_values=value)
        for x, value in ((first, 0.0), (lowest, -np.inf), (highest, np.inf))
    )
    # An input innovation that is always 0 has no gain to estimate. Of lagged innovations, only the first has a gain on
    # the disturbance: one sample later, it is the same disturbance less a step of the rate.
    of_disturbance = has_input & ~(problem.lagged & (np.arange(has_input.shape[1]) > 0))
    free = jnp.concatenate([free, has_input, of_disturbance, has_input & rate & problem.answers_within], axis=1)
    names = tuple(each.format(name) for name in problem.channels for each in own_names(count, has_input.shape[1]))
    precision = jnp.full(first.size, PRECISION)
    return Unknowns(
        names=own.names + names,
        units=own.units + tuple(_unit(name) for name in names),
        parameter_count=own.count,
        largest_std=PROPER_PRIOR,
        center=jnp.concatenate([own.center, first.ravel()]),
        half_width=jnp.concatenate([own.half_width, 1 / jnp.sqrt(precision)]),
        free=jnp.concatenate([own.free, free.ravel()]),
        precision=jnp.concatenate([1 / jnp.square(own.usable.half_width), precision]),
        lowest=jnp.concatenate([own.lowest, lowest.ravel()]),
        highest=jnp.concatenate([own.highest, highest.ravel()]),
        stride=jnp.concatenate([own.stride, jnp.full(first.size, _STRIDE)]),
    )


def own_names(count: int, feedthroughs: int) -> tuple[str, ...]:
    """The names of the unknowns of a channel, with its name to be filled in. `count`: of noise levels."""
    noise = ("log_{}_strength", "log_{}_time", "log_{}_sensor", "log_{}_smoothing")
    of_inputs = ("rate_gain", "disturbance_gain", "feedthrough")
    return (*noise[:count], *(f"{{}}_{what}_{i + 1}" for what in of_inputs for i in range(feedthroughs)))


def _unit(name: str) -> str:
    if name.startswith("log"):
        return "1"
    if name.startswith(FORCE_NAMES):
        return "m/s^2"
    return "rad/s^2" if "disturbance" in name else "rad/s"


def joined(
    gradient: Float[Array, "channels some"], information: Float[Array, "channels some some"], count: int
) -> tuple[Float[Array, " unknowns"], Float[Array, "unknowns unknowns"]]:
    """Gradient and information in all unknowns, from each channel's in `count` parameters and its other unknowns."""
    channels, each = gradient.shape[0], gradient.shape[1] - count
    size = count + each * channels
    total = jnp.concatenate([gradient[:, :count].sum(axis=0), gradient[:, count:].ravel()])
    whole = jnp.zeros((size, size), dtype=float).at[:count, :count].set(information[:, :count, :count].sum(axis=0))
    for i in range(channels):
        own = slice(count + each * i, count + each * (i + 1))
        whole = whole.at[:count, own].set(information[i, :count, count:])
        whole = whole.at[own, :count].set(information[i, count:, :count])
        whole = whole.at[own, own].set(information[i, count:, count:])
    return total, whole


def placed(
    gradient: Float[Array, "segments some"],
    information: Float[Array, "segments some some"],
    places: Int[Numeric, "segments some"],
    size: int,
) -> tuple[Float[Array, "segments size"], Float[Array, "segments size size"]]:
    """Gradient and information of each segment in all `size` unknowns, from its own, which are at `places`."""
    segments = np.arange(places.shape[0])
    pairs = segments[:, None, None], places[:, :, None], places[:, None, :]
    return (
        jnp.zeros((places.shape[0], size), dtype=float).at[segments[:, None], places].add(gradient),
        jnp.zeros((places.shape[0], size, size), dtype=float).at[pairs].add(information),
    )
