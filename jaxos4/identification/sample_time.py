"""The sample time of a vehicle's fit: the shortest at which the answer does not depend on it.

Short samples contain the vibration of the sensors and the noise of measured rotor speeds. Long samples hide motion. The
flight is fitted at several sample times, from the longest on, each starting at the answer before.

The rule: the shortest sample time at which innovations are nearly white, and whose moments of inertia are those of
samples twice as long, within two standard deviations. If there is none: the shortest with nearly white innovations.
"""

from collections.abc import Sequence

import numpy as np

from .answers import vehicle_constants
from .fit import Fit, fit_innovations
from .prepare import Case, Progress
from .results import Constant, SampleTime

# Innovations that correlate by less count as white. Two answers agree within so many standard deviations and this share:
# longer samples have errors of discretisation.
WHITE, AGREE, _DISCRETE = 0.3, 2.0, 0.03
_RATES = ("p", "q", "r")


def fit_at_sample_times(cases: Sequence[Case], *, progress: Progress) -> tuple[int, Fit, tuple[SampleTime, ...]]:
    """The place of the case that the rule chooses, its fit, and the answers of all.

    **Arguments:** `cases`: of one flight at several sample times, each twice the one before.
    """
    fits: list[Fit] = []
    for case in reversed(cases):
        problem = case.innovations
        progress(f"fitting samples of {1e3 * float(case.shooting.flight.dt):.3g} ms")
        if fits and fits[0].answered:
            problem = problem.starting_from(np.asarray(fits[0].estimate.parameters))
        fits.insert(0, fit_innovations(case.estimator, problem, case.recording, shooting=case.shooting))
    answers = tuple(_answer(case, fit) for case, fit in zip(cases, fits, strict=True))
    place = shortest(answers)
    return place, fits[place], answers


def shortest(answers: Sequence[SampleTime]) -> int:
    """The place of the sample time that the rule chooses. `answers`: the shortest sample time first."""
    white = [i for i, answer in enumerate(answers) if abs(answer.correlation) <= WHITE and answer.constants] or [0]
    return next((i for i in white[:-1] if not moved(answers[i], answers[i + 1])), white[0])


def moved(answer: SampleTime, other: SampleTime) -> list[str]:
    """The moments of inertia that another sample time contradicts."""

    def differs(one: Constant, two: Constant) -> bool:
        return abs(one.estimate - two.estimate) > AGREE * max(one.std, two.std) + _DISCRETE * one.estimate

    both = [name for name in answer.constants if name in other.constants]
    return [name for name in both if differs(answer.constants[name], other.constants[name])]


def _answer(case: Case, fit: Fit) -> SampleTime:
    constants = vehicle_constants(fit).constants if fit.answered else {}
    correlations = [row.correlation for name, row in fit.disturbances.items() if name in _RATES] if fit.answered else []
    largest = max(correlations, key=abs, default=1.0)
    return SampleTime(float(case.shooting.flight.dt), constants, largest)
