"""A flight with its Fisher information, by a program whose reverse-mode derivatives are fast."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters, RotorSpeeds, Scalar, States
from ..flight import Inputs
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, Forcing, State, stack, unstack
from ..simulation import euler_step


class Sensed(NamedTuple):
    """The states of a flight from rest, and what its sensors would tell.

    - `slopes`: the derivatives of the weighted outputs in the parameters and, if it is free, the initial state.
    """

    states: States
    slopes: Float[Array, "samples sensors unknowns"]

    @property
    def information(self) -> Float[Array, "unknowns unknowns"]:
        """Of all samples about all unknowns."""
        return jnp.einsum("tsu,tsv->uv", self.slopes, self.slopes)


def sense(
    model: AbstractModel,
    omega: RotorSpeeds,
    parameters: Parameters,
    dt: Scalar,
    weights: Float[Array, " sensors"],
    start_is_known: bool,
) -> Sensed:
    """Fly from rest with derivatives, by forward Euler.

    `weights`: 1 / sigma of each channel, in cascade order. A known first sample tells nothing; a free initial state is
    that of the channels.
    """
    count, sensors = parameters.shape[0], weights.shape[0]
    unknowns = count + (0 if start_is_known else sensors)
    identity, scalars = np.eye(unknowns), tuple(parameters)
    starts = np.zeros((12, unknowns))
    starts[: unknowns - count, count:] = np.eye(unknowns - count)
    first, first_slopes = unstack(jnp.zeros(12, dtype=float)), jax.vmap(unstack)(jnp.asarray(starts.T))

    def step(carry: tuple[State, State], forcing: Forcing):
        state, slopes = carry
        following, push = jax.linearize(lambda x, a: euler_step(model, x, forcing, a, dt), state, scalars)
        carry = following, jax.vmap(push)(slopes, tuple(identity[:, :count].T))
        return carry, carry

    forcing = jax.tree.map(lambda leaf: leaf[:-1], model.forcing(Inputs(omega, dt), parameters))
    # Recomputing a step is faster than keeping its intermediate values for the reverse pass.
    states, slopes = jax.lax.scan(jax.checkpoint(step), (first, first_slopes), forcing)[1]
    whole = jnp.concatenate([stack(first)[None], stack(states)])[:, CASCADE_ORDER.argsort()]
    rows = jnp.concatenate([starts[None, :sensors], jnp.stack(jax.tree.leaves(slopes)[:sensors], axis=1)])
    return Sensed(whole, weights[:, None] * rows)
