"""Stretches joined into one flight of windows, and rows averaged onto a coarser grid."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import standard_flight
from hypothesis import given, settings, strategies as st

import jaxos4
from jaxos4.errors import InputError
from jaxos4.flight import SIGNALS
from jaxos4.logs import as_recording, read_recording, write_flight
from jaxos4.logs.sampling import averages
from jaxos4.recording import Recording
from jaxos4.recording.stretches import Stretch, cut
from jaxos4.recording.windows import averaged, concatenate, hold_out
from jaxos4.shooting.layout import pad_flight


def stretch(samples, seed, *, force=False, velocity=False, voltage=False, dt=0.01, start=0.0):
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(samples, 12))
    states[rng.uniform(size=states.shape) < 0.1] = np.nan
    return jaxos4.Flight(
        time=start + dt * np.arange(samples),
        omega=rng.uniform(100, 300, (samples, 4)),
        states=states,
        specific_force=rng.normal(size=(samples, 3)) if force else None,
        body_velocity=rng.normal(size=(samples, 3)) if velocity else None,
        voltage=rng.uniform(10, 12, samples) if voltage else None,
    )


@given(
    lengths=st.lists(st.integers(2, 60), min_size=1, max_size=5),
    length=st.integers(2, 20),
    forces=st.lists(st.booleans(), min_size=5, max_size=5),
)
@settings(max_examples=25)
def test_no_window_reaches_from_one_stretch_into_the_next(lengths, length, forces):
    flights = [stretch(n, i, force=forces[i], start=7.0 * i) for i, n in enumerate(lengths)]
    whole = [(flight, n // length) for flight, n in zip(flights, lengths, strict=True) if n >= length]
    if not whole:
        with pytest.raises(ValueError, match=f"`flights` must hold at least `length` = {length} samples"):
            jaxos4.join(flights, length=length)
        return
    joined, windows = jaxos4.join(flights, length=length), sum(n for _, n in whole)
    np.testing.assert_allclose(joined.time, 0.01 * np.arange(windows * length), rtol=1e-12, atol=1e-12)
    assert float(joined.dt) == pytest.approx(0.01, rel=1e-9)
    settings = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "rates", "windows": windows}
    problem = jaxos4.ShootingProblem(jaxos4.CorrectedOS4(), joined, **settings)
    np.testing.assert_array_equal(np.nonzero(problem.window_samples()[1])[0], np.repeat(np.arange(windows), length))
    for name in ("omega", "states", "channels"):
        parts = [np.asarray(getattr(flight, name))[: n * length] for flight, n in whole]
        np.testing.assert_array_equal(getattr(joined, name), np.concatenate(parts))
    np.testing.assert_array_equal(joined.stretch, np.repeat(np.arange(len(whole)), [n * length for _, n in whole]))
    assert (joined.specific_force is None) == (not any(flight.specific_force is not None for flight, _ in whole))


@pytest.mark.parametrize("field", ["body_velocity", "voltage"])
@pytest.mark.parametrize("second", [True, False])
def test_velocity_and_voltage_are_kept_if_every_stretch_has_them_and_averaged_and_cut(field, second):
    flights = [stretch(30, i, **{field.removeprefix("body_"): each}) for i, each in enumerate((True, second))]
    joined = getattr(jaxos4.join(flights, length=10), field)
    if second:
        np.testing.assert_array_equal(joined, np.concatenate([getattr(flight, field) for flight in flights]))
    else:
        assert joined is None
    flight = Recording.of(stretch(401, 0, voltage=True, dt=0.001))
    (coarse,) = averaged(flight, [0.004])
    expected = averaged_slowly(flight.time, flight.voltage[:, None], np.asarray(coarse.time), 0.004)[:, 0]
    np.testing.assert_allclose(coarse.voltage, expected, rtol=1e-9)
    assert averaged(flight._replace(voltage=None), [0.004])[0].voltage is None
    np.testing.assert_array_equal(cut(flight, Stretch(0.1, 0.2)).voltage, flight.voltage[100:201])


@pytest.mark.parametrize("field", [name for name, signal in SIGNALS.items() if signal.columns])
def test_a_signal_is_written_read_cut_averaged_joined_and_padded(field, tmp_path):
    """A new signal, a field of `Flight` and of `Recording`, needs no line here, nor elsewhere."""
    signal, rows = SIGNALS[field], np.random.default_rng(0).uniform(0.1, 1.2, (40, *SIGNALS[field].shape))
    flown = Recording(0.01 * np.arange(40), np.full((40, 4), 300.0), np.full((40, 12), 0.5))._replace(**{field: rows})
    write_flight(flown.flight, tmp_path / "flight.csv")
    again = read_recording(tmp_path / "flight.csv")
    np.testing.assert_array_equal(getattr(again, field), rows)
    part = cut(again, Stretch(0.1, 0.19))
    (coarse,) = averaged(part, [0.02])
    means = rows[10:20].reshape(5, 2, *signal.shape).mean(axis=1)
    np.testing.assert_allclose(getattr(coarse, field), means, rtol=1e-9)
    whole = concatenate([part, cut(again, Stretch(0.2, 0.29))])
    np.testing.assert_array_equal(getattr(whole, field), rows[10:30])
    last = getattr(pad_flight(whole.flight, 30), field)[-1]
    np.testing.assert_array_equal(last, rows[29] if signal.is_input else np.full(signal.shape, np.nan))
    if field != "states":
        some = getattr(concatenate([part, part._replace(**{field: None})]), field)
        assert some is None if signal.is_input else np.isnan(some[10:]).all() and np.isfinite(some[:10]).all()


def test_a_force_that_was_never_measured_is_none_of_joined_stretches():
    flown = Recording(0.01 * np.arange(20), np.full((20, 4), 300.0), np.full((20, 12), np.nan))
    silent, heard = np.full((20, 3), np.nan), np.full((20, 3), 9.8)
    whole = concatenate([flown._replace(specific_force=silent)] * 2)
    assert whole.specific_force is None
    assert whole.states.shape == (40, 12)
    some = concatenate([flown._replace(specific_force=each) for each in (silent, heard)]).specific_force
    np.testing.assert_array_equal(some, np.concatenate([silent, heard]))


def test_the_cost_of_joined_flights_is_the_sum_of_theirs():
    model = jaxos4.FlightModel(terms=("lag", "delay", "offset"))
    omega, parts = jaxos4.multisine(jaxos4.OS4, duration=0.6), []
    for i in range(2):
        flown = jaxos4.simulate(model, model.alpha, omega[:: 1 - 2 * i], dt=0.01)
        parts.append(jaxos4.WhiteNoise(0.01)(flown, key=jax.random.key(i)))

    def cost(flight, windows):
        settings = {"sigma": jaxos4.SENSOR_SIGMA, "channels": "rates", "windows": windows}
        parameters = model.alpha.at[8:].add(jnp.array([0.1, 0.0, -0.1, 0.01, 0.013]))
        return float(jaxos4.ShootingProblem(model, flight, **settings).cost(parameters))

    alone = [jaxos4.Flight(part.time[:60], part.omega[:60], part.states[:60]) for part in parts]
    assert cost(jaxos4.join(parts, length=20), 6) == pytest.approx(sum(cost(part, 3) for part in alone), rel=1e-12)


def averaged_slowly(t, y, grid, dt):
    """Each row's interval cut with each sample's, one by one."""
    t, y = np.asarray(t), np.asarray(y)
    own, out = t[1] - t[0], np.full((grid.size, y.shape[1]), np.nan)
    for k, center in enumerate(grid):
        for column in range(y.shape[1]):
            total = share = 0.0
            for at, value in zip(t, y[:, column], strict=True):
                overlap = min(at + own / 2, center + dt / 2) - max(at - own / 2, center - dt / 2)
                if overlap > 0 and np.isfinite(value):
                    total, share = total + overlap * value, share + overlap
            if share > 0.45 * dt:
                out[k, column] = total / share
    return out


@pytest.mark.parametrize("ratio", [2, 3, 4, 2.5, 5.7])
@pytest.mark.parametrize("lost", [0.0, 0.3, 0.6])
def test_averages_are_means_over_the_sample(ratio, lost):
    rng, t, dt = np.random.default_rng(0), 3.0 + 0.001 * np.arange(83), 0.001 * ratio
    channels = np.cumsum(rng.normal(size=(83, 3)), axis=0)
    channels[rng.uniform(size=channels.shape) < lost] = np.nan
    grid, _, found = averages(t, rng.uniform(100, 300, (83, 4)), channels, held=True)(dt)
    # The first sample begins half of a row before the first row, and the last ends half of a row after the last.
    edges = t[0] - 0.0005 + dt * np.arange(grid.size + 1)
    np.testing.assert_allclose(grid, edges[:-1] + dt / 2, rtol=1e-12)
    assert edges[-1] <= t[-1] + 0.0005 + 1e-6 < edges[-1] + dt + 1e-6
    np.testing.assert_allclose(found, averaged_slowly(t, channels, grid, dt), rtol=1e-9, atol=1e-9)


def test_impossible_values_of_a_flight_are_missing():
    """A single glitch is no reason to lose a flight; many are one to refuse it."""
    flight = standard_flight()
    glitches = dataclasses.replace(flight, states=flight.states.at[7, 1].set(1e9).at[30, 7].set(-1e6))
    found = as_recording(glitches)
    assert np.argwhere(np.isnan(found.states)).tolist() == [[7, 1], [30, 7]]
    (note,) = found.notes
    assert note.startswith("impossible values count as not measured, in vx: 1 (first 1e+09 m/s at 0.07 s), p: 1 (first")
    assert as_recording(flight).notes == ()
    with pytest.raises(InputError, match=r"flight: field p: at 0 s is 1e\+06 rad/s, beyond 60 rad/s"):
        as_recording(dataclasses.replace(flight, states=flight.states.at[:20, 7].set(1e6)))


@pytest.mark.parametrize("share", [0.1, 0.15, 0.25, 0.3, 0.4, 0.45, 0.5])
def test_the_share_that_is_asked_for_is_held_out(share):
    """Within one block of 5 s, in 400 s."""
    samples = 4000
    recording = Recording(0.1 * np.arange(samples), np.ones((samples, 4)), np.ones((samples, 12)))
    fitted, held_out = hold_out(recording, 10, share)
    kept, left_out = (np.isfinite(each.states).all(axis=1) for each in (fitted, held_out))
    assert (kept ^ left_out).all()
    assert left_out.mean() == pytest.approx(share, abs=5 / 400)
