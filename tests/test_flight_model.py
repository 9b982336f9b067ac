"""`FlightModel`: each term against its equation written a second time, lag and delay, derivatives, estimates.

The reference is plain NumPy in continuous time: held commands, and rotors and body integrated together in small steps.
"""

import itertools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import curvatures, first_state, forcing_of, standard_flight

import jaxos4
from jaxos4.flight import Inputs, Stretches
from jaxos4.models import Term, TermParameter, default_terms
from jaxos4.models.state import CASCADE_ORDER, Rates
from jaxos4.models.terms import BODY_VELOCITY, COMMANDS, FULL_SCALE, LATERAL_FORCE, VERTICAL_FORCE, VOLTAGE
from jaxos4.models.vehicle import DEFAULT_TERMS

ALL = tuple(jaxos4.TERMS)
RATE_TERMS = tuple(term for term in ALL if term not in ("velocity", "flapping", "drag"))
FULL = eqx.tree_at(lambda a: a.max_rotor_speed, jaxos4.OS4, np.asarray(500.0))
VOLTS = 11.1
NAMES = {
    "offset": ["roll_offset", "pitch_offset", "yaw_offset"],
    "center_of_mass": ["roll_thrust", "pitch_thrust"],
    "damping": ["roll_damping", "pitch_damping", "yaw_damping"],
    "velocity": ["roll_velocity", "pitch_velocity"],
    "flapping": ["roll_flapping", "pitch_flapping"],
    "voltage": ["voltage_exponent"],
    "lag": ["rotor_lag"],
    "delay": ["rotor_delay"],
    "reaction": ["rotor_reaction"],
    "curve": ["thrust_curve"],
    "accelerometer": ["thrust_gain", "az_bias"],
    "drag": ["x_drag", "y_drag"],
    "gyro_bias": ["p_bias", "q_bias", "r_bias"],
}
# A vehicle with all terms; its delay is a whole number of samples of the steps below.
VALUES = {
    **dict(roll_offset=0.3, pitch_offset=-0.2, yaw_offset=0.1, roll_damping=1.5, pitch_damping=0.8, yaw_damping=0.4),
    **dict(roll_velocity=0.3, pitch_velocity=-0.4, roll_flapping=0.2, pitch_flapping=-0.1, rotor_lag=0.06),
    **dict(rotor_delay=0.02, rotor_reaction=0.02, thrust_curve=0.6, thrust_gain=1.2, x_drag=0.4, y_drag=0.3),
    **dict(ax_bias=0.5, ay_bias=-0.4, az_bias=0.2, p_bias=0.03, q_bias=-0.02, r_bias=0.01),
    **dict(roll_thrust=-0.5, pitch_thrust=0.9, voltage_exponent=0.7),
}


def truth(model):
    """A value for each parameter of a model, whatever recording it belongs to."""
    alpha = dict(zip(jaxos4.CorrectedOS4().parameter_names, np.asarray(jaxos4.CorrectedOS4(FULL).alpha), strict=True))
    values = {**alpha, **VALUES}
    rows = [values[n] if n in values else values[n[:-2]] * (1.0 - 2.0 * (n[-1] == "2")) for n in model.parameter_names]
    return jnp.asarray(np.array(rows))


def commands(seconds, dt, *, hold=0.02):
    """Rotor speeds that are held for 20 ms, the same on every time grid."""
    rows = np.arange(round(seconds / dt) + 1) * dt
    t = hold * np.floor(rows / hold + 1e-9)
    hover = float(jaxos4.OS4.hover_speed)
    phases, tones = np.array([0.0, 1.1, 2.0, 3.3]), np.array([0.9, 1.3, 1.1, 1.7])
    return hover * (1 + 0.05 * np.sin(2 * np.pi * tones * t[:, None] + phases))


def battery(samples, dt):
    """A voltage that falls, and that dips when the rotors take more [V]."""
    t = dt * np.arange(samples)
    return VOLTS + 0.6 - 0.4 * t + 0.3 * np.sin(7.0 * t)


def reference(terms, omega, dt, *, fine, values=VALUES, airframe=FULL):
    """The states in cascade order and the specific force, on the samples: the class's equations, with Runge-Kutta."""
    v = {name: values[name] if name in sum((NAMES[t] for t in terms), []) else 0.0 for name in VALUES}
    v["thrust_gain"] = values["thrust_gain"] if "accelerometer" in terms else 1.0
    v["ax_bias"], v["ay_bias"] = ((values[n] if {"accelerometer", "drag"} <= set(terms) else 0.0) for n in NAMES_XY)
    a1, a2, a3, a4, a5, a6, a7, a8 = np.asarray(jaxos4.CorrectedOS4(airframe).alpha)
    b, d, m, g = (float(getattr(airframe, n)) for n in ("thrust_coefficient", "drag_coefficient", "mass", "gravity"))
    (x, y), spin = np.asarray(airframe.rotor_positions).T, np.asarray(airframe.rotor_spins)
    curve = values["thrust_curve"] if "curve" in terms else 1.0
    full = float(airframe.max_rotor_speed)
    omega = omega * ((battery(omega.shape[0], dt) / VOLTS) ** v["voltage_exponent"])[:, None]
    # The centre of mass (x_c, y_c): its torque in hover belongs to the offset.
    x_c, y_c = v["pitch_thrust"] / (a6 * m), -v["roll_thrust"] / (a3 * m)

    def body(state, w, w_dot):
        p, q, r, phi, theta, psi = state[:6]
        force = b * (curve * w**2 + (1 - curve) * (full * w if curve != 1 else 0.0))
        cx, sx, cy, sy, cz, sz = (f(angle) for angle in (phi, theta, psi) for f in (np.cos, np.sin))
        turn = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
        turn = turn @ [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
        vx, vy, _ = turn.T @ state[[7, 9, 11]]
        specific = np.array([-v["x_drag"] * vx, -v["y_drag"] * vy, v["thrust_gain"] * force.sum() / m])
        rates_dot = [
            a1 * q * r - a2 * (spin @ w) * q + a3 * (y @ force) + v["roll_offset"] - v["roll_damping"] * p
            + v["roll_velocity"] * vy - a3 * y_c * (force.sum() - 9.81 * m),
            a4 * p * r + a5 * (spin @ w) * p - a6 * (x @ force) + v["pitch_offset"] - v["pitch_damping"] * q
            + v["pitch_velocity"] * vx + a6 * x_c * (force.sum() - 9.81 * m),
            a7 * p * q - a8 * d / b * (spin @ force) + v["yaw_offset"] - v["yaw_damping"] * r
            - v["rotor_reaction"] * (spin @ w_dot),
        ]  # fmt: skip
        turning = [p + np.tan(theta) * (q * sx + r * cx), q * cx - r * sx, (q * sx + r * cx) / cy]
        ax, ay, az = turn @ specific - [0, 0, g]
        biased = specific + [v["ax_bias"], v["ay_bias"], v["az_bias"]]
        return np.array([*rates_dot, *turning, state[7], ax, state[9], ay, state[11], az]), biased

    def whole(z, u):
        w = z[12:] if "lag" in terms else u
        w_dot = (u - w) / v["rotor_lag"] if "lag" in terms else np.zeros(4)
        dz, force = body(z[:12], w, w_dot)
        return np.concatenate([dz, w_dot]), force

    late = round(v["rotor_delay"] / dt)
    z = np.concatenate([np.zeros(12), omega[0]])
    states, forces, h = [], [], dt / fine
    for k in range(omega.shape[0]):
        u = omega[max(k - late, 0)]
        states.append(z[:12])
        forces.append(whole(z, u)[1])
        for _ in range(fine):
            k1 = whole(z, u)[0]
            k2 = whole(z + h / 2 * k1, u)[0]
            k3 = whole(z + h / 2 * k2, u)[0]
            k4 = whole(z + h * k3, u)[0]
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    states = np.array(states)
    for i, name in enumerate(NAMES["gyro_bias"]):
        states[:, i] += v[name]
    return states, np.array(forces)


NAMES_XY = ("ax_bias", "ay_bias")
RIGID = ("alpha1", "alpha2", "alpha4", "alpha5", "alpha7")


def seen(model, omega, dt, *, method="rk4"):
    """What the model's sensors show, from rest, beside the flight."""
    samples = omega.shape[0]
    blank = jaxos4.Flight(dt * np.arange(samples), omega, np.full((samples, 12), np.nan), voltage=battery(samples, dt))
    problem = jaxos4.ShootingProblem(model, blank, sigma=np.ones(12), initial_state=np.zeros(12), method=method)
    return np.asarray(problem.predict(truth(model), jnp.zeros(12)))


def test_without_terms_it_is_the_corrected_model():
    model, plain = jaxos4.FlightModel(terms=()), jaxos4.CorrectedOS4()
    omega = jaxos4.multisine(jaxos4.OS4, duration=2.0)
    inputs = Inputs(omega, jnp.asarray(0.01))
    forcings = [forcing_of(m, inputs, plain.alpha)[:5] for m in (model, plain)]
    for one, other in zip(*forcings, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-13 * np.abs(other).max())
    np.testing.assert_array_equal(model.alpha, plain.alpha)
    np.testing.assert_array_equal(model.half_width, plain.half_width)
    assert model.parameters == plain.parameters
    assert (model.is_linear, model.forcing_parameters, model.force_axes, model.observes_states) == (True, (), (), True)
    for method in ("euler", "rk4"):
        flights = [jaxos4.simulate(m, plain.alpha, omega, dt=0.01, method=method).states for m in (model, plain)]
        np.testing.assert_allclose(*flights, rtol=1e-11, atol=1e-12)
    state = jnp.linspace(-0.4, 0.7, 12)
    derivatives = [eqx.filter_jit(type(m).derivative)(m, state, omega[3], plain.alpha) for m in (model, plain)]
    np.testing.assert_allclose(*derivatives, rtol=1e-11, atol=1e-12)


@pytest.mark.parametrize(
    ("terms", "tolerance"),
    [
        (("offset", "damping", "velocity", "gyro_bias"), 1e-7),
        (("offset", "center_of_mass"), 1e-7),
        (("voltage", "accelerometer"), 1e-7),
        (("curve", "accelerometer"), 1e-7),
        (("accelerometer", "drag"), 1e-7),
        (("lag", "delay", "reaction"), 2e-3),
        (tuple(term for term in ALL if term != "flapping"), 2e-3),
    ],
    ids=["air", "center of mass", "voltage", "curve", "drag", "rotors", "all"],
)
def test_terms_are_their_equations(terms, tolerance):
    """Inputs are held, so that without a lag only Runge-Kutta errs; with one, straight lines over samples do."""
    dt = 0.005
    omega = commands(0.8, dt)
    model = jaxos4.FlightModel(FULL, terms=terms, battery_voltage=VOLTS)
    found = seen(model, omega, dt)
    states, force = reference(terms, omega, dt, fine=3)
    expected = np.concatenate([states, force[:, list(model.force_axes)]], axis=1)
    assert found.shape == expected.shape
    errors = np.abs(found - expected).max(axis=0) / np.abs(expected).max(axis=0).clip(1e-3)
    assert errors.max() < tolerance, dict(zip(range(15), errors, strict=False))


def rates_with(term, field, measured, channels):
    """The rates of a flight with a measured input."""
    flight = jaxos4.Flight(0.01 * np.arange(51), commands(0.5, 0.01), np.full((51, 12), np.nan), **{field: measured})
    given = {"sigma": np.ones(12), "channels": channels, "initial_state": np.zeros(12)}
    problem = jaxos4.ShootingProblem(jaxos4.FlightModel(terms=(term,)), flight, **given)
    return np.asarray(problem.predict(truth(problem.model), jnp.zeros(problem.size)))[:, :3]


@pytest.mark.parametrize("channels", ["rates", "all"])
@pytest.mark.parametrize("measured", [("velocity", "body_velocity"), ("flapping", "specific_force")])
def test_a_measured_input_acts_in_its_own_step(measured, channels):
    once = np.zeros((51, 3))
    once[7] = x, y, _ = 0.7, -0.4, 0.2
    moved = rates_with(*measured, once, channels) - rates_with(*measured, np.zeros((51, 3)), channels)
    assert not moved[:8].any()
    expected = [0.01 * VALUES[f"roll_{measured[0]}"] * y, 0.01 * VALUES[f"pitch_{measured[0]}"] * x, 0.0]
    np.testing.assert_allclose(moved[8], expected, rtol=1e-9, atol=1e-15)


def test_gaps_of_a_measured_force_are_filled_with_the_value_before_or_after():
    gaps = np.random.default_rng(0).normal(size=(51, 3))
    filled = gaps.copy()
    gaps[10:14, 0], gaps[:3, 1] = np.nan, np.nan
    filled[10:14, 0], filled[:3, 1] = gaps[9, 0], gaps[3, 1]
    found = [rates_with("flapping", "specific_force", force, "rates") for force in (gaps, filled)]
    np.testing.assert_array_equal(*found)


@pytest.mark.parametrize("counts", [(1,), (2,), (37,), (5, 1, 20, 11), (1, 1, 1), (64, 64)])
def test_the_filter_is_the_recursion(counts):
    samples, dt, lag = sum(counts), 0.004, 0.05
    omega = np.random.default_rng(0).uniform(100, 400, (samples, 4))
    stretch = np.repeat(np.arange(len(counts)), counts)
    model = jaxos4.FlightModel(FULL, terms=("lag", "reaction", "accelerometer"))
    values = dict(zip(model.parameter_names, truth(model).tolist(), strict=True)) | {"rotor_lag": lag}
    given = None if len(counts) == 1 else jnp.asarray(stretch)
    inputs = Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=None if given is None else Stretches.of(given))
    found = forcing_of(model, inputs, jnp.array(list(values.values())))
    decay, here = np.exp(-dt / lag), np.empty_like(omega)
    for k in range(samples):
        restart = k == 0 or stretch[k] != stretch[k - 1]
        here[k] = omega[k] if restart else decay * here[k - 1] + (1 - decay) * omega[k - 1]
    following = decay * here + (1 - decay) * omega
    squares = (here**2 + here * following + following**2) / 3
    b, m, spins = float(FULL.thrust_coefficient), float(FULL.mass), np.asarray(FULL.rotor_spins)
    torques = squares @ np.asarray(FULL.mixer).T
    for value, expected in (
        (found.specific_thrust, b / m * (here**2).sum(axis=1)),
        (found.thrust, b / m * squares.sum(axis=1)),
        (found.spin_up, (following - here) @ spins / dt),
        (found.residual_speed, (here + following) @ spins / 2),
        *zip((found.roll, found.pitch, found.yaw), torques.T[:3], strict=True),
    ):
        np.testing.assert_allclose(value, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max() + 1e-15)


def test_a_lag_below_the_shortest_is_the_shortest():
    model = jaxos4.FlightModel(terms=("lag",))
    omega = jnp.asarray(commands(0.5, 0.01))
    inputs, plain = Inputs(omega, jnp.asarray(0.01)), jaxos4.CorrectedOS4()
    plain = forcing_of(plain, inputs, plain.alpha)
    for lag in (-1.0, 0.0, 1e-6):
        found = forcing_of(model, inputs, model.alpha.at[8].set(lag))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(found) if leaf is not None)
        # The difference is the straight line over the sample in which the command changes.
        assert np.abs(found.thrust - plain.thrust)[5:].max() < 0.1 * np.ptp(np.asarray(plain.thrust))


@jax.jit
def delayed(omega, delay, dt=0.01, stretch=None):
    model = jaxos4.FlightModel(terms=("delay",))
    inputs = Inputs(jnp.asarray(omega), jnp.asarray(dt), stretches=None if stretch is None else Stretches.of(stretch))
    return model.forcing(inputs, model.alpha.at[8].set(delay)).residual_speed


@pytest.mark.parametrize("samples", [-3, -1, 0, 1, 2, 7])
def test_whole_delays_are_exact(samples):
    counts = (30, 12, 1, 4)
    omega = np.random.default_rng(0).uniform(100, 400, (sum(counts), 4))
    begin, end = (np.repeat(ends, counts) for ends in (np.cumsum((0, *counts[:-1])), np.cumsum(counts) - 1))
    row = np.clip(np.arange(sum(counts)) - samples, begin, end)
    found = delayed(omega, 0.01 * samples, stretch=jnp.asarray(np.repeat(np.arange(4), counts)))
    np.testing.assert_allclose(found, omega[row] @ np.asarray(jaxos4.OS4.rotor_spins), rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("delay", [0.0031, 0.0149, 0.0377, -0.0121])
def test_parabolas_are_delayed_exactly(delay):
    def speeds(t):
        return np.stack([200 + 30 * t, 210 - 500 * t**2, 190 + 100 * t**2, 200 + 0 * t], axis=1)

    t = 0.01 * np.arange(60)
    expected = speeds(t - delay) @ np.asarray(jaxos4.OS4.rotor_spins)
    np.testing.assert_allclose(delayed(speeds(t), delay)[8:-8], expected[8:-8], rtol=1e-10, atol=1e-9)


def test_the_delay_has_a_continuous_derivative():
    omega = np.random.default_rng(0).uniform(100, 400, (40, 4))
    slope = jax.jit(jax.jacfwd(lambda delay: delayed(omega, delay)))
    size = np.abs(slope(0.0123)).max()
    for whole in (0.0, 0.01, 0.02, -0.01):
        below, above = slope(whole - 1e-9), slope(whole + 1e-9)
        np.testing.assert_allclose(below, above, atol=1e-5 * size)
        np.testing.assert_allclose(delayed(omega, whole - 1e-9), delayed(omega, whole + 1e-9), atol=1e-3)
    middle = 0.0137
    difference = (delayed(omega, middle + 1e-7) - delayed(omega, middle - 1e-7)) / 2e-7
    np.testing.assert_allclose(slope(middle), difference, rtol=1e-5, atol=1e-5 * size)


SUBSETS = [
    (),
    *((term,) for term in ALL),
    *itertools.combinations(("offset", "lag", "gyro_bias", "accelerometer", "drag"), 3),
    DEFAULT_TERMS,
    RATE_TERMS,
    ALL,
]


@pytest.mark.parametrize("recordings", [(0,), (0, 0), (0, 1), (1, 0, 2)])
def test_every_parameter_has_a_name_a_unit_and_a_bracket(recordings):
    count = max(recordings) + 1
    for terms in SUBSETS:
        model = jaxos4.FlightModel(FULL, terms=terms, recordings=recordings, battery_voltage=VOLTS)
        names = model.parameter_names
        own = [name for term in terms if term in ("offset", "gyro_bias") for name in NAMES[term]]
        shared = [name for term in terms if term not in ("offset", "gyro_bias") for name in NAMES[term]]
        shared += ["ax_bias", "ay_bias"] * ({"accelerometer", "drag"} <= set(terms))
        numbered = own if count == 1 else [f"{name}_{i + 1}" for name in own for i in range(count)]
        assert sorted(names) == sorted([*jaxos4.CorrectedOS4().parameter_names, *shared, *numbered])
        assert len(model.parameter_units) == len(names)
        center, half_width = np.asarray(model.alpha), np.asarray(model.half_width)
        assert center.shape == half_width.shape == (len(names),)
        assert np.all(np.isfinite(half_width) & (half_width > 0) & np.isfinite(center))
        chain = {"rotor_lag", "rotor_delay", "thrust_curve", "voltage_exponent"} & set(names)
        assert {names[i] for i in model.forcing_parameters} == chain
        assert model.is_linear == (not chain)
    # The order is that of TERMS, in whatever order they were given, and within a term recording by recording.
    assert jaxos4.FlightModel(terms=("lag", "offset")).parameter_names[8:] == (*NAMES["offset"], "rotor_lag")
    two = jaxos4.FlightModel(terms=("offset",), recordings=(0, 1)).parameter_names[8:]
    assert two == tuple(f"{name}_{i}" for i in (1, 2) for name in NAMES["offset"])


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"terms": ("curve",)}, "max_rotor_speed"),
        ({"terms": ("voltage",)}, "`battery_voltage` must be given for the term voltage"),
        ({"terms": ("wind",)}, "`terms` must be some of offset, center_of_mass, damping"),
        ({"terms": ("lag", "lag")}, "`terms` must be some of"),
        ({"terms": ("lag", "Lag")}, "`terms` must be some of"),
        *(({"recordings": some}, "`recordings` must count from 0") for some in ((), (1,), (0, 2), (-1, 0))),
        ({"terms": ("velocity",)}, "velocity, drag need `Flight.body_vel"),
        ({"terms": ("flapping",)}, "need `Flight.specific_force"),
        ({"terms": ("voltage",), "battery_voltage": VOLTS}, "voltage need `Flight.voltage`"),
    ],
)
def test_impossible_models_and_missing_measurements_are_named(settings, said):
    flight = jaxos4.Flight(0.01 * np.arange(51), commands(0.5, 0.01), np.full((51, 12), np.nan))

    def cost():
        model = jaxos4.FlightModel(**settings)
        return jaxos4.ShootingProblem(model, flight, sigma=np.ones(12), channels="rates").cost(truth(model))

    with pytest.raises(ValueError, match=said):
        cost()


def two_flights(model, *, windows=2, dt=0.01, seconds=2.0, noise=0.0, channels="rates"):
    """Two stretches, flown by the model itself and seen by its sensors."""
    parts, rng = [], np.random.default_rng(0)
    recordings = model.recordings if len(model.recordings) == 2 else (0, 0)
    for i, recording in enumerate(recordings):
        omega = commands(seconds, dt, hold=dt)[:: 1 - 2 * i][:-1]
        alone = jaxos4.FlightModel(model.airframe, terms=model.terms, battery_voltage=model.battery_voltage)
        voltage = battery(omega.shape[0], dt) - 0.5 * i
        values = dict(zip(model.parameter_names, truth(model).tolist(), strict=True))
        own = jnp.array([values.get(n, values.get(f"{n}_{recording + 1}")) for n in alone.parameter_names])
        time = dt * np.arange(omega.shape[0])
        blank = jaxos4.Flight(time, omega, np.full((omega.shape[0], 12), np.nan), voltage=voltage)
        problem = jaxos4.ShootingProblem(alone, blank, sigma=np.ones(12), channels=channels)
        found = np.asarray(problem.predict(own, jnp.zeros(problem.size)))
        states, force = np.full((omega.shape[0], 12), np.nan), np.full((omega.shape[0], 3), np.nan)
        states[:, CASCADE_ORDER[: problem.size]] = found[:, : problem.size]
        force[:, list(alone.force_axes)] = found[:, problem.size :]
        states, force = states + rng.normal(0, noise, states.shape), force + rng.normal(0, 10 * noise, force.shape)
        parts.append(jaxos4.Flight(time, omega, states, force, voltage=voltage))
    flight = jaxos4.join(parts, length=round(2 * seconds / dt / windows))
    return jaxos4.ShootingProblem(model, flight, sigma=jaxos4.SENSOR_SIGMA, channels=channels, windows=windows)


@pytest.mark.parametrize("recordings", [(0, 0), (0, 1)])
def test_gradient_and_information_are_the_residuals_derivatives(recordings):
    terms = ("offset", "lag", "delay", "curve", "accelerometer", "gyro_bias")
    problem = two_flights(jaxos4.FlightModel(FULL, terms=terms, recordings=recordings), windows=4, noise=0.01)
    count = len(problem.model.parameter_names)
    parameters = truth(problem.model) * 1.03
    unknowns = jnp.concatenate([parameters, first_state(problem)])

    def residuals(u):
        found = problem.residuals(u[:count], u[count:])
        return found, found

    jacobian, errors = map(np.asarray, jax.jit(jax.jacfwd(residuals, has_aux=True))(unknowns))
    scale = np.linalg.norm(jacobian, axis=0)
    found = curvatures(problem, parameters, unknowns[count:])
    own = problem.size
    for w in range(4):
        columns = np.r_[:count, count + w * own : count + (w + 1) * own]
        rows = np.repeat(problem.window_of_samples() == w, problem.columns.size)
        expected = jacobian[rows][:, columns]
        size = np.outer(scale[columns], scale[columns])
        np.testing.assert_allclose(found.information[w] / size, expected.T @ expected / size, atol=1e-10)
        gradient = expected.T @ errors[rows] / scale[columns] / np.linalg.norm(errors)
        np.testing.assert_allclose(found.gradient[w] / scale[columns] / np.linalg.norm(errors), gradient, atol=1e-10)
        assert float(found.shot.cost[w]) == pytest.approx(0.5 * float(errors[rows] @ errors[rows]), rel=1e-10)


@pytest.mark.parametrize("estimator", [jaxos4.IBSS(), jaxos4.OutputError()], ids=["ibss", "output error"])
def test_the_truth_is_found_without_noise(estimator):
    """The offsets of two recordings differ, and each is found."""
    model = jaxos4.FlightModel(FULL, terms=("offset", "lag", "delay"), recordings=(0, 1))
    whole = truth(model)
    held = jaxos4.hold(model, {name: whole[model.parameter_names.index(name)] for name in RIGID})
    problem = eqx.tree_at(lambda p: p.model, two_flights(model, seconds=2.0), held)
    values = held.without(whole)
    off = 0.4 * jnp.cos(jnp.arange(values.size)) * held.half_width
    found = estimator(problem, jaxos4.Bracket.around(values + off, held.half_width))
    np.testing.assert_array_less(np.abs(found.parameters - values) / held.half_width, 1e-4)


def test_the_centre_of_mass_and_the_effect_of_the_voltage_are_found():
    model = jaxos4.FlightModel(FULL, terms=("offset", "center_of_mass", "voltage", "delay"), battery_voltage=VOLTS)
    whole = truth(model)
    held = jaxos4.hold(model, {name: whole[i] for i, name in enumerate(model.parameter_names) if name in RIGID})
    problem = eqx.tree_at(lambda p: p.model, two_flights(model, seconds=3.0, noise=1e-4), held)
    problem = eqx.tree_at(lambda p: p.sigma, problem, jnp.full_like(problem.sigma, 1e-4))
    values = held.without(whole)
    found = jaxos4.OutputError()(problem, jaxos4.Bracket.default(held))
    std = np.sqrt(np.diagonal(found.covariance))
    assert np.all(std < 0.1 * held.half_width)
    assert np.all(np.abs(found.parameters - values) < 4 * std)
    alpha, mass = jaxos4.CorrectedOS4(FULL).alpha, float(FULL.mass)
    expected = {
        "x": VALUES["pitch_thrust"] / (float(alpha[5]) * mass),
        "y": -VALUES["roll_thrust"] / (float(alpha[2]) * mass),
    }
    coordinates = jaxos4.center_of_mass(held.parameter_names, found.parameters, found.covariance, FULL)
    assert [c.axis for c in coordinates] == ["x", "y"]
    for c in coordinates:
        assert abs(c.value - expected[c.axis]) < 4 * c.std
        assert c.std < 0.05 * abs(c.value)
    assert jaxos4.center_of_mass(held.parameter_names[:2], whole[:2], np.eye(2), FULL) == ()


def test_the_error_of_the_centre_of_mass_is_that_of_the_quotient():
    names, values = ("pitch_thrust", "roll_thrust", "alpha6", "alpha3"), np.array([0.9, -0.5, 133.0, 120.0])
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(4, 4)) * values[:, None] * 0.01
    covariance = spread @ spread.T
    draws = rng.multivariate_normal(values, covariance, 200_000)
    expected = draws[:, 0] / draws[:, 2] / 0.65, -draws[:, 1] / draws[:, 3] / 0.65
    for found, sample in zip(jaxos4.center_of_mass(names, values, covariance, FULL), expected, strict=True):
        assert found.value == pytest.approx(sample.mean(), rel=1e-3)
        assert found.std == pytest.approx(sample.std(), rel=0.02)


def test_the_attitude_distinguishes_a_gyro_bias_from_an_offset():
    model = jaxos4.FlightModel(FULL, terms=("offset", "gyro_bias"))
    problem = two_flights(model, seconds=3.0, channels="attitude", windows=2)
    values = truth(model)
    bracket = jaxos4.Bracket.around(values + 0.3 * model.half_width, model.half_width)
    found = jaxos4.IBSS()(problem, bracket)
    assert np.all(np.abs(found.parameters - values)[8:] < 1e-5 * model.half_width[8:])


def brake(total, values, rates, forcing):
    """Damping that grows with the square of the rate."""
    coefficients = (values[f"{axis}_brake"] for axis in ("roll", "pitch", "yaw"))
    return Rates(*(x - c * jnp.abs(rate) * rate for x, c, rate in zip(total, coefficients, rates, strict=True)))


def test_a_new_term_is_one_object(monkeypatch):
    """One `Term` in the registry is all that a vehicle needs to be simulated and estimated with it."""
    parameters = tuple(TermParameter(f"{axis}_brake", "1/rad", 2.0) for axis in ("roll", "pitch", "yaw"))
    term = Term("a moment against the square of each body rate", parameters, angular_acceleration=brake)
    monkeypatch.setitem(jaxos4.TERMS, "brake", term)
    model = jaxos4.FlightModel(terms=("brake", "offset"))
    assert model.parameter_names[8:] == (*NAMES["offset"], "roll_brake", "pitch_brake", "yaw_brake")
    values = model.alpha.at[-3:].set(jnp.array([0.5, 0.3, 0.8]))
    flight = jaxos4.simulate(model, values, standard_flight().omega[:201], dt=0.01)
    held = jaxos4.hold(model, dict(zip(model.parameter_names[:8], values, strict=False)))
    problem = jaxos4.ShootingProblem(held, flight, sigma=jaxos4.SENSOR_SIGMA, channels="rates")
    found = jaxos4.OutputError()(problem, jaxos4.Bracket.default(held))
    np.testing.assert_allclose(found.parameters[-3:], [0.5, 0.3, 0.8], atol=1e-4)
    with pytest.raises(ValueError, match="acts on the forcing"):
        Term("", (TermParameter("own_lag", "s", 0.1, each_recording=True),), speed=lambda speeds, values, grid: speeds)


def test_an_estimate_uses_the_terms_that_the_logs_allow():
    basic = ("offset", "center_of_mass", "damping", "reaction")
    rotors = ("offset", "center_of_mass", "damping", "lag", "delay", "reaction")
    assert default_terms(frozenset()) == default_terms(frozenset({FULL_SCALE})) == basic
    assert default_terms(frozenset({COMMANDS, FULL_SCALE})) == rotors == DEFAULT_TERMS
    force = frozenset({LATERAL_FORCE, VERTICAL_FORCE})
    for available, terms in (
        (force, (*basic, "flapping", "accelerometer")),
        (force | {BODY_VELOCITY, FULL_SCALE}, (*basic, "velocity", "accelerometer")),
        (frozenset({VOLTAGE}), basic),
        (frozenset({COMMANDS, VOLTAGE}), (*rotors, "voltage")),
        (force | {COMMANDS}, (*rotors, "flapping", "accelerometer")),
        (force | {COMMANDS, FULL_SCALE}, (*rotors, "flapping", "curve", "accelerometer")),
    ):
        assert set(default_terms(available)) == set(terms)
        assert list(default_terms(available)) == [name for name in jaxos4.TERMS if name in terms]
    assert all(term.description for term in jaxos4.TERMS.values())
