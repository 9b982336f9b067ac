"""A design: the search for the most informative inputs within an envelope, a comparison with standard inputs, files.

The search minimises criterion + penalty by BFGS. The penalty grows from stage to stage, so that the limits hold better
and better. They hold exactly only after the task has flown the inputs and has reduced their amplitude.

Reference: Nocedal and Wright, Numerical Optimization, ch. 6 (BFGS) and 17 (penalty).
"""

import abc
import math
from collections.abc import Callable, Mapping
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, Scalar, as_float
from .._files import write_atomically
from .._xla import quick_jit
from ..errors import InputError, check_choice
from ..flight import SPEED_NAMES, STATE_NAMES, Flight
from ..linalg import gram, joint_factor
from ..logs import write_flight
from ..logs.csv import read_table
from ..logs.table import LogPath, refuse
from .envelope import Envelope, Uses

Coefficients = Float[Array, " coefficients"]
Series = Float[np.ndarray, "samples 4"]
"""Rotor speeds [rad/s], each for one sample (a zero-order hold); or references as `fly_closed_loop` takes them."""
# Inputs, and the largest share of each limit that a vehicle uses.
Flown = tuple[Series, dict[str, float]]
Progress = Callable[[str], None]

CRITERIA = ("A", "D", "worst")
# The weight of the penalty in each stage of a search. The last ones let other vehicles keep the limits too.
_PENALTIES = (10.0, 50.0, 250.0, 1250.0, 6000.0, 6000.0, 6000.0, 6000.0)
# The number of stages after which only the best search continues.
_COMPARED = 2
# The usual size of a coefficient: the moves of the first stage.
_UNIT = 0.1
# A stage ends if a step changes neither the cost nor a coefficient by this share.
_TOLERANCE = 1e-6
_REFERENCE_NAMES = ("roll_reference", "pitch_reference", "yaw_reference", "az_reference")
# The largest error of a sample time in a file, as a share of it.
_PRECISION = 1e-3


class Designed(NamedTuple):
    """Inputs of a flight, and the accuracy of an estimate from it.

    - `inputs`: rotor speeds or references. `dt`: their sample time [s].
    - `bounds`: the smallest standard deviation that each parameter can have after the flight.
    - `uses`: the largest share of each limit that any vehicle of the bracket uses; empty if none was flown.
    - `period`: the time after which the inputs repeat [s]; the whole flight if they do not.
    - `history`: the bounds after each sample, very large until a parameter is excited. `None`: the bounds fall with the
      square root of the duration.
    """

    inputs: Series
    dt: float
    bounds: Float[np.ndarray, " parameters"]
    uses: dict[str, float]
    period: float
    history: Float[np.ndarray, "samples parameters"] | None = None

    @property
    def duration(self) -> float:
        """The length of the flight [s]."""
        return self.dt * (self.inputs.shape[0] - 1)

    def shortest(self, wanted: Float[Numeric, " targets"]) -> Float[np.ndarray, " targets"]:
        """The shortest flights [s] after which the first parameters can have the standard deviations `wanted`.

        Longer flights repeat the inputs: bounds fall with the root of the duration, about so if a period is cut.
        """
        wanted = np.asarray(wanted)
        repeated = self.duration * np.square(self.bounds[: wanted.size] / wanted)
        if self.history is None:
            return repeated
        enough = self.history[:, : wanted.size] <= wanted
        return np.where(enough.any(axis=0), self.dt * np.argmax(enough, axis=0), repeated)


class AbstractTask(eqx.Module):
    """A kind of input: how coefficients become a flight, its limits, its information, and its file.

    - `kind`: the name of the inputs. `vehicles`: the number of vehicles that stay within the envelope.
    - `starts`: the number of searches; after `_COMPARED` stages, the best continues alone. `first`: the length of their
      first coefficients, which are random. `steps`: the most BFGS steps of a stage.
    - `names`, `units`: of each parameter, the targets first.
    - `scale`: for each target, a size of which accuracies are shares. `unexcited`: a parameter whose bound is not below
      this counts as not excited.
    - `criterion`: how the accuracies of all targets are combined, see `design_input`.
    """

    kind: ClassVar[str]
    vehicles: ClassVar[int]
    starts: ClassVar[int]
    first: ClassVar[float]
    steps: ClassVar[int]
    envelope: eqx.AbstractVar[Envelope]
    names: eqx.AbstractVar[tuple[str, ...]]
    units: eqx.AbstractVar[tuple[str, ...]]
    scale: eqx.AbstractVar[Float[Numeric, " targets"]]
    unexcited: eqx.AbstractVar[Float[Numeric, " parameters"]]
    criterion: eqx.AbstractVar[str]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """The number of coefficients."""

    @abc.abstractmethod
    def objective(self, coefficients: Coefficients) -> Scalar:
        """The criterion of the information that the flight gives: smaller is better."""

    @abc.abstractmethod
    def uses(self, coefficients: Coefficients) -> Uses:
        """The shares of the limits at each sample, which should be at most 1; samples are the last axis but one."""

    def watching(self, coefficients: Coefficients) -> "AbstractTask":
        """The task of the next stage, which may watch the limits of other vehicles. By default the same."""
        del coefficients
        return self

    @abc.abstractmethod
    def flown(self, coefficients: Float[np.ndarray, " coefficients"]) -> Flown:
        """The inputs, with an amplitude at which all vehicles keep the limits."""

    @abc.abstractmethod
    def standard(self) -> dict[str, Flown]:
        """The standard inputs that fit into the time, by name."""

    @staticmethod
    @abc.abstractmethod
    def write(designed: Designed, path: LogPath) -> None:
        """Write the inputs as CSV."""

    @abc.abstractmethod
    def judged(self, flown: Mapping[str, Flown]) -> dict[str, Designed]:
        """The bounds of several inputs."""


class Design(NamedTuple):
    """Designed inputs, and the standard inputs of the same length.

    - `task`: its `envelope` has the limits, its `names` and `units` are those of the parameters.
    - `standard`: by name; empty if they were not to be compared. One that does not fit into the time is missing.
    """

    task: AbstractTask
    designed: Designed
    standard: dict[str, Designed]

    def gain(self, name: str) -> tuple[float, int]:
        """The geometric mean of designed over standard bounds of the targets that are excited, or NaN; their number."""
        count = self.task.scale.size
        own, other = (one.bounds[:count] for one in (self.designed, self.standard[name]))
        excited = other < self.task.unexcited[:count]
        mean = float(np.exp(np.log(own / other)[excited].mean())) if excited.any() else math.nan
        return mean, int(excited.sum())


def design(task: AbstractTask, *, compare: bool, key: Key, progress: Progress) -> Design:
    """Search inputs, fit them into the envelope, and judge them, beside the standard inputs if `compare`.

    **Raises:** `InputError` if the criterion is not finite: there is nothing to search for.
    """
    progress("compiling the search")
    searches = _started(jax.random.fold_in(key, 2), task)
    for stage, penalty in enumerate(_PENALTIES, start=1):
        watching = (search._replace(task=search.task.watching(search.coefficients)) for search in searches)
        searches = [_minimise(search, as_float(penalty)) for search in watching]
        best = min(searches, key=lambda search: search.cost)
        if not np.isfinite(best.cost):
            remedy = "narrow the bracket, or give stronger gusts for a vehicle under a controller"
            raise InputError(f"the accuracy after these {task.kind} is not a finite number; {remedy}.")
        if stage == _COMPARED:
            searches = [best]
        progress(f"search, stage {stage} of {len(_PENALTIES)}")
    progress(f"flying {task.vehicles} vehicles")
    (found,) = searches
    flown = {"designed": task.flown(np.asarray(found.coefficients))}
    progress("bounds")
    judged = task.judged(flown | (task.standard() if compare else {}))
    return Design(task, judged.pop("designed"), judged)


class _Search(NamedTuple):
    """The state of a search.

    - `task`: with the vehicles whose limits the search watches.
    - `basis`: moves along which the cost is about equally curved, as BFGS found.
    - `cost`: the criterion, and the penalty of the vehicles that this search watches.
    """

    task: AbstractTask
    coefficients: Coefficients
    basis: Float[Array, "coefficients coefficients"]
    cost: Scalar


@quick_jit
def _started(key: Key, task: AbstractTask) -> list[_Search]:
    starts = task.first / math.sqrt(task.size) * jax.random.normal(key, (task.starts, task.size), dtype=float)
    return [_Search(task, start, _UNIT * jnp.eye(task.size), jnp.zeros(())) for start in starts]


@quick_jit
def _minimise(search: _Search, penalty: Scalar) -> _Search:
    """One stage of a search. BFGS begins with a unit matrix, so its unknowns are moves along the basis found before."""
    task = search.task

    def moved(moves: Coefficients) -> Coefficients:
        return search.coefficients + search.basis @ moves

    def cost(moves: Coefficients, _: None) -> Scalar:
        uses = jax.tree.leaves(task.uses(moved(moves)))
        excess = sum(jnp.square(jnp.maximum(jnp.square(use) - 1, 0)).sum() / use.shape[-2] for use in uses)
        return task.objective(moved(moves)) + penalty / 2 * excess

    solver, still = optimistix.BFGS(_TOLERANCE, _TOLERANCE), jnp.zeros(task.size)
    found = optimistix.minimise(cost, solver, still, max_steps=task.steps, throw=False)
    end = found.state.f_info
    basis = search.basis @ jnp.linalg.cholesky(end.hessian_inv.as_matrix())
    return _Search(task, moved(found.value), basis, jnp.where(jnp.isnan(end.f), jnp.inf, end.f))


def criterion_of(
    information: Float[Array, "unknowns unknowns"], half_width: Float[Array, " count"], criterion: str
) -> Scalar:
    """The logarithm of a mean bound of the first unknowns, see `design_input`. Smaller is better.

    A bound is a standard deviation as a share of the `half_width` of its parameter's bracket. The volume of `"D"` is
    given as the edge of a cube. In `"worst"`, the largest bound is replaced by the 16-norm of the bounds, which has
    derivatives.
    """
    count = half_width.shape[0]
    factor, basis = joint_factor(information[None], count)
    if criterion == "D":
        volume = -jnp.log(jnp.diagonal(factor[0, :count, -count:])).sum()
        return (volume - jnp.log(half_width).sum()) / count
    squares = jnp.diagonal(gram(basis[0, :count, -count:])) / jnp.square(half_width)
    if criterion == "A":
        return jnp.log(squares.mean()) / 2
    largest, norm = squares.max(), 16
    return jnp.log(largest) / 2 + jnp.log(((squares / largest) ** (norm / 2)).sum()) / norm


def check_settings(
    duration: float, dt: float, bandwidth: float, criterion: str, samples: tuple[int, int], cycles: int, fastest: float
) -> None:
    """Raise `InputError` for settings that cannot be designed for.

    `samples`: the fewest and the most. `cycles`: the fewest of the fastest tone. `fastest`: its frequency times `dt`.
    """
    if not (dt > 0 and samples[0] <= duration / dt <= samples[1]):
        allowed = f"{samples[0]} to {samples[1]} samples of a positive `dt`"
        raise InputError(f"`duration` must be {allowed}, got {duration:g} s and {dt:g} s.")
    check_choice("criterion", criterion, CRITERIA)
    low, high = cycles / duration, fastest / dt
    if not low <= bandwidth <= high:
        limits = f"{cycles} / `duration` and {fastest:g} / `dt`, {low:.3g} to {high:.3g} Hz"
        raise InputError(f"`bandwidth` must lie between {limits}, got {bandwidth:g} Hz.")


def write_input(designed: Designed, path: LogPath) -> None:
    """Write rotor speeds as a flight CSV with the columns t and omega1..4."""
    samples = designed.inputs.shape[0]
    nothing = np.full((samples, len(STATE_NAMES)), np.nan)
    write_flight(Flight(designed.dt * np.arange(samples), designed.inputs, nothing), path)


def write_references(designed: Designed, path: LogPath) -> None:
    """Write references as CSV, with the columns t, roll_reference, pitch_reference, yaw_reference and az_reference."""
    rows = np.column_stack([designed.dt * np.arange(len(designed.inputs)), designed.inputs])
    with write_atomically(path) as beside:
        np.savetxt(beside, rows, delimiter=",", header=",".join(("t", *_REFERENCE_NAMES)), comments="", fmt="%.8g")


def read_input(path: LogPath, dt: float) -> Series:
    """Read rotor speeds [rad/s] with the sample time `dt` [s]. Raises `InputError` as `read_references` does."""
    omega, step = read_references(path, SPEED_NAMES)
    if (omega < 0).any() or abs(step - dt) > _PRECISION * dt:
        refuse(path, f"has a negative cell, or is not sampled every {dt:g} s; design it for this `dt`")
    return omega


def read_references(path: LogPath, names: tuple[str, ...] = _REFERENCE_NAMES) -> tuple[Series, float]:
    """Read the columns `names`, by default references, and their sample time [s]. Raises `InputError`, one line."""
    columns = read_table(path, ("t", *names)).columns
    for column in ("t", *names):
        if column not in columns:
            refuse(path, f"is missing; its columns must be t, {', '.join(names)}", column=column)
        if not np.isfinite(columns[column]).all():
            refuse(path, "a cell is empty; give every sample a number", column=column)
    steps = np.diff(columns["t"])
    if not steps.size or not np.all(np.abs(steps - steps.mean()) < _PRECISION * steps.mean()):
        refuse(path, "is not sampled at equal times; give one row for each sample")
    return np.stack([columns[column] for column in names], axis=1), float(steps.mean())
