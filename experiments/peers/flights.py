"""The flights of all tools: simulated by jaxos4, MuJoCo and RotorPy, and real ones."""

import functools
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

import jaxos4
from experiments.closed_loop.effects import VEHICLE as CRAZYFLIE, turned_over
from experiments.real_flights import ARPL, AUTHORS, CRAZYFLIE as NANOBENCH, PENDULUM
from experiments.sample_times.run import VEHICLE as CINERAT
from experiments.shared import flight_files
from jaxos4.flight import ANGLES, RATES
from jaxos4.recording import Recording, read_recording
from jaxos4.rotations import euler_angles

GUSTS, DT = (0.0, 2.0, 5.0), 0.004  # [rad/s^2], [s]
VEHICLES = {  # with what is logged
    "Crazyflie": (CRAZYFLIE, "commands"),
    "CineRat": (CINERAT, "speeds"),
    "x500": (jaxos4.load_airframe("x500"), "commands"),
}
SUBSTEPS = 4  # of MuJoCo, in a period of the controller
PART = (10.0, 30.0)  # s
REAL = {  # file, airframe, part of the flight, what is logged, reference [kg m^2]
    "CineRat": ("cinerat/cinerat_281.csv", CINERAT, PART, "speeds", PENDULUM),
    "Crazyflie, ARPL": ("arpl_crazyflie_rollpitch.csv", ARPL, PART, "commands", AUTHORS),
    **{f"NanoBench {i}": (f"nanobench/B3_figure8_fast_rep{i}.csv", NANOBENCH, None, "commands", {}) for i in (1, 2)},
}


class Case(NamedTuple):
    """Flights of one kind, by their numbers; `None`: the vehicle turned over."""

    vehicle: jaxos4.Airframe
    commands: bool
    calm: bool
    fly: Callable[[int, float], jaxos4.Flight | None]


def closed_loop(loop: jaxos4.ClosedLoop, seed: int, duration: float) -> jaxos4.Flight | None:
    """A flight of `jaxos4 simulate --closed-loop`."""
    flight = jaxos4.closed_loop.fly_standard(loop, duration=duration, dt=DT, seed=seed)
    return None if turned_over(flight) else flight


def in_mujoco(loop: jaxos4.ClosedLoop, seed: int, duration: float) -> jaxos4.Flight:
    """The flight of MuJoCo's physics with gusts, noise and controller of `loop`, which answers the logged rates."""
    import mujoco

    from experiments.peers.mujoco_sysid import vehicle as model_of

    vehicle, random = loop.airframe, np.random.default_rng(seed)
    lag, delay, gust_time = float(loop.rotor_lag), float(loop.rotor_delay), float(loop.gust_time)
    gust = np.broadcast_to(loop.gust, 3)
    references = np.asarray(jaxos4.random_references(duration=duration, dt=DT, key=jax.random.key(seed)))
    gains = [np.asarray(gain) for gain in (loop.attitude_gain, loop.rate_gain, loop.integral_gain)]
    mixer, spins, inertia = (np.asarray(x) for x in (vehicle.mixer, vehicle.rotor_spins, vehicle.inertia))
    h, mass, scale = DT / SUBSTEPS, float(vehicle.mass), float(vehicle.thrust_coefficient)
    model = model_of(vehicle, h, lag).compile()
    model.actuator_gainprm[:, 0] = 1
    data, allocation, top = mujoco.MjData(model), np.linalg.inv(mixer), float(vehicle.max_rotor_speed)
    data.act[:] = scale * vehicle.hover_squares
    kept, integral, blown, commands, rows = np.exp(-h / gust_time), np.zeros(3), gust * random.normal(size=3), [], []
    for k, reference in enumerate(references):
        mujoco.mj_forward(model, data)
        attitude = euler_angles(data.qpos[3:7]) + float(loop.attitude_noise) * random.normal(size=3)
        gyro = data.sensordata[:3] + float(loop.gyro_noise) * random.normal(size=3)
        force = data.sensordata[3:] + float(loop.force_noise) * random.normal(size=3)
        error = gains[0] * (reference[:3] - attitude) - gyro
        demand, integral = gains[1] * error + integral, integral + DT * gains[2] * error
        upright = max(np.cos(attitude[0]) * np.cos(attitude[1]), loop.steepest)
        wanted = allocation @ [*(inertia * demand), mass * (reference[3] + float(vehicle.gravity)) / upright]
        commands.append(np.sqrt(np.clip(wanted, 0, top**2)))
        rows.append((commands[-1], gyro, attitude, force))
        for j in range(SUBSTEPS):
            late = int(np.floor((k * DT + j * h - delay) / DT + 1e-9))
            thrust = scale * commands[max(late, 0)] ** 2
            change = (thrust - data.act) / lag / (2 * np.sqrt(scale * np.maximum(data.act, 1e-9)))
            data.ctrl[:] = [*thrust, -float(vehicle.rotor_inertia) * spins @ change, *(inertia * blown)]
            blown = kept * blown + gust * np.sqrt(1 - kept**2) * random.normal(size=3)
            mujoco.mj_step(model, data)
    omega, gyro, attitude, force = (np.array(column) for column in zip(*rows, strict=True))
    states = np.full((len(omega), len(jaxos4.STATE_NAMES)), np.nan)
    states[:, RATES], states[:, ANGLES] = gyro, attitude
    held = {"commanded": True, "held": True}
    return jaxos4.Flight(time=DT * np.arange(len(omega)), omega=omega, states=states, specific_force=force, **held)


def in_rotorpy(gust: float, seed: int, duration: float) -> jaxos4.Flight:
    """A flight of RotorPy's physics and controller."""
    from experiments.rotorpy import flights

    return flights.fly(gust, duration, seed, 0)


def cases() -> dict[str, Case]:
    """The simulated flights, by their names."""
    found = {}
    for name, (vehicle, logged) in VEHICLES.items():
        for gust in GUSTS:
            loop = jaxos4.ClosedLoop(vehicle, gust=gust, logged=logged)
            fly = functools.partial(closed_loop, loop)
            found[f"{name}, {gust:g}"] = Case(vehicle, logged == "commands", not gust, fly)
    for gust in GUSTS[:2]:
        fly = functools.partial(in_mujoco, jaxos4.ClosedLoop(CRAZYFLIE, gust=gust))
        found[f"MuJoCo, {gust:g}"] = Case(CRAZYFLIE, True, not gust, fly)
    from experiments.rotorpy.flights import GUSTS as WINDS, VEHICLE as HUMMINGBIRD

    for name, wind in WINDS.items():
        found[f"RotorPy, {name}"] = Case(HUMMINGBIRD, False, not wind, functools.partial(in_rotorpy, wind))
    return found


def real(folder: Path | None, name: str) -> Recording:
    """A part of a real flight."""
    file, airframe, part, *_ = REAL[name]
    (path,) = flight_files(folder, [file])
    recording = read_recording(path, airframe=airframe)._replace(name=name)
    begin, end = part or (-np.inf, np.inf)
    rows = np.flatnonzero((recording.time >= begin) & (recording.time <= end))
    return recording.rows(slice(rows[0], rows[-1] + 1))
