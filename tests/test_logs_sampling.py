"""Sensors at any times, brought to the rows of a flight, and how often they were logged."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from hypothesis.extra import numpy as hnp
from recorded_logs import rates
from test_flight_csv import csv, read_flight_and_notes
from test_logs_ulog import grid

from jaxos4.flight import STATE_NAMES
from jaxos4.logs import LogFacts, Sampling, Table
from jaxos4.logs.sampling import (
    Series,
    at_rows,
    gyro_rows,
    held_regularly,
    logged_rate,
    resample,
    root_mean_square,
    unwrap,
)

# Uneven times


def uneven(n, dt, seed=0, jitter=0.2):
    rng = np.random.default_rng(seed)
    return dt * (np.arange(n) + rng.uniform(-jitter, jitter, n))


def worst(n):
    """Largest error of a sine sampled n times in 2 s at uneven times and brought to a grid."""
    t = uneven(n, 2.0 / n)
    (grid, _, channels), _ = resample(t, np.ones((n, 4)), np.sin(5 * t)[:, None], 2.0 / n)
    assert not np.isnan(channels).any()
    return np.abs(channels[:, 0] - np.sin(5 * grid)).max()


def test_resampling_is_second_order():
    assert 1.8 < np.log2(worst(250) / worst(1000)) / 2 < 2.3
    assert worst(1000) < 25 / 8 * (2 / 1000) ** 2 * 1.4**2


@given(seed=st.integers(0, 999), lost=st.floats(0, 0.6), slow=st.integers(1, 5))
@settings(max_examples=100)
def test_nothing_is_invented_across_gaps(seed, lost, slow):
    rng = np.random.default_rng(seed)
    dt = 0.01
    t = uneven(80, dt, seed)
    t = t[np.sort(rng.choice(80, 60, replace=False))]
    y = np.cumsum(rng.normal(size=60))
    y[rng.random(60) < lost] = np.nan
    y[np.arange(60) % slow != 0] = np.nan
    (grid, _, channels), _ = resample(t, np.ones((60, 4)), y[:, None], dt)
    ts, ys = t[np.isfinite(y)], y[np.isfinite(y)]
    for g, value in zip(grid, channels[:, 0], strict=True):
        if np.isnan(value):
            continue
        right = np.searchsorted(ts, g)
        assert np.abs(ts - g).min() <= 0.75 * dt + 1e-12  # a sample is near
        around = ys[max(right - 1, 0) : right + 1]  # and the value lies between those around it
        assert around.min() - 1e-9 <= value <= around.max() + 1e-9


def test_rows_that_are_missing_from_a_grid_are_not_measured(save):
    rows = [f"{0.01 * k:.2f},{k},0,0,0,{k},0,0" for k in range(20) if k not in (5, 11, 12)]
    flight, notes = read_flight_and_notes(save(csv(rows=rows)))
    p = np.asarray(flight.states)[:, STATE_NAMES.index("p")]
    assert flight.time.shape == (20,)
    assert np.flatnonzero(np.isnan(p)).tolist() == [5, 11, 12]
    np.testing.assert_allclose(p[~np.isnan(p)], np.delete(np.arange(20.0), [5, 11, 12]), atol=1e-9)
    np.testing.assert_allclose(flight.omega[[4, 5, 6, 10, 11, 12, 13], 0], [4, 4, 6, 10, 10, 10, 13], rtol=1e-9)
    assert len(notes) == 1
    assert "17 rows were resampled to 20 samples, one every 10 ms" in notes[0]
    assert "2 gaps of up to 30 ms: the 3 samples in gaps hold the rotor speeds" in notes[0]


def columns(names, t, *values):
    """A file of some columns, with rotors that turn at 9 rad/s."""
    rows = [",".join(map(repr, [row[0], 9, 9, 9, 9, *row[1:]])) for row in np.column_stack([t, *values]).tolist()]
    return csv(",".join(["t,omega1,omega2,omega3,omega4", *names]), rows)


@pytest.mark.parametrize("offset", [0.004, 0.009])
def test_rows_near_a_grid_stand_as_recorded_and_time_is_the_grid(offset, save):
    dt = 0.01
    t = dt * np.arange(50)
    t[1:-1] += dt * offset * np.random.default_rng(0).choice([-1, 1], 48)
    flight, notes = read_flight_and_notes(save(columns("p", t, np.sin(99 * t))))
    assert notes == ()
    np.testing.assert_array_equal(np.asarray(flight.states)[:, STATE_NAMES.index("p")], np.sin(99 * t))
    np.testing.assert_allclose(np.diff(flight.time), dt, rtol=1e-12)
    t[7] = dt * 7.02
    assert "resampled" in read_flight_and_notes(save(columns("p", t, np.sin(99 * t))))[1][0]


def test_turns_are_taken_out_before_interpolation(save):
    t = uneven(400, 0.01)
    flight, notes = read_flight_and_notes(save(columns(["psi"], t, (7 * t + np.pi) % (2 * np.pi) - np.pi)))
    np.testing.assert_allclose(flight.states[:, STATE_NAMES.index("psi")], 7 * np.asarray(flight.time), atol=1e-9)
    assert notes[0] == "psi: 4 jumps of 2 pi removed"


@given(turns=hnp.arrays(int, st.integers(2, 30), elements=st.integers(-3, 3)), seed=st.integers(0, 99))
@settings(max_examples=50)
def test_unwrapping_changes_by_whole_turns_and_leaves_the_smooth(turns, seed):
    rng = np.random.default_rng(seed)
    angle = np.cumsum(rng.uniform(-3, 3, turns.size))
    angle[rng.random(turns.size) < 0.2] = np.nan
    jumpy = angle + 2 * np.pi * turns
    out, jumps = unwrap(jumpy)
    steps = np.diff(out[np.isfinite(out)])
    assert (np.abs(steps) <= np.pi + 1e-9).all()
    whole = ((out - jumpy) / (2 * np.pi))[np.isfinite(out)]
    np.testing.assert_allclose(whole, np.rint(whole), atol=1e-9)
    again, none = unwrap(out)
    assert none == 0
    assert again is out


def test_a_gyro_beyond_a_kilohertz_is_averaged_to_one():
    t = grid(0.00025, 2.0)
    noise = np.random.default_rng(0).normal(0, 0.1, (t.size, 3))
    motor = Series(grid(0.01, 2.2, offset=-0.1), np.full((220, 4), 0.5))
    rows, table = gyro_rows(Table("", {}), Series(t, rates(t) + noise), motor, measured=False, others={})
    assert np.median(np.diff(rows)) == pytest.approx(0.001)
    off = np.column_stack([table.columns[name] for name in "pqr"]) - rates(rows)
    assert np.std(off) == pytest.approx(0.1 / 2, rel=0.15)  # of four samples each


@given(seed=st.integers(0, 999), ratio=st.floats(1.5, 30.0))
@settings(max_examples=40)
def test_means_of_a_line_lie_on_the_line_and_not_across_gaps(seed, ratio):
    rng = np.random.default_rng(seed)
    rows = 0.01 * np.arange(200)
    t = np.arange(0.0, 2.0, 0.01 / ratio)
    t = np.sort(t + rng.uniform(-0.2, 0.2, t.size) * 0.01 / ratio)
    t = t[(t < 0.8) | (t > 1.1)]
    out = at_rows(rows, Series(t, np.column_stack([3 * t - 1, np.ones(t.size)])))
    measured = np.isfinite(out[:, 0])
    np.testing.assert_allclose(out[measured, 0], 3 * rows[measured] - 1, atol=1e-9)
    np.testing.assert_allclose(out[measured, 1], 1.0, atol=1e-9)
    assert not measured[(rows > 0.8) & (rows < 1.1)].any()
    assert measured[(rows > 0.05) & (rows < 0.75)].all()


# Rates of their own


@given(seed=st.integers(0, 99), measured=st.booleans())
@settings(max_examples=30)
def test_impulse_is_conserved_whatever_the_rates(seed, measured):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.001, 0.1, 60))
    rows = np.sort(rng.uniform(t[0], t[-1], 40))
    values = rng.uniform(0, 900, (60, 4))
    got = root_mean_square(Series(t, values), rows, linear=measured)
    fine = np.linspace(rows[0], rows[-1], 400_001)
    held = values[np.searchsorted(t, fine, side="right") - 1] ** 2
    if measured:
        held = np.column_stack([np.interp(fine, t, column**2) for column in values.T])
    truth = held[:-1].mean(axis=0) * (rows[-1] - rows[0])
    np.testing.assert_allclose((got[:-1] ** 2 * np.diff(rows)[:, None]).sum(axis=0), truth, rtol=1e-3)


def test_a_slow_sensor_stands_at_its_nearest_row_and_not_across_its_gaps():
    rows = 0.01 * np.arange(200)
    t = np.delete(0.004 + 0.05 * np.arange(40), np.arange(10, 20))
    out = at_rows(rows, Series(t, np.sin(3 * t)[:, None]))[:, 0]
    measured = np.isfinite(out)
    np.testing.assert_allclose(out[measured], np.sin(3 * rows[measured]), atol=3 * 0.05**2)
    assert abs(np.count_nonzero(measured) - 29) <= 2
    assert not measured[(rows > t[9] + 0.01) & (rows < t[10] - 0.01)].any()


@given(st.integers(0, 2**32 - 1))
def test_inputs_that_change_now_and_then_are_no_rate(seed):
    steps = np.random.default_rng(seed).exponential(0.3, 200)
    assert not held_regularly(np.cumsum(steps))
    assert not held_regularly(0.3 * np.arange(10.0))  # a 3-2-1-1 of few steps
    assert held_regularly(0.1 * np.arange(50.0))


@given(step=st.floats(0.001, 0.9), seed=st.integers(0, 99), pauses=st.integers(0, 3), bursts=st.booleans())
@settings(max_examples=60)
def test_the_rate_is_that_of_the_samples_whatever_pauses_and_bursts_come_between(step, seed, pauses, bursts):
    rng = np.random.default_rng(seed)
    steps = step * rng.uniform(0.9, 1.1, 300)
    if bursts:  # five samples at once, then nothing for five steps: this is no high rate
        steps = np.tile([1e-6, 1e-6, 1e-6, 1e-6, step], 60)
    steps[rng.integers(0, 300, pauses)] = 500.0
    assert logged_rate(np.cumsum(steps)) == pytest.approx(1 / step, rel=0.11)


def test_the_rate_of_almost_nothing():
    assert logged_rate(np.zeros(1)) == 0
    assert logged_rate(np.array([0.0, 5.0])) == pytest.approx(0.2)
    assert LogFacts().too_slow == ""
    assert LogFacts(Sampling("m", 38.5), Sampling("g", 250.0)).too_slow == ""  # a nominal 40 Hz with jitter
