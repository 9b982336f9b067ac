"""The sample time of a vehicle's fit: the shortest at which the answer does not depend on it.

Short samples contain the vibration of the sensors and the noise of measured rotor speeds. Long samples hide motion. The
flight is fitted at several sample times, from the longest on.

The rule: the shortest sample time at which innovations are nearly white, measured rotor speeds have little noise, and
the moments of inertia are those of samples twice as long, within two standard deviations. If there is none: the
shortest without vibration and noise. If all have it: the longest with an answer.
"""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import numpy as np

from ..airframe import Airframe
from ..estimate import REACH, Estimate
from ..flight import Flight
from ..results import result_names
from ..shooting import InnovationsProblem, for_threads
from .answers import AXES, NOISY, overwhelmed, vehicle_constants
from .fit import Fit, fit_case
from .held_out import compile_ahead
from .prepare import Case, Progress
from .results import Constant, SampleTime, has_answer

# The limit of a correlation of white innovations: the first number plus so many standard errors. The largest of 24
# correlations (3 rates, 8 lags) is compared.
WHITE, _CHANCE = 0.06, 3.0
# Two answers agree within so many standard deviations and this share, which allows for errors of discretisation.
AGREE, _DISCRETE = 2.0, 0.03
# The share of the way to its limit at which an unknown counts as being there.
_NEAR = 0.95


def fit_at_sample_times(cases: Sequence[Case], *, progress: Progress) -> tuple[int, Fit, tuple[SampleTime, ...]]:
    """The place of the case that the rule chooses, its fit, and the answers of all.

    The search for all parameters starts at the answer of the sample time before, if that is a minimum. What the flights
    do not show is held beside it, in another thread.

    **Arguments:** `cases`: of one flight at several sample times, each twice the one before.
    """
    found, fits, beside = None, [], ThreadPoolExecutor(1)
    try:
        for case in reversed(cases):
            progress(f"fitting samples of {1e3 * float(case.shooting.flight.dt):.3g} ms")
            if not fits:
                beside.submit(for_threads(compile_ahead), case)  # what fails here fails again when it is needed
            begin = case if found is None else _starting_from(case, found)
            found = jax.block_until_ready(begin.estimator(begin.problem))
            if begin is not case and not has_answer(found):  # the answer for longer samples was no start
                other = jax.block_until_ready(case.estimator(case.problem))
                found = eqx.tree_at(lambda e: e.rollouts, other, found.rollouts + other.rollouts)
            fits.append(beside.submit(for_threads(fit_case), case, first=found))
        fits = [fit.result() for fit in fits][::-1]
    finally:  # after an error, what has not begun is not computed
        beside.shutdown(cancel_futures=True)
    finest = cases[0].shooting.flight
    answers = tuple(answer_of(case, fit, finest) for case, fit in zip(cases, fits, strict=True))
    place = shortest(answers)
    return place, fits[place], answers


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
    clean = [i for i in answered if abs(answers[i].correlation) <= limits[i] and answers[i].speed_noise <= NOISY]
    clean = clean or answered[-1:]
    return next((i for i in clean[:-1] if not moved(answers[i], answers[i + 1])), clean[0])


def noise_of_speeds(flight: Flight, finest: Flight, airframe: Airframe) -> float:
    """The share of white noise in the changes of the rotors' roll or pitch torque from sample to sample.

    Commands have no noise. White noise has second differences of 6 times its variance, and first differences of twice.
    Its variance falls as samples of `finest` are averaged to longer ones. There the rotors are smoother.
    """
    if flight.commanded:
        return 0.0
    mixer = np.asarray(airframe.mixer, dtype=float)[:2].T

    def median_square(each: Flight, order: int) -> np.ndarray:
        return np.median(np.abs(np.diff(np.square(np.asarray(each.omega)) @ mixer, order, axis=0)), axis=0) ** 2

    changes = median_square(flight, 1)
    noise = median_square(finest, 2) / 6 * float(finest.dt) / float(flight.dt)
    return float(np.max(2 * noise / np.where(changes > 0, changes, np.inf)))


def moved(answer: SampleTime, other: SampleTime) -> list[str]:
    """The moments of inertia that another sample time contradicts."""

    def differs(one: Constant, two: Constant) -> bool:
        return abs(one.estimate - two.estimate) > AGREE * max(one.std, two.std) + _DISCRETE * one.estimate

    both = [name for name in answer.constants if name in other.constants]
    return [name for name in both if differs(answer.constants[name], other.constants[name])]


def answer_of(case: Case, fit: Fit, finest: Flight) -> SampleTime:
    """The answer of one sample time. `finest`: the flight with the shortest samples.

    Without a thrust there is no scale of torques, and so no answer.
    """
    scales = [each.name for each in fit.problem.model.parameters if each.scales_torque]
    answered = fit.answered and not any(name in fit.held for name in scales)
    flight = case.shooting.flight
    noise = noise_of_speeds(flight, finest, fit.problem.model.airframe)
    constants = vehicle_constants(fit, noise).constants if answered else {}
    if answered and "yaw" in overwhelmed(fit):
        constants = {name: row for name, row in constants.items() if name != "Iz"}
    correlations = [row.correlation for name, row in fit.disturbances.items() if name in AXES] if fit.answered else []
    largest, samples = max(correlations, key=abs, default=1.0), 0
    if fit.answered and fit.estimate.parts is not None:
        # The sum of the squares of the innovations of a body rate, which have a mean of 1.
        samples = round(float(np.asarray(fit.estimate.parts.products)[:, : len(AXES), 0].sum() / len(AXES)))
    return SampleTime(float(flight.dt), constants, largest, samples, noise)
