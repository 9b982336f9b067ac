"""The sandwich covariance: the covariance of a fit whose residuals are coloured, or not as large as sigma says."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Covariance, InitialStates, Parameters, as_float
from ..linalg import covariances
from ..shooting import ShootingProblem

# Residuals are taken as correlated over lags up to this share of the flight.
_LAGS = 0.1
# The covariance of a window's residuals is estimated from at least so many windows, each of at most so many residuals.
_MANY_WINDOWS, _LARGEST_WINDOW = 20, 4000


@eqx.filter_jit
def robust_covariance(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """The covariance of fitted parameters, F^-1 (sum_t sum_s J_t^T R(t, s) J_s) F^-1, from the residuals of the fit.

    F is the Fisher information, J the Jacobian of the weighted residuals, and R their autocovariance, between channels
    too. The residuals are taken as the noise. They lack slow noise that the fit explained as motion. A flight must
    therefore be many times longer than the correlation time of the noise.

    **Arguments:** as for `cramer_rao_bound`, at the answer of a fit.

    **Returns:** the covariance; infinite if the trajectory diverges or nothing was measured.

    Reference: Klein and Morelli, Aircraft System Identification, chapter 6. Coverage: `docs/measured.md`.
    """
    parameters = as_float(parameters)
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    count = parameters.shape[0]
    index, within = problem.cut()
    errors, slopes = _linearised(problem, parameters, start)
    inverse = covariances(jnp.einsum("uwtc,vwtc->wuv", slopes, slopes), count)[:, :, :count]
    # The change of each estimated parameter with each residual.
    moves = jnp.einsum("uwtc,wuv->wtcv", slopes, inverse)
    measured = (~jnp.isnan(problem.measured())).astype(errors.dtype)
    sound = jnp.isfinite(problem.cost(parameters, start)) & (measured.sum() > 0)
    if problem.windows >= _MANY_WINDOWS and index.shape[1] * problem.columns.size <= _LARGEST_WINDOW:
        covariance = _window_by_window(errors, jnp.where(within[:, :, None], measured[index], 0.0), moves)
    else:
        covariance = _stationary(errors[within], measured, moves[within])
    return jnp.where(sound, covariance, jnp.inf)


def _linearised(
    problem: ShootingProblem, parameters: Parameters, start: InitialStates
) -> tuple[Float[Array, "windows length columns"], Float[Array, "unknowns windows length columns"]]:
    """The weighted residuals, window by window, and their derivatives in the parameters and the initial states.

    All initial states take the same step: a sample depends on the initial state of its own window only.
    """
    count, free = parameters.shape[0], problem.free_size
    index, within = problem.cut()

    def moved(steps: Float[Array, " unknowns"]) -> Float[Array, "windows length columns"]:
        starts = problem.split(start) + (steps[count:] if free else 0.0)
        residuals = problem.residuals(parameters + steps[:count], starts.ravel()).reshape(-1, problem.columns.size)
        return jnp.where(within[:, :, None], residuals[index], 0.0)

    zero = jnp.zeros(count + free)
    # One unknown after another: all at once would need one copy of the flight's forcing for each.
    slopes = jax.lax.map(lambda step: jax.jvp(moved, (zero,), (step,))[1], jnp.eye(count + free))
    return moved(zero), slopes


def _stationary(
    errors: Float[Array, "samples columns"],
    measured: Float[Array, "samples columns"],
    moves: Float[Array, "samples columns parameters"],
) -> Covariance:
    """The covariance for stationary noise: R(t, s) depends on t - s only.

    Bartlett's weights make the sum over lags positive. Sums over lags are products of spectra.
    """
    samples, length = errors.shape[0], 2 * errors.shape[0]

    def products(x: Float[Array, "samples columns"]) -> Float[Array, "lags columns columns"]:
        """Sums over all pairs of samples at each lag."""
        transform = jnp.fft.rfft(x, length, axis=0)
        return jnp.fft.irfft(transform[:, :, None] * jnp.conj(transform[:, None, :]), length, axis=0)

    lag = jnp.minimum(jnp.arange(length), length - jnp.arange(length))
    pairs = jnp.maximum(jnp.round(products(measured)), 1) / (1 - jnp.minimum(lag, samples - 1) / samples)[:, None, None]
    autocovariance = products(errors) / pairs
    weights = jnp.clip(1 - lag / (_LAGS * samples), 0.0)
    spectrum = jnp.fft.rfft(weights[:, None, None] * autocovariance, axis=0)
    slopes = jnp.fft.rfft(moves, length, axis=0)
    density = jnp.einsum("fcu,fcd,fdv->fuv", jnp.conj(slopes), spectrum, slopes)
    return jnp.fft.irfft(density, length, axis=0)[0]


def _window_by_window(
    errors: Float[Array, "windows length columns"],
    measured: Float[Array, "windows length columns"],
    moves: Float[Array, "windows length columns parameters"],
) -> Covariance:
    """The covariance for many windows: the residuals of the windows are draws of one random vector.

    The initial state of a window absorbs some slow noise, more at its ends than in its middle, so residuals are not
    stationary. The covariance of the vector, and of the vector with its successor, is the mean over the windows.
    """
    windows, parameters = moves.shape[0], moves.shape[-1]
    errors, measured = errors.reshape(windows, -1), measured.reshape(windows, -1)
    moves = moves.reshape(windows, -1, parameters)

    def contribution(apart: int) -> Covariance:
        """The contribution of all pairs of windows that are `apart` windows apart."""
        count = windows - apart
        pairs = measured[:count].T @ measured[apart:]
        covariance = errors[:count].T @ errors[apart:] / jnp.maximum(pairs, 1)
        moved = jnp.einsum("ts,wsv->wtv", covariance, moves[apart:])
        return jnp.einsum("wtu,wtv->uv", moves[:count], moved)

    following = contribution(1)
    # Bartlett's weight of neighbours is one half.
    return contribution(0) + (following + following.T) / 2
