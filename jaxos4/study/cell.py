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
from ..estimate import AbstractEstimator, Estimate
from ..estimators import make_estimator
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
        found = _identify(_estimator(scenario.estimator, network), blank, fleet.bracket, flights.measured)
        return _results(study, cell, flights, bound, jax.tree.map(np.asarray, found))


def compile_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> None:
    """Compiles the program of `run_cell`, on flights without measurements: each search ends after its first look.

    The values of the network do not matter. Raises as the estimator does.
    """
    with jax.enable_x64(study.double):
        fleet, flights, blank = _flown(study, cell)
        with one_core():
            nothing = jax.device_put(np.full_like(flights.measured, np.nan))
        found = _identify(_estimator(cell.scenario.estimator, network), blank, fleet.bracket, nothing)
        jax.block_until_ready(found)


def _flown(study: Study, cell: Cell) -> tuple[Fleet, Flights, ShootingProblem]:
    """The flights of a cell, and the problem that an estimator solves for each."""
    scenario = cell.scenario
    with one_core():
        fleet = fleet_of(study, scenario)
        blank = blank_problem(study, fleet, scenario.scale or 1.0, scenario.seen)
        return fleet, fly(study, fleet, cell), blank


def program_of(study: Study, cell: Cell) -> tuple:
    """Two cells are run by the same compiled program if this is equal for both."""
    scenario = cell.scenario._replace(noise="", scale=0.0, method="")
    return scenario, job_of(study, scenario) if scenario.needs_network else None


@eqx.filter_jit
def _identify(
    estimator: AbstractEstimator, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"]
) -> dict[str, Any]:
    """The attributes of each flight's `Estimate` that are kept, by name."""

    def one(states: States) -> dict[str, Any]:
        found: Estimate = estimator(eqx.tree_at(lambda p: p.flight.states, blank, states), bracket)
        half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
        return {name: getattr(found, name) for name in _KEPT} | {"half_width": half_width}

    return jax.vmap(one)(states)


def _estimator(name: str, network: TrainedNetwork | None) -> AbstractEstimator:
    # A history of another length would be another program.
    without_history = None if network is None else eqx.tree_at(lambda n: n.history, network, jnp.zeros((0, 2)))
    estimator = make_estimator(name, without_history)
    records = any(field.name == "record" for field in dataclasses.fields(estimator))
    return dataclasses.replace(estimator, record=_RECORDED_SWEEPS) if records else estimator


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
