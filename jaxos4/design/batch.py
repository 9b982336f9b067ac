"""Batches of flights in closed loop. All have one size, and share one compiled program."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Key, Scalar, as_float
from ..closed_loop import ClosedLoop, References, fly_closed_loop
from ..flight import Flight
from ..models.rotation import to_earth
from ..models.state import Attitude
from .envelope import ANGLES, POSITION, VELOCITY

LANES = 64
"""The number of flights in a batch."""

# Physics steps in a sample: twice as many as `fly_closed_loop` takes by default.
_SUBSTEPS = 8


def batch_of(loop: ClosedLoop, **values: Float[ArrayLike, "lanes ..."]) -> ClosedLoop:
    """`LANES` copies of a loop, with some settings replaced: one value for each copy.

    `inertia` is that of the airframe. The controller knows the inertia of `loop`.
    """
    known = loop.airframe.inertia if loop.controller_inertia is None else loop.controller_inertia
    loop = eqx.tree_at(lambda x: x.controller_inertia, loop, as_float(known), is_leaf=lambda x: x is None)
    copies = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (LANES, *np.shape(leaf))), loop)
    for name, value in values.items():
        part = (lambda x: x.airframe.inertia) if name == "inertia" else (lambda x, name=name: getattr(x, name))
        copies = eqx.tree_at(part, copies, np.asarray(value, dtype=float))
    return copies


@eqx.filter_jit
def fly_batch(loops: ClosedLoop, references: Float[Array, "lanes samples 4"], dt: Scalar, key: Key) -> Flight:
    """Fly a batch. Velocity and position are integrals of measured attitude and specific force."""

    def one(loop: ClosedLoop, references: References, key: Key) -> Flight:
        flight = fly_closed_loop(loop, references, dt=dt, key=key, substeps=_SUBSTEPS)
        vertical = flight.channels[:, -1]
        nothing = jnp.zeros_like(vertical)
        force = jnp.stack(to_earth(Attitude(*flight.states[:, ANGLES].T), (nothing, nothing, vertical)), axis=1)
        velocity = dt * jnp.cumsum(force.at[:, 2].add(-loop.airframe.gravity), axis=0)
        states = flight.states.at[:, POSITION].set(dt * jnp.cumsum(velocity, axis=0)).at[:, VELOCITY].set(velocity)
        return eqx.tree_at(lambda f: f.states, flight, states)

    return eqx.filter_vmap(one)(loops, references, jax.random.split(key, LANES))
