"""Finds which unknowns act on which output. All other derivatives are zero, so their products need not be summed."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import Literal
from jaxtyping import Array, Bool, Float

from ..models.state import CHANNELS

# Rows of the information that are summed together, without the columns to the right of their diagonal block.
_ROWS = 4


# The first row, the row after the last, and the outputs on which the unknowns of these rows act.
Panel = tuple[int, int, tuple[int, ...]]


def dependence(function: Callable, *arguments: Any) -> Bool[np.ndarray, "results arguments"]:
    """Which leaves of a function's result depend on which arguments. An inner function counts as one operation."""
    program = jax.make_jaxpr(function)(*arguments).jaxpr
    nothing = np.zeros(len(program.invars), dtype=bool)
    known = dict(zip(program.invars, np.eye(nothing.size, dtype=bool), strict=True))

    def sources(variables: list) -> np.ndarray:
        return np.any([nothing, *(known.get(v, nothing) for v in variables if not isinstance(v, Literal))], axis=0)

    for equation in program.eqns:
        known |= dict.fromkeys(equation.outvars, sources(equation.invars))
    return np.array([sources([v]) for v in program.outvars])


def panels_of(
    advance: Callable, at: tuple[Any, Any, tuple], forcing_parameters: tuple[int, ...], *, free: bool
) -> tuple[int, list[Panel]]:
    """The index after the last unknown that acts on rates or attitude, and the panels of all rows.

    - `advance`: returns the next state and the outputs, from the forcing, a state and the parameters, which are `at`.
    - `free`: whether the initial state is unknown too. Its leaves then follow the parameters.
    """
    leaves = dependence(advance, *at)
    forces, size, count = (len(jax.tree.leaves(part)) for part in at)
    unknowns = np.eye(count + size * free, dtype=bool)
    reached = unknowns[count:] if free else np.zeros((size, count), dtype=bool)
    driven = np.zeros((forces, len(unknowns)), dtype=bool)
    driven[:, list(forcing_parameters)] = True
    for _ in range(size):  # an effect reaches the last state after at most `size` samples
        reached = reached | (leaves @ np.concatenate([driven, reached, unknowns[:count]]))[:size]
    acting, panels = (leaves @ np.concatenate([driven, reached, unknowns[:count]]))[size:], []
    first_late = max(count, *(np.flatnonzero(reached[: CHANNELS["attitude"]].any(axis=0)) + 1).tolist())
    for row, outputs in enumerate(tuple(np.flatnonzero(column).tolist()) for column in acting.T):
        top, _, before = panels[-1] if panels else (row, row, ())
        joined = before == outputs and row - top < _ROWS and row != first_late
        panels = [*panels[:-1], (top, row + 1, outputs)] if joined else [*panels, (row, row + 1, outputs)]
    return first_late, panels


def symmetric(panels: tuple[Array, ...]) -> Float[Array, "unknowns unknowns *lanes"]:
    """The symmetric matrix from panels of its rows, which end with their diagonal blocks."""
    size, lanes = panels[-1].shape[1], panels[0].ndim - 2
    filled = [jnp.pad(panel, ((0, 0), (0, size - panel.shape[1]), *((0, 0),) * lanes)) for panel in panels]
    lower = jnp.concatenate(filled)
    below = np.tri(size, dtype=bool).reshape(size, size, *(1,) * lanes)
    return jnp.where(below, lower, jnp.swapaxes(lower, 0, 1))
