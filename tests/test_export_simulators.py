"""Exported vehicles in MuJoCo and RotorPy: they accelerate as the model does."""

import json
import pathlib
import re

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from synthetic_results import AIRFRAME, VALUES, vehicle_result

import jaxos4
from jaxos4.airframe import airframe_from_table, alpha_from_inertia
from jaxos4.export import export_vehicle, read_result

PAGE = pathlib.Path(__file__).resolve().parents[1] / "docs" / "into_your_simulator.md"
# The simulators of the programs of the page, in their order.
PROGRAMS = ("mujoco", "mujoco", "rotorpy")
STATES = 1000
# Terms that make a torque or a force.
TERMS = ("offset", "center_of_mass", "damping", "motor", "accelerometer", "drag")
# RotorPy has neither.
NOT_ROTORPY = ("roll_offset", "pitch_offset", "yaw_offset", "roll_damping", "pitch_damping", "yaw_damping")
DRAG = ("x_drag", "y_drag")


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco", reason="pip install mujoco")


def read(tmp_path, result):
    path = tmp_path / "found.json"
    path.write_text(json.dumps(result), encoding="utf-8")
    return read_result(path)


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


def vehicle_acceleration(values, states, omega):
    """Of the vehicle model with all terms, its alphas those of a rigid body without inertia of the rotors."""
    airframe = airframe_from_table(AIRFRAME)
    model = jaxos4.FlightModel(airframe, terms=TERMS)
    inertia = [values["thrust_gain"] / values[name] for name in ("alpha3", "alpha6", "alpha8")]
    rigid = dict(zip([f"alpha{i}" for i in range(1, 9)], alpha_from_inertia(np.array(inertia), 0.0), strict=True))
    given = rigid | values
    return modelled(model, jnp.array([given.get(name, 0.0) for name in model.parameter_names]), states, omega)


def mujoco_acceleration(found, states, omega):
    mujoco = pytest.importorskip("mujoco", reason="pip install mujoco")
    model = mujoco.MjModel.from_xml_string(export_vehicle(found, "mujoco").text)
    data, accelerations = mujoco.MjData(model), []
    thrusts = found.vehicle.thrust_coefficient * omega**2
    for state, quaternion, thrust in zip(states, quaternions(states), thrusts, strict=True):
        data.qpos[:] = np.append(state[[0, 2, 4]], np.roll(quaternion, 1))
        data.qvel[:] = state[[1, 3, 5, 7, 9, 11]]
        data.ctrl[:4] = thrust
        if model.na:
            data.act[:] = thrust
        mujoco.mj_forward(model, data)
        accelerations.append(data.qacc.copy())
    return np.array(accelerations)


def rotorpy_vehicle(found):
    multirotor = pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy").Multirotor
    defined = {}
    exec(export_vehicle(found, "rotorpy").text, defined)  # noqa: S102
    return multirotor(defined["quad_params"])


def rotorpy_acceleration(found, states, omega):
    vehicle, accelerations = rotorpy_vehicle(found), []
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
def test_a_vehicle_accelerates_as_the_model(target, tmp_path):
    """With all effects that the simulator has: RotorPy has no offsets, no damping and, except in hover, no drag."""
    values = VALUES
    if target == "rotorpy":
        # An offset that cancels the constant part of the torque of the centre of mass.
        values = VALUES | dict.fromkeys((*NOT_ROTORPY, *DRAG), 0.0)
        values |= {f"{axis}_offset": 9.81 * VALUES[f"{axis}_thrust"] for axis in ("roll", "pitch")}
    states, omega = random_states(500, 2500)
    curve = values["thrust_curve"]
    u = omega / AIRFRAME["max_rotor_speed"]
    effective = 2 * omega / (curve + np.sqrt(curve**2 + 4 * (1 - curve) * u))  # they make the thrust
    expected = vehicle_acceleration(values, states, omega)
    assert agree(SIMULATORS[target](read(tmp_path, vehicle_result(values)), states, effective), expected)
    # The comparison can fail: rotors that turn the other way, or a heavier vehicle.
    for change in ({"rotor_spins": [-1, 1, -1, 1]}, {"mass": 0.0271}):
        other = read(tmp_path, vehicle_result(values, airframe=AIRFRAME | change))
        assert not agree(SIMULATORS[target](other, states, effective), expected)


def test_the_drag_of_rotorpy_is_right_at_the_hover_speed(tmp_path):
    values = VALUES | dict.fromkeys(NOT_ROTORPY, 0.0) | {"x_drag": 0.3, "y_drag": 0.3, "thrust_curve": 1.0}
    found = read(tmp_path, vehicle_result(values))
    states, _ = random_states(0, 1)
    states[:, [7, 9, 11]] = 0.0
    hover = np.full((STATES, 4), found.vehicle.hover_speed)
    simulated = rotorpy_acceleration(found, states, hover)[:, :3]
    assert agree(simulated, vehicle_acceleration(values, states, hover)[:, :3])


@pytest.mark.parametrize(
    ("step", "delay", "error"),
    # Whole time steps are exact. Between them, the command rises during one time step.
    [(0.002, 0.01, 1e-12), (0.0005, 0.01, 1e-12), (0.0002, 0.01, 1e-12), (0.002, 0.0102, 1e-5)],
)
def test_the_rotors_of_mujoco_lag_and_are_late(mujoco, tmp_path, step, delay, error):
    """Also in a scene with another time step, and with a delay of 5.1 time steps."""
    found = read(tmp_path, vehicle_result(VALUES | {"rotor_delay": delay}))
    model = mujoco.MjModel.from_xml_string(export_vehicle(found, "mujoco").text)
    model.opt.timestep = step
    data = mujoco.MjData(model)
    data.ctrl[:4] = 0.1
    thrust = []
    for _ in range(round(0.2 / step)):
        mujoco.mj_step(model, data)
        thrust.append(data.act[0])
    late = np.maximum(step * np.arange(1, len(thrust) + 1) - delay, 0.0)
    np.testing.assert_allclose(thrust, 0.1 * -np.expm1(-late / found.vehicle.lag), atol=error)


def test_the_rotors_of_rotorpy_lag(tmp_path):
    found = read(tmp_path, vehicle_result())
    vehicle = rotorpy_vehicle(found)
    rest = {"x": np.zeros(3), "v": np.zeros(3), "q": np.array([0, 0, 0, 1.0]), "w": np.zeros(3), "wind": np.zeros(3)}
    state = vehicle.step(
        rest | {"rotor_speeds": np.zeros(4)}, {"cmd_motor_speeds": np.full(4, 1000.0)}, found.vehicle.lag
    )
    np.testing.assert_allclose(state["rotor_speeds"], -1000 * np.expm1(-1.0), rtol=1e-3)


def test_the_vehicle_rests_in_the_hover_of_mujoco(mujoco, tmp_path):
    """The thrusts of the keyframe balance the weight and the constant torques."""
    model = mujoco.MjModel.from_xml_string(export_vehicle(read(tmp_path, vehicle_result()), "mujoco").text)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, 0, atol=1e-9)


@pytest.mark.parametrize(("target", "suffix"), [("mujoco", "xml"), ("rotorpy", "py")])
def test_the_programs_of_the_page_run(run, monkeypatch, tmp_path, target, suffix):
    """The vehicle hovers in each simulator, and every sample of it too, by the programs that the page prints."""
    pytest.importorskip(target)
    read(tmp_path, vehicle_result())
    code, _, err = run("export", "found.json", "--to", target, "--out", f"vehicle.{suffix}", "--samples", "3")
    assert code == 0, err
    programs = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    mine = [program for name, program in zip(PROGRAMS, programs, strict=True) if name == target]
    monkeypatch.syspath_prepend(tmp_path)
    defined = {}
    for program in mine:
        exec(program, defined)  # noqa: S102
    flown = [(defined["height"], defined["tilt"]), *defined.get("drawn", [])]
    assert len(flown) == {"mujoco": 4, "rotorpy": 1}[target]
    assert all(abs(height - 1) < 0.05 and tilt < 0.05 for height, tilt in flown)
