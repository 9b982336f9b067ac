"""The ant colony finds the optimum of IBSS, by the kernels of its source. Its laws: `test_estimators.py`."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import noisy_states, standard_problem
from lanes import LANES, bound, identify, lanes, names

import jaxos4
from jaxos4.estimators.ant_colony import _directions


def test_the_colony_reaches_the_optimum_of_ibss_with_many_more_rollouts():
    arguments = lanes(noisy_states(LANES, seed=50))
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
