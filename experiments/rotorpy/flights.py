"""Flights of RotorPy's Hummingbird under RotorPy's own SE3 controller, as jaxos4 reads them.

Physics and controller are another's: rotors with a lag, drag of frame and rotors, inflow, translational lift, and a
controller that knows the true state. RotorPy has the frames of jaxos4 (x forward, y left, z up). Its `rotor_directions`
are the signs of the yaw torques, and so the opposite of `rotor_spins`.
"""

from pathlib import Path

import numpy as np
from rotorpy.controllers.quadrotor_control import SE3Control
from rotorpy.vehicles.hummingbird_params import quad_params
from rotorpy.vehicles.multirotor import Multirotor
from rotorpy.wind.default_winds import SinusoidWind
from scipy.spatial.transform import Rotation

import jaxos4
from jaxos4.flight import ANGLES, POSITION, RATES, STATE_NAMES, VELOCITY
from jaxos4.logs.csv import write_flight

DT = 0.004
GUSTS = {"calm": 0.0, "gusty": 1.5}  # [m/s]
GYRO_NOISE, FORCE_NOISE, ATTITUDE_NOISE = 0.01, 0.1, 0.002
POSITION_NOISE, VELOCITY_NOISE = 0.002, 0.02  # of motion capture
# The gusts are sums of sines with the spectrum of a first-order process with this correlation time [s].
GUST_TIME, SINES = 0.5, 12
# Frequencies [Hz] of the sines of the references, and their largest accelerations [m/s^2] and [rad/s^2].
FREQUENCIES = np.array([0.25, 0.5, 0.9, 1.5])
ACCELERATIONS = np.array([[1.0, 1.0, 1.5, 1.5], [1.0, 1.0, 1.5, 1.5], [0.5, 0.7, 1.0, 1.0]])
YAW_ACCELERATIONS = np.array([0.4, 0.8, 1.2, 1.6])
# The steps of the position along each axis [m], and the time between two of them [s].
STEPS, HOLD = np.array([0.15, 0.15, 0.1]), 1.0

VEHICLE = jaxos4.Airframe(
    mass=quad_params["mass"],
    inertia=[quad_params[name] for name in ("Ixx", "Iyy", "Izz")],
    rotor_positions=np.array(list(quad_params["rotor_pos"].values()))[:, :2],
    rotor_spins=-quad_params["rotor_directions"],
    thrust_coefficient=quad_params["k_eta"],
    drag_coefficient=quad_params["k_m"],
    rotor_inertia=0.0,
    max_rotor_speed=quad_params["rotor_speed_max"],
)


class References:
    """Positions and yaw as sums of sines, with random phases, and random steps of the position."""

    def __init__(self, duration: float, random: np.random.Generator):
        self.rate = 2 * np.pi * FREQUENCIES * random.uniform(0.9, 1.1, FREQUENCIES.size)
        self.phases = random.uniform(0, 2 * np.pi, (4, FREQUENCIES.size))
        self.sizes = np.vstack([ACCELERATIONS, YAW_ACCELERATIONS]) / self.rate**2
        self.steps = STEPS * random.uniform(-1, 1, (int(duration / HOLD) + 2, 3))

    def update(self, t: float) -> dict[str, np.ndarray | float]:
        """The flat outputs of RotorPy. The first second is still."""
        angles, begun = self.rate * t + self.phases, min(t, 1.0) ** 3
        value, change, second = (
            (self.sizes * self.rate**order * np.sin(angles + order * np.pi / 2)).sum(axis=1) for order in (0, 1, 2)
        )
        start = (self.sizes * np.sin(self.phases)).sum(axis=1)
        position = begun * (value - start)
        zero = np.zeros(3)
        return {
            "x": position[:3] + (t > 1) * self.steps[int(t / HOLD)],
            **{"x_dot": begun * change[:3], "x_ddot": begun * second[:3], "x_dddot": zero, "x_ddddot": zero},
            **{"yaw": position[3], "yaw_dot": begun * change[3], "yaw_ddot": begun * second[3]},
        }


class Gusts:
    """RotorPy's sinusoidal winds, summed: standard deviation `gust` [m/s] along each axis."""

    def __init__(self, gust: float, random: np.random.Generator):
        edges = np.geomspace(0.05, 8.0, SINES + 1)
        frequencies = np.exp(random.uniform(np.log(edges[:-1]), np.log(edges[1:]), (3, SINES)))
        share = np.diff(np.arctan(2 * np.pi * edges * GUST_TIME))
        sizes = gust * np.sqrt(2 * share / share.sum())
        phases = random.uniform(0, 1, (3, SINES)) / frequencies
        self.winds = [
            SinusoidWind(amplitudes=np.full(3, size), frequencies=frequencies[:, i], phase=phases[:, i])
            for i, size in enumerate(sizes)
        ]

    def update(self, t: float) -> np.ndarray:
        """The wind along the axes of the earth [m/s]."""
        return sum((wind.update(t, None) for wind in self.winds), np.zeros(3))


def fly(gust: float, duration: float, seed: int, i: int, *, captured: bool = False) -> jaxos4.Flight:
    """Flight `i` of a seed, with gyro, attitude, accelerometer, and the speed of each rotor, all at the same instants.

    `captured`: with position and velocity too. All other columns are the same.
    """
    random = np.random.default_rng(1000 * seed + i)
    references, gusts = References(duration, random), Gusts(gust, random)
    vehicle, controller = Multirotor(quad_params), SE3Control(quad_params)
    hover = np.full(4, float(VEHICLE.hover_speed))
    state = {"x": np.zeros(3), "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3)}
    state |= {"wind": np.zeros(3), "rotor_speeds": hover}
    rows = []
    for k in range(round(duration / DT) + 1):
        state["wind"] = gusts.update(k * DT)
        control = controller.update(k * DT, state, references.update(k * DT))
        turn, vdot = Rotation.from_quat(state["q"]), vehicle.statedot(state, control, DT)["vdot"]
        specific = turn.inv().apply(vdot + [0, 0, vehicle.g])
        angles = turn.as_euler("ZYX")[::-1]
        rows.append(np.concatenate([state["rotor_speeds"], state["w"], angles, specific, state["x"], state["v"]]))
        state = vehicle.step(state, control, DT)
    omega, rates, angles, specific, position, velocity = np.split(np.array(rows), [4, 7, 10, 13, 16], axis=1)
    states = np.full((len(omega), len(STATE_NAMES)), np.nan)
    states[:, RATES] = rates + random.normal(0, GYRO_NOISE, rates.shape)
    measured = np.unwrap(angles, axis=0) + random.normal(0, ATTITUDE_NOISE, angles.shape)
    states[:, ANGLES] = measured
    force = specific + random.normal(0, FORCE_NOISE, specific.shape)
    if captured:
        states[:, POSITION] = position + random.normal(0, POSITION_NOISE, position.shape)
        states[:, VELOCITY] = velocity + random.normal(0, VELOCITY_NOISE, velocity.shape)
    signals = {"omega": omega, "states": states, "specific_force": force}
    return jaxos4.Flight(time=DT * np.arange(len(omega)), **signals, held=False)


def recorded(folder: Path, i: int, gust: float, duration: float, seed: int, *, captured: bool = False) -> Path:
    """The file of flight `i`, which is flown only if there is none."""
    path = folder / f"gust{gust:g}_{duration:g}s_seed{seed}_{i:03}{'_captured' * captured}.csv"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        write_flight(fly(gust, duration, seed, i, captured=captured), path)
    return path
