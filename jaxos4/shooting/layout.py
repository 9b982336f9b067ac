"""The layout of a flight's samples: windows to simulate, segments to filter, and padding to share a program."""

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Count, Numeric
from ..flight import SIGNALS, Flight, Signal
from ..models.state import CASCADE_ORDER, CHANNELS, Forcing
from .filters import BLOCK

if TYPE_CHECKING:
    from .innovations import InnovationsProblem
    from .problem import ShootingProblem

Series = TypeVar("Series", Forcing, tuple[Array, ...])
# s; after a gap of this length, a filter restarts.
_GAP = 0.1
# A flight is padded to the smallest of these numbers of samples that suffices. A longer flight is not padded: compiling
# its program takes less time than simulating it.
_CAPACITIES = (4096, 16384, 65536)


def windowed(series: Series, index: Int[Numeric, "windows length"]) -> Series:
    """The series of each window, from the series of the flight. Windows of equal length need no copy."""

    def rows(leaf: Float[Array, "samples ..."]) -> Float[Array, "windows length ..."]:
        return leaf.reshape(index.shape) if index.size == leaf.shape[0] else leaf[index]

    return jax.tree.map(rows, series)


def each_window(function: Callable, *arguments: Any) -> Any:
    """`function` for each window. A single window needs no `vmap`, which takes long to trace."""
    if jax.tree.leaves(arguments[0])[0].shape[0] > 1:
        return jax.vmap(function)(*arguments)
    only = jax.tree.map(lambda leaf: leaf[0], arguments)
    return jax.tree.map(lambda leaf: leaf[None], function(*only))


class Segments(NamedTuple):
    """The division of recordings into segments.

    A segment begins with the last samples of the segment before it, in which its filter settles. The first segment
    begins with its recording. Segments are equally long, except for the last one of each recording.

    - `place`: the samples of each segment, in a multiple of `BLOCK` rows. Indices beyond the flight are padding.
    - `owned`: whether a sample belongs to a segment. Each sample belongs to one segment. It may also settle
      the filter of the next.
    - `rows`: the number of rows that are used; the others are padding.
    - `recording`: the number of the recording of each segment.
    """

    place: Int[Numeric, "segments time"]
    owned: Bool[Numeric, "segments time"]
    rows: Count | int
    recording: Int[Numeric, " segments"]

    @classmethod
    def of(cls, number: int, capacity: int, edges: Int[Numeric, " edges"], settling: int) -> "Segments":
        """At most `number` segments. Several recordings need more segments than there are recordings.

        `capacity`: the number of samples with padding. `edges`: the first sample of each recording, and the end of the
        last.
        """
        numpy = jnp if isinstance(edges, jax.Array) else np  # known numbers need no compiled program
        recordings, settling = edges.shape[0] - 1, settling if number > 1 else 0
        # A recording whose length is no multiple of a segment's has one segment more.
        whole = number - (recordings if recordings > 1 else 0)
        begin, end, own = edges[:-1], edges[1:], numpy.maximum(numpy.diff(edges) - settling, 0)
        length, most = numpy.maximum(-(-own.sum() // whole), 1), -(-(capacity - settling) // whole)
        last = numpy.cumsum(numpy.maximum(-(-own // length), 1))
        recording = numpy.minimum(numpy.searchsorted(last, np.arange(number), side="right"), recordings - 1)
        first = numpy.concatenate([last[:1] * 0, last[:-1]])
        segment = (np.arange(number) - first[recording])[:, None]
        row = np.arange(-(-(settling + most) // BLOCK) * BLOCK)
        place = begin[recording][:, None] + length * segment + row
        owned = (row < settling + length) & ((row >= settling) | (segment == 0)) & (place < end[recording][:, None])
        rows = settling + length
        return cls(place, owned, rows if isinstance(rows, jax.Array) else int(rows), recording)


def observe_in_segments(problem: "InnovationsProblem") -> dict[str, Any]:
    """The fields `place`, `measured`, `restart`, `counts` and `known` of `Segmented`.

    A filter restarts in a gap, and where a stretch begins. Its innovations do not count until it has settled. Only a
    flight without stretches counts from its first sample, because a simulation begins at rest.
    """
    flight, segments, known = problem.flight, problem.segmentation, None
    index, samples = jnp.asarray(segments.place), flight.time.shape[0]
    exists, place = ((index >= 0) & (index < samples)).T, jnp.minimum(index, samples - 1)
    measured, initial_state = problem.problem.measured(), problem.problem.initial_state
    restart, settled = _restarts(jnp.isnan(measured[:, :3]).all(axis=1), flight, problem.settling)

    def in_segments(series: Array) -> Array:
        return jnp.moveaxis(series[place], 0, -1)  # segments last

    begins = np.broadcast_to(np.arange(index.shape[1])[:, None] == 0, exists.shape)
    if initial_state is not None:
        is_first = np.arange(index.shape[0]) == 0
        begins = begins & ~is_first
        rates = initial_state[CASCADE_ORDER[: CHANNELS["rates"]]]
        known = jnp.where(is_first, rates[:, None], 0.0)
    restart = in_segments(restart) | begins | ~exists
    measured = jnp.where(exists[:, None], in_segments(measured), jnp.nan)
    counts = in_segments(settled) & segments.owned.T
    return {"place": place.T, "measured": measured, "restart": restart, "counts": counts, "known": known}


def _restarts(
    missing: Bool[Array, " samples"], flight: Flight, settling: int
) -> tuple[Bool[Array, " samples"], Bool[Array, " samples"]]:
    """Where a filter restarts, and where it has settled."""

    def follow(carry, row):
        gap, since = carry
        is_missing, another = row
        # In a long gap each sample restarts, so that no trajectory runs away there.
        restart = another | (gap * flight.dt >= _GAP)
        since = jnp.where(restart, 0, since + 1)
        return (jnp.where(is_missing, gap + 1, 0), since), (restart, since >= settling)

    another = jnp.concatenate([jnp.zeros(1, dtype=bool), jnp.diff(flight.stretch_numbers) != 0])
    first = jnp.zeros((), dtype=int), jnp.full((), settling if flight.stretch is None else -1, dtype=int)
    return jax.lax.scan(follow, first, (missing, another))[1]


def padded(problem: "ShootingProblem") -> "ShootingProblem":
    """The problem with a padded flight, unless it is cut into windows. A padded flight has no reverse-mode derivatives.

    Padding is not simulated, so it costs memory but no time. Results change by rounding errors only.
    """
    samples = problem.flight.time.shape[0]
    capacity = capacity_of(samples)
    if capacity == samples or problem.windows > 1 or problem.length is not None:
        return problem
    return with_capacity(problem, capacity)


def with_capacity(problem: "ShootingProblem", capacity: int) -> "ShootingProblem":
    """The problem in one window, with a flight that is padded to `capacity` samples."""
    length = jax.device_put(np.asarray(problem.flight.time.shape[0]))
    return dataclasses.replace(problem, flight=pad_flight(problem.flight, capacity), windows=1, length=length)


def capacity_of(samples: int) -> int:
    """The number of rows of a padded flight; `samples` if it is not padded."""
    return next((capacity for capacity in _CAPACITIES if capacity >= samples), samples)


def pad_flight(flight: Flight, capacity: int) -> Flight:
    """The flight with more rows, up to `capacity`, in which nothing was measured and the inputs stay as they were.

    `commanded` and `held` are reset: no model reads them, and static fields that differ would compile another program.
    """
    samples = flight.time.shape[0]

    def pad(name: str, signal: Signal) -> jax.Array | None:
        values = getattr(flight, name)
        if values is None:
            return None
        rows = np.asarray(values)
        last = rows[-1:] if signal.is_input else np.full_like(rows[-1:], np.nan)
        return jax.device_put(np.concatenate([rows, np.repeat(last, capacity - samples, axis=0)]))

    return dataclasses.replace(
        flight,
        time=np.asarray(flight.time)[0] + float(flight.dt) * np.arange(capacity),
        commanded=False,
        held=True,
        **{name: pad(name, signal) for name, signal in SIGNALS.items()},
    )
