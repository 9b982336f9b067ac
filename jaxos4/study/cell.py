"""The results of a cell: a pure function of the specification, the cell's index, and its network.

A cell is one call of each of its programs, on one device. Last digits depend on the length of a batch and on the number
of devices that share a program; with whole cells they are the same in any order and in any process.
"""

import contextlib
import dataclasses
import io
import math
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import States, as_float
from .._xla import quick_jit
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..estimators import ESTIMATORS, IBSS, Hybrid, make_estimator
from ..estimators.hybrid import Seed, search_near
from ..models.state import CHANNELS
from ..networks import TrainedNetwork
from ..results import NAMES, result_names
from ..shooting import ShootingProblem
from .flights import Fleet, Flights, blank_problem, cramer_rao_std, fleet_of, fly, key_of, problem_of
from .specification import Cell, Job, Scenario, Study

OUTCOMES = (*NAMES, "failed", "not_run")
"""Outcomes of an estimate. `failed`: its cell could not be computed; `not_run`: not yet. Files hold the index."""

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""The levels of the intervals that are kept."""

# Sweeps of IBSS that are kept, for a scenario's first flight.
_RECORDED_SWEEPS = 64
# Attributes of an estimate that are kept.
_KEPT = ("parameters", "std", "cost", "rollouts", "initial_state", "result", "seed", "brackets")
# An estimator with more flights computes for longer than its fully optimised program compiles.
_FEW_FLIGHTS = 2000


def run_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> dict[str, np.ndarray]:
    """Identifies the flights of a cell on the default device. `network`: that of `Study.job`.

    Raises as the estimator does.
    """
    with jax.enable_x64(study.double):
        scenario = cell.scenario
        with one_core():
            fleet = fleet_of(study, scenario)
            flights = fly(study, fleet, cell)
            blank = blank_problem(study, fleet, scenario.scale or 1.0, scenario.seen)
            standard = blank_problem(study, fleet, 1.0, scenario.seen)
            bound = scenario.scale * np.asarray(cramer_rao_std(standard, flights))
        found = _answers(study, cell, fleet, blank, flights.measured, network)
        return _results(study, cell, flights, bound, jax.tree.map(np.asarray, found))


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Computes on the first core of a CPU: a program that all estimators share is compiled once, not for each core."""
    first = jax.local_devices()[0]
    with jax.default_device(first) if first.platform == "cpu" else contextlib.nullcontext():
        yield


def programs_of(study: Study, scenario: Scenario) -> list[tuple]:
    """The keys of the programs that identify the flights of a scenario, in the order of use.

    IBSS and the hybrid share their search. The hybrid also runs its network's program.
    """
    kind, shapes = ESTIMATORS[scenario.estimator], (scenario.model, scenario.duration)
    if issubclass(kind, Hybrid):
        return [(TrainedNetwork, *shapes, study.seed_channels(scenario)), (IBSS, *shapes, scenario.seen)]
    return [(kind, *shapes, scenario.seen)]


def _answers(
    study: Study,
    cell: Cell,
    fleet: Fleet,
    blank: ShootingProblem,
    states: Float[Array, "lanes samples 12"],
    network: TrainedNetwork | None,
) -> dict[str, Any]:
    """The attributes in `_KEPT` of each flight's estimate, and its `half_width` at `LEVELS`, by name."""
    few = math.prod(study.shape[:-1]) * study.flights <= _FEW_FLIGHTS
    identify, search = _COMPILED_QUICKLY if few else _OPTIMISED
    if network is not None:  # a history of another length would be another program
        network = eqx.tree_at(lambda n: n.history, network, as_float(np.zeros((0, 2))))
    estimator, channels = make_estimator(cell.scenario.estimator, network), study.seed_channels(cell.scenario)
    if isinstance(estimator, Hybrid):
        with one_core():
            looked_at = blank_problem(study, fleet, cell.scenario.scale or 1.0, channels)
        _, seeds = identify(estimator.network, looked_at, fleet.bracket, states)
        return search(estimator.ibss, blank, fleet.bracket, states, seeds) | {"brackets": None}
    if isinstance(estimator, IBSS):
        # Without an answer near which to search, it searches the whole bracket.
        none = Seed.none(len(fleet.model.parameter_names), CHANNELS[channels])
        seeds = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (study.batch, *leaf.shape)), none)
        return search(estimator, blank, fleet.bracket, states, seeds) | {"seed": None}
    return identify(estimator, blank, fleet.bracket, states)[0]


def _identify(
    estimator: AbstractEstimator, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"]
) -> tuple[dict[str, Any], Seed]:
    """The results as in `_answers`, and for each answer the seed of a search."""

    def one(states: States) -> tuple[dict[str, Any], Seed]:
        found = estimator(problem_of(blank, states), bracket)
        return _kept(found), Seed.of(found)

    return jax.vmap(one)(states)


def _search(
    ibss: IBSS, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"], seeds: Seed
) -> dict[str, Any]:
    """The results as in `_answers`, of a search near the seeds. Its sweeps are recorded."""
    ibss = dataclasses.replace(ibss, record=_RECORDED_SWEEPS)

    def one(states: States, seed: Seed) -> dict[str, Any]:
        return _kept(search_near(ibss, problem_of(blank, states).within(bracket), seed))

    return jax.vmap(one)(states, seeds)


def _kept(found: Estimate) -> dict[str, Any]:
    half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
    return {name: getattr(found, name) for name in _KEPT} | {"half_width": half_width}


_COMPILED_QUICKLY = quick_jit(_identify), quick_jit(_search)
_OPTIMISED = eqx.filter_jit(_identify), eqx.filter_jit(_search)


def _results(
    study: Study, cell: Cell, flights: Flights, bound: np.ndarray, found: dict[str, Any]
) -> dict[str, np.ndarray]:
    """The arrays of a cell's file. A flight without an estimate has NaN, and a result that says why."""
    count = min(study.batch, study.flights - cell.first)
    truth, seed, hit = np.asarray(flights.truth), found["seed"], np.full(study.batch, -1)
    if seed is not None:
        hit = ((truth >= seed.lower) & (truth <= seed.upper)).all(axis=-1)
    finite = np.isfinite(found["std"]).all(axis=-1) & np.isfinite(found["parameters"]).all(axis=-1)

    def kept(name: str) -> np.ndarray:
        return np.where(finite.reshape(-1, *[1] * (found[name].ndim - 1)), found[name], np.nan)

    results = {
        "truth": truth,
        "estimate": kept("parameters"),
        "std": kept("std"),
        "half_width": kept("half_width"),
        "bound": bound,
        "initial_state": kept("initial_state"),
        "cost": kept("cost"),
        "rollouts": found["rollouts"].astype(np.int32),
        "result": np.array([OUTCOMES.index(name) for name in result_names(found["result"])], np.int8),
        "hit": hit.astype(np.int8),
    }
    results = {name: value[:count] for name, value in results.items()}
    if cell.first == 0:  # the example flight of the report
        results |= {"true": np.asarray(flights.exact)[0], "measured": np.asarray(flights.measured)[0]}
        if found["brackets"] is not None:
            results["brackets"] = found["brackets"][0]
    return results


def encode(results: dict[str, np.ndarray]) -> bytes:
    """The bytes of a cell's file; equal results give equal bytes."""
    buffer = io.BytesIO()
    np.savez(buffer, **results)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The results in the bytes of a cell's file. Raises an exception of `_files.BROKEN` for other bytes."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


def train_network(study: Study, job: Job) -> TrainedNetwork:
    """Trains a network for all noises and scales of a study. Raises as `NetworkEstimator.fit` does.

    The numbers are the same bit for bit only on the same number of cores, which share the products of matrices.
    """
    with jax.enable_x64(study.double):
        scales, fleet = [scale or 1.0 for scale in study.scales], fleet_of(study, job)
        settings = study.network.estimator(job.channels, (min(scales), max(scales)))
        problem = blank_problem(study, fleet, 1.0, job.channels)
        return settings.fit(problem, fleet.bracket, key=key_of(study.network.seed, study.jobs()[job]))
