"""The effects of `Air` and `Sensors` in a flight in closed loop, each against a law in closed form or SciPy.

Unless a test says otherwise: no gusts, no noise, and a controller that knows the true rates.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop_flights import ANGLES, DT, LEVEL, QUIET, RATES, SAMPLES, SUCCESS, VELOCITY, references
from helpers import CRAZYFLIE
from scipy.signal import lsim
from scipy.spatial.transform import Rotation

import jaxos4

TIME, RANDOM = DT * np.arange(SAMPLES), np.asarray(references())
GRAVITY, HOVER = float(CRAZYFLIE.gravity), float(CRAZYFLIE.hover_speed)


def loop_of(*, air=None, loop=None, **sensors):
    sensors = {"velocity_noise": 0.0, "controller_gyro_noise": 0.0, **sensors}
    return jaxos4.ClosedLoop(
        CRAZYFLIE, air=jaxos4.Air(**(air or {})), sensors=jaxos4.Sensors(**sensors), **{**QUIET, **(loop or {})}
    )


def fly(references=RANDOM, *, seed=1, **settings):
    """All flights have one length, and share one program. Returns rotor speeds, states and specific force."""
    flight = jaxos4.fly_closed_loop(loop_of(**settings), jnp.asarray(references), dt=DT, key=jax.random.key(seed))
    assert flight.result == SUCCESS
    return np.asarray(flight.omega), np.asarray(flight.states), np.asarray(flight.specific_force)


def test_still_air_and_perfect_sensors_change_nothing():
    flight = jaxos4.fly_closed_loop(
        jaxos4.ClosedLoop(CRAZYFLIE, gust=5.0), jnp.asarray(RANDOM), dt=DT, key=jax.random.key(1)
    )
    noise = {"gyro_noise": 0.02, "attitude_noise": 0.002, "force_noise": 0.3}
    omega, states, force = fly(loop={"gust": 5.0, **noise}, controller_gyro_noise=None, velocity_noise=None)
    np.testing.assert_allclose(omega, flight.omega, rtol=1e-9)
    np.testing.assert_allclose(states, flight.states, atol=1e-9)
    np.testing.assert_allclose(force, flight.specific_force, atol=1e-9)


# The air.


def test_a_climb_ends_at_the_speed_at_which_inflow_takes_the_thrust():
    """Commands that accelerate by 2 m/s^2 in still air: v = 2 / k_z (1 - exp(-k_z t)), and the force falls to g."""
    inflow = 0.8
    _, states, force = fly(LEVEL + [0, 0, 0, 2.0], air={"inflow": inflow})
    late = TIME > 1
    expected = 2 / inflow * (1 - np.exp(-inflow * (TIME - 0.06)))  # the rotors follow after lag and delay
    np.testing.assert_allclose(states[late, 5], expected[late], rtol=5e-3)
    np.testing.assert_allclose(force[late, 2], GRAVITY + 2 - inflow * states[late, 5], rtol=1e-9)


def test_wind_has_its_strength_and_its_correlation_time():
    """Drag shows the airspeed, and the log shows the velocity: the difference is the wind."""
    drag, inflow, wind, duration = (0.5, 0.3), 0.6, np.array([1.0, 0.5, 0.8]), 0.1
    omega, states, force = fly(LEVEL, air={"drag": drag, "inflow": inflow, "wind": wind, "wind_time": duration})
    body = Rotation.from_euler("ZYX", states[:, ANGLES[::-1]]).inv().apply(states[:, VELOCITY])
    np.testing.assert_allclose(omega, HOVER, rtol=1e-9)
    found = body + (force - [0, 0, GRAVITY]) / [*drag, inflow]
    # 16 s are 160 correlation times: the variance has a standard error of 11 %.
    np.testing.assert_allclose(found.std(axis=0) / wind, 1, atol=0.2)
    shifted = (found[25:] * found[:-25]).mean(axis=0) / found.var(axis=0)
    np.testing.assert_allclose(shifted, np.exp(-25 * DT / duration), atol=0.2)
    assert np.abs(np.corrcoef(found.T) - np.eye(3)).max() < 0.4


# Vibration and filters.


def test_vibration_is_a_line_at_the_speed_of_the_rotors():
    """Its amplitude is proportional to the squared speed. The line lies beyond half the rate of the log."""
    assert HOVER > np.pi / DT
    sizes, late, amplitudes = {"gyro_vibration": 0.05, "force_vibration": 0.4}, slice(1000, None), []
    for climb, share in ((0.0, 1.0), (2.0, 1 + 2 / GRAVITY)):
        _, states, force = fly(LEVEL + [0, 0, 0, climb], **sizes)
        shaken = np.concatenate([states[late, RATES], force[late] - [0, 0, GRAVITY + climb]], axis=1)
        waves = np.exp(1j * HOVER * np.sqrt(share) * TIME[late])
        design = np.stack([waves.real, waves.imag], axis=1)
        fitted = np.linalg.lstsq(design, shaken, rcond=None)[0]
        np.testing.assert_allclose(design @ fitted, shaken, atol=1e-5)
        amplitudes.append(np.hypot(*fitted) / np.repeat(list(sizes.values()), 3) / share)
    assert 1 < np.sqrt(np.mean(amplitudes[0] ** 2)) < 3  # four rotors with random phases
    np.testing.assert_allclose(*amplitudes, rtol=1e-4)


def test_filters_are_of_first_order():
    """SciPy's simulation of 1 / (T s + 1) takes signals as linear between samples, too."""
    _, raw, raw_force = fly()
    _, states, force = fly(gyro_filter=0.008, force_filter=0.03)
    starts = np.array([[0, 0, 0], [0, 0, GRAVITY]])
    pairs = (0.008, raw[:, RATES], states[:, RATES]), (0.03, raw_force, force)
    for (T, before, after), start in zip(pairs, starts, strict=True):
        for axis in range(3):
            expected = lsim(([1], [T, 1]), before[:, axis] - start[axis], TIME)[1] + start[axis]
            np.testing.assert_allclose(after[:, axis], expected, atol=1e-9)
        assert np.abs(after - before)[:, 2].max() > 1e-3


# The gyro of the controller.


def test_the_controller_can_know_the_true_rates():
    quiet, noisy = fly(), fly(loop={"gyro_noise": 0.1}, gyro_filter=0.01, gyro_vibration=0.1)
    np.testing.assert_allclose(noisy[0], quiet[0], rtol=1e-12)
    assert np.std(noisy[1][:, RATES] - quiet[1][:, RATES]) > 0.05
    answering, _, _ = fly(loop={"gyro_noise": 0.1}, controller_gyro_noise=None)
    assert np.std(answering - quiet[0]) > 1


def test_the_controller_can_have_a_gyro_of_its_own():
    """A controller with little gain answers its noise with the proportional gain. A filter makes the noise smaller."""
    gains = {"attitude_gain": 0.0, "rate_gain": 1.0, "integral_gain": 0.0, "gyro_noise": 0.02}
    sizes = []
    for own, T in ((0.0, 0.0), (0.0, 0.02), (0.05, 0.0), (0.05, 0.02)):
        omega, states, _ = fly(LEVEL, loop=gains, controller_gyro_noise=own, controller_gyro_filter=T)
        torque = np.asarray(CRAZYFLIE.mixer)[:3] @ np.square(omega).T
        sizes.append((torque.T / np.asarray(CRAZYFLIE.inertia)).std(axis=0))
        # The noise of the log is another one. Without noise the torque is constant.
        assert own == 0.0 or np.abs(np.corrcoef(states[1000:, RATES[0]], torque[0, 1000:])[0, 1]) < 0.1
    none, also_none, white, filtered = sizes
    np.testing.assert_allclose([none, also_none], 0, atol=1e-9)
    np.testing.assert_allclose(white, 0.05, rtol=0.05)
    # The variance of filtered white noise is the sum of the squared impulse response.
    impulse = lsim(([1], [0.02, 1]), 1.0 * (np.arange(500) == 1), DT * np.arange(500))[1]
    np.testing.assert_allclose(filtered / white, np.sqrt(np.square(impulse).sum()), rtol=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("logged", ["commands", "speeds"])
def test_a_fast_controller_is_a_fast_log_of_which_some_rows_are_kept(logged):
    sensors = {"gyro_vibration": 0.05, "gyro_filter": 0.002, "clock_offset": 0.0023, "controller_gyro_noise": None}
    air = {"wind": 1.0, "drag": 0.3, "flapping": 2.0}
    settings = {"gust": 5.0, "gyro_noise": 0.02, "force_noise": 0.3, "logged": logged}
    rows = RANDOM[:500]
    slow, fast = (loop_of(air=air, loop={**settings, "log_every": n}, **sensors) for n in (4, 1))
    key = jax.random.key(3)
    kept = jaxos4.fly_closed_loop(slow, jnp.asarray(rows), dt=DT, key=key, substeps=8)
    every = jaxos4.fly_closed_loop(fast, jnp.repeat(jnp.asarray(rows), 4, axis=0), dt=DT / 4, key=key, substeps=2)
    np.testing.assert_allclose(kept.states[:, RATES + ANGLES], every.states[::4, RATES + ANGLES], atol=1e-9)
    np.testing.assert_allclose(kept.specific_force, every.specific_force[::4], atol=1e-9)
    omega = np.asarray(every.omega)
    np.testing.assert_allclose(kept.omega, omega[::4], rtol=1e-9)
    assert np.std(np.diff(omega, axis=0)) > 0.5


# The recorder.


@pytest.mark.parametrize("offset", [0.0031, -0.0067, 0.008])
def test_a_clock_offset_moves_the_rotors_against_the_gyro(offset):
    (exact, states, _), (late, same, _) = fly(), fly(clock_offset=offset)
    np.testing.assert_array_equal(same, states)
    expected = np.stack([np.interp(TIME - offset, TIME, column) for column in exact.T], axis=1)
    np.testing.assert_allclose(late, expected, rtol=1e-9)
    assert np.abs(late - exact).max() > 10


def test_rotor_speeds_and_velocities_have_their_noise_and_speeds_are_rounded():
    exact, noisy, rounded = (fly(speed_noise=noise, speed_step=step)[0] for noise, step in ((0, 0), (3, 0), (0, 25)))
    # 16004 draws: the standard deviation has an error of 0.6 %.
    np.testing.assert_allclose(np.std(noisy - exact), 3, rtol=0.025)
    np.testing.assert_array_equal(rounded, 25 * np.round(exact / 25))
    true, measured = (fly(velocity_noise=noise)[1][:, VELOCITY] for noise in (0.0, 0.1))
    np.testing.assert_allclose((measured - true).std(axis=0), 0.1, rtol=4 / np.sqrt(2 * SAMPLES))


def test_samples_are_lost_and_impossible():
    shares, count = np.array([0.05, 0.2]), 7
    _, exact, exact_force = fly()
    _, states, force = fly(bad_samples=count)
    bad = np.concatenate([states != exact, force != exact_force], axis=1) & ~np.isnan(np.c_[exact, exact_force])
    assert bad[:, [*RATES, 12, 13, 14]].sum() == bad.sum() == count
    assert (np.c_[states, force][bad] == 1e6).all()
    _, states, force = fly(dropouts=shares)
    lost = np.isnan(np.c_[states[:, RATES], force])
    np.testing.assert_array_equal(lost, lost[:, [0, 0, 0, 3, 3, 3]])
    np.testing.assert_allclose(lost.mean(axis=0)[[0, 3]], shares, atol=4 * np.sqrt(0.25 * 0.2 / SAMPLES * 4))
    # Which samples are lost is independent.
    assert abs(np.corrcoef(lost[:, 0], lost[:, 3])[0, 1]) < 4 / np.sqrt(SAMPLES)
    np.testing.assert_array_equal(states[:, ANGLES], exact[:, ANGLES])


def test_a_battery_sags_linearly():
    sag = 0.2
    omega, _, force = fly(LEVEL, loop={"sag": sag})
    np.testing.assert_allclose(omega, HOVER, rtol=1e-9)
    np.testing.assert_allclose(force[:, 2], GRAVITY * (1 - sag * TIME / TIME[-1]), rtol=1e-9)


def test_a_battery_sags_under_load():
    """Level commands above hover load it: with slow rotors, the speed is that of the command times the voltage."""
    sag, more = 0.1, 1.15
    omega, _, force = fly(LEVEL + [0, 0, 0, (more**2 - 1) * GRAVITY], loop={"load_sag": sag})
    np.testing.assert_allclose(omega, more * HOVER, rtol=1e-9)
    # The share of hover at which x = more (1 - sag (x^3 - 1)).
    share = np.roots([more * sag, 0, 1, -more * (1 + sag)])
    (share,) = share[np.isreal(share)].real
    np.testing.assert_allclose(force[TIME > 1, 2], share**2 * GRAVITY, rtol=1e-6)
    np.testing.assert_allclose(fly(LEVEL, loop={"load_sag": sag})[2][:, 2], GRAVITY, rtol=1e-9)


@pytest.mark.parametrize("delay", [0.003, 0.0105])
def test_the_log_and_its_controller_see_the_gyro_late(delay):
    _, exact, _ = fly(gyro_filter=0.003)
    _, states, _ = fly(gyro_filter=0.003, gyro_delay=delay)
    for axis in RATES:
        expected = np.interp(TIME - delay, TIME, exact[:, axis])
        np.testing.assert_allclose(states[2:, axis], expected[2:], atol=1e-9)
    assert np.abs(states - exact)[:, RATES].max() > 0.01
    answers = [fly(gyro_delay=late, controller_gyro_noise=None)[0] for late in (0.0, delay)]
    assert np.std(answers[1] - answers[0]) > 0.3
