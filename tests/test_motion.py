"""The motion that a recording shows: its velocity, measured or by dead reckoning; its rotor speeds without noise."""

import functools

import numpy as np
import pytest
import scipy.signal
from helpers import CRAZYFLIE
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from jaxos4.recording import Recording
from jaxos4.recording.motion import measures_velocity, velocity_of
from jaxos4.recording.sensor_errors import force_level, without_noise

# The velocity, against a trajectory that SciPy integrates.

G, FORGETS, SECONDS = 9.81, 2.0, 20.0
ANGLES, VELOCITY, RATES = [6, 8, 10], [1, 3, 5], [7, 9, 11]


def tones(t, *parts):
    """A sum of sines, and its derivative. `parts`: amplitude, frequency [Hz], phase."""
    turns = [(a, 2 * np.pi * f, 2 * np.pi * f * t + phase) for a, f, phase in parts]
    return sum(a * np.sin(x) for a, _, x in turns), sum(a * w * np.cos(x) for a, w, x in turns)


def flown_at(t):
    """Euler angles, body rates, and the specific force of a thrust along z. The climb has whole periods."""
    (phi, phi_), (theta, theta_), (psi, psi_) = (
        tones(t, (0.2, 0.7, 0.0)), tones(t, (0.15, 0.9, 1.0)), tones(t, (0.4, 0.3, 0.0)),
    )  # fmt: skip
    p = phi_ - psi_ * np.sin(theta)
    q = theta_ * np.cos(phi) + psi_ * np.sin(phi) * np.cos(theta)
    r = -theta_ * np.sin(phi) + psi_ * np.cos(phi) * np.cos(theta)
    climb, _ = tones(t, (3.0, 0.8, 0.0), (2.0, 1.5, 1.0))
    thrust = (G + climb) / (np.cos(phi) * np.cos(theta))
    return np.stack([phi, theta, psi], -1), np.stack([p, q, r], -1), np.stack([0 * thrust, 0 * thrust, thrust], -1)


def to_earth(angles):
    return Rotation.from_euler("ZYX", angles[..., ::-1])


@functools.cache
def trajectory(dt):
    """A recording, its velocity in the body, and the same after the slow part of it is forgotten."""
    time = dt * np.arange(round(SECONDS / dt))

    def follow(t, state):
        angles, _, force = flown_at(t)
        push = to_earth(angles).apply(force) - [0.0, 0.0, G]
        return np.concatenate([push, push - state[3:] / FORGETS])

    exact = solve_ivp(follow, (0.0, time[-1]), np.zeros(6), t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.02).y.T
    angles, rates, force = flown_at(time)
    states = np.full((time.size, 12), np.nan)
    states[:, ANGLES], states[:, RATES], states[:, VELOCITY] = angles, rates, exact[:, :3]
    turn = to_earth(angles)
    true, forgetful = (turn.apply(part, inverse=True) for part in (exact[:, :3], exact[:, 3:]))
    return Recording(time, np.full((time.size, 4), 100.0), states, force), true, forgetful


def without(recording, *columns):
    states = recording.states.copy()
    states[:, sum(columns, [])] = np.nan
    return recording._replace(states=states)


def test_a_measured_velocity_is_turned_by_the_attitude():
    recording, true, _ = trajectory(0.004)
    velocity, ups = velocity_of(recording)
    assert measures_velocity(recording)
    np.testing.assert_allclose(velocity, true, atol=1e-9)
    upright = to_earth(recording.states[:, ANGLES]).apply([0.0, 0.0, 1.0], inverse=True)
    np.testing.assert_allclose(ups[0], upright, atol=1e-12)
    gaps = recording._replace(states=recording.states.copy())
    gaps.states[20:24] = np.nan  # a gap has the value before it
    np.testing.assert_allclose(velocity_of(gaps)[0][20:24], true[[19] * 4], atol=1e-9)


def test_dead_reckoning_converges_to_the_integral_that_forgets():
    errors = []
    for dt in (0.008, 0.004):
        recording, _, forgetful = trajectory(dt)
        assert not measures_velocity(without(recording, VELOCITY))
        errors.append(np.abs(velocity_of(without(recording, VELOCITY), forgets=2.0)[0] - forgetful).max())
    assert errors[1] < 0.05
    assert errors[1] < 0.7 * errors[0]


@pytest.mark.parametrize(("unknown", "share"), [([], 0.2), (ANGLES, 0.3)], ids=["attitude", "nothing"])
def test_the_velocity_along_z_is_found(unknown, share):
    recording, true, _ = trajectory(0.004)
    (velocity, ups), late = velocity_of(without(recording, VELOCITY, unknown)), recording.time > 5
    assert (velocity - true)[late, 2].std() < share * true[late, 2].std()
    up = np.cos(recording.states[late, 6]) * np.cos(recording.states[late, 8])
    assert np.abs(ups[0][late, 2] - up).max() < 0.03


def test_a_constant_error_of_the_accelerometer_is_left_out_and_without_it_or_a_gyro_there_is_no_velocity():
    recording = without(trajectory(0.004)[0], VELOCITY)
    (velocity, ups), force = velocity_of(recording), recording.specific_force.copy()
    biased = recording._replace(specific_force=force + 0.5 * ups[0])
    np.testing.assert_allclose(velocity_of(biased)[0], velocity, atol=1e-9)
    force[:, 1] = np.nan
    for lacking in (None, force):
        assert velocity_of(recording._replace(specific_force=lacking)) is None
    assert velocity_of(without(recording, RATES)) is None


# White noise of measured rotor speeds: its level, and the speeds that are expected given the measured ones.


def recordings(noise, *, samples=10_000, seed=0):
    """The measured and the true speeds of rotors that follow random levels within 50 ms."""
    random, time = np.random.default_rng(seed), 0.004 * np.arange(samples)
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


@pytest.mark.parametrize(("rest", "level", "spread"), [([], 0.5, 0.06), ([10.3], 0.5, 0.06), ([9.1], -0.71, 0.2)])
def test_rest_before_take_off_decides_the_level_of_a_flight_that_disagrees(rest, level, spread):
    """The flight feels 0.5 m/s^2 too much."""
    samples = 5000
    states = np.zeros((samples, 12))
    force = np.tile([0.0, 0.0, G + 0.5], (samples, 1))
    flight = Recording(0.004 * np.arange(samples), np.full((samples, 4), 1700.0), states, force)
    up = np.tile([0.0, 0.0, 1.0], (samples, 1))
    found = force_level(flight, [(up, up)], [np.array([0.0, 0.0, size]) for size in rest], G)
    assert found is not None
    assert found[0] == pytest.approx(level, abs=0.02)
    assert found[1] <= spread + 1e-9
    assert force_level(flight, [], [], G) is None
