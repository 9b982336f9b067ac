"""CMAC, the cerebellar model articulation controller: a table of weights, of which an input selects a few.

Reference: Albus (1975), A new approach to manipulator control, J. Dyn. Sys., Meas., Control 97(3), 220-227.
"""

import itertools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key

_EXTENT = 3.0  # cells cover inputs from minus this to this: twice what a flight without noise has


class CMAC(eqx.Module):
    """A sum over all pairs of inputs; each pair adds the mean of one weight from each of its tilings.

    A tiling divides the plane of two inputs into square cells, and each cell has a weight. The tilings of a pair are
    shifted against each other, so that inputs that are close share most of their weights. The output is piecewise
    constant in the inputs. The outermost cells also hold everything beyond them.

    Albus tiles all inputs together and hashes the cells. In nine dimensions two flights rarely share a cell, so that
    little is learnt; pairs can represent the products in which parameters act on a flight.
    """

    table: Float[Array, "pairs tilings cells cells out"]

    def __init__(self, in_size: int, out_size: int, tilings: int, cells: int, *, key: Key):
        del key  # weights begin at 0
        self.table = jnp.zeros((in_size * (in_size - 1) // 2, tilings, cells, cells, out_size))

    def __call__(self, x: Float[Array, " in"]) -> Float[Array, " out"]:
        """The output for inputs `x`."""
        pairs, tilings, cells = self.table.shape[:3]
        first, second = np.array(list(itertools.combinations(range(x.size), 2))).T
        place, number = (x / _EXTENT + 1) / 2 * (cells - 1), np.arange(tilings)

        def cell(inputs: Int[np.ndarray, " pairs"], shift: Int[np.ndarray, " tilings"]) -> Int[Array, "pairs tilings"]:
            shifted = place[inputs, None] + (shift % tilings / tilings).astype(x.dtype)
            return jnp.clip(jnp.floor(shifted), 0, cells - 1).astype(int)

        # The second input moves by another multiple, so that the shifts do not lie on the diagonal.
        own = np.arange(pairs)[:, None], number, cell(first, number), cell(second, 3 * number)
        return self.table[own].mean(axis=1).sum(axis=0)
