"""The sample time of a vehicle's fit: the shortest at which the answer does not depend on it.

Short samples contain the vibration of the sensors. Long samples hide motion. The flight is fitted at several sample
times, from the longest on. A sample time that the user gives is fitted in the same way, and longer ones beside it.

The rule: the shortest sample time at which the innovations of the body rates are nearly white, and the moments of
inertia are those of samples twice as long, within two standard deviations, and known nearly as well. If there is none:
the shortest without vibration. If all have it: the longest with an answer.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import numpy as np

from ..estimate import REACH, Estimate
from ..results import result_names
from ..shooting import InnovationsProblem
from .answers import AXES, overwhelmed, vehicle_constants
from .fit import Fit, fit_case
from .prepare import Case, Progress
from .results import Constant, SampleTime, has_answer

# The limit of a correlation of white innovations: the first number plus so many standard errors. The largest of 24
# correlations (3 rates, 8 lags) is compared.
WHITE, _CHANCE = 0.06, 3.0
# Two answers agree within so many standard deviations and this share, which allows for errors of discretisation.
AGREE, _DISCRETE = 2.0, 0.03
# Intervals that are longer by this factor than those of samples twice as long agree with anything.
_WIDER = 1.5
# The share of the way to its limit at which an unknown counts as being there.
_NEAR = 0.95


def fit_at_sample_times(
    cases: Sequence[Case], *, choose: bool = True, progress: Progress
) -> tuple[int, Case, Fit, tuple[SampleTime, ...]]:
    """The place of the case that the rule chooses, the case, its fit, and the answers of all.

    If not `choose`: the first place.

    The search for all parameters starts at the answer of the sample time before, if that is a minimum.

    **Arguments:** `cases`: of one flight at several sample times, each twice the one before.
    """
    found, fits = None, []
    for case in reversed(cases):
        progress(f"fitting samples of {1e3 * float(case.shooting.flight.dt):.3g} ms")
        begin = case if found is None else _starting_from(case, found)
        found = jax.block_until_ready(begin.estimator(begin.problem))
        if begin is not case and not has_answer(found):  # the answer for longer samples was no start
            other = jax.block_until_ready(case.estimator(case.problem))
            found = eqx.tree_at(lambda e: e.rollouts, other, found.rollouts + other.rollouts)
        fits.insert(0, fit_case(case, first=found))
    answers = tuple(map(answer_of, cases, fits))
    place = shortest(answers) if choose else 0
    return place, cases[place], fits[place], answers


def _starting_from(case: Case, found: Estimate) -> Case:
    """The case, whose search starts at the estimate of all parameters for longer samples, if that is a minimum."""
    if str(result_names(found.result)) != "successful" or not isinstance(case.problem, InnovationsProblem):
        return case
    own, start = case.problem.problem.unknowns, np.asarray(found.parameters)
    off = np.abs(start[: own.count] - np.asarray(own.center)) / np.asarray(own.half_width)
    if not (off < _NEAR * REACH).all():  # the answer may be another minimum
        return case
    return case._replace(problem=case.problem.starting_from(start))


def shortest(answers: Sequence[SampleTime]) -> int:
    """The place of the sample time that the rule chooses. `answers`: the shortest sample time first."""
    answered = [i for i, answer in enumerate(answers) if answer.constants] or [0]
    limits = [WHITE + _CHANCE / math.sqrt(max(answer.samples, 1)) for answer in answers]
    clean = [i for i in answered if abs(answers[i].correlation) <= limits[i]] or answered[-1:]
    steady = (i for i in clean[:-1] if not moved(answers[i], answers[i + 1]) and not _vague(answers[i], answers[i + 1]))
    return next(steady, clean[0])


def _vague(answer: SampleTime, other: SampleTime) -> bool:
    """Whether another sample time knows Ix or Iy clearly better."""
    both = [name for name in ("Ix", "Iy") if name in answer.constants and name in other.constants]
    return any(answer.constants[name].std > _WIDER * other.constants[name].std for name in both)


def moved(answer: SampleTime, other: SampleTime) -> list[str]:
    """The moments of inertia that another sample time contradicts."""

    def differs(one: Constant, two: Constant) -> bool:
        return abs(one.estimate - two.estimate) > AGREE * max(one.std, two.std) + _DISCRETE * one.estimate

    both = [name for name in answer.constants if name in other.constants]
    return [name for name in both if differs(answer.constants[name], other.constants[name])]


def answer_of(case: Case, fit: Fit) -> SampleTime:
    """The answer of one sample time. Without a thrust there is no scale of torques, and so no answer."""
    scales = [each.name for each in fit.problem.model.parameters if each.scales_torque]
    answered = fit.answered and not any(name in fit.held for name in scales)
    constants = vehicle_constants(fit).constants if answered else {}
    if answered and "yaw" in overwhelmed(fit):
        constants = {name: row for name, row in constants.items() if name != "Iz"}
    correlations = [row.correlation for name, row in fit.disturbances.items() if name in AXES] if fit.answered else []
    largest, samples = max(correlations, key=abs, default=1.0), 0
    if fit.answered and fit.estimate.parts is not None:
        # The sum of the squares of the innovations of a body rate, which have a mean of 1.
        samples = round(float(np.asarray(fit.estimate.parts.products)[:, : len(AXES), 0].sum() / len(AXES)))
    return SampleTime(float(case.shooting.flight.dt), constants, largest, samples)
