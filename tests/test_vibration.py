"""A gyro that vibrates has a line in its spectrum; noise, a filter and motion have none."""

import numpy as np
import pytest

from jaxos4.flight import RATES
from jaxos4.recording import Recording
from jaxos4.recording.sensor_errors import vibrating_rates


def gyro(seed, *, line=0.0, hertz=143.0, filtered=False, dt=0.002):
    """White noise and slow motion, and a vibration of p whose frequency varies by 5 %."""
    rng, time = np.random.default_rng(seed), dt * np.arange(round(20 / dt))
    noise = 0.02 * rng.normal(size=(time.size, 3))
    if filtered:
        kernel = np.exp(-np.arange(20) * dt / 0.003)
        noise = np.column_stack([np.convolve(x, kernel / kernel.sum(), "same") for x in noise.T])
    motion = np.sin(2 * np.pi * np.array([0.7, 1.1, 0.4]) * time[:, None]) + 0.1 * np.sin(2 * np.pi * 8 * time)[:, None]
    states = np.full((time.size, 12), np.nan)
    states[:, RATES] = motion + noise
    turns = np.cumsum(2 * np.pi * hertz * (1 + 0.05 * np.sin(2 * np.pi * 0.3 * time)) * dt)
    states[:, RATES[0]] += line * np.sin(turns)
    return Recording(time, np.full((time.size, 4), 1000.0), states, None)


@pytest.mark.parametrize("filtered", [False, True])
@pytest.mark.parametrize("dt", [0.001, 0.002, 0.004])
def test_noise_and_motion_have_no_line(filtered, dt):
    assert not any(vibrating_rates([gyro(seed, filtered=filtered, dt=dt)]) for seed in range(5))


@pytest.mark.parametrize(("dt", "seen"), [(0.001, 143.0), (0.002, 143.0), (0.004, 107.0)])
def test_a_line_is_found_at_its_frequency_or_where_the_log_folds_it_to(dt, seen):
    (found,) = vibrating_rates([gyro(0, line=0.1, dt=dt)]).items()
    assert found[0] == "p"
    assert found[1] == pytest.approx(seen, abs=0.06 * 143)


def test_short_or_slow_logs_show_none():
    flight = gyro(0, line=0.1)
    assert vibrating_rates([]) == vibrating_rates([flight.rows(slice(900))]) == {}
    assert vibrating_rates([flight.rows(slice(None, None, 20))]) == {}
