"""The results of a cell: a pure function of the specification, the cell's index, and its network.

A cell is one call of each of its programs, on one device. Last digits depend on the length of a batch and on the number
of devices that share a program; with whole cells they are the same in any order and in any process.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import States, as_float
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..estimators import ESTIMATORS, IBSS, Hybrid, make_estimator
from ..estimators.hybrid import Seed, search_near
from ..models.state import CHANNELS
from ..networks import TrainedNetwork
from ..results import result_names
from ..shooting import ShootingProblem
from .cell_file import LEVELS, OUTCOMES
from .devices import one_core
from .flights import Fleet, Flights, blank_problem, cramer_rao_std, fleet_of, fly, problem_of
from .network_jobs import hybrid_channels, job_of
from .specification import Cell, Study

# Sweeps of a search that are kept, for a scenario's first flight.
_RECORDED_SWEEPS = 64
# Attributes of an estimate that are kept.
_KEPT = ("parameters", "std", "cost", "rollouts", "initial_state", "result", "seed", "brackets")


def run_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> dict[str, np.ndarray]:
    """Identifies the flights of a cell on the default device. `network`: that of `job_of`, if the estimator needs one.

    Raises as the estimator does.
    """
    with jax.enable_x64(study.double):
        scenario, (fleet, flights, blank) = cell.scenario, _flown(study, cell)
        with one_core():
            standard = blank_problem(study, fleet, 1.0, scenario.seen)
            bound = scenario.scale * np.asarray(cramer_rao_std(standard, flights))
        found = _answers(study, cell, fleet, blank, flights.measured, network)
        return _results(study, cell, flights, bound, jax.tree.map(np.asarray, found))


def compile_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> None:
    """Compiles the programs of `run_cell`, on flights without measurements: each search ends after its first look.

    The values of the network do not matter. Raises as the estimator does.
    """
    with jax.enable_x64(study.double):
        fleet, flights, blank = _flown(study, cell)
        with one_core():
            nothing = jax.device_put(np.full_like(flights.measured, np.nan))
        jax.block_until_ready(_answers(study, cell, fleet, blank, nothing, network))


def _flown(study: Study, cell: Cell) -> tuple[Fleet, Flights, ShootingProblem]:
    """The flights of a cell, and the problem that an estimator solves for each."""
    scenario = cell.scenario
    with one_core():
        fleet = fleet_of(study, scenario)
        blank = blank_problem(study, fleet, scenario.scale or 1.0, scenario.seen)
        return fleet, fly(study, fleet, cell), blank


def programs_of(study: Study, cell: Cell) -> list[tuple]:
    """The keys of the programs that a cell runs, in the order of use. Cells with an equal key share the program.

    IBSS and the hybrid share their search. The hybrid also runs its network's program.
    """
    scenario = cell.scenario
    kind, shapes = ESTIMATORS[scenario.estimator], (scenario.model, scenario.duration)
    if issubclass(kind, Hybrid):
        return [(TrainedNetwork, *shapes, job_of(study, scenario).channels), (IBSS, *shapes, scenario.seen)]
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
    estimator, bracket = _estimator(cell.scenario.estimator, network), fleet.bracket
    if not isinstance(estimator, Hybrid | IBSS):
        return _identify(estimator, blank, bracket, states)[0]
    channels = hybrid_channels(study, cell.scenario)
    if isinstance(estimator, IBSS):
        # Without an answer near which to search, it searches the whole bracket.
        none = Seed.none(len(fleet.model.parameter_names), CHANNELS[channels])
        seeds = jax.tree.map(lambda leaf: np.broadcast_to(leaf, (study.batch, *leaf.shape)), none)
        return _search(estimator, blank, bracket, states, seeds) | {"seed": None}
    with one_core():
        looked_at = blank_problem(study, fleet, cell.scenario.scale or 1.0, channels)
    _, seeds = _identify(estimator.network, looked_at, bracket, states)
    return _search(estimator.ibss, blank, bracket, states, seeds) | {"brackets": None}


@eqx.filter_jit
def _identify(
    estimator: AbstractEstimator, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"]
) -> tuple[dict[str, Any], Seed]:
    """What `_answers` returns, and the seed that each answer is for a search."""

    def one(states: States) -> tuple[dict[str, Any], Seed]:
        found = estimator(problem_of(blank, states), bracket)
        return _kept(found), Seed.of(found)

    return jax.vmap(one)(states)


@eqx.filter_jit
def _search(
    ibss: IBSS, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"], seeds: Seed
) -> dict[str, Any]:
    """What `_answers` returns, from a search near the seeds. Its sweeps are recorded."""
    ibss = dataclasses.replace(ibss, record=_RECORDED_SWEEPS)

    def one(states: States, seed: Seed) -> dict[str, Any]:
        return _kept(search_near(ibss, problem_of(blank, states), bracket, seed))

    return jax.vmap(one)(states, seeds)


def _kept(found: Estimate) -> dict[str, Any]:
    half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
    return {name: getattr(found, name) for name in _KEPT} | {"half_width": half_width}


def _estimator(name: str, network: TrainedNetwork | None) -> AbstractEstimator:
    # A history of another length would be another program.
    without_history = None if network is None else eqx.tree_at(lambda n: n.history, network, as_float(np.zeros((0, 2))))
    return make_estimator(name, without_history)


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
