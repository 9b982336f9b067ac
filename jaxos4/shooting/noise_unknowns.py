"""The unknowns of a likelihood of innovations besides the parameters: the noise of each channel, and feedthroughs."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Scalar
from ..bracket import PROPER_PRIOR
from .abstract import Unknowns
from .gains import first_noise, is_rate


class NoiseUnknowns(NamedTuple):
    """How the noise of each channel is looked for: the logarithms of a strength, a time constant and a sensor's noise.

    - `precision`: of a weak prior on each logarithm, as the reciprocal of a variance.
    - `stride`: the cost is roughly quadratic in a logarithm over such a step.
    - `reach`: factor to either side of the first noise levels; large, as simulated flights have no disturbance.
    - `times`: time constants of the disturbance at which searches start [s]: the likelihood has several maxima.
    - `shortest`, `longest`: of the time constants, in samples and in seconds.
    - `shortest_of_force`: of a disturbance of specific force [s]: what is faster is vibration, a noise of the sensor.
    """

    precision: float = 1e-2
    stride: float = 1.0
    reach: float = 1e8
    times: tuple[float, ...] = (0.2, 0.03)
    shortest: float = 0.25
    longest: float = 3.0
    shortest_of_force: float = 0.25

    def after(
        self,
        own: Unknowns,
        channels: tuple[str, ...],
        feedthroughs: int,
        measured: Float[Array, "samples channels"],
        dt: Scalar,
        least_noise: Float[Array, " channels"],
    ) -> Unknowns:
        """The parameters, then noise and feedthroughs of each channel, in brackets from differences of measurements."""
        first = jnp.stack(first_noise(measured, dt, self.times[0]), axis=1)
        lowest, highest = first - np.log(self.reach), first + np.log(self.reach)
        shortest = jnp.where(is_rate(first.shape[0]), jnp.log(self.shortest * dt), np.log(self.shortest_of_force))
        lowest, highest = lowest.at[:, 1].set(shortest), highest.at[:, 1].set(np.log(self.longest))
        lowest = lowest.at[:, 2].max(jnp.log(jnp.maximum(least_noise, jnp.finfo(float).tiny)))
        first, lowest, highest = (
            jnp.pad(x, ((0, 0), (0, feedthroughs)), constant_values=value)
            for x, value in ((first, 0.0), (lowest, -np.inf), (highest, np.inf))
        )
        names = tuple(each.format(name) for name in channels for each in own_names(feedthroughs))
        precision = jnp.full(first.size, self.precision)
        return Unknowns(
            names=own.names + names,
            units=own.units + tuple("1" if name.startswith("log") else "rad/s" for name in names),
            parameters=own.count,
            prior=PROPER_PRIOR,
            center=jnp.concatenate([own.center, first.ravel()]),
            half_width=jnp.concatenate([own.half_width, 1 / jnp.sqrt(precision)]),
            free=jnp.concatenate([own.free, jnp.ones(first.size, dtype=bool)]),
            precision=jnp.concatenate([1 / jnp.square(own.usable.half_width), precision]),
            lowest=jnp.concatenate([own.lowest, lowest.ravel()]),
            highest=jnp.concatenate([own.highest, highest.ravel()]),
            stride=jnp.concatenate([own.stride, jnp.full(first.size, self.stride)]),
        )


def own_names(feedthroughs: int) -> tuple[str, ...]:
    """The names of the unknowns of a channel, with its name to be filled in."""
    more = tuple(f"{{}}_feedthrough_{i + 1}" for i in range(feedthroughs))
    return ("log_{}_strength", "log_{}_time", "log_{}_sensor", *more)
