"""Sensors at any times, brought to the rows of a flight, and how often they were logged."""

import numpy as np
import pytest
from flight_csvs import csv, read_flight_and_notes
from hypothesis import given, settings, strategies as st
from px4_logs import grid
from recorded_logs import rates, table_csv

from jaxos4.errors import InputError
from jaxos4.flight import STATE_NAMES
from jaxos4.logs.messages import Messages, Rotors
from jaxos4.logs.sampling import PARTS, Series, logged_rate, resample, root_mean_square, speeds_within

# Uneven times


def uneven(n, dt, seed=0, jitter=0.2):
    rng = np.random.default_rng(seed)
    return dt * (np.arange(n) + rng.uniform(-jitter, jitter, n))


def test_resampling_is_second_order():
    errors = []
    for n in (250, 1000):  # a sine, sampled so often in 2 s at uneven times
        t = uneven(n, 2.0 / n)
        (rows, _, channels), _ = resample(t, np.ones((n, 4)), np.sin(5 * t)[:, None], 2.0 / n, held=True)
        errors.append(np.abs(channels[:, 0] - np.sin(5 * rows)).max())
    assert 1.8 < np.log2(errors[0] / errors[1]) / 2 < 2.3
    assert errors[1] < 25 / 8 * (2 / 1000) ** 2 * 1.4**2


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
    (grid, _, channels), _ = resample(t, np.ones((60, 4)), y[:, None], dt, held=True)
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
    # Squares of measured speeds are linear from row to row, also in a gap: means up to the next row.
    squares = np.interp(np.arange(20.0), np.delete(np.arange(20.0), [5, 11, 12]), p[~np.isnan(p)] ** 2)
    means = np.append((squares[:-1] + squares[1:]) / 2, squares[-1])
    np.testing.assert_allclose(flight.omega[:, 0], np.sqrt(means), rtol=1e-9)
    assert len(notes) == 1
    assert "17 rows were resampled to 20 samples, one every 10 ms" in notes[0]
    assert "2 gaps of up to 30 ms: the 3 samples in gaps interpolate the rotor speeds" in notes[0]


def columns(names, t, *values):
    """A file of some columns, with rotors that turn at 9 rad/s."""
    return table_csv(["t", *(f"omega{i}" for i in range(1, 5)), *names], t, np.full((len(t), 4), 9), *values)


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


def test_a_gyro_beyond_a_kilohertz_is_averaged_to_one():
    t = grid(0.00025, 2.0)
    noise = np.random.default_rng(0).normal(0, 0.1, (t.size, 3))
    motor = Series(grid(0.01, 2.2, offset=-0.1), np.full((220, 4), 0.5))
    log = Messages("", {}, "", names={"p": "gyro"})
    gyro, rotors = {("p", "q", "r"): Series(t, rates(t) + noise)}, Rotors(motor, ["motors"] * 4, is_measured=False)
    table, _ = log.table(gyro, rotors, remedies=("", ""))
    rows = table.columns["t"]
    assert np.median(np.diff(rows)) == pytest.approx(0.001)
    off = np.column_stack([table.columns[name] for name in "pqr"]) - rates(t[0] + 0.0005 + rows)
    assert np.std(off) == pytest.approx(0.1 / 2, rel=0.15)  # of four samples each


def test_late_messages_are_ignored_and_noted_once_and_the_fastest_source_is_taken():
    t = np.array([0.0, 0.01, 0.005, 0.02, 0.03])
    slow = {"t": grid(0.02, 0.2), "x": np.arange(10.0)}
    log = Messages("log", {"slow": {0: slow}, "late": {3: {"t": t, "x": np.arange(5.0)}}}, "copy it again")
    for _ in range(2):
        found = log.fastest(("p",), [("slow", ("x",), 1.0), ("late", ("x",), 2.0)])
    np.testing.assert_array_equal(found.values[:, 0], [0, 2, 6, 8])
    assert log.names == {"p": "late.x"}
    assert log.notes == ["late: 1 late messages are ignored"]
    log.fields["late"][3]["t"] = t[::-1]
    with pytest.raises(InputError, match="log: time runs backward in late: copy it again"):
        log.series("late", ["x"])


# Rates of their own


@given(seed=st.integers(0, 99), measured=st.booleans())
@settings(max_examples=30)
def test_impulse_is_conserved_whatever_the_rates(seed, measured):
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.001, 0.1, 60))
    rows = np.sort(rng.uniform(t[0], t[-1], 40))
    values = rng.uniform(0, 900, (60, 4))
    got = root_mean_square(Series(t, values), linear=measured)(rows)
    fine = np.linspace(rows[0], rows[-1], 400_001)
    held = values[np.searchsorted(t, fine, side="right") - 1] ** 2
    if measured:
        held = np.column_stack([np.interp(fine, t, column**2) for column in values.T])
    truth = held[:-1].mean(axis=0) * (rows[-1] - rows[0])
    np.testing.assert_allclose((got[:-1] ** 2 * np.diff(rows)[:, None]).sum(axis=0), truth, rtol=1e-3)


@pytest.mark.parametrize("held", [True, False])
def test_speeds_within_a_sample_are_those_of_its_quarters(held):
    """Root mean squares from half a sample before a row to half a sample after it, also at the ends of a recording.

    Before the first row speeds are those of the first row, and after the last those of the last.
    """
    rng = np.random.default_rng(0)
    t = 5 + np.cumsum(rng.uniform(0.001, 0.02, 60))
    omega = rng.uniform(100, 900, (60, 4))
    dt = (t[-1] - t[0]) / 18.2
    rows = t[0] + dt * np.arange(19)
    found = speeds_within(t, omega, held=held)(rows, dt)
    assert found.shape == (rows.size, PARTS, 4)
    count = 2000  # in each part
    fine = rows[0] - dt / 2 + dt / PARTS / count * (np.arange(rows.size * PARTS * count) + 0.5)
    squares = omega[np.maximum(np.searchsorted(t, fine, side="right") - 1, 0)] ** 2
    if not held:
        squares = np.stack([np.interp(fine, t, column**2) for column in omega.T], axis=1)
    assert fine[0] < t[0] < t[-1] < fine[-1]
    expected = np.sqrt(squares.reshape(rows.size, PARTS, count, 4).mean(axis=2))
    np.testing.assert_allclose(found, expected, rtol=2e-3 if held else 1e-5)
    np.testing.assert_allclose(found[0, : PARTS // 2], omega[[0, 0]], rtol=1e-12)
    # It sees a shift by a quarter of a sample.
    assert np.abs(found.reshape(-1, 4)[1:] - expected.reshape(-1, 4)[:-1]).max() > 100


@pytest.mark.parametrize("pause", [1.0, 0.95, 3.0])
def test_pauses_between_short_sessions_are_no_rate(pause):
    """Sessions of 0.4 s at 500 Hz."""
    session = np.arange(0, 0.4, 0.002)
    times = np.concatenate([i * (0.398 + pause) + session for i in range(20)])
    assert logged_rate(times) == pytest.approx(500, rel=1e-3)
