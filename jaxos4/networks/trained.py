"""A trained network as an estimator, and the check that a problem is one that it was trained for."""

from typing import TYPE_CHECKING, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, UInt32

from .._custom_types import Scalar, as_float
from ..bracket import UNIFORM_PRIOR, Bracket
from ..estimate import AbstractEstimator, Calibration, Estimate
from ..flight import STATE_NAMES
from ..models.state import CASCADE_ORDER, CHANNELS
from ..results import RESULTS
from ..shooting import ShootingProblem
from .architecture import Regressor, Scaling
from .calibration import LEVELS, ErrorTable
from .features import AbstractFeatures

if TYPE_CHECKING:
    from .estimator import NetworkEstimator

_LARGEST_INFLATION = 2.0  # if missing samples enlarge a standard deviation by more, the problem is another one
_SAME = 1e-6  # relative tolerance of equal numbers: files round them


class TrainedNetwork(AbstractEstimator):
    """A network that identifies flights of the inputs that it was trained for. Made by `NetworkEstimator.fit`.

    Its intervals contain the truth in the share of flights that their level gives, even if the network is bad. They
    are calibrated on simulated flights that training did not use (split-conformal prediction). The share is an average
    over flights that do not diverge, with parameters and initial states uniform in the bracket of training. It is exact
    at nine noise scales and interpolated between them.
    """

    looks_at: ClassVar[str] = "rates"
    shoots: ClassVar[bool] = False
    prior: ClassVar[float] = UNIFORM_PRIOR
    needs_network: ClassVar[bool] = True

    settings: "NetworkEstimator"
    features: AbstractFeatures
    scaling: Scaling
    regressor: Regressor
    errors: ErrorTable
    history: Float[Array, "checks 2"]
    key: UInt32[Array, "..."]

    @property
    def channels(self) -> str:
        """The channels that the network looks at."""
        return self.settings.channels

    @property
    def problem(self) -> ShootingProblem:
        """The problem of training."""
        return self.features.problem

    @property
    def bracket(self) -> Bracket:
        """The bracket of training."""
        count = len(self.problem.model.parameter_names)
        return Bracket.around(self.features.coordinates.center[:count], self.features.coordinates.width[:count])

    def __call__(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        """Identifies one flight. The network looks in its own bracket; `bracket` must only be valid.

        **Returns:** an estimate, whose result is `at_bound` if the answer lies outside the bracket of training by more
        than its interval, `unidentifiable` if the interval of a parameter is hardly narrower than the bracket, and
        `network_mismatch` if the flight has more noise than in training, or too many missing samples.

        **Raises:** `ValueError` if the network was trained for another problem, with what differs. Inside `jit` or
        `vmap`, numbers that differ give the result `network_mismatch` instead.
        """
        difference = self.mismatch(problem)
        if difference is not None:
            raise ValueError(f"The network cannot be used on this problem: {difference}; train a network for it.")
        return self._identify(problem.restrict(self.channels), bracket)

    def mismatch(self, problem: ShootingProblem) -> str | None:
        """How a problem differs from the problem of training, in words; `None` if it does not.

        Inside `jit` or `vmap` numbers cannot be compared here; `__call__` compares them there.
        """
        own = self.problem
        if CHANNELS[self.channels] > problem.size:
            return f"it looks at {self.channels!r} channels, and the problem has {problem.channels!r}"
        if type(problem.model) is not type(own.model):
            return f"it was trained for {type(own.model).__name__}, not {type(problem.model).__name__}"
        if problem.method != own.method:
            return f"it was trained with the method {own.method!r}, not {problem.method!r}"
        if problem.flight.omega.shape != own.flight.omega.shape:
            return f"it was trained for {own.flight.omega.shape[0]} samples, not {problem.flight.omega.shape[0]}"
        if problem.windows != own.windows:
            return f"it was trained for {own.windows} windows, not {problem.windows}"
        if (problem.initial_state is None) != (own.initial_state is None):
            return "it was trained for an initial state that is " + ("free" if own.initial_state is None else "known")
        if not isinstance(problem.flight.states, Tracer):
            absent, not_needed = (np.isnan(np.asarray(p.flight.states)) for p in (problem, own))
            looked_at = [i for i in CASCADE_ORDER[: own.size] if not not_needed[:, i].all()]
            missing = [STATE_NAMES[i] for i in looked_at if absent[:, i].all()]
            if missing:
                return f"it looks at {', '.join(missing)}, which this flight did not measure"
        for what, differs in self._differences(problem).items():
            if not isinstance(differs, Tracer) and bool(differs):
                return f"it was trained for another {what}"
        return None

    @eqx.filter_jit
    def _differences(self, problem: ShootingProblem) -> dict[str, Bool[Array, ""]]:
        """For each quantity, whether its numbers differ from those of training."""
        own, size = self.problem, CHANNELS[self.channels]

        def differ(a, b, tolerance) -> Bool[Array, ""]:
            a, b = as_float(a), as_float(b)
            return ~((a == b) | (jnp.abs(a - b) <= tolerance)).all()

        fastest = jnp.abs(own.flight.omega).max()
        constants, own_constants = (jax.tree.leaves(p.model.airframe) for p in (problem, own))
        airframe = [differ(a, b, _SAME * jnp.abs(b).max()) for a, b in zip(constants, own_constants, strict=True)]
        width = self.features.coordinates.width[len(own.model.parameter_names) :]
        first_state, off = (problem.split(x)[:, :size].ravel() for x in problem.first_state())
        own_start = self.features.coordinates.first_state
        allowed = 1.5 * width + off if width.size else _SAME * (1 + jnp.abs(own_start))
        return {
            "airframe": jnp.stack(airframe).any(),
            "sample time": differ(problem.flight.dt, own.flight.dt, _SAME * own.flight.dt),
            "series of rotor speeds": differ(problem.flight.omega, own.flight.omega, _SAME * fastest),
            "start": ~(jnp.abs(first_state - own_start) <= allowed).all(),
        }

    @eqx.filter_jit
    def _identify(self, problem: ShootingProblem, bracket: Bracket) -> Estimate:
        count, coordinates = len(problem.model.parameter_names), self.features.coordinates
        scale = self._scale(problem)
        within = jnp.clip(scale, *self.settings.noise)
        features = self.features(problem)
        finite = jnp.isfinite(features.values).all()
        output = self.regressor(jnp.where(finite, features.values, 0.0), within, self.scaling)
        parameters, initial_state = coordinates.split(output.u, count)

        rms, correlation, factors, simultaneous = self.errors.at(within)
        std = jnp.exp(output.log_spread[:count]) * self.scaling.bound(within)[:count] * rms * features.inflation
        deviations = std * coordinates.width[:count]
        shot = problem.shots(parameters, initial_state)
        outside = jnp.abs(output.u[:count]) > 1 + factors[-1] * std
        unidentifiable = std > self.prior

        other = jnp.stack(list(self._differences(problem).values())).any()
        other |= (features.inflation > _LARGEST_INFLATION).any() | (scale > self.settings.noise[1] * (1 + _SAME))
        result = RESULTS.where(outside.any(), RESULTS.at_bound, RESULTS.successful)
        result = RESULTS.where(unidentifiable.any(), RESULTS.unidentifiable, result)
        sound = finite & shot.sound & jnp.isfinite(parameters).all()
        result = RESULTS.where(sound, result, RESULTS.nonfinite_trajectory)
        result = RESULTS.where(other, RESULTS.network_mismatch, result)
        result = RESULTS.where(bracket.valid, result, RESULTS.bracket_invalid)
        usable = sound & ~other & bracket.valid
        return Estimate(
            parameters=jnp.where(usable, parameters, self.bracket.center),
            covariance=jnp.where(usable, correlation * deviations[:, None] * deviations[None, :], jnp.inf),
            initial_state=jnp.where(jnp.isfinite(initial_state), initial_state, 0.0),
            cost=jnp.where(usable, shot.cost, jnp.inf),
            rollouts=jnp.ones((), dtype=int),
            sweeps=jnp.zeros((), dtype=int),
            result=result,
            calibration=Calibration(as_float(LEVELS), factors, simultaneous),
        )

    def _scale(self, problem: ShootingProblem) -> Scalar:
        """The problem's noise in multiples of that of training; the largest over the channels."""
        order = CASCADE_ORDER[: CHANNELS[self.channels]]
        return (problem.sigma[order] / self.problem.sigma[order]).max()
