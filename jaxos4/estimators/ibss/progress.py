"""What the search remembers: from sweep to sweep, and from stage to stage."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..._custom_types import Scalar
from .bisection import Lines, PerDirection
from .brackets import Brackets
from .view import View


class Progress(NamedTuple):
    """What one stage gives to the next: where the search is, and the covariance `spread` of this point."""

    unknowns: Float[Array, "windows unknowns"]
    spread: Float[Array, "windows unknowns unknowns"]
    sweeps: Int[Array, ""]
    rollouts: Int[Array, ""]
    done: Bool[Array, ""]
    brackets: Float[Array, "record 2 parameters"] | None


class Search(NamedTuple):
    """One stage between two shots.

    - `view`: from where this sweep began.
    - `brackets`, `lines`: of all directions.
    - `turn`, `shots`: the number of this turn, in which some directions are bisected, and of its shots so far.
    - `steps`, `errors`, `at_end`: along the directions of earlier turns, the steps that were found, how far off their
      predictions were, and whether the bracket was too narrow.
    - `growth`: by how much the brackets of each direction are wider than the last relative error asks for.
    - `trust`: the share of the longest predicted step that a sweep may go.
    - `done`: the search ended by itself. `ended`: it ended, for whatever reason.
    """

    view: View
    brackets: Brackets
    lines: Lines
    turn: Int[Array, ""]
    shots: Int[Array, ""]
    steps: PerDirection
    errors: PerDirection
    at_end: Bool[Array, "windows n"]
    growth: PerDirection
    sweeps: Int[Array, ""]
    rollouts: Int[Array, ""]
    trust: Scalar
    done: Bool[Array, ""]
    ended: Bool[Array, ""]
    record: Float[Array, "record 2 parameters"] | None


def record_brackets(
    record: Float[Array, "record 2 parameters"] | None,
    sweep: Int[Array, ""],
    view: View,
    half_width: Float[Array, "windows unknowns"],
    *,
    skip: Bool[Array, ""],
) -> Float[Array, "record 2 parameters"] | None:
    """The record with the bracket of each parameter in one more sweep; sweeps beyond its length are dropped."""
    if record is None:
        return None
    count = record.shape[-1]
    widest = jnp.abs(view.basis * half_width[:, None, :]).max(axis=(0, 2))[:count]
    around = view.unknowns[0, :count] + jnp.stack([-widest, widest])
    return record.at[jnp.where(skip, record.shape[0], sweep)].set(around, mode="drop")
