"""Smooth Variable Structure Filter: body rates are measured, parameters are not.

Let e be the measured minus the predicted rates, and w = Phi12^+ e the change of the parameters that would have made
the prediction right. The filter corrects rates and parameters element by element:

    rates:       |e| sat(e / psi_rates)
    parameters:  |w| sat(w / psi_parameters)

This is Habibi's filter for fewer measurements than states, with gamma = 0: Phi12 is the derivative of the rates with
respect to the parameters, and Phi22 = 1. Here Phi12 takes the derivative through all earlier corrections. In Habibi's
paper it is the derivative of one step alone, whose errors are small compared with the noise.
"""

import functools
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .._custom_types import Parameters, Scalar, integer, setting
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import REACH, AbstractEstimator, Estimate, as_estimate, fit_start, recursively
from ..flight import RATES
from ..linalg import gram, invert
from ..models.state import stack, unstack
from ..shooting import Rows, ShootingProblem, Unknowns

_AVERAGED = 0.5  # the share of the last pass over which the parameters are averaged


class _Filter(NamedTuple):
    """The filter before a measurement; parameters in half-widths from the bracket's center.

    - `influence`: Phi12, the derivative of the rates with respect to the parameters.
    - `energy`: the squared influence of each parameter, summed over `samples` so far.
    - `covariance`: of the errors of rates, parameters, and the parameters' average.
    """

    rates: Float[Array, "3"]
    parameters: Parameters
    influence: Float[Array, "3 parameters"]
    energy: Float[Array, " parameters"]
    samples: Float[Array, ""]
    covariance: Float[Array, "joint joint"]


class SVSF(AbstractEstimator):
    """Smooth Variable Structure Filter of the body rates and the parameters.

    - `rates_layer`: boundary layer of the rates, in multiples of the problem's sigma.
    - `parameter_layer`: boundary layer of the parameters, in multiples of the noise of w from one sample.
    - `damping`: of the pseudo-inverse, in multiples of a parameter's root mean square influence. Phi12 maps 3 errors
      onto more parameters, and passes through 0, so that without damping w is mostly noise.
    - `equilibration`: the pseudo-inverse has least norm in half-widths, multiplied by up to this factor for parameters
      with less influence than the greatest. With 1, the gyroscopic terms hardly move.
    - `passes`: number of passes over the flight. Each begins with the parameters of the pass before (iterative SVSF).

    The answer is the mean of the parameters over the second half of the last pass. `history` holds the parameters of
    that pass. Only the body rates are used. A free initial state is fitted at the end, with these parameters.

    The method gives no covariance. Ours propagates the errors through the slope of each correction (in the manner of
    Gadsden and Habibi 2010). Only its magnitude is right, because all passes see the same noise. A pass counts as one
    rollout for each rate and parameter, and one for the state.

    Reference: Habibi 2007, Proc. IEEE 95(5), 1026-1059; Al-Shabi and Habibi 2011, ISRN Signal Processing 725108, for
    the idea of iterating it.
    """

    looks_at: ClassVar[str] = "rates"
    largest_std: ClassVar[float] = GAUSSIAN_PRIOR

    rates_layer: Scalar = eqx.field(converter=setting("rates_layer", positive=True), default=110.0)
    parameter_layer: Scalar = eqx.field(converter=setting("parameter_layer", positive=True), default=50.0)
    damping: Scalar = eqx.field(converter=setting("damping", positive=True), default=3.0)
    equilibration: Scalar = eqx.field(converter=setting("equilibration", low=1.0), default=150.0)
    passes: int = eqx.field(static=True, converter=integer("passes", 1, static=True), default=4)

    def __call__(self, problem: ShootingProblem, bracket: Bracket | None = None) -> Estimate:
        """Identifies one flight. Raises `ValueError` as `recursively` does."""
        return recursively(self._identify, problem, bracket)

    def _identify(self, problem: ShootingProblem) -> Estimate:
        """One flight, or a block of flights."""
        box, rates = problem.unknowns.usable, problem.restrict("rates")
        rows, start = jax.tree.map(lambda leaf: leaf[0], rates.rows()), rates.first_state()
        count, samples = box.center.shape[0], rows.measured[0].shape[0]
        averaged = jnp.arange(samples) >= (1 - _AVERAGED) * samples
        shares = averaged / averaged.sum()
        # The second part of `first_state` is three standard deviations.
        spread = jnp.concatenate([start[1] / 3, jnp.ones(count), jnp.zeros(count)])
        kept = (jnp.arange(spread.size) >= 3) & (jnp.arange(spread.size) < 3 + count)
        anew = jnp.diag(jnp.where(kept, 0.0, jnp.square(spread)))
        at_center = _Filter(
            rates=start[0],
            parameters=jnp.zeros(count, dtype=float),
            influence=jnp.zeros((3, count), dtype=float),
            energy=jnp.zeros(count, dtype=float),
            samples=jnp.zeros((), dtype=float),
            covariance=jnp.diag(jnp.square(spread)),
        )

        def fly(previous: tuple[_Filter, Array], _) -> tuple[tuple[_Filter, Array], None]:
            """One pass: rates and average begin anew, the parameters do not."""
            last = previous[0]
            covariance = jnp.where(kept[:, None] & kept, last.covariance, 0.0) + anew
            kept_fields = {"parameters": last.parameters, "energy": last.energy, "samples": last.samples}
            begin = at_center._replace(**kept_fields, covariance=covariance)
            return jax.lax.scan(lambda f, row: self._step(rates, box, f, *row), begin, (rows, shares)), None

        none = jnp.zeros((samples, count), dtype=float)
        (last, history), _ = jax.lax.scan(fly, (at_center, none), length=self.passes)
        parameters = box.center + box.free_half_width * (shares[:, None] * history).sum(axis=0)
        initial_state, cost, feasible, rollouts = fit_start(problem, parameters)
        return as_estimate(
            problem,
            parameters=parameters,
            covariance=last.covariance[3 + count :, 3 + count :] * box.free_half_width[:, None] * box.free_half_width,
            initial_state=initial_state,
            cost=cost,
            rollouts=self.passes * (1 + 3 + count) + rollouts,
            sweeps=self.passes,
            feasible=feasible,
            largest_std=self.largest_std,
            done=jnp.ones((), dtype=bool),
            history=box.center + box.free_half_width * history,
        )

    def _step(
        self, problem: ShootingProblem, box: Unknowns, before: _Filter, row: Rows, share: Float[Array, ""]
    ) -> tuple[_Filter, Parameters]:
        """Corrects with one measurement and predicts the next; returns the parameters after the correction too."""
        rates, parameters, influence, energy, _, covariance = before
        sigma, count = problem.sigma[RATES], parameters.shape[0]
        measured = jnp.stack(row.measured)
        valid = ~jnp.isnan(measured)
        error = jnp.where(valid, measured - rates, 0.0)

        # The pseudo-inverse has least norm in units in which all parameters had the same influence so far.
        energy = energy + jnp.square(jnp.where(valid[:, None], influence, 0.0)).sum(axis=0)
        most, samples = energy.max(), before.samples + 1
        weakness = jnp.sqrt(most / jnp.where(energy > 0, energy, 1.0))
        unit = jnp.where(energy > 0, jnp.minimum(weakness, self.equilibration), self.equilibration)
        scaled = jnp.where(valid[:, None], unit * influence, 0.0)
        damping = jnp.square(self.damping) * jnp.where(most > 0, most / samples, 1.0)
        damped = gram(scaled) + damping * jnp.eye(3, dtype=float)
        inverse = (scaled[:, :, None] * invert(damped)[:, None, :]).sum(axis=0)
        change = (inverse * error).sum(axis=1)
        noise = jnp.sqrt(jnp.square(inverse * sigma).sum(axis=1))
        layer = self.parameter_layer * jnp.where(noise > 0, noise, 1.0)

        rate_gain, rate_slope = _gain(error, self.rates_layer * sigma)
        gain, slope = _gain(change, layer)
        rates = rates + rate_gain * error
        parameters = jnp.clip(parameters + unit * gain * change, -REACH, REACH)

        def advance(x: Float[Array, "3"], u: Parameters) -> Float[Array, "3"]:
            return stack(problem.advance(row.forcing, unstack(x), tuple(box.center + box.free_half_width * u))[0])

        following = advance(rates, parameters)
        by_rates, by_parameters = jax.jacfwd(advance, argnums=(0, 1))(rates, parameters)
        remembered = jnp.where(valid, 1 - rate_gain, 1.0)[:, None] * influence
        influence = by_parameters + _product(by_rates, remembered)

        # Errors and noise pass through the slope of each correction.
        correct_rates = jnp.diag(jnp.where(valid, rate_slope, 0.0))
        correct_parameters = (unit * slope)[:, None] * inverse
        correct = jnp.concatenate([correct_rates, correct_parameters, jnp.zeros((count, 3), dtype=float)])
        identity = jnp.eye(3 + 2 * count, dtype=float)
        advanced = identity.at[:3, :3].set(by_rates).at[:3, 3 : 3 + count].set(by_parameters)
        advanced = advanced.at[3 + count :, 3 : 3 + count].set(share * jnp.eye(count, dtype=float))
        entering = _product(advanced, correct)
        passing = advanced.at[:, :3].add(-entering)
        added = _product(jnp.square(sigma) * entering, entering.T)
        covariance = _product(_product(passing, covariance), passing.T) + added
        return _Filter(following, parameters, influence, energy, samples, covariance), parameters


def _gain(error: Float[Array, " n"], layer: Float[Array, " n"]) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """K and d/d error of K error = |error| sat(error / layer)."""
    share = jnp.abs(error) / layer
    return jnp.minimum(share, 1.0), jnp.where(share > 1, 1.0, 2 * share)


_product = functools.partial(jnp.matmul, precision="highest")
