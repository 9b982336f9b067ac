"""Diagnostics of the residuals of a fit: their size, whether they are white, and whether they depend on the inputs."""

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from .._custom_types import Arrays
from ..results import NINETY_FIVE
from ..shooting import ROUNDING
from .evaluation import Evaluation

LARGEST_LAG = 25  # samples, of the correlations


class Correlations(Arrays, frozen=True, eq=False):
    """Correlations of the residuals of some channels: with themselves, and with the roll, pitch and yaw torque.

    - `own`: at 1, 2, ... samples apart.
    - `with_torque`: at lags from -`lags` to `lags`; at a positive lag, the residual is the later one. A controller
      responds to residuals, so a vehicle has correlations at negative lags.
    - `bound`: larger than 95 % of `own` if residuals are white. `torque_bound`: larger than 95 % of `with_torque` if no
      torque causes the residuals, white or coloured.
    """

    own: Float[np.ndarray, "channels lags"]
    with_torque: Float[np.ndarray, "channels 3 both"]
    bound: Float[np.ndarray, " channels"]
    torque_bound: Float[np.ndarray, "channels 3"]


class Diagnostics(eqx.Module):
    """Residuals of each simulated channel, in cascade order: p, q, r, then phi, theta, psi, then x, vx, y, vy, z, vz.

    A p-value is the probability of residuals like these, or worse, if the fit were perfect: near 0, something is wrong.
    It is 1 for a channel with fewer than three measurements, or with rounding errors as its only residuals.

    - `feasible`: whether the trajectory did not fail before its end. If not, the other fields mean nothing.
    - `count`: number of measured samples. `rms`: of the residuals, in the channel's unit.
    - `percent`: 100 (1 - |y - x| / |y - mean y|). 100: a perfect prediction. 0: as good as the mean, or no motion.
    - `level`: mean square of the weighted residuals (the *normalised innovation level*). `level_p`: p-value of a level
      of 1, two-sided (chi-squared).
    - `autocorrelation`: of residuals 1, 2, ... samples apart. `colour`: its value at the first lag with measured pairs.
    - `white_p`: p-value of white residuals (Ljung and Box 1978; by measured pairs, Stoffer and Toloi 1992). 1 for
      several windows, whose fitted initial states correlate the residuals.
    - `input_correlation`: with the roll, pitch and yaw torques, each at the lag with the largest correlation.
    - `input_p`: p-value of residuals that depend on no torque at any lag, coloured or not (Ljung, System
      Identification, chapter 16); conservative (Bonferroni).
    """

    feasible: bool
    count: Int[np.ndarray, " size"]
    rms: Float[np.ndarray, " size"]
    percent: Float[np.ndarray, " size"]
    level: Float[np.ndarray, " size"]
    level_p: Float[np.ndarray, " size"]
    autocorrelation: Float[np.ndarray, "size lags"]
    colour: Float[np.ndarray, " size"]
    white_p: Float[np.ndarray, " size"]
    input_correlation: Float[np.ndarray, "size 3"]
    input_p: Float[np.ndarray, " size"]


def residual_diagnostics(evaluation: Evaluation, *, fitted: bool = True) -> Diagnostics:
    """Diagnostics of the residuals of one flight, evaluated at the answer of a fit.

    `fitted`: whether the parameters were fitted to this flight, which uses degrees of freedom. Correlations are those
    of residuals up to `LARGEST_LAG` samples apart, in a short flight up to half of it.
    """
    from scipy.special import gammainc, gammaincc, ndtr  # slow to import, and few need it

    lags = min(LARGEST_LAG, evaluation.measured.shape[0] // 2)
    problem, feasible = evaluation.problem, evaluation.feasible
    # A diverged trajectory counts as nothing measured.
    measured = ~np.isnan(evaluation.measured) & feasible
    errors, values = (np.where(measured, x, 0.0) for x in (evaluation.errors, evaluation.measured))
    sigma, count, squares = evaluation.sigma, measured.sum(axis=0), np.square(errors).sum(axis=0)
    most, known, largest = np.maximum(count, 1), count >= 3, np.abs(values).max(axis=0)
    # Residuals below this share of a channel's largest value are rounding errors.
    rounding = max(1e-9, ROUNDING * float(np.finfo(np.asarray(problem.sigma).dtype).eps))
    trivial = ~known | (sigma * np.abs(errors).max(axis=0) <= rounding * largest)

    unknowns = problem.windows * problem.free_size + (evaluation.parameters.size if fitted else 0)
    freedom = np.maximum(count * (1 - unknowns / max(count.sum(), 1)), 1.0)
    level, tails = squares / freedom, [tail(freedom / 2, squares / 2) for tail in (gammainc, gammaincc)]
    motion = np.where(measured, values - values.sum(axis=0) / most, 0.0)
    spread = np.sqrt(np.square(motion).sum(axis=0))
    moved = known & (spread > rounding * largest * np.sqrt(most))
    autocorrelation, pairs = _correlations(errors, errors, measured, measured, lags)
    autocorrelation, pairs = autocorrelation[:, lags + 1 :], pairs[:, lags + 1 :]
    # Without any pairs the statistic is 0 and the p-value 1.
    box = ((most + 2) / most) * (pairs * np.square(autocorrelation)).sum(axis=1)
    white_p = gammaincc(np.maximum((pairs > 0).sum(axis=1), 1) / 2, box / 2)
    colour = autocorrelation[np.arange(count.size), np.argmax(pairs > 0, axis=1)]
    # The largest correlation with each torque, and the p-value of residuals that depend on no torque.
    moves = _moves(evaluation.torques)
    moves = np.where(np.abs(moves).max(axis=0) > rounding * np.abs(evaluation.torques[:-1]).max(axis=0), moves, 0.0)
    correlations, deviations = _with_torques(errors, measured, autocorrelation, moves, lags)
    ratios = np.abs(correlations) / deviations
    at = ratios.argmax(axis=2)[:, :, None]
    input_correlation, worst = (np.take_along_axis(each, at, axis=2)[:, :, 0] for each in (correlations, ratios))
    p = np.minimum((2 * lags + 1) * np.min(2 * ndtr(-worst), axis=1), 1.0)
    return Diagnostics(
        feasible=feasible,
        count=count,
        rms=np.where(known, sigma * np.sqrt(squares / most), 0.0),
        percent=np.where(moved, 100 * (1 - sigma * np.sqrt(squares) / np.where(moved, spread, 1.0)), 0.0),
        level=np.where(known, level, 1.0),
        level_p=np.where(known, 2 * np.minimum(*tails), 1.0),
        autocorrelation=np.where(trivial[:, None], 0.0, autocorrelation),
        colour=np.where(trivial, 0.0, colour),
        white_p=np.where(trivial | (problem.windows > 1), 1.0, white_p),
        input_correlation=np.where(trivial[:, None], 0.0, input_correlation),
        input_p=np.where(trivial, 1.0, np.minimum(3 * p, 1.0)),
    )


def residual_correlations(
    errors: Float[np.ndarray, "samples channels"], torques: Float[np.ndarray, "samples 3"]
) -> Correlations:
    """The correlations of residuals up to `LARGEST_LAG` samples apart. NaN: not measured."""
    measured = np.isfinite(errors)
    errors = np.where(measured, errors, 0.0)
    own = _correlations(errors, errors, measured, measured, LARGEST_LAG)[0][:, LARGEST_LAG + 1 :]
    crossed, deviations = _with_torques(errors, measured, own, _moves(torques), LARGEST_LAG)
    bound = NINETY_FIVE / np.sqrt(np.maximum(measured.sum(axis=0), 1))
    return Correlations(own, crossed, bound, NINETY_FIVE * deviations[:, :, LARGEST_LAG])


def _moves(torques: Float[np.ndarray, "samples 3"]) -> Float[np.ndarray, "samples 3"]:
    """The torques less their means. The last row of rotor speeds drives nothing."""
    return np.append(torques[:-1] - torques[:-1].mean(axis=0), np.zeros((1, 3)), axis=0)


def _with_torques(
    errors: np.ndarray, measured: np.ndarray, autocorrelation: np.ndarray, torques: np.ndarray, lags: int
) -> tuple[Float[np.ndarray, "size 3 both"], Float[np.ndarray, "size 3 both"]]:
    """The correlation with each torque at each lag, and its standard deviation if there is no dependence."""
    taper, found = 1 - np.arange(1, lags + 1) / (lags + 1), []
    drives = np.arange(len(torques))[:, None] < len(torques) - 1
    for torque in torques.T:
        column = torque[:, None]
        correlation, pairs = _correlations(errors, column, measured, drives, lags)
        own = _correlations(column, column, drives, drives, lags)[0][0, lags + 1 :]
        # Variance of the correlation of two coloured series, relative to white ones; at least 1.
        inflation = np.maximum(1 + 2 * (autocorrelation * (taper * own)).sum(axis=1), 1.0)
        found.append((correlation, np.sqrt(inflation[:, None] / np.maximum(pairs, 1e-9))))
    correlations, deviations = (np.stack(each, axis=1) for each in zip(*found, strict=True))
    return correlations, deviations


def _correlations(
    a: np.ndarray, b: np.ndarray, of_a: np.ndarray, of_b: np.ndarray, lags: int
) -> tuple[Float[np.ndarray, "size both"], Float[np.ndarray, "size both"]]:
    """Correlation of a(t + lag) with b(t) for lags from -`lags` to `lags`, and the number of pairs at each lag.

    `of_a`, `of_b`: which samples (rows) were measured; the others are 0. Columns of `a` and `b` are paired.
    """
    pairs = np.round(_lagged_sums(of_a, of_b, lags))
    power = [np.square(x).sum(axis=0) / np.maximum(of_x.sum(axis=0), 1) for x, of_x in ((a, of_a), (b, of_b))]
    variance = (power[0] * power[1])[:, None]
    mean = _lagged_sums(a, b, lags) / np.maximum(pairs, 1)
    return np.where((variance > 0) & (pairs > 0), mean / np.sqrt(np.where(variance > 0, variance, 1.0)), 0.0), pairs


def _lagged_sums(a: np.ndarray, b: np.ndarray, lags: int) -> np.ndarray:
    """The sum of a(t + lag) b(t) for lags from -`lags` to `lags`, by the Fourier transform; (size, both)."""
    length = 1 << (a.shape[0] + lags - 1).bit_length()  # no lag wraps around; a power of two has the fastest transform
    spectrum = np.fft.rfft(a, length, axis=0) * np.conj(np.fft.rfft(b, length, axis=0))
    return np.fft.irfft(spectrum, length, axis=0)[np.arange(-lags, lags + 1)].T
