"""The plan of a search in stages: the body rates of a short part of the flight first, then more.

Rates do not depend on attitude and position, so they are fitted first. Errors grow with time, so the cost of a long
flight has other minima: the first stages are short.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Count
from ..models.state import CHANNELS

# Rounding errors add up over a flight, to about this many times the rounding of one measurement.
ROUNDING = 64.0


class Plan(NamedTuple):
    """The comparisons of each stage.

    - `channels`: of the stages, each once. `place`: of each stage's channels among them.
    - `sizes`: the number of states that each stage simulates.
    - `lengths`: the number of samples that each stage fits; `None` if all stages fit all of them.
    - `measurements`: how many were measured in them.
    - `smallest_step`: in standard deviations; below it, rounding decides the sign of a slope.
    """

    channels: tuple[str, ...]
    place: Int[np.ndarray, " stages"]
    sizes: Int[np.ndarray, " stages"]
    lengths: Int[Array, " stages"] | None
    measurements: Float[Array, " stages"]
    smallest_step: Float[Array, " stages"]

    @classmethod
    def of(
        cls,
        channels: str,
        shares: tuple[float, ...],
        measured: Float[Array, "samples columns"],
        sigma: Float[Array, " columns"],
        samples: Count | int,
        windows: int,
    ) -> "Plan":
        """The plan of a flight, whose last stage is the whole.

        - `channels`: that are compared. `shares`: of the flight, to which the body rates are fitted first.
        - `measured`: states in cascade order, then specific force, which all stages compare. `sigma`: of their noise.
        - `samples`: how many count. `windows`: of the flight; one of several is short enough as a whole.
        """
        wanted = (share for share in shares if share == 1 or windows == 1)
        rates = tuple(("rates", share) for share in wanted if (channels, share) != ("rates", 1))
        stages = (*rates, (channels, 1.0))
        names, size = tuple(dict.fromkeys(name for name, _ in stages)), CHANNELS[channels]
        sizes, columns = np.array([CHANNELS[name] for name, _ in stages]), np.arange(measured.shape[1])
        fitted = (columns < sizes[:, None]) | (columns >= size)
        lengths = jnp.ceil(np.array([share for _, share in stages]) * samples).astype(int)
        within = (jnp.arange(measured.shape[0]) < lengths[:, None]).astype(float)
        known, eps = within @ (~jnp.isnan(measured)).astype(float), jnp.finfo(sigma.dtype).eps
        squares = (within @ jnp.square(jnp.nan_to_num(measured))) / jnp.maximum(known, 1)
        largest = jnp.where(fitted, jnp.sqrt(squares) / sigma, 0.0).max(axis=1)
        return cls(
            channels=names,
            place=np.array([names.index(name) for name, _ in stages]),
            sizes=sizes,
            lengths=None if all(share == 1 for _, share in stages) else lengths,
            measurements=jnp.where(fitted, known, 0.0).sum(axis=1),
            smallest_step=jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * largest),
        )
