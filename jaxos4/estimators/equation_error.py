"""Equation error: the parameters for which the measured rates satisfy the rate equations best, by least squares.

Between two samples the rates change by the integral of the rate equations, which are linear in the parameters. The
noise of measured rates makes their differences coloured. Integrating again whitens them exactly: y_k = w_0 + sum_{j<k}
T Phi_j alpha + e_k, with white noise e and an unknown w_0, which `Regression.rows` eliminates (it subtracts the mean of
all rows before each row, the Helmert transform). Rows then have white noise, unit variance, and no other unknowns.
"""

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from .._custom_types import Count, Parameters, Scalar, integer, setting
from ..bracket import Bracket
from ..estimate import AbstractEstimator, Estimate, as_estimate, fit_start, in_one_program, recursively
from ..flight import RATES
from ..linalg import gram, invert
from ..models.state import Rates
from ..shooting import ShootingProblem

RegressionRows = Float[Array, "samples 3 columns"]
Matrix = Float[Array, "parameters parameters"]

# Standard deviation of the diffuse prior around the bracket's center, in half-widths of the bracket. It matters only
# for parameters that are not excited.
DIFFUSE = 1e6
_MANY = 100  # columns; one flight has at most 30


class Regression(NamedTuple):
    """A flight as a regression for the parameters, in half-widths from the bracket's center.

    - `center`, `half_width`: of the bracket; a half-width of 0 fixes a parameter.
    - `rates`: NaN if not measured, and at the first sample if the initial state is known.
    - `anchor`: the known initial rates; NaN if they are free. `anchored`: whether they are known.
    - `settings`: `memory`, `bridge` and `forgetting`.
    """

    problem: ShootingProblem
    center: Parameters
    half_width: Parameters
    rates: Float[Array, "samples 3"]
    anchor: Float[Array, "3"]
    anchored: bool
    settings: "EquationError | RecursiveLeastSquares"

    @classmethod
    def of(cls, problem: ShootingProblem, settings: "EquationError | RecursiveLeastSquares") -> "Regression":
        """The regression for a flight's body rates. Parameters in which it is not linear stay at their center."""
        unknowns, rates = problem.unknowns.usable, problem.restrict("rates")
        linear = np.array([not each.in_forcing for each in problem.model.parameters])
        anchored = problem.initial_state is not None
        anchor = rates.first_state()[0] if anchored else jnp.full(3, jnp.nan)
        half_width, measured = jnp.where(linear, unknowns.free_half_width, 0.0), rates.measured()[:, :3]
        return cls(problem, unknowns.center, half_width, measured, anchor, anchored, settings)

    @property
    def sigma(self) -> Float[Array, "3"]:
        """The noise of the rates [rad/s]."""
        return self.problem.sigma[RATES]

    def rows(self) -> RegressionRows:
        """Regressors, then the output: a row of unit noise for p, q and r at every sample, 0 if it was not measured."""
        return self._rows(jnp.where(jnp.isnan(self.rates), 0.0, self.rates))

    def rows_and_pullback(self) -> tuple[RegressionRows, Callable[[RegressionRows], Float[Array, "samples 3"]]]:
        """The rows, and a function that turns a derivative with respect to them into one with respect to the rates."""
        rows, back = jax.vjp(self._rows, jnp.where(jnp.isnan(self.rates), 0.0, self.rates))
        return rows, lambda slope: back(slope)[0]

    def _rows(self, rates: Float[Array, "samples 3"]) -> RegressionRows:
        """The rows with other values of the measured rates; the same samples are missing."""
        measured, (filled, known) = ~jnp.isnan(self.rates), self._fill(rates)
        # An increment that depends on an unknown rate is NaN. Both in one call, so that the model is traced once.
        marked = jnp.where(known, jax.lax.stop_gradient(filled), jnp.nan)
        increments, of_known = self._increments(jnp.stack([filled, marked]))
        usable = ~jnp.isnan(of_known).any(axis=-1)
        if self.problem.flight.stretch is not None:
            usable &= (jnp.diff(self.problem.flight.stretch, append=-1) == 0)[:, None]
        increments = jnp.where(usable[..., None], increments, 0.0)
        output = filled / self.sigma
        forgetting = self.settings.forgetting
        decay = self.settings.memory * forgetting

        def step(carry, sample):
            integral, mean, count = carry
            increment, usable, output, measured = sample
            row = integral.at[:, -1].add(output)
            deviation, weight = row - mean, forgetting * count
            scale = jnp.sqrt(1 / (1 + 1 / weight))
            mean = jnp.where(measured[:, None], mean + deviation / (1 + decay * count)[:, None], mean)
            count = jnp.where(usable, decay * count + measured, 0.0)
            integral = jnp.where(usable[:, None], integral + increment, 0.0)
            return (integral, mean, count), jnp.where(measured[:, None], scale[:, None] * deviation, 0.0)

        exact = jnp.where(decay < 1, 1.0, jnp.inf)
        first = jnp.where(jnp.isnan(self.anchor), 0.0, self.anchor) / self.sigma
        zero = jnp.zeros_like(increments[0])
        start = (zero, zero.at[:, -1].set(first), jnp.where(self.anchored, exact, 0.0) * jnp.ones(3))
        return jax.lax.scan(step, start, (increments, usable, output, measured))[1]

    def _fill(self, rates) -> tuple[Float[Array, "samples 3"], Bool[Array, "samples 3"]]:
        """Rates with short gaps bridged by straight lines and other gaps set to 0, and which values are known."""
        samples = jnp.arange(rates.shape[0])[:, None]
        first = (samples == 0) & self.anchored
        rates = jnp.where(first, self.anchor, rates)
        given = ~jnp.isnan(self.rates) | first
        last = jax.lax.cummax(jnp.where(given, samples, -1), axis=0)
        following = jax.lax.cummin(jnp.where(given, samples, rates.shape[0]), axis=0, reverse=True)
        known = given | ((last >= 0) & (following < rates.shape[0]) & (following - last - 1 <= self.settings.bridge))
        finite = jnp.where(given, rates, 0.0)
        before = jnp.take_along_axis(finite, jnp.maximum(last, 0), axis=0)
        after = jnp.take_along_axis(finite, jnp.minimum(following, rates.shape[0] - 1), axis=0)
        share = (samples - last) / jnp.maximum(following - last, 1)
        return jnp.where(known, before + share * (after - before), 0.0), known

    def _increments(self, rates: Float[Array, "series samples 3"]) -> Float[Array, "series samples 3 columns"]:
        """The step of each integral from t_k to t_{k+1}: of the regressors, and of minus the center's acceleration.

        The input of row k acts from t_k to t_{k+1}. Forward Euler uses the rates at t_k; any other method uses the mean
        of both ends (the trapezoidal rule), with an error of the order T^2.
        """
        model, sigma, dt = self.problem.model, self.sigma, self.problem.flight.dt
        center, half_width = self.center, self.half_width

        def acceleration(steps, rates, forcing):
            found = jnp.stack(model.angular_acceleration(Rates(*rates), forcing, center + half_width * steps)) * dt
            return found, found

        def at(rates, forcing):
            regressors, offset = jax.jacfwd(acceleration, has_aux=True)(jnp.zeros_like(center), rates, forcing)
            return jnp.concatenate([regressors, -offset[:, None]], axis=-1) / sigma[:, None]

        forcing = jax.tree.map(lambda leaf: leaf[:-1], self.problem.forcing(center))
        ends = rates[None, :, :-1] if self.problem.method == "euler" else jnp.stack([rates[:, :-1], rates[:, 1:]])
        of_series = jax.vmap(jax.vmap(jax.vmap(at), in_axes=(0, None)), in_axes=(0, None))
        return jnp.pad(of_series(ends, forcing).mean(axis=0), ((0, 0), (0, 1), (0, 0), (0, 0)))

    def covariance(
        self,
        rows: RegressionRows,
        back: Callable[[RegressionRows], Float[Array, "samples 3"]],
        steps: Parameters,
        inverse: Matrix,
    ) -> Matrix:
        """The covariance of the solution `steps` from white noise in the measured rates, to first order.

        The solution satisfies g(Y) = X(Y)^T (y(Y) - X(Y) steps) = 0. The derivative of g with respect to each measured
        rate carries the noise through both the regressors and the outputs. So errors in variables are included, and the
        result holds for coloured differences and any weights. The bias, a second-order effect of the noise, is not
        included.
        """
        age = jnp.arange(rows.shape[0])[::-1]
        weight = (self.settings.forgetting**age)[:, None, None]
        regressors, output = rows[..., :-1], rows[..., -1]
        residuals = output - (regressors * steps).sum(axis=-1)

        def sensitivity_of(one: Parameters) -> Float[Array, "samples 3"]:
            """The derivative of one element of g; `one` is 1 at the element."""
            regressor = (regressors * one).sum(axis=-1)[..., None]
            by_regressors = residuals[..., None] * one - regressor * steps
            return back(weight * jnp.concatenate([by_regressors, regressor], axis=-1))

        count = steps.shape[0]
        sensitivity = (jax.vmap(sensitivity_of)(jnp.eye(count, dtype=float)) * self.sigma).reshape(count, -1)
        spread = gram(sensitivity) + _prior(count)
        half = (inverse[:, :, None] * spread[None, :, :]).sum(axis=1)
        covariance = (half[:, :, None] * inverse[None, :, :]).sum(axis=1)
        return (covariance + covariance.T) / 2

    def answer(
        self, steps: Parameters, covariance: Matrix, history: Float[Array, "samples parameters"] | None = None
    ) -> Estimate:
        """A solution as an estimate, with the initial state and the cost of a simulation.

        A parameter that is not identifiable can have any value. If the flight cannot be simulated with it, the estimate
        is the bracket's center. `history`: the solution after each sample, in half-widths from the center.
        """
        problem, center, half_width = self.problem, self.center, self.half_width
        history = None if history is None else center + half_width * history
        parameters = center + half_width * steps if history is None else history[-1]
        covariance = half_width[:, None] * covariance * half_width[None, :]
        identifiable = problem.unknowns.usable.identifiable(jnp.sqrt(jnp.diagonal(covariance))).all()
        initial_state, _, _, rollouts = fit_start(problem, parameters)
        choices = (parameters, initial_state), (center, problem.first_state()[0])
        choices = jax.tree.map(lambda *each: jnp.stack(each), *choices)
        # In sequence, so that the simulation is compiled once.
        costs, feasible = jax.lax.map(lambda choice: problem.shots(*choice), choices)
        flies = feasible[0] & jnp.isfinite(costs[0])
        (parameters, initial_state), cost, feasible = jax.tree.map(
            lambda both: jnp.where(identifiable | flies, *both), (choices, costs, feasible)
        )
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=covariance,
            initial_state=initial_state,
            cost=cost,
            rollouts=rollouts + 1,
            sweeps=1,
            feasible=feasible,
            done=jnp.ones((), dtype=bool),
            history=history,
        )


def normal_equations(rows: Float[Array, "*rows columns"]) -> tuple[Matrix, Float[Array, " parameters"]]:
    """X^T X and X^T y of rows [X, y]. Plain sums give the same digits for one flight and for a batch.

    Pooled logs, which are no batch, have so many columns that the products of plain sums would not fit into memory.
    """
    rows = rows.reshape(-1, rows.shape[-1])
    regressors, output = rows[:, :-1], rows[:, -1]
    if regressors.shape[1] > _MANY:
        information = regressors.T @ regressors
    else:
        information = (regressors[:, :, None] * regressors[:, None, :]).sum(axis=0)
    return information, (regressors * output[:, None]).sum(axis=0)


def solve(information: Matrix, moment: Float[Array, " parameters"]) -> tuple[Float[Array, " parameters"], Matrix]:
    """The least-squares solution under the diffuse prior, and the inverse of the normal matrix."""
    inverse = invert(information + _prior(moment.shape[0]))
    return (inverse * moment).sum(axis=-1), inverse


def _prior(count: int) -> Matrix:
    return jnp.eye(count, dtype=float) / DIFFUSE**2


class EquationError(AbstractEstimator):
    """Least squares of differentiated body rates on the regressors of the rate equations, in one step.

    The rate equations must be linear in the parameters: their derivatives at the measured rates are the regressors.
    Only the body rates are used; the cost counts all channels. A free initial state is fitted to the parameters
    afterwards.

    - `memory`: how the rates are differentiated, from 0 to 1: the mean of the earlier samples is subtracted, where a
      sample weighs `memory` times its successor. 0: forward differences (ordinary least squares); 1: the integrated
      regression, generalised least squares for white noise of the rates.
    - `bridge`: a gap of up to this many samples in a rate is bridged by a straight line in the regressors. A longer gap
      splits the integration in two.

    A known initial state is exact if `memory` is 1, and counts as one more sample otherwise. Without noise the answer
    is exact for forward Euler; for another `method` the trapezoidal rule leaves a small error. The covariance includes
    the white noise of `sigma` in regressors and outputs, to first order, but neither the bias nor forces that the model
    lacks. If a rate was not measured, the result is `unidentifiable`.

    References: Klein and Morelli, Aircraft System Identification, ch. 5; Jategaonkar, Flight Vehicle System
    Identification, ch. 6; Ljung, System Identification, section 7.3.
    """

    looks_at: ClassVar[str] = "rates"

    forgetting: ClassVar[float] = 1.0
    memory: Scalar = eqx.field(converter=setting("memory", high=1.0), default=1.0)
    bridge: Count = eqx.field(converter=integer("bridge", 0), default=4)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises `ValueError` for a wrong bracket, or free parameters that are not linear."""
        mask, parameters = problem.unknowns.free, problem.model.parameters
        free = np.ones(len(parameters), dtype=bool) if isinstance(mask, Tracer) else np.asarray(mask)
        if any(each.in_forcing for each, searched in zip(parameters, free, strict=True) if searched):
            raise ValueError(
                "`problem.model` must have rate equations that are linear in its parameters for a regression: hold the "
                "others, or use an estimator that shoots."
            )
        return in_one_program(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        data = Regression.of(problem, self)
        rows, back = data.rows_and_pullback()
        steps, inverse = solve(*normal_equations(rows))
        return data.answer(steps, data.covariance(rows, back, steps, inverse))

    @eqx.filter_jit
    def solution(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Parameters:
        """The least-squares solution alone. Parameters in which the equations are not linear stay at their center."""
        data = Regression.of(problem.within(bracket), self)
        return data.center + data.half_width * solve(*normal_equations(data.rows()))[0]


class RecursiveLeastSquares(AbstractEstimator):
    """The regression of `EquationError`, updated at every sample with one row for each of p, q and r.

    The recursion carries the normal matrix and its right-hand side. A parameter stays at the bracket's center until it
    is excited.

    - `forgetting`: the weight of a sample relative to its successor, above 0 and up to 1: the estimate describes about
      the last 1 / (1 - forgetting) samples. With 1 the last estimate equals that of `EquationError`.
    - `memory`, `bridge`: as in `EquationError`. With a `forgetting` below 1 a known initial state counts like one
      sample.

    `history` holds the parameters after each sample; rows inside a bridged gap are known only after the gap. The
    covariance is that of the last estimate, without its lag behind parameters that change.

    Reference: Ljung, System Identification, section 11.2, with exponential forgetting.
    """

    looks_at: ClassVar[str] = "rates"

    forgetting: Scalar = eqx.field(converter=setting("forgetting", high=1.0, positive=True), default=1.0)
    memory: Scalar = eqx.field(converter=setting("memory", high=1.0), default=1.0)
    bridge: Count = eqx.field(converter=integer("bridge", 0), default=4)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises `ValueError` as `recursively` does."""
        return recursively(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        count, data = problem.unknowns.count, Regression.of(problem, self)
        rows, back = data.rows_and_pullback()

        def update(carry, row):
            added, (information, moment, _) = normal_equations(row), carry
            carry = self.forgetting * information + added[0], self.forgetting * moment + added[1]
            steps, inverse = solve(*carry)
            return (*carry, inverse), steps

        zero = jnp.zeros((count, count), dtype=float)
        (*_, inverse), steps = jax.lax.scan(update, (zero, jnp.zeros(count, dtype=float), zero), rows)
        return data.answer(steps[-1], data.covariance(rows, back, steps[-1], inverse), steps)
