"""Bi-section shooting and the ant colony: settings, starts, counts, kernels. Their errors: `test_errors.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import noisy_states, same, standard_flight, standard_problem
from lanes import HALF, bound, errors, identify, lanes, names

import jaxos4
from jaxos4.estimators.ant_colony import _directions

PUBLISHED = jaxos4.PublishedOS4
FEW = 16  # lanes of a batch


def test_where_a_start_is_nan_the_search_begins_at_the_center():
    arguments = lanes(noisy_states(FEW))
    center = (arguments[-1] + arguments[-2]) / 2
    found = [identify(jaxos4.IBSS(), *arguments, start) for start in (center, center.at[7, 2].set(jnp.nan))]
    assert same(*found)
    assert set(names(found[0])) == {"successful"}
    elsewhere = identify(jaxos4.IBSS(), *arguments, center.at[7, 2].add(0.5 * HALF[2]))
    assert not np.array_equal(elsewhere.parameters[7], found[0].parameters[7])


def test_too_few_sweeps_are_reported():
    estimates = identify(jaxos4.IBSS(max_sweeps=1, tolerance=1e-8), *lanes(noisy_states(FEW)))
    assert set(names(estimates)) == {"max_sweeps"}
    assert np.isfinite(estimates.parameters).all()
    assert (np.asarray(estimates.sweeps) == 3).all()  # one for each share of the flight


@eqx.filter_jit
def table_of(estimator, problem, states, *ends):
    """An estimate for each flight and each bracket."""

    def one(states, *ends):
        return estimator(eqx.tree_at(lambda p: p.flight.states, problem, states), jaxos4.Bracket(*ends))

    return jax.vmap(jax.vmap(one, in_axes=(None, 0, 0)), in_axes=(0, None, None))(states, *ends)


def test_vmaps_over_brackets_flights_and_both():
    """A table of flights by brackets, in one call, is a row of lanes. That a lane is an estimate: `test_estimators`."""
    states, estimator = noisy_states(2), jaxos4.IBSS(tolerance=1e-4)
    centers = np.asarray(PUBLISHED().alpha) + np.array([[0.0], [0.4], [-0.4]]) * HALF
    problem = standard_problem(channels="rates")
    table = table_of(estimator, problem, states, centers - HALF, centers + HALF)
    assert table.parameters.shape == (2, 3, 8)
    assert table.std.shape == (2, 3, 8)
    sigma = np.asarray(table.std[0, 0])
    columns = (
        np.repeat(states, 3, axis=0),
        np.tile(problem.flight.omega, (6, 1, 1)),
        *(np.tile(centers + h, (2, 1)) for h in (-HALF, HALF)),
    )
    row = identify(estimator, problem, *(jnp.asarray(np.resize(x, (FEW, *x.shape[1:]))) for x in columns))
    np.testing.assert_allclose(table.parameters.reshape(6, 8) / sigma, row.parameters[:6] / sigma, atol=1e-6)
    # Where it began does not matter, and two flights are two estimates.
    assert np.abs((table.parameters - table.parameters[:, :1]) / sigma).max() < 1e-2
    assert np.abs((table.parameters[0] - table.parameters[1]) / sigma).max() > 0.1
    assert set(names(table).ravel()) == {"successful"}
    assert np.abs(errors(table)).max() < 1


@eqx.filter_jit
def jacobian(problem, parameters):
    """The residuals' derivatives, and the residuals."""
    return jax.jacfwd(lambda x: (problem.residuals(x),) * 2, has_aux=True)(parameters)


def maximum_likelihood(problem):
    """By Gauss-Newton steps on a Jacobian of the residuals."""
    parameters = problem.model.alpha
    for _ in range(6):
        slopes, residuals = jacobian(problem, parameters)
        parameters = parameters - np.linalg.lstsq(slopes, residuals, rcond=None)[0]
    return np.asarray(parameters)


@pytest.mark.parametrize("directions", ["whitened", "coordinate"])
def test_both_kinds_of_directions_reach_the_maximum_of_the_likelihood(directions):
    states, count = noisy_states(FEW, seed=5), 4
    best = np.stack([maximum_likelihood(standard_problem(channels="rates", states=s)) for s in states[:count]])
    # What the default tolerance allows is far below the noise.
    for settings, most in (({"tolerance": 1e-5}, 1e-4), ({}, 0.05)):
        estimates = identify(jaxos4.IBSS(directions=directions, **settings), *lanes(states))
        assert set(names(estimates)) == {"successful"}
        assert np.abs((estimates.parameters[:count] - best) / bound()).max() < most


def test_rollouts_are_counted_right():
    """Each simulated step calls back with its torque; the first torque starts a shot, on however many samples."""
    torques = []

    class Counting(PUBLISHED):
        def angular_acceleration(self, rates, forcing, parameters):
            jax.debug.callback(lambda torque: torques.append(float(torque)), forcing.roll)
            return super().angular_acceleration(rates, forcing, parameters)

    flight = standard_flight(duration=0.5)
    states = noisy_states(1, duration=0.5)[0]
    free, slow = None, {"directions": "coordinate", "halvings": 3, "max_sweeps": 5}
    for start, unknowns, most, settings in ((flight.states[0], 8, 2, {}), (free, 11, 3 * 11, slow)):
        problem = jaxos4.ShootingProblem(
            Counting(),
            eqx.tree_at(lambda f: f.states, flight, states),
            sigma=jaxos4.SENSOR_SIGMA,
            channels="rates",
            initial_state=start,
        )
        torques.clear()
        bracket = jaxos4.Bracket.around(PUBLISHED().alpha + 0.5 * HALF, HALF)
        estimate = jaxos4.IBSS(**settings)(problem, bracket)
        jax.effects_barrier()
        rolls = np.asarray(problem.forcing(problem.model.alpha).roll)
        assert (rolls == rolls[0]).sum() == 1
        shots = torques.count(float(rolls[0]))
        sweeps = int(estimate.sweeps)
        assert int(estimate.rollouts) == unknowns * shots  # each shot carries one tangent for every unknown
        assert sweeps > 3
        # A sweep looks around and narrows each bracket; it ends early where the minimum is.
        assert 2 * sweeps <= shots <= 3 + sweeps * (1 + most)


def test_the_colony_reaches_the_optimum_of_ibss_with_many_more_rollouts():
    arguments = lanes(noisy_states(FEW, seed=50))
    colony, ibss = (identify(estimator, *arguments) for estimator in (jaxos4.AntColony(), jaxos4.IBSS()))
    assert set(names(colony)) == {"successful"}
    # A cost of 0.005 is an error of 0.1 standard deviations.
    assert (np.abs(colony.cost - ibss.cost) < 5 * jaxos4.AntColony().tolerance).all()
    assert (np.abs(colony.parameters - ibss.parameters) < 0.1 * bound()).all()
    np.testing.assert_allclose(colony.std, ibss.std, rtol=0.01)
    assert (np.asarray(colony.rollouts) > 5 * np.asarray(ibss.rollouts)).all()


def test_each_simulated_point_is_counted(monkeypatch):
    """The count is that of calls while the program runs. A search that is stopped says so."""
    calls, shots = [], jaxos4.ShootingProblem.shots

    def counted(problem, parameters, initial_state):
        jax.debug.callback(lambda _: calls.append(1), parameters)
        return shots(problem, parameters, initial_state)

    monkeypatch.setattr(jaxos4.ShootingProblem, "shots", counted)
    problem = standard_problem(channels="rates")
    # No other test has so many ants, and so the program that counts.
    estimate = jaxos4.AntColony(ants=9, max_sweeps=3)(problem, jaxos4.Bracket.default(problem.model))
    jax.effects_barrier()
    assert len(calls) == 50 + 3 * 9
    assert int(estimate.rollouts) == len(calls) + 1 + 8  # and the information: a shot with eight tangents
    assert (int(estimate.sweeps), str(names(estimate))) == (3, "max_sweeps")


def test_new_points_have_the_distribution_of_the_reference():
    """Socha and Dorigo 2008, sec. 3: a mixture of Gaussians, here of one unknown, against NumPy."""
    k, ants, q, xi = 20, 4000, 0.2, 0.85
    points = np.random.default_rng(0).normal(size=(k, 1))
    colony = jaxos4.AntColony(archive=k, ants=ants, q=q, xi=xi)
    drawn = np.asarray(eqx.filter_jit(colony._sample)(jnp.asarray(points), jax.random.key(0)))[:, 0]

    rank = np.arange(1, k + 1)
    weight = np.exp(-((rank - 1) ** 2) / (2 * q**2 * k**2)) / (q * k * np.sqrt(2 * np.pi))
    weight /= weight.sum()
    kernel = xi * np.abs(points - points.T).sum(axis=0) / (k - 1)
    mean = weight @ points[:, 0]
    variance = weight @ (kernel**2 + (points[:, 0] - mean) ** 2)
    squares = (drawn - mean) ** 2
    assert abs(drawn.mean() - mean) < 4 * np.sqrt(variance / ants)
    assert abs(squares.mean() - variance) < 4 * squares.std() / np.sqrt(ants)


def test_the_directions_are_orthonormal_and_none_is_invented():
    generator, draw = np.random.default_rng(0), jax.jit(_directions)
    basis = np.asarray(draw(generator.normal(size=(20, 5)) * np.geomspace(1, 1e-4, 5), jax.random.key(0)))
    np.testing.assert_allclose(basis @ basis.T, np.eye(5), atol=1e-9)
    # Points of a plane have two directions, a single point has none.
    plane = generator.normal(size=(20, 2)) @ np.eye(5)[:2]
    lengths = np.linalg.norm(draw(plane, jax.random.key(0)), axis=1)
    np.testing.assert_allclose(lengths, [1, 1, 0, 0, 0])
    assert (np.asarray(draw(np.zeros((20, 5)), jax.random.key(0))) == 0).all()
