import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import folded, measured, same

from jaxos4.flight import STATE_NAMES, Flight
from jaxos4.noise import SENSOR_SIGMA, Chain, ConstantBias, Dropouts, GaussMarkov, Quantisation, WhiteNoise

DT = 0.02
NOISES = {
    "white": WhiteNoise(SENSOR_SIGMA),
    "bias": ConstantBias(SENSOR_SIGMA, mean=0.01),
    "coloured": GaussMarkov(SENSOR_SIGMA, correlation_time=0.5),
    "quantised": Quantisation(0.05),
    "dropouts": Dropouts(0.2),
    "chain": Chain((WhiteNoise(SENSOR_SIGMA), Quantisation(0.001), Dropouts(0.1))),
}
every_noise = pytest.mark.parametrize("noise", NOISES.values(), ids=NOISES)


def make_flight(samples=50, *, states=None):
    states = jnp.sin(jnp.arange(samples * 12.0).reshape(samples, 12)) if states is None else states
    time, omega = DT * jnp.arange(samples), jnp.full((samples, 4), 200.0)
    return Flight(time=time, omega=omega, states=states, specific_force=jnp.ones((samples, 3)))


def errors(noise, samples, *, trials=None):
    """The errors that `noise` adds: (samples, 12), or (trials, samples, 12). Trial i draws from `fold_in(key, i)`."""
    key, flight = jax.random.key(0), make_flight(samples, states=jnp.zeros((samples, 12)))
    if trials is None:
        return np.asarray(noise(flight, key=key).states)
    return np.asarray(measured(noise, flight, folded(key, jnp.arange(trials))))


def assert_within(estimate, truth, standard_error, limit=4.0):
    """All channels are within `limit` standard errors. By chance, one of 1,300 sets of 12 channels is not."""
    z = np.abs(np.asarray(estimate) - truth) / standard_error
    assert z.max() < limit, z


# Laws of every noise.


@every_noise
def test_the_key_decides_the_states_in_a_batch_too_and_what_was_not_measured_stays_nan(noise):
    flight, keys = make_flight(), [jax.random.key(seed) for seed in (1, 1, 2)]
    first, again, other = (noise(flight, key=key) for key in keys)
    assert same(first, again)
    assert isinstance(noise, Quantisation) == np.array_equal(first.states, other.states, equal_nan=True)
    assert not np.array_equal(first.states, flight.states)
    assert same(eqx.tree_at(lambda f: f.states, first, flight.states), flight)
    assert first.states.dtype == flight.states.dtype
    batch = eqx.filter_jit(eqx.filter_vmap(lambda n, f, k: n(f, key=k), in_axes=(None, None, 0)))
    for one, alone in zip(batch(noise, flight, jnp.stack(keys)).states, (first, again, other), strict=True):
        np.testing.assert_allclose(one, alone.states, rtol=1e-14, atol=1e-16)
    holes = np.zeros(flight.states.shape, dtype=bool)
    holes[3:7, 2] = holes[:, 5] = True
    noisy = noise(make_flight(states=jnp.where(holes, jnp.nan, flight.states)), key=keys[0]).states
    np.testing.assert_array_equal(noisy, np.where(holes, np.nan, first.states))


# Statistics.


def test_white_noise_is_white_with_the_sizes_of_the_sensors():
    sizes = {"x y z": 0.005, "vx vy vz": 0.02, "phi theta psi": 0.005, "p q r": 0.01}
    sizes = {name: size for names, size in sizes.items() for name in names.split()}
    assert SENSOR_SIGMA.tolist() == [sizes[name] for name in STATE_NAMES]
    n = 10_000
    z = errors(WhiteNoise(SENSOR_SIGMA), n) / SENSOR_SIGMA
    assert_within(z.mean(axis=0), 0, 1 / np.sqrt(n))
    assert_within((z**2).mean(axis=0), 1, np.sqrt(2 / n))
    assert_within((z[1:] * z[:-1]).mean(axis=0), 0, 1 / np.sqrt(n - 1))
    assert_within((z**4).mean(axis=0), 3, np.sqrt(96 / n))
    cross = z.T @ z / n
    assert_within(cross[np.triu_indices(12, 1)], 0, 1 / np.sqrt(n), limit=4.5)


def test_bias_is_constant_and_drawn_anew():
    mean, trials = 0.3 * SENSOR_SIGMA, 4000
    offset = errors(ConstantBias(SENSOR_SIGMA, mean=mean), 5, trials=trials)
    np.testing.assert_array_equal(offset, offset[:, :1] * np.ones((1, 5, 1)))
    z = offset[:, 0] / SENSOR_SIGMA
    assert_within(z.mean(axis=0), 0.3, 1 / np.sqrt(trials))
    assert_within(z.std(axis=0), 1, np.sqrt(0.5 / trials))
    known = errors(ConstantBias(0, mean=mean), 5)
    np.testing.assert_array_equal(known, np.broadcast_to(mean, (5, 12)))


CORRELATION_TIME = np.linspace(0.05, 2.0, 12)


def coloured_errors(z, correlation_time):
    """Standard errors by which noise of unit variance is off: autocorrelations, and the variance of its innovations."""
    for start, lag in itertools.product((0, 30), (0, 1, 5, 30)):
        truth = np.exp(-lag * DT / correlation_time)
        yield ((z[:, start] * z[:, start + lag]).mean(axis=0) - truth) / np.sqrt((1 + truth**2) / len(z))
    decay = np.exp(-DT / correlation_time)
    innovation = (z[:, 1:] - decay * z[:, :-1]) / np.sqrt(1 - decay**2)
    yield ((innovation**2).mean(axis=(0, 1)) - 1) / np.sqrt(2 / innovation[..., 0].size)


def test_coloured_noise_is_stationary_from_the_first_sample_and_its_innovations_have_their_variance():
    z = errors(GaussMarkov(SENSOR_SIGMA, correlation_time=CORRELATION_TIME), 61, trials=2000) / SENSOR_SIGMA
    assert np.abs(list(coloured_errors(z, CORRELATION_TIME))).max() < 4
    # White noise, and a correlation time that is wrong by 5 %, are detected on every channel.
    white = errors(WhiteNoise(SENSOR_SIGMA), 61, trials=2000) / SENSOR_SIGMA
    for wrong in (coloured_errors(white, CORRELATION_TIME), coloured_errors(z, 1.05 * CORRELATION_TIME)):
        assert np.abs(list(wrong)).max(axis=0).min() > 4
    # An infinite correlation time is a constant; one far below the sample time is white.
    constant, white = (errors(GaussMarkov(SENSOR_SIGMA, correlation_time=time), 50) for time in (np.inf, 1e-6))
    np.testing.assert_array_equal(constant, np.broadcast_to(constant[0], (50, 12)))
    np.testing.assert_array_equal(white, errors(WhiteNoise(SENSOR_SIGMA), 50))


def test_quantised_states_are_the_nearest_multiples():
    step = np.where(np.arange(12) < 6, 0.05, 0.0)
    flight = make_flight()
    rounded = np.asarray(Quantisation(step)(flight, key=jax.random.key(0)).states)
    multiples = rounded[:, :6] / 0.05
    np.testing.assert_allclose(multiples, np.round(multiples), atol=1e-12)
    assert np.abs(rounded - flight.states).max() <= 0.025 + 1e-15
    np.testing.assert_array_equal(rounded[:, 6:], flight.states[:, 6:])


def test_dropouts_come_at_their_rate():
    n, probability = 10_000, np.linspace(0.05, 0.6, 12)
    flight = make_flight(n)
    noisy = np.asarray(Dropouts(probability)(flight, key=jax.random.key(0)).states)
    lost = np.isnan(noisy)
    assert_within(lost.mean(axis=0), probability, np.sqrt(probability * (1 - probability) / n))
    together = probability[0] * probability[11]
    assert_within((lost[:, 0] & lost[:, 11]).mean(), together, np.sqrt(together * (1 - together) / n))
    np.testing.assert_array_equal(noisy[~lost], np.asarray(flight.states)[~lost])
    assert np.isnan(errors(Dropouts(1), 5)).all()


def test_chain_is_one_after_the_other():
    first, second, key = WhiteNoise(0.01), Quantisation(0.005), jax.random.key(7)
    flight = make_flight()
    chained = Chain((first, second, first))(flight, key=key)
    by_hand = flight
    for i, noise in enumerate((first, second, first)):
        by_hand = noise(by_hand, key=jax.random.fold_in(key, i))
    assert same(chained, by_hand)
    assert not np.array_equal(chained.states, Chain((second, first, first))(flight, key=key).states)
    assert same(Chain(())(flight, key=key), flight)
