"""Every batch program lowers for CUDA and TPU, without a call of a library such as LAPACK, and without one of the host.

No accelerator is needed: the programs are only lowered. Where a CPU takes another branch, that of a GPU is traced.
"""

import re

import equinox as eqx
import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE
from small_network import BRACKET, OMEGA, PUBLISHED, problem_of, trained

import jaxos4
from jaxos4.estimators import ESTIMATORS, make_estimator
from jaxos4.noise import NOISES
from jaxos4.simulation import METHODS

PLATFORMS = "cuda", "tpu"
LANES = 37  # more than a block of a CPU, and no other test's: JAX keeps what it has traced
STATES, KEYS = np.zeros((LANES, len(OMEGA), 12)), jax.random.split(jax.random.key(0), LANES)


@pytest.fixture
def foreign(monkeypatch):
    """The calls in the program of a function of these arguments, beside XLA's own operations."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")

    def calls(function, *arguments):
        arrays, settings = eqx.partition(arguments, eqx.is_array)

        def of_arrays(arrays):
            return eqx.filter(function(*eqx.combine(arrays, settings)), eqx.is_array)

        text = jax.export.export(jax.jit(of_arrays), platforms=PLATFORMS)(arrays).mlir_module()
        return set(re.findall(r"custom_call\s*@(\w+)|stablehlo\.(send|recv|infeed|outfeed)\b", text))

    return calls


def test_calls_of_a_library_and_of_the_host_are_found(foreign):
    matrices = jnp.ones((LANES, 3, 3))
    assert foreign(jax.vmap(jnp.linalg.cholesky), matrices)
    assert foreign(jax.vmap(jnp.linalg.solve), matrices, matrices)
    for of_the_host in (lambda x: jax.pure_callback(np.sin, x, x), lambda x: eqx.error_if(x, x.sum() > 0, "never")):
        with pytest.raises(NotImplementedError, match="callback"):  # JAX cannot lower one for two platforms at once
            foreign(of_the_host, matrices)
    assert not foreign(jnp.sin, matrices)


# One lane of each batch program, and the lanes.


def estimates(name):
    estimator = make_estimator(name, trained() if ESTIMATORS[name].needs_network else None)
    return lambda states: estimator(problem_of(states), BRACKET), STATES


def simulated(method):
    return lambda alpha: jaxos4.simulate(PUBLISHED(), alpha, OMEGA, dt=0.01, method=method), np.ones((LANES, 8))


def noisy(kind):
    flight = jaxos4.simulate(PUBLISHED(), PUBLISHED().alpha, OMEGA, dt=0.01)
    return lambda key: NOISES[kind](jaxos4.SENSOR_SIGMA)(flight, key=key), KEYS


def in_closed_loop(airframe):
    return lambda key: jaxos4.fly_closed_loop(jaxos4.ClosedLoop(airframe), jnp.zeros((21, 4)), key=key), KEYS


def shots(free):
    """With their derivatives and bounds."""

    def one(states, alpha):
        problem = problem_of(states, channels="all", free=free)
        start = problem.first_state()[0]
        shot, model = problem.shots(alpha, start), problem.local_model(problem.join(alpha, start))
        return shot, model, problem.residuals(alpha), jaxos4.cramer_rao_bound(problem, alpha)

    return one, STATES, np.ones((LANES, 8))


PROGRAMS = [(in_closed_loop, CRAZYFLIE), (shots, False), (shots, True), *((estimates, name) for name in ESTIMATORS)]
PROGRAMS += [(noisy, kind) for kind in NOISES]
PROGRAMS += [(simulated, method) for method in sorted(METHODS.keys() - {"diffrax"})]  # diffrax calls the host


@pytest.mark.slow
@pytest.mark.parametrize(("program", "of"), PROGRAMS)
def test_a_batch_needs_no_library_and_no_host(foreign, program, of):
    one, *lanes = program(of)
    assert not foreign(jax.vmap(one), *lanes)
