"""Information and covariance of parameters: Fisher information, Cramer-Rao bound, and the sandwich covariance.

The sandwich covariance is that of a fit whose residuals are coloured, or not as large as sigma says.
"""

import numpy as np
from jaxtyping import Float

from .._custom_types import Covariance, InitialStates, Parameters, as_float
from .._xla import quick_jit
from ..linalg import covariance_of_shared
from ..shooting import ShootingProblem
from .evaluation import Evaluation, inverse

# Residuals are taken as correlated over lags up to this share of the flight.
_LAGS = 0.1
# The covariance of a window's residuals is estimated from at least so many windows, each of at most so many residuals.
_MANY_WINDOWS, _LARGEST_WINDOW = 20, 4000

Spread = Float[np.ndarray, "parameters parameters"]


@quick_jit
def cramer_rao_bound(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates | None = None
) -> Covariance:
    """The smallest covariance that an unbiased estimate can have: the inverse of the Fisher information J^T W^2 J.

    J is the Jacobian at `parameters`, W the weights 1 / sigma. A free initial state is unknown too. `initial_state` is
    where J is computed, by default the measured one. A parameter that is not excited has a huge variance, but not an
    infinite one.
    """
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    information = problem.curvatures(as_float(parameters), start).information
    return covariance_of_shared(information, parameters.shape[0])


def robust_covariance(evaluation: Evaluation) -> Spread:
    """The covariance of fitted parameters, F^-1 (sum_t sum_s J_t^T R(t, s) J_s) F^-1, from the residuals of the fit.

    F is the Fisher information, J the Jacobian of the weighted residuals, and R their autocovariance, between channels
    too. The residuals are taken as the noise. They lack slow noise that the fit explained as motion. A flight must
    therefore be many times longer than the correlation time of the noise.

    **Arguments:** the flight, evaluated at the answer of a fit.

    **Returns:** the covariance; infinite if the trajectory diverges or nothing was measured.

    Reference: Klein and Morelli, Aircraft System Identification, chapter 6. Coverage: `docs/measured.md`.
    """
    count, measured = evaluation.parameters.size, ~np.isnan(evaluation.measured)
    if not (evaluation.sound and measured.any()):
        return np.full((count, count), np.inf)
    jacobian, information, shared = evaluation.jacobian, evaluation.information, evaluation.covariance
    cross, own = information[:, count:, :count], information[:, count:, count:]
    sensitivity = np.concatenate(
        [np.broadcast_to(shared, (len(cross), count, count)), -inverse(own) @ cross @ shared], 1
    )
    # The change of each estimated parameter with each weighted residual.
    moves = np.swapaxes(jacobian, 1, 2) @ sensitivity
    index, within = evaluation.problem.cut()
    errors, measured = (x[index] * within[:, :, None] for x in (evaluation.errors, measured.astype(float)))
    if len(index) >= _MANY_WINDOWS and moves.shape[1] <= _LARGEST_WINDOW:
        return _window_by_window(errors.reshape(len(index), -1), measured.reshape(len(index), -1), moves)
    return _stationary(errors[within], measured[within], moves.reshape(*errors.shape, count)[within])


def _stationary(errors: np.ndarray, measured: np.ndarray, moves: np.ndarray) -> Spread:
    """The covariance for stationary noise: R(t, s) depends on t - s only. The first axis of all arrays is time.

    Bartlett's weights make the sum over lags positive. Sums over lags are products of spectra.
    """
    samples, length = errors.shape[0], 2 * errors.shape[0]

    def products(x: Float[np.ndarray, "samples columns"]) -> Float[np.ndarray, "lags columns columns"]:
        """Sums over all pairs of samples at each lag."""
        transform = np.fft.rfft(x, length, axis=0)
        return np.fft.irfft(transform[:, :, None] * np.conj(transform[:, None, :]), length, axis=0)

    lag = np.minimum(np.arange(length), length - np.arange(length))
    pairs = np.maximum(np.round(products(measured)), 1) / (1 - np.minimum(lag, samples - 1) / samples)[:, None, None]
    weights = np.maximum(1 - lag / (_LAGS * samples), 0.0)
    spectrum = np.fft.rfft(weights[:, None, None] * products(errors) / pairs, axis=0)
    slopes = np.fft.rfft(moves, length, axis=0)
    density = np.swapaxes(np.conj(slopes), 1, 2) @ spectrum @ slopes
    return np.fft.irfft(density, length, axis=0)[0]


def _window_by_window(errors: np.ndarray, measured: np.ndarray, moves: np.ndarray) -> Spread:
    """The covariance for many windows: the residuals of the windows are draws of one random vector.

    The initial state of a window absorbs some slow noise, more at its ends than in its middle, so residuals are not
    stationary. The covariance of the vector, and of the vector with its successor, is the mean over the windows.
    """

    def contribution(apart: int) -> Spread:
        """The contribution of all pairs of windows that are `apart` windows apart."""
        count = len(moves) - apart
        pairs = measured[:count].T @ measured[apart:]
        covariance = errors[:count].T @ errors[apart:] / np.maximum(pairs, 1)
        return np.tensordot(moves[:count], covariance @ moves[apart:], axes=((0, 1), (0, 1)))

    following = contribution(1)
    # Bartlett's weight of neighbours is one half.
    return contribution(0) + (following + following.T) / 2
