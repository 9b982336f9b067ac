"""How much of a battery's sag a logged voltage shows."""

import numpy as np
import pytest

from jaxos4.logs import Recording
from jaxos4.recording.sensor_errors import unseen_sag

TIME = np.arange(0, 20, 0.004)
TRUE = 16 - 0.5 * np.random.default_rng(0).random(TIME.size)


def recording(voltage):
    """A log with this voltage."""
    zeros = np.zeros((TIME.size, 4))
    return Recording(time=TIME, omega=zeros, states=np.zeros((TIME.size, 12)), specific_force=None, voltage=voltage)


@pytest.mark.parametrize("interpolated", [False, True])
@pytest.mark.parametrize(("period", "low", "high"), [(0.004, 0.1, 0.1), (0.1, 0.3, 0.5), (0.5, 0.85, 0.95)])
def test_a_voltage_shows_the_less_the_slower_it_is(interpolated, period, low, high):
    """Whether it is held between its measurements or interpolated."""
    every = round(period / 0.004)
    own, values = TIME[::every], TRUE[::every]
    at = np.interp(TIME, own, values) if interpolated else np.repeat(values, every)[: TIME.size]
    assert low <= unseen_sag(recording(at)) <= high


def test_a_coarse_voltage_and_none_show_little():
    assert 0.1 < unseen_sag(recording(np.round(TRUE, 1))) < 0.3
    assert unseen_sag(recording(np.round(TRUE))) == 1
    assert unseen_sag(recording(np.full(TIME.size, 16.0))) == 1
    assert unseen_sag(recording(None)) == 1
