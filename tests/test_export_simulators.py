"""Exported vehicles in MuJoCo and RotorPy: they accelerate as the model does, and fly what it predicts."""

import importlib
import json

import equinox as eqx
import jax.numpy as jnp
import msgspec
import numpy as np
import pytest
from helpers import ROOT, blocks
from scipy.spatial.transform import Rotation
from synthetic_results import AIRFRAME, VALUES, provenance, vehicle_result

import jaxos4
from jaxos4.airframe import airframe_from_table, airframe_table, alpha_from_inertia
from jaxos4.export import export_vehicle, read_result
from jaxos4.forecast.motion import departures

PAGE = ROOT / "docs" / "into_your_simulator.md"
# The simulators of the programs of the page, in their order.
PROGRAMS = ("mujoco", "mujoco", "mujoco", "rotorpy")
STATES = 1000
# Terms that make a torque or a force.
TERMS = ("offset", "center_of_mass", "damping", "velocity", "accelerometer", "inflow", "drag")
SAMPLE, SECONDS = 0.004, 2.0


@pytest.fixture
def mujoco():
    """MuJoCo, without callbacks after the test."""
    yield pytest.importorskip("mujoco", reason="pip install mujoco")
    importlib.import_module("mujoco").set_mjcb_passive(None)


def mujoco_model(found):
    """The exported model; the callback of the page acts on it."""
    import mujoco

    mujoco.set_mjcb_passive(None)
    model = mujoco.MjModel.from_xml_string(export_vehicle(found, "mujoco").text)
    exec(blocks(PAGE, "python")[2], {})  # noqa: S102
    return model


def random_states(slowest, fastest):
    """States in the paper's order, and rotor speeds."""
    generator = np.random.default_rng(1)
    scale = np.array([3, 4, 3, 4, 3, 4, 1.5, 6, 1.3, 6, 3, 4])
    return scale * generator.uniform(-1, 1, (STATES, 12)), generator.uniform(slowest, fastest, (STATES, 4))


def quaternions(states):
    """x, y, z, w of R_z(psi) R_y(theta) R_x(phi) of each state."""
    return Rotation.from_euler("ZYX", states[:, [10, 8, 6]]).as_quat()


def modelled(model, parameters, states, omega):
    """Linear acceleration along the earth's axes and angular acceleration along the body's, by the model."""
    derivative = eqx.filter_jit(eqx.filter_vmap(model.derivative, in_axes=(0, 0, None)))
    return np.asarray(derivative(jnp.asarray(states), jnp.asarray(omega), parameters))[:, [1, 3, 5, 7, 9, 11]]


def rigid_model(values, terms=TERMS, rotor_inertia=0.0):
    """The vehicle model, and its parameters by name; its alphas are those of a rigid body."""
    model = jaxos4.FlightModel(airframe_from_table(AIRFRAME | {"rotor_inertia": rotor_inertia}), terms=terms)
    inertia = np.array([values["thrust_gain"] / values[name] for name in ("alpha3", "alpha6", "alpha8")])
    given = dict(zip([f"alpha{i}" for i in range(1, 9)], alpha_from_inertia(inertia, rotor_inertia), strict=True))
    given |= values
    return model, {name: float(given.get(name, 0.0)) for name in model.parameter_names}


def vehicle_acceleration(values, states, omega, **options):
    """Of the vehicle model with all terms."""
    model, given = rigid_model(values, ("motor", *TERMS), **options)
    return modelled(model, jnp.array(list(given.values())), states, omega)


def mujoco_acceleration(found, states, omega):
    import mujoco

    model = mujoco_model(found)
    data, accelerations = mujoco.MjData(model), []
    thrusts = found.vehicle.thrust_coefficient * omega**2
    for state, quaternion, thrust in zip(states, quaternions(states), thrusts, strict=True):
        data.qpos[:] = np.append(state[[0, 2, 4]], np.roll(quaternion, 1))
        data.qvel[:] = state[[1, 3, 5, 7, 9, 11]]
        data.ctrl[:4] = thrust
        data.act[:] = thrust if model.na else []
        mujoco.mj_forward(model, data)
        accelerations.append(data.qacc.copy())
    return np.array(accelerations)


def rotorpy_vehicle(found, name="Vehicle", **options):
    pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy")
    defined = {}
    exec(export_vehicle(found, "rotorpy").text, defined)  # noqa: S102
    return defined[name](defined["quad_params"], **options)


def rotorpy_acceleration(found, states, omega, name="Vehicle"):
    vehicle, accelerations = rotorpy_vehicle(found, name), []
    for state, quaternion, speed in zip(states, quaternions(states), omega, strict=True):
        now = {"x": state[[0, 2, 4]], "v": state[[1, 3, 5]], "q": quaternion, "w": state[[7, 9, 11]]}
        now |= {"wind": np.zeros(3), "rotor_speeds": speed}
        derivative = vehicle.statedot(now, {"cmd_motor_speeds": speed}, 0.01)
        accelerations.append(np.append(derivative["vdot"], derivative["wdot"]))
    return np.array(accelerations)


SIMULATORS = {"mujoco": mujoco_acceleration, "rotorpy": rotorpy_acceleration}
every_simulator = pytest.mark.parametrize("target", SIMULATORS)


def agree(found, expected):
    """Whether each acceleration agrees to 1e-9 of the usual size of its component."""
    return bool((np.abs(found - expected) <= 1e-9 * np.sqrt(np.square(expected).mean(axis=0))).all())


@every_simulator
def test_a_vehicle_accelerates_as_the_model(target, mujoco, write):
    """With all effects that the simulator has. MuJoCo has no gyroscopic torque of the rotors."""
    states, omega = random_states(500, 2500)
    u = omega / AIRFRAME["max_rotor_speed"]
    effective = 2 * omega / (0.8 + np.sqrt(0.8**2 + 4 * (1 - 0.8) * u))  # they make the thrust
    inertia = 0.0
    values = VALUES
    if target == "rotorpy":
        # The residual speed is that of the rotors, and the curve changes it.
        effective, values, inertia = omega, VALUES | {"thrust_curve": 1.0}, 2e-8
    values = values | {"rotor_reaction": inertia * values["alpha8"] / values["thrust_gain"]}
    expected = vehicle_acceleration(values, states, omega, rotor_inertia=inertia)
    assert agree(SIMULATORS[target](read_result(write(vehicle_result(values))), states, effective), expected)
    # The comparison can fail: rotors that turn the other way, or a heavier vehicle.
    for change in ({"rotor_spins": [-1, 1, -1, 1]}, {"mass": 0.0271}):
        other = read_result(write(vehicle_result(values, airframe=AIRFRAME | change)))
        assert not agree(SIMULATORS[target](other, states, effective), expected)


def test_the_drag_of_rotorpy_alone_is_right_at_the_hover_speed(write):
    """`Multirotor(quad_params)` has no class of the file."""
    values = VALUES | {"x_drag": 0.3, "y_drag": 0.3, "thrust_curve": 1.0}
    found = read_result(write(vehicle_result(values)))
    states, _ = random_states(0, 1)
    states[:, [7, 9, 11]] = 0.0
    hover = np.full((STATES, 4), found.vehicle.hover_speed)
    simulated = rotorpy_acceleration(found, states, hover, "Multirotor")[:, :3]
    assert agree(simulated, vehicle_acceleration(values, states, hover)[:, :3])


@pytest.fixture(scope="module")
def predicted_flight(tmp_path_factory):
    """The exported vehicle, its rotor speeds, and the flight from the first sample as `jaxos4.predict` predicts it."""
    model, values = rigid_model({name: VALUES[name] for name in VALUES if not name.startswith(("rotor", "thrust_cu"))})
    level = {"strength": 0.0, "unit": "", "time_constant": 0.25, "sensor": 0.01, "correlation": 0.0}
    about = provenance(terms=list(TERMS), sample_time=SAMPLE)
    known = {"disturbances": dict.fromkeys(("p", "q", "r", "ax", "ay", "az"), level), "provenance": about, "held": {}}
    path = tmp_path_factory.mktemp("flight") / "found.json"
    path.write_text(json.dumps(vehicle_result(values, airframe=airframe_table(model.airframe), **known)))
    found = read_result(path)
    time = SAMPLE * np.arange(round(SECONDS / SAMPLE) + 250)
    steer = np.sin(2 * np.pi * time[:, None] * [1.1, 1.7, 2.3, 0.9] + [0, 1, 2, 3])
    hover = np.sqrt(found.vehicle.hover_thrust / float(model.airframe.thrust_coefficient) / VALUES["thrust_gain"])
    omega = hover * (1 + 0.02 * steer)
    states = np.zeros((time.size, 12))
    states[:, [6, 8, 10]], states[:, 1:6:2] = [0.5, 0.3, -2.0], [1.0, -2.0, 0.5]
    states[1:, 1:6:2] = np.nan  # no changes that the model would have to learn
    flight = jaxos4.Flight(time=time, omega=omega, states=states, specific_force=np.full((time.size, 3), 9.81))
    prediction = jaxos4.predict(path, flight, horizon=SECONDS, spacing=1.0)
    assert prediction.time[0] == 0
    return found, omega, np.vstack([prediction.begin[0], prediction.unaware[0]])


def flown_by_mujoco(found, omega, begin):
    import mujoco

    model = mujoco_model(found)
    model.opt.timestep, model.opt.integrator = SAMPLE / 20, mujoco.mjtIntegrator.mjINT_RK4
    data, states = mujoco.MjData(model), []
    data.qpos[:], data.qvel[:] = begin[[0, 1, 2, 6, 7, 8, 9]], begin[[3, 4, 5, 10, 11, 12]]
    for speeds in omega:
        data.ctrl[:4] = found.vehicle.thrust_coefficient * speeds**2
        mujoco.mj_step(model, data, 20)
        states.append(np.concatenate([data.qpos[:3], data.qvel[:3], data.qpos[3:], data.qvel[3:]]))
    return np.array(states)


def flown_by_rotorpy(found, omega, begin):
    vehicle = rotorpy_vehicle(found, integrator_kwargs={"method": "DOP853", "rtol": 1e-10, "atol": 1e-12})
    state = {"x": begin[:3], "v": begin[3:6], "q": np.roll(begin[6:10], -1), "w": begin[10:], "wind": np.zeros(3)}
    states = []
    for speeds in omega:
        state = vehicle.step(state | {"rotor_speeds": speeds}, {"cmd_motor_speeds": speeds}, SAMPLE)
        states.append(np.concatenate([state["x"], state["v"], np.roll(state["q"], 1), state["w"]]))
    return np.array(states)


@pytest.mark.slow
@pytest.mark.parametrize("fly", [flown_by_mujoco, flown_by_rotorpy])
def test_a_vehicle_flies_the_predicted_flight(mujoco, predicted_flight, fly):
    """For 2 s, from the same start, with the same rotor speeds."""
    found, omega, predicted = predicted_flight
    flown = fly(found, omega[: len(predicted) - 1], predicted[0])
    assert np.abs(departures(predicted[1:], flown)).max() < 1e-6
    assert np.abs(departures(predicted[:1], flown))[-1].min() > 0.05  # it flies somewhere
    own = found.identification
    heavy = eqx.tree_at(lambda a: a.mass, own.airframe, 1.001 * own.airframe.mass)
    heavier = found._replace(identification=msgspec.structs.replace(own, airframe=heavy))
    assert np.abs(departures(predicted[1:], fly(heavier, omega[: len(predicted) - 1], predicted[0]))).max() > 1e-3


@pytest.mark.parametrize(
    ("step", "delay", "error"),
    # Whole time steps are exact. Between them, the command rises during one time step.
    [(0.002, 0.01, 1e-12), (0.0002, 0.01, 1e-12), (0.002, 0.0102, 1e-5)],
)
def test_the_rotors_lag_and_those_of_mujoco_are_late(mujoco, write, step, delay, error):
    """Also in a scene with another time step, and with a delay of 5.1 time steps."""
    found = read_result(write(vehicle_result(VALUES | {"rotor_delay": delay})))
    model = mujoco.MjModel.from_xml_string(export_vehicle(found, "mujoco").text)
    data = mujoco.MjData(model)
    # The thrusts of the keyframe balance the weight and the constant torques.
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-9)
    model.opt.timestep = step
    data = mujoco.MjData(model)
    data.ctrl[:4], thrust = 0.1, []
    for _ in range(round(0.2 / step)):
        mujoco.mj_step(model, data)
        thrust.append(data.act[0])
    late = np.maximum(step * np.arange(1, len(thrust) + 1) - delay, 0.0)
    np.testing.assert_allclose(thrust, 0.1 * -np.expm1(-late / found.vehicle.lag), atol=error)
    rest = {"x": np.zeros(3), "v": np.zeros(3), "q": np.array([0, 0, 0, 1.0]), "w": np.zeros(3), "wind": np.zeros(3)}
    command = {"cmd_motor_speeds": np.full(4, 1000.0)}
    state = rotorpy_vehicle(found).step(rest | {"rotor_speeds": np.zeros(4)}, command, found.vehicle.lag)
    np.testing.assert_allclose(state["rotor_speeds"], -1000 * np.expm1(-1.0), rtol=1e-3)


@pytest.mark.parametrize(("target", "suffix"), [("mujoco", "xml"), ("rotorpy", "py")])
def test_the_programs_of_the_page_run(run, mujoco, monkeypatch, tmp_path, write, target, suffix):
    """The vehicle hovers in each simulator, and every sample of it too, by the programs that the page prints."""
    pytest.importorskip(target)
    write(vehicle_result())
    for options in (("--out", f"vehicle.{suffix}"), ("--out", "vehicles", "--samples", "3")):
        code, _, err = run("export", "found.json", "--to", target, *options)
        assert code == 0, err
    mine = [program for name, program in zip(PROGRAMS, blocks(PAGE, "python"), strict=True) if name == target]
    monkeypatch.syspath_prepend(tmp_path)
    defined = {}
    for program in mine:
        exec(program, defined)  # noqa: S102
    flown = [(defined["height"], defined["tilt"]), *(each[:2] for each in defined.get("drawn", []))]
    assert len(flown) == {"mujoco": 4, "rotorpy": 1}[target]
    assert all(abs(height - 1) < 0.05 and tilt < 0.05 for height, tilt in flown)
    if target == "mujoco":  # one controller turns three vehicles at three rates
        assert defined["hovering"] == len(set(defined["peaks"])) == 3
        assert defined["peaks"] == pytest.approx([defined["expected"].max()] * 3, rel=0.1)
