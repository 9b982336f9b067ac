"""A flight cut into segments, in which Kalman filters run in parallel.

A filter that starts in the middle of a flight does not know the disturbance, and the controller does: the first samples
of a segment settle the filter.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

from ..flight import Flight
from ..models.state import CASCADE_ORDER, CHANNELS
from .filters import Observed
from .problem import ShootingProblem

# A gap of this length ends what a filter knows [s].
_GAP = 0.1


def segments_of(samples: int, wanted: int, settling: int) -> Int[np.ndarray, "segments time"]:
    """The samples of each segment, of which there are about `wanted` after those that settle its filter.

    A segment begins with the end of the segment before it, which its filter needs to settle. The first begins with the
    flight. Samples beyond the last do not exist.
    """
    segments = max(round((samples - settling) / wanted), 1)
    settling = settling if segments > 1 else 0
    length = -(-(samples - settling) // segments)
    return length * np.arange(segments)[:, None] + np.arange(settling + length)


def owned(index: Int[np.ndarray, "segments time"], samples: int, settling: int) -> Bool[np.ndarray, "segments time"]:
    """Whether a sample belongs to a segment. Each belongs to one; in other segments it settles the filter."""
    return ((np.arange(index.shape[1]) >= settling) | (index[:, :1] == 0)) & (index < samples)


def observe_in_segments(problem: ShootingProblem, index: Int[np.ndarray, "segments time"], settling: int) -> Observed:
    """The measurements in segments, where filters restart, and which innovations count.

    A filter restarts in a gap, and where another stretch begins. Until it has settled its innovations do not count:
    the controller knew the disturbance then, and the filter does not. At the beginning of a flight in one piece
    they count: a simulation begins at rest.
    """
    flight, samples, segments = problem.flight, problem.flight.time.shape[0], index.shape[0]
    exists, place = (index < samples).T, np.minimum(index, samples - 1)
    measured = problem.measured()
    restart, settled = _restarts(jnp.isnan(measured[:, :3]).all(axis=1), flight, settling)

    def in_segments(series: Array) -> Array:
        return jnp.moveaxis(series[place], 0, -1)  # segments last

    known = None
    begins = np.broadcast_to(np.arange(index.shape[1])[:, None] == 0, exists.shape)
    if problem.initial_state is not None:
        is_first = np.arange(segments) == 0
        begins = begins & ~is_first
        rates = problem.initial_state[CASCADE_ORDER[: CHANNELS["rates"]]]
        known = jnp.where(is_first, rates[:, None], 0.0)
    restarts = in_segments(restart) | begins | ~exists
    measured = jnp.where(exists[:, None], in_segments(measured), jnp.nan)
    return Observed(measured, restarts, in_segments(settled) & owned(index, samples, settling).T, known)


def _restarts(
    missing: Bool[Array, " samples"], flight: Flight, settling: int
) -> tuple[Bool[Array, " samples"], Bool[Array, " samples"]]:
    """Where a filter restarts, and where it has settled."""
    samples = missing.shape[0]
    stretch = jnp.zeros(samples, dtype=int) if flight.stretch is None else flight.stretch

    def follow(carry, row):
        gap, since = carry
        is_missing, another = row
        # In a long gap each sample restarts, so that no trajectory runs away there.
        restart = another | (gap * flight.dt >= _GAP)
        since = jnp.where(restart, 0, since + 1)
        return (jnp.where(is_missing, gap + 1, 0), since), (restart, since >= settling)

    another = jnp.concatenate([jnp.zeros(1, dtype=bool), jnp.diff(stretch) != 0])
    first = jnp.zeros((), dtype=int), jnp.full((), settling if flight.stretch is None else -1, dtype=int)
    return jax.lax.scan(follow, first, (missing, another))[1]
