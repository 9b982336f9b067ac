"""Usable stretches: each reason to leave a part out, the law that the parts make the flight, and real flights."""

import equinox as eqx
import numpy as np
import pytest
from helpers import CRAZYFLIE, usable_stretches
from hypothesis import given, settings, strategies as st

from jaxos4.errors import InputError
from jaxos4.flight import Flight
from jaxos4.recording import Recording, read_recording, stretches
from jaxos4.recording.motion import excitation
from jaxos4.recording.pieces import cut
from jaxos4.recording.usable import Stretch, nothing_usable

DT = 0.005
HOVER = float(CRAZYFLIE.hover_speed)
P, Q, R, PHI = 7, 9, 11, 6


def hovering(seconds=20.0, *, dt=DT, noise=0.01, start=0.0, rest=()):
    """A flight that rolls, and rests on the ground in the times `rest`."""
    time = start + dt * np.arange(round(seconds / dt) + 1)
    rng = np.random.default_rng(0)
    omega = HOVER * (1 + 0.05 * np.sin(5 * time)[:, None] * [1, 1, -1, -1]) + rng.normal(0, 3, (time.size, 4))
    states = np.full((time.size, 12), np.nan)
    states[:, [P, Q, R]] = rng.normal(0, noise, (time.size, 3)) + np.sin(5 * time)[:, None] * [1.0, 0.2, 0.0]
    force = np.tile([0.0, 0.0, 9.81], (time.size, 1)) + rng.normal(0, 0.3, (time.size, 3))
    for begin, end in rest:
        omega[(time >= begin) & (time <= end)] = 0.0
    return Recording(time, omega, states, force)


def reasons(recording, airframe=CRAZYFLIE):
    return [part.reason for part in stretches(recording, airframe)]


def changed(rows, *, omega=None, states=None, force=None, **options):
    """A hover in which these values of rotors, states or force are replaced in some rows."""
    flight = hovering(**options)
    for array, change in ((flight.omega, omega), (flight.states, states), (flight.specific_force, force)):
        if change is not None:
            columns, values = change
            array[rows, columns] = values
    return flight


def at(begin, end):
    return slice(round(begin / DT), round(end / DT))


IDLE = "rotor 1, 2, 3, 4 at rest or idle"
RAMP = -34.9 + 0.01 * np.arange(20)
CASES = {
    "no fault": (hovering(), [""]),
    "ground": (hovering(rest=((0, 3), (17, 20))), ["on the ground", "", "on the ground"]),
    "a burst on the ground": (hovering(rest=((0, 3), (3.3, 6))), ["on the ground", ""]),
    "a pause in the air": (hovering(rest=((10, 10.3),)), ["", IDLE, ""]),
    "full speed": (changed(at(5, 5.4), omega=(2, 2500.0)), ["", "rotor 3 at full speed", ""]),
    "clipped below full speed": (changed(at(5, 5.4), omega=(2, 2300.0)), ["", "rotor 3 at full speed", ""]),
    "full speed for a moment": (changed(at(12, 12.05), omega=(2, 2500.0)), [""]),
    "constant rotors": (changed(slice(None), omega=(slice(None), HOVER)), [""]),
    "fast gyro": (changed(slice(1000, 1020), states=(R, RAMP)), [""]),
    "a gap": (changed(slice(1000, 1100), states=(slice(None), np.nan)), ["", "nothing was measured", ""]),
    "a gap of a moment": (changed(slice(2000, 2004), states=(P, np.nan)), [""]),
    "crash, by the force": (
        changed(slice(3000, 3003), force=(slice(None), [90, 0, 40]), rest=((15.2, 20),)),
        ["", "an impact", "on the ground"],
    ),
    "crash, by the rates": (
        changed(slice(3000, None), states=(Q, 25.0), rest=((15.2, 20),)),
        ["", "an impact", "on the ground"],
    ),
    "a bump in flight": (changed(2000, force=(slice(None), [90, 0, 40])), [""]),
    "a bump where the record ends": (changed(-40, force=(slice(None), [90, 0, 40])), ["", "an impact"]),
    "a short part": (
        hovering(rest=((5, 5.3), (6, 6.3))),
        ["", IDLE, "less than 1 s between others", IDLE, ""],
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_each_reason_to_leave_a_part_out(case):
    flight, expected = CASES[case]
    assert reasons(flight) == expected
    assert all(part.length >= 0.99 for part in usable_stretches(flight, CRAZYFLIE))


@pytest.mark.parametrize(
    ("case", "ends"),
    [
        ("ground", (3.3, 16.7)),
        ("a burst on the ground", (6.3, 20.0)),
        ("full speed", (0.0, 5.0)),
        ("crash, by the force", (0.0, 14.5)),
        ("crash, by the rates", (0.0, 14.5)),
    ],
)
@pytest.mark.parametrize("airframe", [CRAZYFLIE, None])
def test_parts_end_with_a_margin(case, ends, airframe):
    usable = usable_stretches(CASES[case][0], airframe)[0]
    assert (usable.begin, usable.end) == (pytest.approx(ends[0], abs=0.02), pytest.approx(ends[1], abs=0.02))


def test_another_vehicles_airframe_does_not_ground_a_flight():
    heavy = eqx.tree_at(lambda a: a.mass, CRAZYFLIE, np.asarray(2.7))
    assert len(usable_stretches(hovering(), heavy)) == 1


def test_a_slow_sensor_alone_has_no_gaps():
    flight = hovering()
    flight.states[:] = np.nan
    flight.states[::10, PHI] = 0.1
    assert len(reasons(flight._replace(specific_force=None))) == 1


# Ground and flight by the accelerometer


def wandering(seed, *, dt=0.01, seconds=20.0, change=0.35):
    """Time, commands whose thrust wanders slowly, and their thrust as a share of its mean."""
    rng = np.random.default_rng(seed)
    time = dt * np.arange(round(seconds / dt))
    collective = sum(np.sin(2 * np.pi * f * time + rng.uniform(0, 6)) for f in (0.3, 0.7, 1.1)) / 3
    turn = 0.05 * np.sin(2 * np.pi * 2.3 * time + rng.uniform(0, 6))[:, None] * [1, -1, 1, -1]
    command = (1 + change * collective)[:, None] + turn + rng.normal(0, 0.02, (time.size, 4))
    thrust = (command**2).sum(axis=1)
    return time, command, thrust / thrust.mean()


def sensed(time, vertical, seed, *, tilt=(0.0, 0.0)):
    """States with a moving gyro, and the specific force with vibration."""
    rng = np.random.default_rng(seed)
    states = np.full((time.size, 12), np.nan)
    states[:, [P, Q, R]] = rng.normal(0, 0.02, (time.size, 3)) + 0.4 * np.sin(7 * time)[:, None]
    force = np.column_stack([np.full(time.size, tilt[0]), np.full(time.size, tilt[1]), vertical])
    return states, force + rng.normal(0, 0.5, force.shape)


@given(seed=st.integers(0, 99), size=st.floats(0.15, 0.6), gain=st.floats(0.5, 1.5), commanded=st.booleans())
@settings(max_examples=40, deadline=None)
def test_the_accelerometer_tells_ground_from_flight(seed, size, gain, commanded):
    """The same rotors: in flight the vertical force follows the thrust, on the ground it does not."""
    time, command, thrust = wandering(seed)
    for flying in (True, False):
        vertical = 9.81 * (1 + gain * (thrust - 1)) if flying else np.full(time.size, 9.81)
        states, force = sensed(time, vertical, seed)
        flight = Flight(time, size * command, states, force, commanded=commanded)
        usable = usable_stretches(flight)
        if flying:
            assert [(part.begin, part.end) for part in usable] == [(0.0, pytest.approx(time[-1]))]
        else:
            assert usable == ()
            assert "the vehicle never flew" in nothing_usable(stretches(flight))


@given(seed=st.integers(0, 99))
@settings(max_examples=20, deadline=None)
def test_steady_thrust_proves_nothing(seed):
    """A hover with constant thrust, and an accelerometer that repeats one value, are left alone."""
    time, command, thrust = wandering(seed, change=0.03)
    states, force = sensed(time, np.full(time.size, 9.81), seed)
    assert len(usable_stretches(Flight(time, 0.5 * command, states, force))) == 1
    time, command, thrust = wandering(seed)
    assert len(usable_stretches(Flight(time, 0.5 * command, states, np.full_like(force, 9.81)))) == 1


def test_the_ground_before_a_flight_is_left_out():
    time, command, thrust = wandering(3, seconds=40)
    on_ground = time < 15
    states, force = sensed(time, np.where(on_ground, 9.81, 9.81 * thrust), 3)
    (usable,) = usable_stretches(Flight(time, 0.5 * command, states, force))
    assert usable.begin == pytest.approx(15, abs=1.5)
    assert usable.end == pytest.approx(40, abs=0.1)


def test_a_vehicle_on_its_side_is_left_out():
    time, command, _ = wandering(1, change=0.0)
    states, force = sensed(time, np.full(time.size, 9.81), 1)
    crashed = time > 12
    force[crashed] = [9.0, 2.5, 2.0] + np.random.default_rng(0).normal(0, 0.05, (crashed.sum(), 3))
    states[np.ix_(crashed, [P, Q, R])] *= 0.01
    (usable,) = usable_stretches(Flight(time, 0.5 * command, states, force))
    assert usable.end == pytest.approx(12, abs=0.2)


@pytest.mark.parametrize(("command", "flies"), [(0.05, False), (0.1, False), (0.15, True), (0.4, True)])
def test_idle_commands_are_no_flight(command, flies):
    time, commands, _ = wandering(2, change=0.05)
    states, _ = sensed(time, np.full(time.size, 9.81), 2)
    flight = Flight(time, command * commands, states, commanded=True)
    assert bool(usable_stretches(flight)) == flies
    scaled = Flight(time, 2500 * command * commands, states, commanded=True)
    assert bool(usable_stretches(scaled, CRAZYFLIE)) == flies
    measured = Flight(time, command * commands, states)  # speeds have no full scale
    assert usable_stretches(measured)


@given(seed=st.integers(0, 999))
@settings(max_examples=40)
def test_parts_are_the_flight(seed):
    """Parts of any flight follow one another without a gap, and neighbours differ."""
    rng = np.random.default_rng(seed)
    n = int(rng.choice([2, 50, 100, 400]))
    omega = (
        np.abs(rng.normal(HOVER * rng.random(), 200, (n, 4))) * np.repeat(rng.random(n // 20 + 1) < 0.7, 20)[:n, None]
    )
    states = np.where(rng.random((n, 12)) < 0.3, np.nan, rng.normal(0, 10, (n, 12)))
    force = rng.normal(0, 40, (n, 3)) if seed % 2 else None
    flight = Recording(0.02 * np.arange(n), omega, states, force)
    parts = stretches(flight, CRAZYFLIE if seed % 3 else None)
    assert parts[0].begin == 0
    assert parts[-1].end == pytest.approx(float(flight.time[-1]))
    for one, following in zip(parts[:-1], parts[1:], strict=True):
        assert following.begin == pytest.approx(one.end + 0.02)
        assert one.reason != following.reason
    assert sum(cut(flight, part).time.size for part in parts if part.length > 0) == n - sum(
        part.length == 0 for part in parts
    )


# Cutting


def test_a_cut_keeps_time_and_rows():
    flight = hovering(start=100.0)
    part = cut(flight, Stretch(103.0, 104.0))
    assert (float(part.time[0]), float(part.time[-1])) == (pytest.approx(103.0), pytest.approx(104.0))
    np.testing.assert_array_equal(part.omega, flight.omega[600:801])
    np.testing.assert_array_equal(part.specific_force, flight.specific_force[600:801])
    bare = cut(flight._replace(specific_force=None), Stretch(0, 200))
    assert bare.specific_force is None
    assert bare.time.size == flight.time.size


def test_a_part_beyond_the_flight_is_refused():
    flight = hovering()
    with pytest.raises(
        InputError, match="from 30 s to 40 s: fewer than two samples; the flight lasts from 0 s to 20 s"
    ):
        cut(flight, Stretch(30.0, 40.0))


# Excitation


def test_excitation_is_the_spread_of_torque_and_rate():
    flight = hovering()
    roll, pitch, yaw = excitation(flight, CRAZYFLIE).values()
    assert (roll.verdict, pitch.verdict, yaw.verdict) == ("good", "weak", "none")
    assert roll.rate == pytest.approx(1 / np.sqrt(2), rel=0.02)
    assert roll.noise == pytest.approx(0.01, rel=0.1)
    y = np.asarray(CRAZYFLIE.rotor_positions)[:, 1]
    torque = CRAZYFLIE.thrust_coefficient * (np.asarray(flight.omega) ** 2 * y).sum(axis=1)
    assert roll.torque == pytest.approx(float(np.std(torque)), rel=1e-3)
    assert excitation(flight)["roll"].torque is None


def test_angles_stand_in_for_rates():
    flight = hovering()
    flight.states[:] = np.nan
    flight.states[::4, PHI] = -0.2 * np.cos(5 * flight.time[::4])
    roll, pitch, _ = excitation(flight, CRAZYFLIE).values()
    assert roll.rate == pytest.approx(1 / np.sqrt(2), rel=0.02)
    assert pitch.verdict == "not measured"


# Real flights


@pytest.mark.parametrize(
    ("name", "usable", "axes"),
    [
        ("rollpitch", 0.99, ("good", "good", "weak")),
        ("yaw_a", 0.75, ("good", "good", "good")),
        ("yaw_b", 0.7, ("good", "good", "good")),
        ("hover", 0.9, ("good", "good", "weak")),
    ],
)
def test_real_flights(name, usable, axes, shared_flights):
    flight = read_recording(shared_flights / f"arpl_crazyflie_{name}.csv", CRAZYFLIE)
    parts = stretches(flight, CRAZYFLIE)
    kept = [part for part in parts if not part.reason]
    duration = float(flight.time[-1] - flight.time[0])
    assert sum(part.length for part in kept) > usable * duration
    assert all("at rest" in part.reason or "less than" in part.reason for part in parts if part.reason)
    longest = max(kept, key=lambda part: part.length)
    found = excitation(cut(flight, longest), CRAZYFLIE)
    assert tuple(each.verdict for each in found.values()) == axes
    bare = read_recording(shared_flights / f"arpl_crazyflie_{name}.csv", full_scale=1.0)
    assert len(usable_stretches(bare)) == len(kept)
