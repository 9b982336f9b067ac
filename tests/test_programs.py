"""How many programs an identification compiles, which are kept, and that other numbers of one shape are other data.

`eqx.filter_eval_shape` traces a program as a call does, but does not compile it, which takes long.
"""

import functools
import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import compiled_programs, curvatures, first_state, noisy_states, standard_flight, standard_problem

import jaxos4
from jaxos4 import _programs
from jaxos4.bracket import _default
from jaxos4.cli import _jax
from jaxos4.shooting import for_threads, padded
from jaxos4.simulation import METHODS

# The search, the simulation with all derivatives, the default bracket, the intervals, a comparison of result codes.
BUDGET = 6


def recorded(samples, model, seed=0):
    """A noisy flight of this many samples; every third velocity is missing."""
    flight = standard_flight(type(model))
    states = np.array(noisy_states(1, type(model), seed=seed)[0][:samples])
    states[::3, 1] = np.nan
    return jaxos4.Flight(np.asarray(flight.time)[:samples], np.asarray(flight.omega)[:samples], states)


def test_an_identification_is_few_programs_and_the_next_one_none():
    """The second flight has another length, and another vehicle flew it."""
    model = jaxos4.PublishedOS4()
    other = eqx.tree_at(lambda m: m.airframe.inertia, model, 1.1 * np.asarray(model.airframe.inertia))
    flights = recorded(501, model), recorded(420, other)
    jax.clear_caches()
    with compiled_programs() as first:
        jaxos4.identify(flights[0], model)
    assert 2 <= len(first) <= BUDGET, first
    with compiled_programs() as second:
        jaxos4.identify(flights[1], other)
    assert second == []


@eqx.filter_jit
def cost_and_residuals(problem, *at):
    return problem.cost(*at), problem.residuals(*at).reshape(-1, problem.size)


def test_other_limits_and_tolerances_of_a_search_need_no_other_program():
    problem = standard_problem(states=noisy_states(1)[0], channels="rates", free=True)
    bracket = jaxos4.Bracket.default(problem.model)
    for make, settings in (
        (jaxos4.OutputError, {"max_steps": 7, "tolerance": 1e-3}),
        (jaxos4.EquationError, {"bridge": 7}),
    ):
        make()(problem, bracket)
        other = make(**settings)
        with compiled_programs() as programs:
            other(problem, bracket)
        assert not programs


def test_a_batch_is_the_same_on_any_number_of_cores_by_one_program(monkeypatch):
    """150 flights: the last of three chunks begins with flights of the second. `shared` has a leaf that is no array."""
    problem, states = standard_problem(channels="rates"), jnp.asarray(noisy_states(150))

    def identify(states, problem, negative):
        problem = eqx.tree_at(lambda p: p.flight.states, problem, states)
        return negative(jaxos4.OutputError()(problem, jaxos4.Bracket.default(problem.model)).parameters)

    fit, found, counts = jaxos4.on_all_cores(identify), [], []
    for cores in ("1", "2"):
        monkeypatch.setenv("JAX_NUM_CPU_DEVICES", cores)
        with compiled_programs() as programs:
            found.append(fit(states, problem, jnp.negative))
        counts.append(programs.count("jit(chunk)"))
    assert counts == [1, 0]
    np.testing.assert_array_equal(*found)
    alone = [identify(states[i], problem, jnp.negative) for i in (0, 100, 149)]
    np.testing.assert_allclose(found[0][np.array([0, 100, 149])], alone, rtol=1e-9)


@pytest.mark.parametrize("double", [False, True])
def test_another_thread_has_the_precision_of_its_caller(double):
    with jax.enable_x64(double), ThreadPoolExecutor(1) as other:
        kind = other.submit(for_threads(lambda: jnp.zeros(()).dtype)).result()
    assert kind == (jnp.float64 if double else jnp.float32)


@pytest.mark.parametrize("channels", ["rates", "all"])
def test_padding_changes_no_result(channels):
    problem = standard_problem(states=noisy_states(1)[0], channels=channels, free=True)
    longer, bracket = padded(problem), jaxos4.Bracket.default(problem.model)
    assert longer.flight.time.shape[0] > 501
    found, again = (jaxos4.IBSS()(p, bracket) for p in (problem, longer))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9)
    at = (found.parameters, found.initial_state)
    (own_cost, own), (cost, residuals) = (cost_and_residuals(p, *at) for p in (problem, longer))
    np.testing.assert_allclose(cost, own_cost, rtol=1e-12)
    np.testing.assert_allclose(residuals[:501], own, rtol=1e-9)
    assert not residuals[501:].any()


@pytest.mark.parametrize("windows", [1, 5])
def test_an_evaluation_has_the_cost_and_the_information_of_the_problem(windows):
    problem = standard_problem(states=noisy_states(1)[0], channels="attitude", free=True)
    problem = jaxos4.ShootingProblem(
        problem.model, problem.flight, sigma=problem.sigma, channels="attitude", windows=windows
    )
    found, start = jaxos4.evaluate(problem, problem.model.alpha), first_state(problem)
    expected = curvatures(problem, problem.model.alpha, start)
    assert found.feasible
    np.testing.assert_allclose(found.cost, expected.shot.cost.sum(), rtol=1e-12)
    scale = np.sqrt(np.abs(np.asarray(expected.information)).max())
    np.testing.assert_allclose(found.information / scale**2, expected.information / scale**2, atol=1e-12)
    bound = np.asarray(jaxos4.cramer_rao_bound(problem, problem.model.alpha))
    unit = np.sqrt(np.diagonal(bound))
    np.testing.assert_allclose(found.covariance / np.outer(unit, unit), bound / np.outer(unit, unit), atol=1e-9)
    diverged = jaxos4.evaluate(problem, jnp.asarray(np.where(np.arange(8) == 2, 1e9, problem.model.alpha)))
    assert not diverged.feasible
    assert diverged.cost == float("inf")


@pytest.mark.skipif("small_while_loop" not in os.environ["XLA_FLAGS"], reason="XLA_FLAGS are the user's own")
def test_a_search_is_one_native_loop():
    """If XLA called a function for each few operations of a step instead, a flight would take ten times as long."""
    search = eqx.filter_jit(lambda problem, bracket: jaxos4.OutputError()(problem, bracket))
    problem = standard_problem(channels="rates")
    program = search.lower(problem, jaxos4.Bracket.default(problem.model)).compile().compiled.as_text()
    assert "xla_cpu_small_call" in program
    entry = program[program.index("\nENTRY") :]
    assert " while(" not in entry


# Tracing.

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
    # A sample less is another program.
    eqx.filter_eval_shape(simulate, model, model.alpha, omega[1:], initial_state=start)
    assert count[0] == 2


def shot(what):
    def shoot(problem, trial):
        return getattr(jaxos4.ShootingProblem, what)(problem, 1.1 * problem.model.alpha, problem.first_state()[0])

    return shoot


def search(problem, trial):
    bracket = jaxos4.Bracket.around(problem.model.alpha, (1 + trial) * jaxos4.DEFAULT_HALF_WIDTH)
    return jaxos4.IBSS(tolerance=0.01 * (1 + trial), reach=4 - trial)(problem, bracket)


@pytest.mark.parametrize("compute", [shot("cost"), shot("residuals"), shot("predict"), search])
def test_another_problem_needs_no_other_trace(counted, compute):
    model_class, count = counted
    counts = []
    for trial in range(3):
        eqx.filter_eval_shape(lambda problem, trial=trial: compute(problem, trial), problem_of(model_class, trial))
        counts.append(count[0])
    assert counts[0] == counts[-1]
    # Another kind of problem is seen.
    eqx.filter_eval_shape(lambda problem: compute(problem, 0), problem_of(model_class, 0).restrict("attitude"))
    assert count[0] > counts[0]


# Programs that are kept for the next process.


@pytest.fixture
def kept(tmp_path, monkeypatch):
    """Looks for the program of a function as the command line does, in a folder of files, as another process does."""
    before = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    monkeypatch.setattr(_programs, "_surroundings", [b"this process"])

    def find(*args, function=_default.__wrapped__):
        monkeypatch.setattr(_programs, "_programs", {})
        return _programs.kept_program(function, {}, args, {})

    yield find
    jax.config.update("jax_compilation_cache_dir", before)


def test_a_folder_that_the_user_chose_is_kept(kept, tmp_path, monkeypatch):
    monkeypatch.setattr(_jax, "_usable_folder", None)  # the default folder would call it
    _jax.prepare()
    assert jax.config.values["jax_compilation_cache_dir"] == str(tmp_path)
    assert kept(jaxos4.PublishedOS4(jaxos4.OS4)) is not None
    assert len(list(tmp_path.glob("jaxos4-*"))) == 1


class OwnModel(jaxos4.CorrectedOS4):
    """A model whose source the package does not know."""


def test_a_program_is_traced_once_for_all_processes_unless_its_code_is_not_known(kept, tmp_path, monkeypatch):
    function, one, other = _default.__wrapped__, jaxos4.PublishedOS4(jaxos4.OS4), jaxos4.PublishedOS4(jaxos4.VOOS)

    def files():
        return {path.name: path.read_bytes() for path in tmp_path.glob("jaxos4-*")}

    for model in (one, other):
        for found, expected in zip(*map(jax.tree.leaves, (kept(model)(model), function(model))), strict=True):
            np.testing.assert_allclose(found, expected, rtol=1e-14)
    written = files()
    assert len(written) == 1
    with monkeypatch.context() as patch:
        patch.setattr(_programs, "_write", None)  # tracing would call it
        assert jax.tree.structure(kept(one)(one)) == jax.tree.structure(function(one))
    # Another static value, and other sources, are other programs.
    kept(jaxos4.CorrectedOS4(jaxos4.OS4))
    with monkeypatch.context() as patch:
        patch.setattr(_programs, "_surroundings", [b"changed"])
        kept(one)
    assert len(files()) == 3
    # A damaged file is written again.
    for name, content in written.items():
        (tmp_path / name).write_bytes(content[:-1])
    assert kept(one) is not None
    assert all(_programs._read(tmp_path / name) for name in written)
    assert kept(OwnModel(jaxos4.OS4)) is None
    assert kept(1.0, function=lambda x: x) is None
    assert kept(np.ones(1), function=np.shape) is None  # its results are no arrays
    assert len(files()) == 3
    with monkeypatch.context() as patch:
        patch.setattr(_programs, "_surroundings", [])  # not the command line
        assert kept(one) is None
    jax.config.update("jax_compilation_cache_dir", None)
    assert kept(one) is None


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="this system has no users of POSIX")
def test_a_program_that_another_user_owns_or_can_write_to_is_not_read(kept, tmp_path, monkeypatch):
    """To read it would run that user's code. The folder is not used at all; a file is written again."""
    model, us = jaxos4.PublishedOS4(jaxos4.OS4), os.getuid()
    assert kept(model) is not None
    (path,) = tmp_path.glob("jaxos4-*")
    assert path.stat().st_mode & 0o777 == 0o600

    def read():
        """Whether the file is read, if there is a program."""
        found, loads = [], _programs.pickle.loads
        with monkeypatch.context() as patch:
            patch.setattr(_programs.pickle, "loads", lambda content: found.append(content) or loads(content))
            return None if kept(model) is None else bool(found)

    assert read() is True
    for mode in (0o620, 0o602):
        path.chmod(mode)
        assert read() is False
        assert (read(), path.stat().st_mode & 0o777) == (True, 0o600)
    for mode in (0o720, 0o702):
        tmp_path.chmod(mode)
        assert read() is None
    with monkeypatch.context() as patch:
        patch.delattr(os, "getuid")  # as on Windows
        assert read() is True
    tmp_path.chmod(0o700)
    monkeypatch.setattr(os, "getuid", lambda: us + 1)
    assert read() is None
    assert _programs._read(path) is None
    path.unlink()
    assert read() is None
    assert not list(tmp_path.glob("jaxos4-*"))
