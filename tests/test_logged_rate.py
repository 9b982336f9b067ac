"""Rates of a log whose rows repeat values, as programs write them that join topics of different rates."""

import numpy as np
import pytest
from hypothesis import given, strategies as st

from jaxos4.logs.sampling import held_regularly
from jaxos4.recording import read_recording

ROWS = 1000


def log(tmp_path, held, *, stagger=0, lost=0.0):
    """250 rows a second, with commands that are held for so many rows: each motor `stagger` rows after the last."""
    rng = np.random.default_rng(0)
    commands = np.repeat(rng.uniform(0.4, 0.6, (ROWS // held + 9, 4)), held, axis=0)
    commands = np.stack([commands[stagger * i :, i][:ROWS] for i in range(4)], axis=1)
    commands[1:][rng.uniform(size=ROWS - 1) < lost] = np.nan
    table = np.column_stack([0.004 * np.arange(ROWS), commands, rng.normal(size=(ROWS, 3))])
    path = tmp_path / "log.csv"
    np.savetxt(path, table, delimiter=",", header="t,command1,command2,command3,command4,p,q,r", comments="")
    path.write_text(path.read_text().replace("nan", ""))
    return read_recording(path, full_scale=1.0)


@pytest.mark.parametrize(("held", "rate"), [(25, 10.0), (5, 50.0), (1, 250.0)])
def test_values_that_repeat_were_not_logged(tmp_path, held, rate):
    facts = log(tmp_path, held).facts
    assert facts.motors.rate == pytest.approx(rate, rel=0.01)
    assert facts.gyro.rate == pytest.approx(250.0, rel=0.01)
    assert bool(facts.too_slow) == (rate < 40)
    if facts.too_slow:
        assert "the motors were logged at 10 Hz (the values of command1 change so often)" in facts.too_slow


@pytest.mark.parametrize("kind", [{"stagger": 6}, {"lost": 0.2}])
def test_motors_that_are_held_one_after_the_other_or_with_empty_cells(tmp_path, kind):
    assert log(tmp_path, 25, **kind).facts.motors.rate == pytest.approx(10.0, rel=0.05)


@given(st.integers(0, 2**32 - 1))
def test_inputs_that_change_now_and_then_are_no_rate(seed):
    steps = np.random.default_rng(seed).exponential(0.3, 200)
    assert not held_regularly(np.cumsum(steps))
    assert not held_regularly(0.3 * np.arange(10.0))  # a 3-2-1-1 of few steps
    assert held_regularly(0.1 * np.arange(50.0))
