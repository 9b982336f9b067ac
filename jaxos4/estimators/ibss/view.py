"""What the search sees from where a sweep begins."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...shooting import Curvature
from .stage import Stage


class View(NamedTuple):
    """A point, the flight's curvature there, and the directions: the columns of `basis`."""

    unknowns: Float[Array, "windows unknowns"]
    curvature: Curvature
    basis: Float[Array, "windows unknowns n"]

    def after(self, steps: Float[Array, "windows n"]) -> Float[Array, "windows unknowns"]:
        """The unknowns after these steps along the directions."""
        return self.unknowns + jnp.einsum("wud,wd->wu", self.basis, steps)

    def predicted(self, stage: Stage, steps: Float[Array, "windows n"]) -> Float[Array, "windows n"]:
        """After these steps, the step along each direction to the minimum of the cost's quadratic model."""
        information, moved = self.curvature.information + stage.prior, self.after(steps) - self.unknowns
        gradient = self.curvature.gradient + jnp.einsum("wuv,wv->wu", information, moved)
        return -stage.along(self.basis, gradient)
