"""Smooth Variable Structure Filter: body rates measured, parameters behind them.

With e what a measurement of the rates differs by from its prediction, and w = Phi12^+ e the change of the parameters
that would have made the prediction right, both states are corrected element by element by

    rates:       (|e| + gamma |e_before|) sat(e / psi_rates)
    parameters:  (|w| + gamma |w|) sat(w / psi_parameters)

where e_before is what the last correction left of its e. This is Habibi's filter for fewer measurements than states:
Phi12 is the derivative of the rates in the parameters, and Phi22 = 1, because parameters stand still. He divides by e
and multiplies by it again; here neither is done, so that e = 0 is no case of its own.
"""

from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from .._custom_types import Parameters, as_float
from ..bracket import GAUSSIAN_PRIOR, Bracket
from ..estimate import (
    REACH,
    AbstractEstimator,
    Estimate,
    check_bracket,
    check_one_window,
    conclude,
    fit_start,
)
from ..linalg import invert
from ..models.state import CASCADE_ORDER, stack, unstack
from ..shooting import Rows, ShootingProblem

# The share of the last pass over which the parameters are averaged.
_AVERAGED = 0.5


class _Filter(NamedTuple):
    """Rates and parameters, the latter in half-widths from the bracket's center, before a measurement.

    - `left`: size of the error that the last correction left.
    - `influence`: Phi12, of the rates in the parameters.
    - `energy`: of the influence of each parameter so far, over this many `samples`.
    - `covariance`: of the errors of rates, parameters, and the parameters' average.
    """

    rates: Float[Array, "3"]
    parameters: Parameters
    left: Float[Array, "3"]
    influence: Float[Array, "3 parameters"]
    energy: Float[Array, " parameters"]
    samples: Float[Array, ""]
    covariance: Float[Array, "joint joint"]


class SVSF(AbstractEstimator):
    """Smooth Variable Structure Filter of the body rates and the parameters.

    **Arguments:**

    - `gamma`: how fast errors outside the boundary layers die out, 0 <= gamma < 1; 0 is at once.
    - `rates_layer`: the boundary layer of the rates, in multiples of the problem's sigma.
    - `parameter_layer`: that of the parameters, in multiples of what noise of one sample makes w. A layer in
      half-widths would need a width of its own for each level of noise.
    - `damping`: of the pseudo-inverse, in multiples of a parameter's root mean square influence. Phi12 passes through 0
      with the torques and the rates, and maps 3 errors onto more parameters: undamped, w is noise.
    - `equilibration`: the pseudo-inverse has least norm in half-widths, times up to this factor for parameters with
      less influence than the greatest. With 1 the gyroscopic terms hardly leave the bracket's center.
    - `passes`: over the flight; the parameters go on where the last pass left them, as in the iterative SVSF.
    - `memory`: whether Phi12 is the derivative of a prediction through all corrections before it, or of one step alone,
      as Habibi has it. Errors of a step are small against the noise, and what they add up to is not.

    The answer is the mean of the parameters over the second half of the last pass, and `history` holds the parameters
    of that pass, unaveraged. Only the rates are looked at, whatever the problem's channels. A
    free initial state is not filtered for: each pass begins from the first measurements, and forgets them slowly; what
    is returned is fitted to the parameters at the end.

    The method gives no covariance. Ours is how errors propagate when each correction is replaced by its slope: from
    the bracket's half-widths, in the manner of Gadsden and Habibi 2010, it counts what is left of the start as well
    as the noise, but not that all passes see the same noise. Its 95 % intervals held the truth in 81 to 98 % of 64
    flights, by parameter: it is right as to size, and no more.

    Defaults were tuned on 64 noisy standard flights at a tenth, one and ten times the sensors' noise. On 64 others the
    errors were 1.1 to 1.9 times the Cramer-Rao bound of the rates at all three, and 1.1 to 2.1 times on the corrected
    model; 1.1 to 4.6 times where the initial state is free. With `memory` off and settings tuned for that, they
    were 1.5 to 11 times the bound; with `equilibration` at 1, 2 to 28 times. One pass does not get far enough to
    tell the parameters better than their bracket; 8 passes bring nothing more. With
    gamma 0.1 nothing changes, with 0.5 errors are up to 1.5 times as large.

    A pass carries a tangent for each rate and parameter, and counts as that many rollouts and one.

    Reference: Habibi 2007, Proc. IEEE 95(5), 1026-1059; Al-Shabi and Habibi 2011, ISRN Signal Processing 725108, for
    the idea of iterating it.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = GAUSSIAN_PRIOR
    needs_network: ClassVar[bool] = False

    gamma: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)
    rates_layer: Float[Array, ""] = eqx.field(converter=as_float, default=110.0)
    parameter_layer: Float[Array, ""] = eqx.field(converter=as_float, default=50.0)
    damping: Float[Array, ""] = eqx.field(converter=as_float, default=3.0)
    equilibration: Float[Array, ""] = eqx.field(converter=as_float, default=150.0)
    passes: int = eqx.field(static=True, default=4)
    memory: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        if not isinstance(self.passes, int) or self.passes < 1:
            raise ValueError(f"`passes` must be an integer of at least 1, got {self.passes!r}.")
        if not isinstance(self.gamma, Tracer) and not 0 <= self.gamma < 1:
            raise ValueError(f"`gamma` must be at least 0 and below 1, got {self.gamma}.")
        for name in ("rates_layer", "parameter_layer", "damping"):
            value = getattr(self, name)
            if not isinstance(value, Tracer) and not 0 < value < float("inf"):
                raise ValueError(f"`{name}` must be positive and finite, got {value}.")
        if not isinstance(self.equilibration, Tracer) and not 1 <= self.equilibration < float("inf"):
            raise ValueError(f"`equilibration` must be finite and at least 1, got {self.equilibration}.")

    @eqx.filter_jit
    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight.

        **Arguments:**

        - `problem`: what is filtered: its rates, whatever its channels; NaN is not measured.
        - `bracket`: where the filter begins, and the units of its settings.

        **Raises:** `ValueError` for a bracket of another length than the model's parameters, or a flight that
        is cut into windows.
        """
        check_bracket(problem, bracket)
        check_one_window(problem)
        box, rates = bracket.usable, problem.restrict("rates")
        rows, start = jax.tree.map(lambda leaf: leaf[0], rates.rows()), rates.first_state()
        count, samples = box.center.shape[0], rows.measured[0].shape[0]
        averaged = jnp.arange(samples) >= (1 - _AVERAGED) * samples
        shares = averaged / averaged.sum()
        # How far off a first state may be is three standard deviations of it.
        spread = jnp.concatenate([start[1] / 3, jnp.ones(count), jnp.zeros(count)])
        kept = (jnp.arange(spread.size) >= 3) & (jnp.arange(spread.size) < 3 + count)

        def again(previous: tuple[_Filter, Array], _) -> tuple[tuple[_Filter, Array], None]:
            """The rates begin anew, and so does the average; the parameters go on."""
            last = previous[0]
            covariance = jnp.where(kept[:, None] & kept, last.covariance, 0.0)
            covariance = covariance + jnp.diag(jnp.where(kept, 0.0, jnp.square(spread)))
            nothing = jnp.zeros_like(last.left), jnp.zeros_like(last.influence)
            return fly(_Filter(start[0], last.parameters, *nothing, last.energy, last.samples, covariance)), None

        def fly(begin: _Filter) -> tuple[_Filter, Array]:
            return jax.lax.scan(lambda f, row: self._step(rates, box, f, *row), begin, (rows, shares))

        first = fly(
            _Filter(
                rates=start[0],
                parameters=jnp.zeros(count, dtype=float),
                left=jnp.zeros(3, dtype=float),
                influence=jnp.zeros((3, count), dtype=float),
                energy=jnp.zeros(count, dtype=float),
                samples=jnp.zeros((), dtype=float),
                covariance=jnp.diag(jnp.square(spread)),
            )
        )
        (last, history), _ = jax.lax.scan(again, first, length=self.passes - 1)
        parameters = box.center + box.half_width * (shares[:, None] * history).sum(axis=0)
        initial_state, cost, sound, rollouts = fit_start(problem, parameters)
        return conclude(
            bracket,
            parameters=parameters,
            covariance=last.covariance[3 + count :, 3 + count :] * box.half_width[:, None] * box.half_width,
            initial_state=initial_state,
            cost=cost,
            rollouts=self.passes * (1 + 3 + count) + rollouts,
            sweeps=self.passes,
            sound=sound,
            prior=self.prior,
            done=jnp.ones((), dtype=bool),
            history=box.center + box.half_width * history,
        )

    def _step(
        self, problem: ShootingProblem, box: Bracket, before: _Filter, row: Rows, share: Float[Array, ""]
    ) -> tuple[_Filter, Parameters]:
        """One measurement and the prediction of the next; the parameters after the measurement."""
        rates, parameters, left, influence, energy, _, covariance = before
        sigma, count = problem.sigma[CASCADE_ORDER[:3]], parameters.shape[0]
        measured = jnp.stack(row.measured)
        here = ~jnp.isnan(measured)
        error = jnp.where(here, measured - rates, 0.0)

        # The pseudo-inverse, of least norm in units in which every parameter has had the same influence so far.
        energy = energy + jnp.square(jnp.where(here[:, None], influence, 0.0)).sum(axis=0)
        most, samples = energy.max(), before.samples + 1
        weakness = jnp.sqrt(most / jnp.where(energy > 0, energy, 1.0))
        unit = jnp.where(energy > 0, jnp.minimum(weakness, self.equilibration), self.equilibration)
        scaled = jnp.where(here[:, None], unit * influence, 0.0)
        damping = jnp.square(self.damping) * jnp.where(most > 0, most / samples, 1.0)
        gram = (scaled[:, None, :] * scaled[None, :, :]).sum(axis=-1) + damping * jnp.eye(3, dtype=float)
        inverse = (scaled[:, :, None] * invert(gram)[:, None, :]).sum(axis=0)
        change = (inverse * error).sum(axis=1)
        noise = jnp.sqrt(jnp.square(inverse * sigma).sum(axis=1))
        layer = self.parameter_layer * jnp.where(noise > 0, noise, 1.0)

        rate_gain, rate_slope = _gain(error, self.gamma * left, self.rates_layer * sigma)
        gain, slope = _gain(change, 0.0, layer)
        rates = rates + rate_gain * error
        parameters = jnp.clip(parameters + (1 + self.gamma) * unit * gain * change, -REACH, REACH)
        left = jnp.where(here, jnp.abs(measured - rates), left)

        def advance(x: Float[Array, "3"], u: Parameters) -> Float[Array, "3"]:
            return stack(problem.step(unstack(x), row.forcing, tuple(box.center + box.half_width * u)))

        following = advance(rates, parameters)
        by_rates, by_parameters = jax.jacfwd(advance, argnums=(0, 1))(rates, parameters)
        remembered = jnp.where(here, 1 - rate_gain, 1.0)[:, None] * influence
        influence = by_parameters + (_product(by_rates, remembered) if self.memory else 0.0)

        # How errors go on, and noise enters: by the slope of each correction at what it was given.
        correct = jnp.concatenate(
            [
                jnp.diag(jnp.where(here, rate_slope, 0.0)),
                ((1 + self.gamma) * unit * slope)[:, None] * inverse,
                jnp.zeros((count, 3), dtype=float),
            ]
        )
        identity = jnp.eye(3 + 2 * count, dtype=float)
        advanced = identity.at[:3, :3].set(by_rates).at[:3, 3 : 3 + count].set(by_parameters)
        advanced = advanced.at[3 + count :, 3 : 3 + count].set(share * jnp.eye(count, dtype=float))
        entering = _product(advanced, correct)
        passing = advanced.at[:, :3].add(-entering)
        covariance = _product(_product(passing, covariance), passing.T) + _product(
            jnp.square(sigma) * entering, entering.T
        )
        return _Filter(following, parameters, left, influence, energy, samples, covariance), parameters


def _gain(
    error: Float[Array, " n"], before: Float[Array, " n"] | float, layer: Float[Array, " n"]
) -> tuple[Float[Array, " n"], Float[Array, " n"]]:
    """K and d/d error of K error = (|error| + before) sat(error / layer)."""
    size = jnp.abs(error)
    outside = size > layer
    gain = (size + before) / jnp.where(outside, size, layer)
    return gain, jnp.where(outside, 1.0, (2 * size + before) / layer)


def _product(a: Float[Array, "m k"], b: Float[Array, "k n"]) -> Float[Array, "m n"]:
    return jnp.matmul(a, b, precision="highest")
