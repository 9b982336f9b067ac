"""The balance of weight, padding, and shifted clocks in the likelihood of a vehicle that flew in closed loop."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import CRAZYFLIE

import jaxos4
from jaxos4.shooting import InnovationsProblem
from jaxos4.shooting.innovations import SEGMENT, SETTLING, Balance
from jaxos4.shooting.padding import pad_flight

DT, SAMPLES = 0.004, SETTLING + 8 * SEGMENT
TERMS = ("offset", "lag", "delay", "accelerometer")


@functools.cache
def flown():
    keys = jax.random.split(jax.random.key(1))
    references = jaxos4.random_references(duration=DT * (SAMPLES - 1), dt=DT, key=keys[0])
    return jaxos4.fly_closed_loop(jaxos4.ClosedLoop(CRAZYFLIE, gust=2.0), references, dt=DT, key=keys[1])


def weight_of(flight):
    states, duration = np.asarray(flight.states), DT * flight.time.shape[0]
    upright = np.cos(states[:, 6]) * np.cos(states[:, 8])
    return Balance(upright / upright.size, 9.81, np.hypot(1 / duration, 0.003 * 9.81))


def problem_of(flight, *, terms=TERMS, airframe=CRAZYFLIE, balance=None):
    model = jaxos4.FlightModel(airframe, terms=terms)
    shooting = jaxos4.ShootingProblem(model, flight, sigma=np.full(12, 0.02), channels="rates", method="rk4")
    return InnovationsProblem(shooting, balance=balance)


@eqx.filter_jit
def curvature(problem, values):
    return problem.evaluator()(values, jnp.zeros(0))


@eqx.filter_jit
def searched(problem):
    return jaxos4.FilterError()(problem)


def named(problem, found):
    """Value and standard deviation of each parameter."""
    rows = zip(found.parameters.tolist(), found.std.tolist(), strict=True)
    return dict(zip(problem.problem.unknowns.names, rows, strict=False))


def test_the_balance_has_its_cost_gradient_and_information():
    terms, flight = ("delay", "fade", "accelerometer", "inflow"), flown()
    velocity = np.random.default_rng(0).normal(size=(SAMPLES, 3))
    flight = dataclasses.replace(flight, body_velocity=velocity)
    balance = weight_of(flight)
    bare, weighed = (problem_of(flight, terms=terms, balance=each) for each in (None, balance))
    values = np.array(bare.starts[0])
    place = {name: i for i, name in enumerate(bare.unknowns.names)}
    values[[place[n] for n in ("rotor_delay", "battery_fade", "thrust_gain", "z_drag")]] = 0.0, 0.01, 1.2, 0.6

    def differences(at):
        one, two = (curvature(problem, jnp.asarray(at)) for problem in (bare, weighed))
        return (np.asarray(getattr(two, n) - getattr(one, n))[0] for n in ("gradient", "information")), float(
            two.shot.cost[0] - one.shot.cost[0]
        )

    (gradient, information), cost = differences(values)
    squares = np.asarray(flight.omega) ** 2 * np.square(1 - 0.01 * np.asarray(flight.time))[:, None]
    thrust = float(CRAZYFLIE.thrust_coefficient / CRAZYFLIE.mass) * squares.sum(axis=1)
    excess = (balance.weight @ (1.2 * thrust - 0.6 * velocity[:, 2]) - 9.81) / balance.sigma
    np.testing.assert_allclose(cost, excess**2 / 2, rtol=1e-6)
    slopes = gradient / excess
    size = np.abs(np.outer(slopes, slopes)).max()
    np.testing.assert_allclose(information / size, np.outer(slopes, slopes) / size, atol=1e-6)
    for name, step in (("thrust_gain", 1e-4), ("battery_fade", 1e-5), ("z_drag", 1e-3), ("rotor_delay", 1e-5)):
        costs = [differences(values + sign * step * (np.arange(values.size) == place[name]))[1] for sign in (1, -1)]
        slope = (costs[0] - costs[1]) / (2 * step)
        np.testing.assert_allclose(gradient[place[name]], slope, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())


def test_a_thrust_that_is_off_is_found_with_a_biased_accelerometer():
    """The airframe says 20 % less thrust than there is."""
    flight = flown()
    flight = dataclasses.replace(flight, specific_force=np.asarray(flight.specific_force) + [0.0, 0.0, 0.25])
    weak = eqx.tree_at(lambda a: a.thrust_coefficient, CRAZYFLIE, 0.8 * CRAZYFLIE.thrust_coefficient)
    problem = problem_of(flight, airframe=weak, balance=weight_of(flight))
    found = named(problem, searched(problem))
    for name, truth, most in (("thrust_gain", 1.25, 0.015), ("az_bias", 0.25, 0.1)):
        value, std = found[name]
        assert std < most, (name, value, std)
        assert abs(value - truth) < 4 * std, (name, value, std)


def test_padding_changes_the_likelihood_by_rounding_only():
    flight, values = flown(), None
    found = []
    for capacity in (SAMPLES, SAMPLES + 2 * SEGMENT):
        balance = weight_of(flight)
        balance = balance._replace(weight=np.pad(balance.weight, (0, capacity - SAMPLES)))
        problem = problem_of(pad_flight(flight, capacity), balance=balance)
        values = np.asarray(problem.starts[0]) if values is None else values
        found.append(curvature(problem, jnp.asarray(values)))
    own, padded = found
    np.testing.assert_allclose(padded.shot.cost, own.shot.cost, rtol=1e-10)
    for name in ("gradient", "information"):
        one, other = (np.asarray(getattr(each, name)) for each in (own, padded))
        # The prior of the noise has its center where the differences of measurements are counted.
        np.testing.assert_allclose(other / np.abs(one).max(), one / np.abs(one).max(), atol=1e-10)


def test_shifted_clocks_give_the_same_inertias():
    """The motors are recorded 20 ms early or late: only `rotor_delay` says so."""
    flight, found = flown(), {}
    for shift in (-5, 0, 5):
        rows = np.clip(np.arange(SAMPLES) - shift, 0, SAMPLES - 1)
        problem = problem_of(dataclasses.replace(flight, omega=np.asarray(flight.omega)[rows]))
        found[shift] = named(problem, searched(problem))
    for shift in (-5, 5):
        for name in ("alpha3", "alpha6"):
            (value, std), (own, _) = found[shift][name], found[0][name]
            assert abs(value - own) < 0.3 * std, name
        moved = found[shift]["rotor_delay"][0] - found[0]["rotor_delay"][0]
        assert abs(moved + DT * shift) < 1e-3
