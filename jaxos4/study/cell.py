"""The cells of a study, computed: pure functions of the specification, the cell's index, and the network it needs.

Every cell is `batch` flights in one call of one program on one device. Vectorised arithmetic differs in its last digits
with the length of a batch, and with the number of devices that a program is divided among; this way results are the
same bit for bit however many cells are run side by side, in whichever process.
"""

import contextlib
import dataclasses
import functools
import io
from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, Numeric, Parameters, Scalar, States, as_float
from ..analysis.fisher import cramer_rao_bound
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate
from ..estimators import IBSS, make_estimator
from ..excitation import EXCITATIONS
from ..flight import Flight
from ..models import MODELS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..networks.network import NetworkEstimator, TrainedNetwork, untrained
from ..noise import NOISES, SENSOR_SIGMA
from ..results import NAMES, RESULTS, result_names
from ..shooting import ShootingProblem
from ..simulation import simulate
from .specification import Cell, Scenario, Study

LEVELS = (0.5, 0.9, 0.95, 0.99)
# How an estimate ended, as a study counts it: `failed` where the cell could not be computed, `not_run` where it has
# not been yet. The place in this list is the code that is stored.
OUTCOMES = (*NAMES, "failed", "not_run")
# Sweeps of a search by IBSS that are kept, of a scenario's first flight.
_RECORD = 64
# The share of a bracket's half-width by which it may be off the parameters that all flights have.
_OFF = 0.8


class Job(NamedTuple):
    """A network that cells of a study need: what it is trained for."""

    model: str
    airframe: str
    excitation: str
    duration: float
    width: float
    channels: str


class _Fleet(NamedTuple):
    """What the flights of a scenario have in common, whatever their noise."""

    model: AbstractModel
    bracket: Bracket
    omega: Array
    dt: Scalar


def jobs(study: Study) -> list[Job]:
    """The networks of a study."""
    networked = (cell.scenario for cell in _scenarios(study) if cell.scenario.needs_network)
    return list(dict.fromkeys(job_of(study, scenario) for scenario in networked))


def job_of(study: Study, scenario: Scenario) -> Job:
    """The network that a scenario's estimator needs."""
    channels = scenario.seen
    if scenario.estimator == "hybrid":
        channels = min(channels, study.network.hybrid_channels, key=CHANNELS.__getitem__)
    return Job(scenario.model, scenario.airframe, scenario.excitation, scenario.duration, scenario.width, channels)


def train(study: Study, job: Job, *, progress: bool = False) -> TrainedNetwork:
    """A network for all noises and scales of a study. Raises as `NetworkEstimator.fit` does.

    The same bit for bit only on as many cores: training divides its products of matrices among them.
    """
    with jax.enable_x64(study.precision == "float64"):
        training, problem, bracket = _training(study, job)
        key = _key(study.network.seed, jobs(study).index(job))
        return training.fit(problem, bracket, key=key, progress=progress)


def blank_network(study: Study, job: Job) -> TrainedNetwork:
    """Of the shape of a trained network, with ones for numbers: to compile with, while that is trained."""
    with jax.enable_x64(study.precision == "float64"):
        shapes = eqx.filter_eval_shape(untrained, *_training(study, job), jax.random.key(0))
        arrays, others = eqx.partition(shapes, lambda leaf: isinstance(leaf, jax.ShapeDtypeStruct))
        return eqx.combine(jax.tree.map(lambda leaf: jax.device_put(np.ones(leaf.shape, leaf.dtype)), arrays), others)


def _training(study: Study, job: Job) -> tuple[NetworkEstimator, ShootingProblem, Bracket]:
    settings, scales = study.network, [scale or 1.0 for scale in study.scales]
    training = NetworkEstimator(
        features=settings.features,
        approximator=settings.approximator,
        channels=job.channels,
        noise=(min(scales), max(scales)),
        steps=settings.steps,
        held_out=settings.held_out,
    )
    fleet = _fleet(study, job)
    return training, _blank(study, fleet, 1.0, job.channels), fleet.bracket


def run_cell(study: Study, cell: Cell, network: TrainedNetwork | None) -> dict[str, np.ndarray]:
    """Identifies the flights of a cell on the default device. Raises as the estimator does.

    **Arguments:**

    - `network`: that of `job_of`, where the estimator needs one.
    """
    with jax.enable_x64(study.precision == "float64"):
        scenario = cell.scenario
        with _one_core():
            fleet = _fleet(study, scenario)
            flown = _fly(study, fleet, cell)
            blank = _blank(study, fleet, scenario.scale or 1.0, scenario.seen)
        found = _identify(_estimator(scenario.estimator, network), blank, fleet.bracket, flown.states)
        return _results(study, cell, flown, jax.tree.map(np.asarray, found))


def bracket_of(study: Study, model: str, airframe: str, width: float) -> Bracket:
    """The bracket that all searches, and the networks, of a model, an airframe and a width get."""
    with jax.enable_x64(study.precision == "float64"):
        return _bracket(study, MODELS[model](study.vehicle(airframe)), width)


def program_of(study: Study, cell: Cell) -> tuple:
    """Cells of which this is the same are run by the same compiled program."""
    scenario = cell.scenario._replace(noise="", scale=0.0, method="")
    return scenario, job_of(study, scenario) if scenario.needs_network else None


def truth_of(study: Study, cell: Cell) -> np.ndarray:
    """The true parameters of a cell's flights: known even where no estimator could be run."""
    with jax.enable_x64(study.precision == "float64"):
        truths = _truths(_fleet(study, cell.scenario), *_draws(study, cell), drawn=study.truth == "drawn")
        return np.asarray(truths)[: study.flights - cell.first]


@contextlib.contextmanager
def _one_core() -> Iterator[None]:
    """On a CPU, the first device: programs that all estimators share are compiled once, and not for each core."""
    first = jax.local_devices()[0]
    with jax.default_device(first) if first.platform == "cpu" else contextlib.nullcontext():
        yield


class _Flown(NamedTuple):
    truth: Float[Array, "lanes parameters"]
    exact: Float[Array, "lanes samples 12"]
    states: Float[Array, "lanes samples 12"]
    bound: Float[np.ndarray, "lanes parameters"]


class _Found(NamedTuple):
    parameters: Float[Array, "lanes parameters"]
    std: Float[Array, "lanes parameters"]
    half_width: Float[Array, "lanes parameters levels"]
    cost: Float[Array, " lanes"]
    rollouts: Int[Array, " lanes"]
    initial_state: Float[Array, "lanes starts"]
    result: RESULTS
    seed: Bracket | None
    brackets: Float[Array, "lanes record 2 parameters"] | None


def _scenarios(study: Study) -> list[Cell]:
    """The first cell of each scenario."""
    return [study.cell(index) for index in range(0, study.count, study.blocks)]


def _fleet(study: Study, scenario: Scenario | Job) -> _Fleet:
    airframe = study.vehicle(scenario.airframe)
    model = MODELS[scenario.model](airframe)
    omega = EXCITATIONS[scenario.excitation](airframe, duration=scenario.duration, dt=study.dt)
    return _Fleet(model, _bracket(study, model, scenario.width), omega, as_float(study.dt))


def _bracket(study: Study, model: AbstractModel, width: float) -> Bracket:
    return _bracket_of(model, np.asarray(width), study.seed, off=study.truth == "airframe")


@eqx.filter_jit
def _bracket_of(model: AbstractModel, width: Float[Numeric, ""], seed: int, *, off: bool) -> Bracket:
    center, half_width = model.alpha, width * model.half_width
    if off:
        u = jax.random.uniform(_key(seed, 0), center.shape, minval=-_OFF, maxval=_OFF, dtype=float)
        center = center + half_width * u
    return Bracket.around(center, half_width)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _key(seed: int, number: int) -> Key:
    return jax.random.fold_in(jax.random.key(seed), number)


def _blank(study: Study, fleet: _Fleet, scale: float, channels: str) -> ShootingProblem:
    """What the flights of a scenario, and the training for it, have in common: all measured, at rest at the start."""
    samples, dtype = fleet.omega.shape[0], jnp.result_type(float)
    # By NumPy: eagerly, JAX would compile a program for each operation, on each device.
    time = np.asarray(study.dt, dtype) * np.arange(samples, dtype=dtype)
    return ShootingProblem(
        fleet.model,
        Flight(as_float(time), fleet.omega, as_float(np.zeros((samples, 12)))),
        sigma=scale * SENSOR_SIGMA,
        initial_state=as_float(np.zeros(12)) if study.initial_state == "known" else None,
        channels=channels,
        method=study.fit_method,
    )


def _fly(study: Study, fleet: _Fleet, cell: Cell) -> _Flown:
    """The flights of a cell: those of the same number are the same, but for the scale, in all scenarios."""
    truth, exact, states = _flights(study, fleet, cell)
    bound = cell.scenario.scale * np.asarray(_bounds(_blank(study, fleet, 1.0, cell.scenario.seen), exact, truth))
    return _Flown(truth, exact, states, bound)


def _flights(
    study: Study, fleet: _Fleet, cell: Cell
) -> tuple[Float[Array, "lanes parameters"], Float[Array, "lanes samples 12"], Float[Array, "lanes samples 12"]]:
    """True parameters, true states and measured states of a cell."""
    return _measured(
        fleet,
        *_draws(study, cell),
        as_float(cell.scenario.scale),
        method=cell.scenario.method,
        kind=cell.scenario.noise,
        drawn=study.truth == "drawn",
    )


def _draws(study: Study, cell: Cell) -> tuple[Int[np.ndarray, " lanes"], Key]:
    """The numbers of a cell's flights, and the key that each folds its own into."""
    return cell.first + np.arange(study.batch), _key(study.seed, 1)


def _truth(fleet: _Fleet, key: Key, drawn: bool) -> Parameters:
    truth = fleet.model.alpha
    if not drawn:
        return truth
    u = jax.random.uniform(key, truth.shape, minval=-1, maxval=1, dtype=float)
    return fleet.bracket.center + u * fleet.bracket.half_width


@eqx.filter_jit
def _truths(
    fleet: _Fleet, numbers: Int[Numeric, " lanes"], key: Key, *, drawn: bool
) -> Float[Array, "lanes parameters"]:
    """True parameters alone, from the draws that `_measured` makes."""
    return jax.vmap(lambda number: _truth(fleet, jax.random.split(jax.random.fold_in(key, number))[0], drawn))(numbers)


@eqx.filter_jit
def _measured(
    fleet: _Fleet, numbers: Int[Numeric, " lanes"], key: Key, scale: Scalar, *, method: str, kind: str, drawn: bool
) -> tuple[Float[Array, "lanes parameters"], Float[Array, "lanes samples 12"], Float[Array, "lanes samples 12"]]:
    """True parameters, true states and measured states."""

    def fly(number: Int[Array, ""]) -> tuple[Parameters, Flight, Key]:
        truth_key, noise_key = jax.random.split(jax.random.fold_in(key, number))
        truth = _truth(fleet, truth_key, drawn)
        return truth, simulate(fleet.model, truth, fleet.omega, dt=fleet.dt, method=method), noise_key

    def measured(exact_and_key: tuple[Flight, Key]) -> States:
        exact, noise_key = exact_and_key
        return NOISES[kind](scale * SENSOR_SIGMA)(exact, key=noise_key).states

    truth, exact, noise_keys = jax.vmap(fly)(jnp.asarray(numbers))
    # A batch of random numbers takes XLA seconds to compile for a CPU, where one flight after the other is as fast.
    each = jax.lax.map if jax.default_backend() == "cpu" else lambda one, flights: jax.vmap(one)(flights)
    return truth, exact.states, each(measured, (exact, noise_keys))


@eqx.filter_jit
def _bounds(
    blank: ShootingProblem, exact: Float[Array, "lanes samples 12"], truth: Float[Array, "lanes parameters"]
) -> Float[Array, "lanes parameters"]:
    """Cramer-Rao standard deviations at the noise of scale 1."""

    def one(states: States, parameters: Parameters) -> Parameters:
        problem = eqx.tree_at(lambda p: p.flight.states, blank, states)
        start = None if blank.initial_state is not None else states[0][CASCADE_ORDER[: blank.size]]
        return jnp.sqrt(jnp.diagonal(cramer_rao_bound(problem, parameters, start)))

    return jax.vmap(one)(exact, truth)


@eqx.filter_jit
def _identify(
    estimator: AbstractEstimator, blank: ShootingProblem, bracket: Bracket, states: Float[Array, "lanes samples 12"]
) -> _Found:
    def one(states: States) -> _Found:
        found: Estimate = estimator(eqx.tree_at(lambda p: p.flight.states, blank, states), bracket)
        half_width = jnp.stack([found.half_width(level) for level in LEVELS], axis=-1)
        return _Found(
            parameters=found.parameters,
            std=found.std,
            half_width=half_width,
            cost=found.cost,
            rollouts=found.rollouts,
            initial_state=found.initial_state,
            result=found.result,
            seed=found.seed,
            brackets=found.brackets,
        )

    return jax.vmap(one)(states)


def _estimator(name: str, network: TrainedNetwork | None) -> AbstractEstimator:
    # The length of the training is no part of the program.
    timeless = None if network is None else eqx.tree_at(lambda n: n.history, network, jnp.zeros((0, 2)))
    estimator = make_estimator(name, timeless)
    return dataclasses.replace(estimator, record=_RECORD) if isinstance(estimator, IBSS) else estimator


def _results(study: Study, cell: Cell, flown: _Flown, found: _Found) -> dict[str, np.ndarray]:
    """What is kept of a cell. Where there is no answer its numbers are missing (NaN), and its result says why."""
    count = min(study.batch, study.flights - cell.first)
    truth, outcome = np.asarray(flown.truth), np.array([OUTCOMES.index(n) for n in result_names(found.result)])
    told = np.asarray(np.isfinite(found.std).all(axis=-1) & np.isfinite(found.parameters).all(axis=-1))
    hit = np.full(study.batch, -1)
    if found.seed is not None:
        hit = ((truth >= found.seed.lower) & (truth <= found.seed.upper)).all(axis=-1).astype(int)
    results = {
        "truth": truth,
        "estimate": np.where(told[:, None], found.parameters, np.nan),
        "std": np.where(told[:, None], found.std, np.nan),
        "half_width": np.where(told[:, None, None], found.half_width, np.nan),
        "bound": flown.bound,
        "initial_state": np.where(told[:, None], found.initial_state, np.nan),
        "cost": np.where(told, found.cost, np.nan),
        "rollouts": found.rollouts.astype(np.int32),
        "result": outcome.astype(np.int8),
        "hit": hit.astype(np.int8),
    }
    results = {name: value[:count] for name, value in results.items()}
    if cell.first == 0:  # its first flight is shown
        results |= {"true": np.asarray(flown.exact[0]), "measured": np.asarray(flown.states[0])}
        if found.brackets is not None:
            results["brackets"] = found.brackets[0]
    return results


def fly_again(study: Study, cell: Cell, answers: list[dict[str, np.ndarray]]) -> np.ndarray:
    """The states [estimators, samples, 12] of a cell's first flight as simulated with each estimator's answer.

    **Arguments:**

    - `answers`: the results of each estimator's cell of the same flights; NaN where one has no answer.
    """
    with jax.enable_x64(study.precision == "float64"):
        fleet = _fleet(study, cell.scenario)
        parameters = np.stack([results["estimate"][0] for results in answers])
        starts = np.zeros((len(answers), 12))
        for start, results in zip(starts, answers, strict=True):
            known = results["initial_state"][0]
            start[CASCADE_ORDER[: known.size]] = known
        return np.asarray(_simulated(fleet, as_float(parameters), as_float(starts), method=study.fit_method))


@eqx.filter_jit
def _simulated(
    fleet: _Fleet,
    parameters: Float[Array, "estimators parameters"],
    starts: Float[Array, "estimators 12"],
    *,
    method: str,
) -> Float[Array, "estimators samples 12"]:
    def one(parameters: Parameters, start: Float[Array, "12"]) -> States:
        flight = simulate(fleet.model, parameters, fleet.omega, dt=fleet.dt, initial_state=start, method=method)
        return jnp.where(jnp.isfinite(parameters).all(), flight.states, jnp.nan)

    return jax.vmap(one)(parameters, starts)


def encode(results: dict[str, np.ndarray]) -> bytes:
    """The bytes of a cell's file: the same for the same results."""
    buffer = io.BytesIO()
    np.savez(buffer, **results)  # pyright: ignore[reportArgumentType]
    return buffer.getvalue()


def decode(data: bytes) -> dict[str, np.ndarray]:
    """The results in the bytes of a cell's file. Raises `ValueError` and its like for bytes that are not one."""
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        return {name: file[name] for name in file.files}
