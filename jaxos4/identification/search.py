"""The search of a vehicle's likelihood: of all parameters, then without those that the flights do not show.

The noise is among the unknowns of this likelihood. All searches return an `Optimum`.
"""

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Float

from ..estimate import AbstractEstimator, Estimate
from ..models.abstract import Parameter
from ..results import has_answer, result_names
from ..shooting import InnovationsProblem, Parts, Unknowns
from ..shooting.gains import LogNoise
from .data import Data, Progress, silent
from .results import Disturbance

NEGATIVE = 2.0  # standard deviations below 0 from which a parameter that must not be negative is fixed at 0
NEAR_NOMINAL = 12.0  # standard deviations; further from its nominal value, a parameter is never tried there
# Parameters near their nominal values are fixed there unless that raises the cost, prior included, by more: near a
# nominal value, a cost with kinks is not quadratic, and standard deviations are too small.
MAX_RISE = 5.0
LOWER = 0.1  # a cost that is lower by more belongs to another minimum
# The usual delay [s] of measured speeds, and of commands. The cost has a minimum in the delay for each row of the log.
USUAL_DELAY, USUAL_DELAY_OF_COMMANDS = 0.0, 0.002

Search = Callable[[InnovationsProblem], Estimate]


class Optimum(NamedTuple):
    """The optimum that a search found with the likelihood of innovations.

    - `data`: of the search. `likelihood`: theirs, with some parameters fixed.
    - `estimate`: of all its unknowns, with the covariance of the search.
    - `unrestricted`, `parameter_unknowns`: the estimate, and the unknowns that are parameters, before any was fixed.
    - `rollouts`: of all searches together.
    - `nominal`: the parameters that are fixed at their nominal values.
    - `negative`: value and standard deviation of those that came out negative, and are fixed at 0.
    - `freed`: the covariance that these would add if they were free.
    - `compared_delay`: of the rotors [s], where the search stayed after a comparison with their usual delay.
    - `restarts`: how often a search began again where the cost is lower. `is_lowest`: false if the cost is known to be
      lower elsewhere.
    """

    data: Data[InnovationsProblem]
    likelihood: InnovationsProblem
    estimate: Estimate
    unrestricted: Estimate
    parameter_unknowns: Unknowns
    rollouts: int
    nominal: tuple[str, ...] = ()
    negative: dict[str, tuple[float, float]] = {}
    freed: Float[ArrayLike, "..."] = 0.0
    compared_delay: float | None = None
    restarts: int = 0
    is_lowest: bool = True

    @property
    def converged(self) -> bool:
        """Whether the search ended at a minimum."""
        return str(result_names(self.estimate.result)) == "successful"

    @property
    def values(self) -> Float[np.ndarray, " unknowns"]:
        """The values of all unknowns: the parameters, then those of the noise and the feedthroughs."""
        return np.asarray(self.estimate.parameters)

    @property
    def covariance(self) -> Float[np.ndarray, "unknowns unknowns"]:
        """The covariance of all unknowns, for a right model and a quadratic cost. Allows for negative estimates."""
        return np.asarray(self.estimate.covariance) + np.asarray(self.freed)

    @property
    def std(self) -> Float[np.ndarray, " parameters"]:
        """Standard deviations of the parameters, by `covariance`."""
        return deviations(self.covariance)[: self.parameter_unknowns.count]

    @property
    def cost(self) -> float:
        """The cost with that of all brackets, which are Gaussian priors, also of parameters that are fixed."""
        own = self.likelihood.problem.unknowns
        fixed = ~np.asarray(own.free)
        off = (np.asarray(own.center) - np.asarray(self.parameter_unknowns.center)) / np.asarray(
            self.parameter_unknowns.half_width
        )
        return float(self.estimate.cost) + float(np.square(off[fixed]).sum()) / 2

    @property
    def noise(self) -> LogNoise:
        """The noise of each channel."""
        return self.likelihood.noise(self.values)

    @property
    def by_segment(self) -> Parts:
        """The likelihood of each segment, at the estimate."""
        if self.estimate.parts is None:
            raise ValueError("`estimator` must return the `parts` of the likelihood.")
        return self.estimate.parts

    def restricted(
        self,
        estimator: Search,
        values: Mapping[str, float],
        start: Float[np.ndarray, " unknowns"] | None = None,
    ) -> "Optimum":
        """Another search with some parameters fixed. `start`: where it starts; by default at this optimum."""
        fixed = self.likelihood.fix({name: np.asarray(value) for name, value in values.items()})
        likelihood = fixed.starting_from(self.values if start is None else start)
        found = jax.block_until_ready(estimator(likelihood))
        return self._replace(likelihood=likelihood, estimate=found, rollouts=self.rollouts + int(found.rollouts))


def search(
    estimator: AbstractEstimator,
    data: Data[InnovationsProblem],
    *,
    start: Float[np.ndarray, " unknowns"] | None = None,
    first: Optimum | None = None,
    compared_delay: float | None = None,
    progress: Progress = silent,
) -> Optimum:
    """The optimum without the parameters that came out negative, or near their nominal values.

    **Arguments:** `start`: see `search_all`. `first`: the result of `search_all`, if it is known. `compared_delay`:
    that of the optimum for longer samples.
    """
    first = search_all(estimator, data, start=start) if first is None else first
    usual = USUAL_DELAY_OF_COMMANDS if data.follows_commands else USUAL_DELAY
    optimum = _lowest_in_delay(estimator, first, usual, compared_delay, progress)
    counted = optimum.by_segment.noise_feedthrough
    optimum = optimum._replace(likelihood=optimum.likelihood.with_noise_feedthrough(counted))
    optimum = _without_negative(estimator, optimum, progress)
    return _at_nominal_values(estimator, optimum, progress)


def search_all(
    estimator: Search, data: Data[InnovationsProblem], *, start: Float[np.ndarray, " unknowns"] | None = None
) -> Optimum:
    """The optimum of all parameters.

    `start`: where the search starts; by default, or without an answer from there, at the likelihood's.
    """
    likelihood, found, spent = data.likelihood, None, 0
    if start is not None:
        found = jax.block_until_ready(estimator(likelihood.starting_from(start)))
        spent = int(found.rollouts)
    if found is None or not has_answer(found.result):
        found = jax.block_until_ready(estimator(likelihood))
        spent += int(found.rollouts)
    return Optimum(data, likelihood, found, found, likelihood.problem.unknowns, spent)


def _lowest_in_delay(
    estimator: Search, first: Optimum, usual: float, compared: float | None = None, progress: Progress = silent
) -> Optimum:
    """The optimum, or a lower minimum near the `usual` delay of the rotors [s].

    A delay near the one that was `compared` for longer samples is not compared again. Minima are compared with what is
    negative in them at 0: at a wrong delay, a negative value can predict the noise of the gyro.
    """
    likelihood, found, names = first.likelihood, first.estimate, first.parameter_unknowns.names
    if likelihood.answers_within or "rotor_delay" not in names or not has_answer(found.result):
        return first
    delay, near_it = float(first.values[names.index("rotor_delay")]), float(likelihood.flight.dt) / 2
    if abs(delay - usual) <= near_it:
        return first
    if compared is not None and abs(delay - compared) <= near_it:
        return first._replace(compared_delay=compared)
    progress("fitting again near the usual delay of the rotors")
    at_usual = likelihood.fix({"rotor_delay": np.asarray(usual)})
    near = jax.block_until_ready(estimator(at_usual.starting_from(found.parameters)))
    spent = first.rollouts + int(near.rollouts)
    if not has_answer(near.result):
        return first._replace(rollouts=spent)
    other = jax.block_until_ready(estimator(likelihood.starting_from(near.parameters)))
    spent += int(other.rollouts)
    if has_answer(other.result):
        rival = first._replace(estimate=other, unrestricted=other, rollouts=spent)
        own, theirs = (_with_negative_at_zero(estimator, each) for each in (first, rival))
        spent = own.rollouts - first.rollouts + theirs.rollouts
        # A search with some parameters at 0 may itself end near the usual delay.
        margin = LOWER if own is first else -LOWER
        if own.cost - theirs.cost > margin:
            return rival._replace(rollouts=spent)
    return first._replace(compared_delay=delay, rollouts=spent)


def _with_negative_at_zero(estimator: Search, optimum: Optimum) -> Optimum:
    """The optimum with what is negative in it fixed at 0, if that leaves an answer."""
    negative = _negative(optimum)
    after = optimum.restricted(estimator, dict.fromkeys(negative, 0.0)) if negative else optimum
    return after if has_answer(after.estimate.result) else optimum._replace(rollouts=after.rollouts)


def _negative(optimum: Optimum) -> dict[str, tuple[float, float]]:
    """Value and standard deviation of the parameters that are negative, though physics forbids it."""
    return {row.name: (value, std) for row, value, std in _rows(optimum) if row.nonnegative and value < -NEGATIVE * std}


def _without_negative(estimator: Search, before: Optimum, progress: Progress) -> Optimum:
    """The parameters that are negative, though physics forbids it, fixed at 0, if that leaves an answer."""
    negative = _negative(before)
    if not negative or not before.converged:  # away from a minimum, signs and standard deviations mean nothing
        return before
    progress("fitting again without what came out negative")
    places = [before.parameter_unknowns.names.index(name) for name in negative]
    covariance = np.asarray(before.estimate.covariance)
    freed = covariance[:, places] @ np.linalg.pinv(covariance[np.ix_(places, places)]) @ covariance[places]
    after = _with_negative_at_zero(estimator, before)
    return after if after.estimate is before.estimate else after._replace(negative=negative, freed=freed)


def _at_nominal_values(estimator: Search, before: Optimum, progress: Progress) -> Optimum:
    """The parameters near their nominal values fixed there, unless that clearly raises the cost."""
    nominal = {
        row.name: row.nominal
        for row, value, std in _rows(before)
        if row.nominal is not None and std > 0 and abs(value - row.nominal) < NEAR_NOMINAL * std
    }
    if not nominal:
        return before
    progress("fitting again without what the flights hardly show")
    after = before.restricted(estimator, nominal)
    if has_answer(after.estimate.result) and after.cost - before.cost < MAX_RISE:
        return after._replace(nominal=tuple(nominal))
    return before._replace(rollouts=after.rollouts)


def _rows(optimum: Optimum) -> list[tuple[Parameter, float, float]]:
    """Each parameter with its value and its standard deviation in the search; empty without an answer."""
    if not has_answer(optimum.estimate.result):
        return []
    std = deviations(optimum.estimate.covariance)
    return list(zip(optimum.likelihood.model.parameters, optimum.values.tolist(), std.tolist(), strict=False))


def deviations(covariance: Float[ArrayLike, "unknowns unknowns"]) -> Float[np.ndarray, " unknowns"]:
    """Standard deviations."""
    return np.sqrt(np.maximum(np.diagonal(np.asarray(covariance)), 0.0))


def disturbances_of(optimum: Optimum) -> dict[str, Disturbance]:
    """The disturbance of each channel: accelerations that the model does not explain."""
    noise = jax.tree.map(np.exp, optimum.noise)
    products = np.asarray(optimum.by_segment.products).sum(axis=0)
    correlation = products[:, 1:] / np.maximum(products[:, :1], 1.0)
    largest = np.take_along_axis(correlation, np.abs(correlation).argmax(axis=1)[:, None], axis=1)[:, 0]
    return {
        name: Disturbance(
            strength=float(noise.strength[i]),
            unit="rad/s^2" if i < 3 else "m/s^2",
            time_constant=float(noise.time_constant[i]),
            sensor=float(noise.sensor[i]),
            smoothing=None if i < 3 else float(noise.smoothing[i]),
            correlation=float(largest[i]),
        )
        for i, name in enumerate(optimum.likelihood.channels)
    }
