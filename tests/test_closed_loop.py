"""`fly_closed_loop`: the physics and the controller against a second implementation in NumPy, gusts, limits, failures.

Unless a test says otherwise: no gusts, no noise.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from closed_loop_flights import ANGLES, DT, LEVEL, QUIET, RATES, SUCCESS, VELOCITY, references
from helpers import CRAZYFLIE, CRAZYFLIE_TOML, FULL_SPEED, output_of
from scipy.spatial.transform import Rotation

import jaxos4
from jaxos4.closed_loop import fly_standard

NO_GAINS = {"attitude_gain": 0.0, "rate_gain": 0.0, "integral_gain": 0.0}
VEHICLES = {"crazyflie": CRAZYFLIE, "os4": jaxos4.OS4}
every_vehicle = pytest.mark.parametrize("airframe", VEHICLES.values(), ids=VEHICLES)


def loop_of(airframe=CRAZYFLIE, **settings):
    return jaxos4.ClosedLoop(airframe, **{**QUIET, **settings})


def fly(loop, wanted=LEVEL, *, seed=1):
    """All flights have one length, and share one program."""
    return jaxos4.fly_closed_loop(loop, jnp.asarray(wanted), dt=DT, key=jax.random.key(seed))


def test_random_references_bring_the_vehicle_back_to_its_height():
    """A pair of accelerations gains no velocity: it rises in one step of 0.5 s, at 1.5 m/s^2 at most."""
    wanted = np.asarray(jaxos4.random_references(duration=60.0, dt=0.01, key=jax.random.key(0)))
    gained = 0.01 * np.cumsum(wanted[:, 3])
    assert 0.5 < np.abs(gained).max() < 2 * 1.5 * 0.5
    assert np.abs(np.corrcoef(wanted[100:-100].T) - np.eye(4)).max() < 0.35  # each its own steps


# The second implementation.


def fall_and_turn(motion, speeds, change, v):
    """The derivative of rates, attitude and velocity from Newton and Euler, with one force for each rotor.

    The velocity is along the axes of the earth.
    """
    airframe = v.airframe
    (x, y), spin = np.asarray(airframe.rotor_positions).T, np.asarray(airframe.rotor_spins)
    inertia, rotor = np.asarray(airframe.inertia), float(airframe.rotor_inertia)
    force = float(airframe.thrust_coefficient) * speeds**2
    yaw = -float(airframe.drag_coefficient) * spin @ speeds**2 - rotor * spin @ change
    rate, (phi, theta, psi) = motion[:3], motion[3:6]
    momentum = inertia * rate + [0, 0, rotor * spin @ speeds]
    (p, q, r), (a, b, c) = rate, momentum  # `numpy.cross` takes long
    gyroscopic = [q * c - r * b, r * a - p * c, p * b - q * a]
    turning = (np.array([y @ force, -x @ force, yaw]) - gyroscopic) / inertia
    turning += np.asarray(v.offset) - np.asarray(v.damping) * rate
    to_earth = Rotation.from_euler("ZYX", [psi, theta, phi]).as_matrix()
    along = to_earth.T @ motion[6:]
    turning += np.array([*np.asarray(v.air.flapping) * along[[1, 0]], 0])
    specific = [0, 0, force.sum() / float(airframe.mass)] - np.array([*v.air.drag, v.air.inflow]) * along
    moving = to_earth @ specific - [0, 0, float(airframe.gravity)]
    across = rate[1] * np.sin(phi) + rate[2] * np.cos(phi)
    forward = rate[1] * np.cos(phi) - rate[2] * np.sin(phi)
    return np.array([*turning, rate[0] + np.tan(theta) * across, forward, across / np.cos(theta), *moving])


def reference_motion(v, omega, samples, fine=10):
    """Rates, attitude and velocity, and rotor speeds, at each sample, from commands: small midpoint steps."""
    v = jax.tree.map(np.asarray, v)  # JAX takes long for single numbers
    h, lag, delay = DT / fine, float(v.rotor_lag), float(v.rotor_delay)
    weight = float(v.airframe.mass * v.airframe.gravity)
    hover = np.sqrt(np.linalg.solve(np.asarray(v.airframe.mixer), [0, 0, 0, weight]))
    motion, speeds, motions, turning = np.zeros(9), hover, [], []
    for k in range(samples):
        motions.append(motion)
        turning.append(speeds)
        for j in range(fine):
            row = int(np.floor(k + (j + 0.5) / fine - delay / DT))
            u = omega[row] if row >= 0 else hover
            after = u + (speeds - u) * np.exp(-h / lag)
            middle = u + (speeds - u) * np.exp(-h / 2 / lag)
            change = (after - speeds) / h
            half = motion + h / 2 * fall_and_turn(motion, speeds, change, v)
            motion = motion + h * fall_and_turn(half, middle, change, v)
            speeds = after
    return np.array(motions), np.array(turning)


def reference_commands(v, measured, wanted, inertia):
    """The commands of the controller, from what it measured."""
    mass, gravity, full = (float(getattr(v.airframe, n)) for n in ("mass", "gravity", "max_rotor_speed"))
    integral, rows = np.zeros(3), []
    for rates, angles, reference in zip(measured[:, RATES], measured[:, ANGLES], wanted, strict=True):
        error = np.asarray(v.attitude_gain) * (reference[:3] - angles) - rates
        torque = inertia * (np.asarray(v.rate_gain) * error + integral)
        thrust = mass * (gravity + reference[3]) / max(np.cos(angles[0]) * np.cos(angles[1]), 0.5)
        squares = np.linalg.inv(np.asarray(v.airframe.mixer)) @ [*torque, thrust]
        rows.append(np.sqrt(np.clip(squares, 0, full**2)))
        if (squares >= 0).all() and (squares <= full**2).all():
            integral = integral + DT * np.asarray(v.integral_gain) * error
    return np.array(rows)


@pytest.fixture(scope="module")
def rough():
    """A flight with everything that the second implementation knows; the delay is 2.7 samples."""
    inertia = 1.25 * np.asarray(CRAZYFLIE.inertia)
    return loop_of(
        **{"rotor_lag": 0.04, "rotor_delay": 2.7 * DT, "offset": (3.0, -2.0, 1.0), "damping": (1.5, 0.8, 0.4)},
        **{"air": jaxos4.Air(drag=(0.4, 0.2), inflow=0.7, flapping=(-2.0, 1.5))},
        sensors=jaxos4.Sensors(velocity_noise=0.0),
        controller_inertia=inertia,
    )


def test_the_motion_follows_from_the_commands(rough):
    flight, samples = fly(rough, references()), 400
    omega, measured = np.asarray(flight.omega), np.asarray(flight.states)[:samples, RATES + ANGLES + VELOCITY]
    assert np.abs(measured).max(axis=0).min() > 0.03
    np.testing.assert_allclose(measured, reference_motion(rough, omega, samples)[0], rtol=0, atol=2e-4)
    # The reference sees a delay that is wrong by half a millisecond, and each effect of the air.
    for part, change, seen in (
        (lambda v: v.rotor_delay, 5e-4, 5e-3),
        (lambda v: v.air.drag, 0.1, 2e-3),
        (lambda v: v.air.inflow, 0.1, 2e-3),
        (lambda v: v.air.flapping, 0.5, 5e-3),
    ):
        wrong = eqx.tree_at(part, rough, part(rough) + change)
        assert np.abs(measured - reference_motion(wrong, omega, samples)[0]).max() > seen


def test_measured_speeds_are_those_at_the_time_of_the_sample():
    """The commands at this time act from then on."""
    samples = 400
    commanded, measured = (fly(loop_of(rotor_lag=0.04, logged=kind), references()) for kind in ("commands", "speeds"))
    assert (commanded.commanded, measured.commanded) == (True, False)
    assert (commanded.held, measured.held) == (True, False)
    same = loop_of(rotor_lag=0.04, air=jaxos4.Air())
    _, expected = reference_motion(same, np.asarray(commanded.omega), samples + 1)
    found = np.asarray(measured.omega)[:samples]
    np.testing.assert_allclose(found, expected[:-1], rtol=1e-5)
    # The reference sees means over the samples.
    assert np.abs(found - (expected[:-1] + expected[1:]) / 2).max() > 10


def test_commands_follow_from_the_measurements(rough):
    """Also with noise, gusts and saturation, because the log has what the controller saw."""
    noisy = jaxos4.ClosedLoop(CRAZYFLIE, gust=40.0, controller_inertia=rough.controller_inertia)
    for loop in (rough, noisy):
        flight, wanted = fly(loop, references()), np.asarray(references())
        states = np.asarray(flight.states)
        expected = reference_commands(loop, states, wanted, np.asarray(rough.controller_inertia))
        np.testing.assert_allclose(np.asarray(flight.omega), expected, rtol=1e-6, atol=1e-6)
    assert (expected.min(), expected.max()) == (0.0, FULL_SPEED)


# What the vehicle does.


@every_vehicle
def test_the_standard_flight(airframe):
    """The vehicle flies through gusts, excites all axes, and its log has what an autopilot's log has."""
    loop = jaxos4.ClosedLoop(airframe, gust=(5.0, 5.0, 2.0))
    flight = fly_standard(loop, seed=3)
    assert flight.result == SUCCESS
    states, force = np.asarray(flight.states), np.asarray(flight.specific_force)
    assert np.isnan(np.delete(states, RATES + ANGLES, axis=1)).all()
    assert (np.std(states[:, RATES], axis=0) > 0.2).all()
    assert (np.abs(states[:, ANGLES]).max(axis=0) < 1).all()
    np.testing.assert_allclose(force.std(axis=0)[:2], 0.3, rtol=0.05)
    # Second differences of the rates are white noise of the gyro and little else.
    noise = np.diff(states[:, RATES], n=2, axis=0).std(axis=0) / np.sqrt(6)
    np.testing.assert_allclose(noise, 0.02, rtol=0.1)
    assert (np.asarray(flight.omega) <= float(airframe.max_rotor_speed)).all()


def test_commands_can_act_at_once():
    flight = fly(loop_of(rotor_lag=0.0, rotor_delay=0.0), references())
    assert flight.result == SUCCESS
    # The specific force at a sample is the thrust of the command before it.
    thrust = float(CRAZYFLIE.thrust_coefficient) * np.square(np.asarray(flight.omega)).sum(axis=1) / 0.027
    np.testing.assert_allclose(np.asarray(flight.specific_force)[1:, 2], thrust[:-1], rtol=1e-12)


# Gusts.


def test_gusts_have_their_strength_and_their_correlation_time_and_follow_from_the_key():
    """A controller without gains answers nothing: the body rates are the integral of the gusts."""
    strength, duration = np.array([1e-3, 2e-3, 3e-3]), 0.05
    loop = loop_of(gust=strength, gust_time=duration, thrust_gust=0.5, **NO_GAINS)
    flight, again, other = fly(loop), fly(loop), fly(loop, seed=2)
    gust = np.diff(np.asarray(flight.states)[:, RATES], axis=0) / DT
    force = np.asarray(flight.specific_force)[:, 2] - 9.81
    # 16 s are 320 correlation times: the variance has a standard error of 8 %.
    np.testing.assert_allclose(gust.std(axis=0) / strength, 1, atol=0.16)
    np.testing.assert_allclose(force.std() / 0.5, 1, atol=0.16)
    found = (gust[12:] * gust[:-12]).mean(axis=0) / gust.var(axis=0)
    np.testing.assert_allclose(found, np.exp(-12 * DT / duration), atol=0.22)
    np.testing.assert_array_equal(again.states, flight.states)
    assert not np.array_equal(other.specific_force, flight.specific_force)


# Batches and failures.


EVERY_EFFECT = jaxos4.ClosedLoop(
    CRAZYFLIE,
    **{"gyro_noise": 0.02, "attitude_noise": 0.0, "force_noise": 0.0, "sag": 0.1, "gust": 5.0},
    air=jaxos4.Air(wind=1.0, drag=0.3, inflow=0.4, flapping=(-3.0, 3.0)),
    sensors=jaxos4.Sensors(
        **{"gyro_vibration": 0.1, "force_vibration": 0.3, "gyro_filter": 0.005, "force_filter": 0.01},
        **{"speed_noise": 3.0, "speed_step": 1.0, "clock_offset": 0.003, "dropouts": 0.05, "bad_samples": 3},
    ),
)


@pytest.mark.slow
def test_a_batch_is_a_loop_and_a_failure_stays_in_its_lane():
    """Two vehicles, one with all effects, one that pitches over, one whose rates grow without bound."""
    whole = {"air": jaxos4.Air(), "sensors": jaxos4.Sensors()}
    fleet = [
        jaxos4.ClosedLoop(CRAZYFLIE, gust=10.0, **whole),
        jaxos4.ClosedLoop(jaxos4.OS4, gust=2.0, rotor_lag=0.02, rotor_delay=0.005, **whole),
        EVERY_EFFECT,
        loop_of(offset=(0.0, 2.0, 0.0), **NO_GAINS, **whole),
        loop_of(offset=(1.0, 1.0, 0.0), damping=-1e3, **NO_GAINS, **whole),
    ]
    single = [fly(loop, references(i), seed=i) for i, loop in enumerate(fleet)]
    loops = jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(x) for x in leaves]), *fleet)
    keys, wanted = (jnp.stack([of(i) for i in range(5)]) for of in (jax.random.key, references))
    together = eqx.filter_vmap(lambda v, r, key: jaxos4.fly_closed_loop(v, r, dt=DT, key=key))(loops, wanted, keys)
    names = [*["successful"] * 3, "attitude_singularity", "nonfinite_trajectory"]
    assert jaxos4.result_names(together.result).tolist() == names
    for i, alone in enumerate(single):
        assert jaxos4.result_names(alone.result) == names[i]
        for field in ("omega", "states", "specific_force"):
            # The sums of a batch are in another order.
            found, expected = np.asarray(getattr(together, field))[i], np.asarray(getattr(alone, field))
            np.testing.assert_allclose(found[:500], expected[:500], rtol=1e-6, atol=1e-9)
    for i in (3, 4):
        states, omega = np.asarray(together.states)[i][:, RATES + ANGLES], np.asarray(together.omega)[i]
        first = int(np.argmax(np.isnan(states).any(axis=1)))
        assert np.isnan(states[first:]).any(axis=1).all()
        assert np.isfinite(states[:first]).all()
        assert (omega[first:] == 0).all()
        assert np.isfinite(omega).all()


# The command line.


def test_simulate_writes_what_estimate_reads(run, tmp_path):
    (tmp_path / "crazyflie.toml").write_text(CRAZYFLIE_TOML)
    out = output_of(run("simulate", "--closed-loop", "--airframe", "crazyflie.toml", "--out", "a.csv"))
    assert "5001 samples of 0.004 s, closed loop, commands, gusts of 5 rad/s^2" in " ".join(out.split())
    airframe = jaxos4.load_airframe(tmp_path / "crazyflie.toml")
    flight = jaxos4.read_flight(tmp_path / "a.csv", airframe)
    assert flight.commanded
    expected = fly_standard(jaxos4.ClosedLoop(airframe, gust=5.0), seed=0)
    np.testing.assert_allclose(flight.omega, expected.omega, rtol=1e-12)
    np.testing.assert_array_equal(flight.states, expected.states)
    np.testing.assert_array_equal(flight.specific_force, expected.specific_force)
    # An airframe without a largest speed has a log of speeds.
    code, out, _ = run("simulate", "--closed-loop", "--out", "b.csv", "--gust", "2")
    assert (code, "speeds" in out) == (0, True)
    assert not jaxos4.read_flight(tmp_path / "b.csv").commanded
