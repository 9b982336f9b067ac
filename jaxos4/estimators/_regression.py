"""The rate equations as a linear regression on measured body rates: what equation-error methods share.

Between two samples the rates change by the integral of the rate equations, which are linear in the parameters. Noise
makes the differences of measured rates coloured, a moving average of order one with a unit root. Its exact whitening
is to integrate again: y_k = w_0 + sum_{j<k} T Phi_j alpha + e_k with white e and an unknown w_0, which `rows`
eliminates recursively (each row less the mean of those before it, the Helmert transform), so that every row has white
noise, unit variance, and no unknown but the parameters.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .._custom_types import Parameters, Scalar
from ..bracket import Bracket
from ..estimate import Estimate, conclude, fit_start
from ..linalg import invert
from ..models.state import CASCADE_ORDER, Rates
from ..shooting import ShootingProblem

# The standard deviation of the diffuse prior around the bracket's center, in half-widths of the bracket. It decides
# what a flight says nothing about, and nothing else.
DIFFUSE = 1e6


class Regression(NamedTuple):
    """A flight as a regression for the parameters, in half-widths of the bracket from its center.

    - `rates`: as measured, NaN where not, the first sample too where the initial state is known.
    - `anchor`: the known initial rates, else NaN.
    - `anchored`: whether they are known.
    """

    problem: ShootingProblem
    bracket: Bracket
    rates: Float[Array, "samples 3"]
    anchor: Float[Array, "3"]
    anchored: bool
    memory: Scalar
    forgetting: Scalar
    bridge: int

    def rows(self, rates: Float[Array, "samples 3"]) -> Float[Array, "samples 3 columns"]:
        """Regressors and, in the last column, what they explain: a row for p, q, r at every sample, of unit noise.

        A row of zeros says nothing. `rates` stands in for the measured rates where these are numbers.
        """
        measured, (filled, known) = ~jnp.isnan(self.rates), self._fill(rates)
        increments = self._increments(filled)
        usable = ~jnp.isnan(self._increments(jnp.where(known, filled, jnp.nan))).any(axis=-1)
        if self.problem.flight.stretch is not None:
            usable &= (jnp.diff(self.problem.flight.stretch, append=-1) == 0)[:, None]
        increments = jnp.where(usable[..., None], increments, 0.0)
        output = filled / self.problem.sigma[CASCADE_ORDER[:3]]
        kept = self.memory * self.forgetting

        def step(carry, sample):
            integral, mean, count = carry
            increment, usable, output, measured = sample
            row = integral.at[:, -1].add(output)
            off, weight = row - mean, self.forgetting * count
            scale = jnp.sqrt(1 / (1 + 1 / weight))
            mean = jnp.where(measured[:, None], mean + off / (1 + kept * count)[:, None], mean)
            count = jnp.where(usable, kept * count + measured, 0.0)
            integral = jnp.where(usable[:, None], integral + increment, 0.0)
            return (integral, mean, count), jnp.where(measured[:, None], scale[:, None] * off, 0.0)

        exact = jnp.where(kept < 1, 1.0, jnp.inf)
        first = jnp.where(jnp.isnan(self.anchor), 0.0, self.anchor) / self.problem.sigma[CASCADE_ORDER[:3]]
        nothing = jnp.zeros_like(increments[0])
        start = (nothing, nothing.at[:, -1].set(first), jnp.where(self.anchored, exact, 0.0) * jnp.ones(3))
        return jax.lax.scan(step, start, (increments, usable, output, measured))[1]

    def weights(self) -> Float[Array, " samples"]:
        """What forgetting leaves of each sample at the end of the flight."""
        age = jnp.arange(self.rates.shape[0])[::-1]
        return self.forgetting**age

    def _fill(self, rates) -> tuple[Float[Array, "samples 3"], Bool[Array, "samples 3"]]:
        """Rates with short gaps bridged by straight lines, and where they are known."""
        samples = jnp.arange(rates.shape[0])[:, None]
        first = (samples == 0) & self.anchored
        rates = jnp.where(first, self.anchor, rates)
        given = ~jnp.isnan(self.rates) | first
        last = jax.lax.cummax(jnp.where(given, samples, -1), axis=0)
        following = jax.lax.cummin(jnp.where(given, samples, rates.shape[0]), axis=0, reverse=True)
        known = given | ((last >= 0) & (following < rates.shape[0]) & (following - last - 1 <= self.bridge))
        finite = jnp.where(given, rates, 0.0)
        before = jnp.take_along_axis(finite, jnp.maximum(last, 0), axis=0)
        after = jnp.take_along_axis(finite, jnp.minimum(following, rates.shape[0] - 1), axis=0)
        share = (samples - last) / jnp.maximum(following - last, 1)
        return jnp.where(known, before + share * (after - before), 0.0), known

    def _increments(self, rates: Float[Array, "samples 3"]) -> Float[Array, "samples 3 columns"]:
        """What one sample adds to the integrated regressors and, negative, to what the bracket's center explains.

        The input of row k acts from t_k to t_{k+1}. Forward Euler takes the rates at t_k; another method the mean of
        both ends of the interval (the trapezoidal rule), whose error is of the order T^2.
        """
        model, sigma, dt = self.problem.model, self.problem.sigma[CASCADE_ORDER[:3]], self.problem.flight.dt
        center, half_width = self.bracket.center, self.bracket.half_width

        def acceleration(steps, rates, forcing):
            return jnp.stack(model.angular_acceleration(Rates(*rates), forcing, center + half_width * steps)) * dt

        def at(rates, forcing):
            zero = jnp.zeros_like(center)
            regressors = jax.jacfwd(acceleration)(zero, rates, forcing)
            return jnp.concatenate([regressors, -acceleration(zero, rates, forcing)[:, None]], axis=-1) / sigma[:, None]

        forcing = jax.tree.map(lambda leaf: leaf[:-1], self.problem.forcing(center))
        increments = jax.vmap(at)(rates[:-1], forcing)
        if self.problem.method != "euler":
            increments = (increments + jax.vmap(at)(rates[1:], forcing)) / 2
        return jnp.concatenate([increments, jnp.zeros_like(increments[:1])])


def regression(
    problem: ShootingProblem, bracket: Bracket, *, memory: Scalar, forgetting: Scalar | float, bridge: int
) -> Regression:
    """The regression of a flight's rates, whatever else the problem's channels are."""
    if not problem.model.is_linear:
        raise ValueError(
            "regression needs a model whose rate equations are linear in its parameters: identify alpha_1..8, then "
            "`fit_inertia`, or shoot."
        )
    rates = problem.restrict("rates")
    anchored = problem.initial_state is not None
    anchor = rates.first_state()[0] if anchored else jnp.full(3, jnp.nan)
    measured = rates.measured()[:, :3]
    decay = jnp.asarray(forgetting, dtype=float)
    return Regression(problem, bracket, measured, anchor, anchored, memory, decay, bridge)


def normal_equations(
    rows: Float[Array, "*rows columns"],
) -> tuple[Float[Array, "parameters parameters"], Float[Array, " parameters"]]:
    """X^T X and X^T y of rows [X, y]: in plain sums, which a batch leaves as they are."""
    rows = rows.reshape(-1, rows.shape[-1])
    regressors, output = rows[:, :-1], rows[:, -1]
    information = (regressors[:, :, None] * regressors[:, None, :]).sum(axis=0)
    return information, (regressors * output[:, None]).sum(axis=0)


def solve(
    information: Float[Array, "parameters parameters"], moment: Float[Array, " parameters"]
) -> tuple[Float[Array, " parameters"], Float[Array, "parameters parameters"]]:
    """The least-squares solution under the diffuse prior, and the inverse of the normal matrix."""
    inverse = invert(information + prior(moment.shape[0]))
    return (inverse * moment).sum(axis=-1), inverse


def prior(count: int) -> Float[Array, "parameters parameters"]:
    """The information of the diffuse prior."""
    return jnp.eye(count, dtype=float) / DIFFUSE**2


def propagated_covariance(
    regression: Regression, steps: Float[Array, " parameters"], inverse: Float[Array, "parameters parameters"]
) -> Float[Array, "parameters parameters"]:
    """The covariance of the solution `steps` that white noise of the measured rates makes, to first order.

    The solution solves g(Y) = X(Y)^T (y(Y) - X(Y) steps) = 0. The derivative of g with respect to every measured rate
    carries its variance through regressors and outputs alike: errors in variables are part of it, and neither the
    colour of the differences nor the weights need to be right. What noise does in second order, a bias, is not.
    """
    root = jnp.sqrt(regression.weights())[:, None, None]

    def score(rates):
        rows = root * regression.rows(rates)
        regressors, output = rows[..., :-1], rows[..., -1]
        residuals = output - (regressors * steps).sum(axis=-1)
        return (regressors * residuals[..., None]).sum(axis=(0, 1))

    measured = jnp.where(jnp.isnan(regression.rates), 0.0, regression.rates)
    sensitivity = jax.jacrev(score)(measured) * regression.problem.sigma[CASCADE_ORDER[:3]]
    sensitivity = sensitivity.reshape(steps.shape[0], -1)
    spread = (sensitivity[:, None, :] * sensitivity[None, :, :]).sum(axis=-1) + prior(steps.shape[0])
    left = (inverse[:, :, None] * spread[None, :, :]).sum(axis=1)
    covariance = (left[:, :, None] * inverse[None, :, :]).sum(axis=1)
    return (covariance + covariance.T) / 2


def parameters_of(bracket: Bracket, steps: Float[Array, "*samples parameters"]) -> Float[Array, "*samples parameters"]:
    """Parameters from half-widths off the bracket's center."""
    return bracket.center + bracket.half_width * steps


def covariance_of(bracket: Bracket, covariance: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """A covariance in the parameters' units."""
    return bracket.half_width[:, None] * covariance * bracket.half_width[None, :]


def check_share(name: str, value: Scalar, *, open_below: bool) -> None:
    """Raises `ValueError` for a setting outside 0 to 1."""
    if not isinstance(value, Tracer):
        number = np.asarray(value)
        if number.shape != () or not ((number > 0 if open_below else number >= 0) and number <= 1):
            raise ValueError(f"`{name}` must lie in {'(' if open_below else '['}0, 1], got {number}.")


def check_bridge(value: int) -> None:
    """Raises `ValueError` for another setting than a number of samples."""
    if not isinstance(value, int) or value < 0:
        raise ValueError(f"`bridge` must be an integer of at least 0, got {value!r}.")


def answer(
    problem: ShootingProblem,
    bracket: Bracket,
    parameters: Parameters,
    covariance: Float[Array, "parameters parameters"],
    *,
    history: Float[Array, "samples parameters"] | None = None,
) -> Estimate:
    """A regression's parameters as an estimate: the initial state and the cost are those of shooting with them.

    A parameter that is not identifiable may have any value. If the flight cannot be simulated with it, the bracket's
    center is returned.
    """
    usable = bracket.usable
    told = (jnp.sqrt(jnp.diagonal(covariance)) <= usable.half_width).all()
    flies = jnp.isfinite(problem.cost(parameters))
    parameters = jnp.where(told | flies, parameters, usable.center)
    initial_state, cost, sound, rollouts = fit_start(problem, parameters)
    return conclude(
        bracket,
        parameters=parameters,
        covariance=covariance,
        initial_state=initial_state,
        cost=cost,
        rollouts=rollouts + 1,
        sweeps=1,
        sound=sound,
        done=jnp.ones((), dtype=bool),
        history=history,
    )
