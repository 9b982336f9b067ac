"""Bi-section shooting and the ant colony: settings, starts, counts, kernels. Their errors: `test_errors.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import documented_class, noisy_states, random_starts, same, standard_flight, standard_problem
from lanes import FEW, HALF, LANES, bound, identify, lanes, names, noisy

import jaxos4
from jaxos4.estimators.levenberg_marquardt import LevenbergMarquardt
from jaxos4.estimators.solver import solve

PUBLISHED = jaxos4.PublishedOS4


def test_where_a_start_is_nan_the_search_begins_at_the_center():
    arguments = lanes(noisy_states(LANES))
    center = (arguments[-1] + arguments[-2]) / 2
    found = [identify(jaxos4.IBSS(), *arguments, start) for start in (center, center.at[7, 2].set(jnp.nan))]
    assert same(*found)
    assert set(names(found[0])) == {"successful"}
    elsewhere = identify(jaxos4.IBSS(), *arguments, center.at[7, 2].add(0.5 * HALF[2]))
    assert not np.array_equal(elsewhere.parameters[7], found[0].parameters[7])


SOLVERS = [jaxos4.IBSS(), LevenbergMarquardt(), jaxos4.AntColony()]


@pytest.mark.slow
@pytest.mark.parametrize("solver", SOLVERS, ids=lambda solver: type(solver).__name__)
def test_a_start_beyond_the_reach_is_moved_to_its_limit(solver):
    problem = standard_problem(channels="rates", states=noisy_states(1)[0])
    lower, upper = problem.unknowns.limits(solver.reach)
    far = problem.unknowns.center.at[2].set(2 * upper[2])
    found = solve(solver, problem, far)
    assert ((found.parameters >= lower) & (found.parameters <= upper)).all()
    assert names(found) != "nonfinite_trajectory"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shooting", "innovations"])
def test_the_search_of_the_documentation_ends_at_the_minimum_or_says_that_it_did_not(kind):
    exec(documented_class("likelihood.md"), defined := {"__name__": "descent"})  # noqa: S102
    problem = standard_problem(channels="rates", states=noisy_states(3)[2], free=True).hold({"alpha2": 0.0})
    best = (jaxos4.OutputError if kind == "shooting" else jaxos4.FilterError)()(problem)
    problem = problem if kind == "shooting" else jaxos4.InnovationsProblem(problem)
    found = defined["Descent"]()(problem)
    assert names(found) == "successful"
    off = np.abs(found.parameters[:8] - best.parameters)
    assert (off <= 0.05 * best.std).all()
    if kind == "shooting":
        assert names(defined["Descent"](steps=1)(problem)) == "max_sweeps"


@pytest.mark.slow
def test_output_error_takes_no_more_steps_for_a_long_flight():
    """Of 300 s. A search of the whole from the start, with ten times the steps, ends in the same minimum at best."""
    problem = standard_problem(channels="rates", duration=300.0)
    center, keys = random_starts(jaxos4.PublishedOS4(), 6, seed=3), jax.random.split(jax.random.key(3), 6)

    @eqx.filter_jit
    def fitted(estimator):
        def one(key, center):
            noisy = jaxos4.WhiteNoise(problem.sigma)(problem.flight, key=key)
            data = eqx.tree_at(lambda p: p.flight, problem, noisy)
            return estimator(data, jaxos4.Bracket.around(center, HALF))

        return jax.vmap(one)(keys, center)

    found, whole = fitted(jaxos4.OutputError()), fitted(jaxos4.OutputError(long=problem.flight.time.size + 1))
    assert set(names(found)) == {"successful"}
    assert found.rollouts.max() < 120 < whole.rollouts.max()
    error = (found.parameters - problem.model.alpha) / found.std
    assert (np.abs(error) < 5).all()
    assert (found.cost <= whole.cost + 0.01).all()


def test_too_few_sweeps_are_reported():
    estimates = identify(jaxos4.IBSS(max_sweeps=1, tolerance=1e-8), *lanes(noisy_states(LANES)))
    assert set(names(estimates)) == {"max_sweeps"}
    assert np.isfinite(estimates.parameters).all()
    assert (np.asarray(estimates.sweeps) == 3).all()  # one for each share of the flight


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_ibss_reaches_the_maximum_of_the_likelihood():
    """That of output error, which is that of another minimiser: `test_estimators.py`."""
    problem, *arguments = lanes(noisy_states(LANES, seed=5))
    best = identify(jaxos4.OutputError(tolerance=1e-9), problem, *arguments).parameters
    # What the default tolerance allows is far below the noise.
    for settings, most in (({"tolerance": 1e-5}, 1e-4), ({}, 0.05)):
        estimates = identify(jaxos4.IBSS(**settings), problem, *arguments)
        assert set(names(estimates)) == {"successful"}
        assert np.abs((estimates.parameters - best) / bound()).max() < most


def broken(problem, lowest, highest, factor):
    """The slope of alpha3 is multiplied by `factor` between two values."""

    class Broken(jaxos4.ShootingProblem):
        def stages(self, shares=()):
            stages = super().stages(shares)

            def local_model(number, before, unknowns):
                model, alpha = stages.local_model(number, before, unknowns), unknowns[0, 2]
                change = jnp.where((alpha > lowest) & (alpha < highest), factor, 1.0)
                return model._replace(gradient=model.gradient.at[:, 2].multiply(change))

            return stages._replace(local_model=local_model)

    return Broken(problem.model, problem.flight, sigma=problem.sigma, channels="rates", unknowns=problem.unknowns)


def test_slopes_that_are_wrong_end_no_search_as_a_success():
    """Beside the minimum, the search goes round what is not a number. Where every slope is wrong, it says so."""
    problem = standard_problem(channels="rates", states=noisy_states(1)[0], free=True)
    problem = problem.within(jaxos4.Bracket.around(PUBLISHED().alpha + 0.5 * HALF, HALF))
    best = jaxos4.IBSS()(problem)
    value, std = float(best.parameters[2]), float(best.std[2])
    found = jaxos4.IBSS()(broken(problem, value + 2 * std, value + 6 * std, np.nan))
    assert names(found) == "successful"
    assert (np.abs(found.parameters - best.parameters) <= 0.05 * best.std).all()
    strides = eqx.tree_at(lambda p: p.unknowns.stride, problem, problem.unknowns.stride.at[0].set(1.0))
    assert names(jaxos4.IBSS()(broken(strides, -np.inf, np.inf, -1.0))) != "successful"


def counting(torques):
    """A model that tells the torque of each simulated step. The first torque of a flight starts a shot."""

    class Counting(PUBLISHED):
        def angular_acceleration(self, rates, forcing, parameters):
            jax.debug.callback(lambda torque: torques.append(float(torque)), forcing.roll)
            return super().angular_acceleration(rates, forcing, parameters)

    return Counting()


def shots_of(problem, torques):
    """How many shots these torques were."""
    jax.effects_barrier()
    rolls = np.asarray(problem.forcing(problem.model.alpha).roll)
    assert (rolls == rolls[0]).sum() == 1
    return torques.count(float(rolls[0]))


def problem_of(model, start, duration):
    flight = eqx.tree_at(lambda f: f.states, standard_flight(duration=duration), noisy_states(1, duration=duration)[0])
    return jaxos4.ShootingProblem(
        model, flight, sigma=jaxos4.SENSOR_SIGMA, channels="rates", initial_state=start
    ).within(jaxos4.Bracket.around(PUBLISHED().alpha + 0.5 * HALF, HALF))


@pytest.mark.slow
def test_rollouts_are_counted_right():
    """On however many samples."""
    free, slow = None, {"halvings": 3}
    for start, unknowns, most, settings in ((np.zeros(12), 8, 2, {}), (free, 11, 3, slow)):
        problem = problem_of(counting(torques := []), start, 0.5)
        estimate = jaxos4.IBSS(**settings)(problem)
        shots, sweeps = shots_of(problem, torques), int(estimate.sweeps)
        assert int(estimate.rollouts) == unknowns * shots  # each shot carries one tangent for every unknown
        assert sweeps > 3
        # A sweep narrows each bracket; it ends early where the minimum is.
        assert 2 * sweeps <= shots <= 3 + sweeps * (1 + most)


@pytest.mark.slow
def test_the_colony_reaches_the_optimum_of_ibss_with_many_more_rollouts():
    colony = noisy(jaxos4.AntColony, count=FEW)
    ibss = jax.tree.map(lambda leaf: leaf[:FEW], noisy(jaxos4.IBSS))
    assert set(names(colony)) == {"successful"}
    # A cost of 0.005 is an error of 0.1 standard deviations.
    assert (np.abs(colony.cost - ibss.cost) < 5 * jaxos4.AntColony().tolerance).all()
    assert (np.abs(colony.parameters - ibss.parameters) < 0.1 * bound()).all()
    np.testing.assert_allclose(colony.std, ibss.std, rtol=0.01)
    assert (np.asarray(colony.rollouts) > 5 * np.asarray(ibss.rollouts)).all()


@pytest.mark.slow
def test_each_simulated_point_of_a_colony_is_counted():
    """A search that is stopped says so."""
    problem = problem_of(counting(torques := []), np.zeros(12), 5.0)
    estimate = jaxos4.AntColony(ants=9, max_sweeps=3)(problem)
    shots = 50 + 3 * 9 + 1  # and one at the answer, with eight tangents
    assert shots_of(problem, torques) == shots
    assert int(estimate.rollouts) == shots + 8
    assert (int(estimate.sweeps), str(names(estimate))) == (3, "max_sweeps")
