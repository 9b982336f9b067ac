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
from jaxos4.study import cell as cells, load_study

pytestmark = pytest.mark.slow

PLATFORMS = "cuda", "tpu"
LANES = 37  # more than a block of a CPU, and no other test's: JAX keeps what it has traced
STATES = np.zeros((LANES, len(OMEGA), 12))


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


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_batch_of_estimates(foreign, name):
    estimator = make_estimator(name, trained() if ESTIMATORS[name].needs_network else None)

    def identify(states):
        return jax.vmap(lambda one: estimator(problem_of(one), BRACKET))(states)

    assert not foreign(identify, STATES)


@pytest.mark.parametrize("method", sorted(METHODS.keys() - {"diffrax"}))  # a reference: diffrax calls the host
def test_a_batch_of_simulated_flights(foreign, method):
    def fly(alpha):
        return jax.vmap(lambda one: jaxos4.simulate(PUBLISHED(), one, OMEGA, dt=0.01, method=method))(alpha)

    assert not foreign(fly, np.ones((LANES, 8)))


def test_a_batch_of_flights_in_closed_loop(foreign):
    loop = jaxos4.ClosedLoop(CRAZYFLIE)

    def fly(keys):
        return jax.vmap(lambda key: jaxos4.fly_closed_loop(loop, jnp.zeros((21, 4)), key=key))(keys)

    assert not foreign(fly, jax.random.split(jax.random.key(0), LANES))


@pytest.mark.parametrize("free", [False, True])
def test_a_batch_of_shots_and_of_their_derivatives_and_bounds(foreign, free):
    def shoot(states, alpha):
        def one(states, alpha):
            problem = problem_of(states, channels="all", free=free)
            start = problem.first_state()[0]
            shot, model = problem.shots(alpha, start), problem.local_model(problem.join(alpha, start))
            return shot, model, problem.residuals(alpha), jaxos4.cramer_rao_bound(problem, alpha)

        return jax.vmap(one)(states, alpha)

    assert not foreign(shoot, STATES, np.ones((LANES, 8)))


SPECIFICATION = f"""
durations = [{0.01 * (len(OMEGA) - 1)}]
noises = {list(NOISES)}
scales = [1.0]
channels = ["rates"]
estimators = ["network", "hybrid"]
truth = "drawn"
flights = {LANES}
batch = {LANES}
network = {{ hybrid_channels = "rates" }}
"""


def test_the_cells_of_a_study(foreign, tmp_path):
    (tmp_path / "study.toml").write_text(SPECIFICATION)
    study = load_study(tmp_path / "study.toml")
    each = [study.cell(i) for i in range(study.count)]
    setup = cells.setup_of(study, each[0].scenario)
    blank = cells.blank_problem(study, setup, 1.0, "rates")
    for cell in each:
        if cell.scenario.estimator == "network":
            assert not foreign(lambda setup, cell=cell: cells.fly(study, setup, cell), setup), cell
        if cell.scenario.noise == "white":
            identify = lambda *args, cell=cell: cells._answers(study, cell, *args)  # noqa: E731
            assert not foreign(identify, setup, blank, STATES, trained()), cell
    assert not foreign(cells.cramer_rao_std, (np.ones((LANES, 8)), STATES), blank)
