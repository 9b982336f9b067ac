"""White noise of measured rotor speeds: its level, and the speeds that are expected given the measured ones."""

import numpy as np
import pytest
import scipy.signal
from helpers import CRAZYFLIE

from jaxos4.logs import Recording
from jaxos4.recording.noise import without_noise

DT = 0.004


def recordings(noise, *, samples=10_000, seed=0):
    """The measured and the true speeds of rotors that follow random levels within 50 ms."""
    random, time = np.random.default_rng(seed), DT * np.arange(samples)
    levels = np.repeat(60 * random.normal(size=(samples // 50, 4)), 50, axis=0)
    true = 1700 + scipy.signal.lfilter([0.08], [1, -0.92], levels, axis=0)
    seen = true + noise * random.normal(size=true.shape)
    return [Recording(time, speeds, np.zeros((samples, 12)), held=False) for speeds in (seen, true)]


@pytest.mark.parametrize("noise", [1.0, 4.0, 16.0])
def test_the_level_of_white_noise_is_found(noise):
    seen, true = recordings(noise)
    (smooth,), level, share = without_noise([seen], CRAZYFLIE)
    assert level == pytest.approx(noise, rel=0.1)
    changes = np.diff(seen.omega, axis=0)
    assert share == pytest.approx(2 * noise**2 / changes.var(), rel=0.25)
    before, after = (np.std(each.omega - true.omega) for each in (seen, smooth))
    assert after < before


def test_speeds_without_noise_and_commands_stay_as_they_are():
    true = recordings(0.0)[1]
    (smooth,), level, _ = without_noise([true], CRAZYFLIE)
    assert level < 0.05
    assert np.std(smooth.omega - true.omega) < 0.01
    commands = recordings(5.0)[0]._replace(commanded=True)
    (same,), level, share = without_noise([commands], CRAZYFLIE)
    assert same is commands
    assert (level, share) == (0.0, 0.0)


def test_the_expected_speeds_do_not_shrink_a_slope():
    """The slope of true on measured changes is too small by noise; that on the expected changes is nearly 1."""
    seen, true = recordings(8.0)
    (smooth,), _, _ = without_noise([seen], CRAZYFLIE)

    def slope(of):
        x, y = (np.diff(each.omega, axis=0).ravel() for each in (of, true))
        return (x @ y) / (x @ x)

    assert slope(seen) < 0.7
    assert slope(smooth) == pytest.approx(1, abs=0.1)


def test_too_short_recordings_are_kept():
    seen = recordings(5.0, samples=50)[0]
    assert without_noise([seen], CRAZYFLIE) == ([seen], 0.0, 0.0)
