"""The unknowns of the noise in filter error: names, first values and brackets."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Scalar
from ..bracket import PROPER_PRIOR
from .abstract import Unknowns
from .gains import RATE_COUNT, LogNoise, is_rate


@jax.jit  # traced once, although many ask for it
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
    """The number of noise levels of each channel: one more if there are specific forces, see `LogNoise`."""
    return 4 if channels > RATE_COUNT else 3


class NoiseUnknowns(NamedTuple):
    """How the noise of each channel is looked for: the logarithms of `LogNoise`.

    - `precision`: of a weak prior on each logarithm, as the reciprocal of a variance.
    - `stride`: the cost is roughly quadratic in a logarithm over such a step.
    - `reach`: factor to either side of the first noise levels; large, as simulated flights have no disturbance.
    - `times`: time constants of the disturbance at which searches start [s]: the likelihood has several maxima.
    - `shortest`, `longest`: of the time constants, in samples and in seconds.
    - `shortest_of_force`: of a disturbance of specific force [s]: what is faster is vibration, a noise of the sensor.
    - `smoothing`, `longest_smoothing`: where the search of a force's low-pass filter starts, and its largest time
      constant [s], which is shorter than that of any disturbance. The shortest is `shortest`.
    """

    precision: float = 1e-2
    stride: float = 1.0
    reach: float = 1e8
    times: tuple[float, ...] = (0.2, 0.03)
    shortest: float = 0.25
    longest: float = 3.0
    shortest_of_force: float = 0.25
    smoothing: float = 0.05
    longest_smoothing: float = 0.2

    def after(
        self,
        own: Unknowns,
        channels: tuple[str, ...],
        measured: Float[Array, "samples channels"],
        dt: Scalar,
        least_noise: Float[Array, " channels"],
        *,
        has_input: Bool[Array, "channels feedthroughs"],
        answers_within: Bool[Array, ""],
    ) -> Unknowns:
        """The parameters, then noise, gains and feedthroughs of each channel, in brackets from the measurements.

        `has_input`: which input innovations a channel has. `answers_within`: see `InnovationsProblem`.
        """
        if self.longest_smoothing >= self.shortest_of_force:
            raise ValueError(
                f"`longest_smoothing` must be shorter than `shortest_of_force`, {self.shortest_of_force} s, "
                f"got {self.longest_smoothing} s."
            )
        first = jnp.stack(first_noise(measured, dt, self.times[0])[:3], axis=1)
        count, rate, shortest = levels(first.shape[0]), is_rate(first), jnp.log(self.shortest * dt)
        smoothing = jnp.full((first.shape[0], count - first.shape[1]), np.log(self.smoothing))
        first = jnp.concatenate([first, jnp.maximum(smoothing, shortest)], axis=1)
        lowest, highest = first - np.log(self.reach), first + np.log(self.reach)
        lowest = lowest.at[:, 1].set(jnp.where(rate[:, 0], shortest, np.log(self.shortest_of_force)))
        highest = highest.at[:, 1].set(np.log(self.longest))
        # A rate has no filter: its place stays where it is.
        lowest = lowest.at[:, 3:].set(jnp.where(rate, first[:, 3:], shortest))
        highest = highest.at[:, 3:].set(jnp.where(rate, first[:, 3:], np.log(self.longest_smoothing)))
        lowest = lowest.at[:, 2].max(jnp.log(jnp.maximum(least_noise, jnp.finfo(float).tiny)))
        free = jnp.ones(first.shape, dtype=bool).at[:, 3:].set(~rate)
        more = 3 * has_input.shape[1]
        first, lowest, highest = (
            jnp.pad(x, ((0, 0), (0, more)), constant_values=value)
            for x, value in ((first, 0.0), (lowest, -np.inf), (highest, np.inf))
        )
        # An input innovation that is always 0 has no gain to estimate.
        free = jnp.concatenate([free, has_input, has_input, has_input & rate & answers_within], axis=1)
        names = tuple(each.format(name) for name in channels for each in own_names(count, has_input.shape[1]))
        precision = jnp.full(first.size, self.precision)
        return Unknowns(
            names=own.names + names,
            units=own.units + tuple(_unit(name) for name in names),
            parameter_count=own.count,
            prior=PROPER_PRIOR,
            center=jnp.concatenate([own.center, first.ravel()]),
            half_width=jnp.concatenate([own.half_width, 1 / jnp.sqrt(precision)]),
            free=jnp.concatenate([own.free, free.ravel()]),
            precision=jnp.concatenate([1 / jnp.square(own.usable.half_width), precision]),
            lowest=jnp.concatenate([own.lowest, lowest.ravel()]),
            highest=jnp.concatenate([own.highest, highest.ravel()]),
            stride=jnp.concatenate([own.stride, jnp.full(first.size, self.stride)]),
        )


def own_names(count: int, feedthroughs: int) -> tuple[str, ...]:
    """The names of the unknowns of a channel, with its name to be filled in. `count`: of noise levels."""
    noise = ("log_{}_strength", "log_{}_time", "log_{}_sensor", "log_{}_smoothing")
    of_inputs = ("rate_gain", "disturbance_gain", "feedthrough")
    return (*noise[:count], *(f"{{}}_{what}_{i + 1}" for what in of_inputs for i in range(feedthroughs)))


def _unit(name: str) -> str:
    if name.startswith("log"):
        return "1"
    if name.startswith("a"):
        return "m/s^2"
    return "rad/s^2" if "disturbance" in name else "rad/s"
