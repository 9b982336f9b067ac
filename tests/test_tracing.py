"""Other numbers of the same shapes are other data, not another program.

`eqx.filter_eval_shape` traces a program as a call does, but does not compile it, which takes long.
"""

import functools

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import standard_flight

import jaxos4
from jaxos4.simulation import METHODS

DURATION = 0.1


@pytest.fixture
def counted():
    """A new model class, and the number of times that a program of it was traced: each calls `forcing`."""
    count = [0]

    class Counted(jaxos4.PublishedOS4):
        def forcing(self, inputs, parameters):
            count[0] += 1
            return super().forcing(inputs, parameters)

    return Counted, count


def model_of(model_class, trial):
    """The OS4 with another mass and other inertias."""
    model = model_class()
    mass, inertia = model.airframe.mass * (1 + trial), model.airframe.inertia * (1 + trial)
    return eqx.tree_at(lambda m: (m.airframe.mass, m.airframe.inertia), model, (mass, inertia))


def problem_of(model_class, trial):
    flight = standard_flight(duration=DURATION)
    return jaxos4.ShootingProblem(
        model_of(model_class, trial),
        eqx.tree_at(lambda f: f.states, flight, flight.states + trial),
        sigma=(1.0 + trial) * jaxos4.SENSOR_SIGMA,
        initial_state=np.full(12, 0.01 * trial),
        channels="rates",
    )


@pytest.mark.parametrize("method", METHODS)
def test_simulates_another_flight_without_another_trace(counted, method):
    model_class, count = counted
    omega = standard_flight(duration=DURATION).omega
    for trial, dt in enumerate((0.01, 0.02, np.float64(0.03), jnp.asarray(0.04))):
        model, start = model_of(model_class, trial), jnp.full(12, 0.01 * trial)
        simulate = functools.partial(jaxos4.simulate, dt=dt, method=method)
        eqx.filter_eval_shape(simulate, model, model.alpha, omega + trial, initial_state=start)
    assert count[0] == 1


@pytest.mark.parametrize("what", ["cost", "residuals", "predict"])
def test_shoots_at_another_problem_without_another_trace(counted, what):
    model_class, count = counted
    counts = []
    for trial in range(3):
        problem = problem_of(model_class, trial)
        shoot = getattr(jaxos4.ShootingProblem, what)
        eqx.filter_eval_shape(shoot, problem, 1.1 * problem.model.alpha, problem.first_state()[0])
        counts.append(count[0])
    assert counts[0] == counts[-1]


def test_the_estimator_itself_traces_once(counted):
    model_class, count = counted
    counts = []
    for trial in range(3):
        problem = problem_of(model_class, trial)
        bracket = jaxos4.Bracket.around(problem.model.alpha, (1 + trial) * jaxos4.DEFAULT_HALF_WIDTH)
        eqx.filter_eval_shape(jaxos4.IBSS(tolerance=0.01 * (1 + trial), reach=4 - trial), problem, bracket)
        counts.append(count[0])
    assert counts[0] == counts[-1]
    # Another kind of problem is seen.
    eqx.filter_eval_shape(jaxos4.IBSS(), problem.restrict("attitude"), bracket)
    assert count[0] > counts[0]


def test_the_count_would_see_a_second_trace(counted):
    """A sample more is another program."""
    model_class, count = counted
    model, simulate = model_class(), functools.partial(jaxos4.simulate, dt=0.01)
    for samples in (5, 6):
        eqx.filter_eval_shape(simulate, model, model.alpha, jnp.full((samples, 4), 200.0))
    assert count[0] == 2
