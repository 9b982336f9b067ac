"""How many programs an identification compiles, and that other numbers of one shape are other data."""

import os
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import compiled_programs, noisy_states, standard_flight, standard_problem

import jaxos4
from jaxos4.analysis.frequency_response import frequency_response
from jaxos4.batching import for_threads, where_needed
from jaxos4.identification.judge import in_one_window
from jaxos4.shooting import padded

PROGRAMS = ["jit(__call__)", "jit(_default)", "jit(_fly)", "jit(_intervals)"]
"""The search, the default bracket, the simulation with all derivatives, the intervals."""


def recorded(samples, model, seed=0):
    """A noisy flight of this many samples; every third velocity is missing."""
    flight = standard_flight(type(model))
    states = np.array(noisy_states(1, type(model), seed=seed)[0][:samples])
    states[::3, 1] = np.nan
    return jaxos4.Flight(np.asarray(flight.time)[:samples], np.asarray(flight.omega)[:samples], states)


@pytest.mark.slow
def test_an_identification_is_four_programs_and_the_next_one_none():
    """The second flight has another length, and another vehicle flew it."""
    model = jaxos4.PublishedOS4()
    other = eqx.tree_at(lambda m: m.airframe.inertia, model, 1.1 * np.asarray(model.airframe.inertia))
    flights = recorded(501, model), recorded(420, other)
    jax.clear_caches()
    with compiled_programs() as first:
        jaxos4.identify(flights[0], model)
    assert sorted(first) == PROGRAMS
    with compiled_programs() as second:
        jaxos4.identify(flights[1], other)
    assert second == []


def test_checks_of_flights_of_other_lengths_share_their_programs():
    model = jaxos4.PublishedOS4()
    problems = (
        jaxos4.ShootingProblem(model, recorded(samples, model), sigma=jaxos4.SENSOR_SIGMA, windows=4)
        for samples in (501, 420)
    )
    programs = []
    for problem in problems:
        with compiled_programs() as compiled:
            frequency_response(in_one_window(problem), model.alpha)
        programs.append(compiled)
    assert "jit(_parts)" in programs[0]
    assert programs[1] == []


@eqx.filter_jit
def cost_and_residuals(problem, *at):
    return problem.cost(*at), problem.residuals(*at).reshape(-1, problem.size)


@pytest.mark.slow
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


@pytest.mark.slow
@pytest.mark.parametrize("double", [False, True])
def test_another_thread_has_the_precision_of_its_caller(double):
    with jax.enable_x64(double), ThreadPoolExecutor(1) as other:
        kind = other.submit(for_threads(lambda: jnp.zeros(()).dtype)).result()
    assert kind == (jnp.float64 if double else jnp.float32)


@pytest.mark.slow
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


def test_a_batch_computes_a_branch_where_a_lane_needs_it():
    """The function is called for a batch in which one lane needs it, and for no other."""
    calls = []

    def half(x):
        jax.debug.callback(lambda: calls.append(1))
        return x / 2

    @jax.jit
    @jax.vmap
    def halved_above(x, limit):
        return where_needed(x > limit, half, x, x)

    x = jnp.arange(4.0)
    np.testing.assert_array_equal(halved_above(x, jnp.full(4, 5.0)), x)
    jax.effects_barrier()
    assert not calls
    np.testing.assert_array_equal(halved_above(x, jnp.full(4, 2.0)), [0, 1, 2, 1.5])
    jax.effects_barrier()
    assert calls


def test_padding_makes_no_flight_long():
    """Output error begins a long flight with a part of it."""
    problem = standard_problem(channels="rates")
    found, again = (jaxos4.OutputError()(p) for p in (problem, padded(problem)))
    assert int(found.rollouts) == int(again.rollouts)


@pytest.mark.skipif("small_while_loop" not in os.environ["XLA_FLAGS"], reason="XLA_FLAGS are the user's own")
def test_a_search_is_one_native_loop():
    """If XLA called a function for each few operations of a step instead, a flight would take ten times as long."""
    search = eqx.filter_jit(lambda problem, bracket: jaxos4.OutputError()(problem, bracket))
    problem = standard_problem(channels="rates")
    program = search.lower(problem, jaxos4.Bracket.default(problem.model)).compile().compiled.as_text()
    assert "xla_cpu_small_call" in program
    entry = program[program.index("\nENTRY") :]
    assert " while(" not in entry
