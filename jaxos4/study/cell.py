"""The results of a cell: a pure function of the specification, the cell's index, and its network.

A cell is one call of one program on one device. Last digits depend on the length of a batch and on the number of
devices that share a program; with whole cells they are the same in any order and in any process.
"""

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import States
from ..bracket import Bracket
from ..estimate import AbstractEstimator
from ..estimators import ESTIMATORS, IBSS, Hybrid, make_estimator
from ..estimators.hybrid import Seed, search_from_seed
from ..models.state import CHANNELS
from ..networks import TrainedNetwork
from ..results import result_names
from ..shooting import ShootingProblem
from .cell_file import LEVELS, OUTCOMES
from .devices import one_core
from .flights import Fleet, Flights, blank_problem, cramer_rao_std, fleet_of, fly
from .network_jobs import job_of
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
    """What tells the compiled programs of a cell from those of other cells, in the order of their use.

    IBSS and the hybrid share their search, and the hybrid asks its network by the network's own program.
    """
    scenario = cell.scenario._replace(noise="", scale=0.0, method="", channels=cell.scenario.seen)
    networks = [tuple(job_of(study, scenario))] if scenario.needs_network else []
    kind = ESTIMATORS[scenario.estimator]
    if issubclass(kind, TrainedNetwork):
        return networks
    return [*networks, scenario._replace(estimator="ibss") if issubclass(kind, Hybrid) else scenario]


def _answers(
    study: Study,
    cell: Cell,
    fleet: Fleet,
    blank: ShootingProblem,
    states: Float[Array, "lanes samples 12"],
    network: TrainedNetwork | None,
) -> dict[str, Any]:
    """What `_identify` finds in the measurements of a cell's flights."""
    estimator = _estimator(cell.scenario.estimator, network)
    if not isinstance(estimator, Hybrid | IBSS):
        return _identify(estimator, blank, fleet.bracket, states)
    # The hybrid is the search of IBSS from a network's seeds. IBSS alone has seeds that are no answers.
    channels = job_of(study, cell.scenario).channels
    if isinstance(estimator, Hybrid):
        looked_at = blank_problem(study, fleet, cell.scenario.scale or 1.0, channels)
        seeds = _identify(estimator.network, looked_at, fleet.bracket, states)["seeds"]
        ibss, not_kept = estimator.ibss, "brackets"
    else:
        seeds = _no_seeds(study.batch, len(fleet.model.parameter_names), CHANNELS[channels])
        ibss, not_kept = estimator, "seed"
    ibss = dataclasses.replace(ibss, record=_RECORDED_SWEEPS)
    return _identify(ibss, blank, fleet.bracket, states, seeds) | {not_kept: None}


def _no_seeds(lanes: int, parameters: int, starts: int) -> Seed:
    """A seed for each lane that is no answer."""
    kind = jnp.result_type(float)
    nowhere, unknown = np.zeros((lanes, parameters), kind), np.full((lanes, parameters, parameters), np.inf, kind)
    return Seed(nowhere, unknown, nowhere, np.zeros((lanes, starts), kind), np.zeros(lanes, jnp.result_type(int)))


@eqx.filter_jit
def _identify(
    estimator: AbstractEstimator,
    blank: ShootingProblem,
    bracket: Bracket,
    states: Float[Array, "lanes samples 12"],
    seeds: Seed | None = None,
) -> dict[str, Any]:
    """The attributes of each flight's `Estimate` that are kept, by name; of a network's answers, also the seeds.

    `seeds`: where IBSS looks first.
    """

    def one(states: States, seed: Seed | None) -> dict[str, Any]:
        problem = eqx.tree_at(lambda p: p.flight.states, blank, states)
        if isinstance(estimator, IBSS) and seed is not None:
            found = search_from_seed(estimator, problem, bracket, seed)
        else:
            found = estimator(problem, bracket)
        half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
        seeds = Seed.of(found) if isinstance(estimator, TrainedNetwork) else None
        return {name: getattr(found, name) for name in _KEPT} | {"half_width": half_width, "seeds": seeds}

    return jax.vmap(one)(states, seeds)


def _estimator(name: str, network: TrainedNetwork | None) -> AbstractEstimator:
    # A history of another length would be another program.
    without_history = None if network is None else eqx.tree_at(lambda n: n.history, network, jnp.zeros((0, 2)))
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
        results |= {"true": np.asarray(flights.exact[0]), "measured": np.asarray(flights.measured[0])}
        if found["brackets"] is not None:
            results["brackets"] = found["brackets"][0]
    return results
