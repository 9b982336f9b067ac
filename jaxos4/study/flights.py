"""The flights of a study: pure functions of its specification and of a flight's number."""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, Numeric, Parameters, Scalar, States, as_float
from .._xla import quick_jit
from ..analysis.covariance import cramer_rao_bound
from ..bracket import Bracket
from ..flight import Flight
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER
from ..noise import NOISES, SENSOR_SIGMA
from ..shooting import ShootingProblem
from ..simulation import simulate
from .specification import Cell, Job, Scenario, Study

# The largest offset of a bracket from the parameters that all flights have, as a share of its half-width.
_LARGEST_OFFSET = 0.8


class Fleet(NamedTuple):
    """Model, bracket and inputs of a scenario. They are the same for all noises."""

    model: AbstractModel
    bracket: Bracket
    omega: Array
    dt: Scalar


class Flights(NamedTuple):
    """Flights of a cell: true parameters, true states and measured states."""

    truth: Float[Array, "lanes parameters"]
    exact: Float[Array, "lanes samples 12"]
    measured: Float[Array, "lanes samples 12"]


def fleet_of(study: Study, scenario: Scenario | Job) -> Fleet:
    """Model, bracket and rotor speeds of a scenario or of a network's job."""
    with jax.enable_x64(study.double):
        model = MODELS[scenario.model](study.vehicle(scenario.airframe))
        offset = study.truth == "airframe"
        bracket = _bracket(model, np.asarray(scenario.width), key_of(study.seed, 0), offset=offset)
        omega = study.omega(scenario.excitation, scenario.airframe, scenario.duration)
        return Fleet(model, bracket, omega, as_float(study.dt))


@quick_jit
def _bracket(model: AbstractModel, width: Float[Numeric, ""], key: Key, *, offset: bool) -> Bracket:
    """The bracket of all searches and networks: around the airframe's parameters, or off them."""
    center, half_width = model.alpha, width * model.half_width
    if offset:
        most = _LARGEST_OFFSET
        u = jax.random.uniform(key, center.shape, minval=-most, maxval=most, dtype=float)
        center = center + half_width * u
    return Bracket.around(center, half_width)


@functools.partial(jax.jit, static_argnums=(0, 1))
def key_of(seed: int, number: int) -> Key:
    """The random key of a seed and a number."""
    return jax.random.fold_in(jax.random.key(seed), number)


def blank_problem(study: Study, fleet: Fleet, scale: float, channels: str) -> ShootingProblem:
    """The problem that all flights of a scenario share: everything measured, at rest at the start.

    `scale`: the noise in multiples of the standard sensors'.
    """
    samples, dtype = fleet.omega.shape[0], jnp.result_type(float)
    # By NumPy: outside jit, JAX would compile a program for each operation, on each device.
    time = np.asarray(study.dt, dtype) * np.arange(samples, dtype=dtype)
    return ShootingProblem(
        fleet.model,
        Flight(as_float(time), fleet.omega, as_float(np.zeros((samples, 12)))),
        sigma=scale * SENSOR_SIGMA,
        initial_state=as_float(np.zeros(12)) if study.initial_state == "known" else None,
        channels=channels,
        method=study.fit_method,
    )


def problem_of(blank: ShootingProblem, states: States) -> ShootingProblem:
    """The problem of a flight with these measurements."""
    return eqx.tree_at(lambda p: p.flight.states, blank, states)


def fly(study: Study, fleet: Fleet, cell: Cell) -> Flights:
    """Simulates the flights of a cell. Flights of one number have the same random numbers in all scenarios."""
    with jax.enable_x64(study.double):
        return _fly(
            fleet,
            cell.first + np.arange(study.batch),
            key_of(study.seed, 1),
            as_float(cell.scenario.scale),
            method=cell.scenario.method,
            kind=cell.scenario.noise,
            drawn=study.truth == "drawn",
        )


@quick_jit
def _fly(
    fleet: Fleet, numbers: Int[Numeric, " lanes"], key: Key, scale: Scalar, *, method: str, kind: str, drawn: bool
) -> Flights:
    def simulated(number: Int[Array, ""]) -> tuple[Parameters, Flight, Key]:
        truth_key, noise_key = jax.random.split(jax.random.fold_in(key, number))
        truth = fleet.model.alpha
        if drawn:
            u = jax.random.uniform(truth_key, truth.shape, minval=-1, maxval=1, dtype=float)
            truth = fleet.bracket.center + u * fleet.bracket.half_width
        return truth, simulate(fleet.model, truth, fleet.omega, dt=fleet.dt, method=method), noise_key

    def measured(exact_and_key: tuple[Flight, Key]) -> States:
        exact, noise_key = exact_and_key
        return NOISES[kind](scale * SENSOR_SIGMA)(exact, key=noise_key).states

    truth, exact, noise_keys = jax.vmap(simulated)(jnp.asarray(numbers))
    # XLA takes seconds to compile a batch of random numbers for a CPU; one flight after the other runs as fast there.
    each = jax.lax.map if jax.default_backend() == "cpu" else lambda one, flights: jax.vmap(one)(flights)
    return Flights(truth, exact.states, each(measured, (exact, noise_keys)))


@quick_jit
def cramer_rao_std(blank: ShootingProblem, flights: Flights) -> Float[Array, "lanes parameters"]:
    """The Cramer-Rao standard deviations of each flight, at the noise of a problem."""

    def one(states: States, parameters: Parameters) -> Parameters:
        problem = problem_of(blank, states)
        start = None if blank.initial_state is not None else states[0][CASCADE_ORDER[: blank.size]]
        return jnp.sqrt(jnp.diagonal(cramer_rao_bound(problem, parameters, start)))

    return jax.vmap(one)(flights.exact, flights.truth)


def fly_again(study: Study, cell: Cell, answers: list[dict[str, np.ndarray]]) -> np.ndarray:
    """Simulates a cell's first flight with the estimate of each estimator; states, (estimators, samples, 12).

    `answers`: for each estimator, the results of its cell of the same flights; NaN without an estimate.
    """
    with jax.enable_x64(study.double):
        parameters = np.stack([results["estimate"][0] for results in answers])
        starts = np.zeros((len(answers), 12))
        for start, results in zip(starts, answers, strict=True):
            known = results["initial_state"][0]
            start[CASCADE_ORDER[: known.size]] = known
        fleet = fleet_of(study, cell.scenario)
        states = _fly_from(fleet, as_float(starts), as_float(parameters), method=study.fit_method)
        return np.where(np.isfinite(parameters).all(axis=1).reshape(-1, 1, 1), states, np.nan)


@quick_jit
def _fly_from(
    fleet: Fleet, starts: Float[Array, "lanes 12"], parameters: Float[Array, "lanes parameters"], *, method: str
) -> Float[Array, "lanes samples 12"]:
    def one(start: Float[Array, "12"], parameters: Parameters) -> States:
        return simulate(fleet.model, parameters, fleet.omega, dt=fleet.dt, initial_state=start, method=method).states

    return jax.vmap(one)(starts, parameters)
