"""Usable stretches: each reason to leave a part out, the law that the parts make the flight, and real flights."""

import equinox as eqx
import numpy as np
import pytest
from helpers import CRAZYFLIE
from hypothesis import given, settings, strategies as st
from test_flight_csv import identical

from jaxos4.errors import InputError
from jaxos4.flight import Flight
from jaxos4.logs import read_log
from jaxos4.recording import stretches
from jaxos4.recording.motion import excitation, gyro_noise
from jaxos4.recording.pieces import cut
from jaxos4.recording.usable import Stretch, nothing_usable, usable_stretches

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
    return time, omega, states, force


def flight_of(parts):
    return Flight(*parts)


def reasons(flight, airframe=CRAZYFLIE):
    return [(round(part.begin, 2), round(part.end, 2), part.reason) for part in stretches(flight, airframe)]


def test_a_flight_without_faults_is_one_stretch():
    flight = flight_of(hovering())
    assert usable_stretches(flight, CRAZYFLIE) == (Stretch(0.0, pytest.approx(20.0)),)


@pytest.mark.parametrize("airframe", [CRAZYFLIE, None])
def test_the_ground_is_left_out_with_a_margin(airframe):
    flight = flight_of(hovering(rest=((0, 3), (17, 20))))
    assert [reason for *_, reason in reasons(flight, airframe)] == ["on the ground", "", "on the ground"]
    (usable,) = usable_stretches(flight, airframe)
    assert (usable.begin, usable.end) == (pytest.approx(3.3, abs=0.02), pytest.approx(16.7, abs=0.02))


def test_another_vehicles_airframe_does_not_ground_a_flight():
    heavy = eqx.tree_at(lambda a: a.mass, CRAZYFLIE, np.asarray(2.7))
    assert len(usable_stretches(flight_of(hovering()), heavy)) == 1


def test_a_burst_on_the_ground_is_no_flight_and_a_pause_in_the_air_no_landing():
    parts = hovering(rest=((0, 3), (3.3, 6)))
    found = reasons(flight_of(parts))
    assert found[0][2] == "on the ground"
    assert found[0][1] == pytest.approx(6.3, abs=0.02)
    parts = hovering(rest=((10, 10.3),))
    assert [reason for *_, reason in reasons(flight_of(parts))] == ["", "rotor 1, 2, 3, 4 at rest or idle", ""]


@pytest.mark.parametrize("clipped", [2500.0, 2300.0])
def test_a_rotor_at_its_limit_is_left_out_if_for_longer_than_a_moment(clipped):
    """At full scale, or clipped at another value."""
    parts = hovering()
    assert clipped > 1.3 * np.median(parts[1])
    for begin, length in ((5.0, 0.4), (12.0, 0.05)):
        parts[1][round(begin / DT) : round((begin + length) / DT), 2] = clipped
    found = reasons(flight_of(parts))
    assert [reason for *_, reason in found] == ["", "rotor 3 at full speed", ""]
    assert found[1][:2] == (pytest.approx(5.0, abs=0.02), pytest.approx(5.4, abs=0.02))


def test_constant_rotors_are_not_clipped():
    time, omega, states, force = hovering()
    omega[:] = HOVER
    assert len(stretches(Flight(time, omega, states, force), CRAZYFLIE)) == 1


def test_a_clipped_gyro_is_left_out():
    parts = hovering()
    parts[2][1000:1020, R] = -34.9
    found = reasons(flight_of(parts))
    assert [reason for *_, reason in found] == ["", "the gyro is clipped", ""]
    parts[2][1000:1020, R] = -34.9 + 0.01 * np.arange(20)
    assert len(reasons(flight_of(parts))) == 1


def test_gaps_are_left_out():
    parts = hovering()
    parts[2][1000:1100] = np.nan
    parts[2][2000:2004, P] = np.nan  # a moment
    found = reasons(flight_of(parts))
    assert [reason for *_, reason in found] == ["", "nothing was measured", ""]
    states = np.full_like(parts[2], np.nan)
    states[::10, PHI] = 0.1  # a slow sensor alone has no gaps
    assert len(reasons(Flight(parts[0], parts[1], states))) == 1


@pytest.mark.parametrize("sign", ["force", "rate"])
def test_a_crash_is_left_out_from_before_it(sign):
    time, omega, states, force = hovering(rest=((15.2, 20),))
    at = round(15 / DT)
    if sign == "force":
        force[at : at + 3] = [90, 0, 40]
    else:
        states[at:, Q] += 25
    found = reasons(Flight(time, omega, states, force))
    assert [reason for *_, reason in found] == ["", "an impact", "on the ground"]
    assert found[0][1] == pytest.approx(14.5, abs=0.02)


def test_a_bump_in_flight_is_no_crash():
    time, omega, states, force = hovering()
    force[2000] = [90, 0, 40]
    assert len(reasons(Flight(time, omega, states, force))) == 1
    force[-40] = [90, 0, 40]  # and where the record ends, it is one
    assert reasons(Flight(time, omega, states, force))[-1][2] == "an impact"


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


def test_short_parts_between_others_are_left_out():
    parts = hovering(rest=((5, 5.3), (6, 6.3)))
    found = reasons(flight_of(parts))
    assert [reason for *_, reason in found].count("less than 1 s between others") == 1
    assert all(stretch.length >= 0.99 for stretch in usable_stretches(flight_of(parts), CRAZYFLIE))


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
    flight = Flight(0.02 * np.arange(n), omega, states, force)
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
    flight = flight_of(hovering(start=100.0))
    part = cut(flight, Stretch(103.0, 104.0))
    assert (float(part.time[0]), float(part.time[-1])) == (pytest.approx(103.0), pytest.approx(104.0))
    assert identical(part.omega, flight.omega[600:801])
    assert identical(part.specific_force, flight.specific_force[600:801])
    bare = cut(Flight(flight.time, flight.omega, flight.states), Stretch(0, 200))
    assert bare.specific_force is None
    assert bare.time.size == flight.time.size


def test_a_part_beyond_the_flight_is_refused():
    flight = flight_of(hovering())
    with pytest.raises(
        InputError, match="from 30 s to 40 s: fewer than two samples; the flight lasts from 0 s to 20 s"
    ):
        cut(flight, Stretch(30.0, 40.0))


# Excitation


def test_excitation_is_the_spread_of_torque_and_rate():
    flight = flight_of(hovering())
    roll, pitch, yaw = excitation(flight, CRAZYFLIE)
    assert (roll.verdict, pitch.verdict, yaw.verdict) == ("good", "weak", "none")
    assert roll.rate == pytest.approx(1 / np.sqrt(2), rel=0.02)
    assert roll.noise == pytest.approx(0.01, rel=0.1)
    y = np.asarray(CRAZYFLIE.rotor_positions)[:, 1]
    torque = CRAZYFLIE.thrust_coefficient * (np.asarray(flight.omega) ** 2 * y).sum(axis=1)
    assert roll.torque == pytest.approx(float(np.std(torque)), rel=1e-3)
    assert np.isnan(excitation(flight)[0].torque)


def test_angles_stand_in_for_rates():
    time, omega, states, _ = hovering()
    only = np.full_like(states, np.nan)
    only[::4, PHI] = -0.2 * np.cos(5 * time[::4])
    roll, pitch, _ = excitation(Flight(time, omega, only), CRAZYFLIE)
    assert roll.rate == pytest.approx(1 / np.sqrt(2), rel=0.02)
    assert pitch.verdict == "not measured"


def test_noise_is_separated_from_motion():
    t = 0.002 * np.arange(5000)
    rate = 3 * np.sin(2 * np.pi * 3 * t) + np.random.default_rng(0).normal(0, 0.05, t.size)
    assert gyro_noise(rate) == pytest.approx(0.05, rel=0.05)
    assert np.isnan(gyro_noise(np.full(3, np.nan)))


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
    flight, _ = read_log(shared_flights / f"arpl_crazyflie_{name}.csv", CRAZYFLIE)
    parts = stretches(flight, CRAZYFLIE)
    kept = [part for part in parts if not part.reason]
    duration = float(flight.time[-1] - flight.time[0])
    assert sum(part.length for part in kept) > usable * duration
    assert all("at rest" in part.reason or "less than" in part.reason for part in parts if part.reason)
    longest = max(kept, key=lambda part: part.length)
    found = excitation(cut(flight, longest), CRAZYFLIE)
    assert tuple(each.verdict for each in found) == axes
    bare, _ = read_log(shared_flights / f"arpl_crazyflie_{name}.csv", full_scale=1.0)
    assert len(usable_stretches(bare)) == len(kept)
