"""Narrow the brackets of all directions, by the sign of the cost's slope along each."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

PerDirection = Float[Array, "windows n"]


class Lines(NamedTuple):
    """The search along each direction. All positions are steps from where the sweep began.

    - `lower`, `upper`: the bracket, around the `predicted` step. `low`, `high`: what is left of it.
    - `trial`: the step of the next shot.
    - `last`, `value`: the step of the shot before, and the slope there.
    - `rate`: the slope's rate of change.
    """

    predicted: PerDirection
    lower: PerDirection
    upper: PerDirection
    low: PerDirection
    high: PerDirection
    trial: PerDirection
    last: PerDirection
    value: PerDirection
    rate: PerDirection

    @property
    def at_end(self) -> Bool[Array, "windows n"]:
        """Whether the trial is an end of its bracket."""
        return (self.trial == self.lower) | (self.trial == self.upper)


def open_lines(predicted: PerDirection, half_width: PerDirection, below: PerDirection, above: PerDirection) -> Lines:
    """Brackets of some half-width around the predicted steps, which go at most `below` backwards, `above` forwards.

    The first trial is the middle, and the expected rate of change is that of unit information.
    """
    predicted = jnp.clip(jnp.nan_to_num(predicted), -below, above)
    lower = jnp.maximum(predicted - half_width, -below)
    upper = jnp.minimum(predicted + half_width, above)
    middle, zero = (lower + upper) / 2, jnp.zeros_like(lower)
    return Lines(predicted, lower, upper, lower, upper, middle, middle, zero, jnp.ones_like(lower))


def narrow(lines: Lines, slope: PerDirection) -> Lines:
    """The lines after a shot at their trials.

    The sign of the slope says which side of the trial holds the zero. The next trial is where a line meets zero:
    through the last two trials, at first with the expected rate of change. It is the middle if the line leads out of
    what is left of the bracket.
    """
    low = jnp.where(slope <= 0, lines.trial, lines.low)
    high = jnp.where(slope >= 0, lines.trial, lines.high)
    secant = (slope - lines.value) / (lines.trial - lines.last)
    rate = jnp.where((secant > 0) & jnp.isfinite(secant), secant, lines.rate)
    zero = lines.trial - slope / rate
    narrowed_there = ((zero <= low) & (low > lines.lower)) | ((zero >= high) & (high < lines.upper))
    following = jnp.where(narrowed_there, (low + high) / 2, jnp.clip(zero, low, high))
    return lines._replace(low=low, high=high, trial=following, last=lines.trial, value=slope, rate=rate)
