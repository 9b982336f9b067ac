"""Several recordings in one likelihood of innovations: each segment belongs to one, with that one's parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import CRAZYFLIE

import jaxos4
from jaxos4.shooting import InnovationsProblem, pad_flight
from jaxos4.shooting.gains import LogNoise
from jaxos4.shooting.layout import Segments

SETTLING, LENGTHS = 30, (200, 330, 100)
NOISE = LogNoise(*(jnp.log(jnp.full(3, x)) for x in (5.0, 0.1, 0.02)))


@pytest.mark.parametrize("number", [4, 9, 40])
@pytest.mark.parametrize("lengths", [LENGTHS, (10, 500, 20), (128, 128, 128), (1, 2, 1000)])
def test_each_sample_counts_once_and_no_segment_has_two_recordings(lengths, number):
    edges = np.append(0, np.cumsum(lengths))
    padded = jax.jit(lambda edges: Segments.of(number, int(edges.shape[0]) * 600, edges, SETTLING))(jnp.asarray(edges))
    for place, owned, rows, recording in (
        Segments.of(number, int(edges[-1]), edges, SETTLING),
        map(np.asarray, padded),
    ):
        np.testing.assert_array_equal(np.sort(place[owned]), np.arange(edges[-1]))
        assert not owned[:, rows:].any()
        of_sample = np.searchsorted(edges, place, side="right") - 1
        assert (of_sample == recording[:, None])[owned].all()
        for own, counts, number_of in zip(place, owned, recording, strict=True):
            if counts.any() and own[counts].min() > edges[number_of]:
                assert own[counts].min() >= edges[number_of] + SETTLING
                assert own[0] >= edges[number_of]


def flight_of(samples, seed):
    """Noise around rates that follow nothing: a likelihood needs no true parameters."""
    rng = np.random.default_rng(seed)
    states = np.cumsum(0.05 * rng.normal(size=(samples, 12)), axis=0)
    omega = float(CRAZYFLIE.hover_speed) * rng.uniform(0.9, 1.1, size=(samples, 4))
    return jaxos4.Flight(0.004 * np.arange(samples), omega, states, stretch=jnp.zeros(samples, dtype=int))


def joined(flights):
    """One flight of several recordings, whose time counts samples."""
    number = np.repeat(np.arange(len(flights)), [each.time.shape[0] for each in flights])
    omega, states = (np.concatenate([getattr(each, name) for each in flights]) for name in ("omega", "states"))
    return jaxos4.Flight(0.004 * np.arange(len(number)), omega, states, stretch=jnp.asarray(number))


def problem_of(flight, recordings, segments):
    """Flights of one recording are padded, and share one program."""
    model = jaxos4.FlightModel(CRAZYFLIE, terms=("offset", "damping", "lag"), recordings=recordings)
    capacity = max(LENGTHS) if len(recordings) == 1 else flight.time.size
    known = {"sigma": np.full(12, 0.02), "channels": "rates", "method": "rk4", "length": jnp.asarray(flight.time.size)}
    shooting = jaxos4.ShootingProblem(model, pad_flight(flight, capacity), **known)
    return InnovationsProblem(shooting, segments=segments, settling=SETTLING)


@eqx.filter_jit
def local_model_of(problem, values):
    return problem.local_model(values[None])


def likelihood(problem, values):
    """Cost, gradient and information without the prior."""
    found, unknowns = local_model_of(problem, values), problem.unknowns.usable
    prior = (unknowns.precision * jnp.square(values - unknowns.center)).sum() / 2
    parts = jax.tree.map(lambda leaf: np.asarray(leaf).sum(axis=0), found.parts)
    return float(found.cost[0] - prior), parts.gradient, parts.information


@pytest.mark.slow
def test_the_likelihood_is_the_sum_over_recordings():
    """Cost, gradient and information, of parameters that are shared and of those that are not."""
    flights = [flight_of(samples, seed) for seed, samples in enumerate(LENGTHS)]
    whole = problem_of(joined(flights), (0, 1, 2), segments=4)
    names, count = whole.unknowns.names, whole.problem.unknowns.count
    values = whole.model.alpha + 0.1 * whole.model.half_width * jnp.cos(jnp.arange(count))
    values = jnp.concatenate([values, jnp.stack(NOISE[:3], axis=1).ravel()])
    cost, gradient, information = 0.0, np.zeros(len(names)), np.zeros((len(names),) * 2)
    for i, flight in enumerate(flights):
        alone = problem_of(flight, (0,), segments=1)
        place = np.array([names.index(n if n in names else f"{n}_{i + 1}") for n in alone.unknowns.names])
        own = likelihood(alone, values[place])
        cost += own[0]
        np.add.at(gradient, place, own[1])
        np.add.at(information, (place[:, None], place), own[2])
    found = likelihood(whole, values)
    scale = np.sqrt(np.diagonal(information))
    assert {f"roll_offset_{i + 1}" for i in range(3)} <= {*names}
    assert found[0] == pytest.approx(cost, rel=1e-9)
    np.testing.assert_allclose(found[1] / scale, gradient / scale, atol=1e-6)
    np.testing.assert_allclose(found[2] / np.outer(scale, scale), information / np.outer(scale, scale), atol=1e-8)


def test_segments_must_be_more_than_recordings():
    flight = joined([flight_of(samples, seed) for seed, samples in enumerate(LENGTHS)])
    with pytest.raises(ValueError, match="`segments` must be more than the 3 recordings, got 3"):
        problem_of(flight, (0, 1, 2), segments=3)
