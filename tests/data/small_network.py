"""A small network, and noisy flights for it to identify, in one program for all numbers of flights."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from helpers import DT, standard_flight
from lanes import LANES

import jaxos4

PUBLISHED, CORRECTED = jaxos4.PublishedOS4, jaxos4.CorrectedOS4
DURATION = 3.0
SMALL = {"width": 32, "depth": 2, "steps": 1000, "batch": 64, "held_out": 4000}
CMAC = {"architecture": "cmac", "tilings": 4, "cells": 8, "steps": 250}
SHORT = SMALL | {"steps": 5, "held_out": 1000}
BRACKET = jaxos4.Bracket.default(PUBLISHED())
OMEGA = standard_flight(duration=DURATION).omega
MANY = 2000  # flights of a statistical test
LEVELS = (0.5, 0.9, 0.99)


def problem_of(states=None, *, noise=1.0, channels="rates", free=False, model=None, omega=OMEGA, dt=DT, **kwargs):
    states = standard_flight(duration=DURATION).states if states is None else states
    flight = jaxos4.Flight(dt * jnp.arange(len(omega)), omega, states)
    model = PUBLISHED() if model is None else model
    kwargs = {"initial_state": None if free else jnp.zeros(12)} | kwargs
    return jaxos4.ShootingProblem(model, flight, sigma=noise * jaxos4.SENSOR_SIGMA, channels=channels, **kwargs)


@functools.cache
def trained(free=False, seed=0, **changes):
    problem = problem_of(free=free, channels="attitude")
    return jaxos4.NetworkEstimator(**(SMALL | changes)).fit(problem, BRACKET, key=jax.random.key(seed))


def flights(count, *, seed=0, noise=1.0, start_width=(0.0, 0.0, 0.0)):
    """Parameters drawn over the bracket, initial rates over +-`start_width`, and the noisy states of their flights."""
    width = jnp.zeros(12).at[jnp.array([7, 9, 11])].set(jnp.asarray(start_width))
    rest = jax.random.key(seed), jnp.asarray(noise), width
    blocks = [fly(first + np.arange(LANES), *rest) for first in range(0, count, LANES)]  # one program for all numbers
    alpha, states = (np.concatenate(part)[:count] for part in zip(*blocks, strict=True))
    return alpha, jnp.asarray(states)


@eqx.filter_jit
def fly(numbers, key, noise, width):
    def one(i):
        alpha_key, noise_key = jax.random.split(jax.random.fold_in(key, i))
        start = width * jax.random.uniform(jax.random.fold_in(alpha_key, 1), (12,), minval=-1, maxval=1)
        alpha = BRACKET.center + BRACKET.half_width * jax.random.uniform(alpha_key, (8,), minval=-1, maxval=1)
        return alpha, jaxos4.simulate(PUBLISHED(), alpha, OMEGA, dt=DT, initial_state=start), noise_key

    sensors = jaxos4.WhiteNoise(noise * jaxos4.SENSOR_SIGMA)
    alpha, exact, keys = jax.vmap(one)(numbers)
    return alpha, jax.lax.map(lambda pair: sensors(pair[0], key=pair[1]).states, (exact, keys))


def identify(estimator, states, noise=1.0, channels="rates", free=False):
    found = identified(estimator, states, jnp.asarray(noise), channels, free)  # one program for all noises
    return jax.tree.map(np.asarray, found)


@eqx.filter_jit
def identified(estimator, states, noise, channels, free):
    return jax.vmap(lambda s: estimator(problem_of(s, noise=noise, channels=channels, free=free), BRACKET))(states)


@functools.cache
def many(noise):
    """Parameters and noisy states of many flights."""
    return flights(MANY, seed=12, noise=noise)


@functools.cache
def answered():
    """What a small network answers to them at noise 1."""
    return identify(trained(), many(1.0)[1])


@eqx.filter_jit
def half_widths(estimates):
    """For each level, those of each parameter and of all at once."""
    return {x: (estimates.half_width(x), estimates.half_width(x, simultaneous=True)) for x in LEVELS}


def names(estimates):
    return jaxos4.result_names(estimates.result).tolist()
