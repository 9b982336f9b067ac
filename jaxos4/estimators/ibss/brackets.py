"""How wide the search looks along each direction. All steps are in standard deviations."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..._custom_types import Scalar
from .stage import Limits

# The first sweep goes at most this many of the start's standard deviations, in brackets of this share of them.
_OPENING, _FIRST = 4.0, 0.05
# A later bracket is the last relative error of the predictions, at least the second number, times the first.
_SAFETY, _LEAST = 2.0, 0.01
GROWTH = 4.0  # of a bracket whose search ended at one of its ends


class Brackets(NamedTuple):
    """Along each direction: the half-width of the bracket around the predicted step, and the longest step allowed."""

    half_width: Float[Array, "windows n"]
    longest: Float[Array, "windows n"]


def open_brackets(
    factor: Float[Array, "windows n n"],
    spread: Float[Array, "windows n n"],
    *,
    later: Float[Array, "windows n"],
    first: Bool[Array, ""],
) -> Brackets:
    """The brackets of one sweep: in the first sweep from the covariance `spread` of the start, then `later`."""
    opening = _OPENING * jnp.sqrt(jnp.einsum("wud,wuv,wvd->wd", factor, spread, factor))
    return Brackets(jnp.where(first, _FIRST * opening, later), jnp.where(first, opening, jnp.inf))


def relative_error(
    errors: Float[Array, "windows n"], steps: Float[Array, "windows n"], smallest_step: Scalar
) -> Scalar:
    """How far the predicted steps were off, as a share of the longest step, with a margin for the next sweep."""
    share = _SAFETY * jnp.abs(errors).max() / jnp.maximum(jnp.abs(steps).max(), smallest_step)
    return jnp.clip(share, _LEAST, 1.0)


def rooms(
    unknowns: Float[Array, "windows n"], basis: Float[Array, "windows n n"], limits: Limits
) -> tuple[Float[Array, "windows n"], Float[Array, "windows n"]]:
    """How far each window can go against and along each direction until an unknown reaches its limit."""
    moves = basis != 0
    to_lower, to_upper = ((limit - unknowns)[:, :, None] / jnp.where(moves, basis, 1.0) for limit in limits)
    above = jnp.where(moves, jnp.maximum(to_lower, to_upper), jnp.inf).min(axis=1)
    below = jnp.where(moves, -jnp.minimum(to_lower, to_upper), jnp.inf).min(axis=1)
    return jnp.maximum(below, 0.0), jnp.maximum(above, 0.0)
