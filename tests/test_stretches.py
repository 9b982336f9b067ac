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
from jaxos4.recording.stretches import Stretch, cut, end_of_tumble, unusable_note

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


def changed(rows, array, columns, values, **options):
    """A hover in which these values of an array are replaced in some rows."""
    flight = hovering(**options)
    getattr(flight, array)[rows, columns] = values
    return flight


def at(begin, end):
    return slice(round(begin / DT), round(end / DT))


FORCE = "specific_force"


IDLE = "rotor 1, 2, 3, 4 at rest or idle"
RAMP = -34.9 + 0.01 * np.arange(20)
CASES = {
    "no fault": (hovering(), [""]),
    "ground": (hovering(rest=((0, 3), (17, 20))), ["on the ground", "", "on the ground"]),
    "idle motors, falling": (
        changed(at(10, 11), FORCE, 2, 0.5, rest=((10, 11),)),
        ["", "motors idle", ""],
    ),
    "idle motors, no accelerometer": (hovering(rest=((0, 3),))._replace(specific_force=None), ["motors idle", ""]),
    "a burst on the ground": (hovering(rest=((0, 3), (3.3, 6))), ["on the ground", ""]),
    "a pause in the air": (hovering(rest=((10, 10.3),)), ["", IDLE, ""]),
    "full speed": (changed(at(5, 5.4), "omega", 2, 2500.0), ["", "rotor 3 at full speed", ""]),
    "clipped below full speed": (changed(at(5, 5.4), "omega", 2, 2300.0), ["", "rotor 3 at full speed", ""]),
    "full speed for a moment": (changed(at(12, 12.05), "omega", 2, 2500.0), [""]),
    "constant rotors": (changed(slice(None), "omega", slice(None), HOVER), [""]),
    "fast gyro": (changed(slice(1000, 1020), "states", R, RAMP), [""]),
    "a gap": (changed(slice(1000, 1100), "states", slice(None), np.nan), ["", "nothing was measured", ""]),
    "a gap of a moment": (changed(slice(2000, 2004), "states", P, np.nan), [""]),
    "crash, by the force": (
        changed(slice(3000, 3003), FORCE, slice(None), [90, 0, 40], rest=((15.2, 20),)),
        ["", "an impact", "on the ground"],
    ),
    "crash, by the rates": (
        changed(slice(3000, None), "states", Q, 25.0, rest=((15.2, 20),)),
        ["", "an impact", "on the ground"],
    ),
    "a bump in flight": (changed(2000, FORCE, slice(None), [90, 0, 40]), [""]),
    "a bump where the record ends": (changed(-40, FORCE, slice(None), [90, 0, 40]), ["", "an impact"]),
    "a short part": (hovering(rest=((5, 5.3), (6, 6.3))), ["", IDLE, "less than 1 s between others", IDLE, ""]),
}
ENDS = {"ground": (3.3, 16.7), "a burst on the ground": (6.3, 20.0), "full speed": (0.0, 5.0)}
ENDS |= dict.fromkeys(("crash, by the force", "crash, by the rates"), (0.0, 14.5))


@pytest.mark.parametrize("case", CASES)
def test_each_reason_to_leave_a_part_out(case):
    """Parts end with a margin, with and without an airframe."""
    flight, expected = CASES[case]
    assert reasons(flight) == expected
    assert all(part.length >= 0.99 for part in usable_stretches(flight, CRAZYFLIE))
    for airframe in (CRAZYFLIE, None) if case in ENDS else ():
        usable = usable_stretches(flight, airframe)[0]
        assert (usable.begin, usable.end) == pytest.approx(ENDS[case], abs=0.02)


@pytest.mark.parametrize(("begin", "end", "recovered"), [(3.2, 4.5, 4.8), (8.0, 9.0, None)], ids=["launch", "flip"])
def test_a_tumble_at_launch_is_noticed(begin, end, recovered):
    """A flip later in the flight is none, and neither is the motion at the begin of a log that begins in flight."""
    tumbling = changed(at(begin, end), "states", P, 12.0, rest=((0, 3),))
    found = end_of_tumble(tumbling, CRAZYFLIE)
    assert found == (None if recovered is None else pytest.approx(recovered, abs=0.02))
    assert end_of_tumble(changed(at(0, 1), "states", P, 12.0), CRAZYFLIE) is None


def test_neither_another_airframe_nor_a_slow_sensor_ends_a_flight():
    heavy = eqx.tree_at(lambda a: a.mass, CRAZYFLIE, np.asarray(2.7))
    assert len(usable_stretches(hovering(), heavy)) == 1
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


def sensed(time, vertical, seed):
    """States with a moving gyro, and the specific force with vibration."""
    rng = np.random.default_rng(seed)
    states = np.full((time.size, 12), np.nan)
    states[:, [P, Q, R]] = rng.normal(0, 0.02, (time.size, 3)) + 0.4 * np.sin(7 * time)[:, None]
    return states, np.outer(vertical, [0, 0, 1]) + rng.normal(0, 0.5, (time.size, 3))


@given(seed=st.integers(0, 99), size=st.floats(0.15, 0.6), gain=st.floats(0.5, 1.5), commanded=st.booleans())
@settings(max_examples=25, deadline=None)
def test_the_accelerometer_tells_ground_from_flight(seed, size, gain, commanded):
    """The same rotors: in flight the vertical force follows the thrust, on the ground it does not."""
    time, command, thrust = wandering(seed)
    for flying in (True, False):
        vertical = 9.81 * (1 + gain * (thrust - 1)) if flying else np.full(time.size, 9.81)
        states, force = sensed(time, vertical, seed)
        flight = Flight(time, size * command, states, force, commanded=commanded)
        found = [(part.begin, part.end) for part in usable_stretches(flight)]
        assert found == ([(0.0, pytest.approx(time[-1]))] if flying else [])
        assert flying or "the vehicle never flew" in unusable_note(stretches(flight))
    # A hover with constant thrust, and an accelerometer that repeats one value, prove nothing.
    assert len(usable_stretches(Flight(time, 0.5 * command, states, np.full_like(force, 9.81)))) == 1
    time, command, _ = wandering(seed, change=0.03)
    states, force = sensed(time, np.full(time.size, 9.81), seed)
    assert len(usable_stretches(Flight(time, 0.5 * command, states, force))) == 1


def test_the_ground_before_a_flight_and_a_vehicle_on_its_side_are_left_out():
    time, command, thrust = wandering(3, seconds=40)
    states, force = sensed(time, np.where(time < 15, 9.81, 9.81 * thrust), 3)
    (usable,) = usable_stretches(Flight(time, 0.5 * command, states, force))
    assert (usable.begin, usable.end) == (pytest.approx(15, abs=1.5), pytest.approx(40, abs=0.1))
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
    omega = np.abs(rng.normal(HOVER * rng.random(), 200, (n, 4)))
    omega *= np.repeat(rng.random(n // 20 + 1) < 0.7, 20)[:n, None]
    states = np.where(rng.random((n, 12)) < 0.3, np.nan, rng.normal(0, 10, (n, 12)))
    force = rng.normal(0, 40, (n, 3)) if seed % 2 else None
    flight = Recording(0.02 * np.arange(n), omega, states, force)
    parts = stretches(flight, CRAZYFLIE if seed % 3 else None)
    assert (parts[0].begin, parts[-1].end) == (0, pytest.approx(float(flight.time[-1])))
    for one, following in zip(parts[:-1], parts[1:], strict=True):
        assert following.begin == pytest.approx(one.end + 0.02)
        assert one.reason != following.reason
    single = sum(part.length == 0 for part in parts)
    assert sum(cut(flight, part).time.size for part in parts if part.length > 0) == n - single


# Cutting


def test_a_cut_keeps_time_and_rows():
    flight = hovering(start=100.0)
    part = cut(flight, Stretch(103.0, 104.0))
    assert (float(part.time[0]), float(part.time[-1])) == (pytest.approx(103.0), pytest.approx(104.0))
    for name in ("omega", FORCE):
        np.testing.assert_array_equal(getattr(part, name), getattr(flight, name)[600:801])
    bare = cut(flight._replace(specific_force=None), Stretch(0, 200))
    assert (bare.specific_force, bare.time.size) == (None, flight.time.size)
    with pytest.raises(InputError, match="from 30 s to 40 s: fewer than two samples; the flight lasts from 100 s to"):
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
    # Angles stand in for rates.
    flight.states[:] = np.nan
    flight.states[::4, PHI] = -0.2 * np.cos(5 * flight.time[::4])
    roll, pitch, _ = excitation(flight, CRAZYFLIE).values()
    assert roll.rate == pytest.approx(1 / np.sqrt(2), rel=0.02)
    assert pitch.verdict == "not measured"


# Real flights


REAL = [("rollpitch", 0.99, "weak"), ("yaw_a", 0.75, "good"), ("yaw_b", 0.7, "good"), ("hover", 0.9, "weak")]


@pytest.mark.parametrize(("name", "usable", "yaw"), REAL)
def test_real_flights(name, usable, yaw, shared_flights):
    path = shared_flights / f"arpl_crazyflie_{name}.csv"
    flight = read_recording(path, CRAZYFLIE)
    parts = stretches(flight, CRAZYFLIE)
    kept = [part for part in parts if not part.reason]
    assert sum(part.length for part in kept) > usable * np.ptp(flight.time)
    assert all("at rest" in part.reason or "less than" in part.reason for part in parts if part.reason)
    found = excitation(cut(flight, max(kept, key=lambda part: part.length)), CRAZYFLIE)
    assert [each.verdict for each in found.values()] == ["good", "good", yaw]
    assert len(usable_stretches(read_recording(path, full_scale=1.0))) == len(kept)
