"""The training of a network on simulated flights: first a linear map, then the loop, then calibrated intervals."""

import math
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from .._custom_types import Key, Numeric, Scalar, as_float
from ..errors import TrainingError, percent
from .architecture import LEVELS, ErrorTable, Regressor, Scaling, calibrated_scales, compress, first_regressor, loss
from .features import CHUNK, Features, Flights, Purpose, draw_chunks, noisy_chunks, place_of, with_noise

if TYPE_CHECKING:
    from .estimator import NetworkEstimator

WARM_UP = 200  # steps in which the learning rate rises, at most half of all
LAST_RATE = 1e-3  # the learning rate at the end of training, relative to the largest
CHECK = 250  # steps between two evaluations of the validation loss
PER_FEATURE = 4  # simulated flights, to which the linear map is fitted
VALIDATION = 2 * CHUNK  # simulated flights
USES = 4  # of a simulated flight in training, with new noise each time; a flight costs more than its noise
IMPROVEMENT = 1e-4  # share by which a loss must be lower
DIVERGED = 1e15  # a loss beyond this ends training; the worst answer inside a bracket has a far lower one
FLYABLE = 0.01  # the smallest share of simulated flights that must not diverge


def _rates(steps: int, largest: float) -> Float[np.ndarray, " steps"]:
    """The learning rate of each step: a linear rise to the largest, then half a cosine."""
    step, warm_up = np.arange(steps), min(WARM_UP, steps // 2)
    wave = (1 + np.cos(np.pi * (step - warm_up) / (steps - warm_up))) / 2
    share = np.where(step < warm_up, step / max(warm_up, 1), LAST_RATE + (1 - LAST_RATE) * wave)
    return (largest * share).astype(np.float32)


def untrained(features: Features, settings: "NetworkEstimator", key: Key) -> tuple[Scaling, Regressor]:
    """Scaling, and a linear map fitted to simulated flights."""
    scales = np.asarray(settings.noise, float)
    count, purpose = max(CHUNK, PER_FEATURE * features.size), Purpose.LINEAR_MAP
    chunks = noisy_chunks(features, draw_chunks(features, count, key=key, purpose=purpose), scales, key, purpose)
    return _untrained(features, chunks, scales, key, settings.architecture, settings.shape)


@eqx.filter_jit
def _untrained(
    features: Features,
    chunks: list[Flights],
    scales: Float[Numeric, "2"],
    key: Key,
    architecture: str,
    shape: dict[str, Any],
) -> tuple[Scaling, Regressor]:
    samples = _joined(chunks)
    # The score's own derivatives give the bound.
    factor = features.noise_factor
    if factor is None:
        factor = Features.of("score", features.problem, features.coordinates).noise_factor
    unit = jnp.linalg.norm(factor, axis=1)

    flown = jnp.isfinite(samples.features).all(axis=1)
    sizes = 1.5 * jnp.nanmedian(jnp.where(flown[:, None], jnp.abs(samples.features), jnp.nan), axis=0)
    # Scaled so that one learning rate suits both kinds of features, however many they are.
    sizes = jnp.where(sizes > 0, sizes, 1.0) * jnp.sqrt(features.size / unit.shape[0])
    inputs = jnp.where(flown[:, None], compress(samples.features / sizes), 0.0)
    targets = jnp.where(flown[:, None], samples.u, 0.0)
    ridge = 1e-6 * jnp.trace(inputs.T @ inputs) / features.size
    linear_map = jnp.linalg.solve(inputs.T @ inputs + ridge * jnp.eye(features.size), inputs.T @ targets).T
    scaling = Scaling(sizes, unit, jnp.minimum(10 * unit, 1.0), jnp.maximum(jnp.abs(jnp.log(scales)).max(), 1.0))
    key = jax.random.fold_in(key, place_of(Purpose.WEIGHTS, 0))
    return scaling, first_regressor(linear_map, key, architecture, shape)


def train(
    regressor: Regressor, scaling: Scaling, features: Features, settings: "NetworkEstimator", key: Key
) -> tuple[Regressor, Float[np.ndarray, "checks 2"]]:
    """Trains a regressor by Muon with a cosine schedule; flights that diverge do not count. Each step has new noise.

    **Returns:** the regressor at the check with the best validation loss, and the losses at every check.

    **Raises:** `TrainingError` if the loss diverges, or if nearly all flights of the bracket diverge.
    """
    scales, steps, batch = np.asarray(settings.noise, float), settings.steps, settings.batch
    held_out = draw_chunks(features, VALIDATION, key=key, purpose=Purpose.VALIDATION)
    held_out = noisy_chunks(features, held_out, scales, key, Purpose.VALIDATION)
    flyable = np.mean([np.isfinite(np.asarray(chunk.features)).all(axis=1) for chunk in held_out])
    if not flyable > FLYABLE:
        what = f"only {percent(float(flyable))} of the flights simulated in the bracket can be flown to their end"
        raise TrainingError(f"{what}: narrow the bracket, or shorten the flight.")
    # Single precision: rounding is far below the noise of a step's flights.
    regressor, held_out, data = _single(regressor), _single(held_out), _single((scaling, features, scales))
    state, rates = _first_state(regressor), _rates(steps, settings.learning_rate)
    flown = batch * CHECK // USES
    best, lowest, without_improvement, history = regressor, np.inf, 0, []
    for number, first in enumerate(range(0, steps, CHECK)):
        place = number * math.ceil(flown / CHUNK)
        flights = draw_chunks(features, flown, key=key, purpose=Purpose.FLIGHTS, first=place)
        count = min(CHECK, steps - first)
        places = place_of(Purpose.STEPS, first + np.arange(CHECK))
        rate = np.resize(rates[first : first + count], CHECK)  # of one shape: the last steps need no other program
        regressor, state, *losses = _advance(
            regressor, state, data, flights, held_out, key, places, rate, np.asarray(count), batch
        )
        history.append([float(value) for value in losses])
        value, current = history[-1]
        if not np.less(history[-1], DIVERGED).all():
            loss = next(each for each in (current, value) if not each < DIVERGED)
            raise TrainingError(
                f"training diverged within {first + count} steps (loss {loss:g}): narrow the bracket; in Python, "
                "lower `learning_rate`."
            )
        without_improvement += 1
        if current < lowest - IMPROVEMENT * abs(current):
            best, lowest, without_improvement = regressor, current, 0
        if without_improvement >= settings.patience:
            break
    whole = jax.tree.map(lambda x: as_float(np.asarray(x)) if eqx.is_inexact_array_like(x) else x, best)
    return whole, np.asarray(history)


@eqx.filter_jit
def _advance(
    regressor: Regressor,
    state: PyTree,
    data: tuple[Scaling, Features, Float[Array, "2"]],
    chunks: list[Flights],
    held_out: list[Flights],
    key: Key,
    places: Int[Numeric, " steps"],
    rates: Float[Numeric, " steps"],
    count: Int[Numeric, ""],
    batch: int,
) -> tuple[Regressor, PyTree, Scalar, Scalar]:
    """The first `count` steps of training, their mean loss, and the loss on `held_out` flights."""
    scaling, features, scales = data
    flights = jax.tree.map(lambda x: x.astype(jnp.float32), _joined(chunks))

    def mean_loss(regressor: Regressor, flights: Flights) -> Scalar:
        flown = jnp.isfinite(flights.features).all(axis=1)
        # NaN would make the gradient NaN even at a weight of 0.
        finite = jnp.where(flown[:, None], flights.features, 0.0)
        losses = jax.vmap(lambda *one: loss(regressor, scaling, *one))(finite, flights.scale, flights.u)
        return jnp.where(flown, losses, 0.0).sum() / jnp.maximum(flown.sum(), 1)

    def step(i: Int[Array, ""], carry: tuple[PyTree, PyTree, Scalar]) -> tuple[PyTree, PyTree, Scalar]:
        weights, state, total = carry
        # All random numbers in one draw, which compiles faster than one for each quantity.
        drawn = jax.random.uniform(
            jax.random.fold_in(key, places[i]), (batch, 2 + features.size), jnp.float32, minval=-1, maxval=1
        )
        picked = ((drawn[:, 0] + 1) / 2 * flights.u.shape[0]).astype(int)
        noisy = with_noise(features, jax.tree.map(lambda leaf: leaf[picked], flights), scales, drawn[:, 1:])
        value, gradient = jax.value_and_grad(lambda weights: mean_loss(eqx.combine(weights, rest), noisy))(weights)
        updates, state = _optimiser(rates[i]).update(gradient, state, weights)
        return eqx.apply_updates(weights, updates), state, total + value

    weights, rest = eqx.partition(regressor, eqx.is_inexact_array)
    weights, state, total = jax.lax.fori_loop(0, count, step, (weights, state, jnp.zeros((), jnp.float32)))
    regressor = eqx.combine(weights, rest)
    return regressor, state, total / count, mean_loss(regressor, _joined(held_out))


def _joined(chunks: list[Flights]) -> Flights:
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *chunks)


@eqx.filter_jit  # by name: a function that is made in each call would be compiled in each call
def _first_state(regressor: Regressor) -> PyTree:
    return _optimiser(0.0).init(eqx.filter(regressor, eqx.is_inexact_array))


def _optimiser(rate: Scalar | float) -> Any:
    """Muon, a `GradientTransformation` of Optax."""
    import optax  # slow to import

    # Optax's own coefficients of Newton and Schulz; as rows they compile to a loop.
    return optax.contrib.muon(rate, ns_coeffs=((3.4445, -4.7750, 2.0315),) * 5)


def _single(tree: PyTree) -> PyTree:
    """All floating-point numbers in single precision, by NumPy: JAX would compile programs."""
    return jax.tree.map(lambda leaf: np.asarray(leaf, np.float32) if eqx.is_inexact_array_like(leaf) else leaf, tree)


def calibrate(
    regressor: Regressor, scaling: Scaling, features: Features, settings: "NetworkEstimator", key: Key
) -> ErrorTable:
    """Measures a network's errors on new simulated flights, with new noise at each noise scale.

    Each quantile is the smallest that holds its level for one more flight. Raises `TrainingError` if too few can be
    flown.
    """
    parameters, tables, purpose = len(features.problem.model.parameter_names), [], Purpose.CALIBRATION
    flights = draw_chunks(features, settings.held_out, key=key, purpose=purpose, uniform=True)
    scales = calibrated_scales(settings.noise)
    for number, scale in enumerate(np.asarray(scales)):
        chunks = noisy_chunks(features, flights, np.stack([scale, scale]), key, purpose, 1 + number)
        error = np.concatenate([_standardised(regressor, scaling, chunk, scale) for chunk in chunks])[:, :parameters]
        error = error[np.isfinite(error).all(axis=1)]
        rank = np.ceil(np.round((len(error) + 1) * LEVELS, 9)).astype(int) - 1  # LEVELS have rounding errors
        if rank[-1] >= len(error):
            raise TrainingError(
                "too few of the held-out flights can be flown to calibrate: narrow the bracket, or increase `held_out`."
            )
        moments = error.T @ error / len(error)
        rms = np.sqrt(np.diagonal(moments))
        relative = np.abs(error) / rms
        quantiles = np.sort(np.column_stack([relative, relative.max(axis=1)]), axis=0)[rank]
        tables.append((rms, moments / np.outer(rms, rms), quantiles[:, :-1], quantiles[:, -1]))
    return ErrorTable(scales, *(as_float(np.stack(column)) for column in zip(*tables, strict=True)))


@eqx.filter_jit
def _standardised(
    regressor: Regressor, scaling: Scaling, flights: Flights, scale: Scalar
) -> Float[Array, "flights unknowns"]:
    """Errors in units of the standard deviation that the network gives, at one noise scale."""
    u, log_spread = jax.vmap(regressor, in_axes=(0, None, None))(flights.features, scale, scaling)
    return (u - flights.u) / (scaling.bound(scale) * jnp.exp(log_spread))
