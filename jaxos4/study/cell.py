"""The cells of a study: their flights, and the results of an estimator on them.

Flights are pure functions of the specification and of their numbers; results also of the network. With whole cells they
are the same in any order, in any process, and on any number of cores, see `on_all_cores`.
"""

import functools
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, Numeric, Parameters, Scalar, States, as_float
from ..analysis.evaluation import cramer_rao_bound
from ..batching import on_all_cores
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..estimators import IBSS, Hybrid, make_estimator
from ..estimators.hybrid import Seed, search_near
from ..flight import Flight
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks import TrainedNetwork
from ..noise import NOISES, SENSOR_SIGMA
from ..results import NAMES, result_names
from ..shooting import ShootingProblem
from ..simulation import simulate
from .specification import Cell, Scenario, Study

OUTCOMES = (*NAMES, "failed", "not_run")
"""Outcomes of an estimate. `failed`: its cell could not be computed; `not_run`: not yet. Files hold the index."""

LEVELS = (0.5, 0.9, 0.95, 0.99)
"""The levels of the intervals that are kept."""

# Attributes of an estimate that are kept.
_KEPT = ("parameters", "std", "cost", "rollouts", "result", "seed")
# The largest offset of a bracket from the parameters that all flights have, as a share of its half-width.
_LARGEST_OFFSET = 0.8

Batch = Float[Array, "flights samples 12"]


class Setup(NamedTuple):
    """Model, bracket and inputs of a scenario. They are the same for all noises."""

    model: AbstractModel
    bracket: Bracket
    omega: Array
    dt: Scalar


# True parameters, true states and measured states of a flight, and of the flights of a cell.
Flown = tuple[Parameters, States, States]
Flights = tuple[Float[Array, "flights parameters"], Batch, Batch]


def setup_of(study: Study, scenario: Scenario) -> Setup:
    """Model, bracket and rotor speeds of a scenario."""
    with jax.enable_x64(True):
        model = MODELS[scenario.model](study.vehicle(scenario.airframe))
        offset = study.truth == "airframe"
        bracket = _bracket(model, np.asarray(scenario.width), key_of(study.seed, 0), offset=offset)
        omega = study.omega(scenario.excitation, scenario.airframe, scenario.duration)
        return Setup(model, bracket, omega, as_float(study.dt))


@eqx.filter_jit
def _bracket(model: AbstractModel, width: Float[Numeric, ""], key: Key, *, offset: bool) -> Bracket:
    """The bracket of all searches and networks: around the airframe's parameters, or off them."""
    center, half_width, most = model.alpha, width * model.half_width, _LARGEST_OFFSET
    if offset:
        center = center + half_width * jax.random.uniform(key, center.shape, minval=-most, maxval=most, dtype=float)
    return Bracket.around(center, half_width)


@functools.partial(jax.jit, static_argnums=(0, 1))
def key_of(seed: int, number: int) -> Key:
    """The random key of a seed and a number."""
    return jax.random.fold_in(jax.random.key(seed), number)


def blank_problem(study: Study, setup: Setup, scale: float, channels: str) -> ShootingProblem:
    """The problem that all flights of a scenario share. `scale`: the noise in multiples of the standard sensors'."""
    samples, dtype = setup.omega.shape[0], jnp.result_type(float)
    # By NumPy: outside jit, JAX would compile a program for each operation, on each device.
    time = as_float(np.asarray(study.dt, dtype) * np.arange(samples, dtype=dtype))
    return ShootingProblem(
        setup.model,
        Flight(time, setup.omega, as_float(np.zeros((samples, 12)))),
        sigma=scale * SENSOR_SIGMA,
        initial_state=as_float(np.zeros(12)) if study.initial_state == "known" else None,
        channels=channels,
        method=study.fit_method,
    )


def problem_of(blank: ShootingProblem, states: States) -> ShootingProblem:
    """The problem of a flight with these measurements."""
    return eqx.tree_at(lambda p: p.flight.states, blank, states)


def fly(study: Study, setup: Setup, cell: Cell) -> Flights:
    """Simulates the flights of a cell. Flights of one number have the same random numbers in all scenarios."""
    scenario, numbers = cell.scenario, cell.first + np.arange(study.batch)
    kinds = {"method": scenario.method, "kind": scenario.noise, "drawn": study.truth == "drawn"}
    with jax.enable_x64(True):
        return _fly(jnp.asarray(numbers), setup, key_of(study.seed, 1), as_float(scenario.scale), kinds)


@on_all_cores
def _fly(number: Int[Array, ""], setup: Setup, key: Key, scale: Scalar, kinds: dict[str, Any]) -> Flown:
    truth_key, noise_key = jax.random.split(jax.random.fold_in(key, number))
    truth = setup.model.alpha
    if kinds["drawn"]:
        u = jax.random.uniform(truth_key, truth.shape, minval=-1, maxval=1, dtype=float)
        truth = setup.bracket.center + u * setup.bracket.half_width
    exact = simulate(setup.model, truth, setup.omega, dt=setup.dt, method=kinds["method"])
    return truth, exact.states, NOISES[kinds["kind"]](scale * SENSOR_SIGMA)(exact, key=noise_key).states


@on_all_cores
def cramer_rao_std(flown: tuple[Parameters, States], blank: ShootingProblem) -> Parameters:
    """The Cramer-Rao standard deviations of each flight, at the noise of a problem."""
    parameters, states = flown
    start = None if blank.initial_state is not None else states[0][CASCADE_ORDER[: blank.size]]
    return jnp.sqrt(jnp.diagonal(cramer_rao_bound(problem_of(blank, states), parameters, start)))


def run_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> dict[str, np.ndarray]:
    """Identifies the flights of a cell on the default device; `network`: that of `Study.job`."""
    scenario = cell.scenario
    with jax.enable_x64(True):
        setup = setup_of(study, scenario)
        truth, exact, measured = fly(study, setup, cell)
        blank = blank_problem(study, setup, scenario.scale or 1.0, scenario.seen)
        standard = blank_problem(study, setup, 1.0, scenario.seen)
        bound = scenario.scale * np.asarray(cramer_rao_std((truth, exact), standard))
        found = _answers(study, cell, setup, blank, measured, network)
        return _results(study, cell, np.asarray(truth), bound, jax.tree.map(np.asarray, found))


def _answers(
    study: Study, cell: Cell, setup: Setup, blank: ShootingProblem, states: Batch, network: TrainedNetwork | None
) -> dict[str, Any]:
    """The attributes in `_KEPT` of each flight's estimate, and its `half_width` at `LEVELS`, by name."""
    if network is not None:  # a history of another length would be another program
        network = eqx.tree_at(lambda n: n.history, network, as_float(np.zeros((0, 2))))
    estimator, channels = make_estimator(cell.scenario.estimator, network), study.seed_channels(cell.scenario)
    if isinstance(estimator, Hybrid):
        looked_at = blank_problem(study, setup, cell.scenario.scale or 1.0, channels)
        _, seeds = _identify(states, estimator.network, looked_at, setup.bracket)
        return _search((states, seeds), estimator.ibss, blank, setup.bracket)
    if isinstance(estimator, IBSS):
        # Without an answer near which to search, it searches the whole bracket.
        none = Seed.none(len(setup.model.parameter_names), CHANNELS[channels])
        seeds = jax.tree.map(lambda leaf: jnp.asarray(np.broadcast_to(leaf, (study.batch, *leaf.shape))), none)
        return _search((states, seeds), estimator, blank, setup.bracket) | {"seed": None}
    return _identify(states, estimator, blank, setup.bracket)[0]


@on_all_cores
def _identify(
    states: States, estimator: AbstractEstimator, blank: ShootingProblem, bracket: Bracket
) -> tuple[dict[str, Any], Seed]:
    """The results as in `_answers`, and for each answer the seed of a search."""
    found = estimator(problem_of(blank, states), bracket)
    return _kept(found), Seed.of(found)


@on_all_cores
def _search(flown: tuple[States, Seed], ibss: IBSS, blank: ShootingProblem, bracket: Bracket) -> dict[str, Any]:
    """The results as in `_answers`, of a search near the seeds."""
    states, seed = flown
    return _kept(search_near(ibss, problem_of(blank, states).within(bracket), seed))


def _kept(found: Estimate) -> dict[str, Any]:
    half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
    return {name: getattr(found, name) for name in _KEPT} | {"half_width": half_width}


def _results(
    study: Study, cell: Cell, truth: np.ndarray, bound: np.ndarray, found: dict[str, Any]
) -> dict[str, np.ndarray]:
    """The arrays of a cell's file. A flight without an estimate has NaN, and a result that says why."""
    seed, hit = found["seed"], np.full(study.batch, -1)
    if seed is not None:
        # A network without an answer has an infinite interval, which is no hit.
        given = np.isfinite(seed.lower) & np.isfinite(seed.upper)
        hit = (given & (truth >= seed.lower) & (truth <= seed.upper)).all(axis=-1)
    finite = np.isfinite(found["std"]).all(axis=-1) & np.isfinite(found["parameters"]).all(axis=-1)

    def kept(name: str) -> np.ndarray:
        return np.where(finite.reshape(-1, *[1] * (found[name].ndim - 1)), found[name], np.nan)

    results = {
        "truth": truth,
        "estimate": kept("parameters"),
        **{name: kept(name) for name in ("std", "half_width", "cost")},
        "bound": bound,
        "rollouts": found["rollouts"].astype(np.int32),
        "result": np.array([OUTCOMES.index(name) for name in result_names(found["result"])], np.int8),
        "hit": hit.astype(np.int8),
    }
    return {name: value[: study.flights - cell.first] for name, value in results.items()}
