"""Diagnostics of the residuals of a fit: their size, whether they are white, and whether they depend on the inputs."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import InitialStates, Parameters, Scalar, as_float
from ..shooting import ROUNDING, ShootingProblem

Series = Float[Array, " samples"]
Measured = Bool[Array, " samples"]
Correlation = Float[Array, " both"]

# Residuals below this share of a channel's largest value are rounding errors, in double precision.
_ROUNDING = 1e-9
# A channel with fewer measurements than this has no diagnostics.
_FEWEST = 3


class Diagnostics(eqx.Module):
    """Residuals of each simulated channel, in cascade order: p, q, r, then phi, theta, psi, then x, vx, y, vy, z, vz.

    A p-value is the probability of residuals like these, or worse, if the fit were perfect: near 0, something is wrong.
    It is 1 for a channel with fewer than three measurements, or with rounding errors as its only residuals.

    - `sound`: whether the trajectory stayed finite to its end. If not, the other fields mean nothing.
    - `count`: number of measured samples.
    - `rms`: of the residuals, in the channel's unit.
    - `percent`: 100 (1 - |y - x| / |y - mean y|). 100 is a perfect prediction, 0 is as good as the mean, or the channel
      does not move.
    - `level`: mean square of the weighted residuals (the *normalised innovation level*). 1: as large as the problem's
      sigma.
    - `level_p`: p-value of a level of 1, two-sided (chi-squared).
    - `autocorrelation`: of residuals 1, 2, ... samples apart.
    - `colour`: the autocorrelation at the first lag that has pairs of measured samples.
    - `white_p`: p-value of white residuals (Ljung and Box 1978; each lag counts its pairs of measured samples, Stoffer
      and Toloi 1992). 1 for several windows, whose fitted initial states correlate the residuals.
    - `input_correlation`: with the roll, pitch and yaw torques, each at the lag with the largest correlation.
    - `input_p`: p-value of residuals that depend on no torque at any lag. It allows for coloured residuals (Ljung,
      System Identification, chapter 16) and is conservative (Bonferroni).
    """

    sound: Bool[Array, ""]
    count: Int[Array, " size"]
    rms: Float[Array, " size"]
    percent: Float[Array, " size"]
    level: Float[Array, " size"]
    level_p: Float[Array, " size"]
    autocorrelation: Float[Array, "size lags"]
    colour: Float[Array, " size"]
    white_p: Float[Array, " size"]
    input_correlation: Float[Array, "size 3"]
    input_p: Float[Array, " size"]


def residual_diagnostics(
    problem: ShootingProblem,
    parameters: Parameters,
    initial_state: InitialStates | None = None,
    *,
    fitted: bool = True,
    lags: int = 25,
) -> Diagnostics:
    """Diagnostics of the residuals at `parameters`.

    **Arguments:**

    - `parameters`, `initial_state`: of a fit. The initial state is by default the measured one.
    - `fitted`: whether the parameters were fitted to this flight, which uses degrees of freedom.
    - `lags`: the largest lag of the correlations, in samples.

    **Raises:** `ValueError` for wrong shapes, or a flight with too few samples for `lags`.
    """
    parameters = as_float(parameters)
    start = problem.first_state()[0] if initial_state is None else as_float(initial_state)
    for name, value, length in (
        ("parameters", parameters, len(problem.model.parameter_names)),
        ("initial_state", start, problem.windows * problem.size),
    ):
        if value.shape != (length,):
            raise ValueError(f"`{name}` must be of shape ({length},), got {value.shape}.")
    samples = problem.flight.states.shape[-2]
    if not 1 <= lags < samples:
        raise ValueError(f"`lags` must lie in 1 to {samples - 1} for {samples} samples, got {lags}.")
    return _diagnostics(problem, parameters, start, fitted, lags)


@eqx.filter_jit
def _diagnostics(
    problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates, fitted: bool, lags: int
) -> Diagnostics:
    sigma = problem.sigma[problem.columns]
    residuals = _residuals(problem, parameters, initial_state)
    _, errors, measured, values, count, most, squares = residuals
    known, size = count >= _FEWEST, jnp.abs(values).max(axis=0)
    rounding = max(_ROUNDING, ROUNDING * float(jnp.finfo(sigma.dtype).eps))
    trivial = ~known | (sigma * jnp.abs(errors).max(axis=0) <= rounding * size)

    unknowns = problem.windows * problem.free_size + (parameters.shape[0] if fitted else 0)
    freedom = jnp.maximum(count * (1 - unknowns / jnp.maximum(count.sum(), 1)), 1.0)
    below, above = (
        tail(freedom / 2, squares / 2) for tail in (jax.scipy.special.gammainc, jax.scipy.special.gammaincc)
    )
    level, level_p = squares / freedom, 2 * jnp.minimum(below, above)
    motion = jnp.where(measured, values - values.sum(axis=0) / most, 0.0)
    spread = jnp.sqrt(jnp.square(motion).sum(axis=0))
    moved = known & (spread > rounding * size * jnp.sqrt(most))
    autocorrelation, colour, white_p = _whiteness(residuals, lags)
    input_correlation, input_p = _dependence(problem, parameters, residuals, autocorrelation, rounding, lags)
    return Diagnostics(
        sound=residuals.sound,
        count=count,
        rms=jnp.where(known, sigma * jnp.sqrt(squares / most), 0.0),
        percent=jnp.where(moved, 100 * (1 - sigma * jnp.sqrt(squares) / jnp.where(moved, spread, 1.0)), 0.0),
        level=jnp.where(known, level, 1.0),
        level_p=jnp.where(known, level_p, 1.0),
        autocorrelation=jnp.where(trivial[:, None], 0.0, autocorrelation),
        colour=jnp.where(trivial, 0.0, colour),
        white_p=jnp.where(trivial | (problem.windows > 1), 1.0, white_p),
        input_correlation=jnp.where(trivial[:, None], 0.0, input_correlation),
        input_p=jnp.where(trivial, 1.0, input_p),
    )


class _Residuals(NamedTuple):
    """Weighted residuals `errors` and measured `values`, 0 for missing samples; `most`: `total`, or 1 if it is 0."""

    sound: Bool[Array, ""]
    errors: Float[Array, "samples size"]
    measured: Bool[Array, "samples size"]
    values: Float[Array, "samples size"]
    total: Int[Array, " size"]
    most: Int[Array, " size"]
    squares: Float[Array, " size"]


def _residuals(problem: ShootingProblem, parameters: Parameters, initial_state: InitialStates) -> _Residuals:
    observed = problem.measured()
    errors = problem.residuals(parameters, initial_state).reshape(observed.shape)
    # A diverged trajectory counts as nothing measured.
    sound = jnp.isfinite(problem.cost(parameters, initial_state)) & jnp.isfinite(errors).all()
    measured = ~jnp.isnan(observed) & sound
    errors, count = jnp.where(measured, errors, 0.0), measured.sum(axis=0)
    values = jnp.where(measured, observed, 0.0)
    return _Residuals(sound, errors, measured, values, count, jnp.maximum(count, 1), jnp.square(errors).sum(axis=0))


def _whiteness(
    residuals: _Residuals, lags: int
) -> tuple[Float[Array, "size lags"], Float[Array, " size"], Float[Array, " size"]]:
    """Autocorrelation at positive lags, its value at the first lag with pairs, and the p-value of white residuals."""
    errors, measured, most = residuals.errors, residuals.measured, residuals.most
    correlation, pairs = jax.vmap(lambda e, m: _correlations(e, e, m, m, lags), in_axes=1)(errors, measured)
    after, pairs = correlation[:, lags + 1 :], pairs[:, lags + 1 :]
    box = ((most + 2) / most) * (pairs * jnp.square(after)).sum(axis=1)
    has_pairs = pairs > 0
    colour = jnp.take_along_axis(after, jnp.argmax(has_pairs, axis=1)[:, None], axis=1)[:, 0]
    # Without any pairs the statistic is 0 and the p-value 1.
    return after, colour, jax.scipy.special.gammaincc(jnp.maximum(has_pairs.sum(axis=1), 1) / 2, box / 2)


def _dependence(
    problem: ShootingProblem,
    parameters: Parameters,
    residuals: _Residuals,
    autocorrelation: Float[Array, "size lags"],
    rounding: float,
    lags: int,
) -> tuple[Float[Array, "size 3"], Float[Array, " size"]]:
    """The largest correlation with each torque, and the p-value of residuals that depend on no torque."""
    torques = jnp.stack(problem.forcing(parameters)[:3], axis=1)
    # The last row of rotor speeds drives nothing.
    driving = jnp.arange(torques.shape[0]) < torques.shape[0] - 1
    moves = jnp.where(driving[:, None], torques - torques[:-1].mean(axis=0), 0.0)
    moving = jnp.abs(moves).max(axis=0) > rounding * jnp.abs(torques[:-1]).max(axis=0)
    torques = jnp.where(moving, moves, 0.0)
    correlation, p = jax.vmap(
        lambda e, m, own: jax.vmap(lambda u: _with_input(e, m, own, u, driving, lags), in_axes=1)(torques),
        in_axes=(1, 1, 0),
    )(residuals.errors, residuals.measured, autocorrelation)
    return correlation, jnp.minimum(3 * p.min(axis=1), 1.0)


def _correlations(a: Series, b: Series, of_a: Measured, of_b: Measured, lags: int) -> tuple[Correlation, Correlation]:
    """Correlation of a(t + lag) with b(t) for lags from -`lags` to `lags`, and the number of pairs at each lag.

    `of_a`, `of_b`: which samples were measured; the others are 0.
    """
    samples = a.shape[0]

    def sums(x: Series, y: Series) -> Correlation:
        spectrum = jnp.fft.rfft(x, 2 * samples) * jnp.conj(jnp.fft.rfft(y, 2 * samples))
        return jnp.fft.irfft(spectrum, 2 * samples)[jnp.arange(-lags, lags + 1)]

    pairs = jnp.round(sums(of_a.astype(a.dtype), of_b.astype(a.dtype)))
    variance = (jnp.square(a).sum() / jnp.maximum(of_a.sum(), 1)) * (jnp.square(b).sum() / jnp.maximum(of_b.sum(), 1))
    mean = sums(a, b) / jnp.maximum(pairs, 1)
    return jnp.where((variance > 0) & (pairs > 0), mean / jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0), pairs


def _with_input(
    errors: Series, measured: Measured, colour: Float[Array, " lags"], torque: Series, driving: Measured, lags: int
) -> tuple[Scalar, Scalar]:
    """The largest correlation of residuals with one input over all lags, and the p-value of no correlation."""
    correlation, pairs = _correlations(errors, torque, measured, driving, lags)
    own, _ = _correlations(torque, torque, driving, driving, lags)
    taper = 1 - jnp.arange(1, lags + 1) / (lags + 1)
    # Variance of the correlation of two coloured series, relative to white ones; at least 1.
    inflation = jnp.maximum(1 + 2 * (taper * colour * own[lags + 1 :]).sum(), 1.0)
    deviations = jnp.abs(correlation) * jnp.sqrt(pairs / inflation)
    at = jnp.argmax(deviations)
    p = 2 * jax.scipy.special.ndtr(-deviations[at])
    return correlation[at], jnp.minimum((2 * lags + 1) * p, 1.0)
