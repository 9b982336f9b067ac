"""Solvers, on likelihoods in which nothing flies: minima, starts, limits, counts. On flights: `test_estimators.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.optimize
from helpers import documented_class, noisy_states, random_starts, same, standard_flight, standard_problem
from lanes import HALF, names
from likelihoods import MINIMUM, SLOPES, late, misfit, narrow, quadratic, shallow, squares, two_minima, valley, wall

import jaxos4
from jaxos4.estimators import FilterError
from jaxos4.estimators.levenberg_marquardt import LevenbergMarquardt
from jaxos4.linalg import joint_factor, limited, slopes_along

IBSS = jaxos4.IBSS


exec(documented_class("likelihood.md"), DOCUMENTED := {"__name__": "descent"})  # noqa: S102
DESCENT = DOCUMENTED["Descent"]
# Each with the settings of a search that is stopped.
SOLVERS = {
    "IBSS": (IBSS, {"max_sweeps": 2}),
    "LevenbergMarquardt": (LevenbergMarquardt, {"max_steps": 2}),
    "AntColony": (jaxos4.AntColony, {"max_sweeps": 3}),
    "of the documentation": (DESCENT, {"steps": 2}),
}
every_solver = pytest.mark.parametrize("name", SOLVERS)


def solver_of(name):
    return SOLVERS[name][0]()


@every_solver
@pytest.mark.parametrize("residuals", [quadratic, valley])
def test_a_search_ends_at_the_minimum_that_another_minimiser_finds(name, residuals):
    best = scipy.optimize.least_squares(lambda x: np.asarray(residuals(jnp.asarray(x))), np.zeros(2), xtol=1e-12)
    found = solver_of(name)(squares(residuals))
    assert names(found) == "successful"
    np.testing.assert_allclose(found.covariance, np.linalg.inv(best.jac.T @ best.jac), rtol=0.05)
    assert (np.abs(found.parameters - best.x) <= 0.05 * found.std).all()
    assert abs(float(found.cost) - best.cost) < 0.005


@every_solver
def test_a_search_that_is_stopped_says_so(name):
    make, settings = SOLVERS[name]
    found = make(**settings)(squares(valley))
    assert names(found) == "max_sweeps"
    assert int(found.sweeps) == next(iter(settings.values()))
    assert np.isfinite(found.parameters).all()


def test_a_step_that_failed_shows_the_curvature_that_the_information_lacks():
    """Damping alone shortens the steps of all unknowns, and needs four times as many."""
    best = scipy.optimize.minimize(lambda x: np.square(misfit(x)).sum() / 2, np.zeros(2), tol=1e-12)
    found = LevenbergMarquardt()(squares(misfit))
    np.testing.assert_allclose(found.parameters, best.x, atol=1e-3)
    assert names(found) != "max_sweeps"
    assert int(found.sweeps) < 30


def test_steps_that_creep_become_longer():
    """Each Gauss-Newton step leaves four fifths of the way, so that 12 of them ended 0.04 before the minimum."""
    best = scipy.optimize.minimize(lambda x: np.square(shallow(x)).sum() / 2, np.zeros(2), tol=1e-12)
    found = FilterError().solver(squares(shallow))
    np.testing.assert_allclose(found.parameters, best.x, atol=0.01)
    assert names(found) == "successful"
    assert int(found.sweeps) < 8


def test_a_gradient_that_misleads_a_little_ends_a_search():
    """That of innovations is approximate: the noise of a channel acts on its own innovations only.

    At the minimum, where this search begins, it promises a gain of 0.2 to 0.3, and no step has any, however short.
    """

    def change(x, gradient):
        return gradient + jnp.array([14.0, 0.0])

    found = FilterError().solver(squares(quadratic, change=change), start=jnp.asarray(MINIMUM))
    assert names(found) == "successful"
    np.testing.assert_array_equal(found.parameters, MINIMUM)
    assert int(found.sweeps) < 10


@pytest.mark.parametrize("solver", [LevenbergMarquardt(), FilterError().solver])
def test_a_steep_secant_ends_no_search(solver):
    """It shortens the next step so much that this step promises little."""
    best = scipy.optimize.minimize(lambda x: np.square(wall(x)).sum() / 2, np.zeros(2), method="Nelder-Mead", tol=1e-12)
    found = solver(squares(wall, half_width=10.0))
    assert float(found.cost) < best.fun + 0.002


def test_an_unknown_at_its_limit_does_not_stop_the_others():
    """Its step is much longer than its stride, and nearly nothing is left of it at the limit."""
    stride, start = np.array([1e-3, np.inf]), jnp.array([4 - 5e-6, 0.4])
    found = FilterError().solver(squares(late, stride=stride), start=start)
    np.testing.assert_allclose(found.parameters, [4.0, -0.5], atol=0.1)


def test_a_bracket_beyond_a_limit_ends_a_search():
    found = LevenbergMarquardt()(squares(quadratic, center=(-10.0, 0.0), lowest=np.array([0.0, -np.inf])))
    assert names(found) == "at_bound"


def test_a_gradient_that_is_nan_is_no_minimum():
    found = LevenbergMarquardt()(
        squares(quadratic, change=lambda x, gradient: gradient + jnp.where(x > 0.2, jnp.nan, 0.0))
    )
    assert names(found) != "successful"


factor_of, limited_step = eqx.filter_jit(joint_factor), eqx.filter_jit(limited)


@pytest.mark.parametrize("windows", [1, 3])
def test_a_limited_step_is_the_lowest_of_all_that_share_its_limits(windows):
    """Behind the shared unknowns, each window has two of its own, without limits."""
    count, random = 4, np.random.default_rng(5)
    width, at_limits = count + 2, 0
    shared = np.eye(count, count + 2 * windows)
    columns = [np.vstack([shared, np.eye(2, count + 2 * windows, count + 2 * w)]) for w in range(windows)]
    for _ in range(20):
        roots, gradient = random.normal(size=(windows, width, width)), random.normal(size=(windows, width))
        basis = factor_of(jnp.asarray(roots @ roots.swapaxes(1, 2)), count).basis
        free = -(basis * slopes_along(basis, jnp.asarray(gradient), count)[:, None, :]).sum(axis=-1)
        low, high = -random.uniform(0, 0.5, width), random.uniform(0, 0.5, width)
        room = (jnp.tile(jnp.asarray(limit), (windows, 1)) for limit in (low, high))
        found = np.asarray(limited_step(free, basis, tuple(room), count))
        whole = sum(c.T @ r @ r.T @ c for c, r in zip(columns, roots, strict=True))
        slope = sum(c.T @ g for c, g in zip(columns, gradient, strict=True))
        joint = np.concatenate([found[0, :count], found[:, count:].ravel()])
        inside = np.ones(joint.size, dtype=bool)
        inside[:count] = (joint[:count] > low[:count]) & (joint[:count] < high[:count])
        assert (found[:, :count] == found[0, :count]).all()
        assert ((joint[:count] >= low[:count]) & (joint[:count] <= high[:count])).all()
        np.testing.assert_allclose((whole @ joint + slope)[inside], 0.0, atol=1e-6)
        at_limits += (~inside).sum()
        if inside.all():
            np.testing.assert_allclose(found, free)
    assert at_limits > 20


def test_two_unknowns_at_their_limits_do_not_stop_the_others():
    """The minimum without limits lies far outside, so that a step shortened as a whole would hardly move the third."""
    information = np.array([[2.0, 0.9, 0.3], [0.9, 1.0, 0.1], [0.3, 0.1, 1.0]])
    basis = factor_of(jnp.asarray(information)[None], 3).basis
    minimum = np.array([80.0, -70.0, 0.5])
    room = jnp.array([[-0.1, -0.2, -90.0]]), jnp.array([[0.1, 0.0, 90.0]])
    (found,) = np.asarray(limited_step(jnp.asarray(minimum)[None], basis, room, 3))
    assert found[0] == 0.1
    assert found[1] in (-0.2, 0.0)
    slope = information @ (found - minimum)
    assert slope[2] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("stride", [(0.1, np.inf), (np.inf, 0.1)])
@pytest.mark.parametrize("solver", [LevenbergMarquardt(), FilterError().solver])
def test_strides_end_no_search_before_the_minimum(solver, stride):
    found = solver(squares(narrow, center=(-1.0, 1.1), half_width=5.0, stride=np.array(stride)))
    assert names(found) == "successful"
    assert (np.abs(found.parameters - MINIMUM) <= 0.05 * found.std).all()


@every_solver
def test_where_a_start_is_nan_the_search_begins_at_the_center(name):
    problem, solver, starts = squares(valley, (0.2, 0.1)), solver_of(name), [[0.2, 0.1], [0.2, np.nan], [-0.9, 0.1]]
    at_center, half, elsewhere = (solver(problem, start=jnp.array(start)) for start in starts)
    assert same(at_center, half)
    assert not same(at_center, elsewhere)


@every_solver
def test_a_start_beyond_the_reach_is_moved_to_its_limit_and_rollouts_are_the_shots_and_their_derivatives(name):
    """IBSS counts derivatives only; a colony simulates without them, but at the answer."""
    shots = []
    problem, solver = squares(valley, half_width=0.5, hear=lambda x: shots.append(x)), solver_of(name)
    lower, upper = (np.asarray(limit) for limit in problem.unknowns.limits(solver.reach))
    found = solver(problem, start=jnp.array([9.0, 0.0]))
    jax.effects_barrier()
    assert [upper[0], 0.0] in [shot.tolist() for shot in shots]
    assert ((np.array(shots) >= lower - 1e-12) & (np.array(shots) <= upper + 1e-12)).all()
    assert names(found) != "nonfinite_trajectory"
    count = len(shots)
    assert int(found.rollouts) == {"IBSS": 2 * count, "AntColony": count + 2}.get(name, 3 * count)


@every_solver
def test_a_minimum_beyond_the_reach_is_reported(name):
    found = solver_of(name)(squares(quadratic, center=MINIMUM + [1.0, 0.0], half_width=0.2))
    assert names(found) == "at_bound"


def test_a_colony_searches_as_far_as_it_is_told():
    problem = squares(quadratic, center=MINIMUM + [1.2, 0.0], half_width=0.2)
    found = jaxos4.AntColony(reach=8.0)(problem)
    assert names(found) == "successful"
    assert (np.abs(found.parameters - MINIMUM) <= 0.05 * found.std).all()


@every_solver
def test_a_held_unknown_needs_neither_a_start_nor_a_bracket(name):
    """A start elsewhere does not move it, and its bracket may be empty."""
    problem, solver = squares(quadratic).hold({"x": 0.25}), solver_of(name)
    empty = jaxos4.Bracket.around(problem.unknowns.center, jnp.array([0.0, 1.0]))
    least = np.linalg.lstsq(SLOPES[:, 1:], SLOPES @ MINIMUM - SLOPES[:, 0] * 0.25)[0]
    for found in (solver(problem), solver(problem, start=jnp.array([0.9, 0.9])), solver(problem, empty)):
        assert names(found) == "successful"
        assert float(found.parameters[0]) == 0.25
        assert abs(float(found.parameters[1] - least[0])) <= 0.05 * float(found.std[1])
        np.testing.assert_array_equal(found.covariance[0], 0.0)
        np.testing.assert_allclose(found.covariance[1, 1], 1 / np.square(SLOPES[:, 1]).sum(), rtol=1e-6)


@pytest.mark.parametrize("name", [name for name in SOLVERS if name != "AntColony"])
def test_the_best_answer_of_several_starts_counts(name):
    """The second unknown is no parameter: each start has its value."""
    starts = jnp.array([[0.1, 1.1], [0.1, -1.1]])
    low, high, both = (
        solver_of(name)(squares(two_minima, half_width=0.5, parameter_count=1, starts=some))
        for some in (starts[:1], starts[1:], starts)
    )
    assert float(high.parameters[1]) < 0 < float(low.parameters[1])
    np.testing.assert_allclose(both.parameters, low.parameters, atol=1e-6)
    assert int(both.rollouts) > int(low.rollouts)


def bent(x):
    """`quadratic` with a curvature, so that the first shots miss the minimum."""
    return quadratic(x) + 3 * (x[0] - MINIMUM[0]) ** 2 * np.array([1, -1, 2])


@pytest.mark.parametrize(("widest", "result"), [(0.1, "successful"), (0.25, "max_sweeps")])
def test_slopes_that_are_wrong_end_no_search_as_a_success(widest, result):
    """Beside the minimum, IBSS goes round what is not a number, or says that it did not."""
    shots = []

    def hole(x, gradient):
        return jnp.where((x[0] > MINIMUM[0] + 0.01) & (x[0] < MINIMUM[0] + widest), jnp.nan, gradient)

    found = IBSS()(squares(bent, center=(1.0, 0.0), change=hole, hear=lambda x: shots.append(float(x[0]))))
    jax.effects_barrier()
    assert any(0.01 < shot - MINIMUM[0] < widest for shot in shots)
    assert names(found) == result
    assert result != "successful" or (np.abs(found.parameters - MINIMUM) <= 0.05 * found.std).all()


def test_a_slope_of_the_wrong_sign_ends_no_search_as_a_success():
    turned = squares(quadratic, center=(1.0, 0.0), change=lambda x, gradient: -gradient, stride=np.ones(2))
    assert names(IBSS()(turned)) != "successful"


# How much was simulated.


@pytest.mark.parametrize("halvings", [2, 3])
def test_a_sweep_of_ibss_narrows_each_bracket_and_ends_early_where_the_minimum_is(halvings):
    found = IBSS(halvings=halvings)(squares(valley))
    shots, sweeps = int(found.rollouts) // 2, int(found.sweeps)
    assert sweeps > 3
    assert 2 * sweeps <= shots <= 1 + sweeps * (1 + halvings)


@pytest.mark.slow
def test_a_shot_simulates_each_sample_of_a_flight_once():
    """Whatever the number of its tangents."""
    torques = []

    class Counting(jaxos4.PublishedOS4):
        def angular_acceleration(self, rates, forcing, parameters):
            jax.debug.callback(lambda torque: torques.append(float(torque)), forcing.roll)
            return super().angular_acceleration(rates, forcing, parameters)

    flight = standard_flight(duration=0.5)
    problem = jaxos4.ShootingProblem(Counting(), flight, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    jax.block_until_ready(jax.jit(problem.local_model)(problem.initial_guess.starts[0]).cost)
    jax.effects_barrier()
    rolls = np.asarray(problem.forcing(problem.model.alpha).roll)
    assert np.sort(torques).tolist() == np.sort(rolls[: len(torques)]).tolist()
    assert len(torques) in (50, 51)


# On flights.


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["shooting", "innovations"])
def test_the_search_of_the_documentation_finds_the_answer_of_ours(kind):
    problem = standard_problem(channels="rates", states=noisy_states(3)[2], free=True).hold({"alpha2": 0.0})
    best = (jaxos4.OutputError if kind == "shooting" else jaxos4.FilterError)()(problem)
    found = DESCENT()(problem if kind == "shooting" else jaxos4.InnovationsProblem(problem))
    assert names(found) == "successful"
    assert (np.abs(found.parameters[:8] - best.parameters) <= 0.05 * best.std).all()


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
