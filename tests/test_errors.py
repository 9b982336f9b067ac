"""The errors of estimates: as large as they claim, none without noise, and never wrong without a word."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, random_starts, standard_flight, standard_problem
from lanes import HALF, LANES, assert_chi_square, assert_covered, bound, errors, identify, lanes, names, noisy

import jaxos4

pytestmark = pytest.mark.slow

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
MAKE = {
    "ibss": jaxos4.IBSS,
    "output error": jaxos4.OutputError,
    "kalman": jaxos4.JointEKF,
    "svsf": jaxos4.SVSF,
    "equation error": jaxos4.EquationError,
    "differences": functools.partial(jaxos4.EquationError, memory=0.0),
    "forgetting": functools.partial(jaxos4.RecursiveLeastSquares, forgetting=0.98),
}
EFFICIENT = ("ibss", "output error", "kalman")
SPREAD = 1 / np.sqrt(2 * LANES)  # the standard error of a root mean square
# An estimator, model, channels, whether the initial state is free, the scale of the noise; the least and the largest
# root mean square error of a parameter, as multiples of the Cramer-Rao bound.
FLIGHTS = [
    ("ibss", PUBLISHED, "rates", False, 1.0, 1 - 3.5 * SPREAD, 1 + 3.5 * SPREAD),
    ("ibss", PUBLISHED, "all", True, 1.0, 1 - 3.5 * SPREAD, 1 + 3.5 * SPREAD),
    ("ibss", CORRECTED, "all", False, 1.0, 1 - 3.5 * SPREAD, 1 + 3.5 * SPREAD),
    ("output error", PUBLISHED, "all", False, 1.0, 1 - 4 * SPREAD, 1 + 4 * SPREAD),
    ("kalman", PUBLISHED, "rates", True, 1.0, 1 - 4 * SPREAD, 1.2 + 3 * SPREAD),
    ("kalman", CORRECTED, "all", False, 1.0, 1 - 4 * SPREAD, 1.2 + 3 * SPREAD),
    ("svsf", PUBLISHED, "rates", False, 1.0, 1 - 3 * SPREAD, 2.0 * (1 + 3 * SPREAD)),
    ("svsf", PUBLISHED, "rates", False, 10.0, 1 - 3 * SPREAD, 2.0 * (1 + 3 * SPREAD)),
    ("svsf", CORRECTED, "rates", False, 1.0, 1 - 3 * SPREAD, 2.5 * (1 + 3 * SPREAD)),
    ("equation error", PUBLISHED, "rates", False, 10.0, 1 - 4 * SPREAD, np.inf),
    ("equation error", PUBLISHED, "rates", False, 1.0, 1 - 4 * SPREAD, 1.6 * (1 + 8 * SPREAD)),
    ("equation error", PUBLISHED, "rates", True, 1.0, 1 - 4 * SPREAD, 1.11 * (1 + 3.5 * SPREAD)),
    ("differences", PUBLISHED, "rates", True, 1.0, 1.4, np.inf),
    ("forgetting", PUBLISHED, "rates", True, 1.0, 1.4, np.inf),
]


@pytest.mark.parametrize(("name", "model_class", "channels", "free", "scale", "least", "most"), FLIGHTS)
def test_errors_are_as_large_as_they_claim(name, model_class, channels, free, scale, least, most):
    estimates, unit = noisy(MAKE[name], model_class, channels, free, scale), scale * bound(model_class, channels, free)
    assert names(estimates).tolist() == ["successful"] * LANES
    error = errors(estimates, model_class)
    efficiency = np.sqrt(np.mean((error / unit) ** 2, axis=0))
    assert least < efficiency.min(), efficiency
    assert efficiency.max() < most, efficiency
    spread = unit if name in EFFICIENT else error.std(axis=0)
    assert (np.abs(error.mean(axis=0)) < 4 * spread / np.sqrt(LANES)).all()
    std = np.asarray(estimates.std)
    if name == "svsf":  # its covariance is on the safe side: a bound for coverage from below only
        assert np.mean(np.abs(error) < 1.96 * std) > 0.95 - 4 * np.sqrt(0.95 * 0.05 / LANES)
        assert (np.median(std, axis=0) < 2.3 * most * unit).all()
        return
    assert_chi_square(error, np.linalg.inv(estimates.covariance))
    assert_covered(error, std)
    assert estimates.initial_state.shape[1] == (12 if channels == "all" else 3)
    assert free or not estimates.initial_state.any()
    if name in EFFICIENT:
        np.testing.assert_allclose(np.median(std / unit, axis=0), 1, atol=0.05)
        problem = standard_problem(model_class, channels, free=free)
        degrees = problem.size * (501 if free else 500) - 8 - problem.free_size
        assert abs(np.mean(2 * estimates.cost / degrees) - 1) < 4 * np.sqrt(2 / (degrees * LANES))


def test_differences_of_the_rates_lose_three_times_as_much_as_their_integrals():
    integrals, differences = (
        np.sqrt(np.mean(np.square(errors(noisy(MAKE[name], PUBLISHED, "rates", True))), axis=0)) / bound(free=True)
        for name in ("equation error", "differences")
    )
    assert integrals.max() < differences.max() / 3


# Brackets that miss the truth: IBSS searches beyond them, and output error too.

CASES = [case[1:4] for case in FLIGHTS if case[0] == "ibss"]
every_case = pytest.mark.parametrize(("model_class", "channels", "free"), CASES)
SIDES = np.array([side * np.eye(8)[i] for i in range(8) for side in (-1, 1)])
# How far beyond the bracket's edge the truth is, in half-widths; a full width is 2.
BEYOND, FAR = 0.1, 2.0
EXACT, MISSED, NOISY_MISSED, BARELY = (slice(16 * i, 16 * (i + 1)) for i in range(4))


@functools.cache
def mixed(model_class, channels, free):
    """16 lanes each: exact; exact, truth far outside; noisy, far outside; noisy, just outside."""
    problem, model = standard_problem(model_class, channels, free=free), model_class()
    exact = np.tile(standard_flight(model_class).states, (32, 1, 1))
    states = jnp.concatenate(
        [exact, noisy_states(32, model_class, seed=200 + CASES.index((model_class, channels, free)))]
    )
    offset = np.concatenate([np.zeros((16, 8)), (1 + FAR) * SIDES, (1 + FAR) * SIDES, (1 + BEYOND) * SIDES])
    center = np.asarray(model.alpha) + offset * HALF
    center[EXACT] = random_starts(model, 16, seed=300)
    omega = jnp.tile(standard_flight(model_class).omega, (LANES, 1, 1))
    return identify(jaxos4.IBSS(), problem, states, omega, *(jnp.asarray(x) for x in (center - HALF, center + HALF)))


@every_case
def test_exact_flights_give_the_truth(model_class, channels, free):
    estimates, alpha = mixed(model_class, channels, free), np.asarray(model_class().alpha)
    assert set(names(estimates)[EXACT]) == {"successful"}
    scale = np.where(alpha == 0, 1, np.abs(alpha))
    error = (np.abs(errors(estimates, model_class)) / scale)[EXACT].max(axis=0)
    tiny = alpha == 6e-9  # alpha2 and alpha5 as printed
    assert (error[tiny] < 1e-2).all(), error
    assert (error[~tiny] < 1e-8).all(), error


@every_case
def test_never_succeeds_with_a_wrong_answer(model_class, channels, free):
    """Each parameter in turn outside the bracket, on either side, by a tenth of its half-width or by its full width."""
    estimates = mixed(model_class, channels, free)
    error = errors(estimates, model_class)
    off = np.abs(error / bound(model_class, channels, free)).max(axis=1)
    succeeded = names(estimates) == "successful"
    assert off[succeeded].max() < 6
    assert off[MISSED][succeeded[MISSED]].max() < 1e-4  # without noise: the truth itself
    # Few are given up.
    assert succeeded[MISSED].sum() >= 14
    assert succeeded[NOISY_MISSED].sum() >= 14
    assert succeeded[BARELY].all()
    # The noisy flights end where they end from a bracket around the truth: at the least cost.
    for part in (NOISY_MISSED, BARELY):
        kept = np.arange(LANES)[part][succeeded[part]]
        assert_chi_square(error[kept], np.linalg.inv(estimates.covariance[kept]))


def test_a_truth_beyond_the_hard_limits_is_reported():
    offset = np.concatenate([4.5 * SIDES] * 4)
    problem, states, omega, _, _ = lanes(noisy_states(LANES, seed=1))
    center = np.asarray(PUBLISHED().alpha) + offset * HALF
    arguments = problem, states, omega, jnp.asarray(center - HALF), jnp.asarray(center + HALF)
    estimates = identify(jaxos4.IBSS(), *arguments)
    assert not (names(estimates) == "successful").any()
    assert np.isfinite(estimates.parameters).all()
    reached = np.abs(np.asarray(estimates.parameters - PUBLISHED().alpha) / HALF - offset)
    assert (reached <= 4 * (1 + 1e-9)).all()
    wider = identify(jaxos4.IBSS(reach=6.0), *arguments)
    off = np.abs(errors(wider) / bound()).max(axis=1)
    assert off[names(wider) == "successful"].max() < 6
    assert (names(wider) == "successful").mean() > 0.8
