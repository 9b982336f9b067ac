"""What the residuals of a fit say about it: their size, whether they are white, and whether inputs are left in them."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Parameters, Scalar, as_float
from ..shooting import ROUNDING, ShootingProblem

# Residuals below this share of a channel's largest value are rounding, whatever their correlation; in single precision
# below as many rounding errors as add up over a flight.
_ROUNDING = 1e-9
# A channel with fewer measurements than this has no diagnostics.
_FEWEST = 3


class Diagnostics(eqx.Module):
    """Residuals of each simulated channel, in cascade order: p, q, r, then phi, theta, psi, then x, vx, y, vy, z, vz.

    p-values are what is left of the null hypothesis: near 0, residuals are not what they should be. Where fewer than
    three samples were measured, or residuals are rounding alone, nothing speaks against them: 1.

    - `sound`: whether the trajectory stayed sound to its end; nothing else means anything where it did not.
    - `count`: measured samples.
    - `rms`: of the residuals, in the channel's unit.
    - `percent`: 100 (1 - |y - x| / |y - mean y|): 100 is a perfect prediction, 0 is as good as the mean. 0 where the
      channel does not move.
    - `level`: mean square of the weighted residuals: 1 where they are as large as the problem's sigma says. The
      *normalised innovation level* of a model without process noise.
    - `level_p`: of that being so, two-sided (chi-squared).
    - `autocorrelation`: of neighbouring residuals, of those two samples apart, and so on.
    - `colour`: the first of those that any two measured samples tell.
    - `white_p`: of all those being 0 (Ljung and Box 1978; with missing samples each lag counts its pairs, Stoffer
      and Toloi 1992). Of one window only, 1 of several: an initial state fitted to each correlates what is left of it.
    - `input_correlation`: with the roll, pitch and yaw torques, each at the lag where it is largest.
    - `input_p`: of there being none at any lag and torque, with the residuals' own colour allowed for
      (Ljung, System Identification, chapter 16) and Bonferroni's correction: on the safe side.
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
    initial_state: Float[Array, " starts"] | None = None,
    *,
    fitted: bool = True,
    lags: int = 25,
) -> Diagnostics:
    """Diagnostics of the residuals at `parameters`.

    **Arguments:**

    - `initial_state`: the measured one by default.
    - `fitted`: whether the parameters were fitted to this flight, which takes degrees of freedom.
    - `lags`: how many sample times apart correlations are looked at, at most.

    **Raises:** `ValueError` for a number of lags that the flight has not, or parameters or an initial state of another
    length than the problem's.
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
    problem: ShootingProblem,
    parameters: Parameters,
    initial_state: Float[Array, " starts"],
    fitted: bool,
    lags: int,
) -> Diagnostics:
    sigma, measured = problem.sigma[problem.columns], problem.measured()
    there = ~jnp.isnan(measured)
    errors = problem.residuals(parameters, initial_state).reshape(measured.shape)
    # A trajectory that diverges leaves nothing to judge.
    sound = jnp.isfinite(problem.cost(parameters, initial_state)) & jnp.isfinite(errors).all()
    there &= sound
    errors = jnp.where(there, errors, 0.0)
    count = there.sum(axis=0)
    known = count >= _FEWEST
    most = jnp.maximum(count, 1)
    squares = jnp.square(errors).sum(axis=0)
    values = jnp.where(there, measured, 0.0)
    motion = jnp.where(there, measured - values.sum(axis=0) / most, 0.0)
    size = jnp.abs(values).max(axis=0)
    rounding = max(_ROUNDING, ROUNDING * float(jnp.finfo(sigma.dtype).eps))
    trivial = ~known | (sigma * jnp.abs(errors).max(axis=0) <= rounding * size)

    unknowns = problem.windows * problem.free_size + (parameters.shape[0] if fitted else 0)
    freedom = jnp.maximum(count * (1 - unknowns / jnp.maximum(count.sum(), 1)), 1.0)
    below, above = (
        tail(freedom / 2, squares / 2) for tail in (jax.scipy.special.gammainc, jax.scipy.special.gammaincc)
    )
    spread = jnp.sqrt(jnp.square(motion).sum(axis=0))
    moved = known & (spread > rounding * size * jnp.sqrt(most))

    correlation, pairs = jax.vmap(lambda e, t: _correlations(e, e, t, t, lags), in_axes=1)(errors, there)
    after, pairs = correlation[:, lags + 1 :], pairs[:, lags + 1 :]
    box = ((most + 2) / most) * (pairs * jnp.square(after)).sum(axis=1)
    told = pairs > 0
    colour = jnp.take_along_axis(after, jnp.argmax(told, axis=1)[:, None], axis=1)[:, 0]
    # Nothing to test is nothing against it.
    whitish = jax.scipy.special.gammaincc(jnp.maximum(told.sum(axis=1), 1) / 2, box / 2)
    torques = jnp.stack(problem.forcing(parameters)[:3], axis=1)
    # The last row of rotor speeds drives nothing.
    driving = jnp.arange(torques.shape[0]) < torques.shape[0] - 1
    moves = jnp.where(driving[:, None], torques - torques[:-1].mean(axis=0), 0.0)
    moving = jnp.abs(moves).max(axis=0) > rounding * jnp.abs(torques[:-1]).max(axis=0)
    torques = jnp.where(moving, moves, 0.0)
    strongest, least_p = jax.vmap(
        lambda e, t, own: jax.vmap(lambda u: _with_input(e, t, own, u, driving, lags), in_axes=1)(torques),
        in_axes=(1, 1, 0),
    )(errors, there, after)
    return Diagnostics(
        sound=sound,
        count=count,
        rms=jnp.where(known, sigma * jnp.sqrt(squares / most), 0.0),
        percent=jnp.where(moved, 100 * (1 - sigma * jnp.sqrt(squares) / jnp.where(moved, spread, 1.0)), 0.0),
        level=jnp.where(known, squares / freedom, 1.0),
        level_p=jnp.where(known, 2 * jnp.minimum(below, above), 1.0),
        autocorrelation=jnp.where(trivial[:, None], 0.0, after),
        colour=jnp.where(trivial, 0.0, colour),
        white_p=jnp.where(trivial | (problem.windows > 1), 1.0, whitish),
        input_correlation=jnp.where(trivial[:, None], 0.0, strongest),
        input_p=jnp.where(trivial, 1.0, jnp.minimum(3 * least_p.min(axis=1), 1.0)),
    )


def _correlations(
    a: Float[Array, " samples"],
    b: Float[Array, " samples"],
    of_a: Bool[Array, " samples"],
    of_b: Bool[Array, " samples"],
    lags: int,
) -> tuple[Float[Array, " both"], Float[Array, " both"]]:
    """Correlation of a(t + lag) with b(t) for lags from -`lags` to `lags`, and the pairs that it is a mean over."""
    samples = a.shape[0]

    def sums(x: Float[Array, " samples"], y: Float[Array, " samples"]) -> Float[Array, " both"]:
        spectrum = jnp.fft.rfft(x, 2 * samples) * jnp.conj(jnp.fft.rfft(y, 2 * samples))
        return jnp.fft.irfft(spectrum, 2 * samples)[jnp.arange(-lags, lags + 1)]

    pairs = jnp.round(sums(of_a.astype(a.dtype), of_b.astype(a.dtype)))
    variance = (jnp.square(a).sum() / jnp.maximum(of_a.sum(), 1)) * (jnp.square(b).sum() / jnp.maximum(of_b.sum(), 1))
    mean = sums(a, b) / jnp.maximum(pairs, 1)
    return jnp.where((variance > 0) & (pairs > 0), mean / jnp.sqrt(jnp.where(variance > 0, variance, 1.0)), 0.0), pairs


def _with_input(
    errors: Float[Array, " samples"],
    there: Bool[Array, " samples"],
    colour: Float[Array, " lags"],
    torque: Float[Array, " samples"],
    driving: Bool[Array, " samples"],
    lags: int,
) -> tuple[Scalar, Scalar]:
    """The largest correlation of residuals with one input over all lags, and the p-value of its being none."""
    correlation, pairs = _correlations(errors, torque, there, driving, lags)
    own, _ = _correlations(torque, torque, driving, driving, lags)
    taper = 1 - jnp.arange(1, lags + 1) / (lags + 1)
    # The variance of a correlation of two coloured series, in that of white ones; never taken as less.
    inflation = jnp.maximum(1 + 2 * (taper * colour * own[lags + 1 :]).sum(), 1.0)
    deviations = jnp.abs(correlation) * jnp.sqrt(pairs / inflation)
    at = jnp.argmax(deviations)
    p = 2 * jax.scipy.special.ndtr(-deviations[at])
    return correlation[at], jnp.minimum((2 * lags + 1) * p, 1.0)
