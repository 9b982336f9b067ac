"""`mujoco.sysid`: least squares on rollouts of a MuJoCo model over windows of the flight.

The model is a free body with four rotors whose actuators lag, and actuators for the torque of rotors that accelerate
and for a torque offset and a damping of each axis. Hooks of `mujoco.sysid` make it as good as we could:
`custom_rollout` shifts the commands by the free delay and begins each window with the rotors' state; `modify_residual`
weighs each sensor by its noise, and removes the mean error of the body rates in each window, which is the error of the
initial rates. Weights are those of the sensors' noise in the first pass, of the residuals in the second.
"""

import contextlib
import copy
import io
import logging
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import sysid

import jaxos4
from experiments.peers.log import Fit, Log, followed

SETTINGS = tuple({"window": window} for window in (0.1, 0.2, 0.5, 1.0, 2.0))
SEARCH = {"max_iters": 40, "xtol": 1e-5}
STARTED = 3  # samples on both sides whose mean rates begin a window
TIME = 0.05  # s
# Value, lowest and highest of the parameters. Inertias, thrust and the rotors' inertia: over those given.
PARAMETERS = {
    **{name: (1.0, 0.1, 10.0) for name in ("Ix", "Iy", "Iz", "thrust")},
    "rotor": (1.0, -10.0, 10.0),
    "lag": (0.8, 0.02, 6.0),  # over `TIME`
    "delay": (0.1, -0.2, 1.0),  # over `TIME`
    **{f"offset_{axis}": (0.0, -100.0, 100.0) for axis in "xyz"},  # rad/s^2
    **{f"damping_{axis}": (0.0, -100.0, 100.0) for axis in "xyz"},  # 1/s
}


def vehicle(airframe: jaxos4.Airframe, dt: float, lag: float) -> mujoco.MjSpec:
    """The model of an airframe. Controls: thrusts [N], a torque about z and the factors of offset and damping."""
    ratio = float(airframe.drag_coefficient / airframe.thrust_coefficient)
    dynamics = f'dyntype="filterexact" dynprm="{lag}"' if lag else ""
    sites, rotors = "", ""
    places, spins = (np.asarray(x).tolist() for x in (airframe.rotor_positions, airframe.rotor_spins))
    for i, ((x, y), spin) in enumerate(zip(places, spins, strict=True)):
        sites += f'<site name="rotor{i}" pos="{x} {y} 0"/>'
        rotors += f'<general name="thrust{i}" site="rotor{i}" gear="0 0 1 0 0 {-spin * ratio}" {dynamics}/>'
    for name, gear in (("reaction", "0 0 1"), ("air_x", "1 0 0"), ("air_y", "0 1 0"), ("air_z", "0 0 1")):
        rotors += f'<general name="{name}" site="center" gear="0 0 0 {gear}" biastype="affine"/>'
    inertia = " ".join(map(str, np.asarray(airframe.inertia).tolist()))
    return mujoco.MjSpec.from_string(f"""<mujoco><option timestep="{dt}"/><worldbody>
      <body name="vehicle"><freejoint name="free"/><site name="center"/>{sites}
      <inertial pos="0 0 0" mass="{float(airframe.mass)}" diaginertia="{inertia}"/></body></worldbody>
      <actuator>{rotors}</actuator>
      <sensor><gyro name="gyro" site="center"/><accelerometer name="force" site="center"/></sensor></mujoco>""")


def with_parameters(base: mujoco.MjModel, values: dict[str, float]) -> mujoco.MjModel:
    """The model with these values of `PARAMETERS`."""
    model, given = copy.copy(base), base.body_inertia[1]
    model.body_inertia[1] = given * [values[name] for name in ("Ix", "Iy", "Iz")]
    model.actuator_gainprm[:5, 0] = [*[values["thrust"]] * 4, values["rotor"]]
    model.actuator_dynprm[:4, 0] = TIME * values["lag"]
    model.actuator_biasprm[5:, 0] = given * [values[f"offset_{axis}"] for axis in "xyz"]
    model.actuator_biasprm[5:, 2] = -given * [values[f"damping_{axis}"] for axis in "xyz"]
    mujoco.mj_setConst(model, mujoco.MjData(model))  # the mass matrix of a free body is such a constant
    return model


def _controls(log: Log, lag: float, delay: float) -> tuple[np.ndarray, np.ndarray]:
    """Controls, and the activations of the rotors, at all samples."""
    speeds = log.speeds(lag, delay)
    change = np.diff(speeds, axis=0, append=speeds[-1:]) / log.dt @ np.asarray(log.airframe.rotor_spins)
    reaction = -float(log.airframe.rotor_inertia) * change[:, None]
    if log.commands:
        thrust = log.thrust_scale * log.delayed(delay) ** 2
        active = followed(thrust, lag, log.dt)
    else:
        later = np.concatenate([speeds[1:], speeds[-1:]])
        thrust = log.thrust_scale * (speeds**2 + speeds * later + later**2) / 3
        active = np.zeros((len(thrust), 0))
    return np.hstack([thrust, reaction, np.zeros((len(thrust), 3))]), active


def fit(log: Log, window: float) -> Fit:
    """Moments of inertia by windows of this length [s]."""
    steps, spec = round(window / log.dt), vehicle(log.airframe, log.dt, 0.04 * log.commands)
    begins, base = range(0, len(log.omega) - steps, steps), spec.compile()
    params = sysid.ParameterDict()
    for name, (value, low, high) in PARAMETERS.items():
        unknown = {"lag": log.commands, "rotor": bool(log.airframe.rotor_inertia)}.get(name, True)
        params.add(sysid.Parameter(name, value, low, high, frozen=not unknown))
    times = log.dt * np.arange(steps + 1)
    data = np.zeros((len(log.omega), 6))
    data[:, [0, 1, 2, 5]] = np.column_stack([log.rates, log.force])
    spread = np.ones(2 * STARTED + 1) / (2 * STARTED + 1)
    padded = np.pad(log.rates, ((STARTED, STARTED), (0, 0)), mode="edge")
    rates = np.column_stack([np.convolve(column, spread, mode="valid") for column in padded.T])

    def values(parameters: sysid.ParameterDict) -> dict[str, float]:
        return {name: float(one.value[0]) for name, one in parameters.items()}

    level = sysid.create_initial_state(base, np.array([0, 0, 0, 1.0, 0, 0, 0]))

    def states(active: np.ndarray) -> list[np.ndarray]:
        return [np.concatenate([level[: 1 + 7 + 3], rates[b], active[b]]) for b in begins]

    def rollout(models, datas, control_signal, initial_states, param_dicts, **mappings) -> Sequence:
        controls, begun = [], []
        for one in param_dicts:
            control, active = _controls(log, *(TIME * values(one)[name] for name in ("lag", "delay")))
            controls += [sysid.TimeSeries(times, control[b : b + steps + 1]) for b in begins]
            begun += states(active)
        return sysid.sysid_rollout(models, datas, controls, begun, **mappings)

    weights = log.noise

    def residual(parameters, predicted, measured, model, return_pred_all, **_):
        # MuJoCo's sensors are those before a step, although their time is that after it.
        left = (measured.data[1:-1] - predicted.data[1:])[:, [0, 1, 2, 5]]
        left[:, :3] -= left[:, :3].mean(axis=0)
        return left / weights, measured, measured  # maps of sensors with three axes are equal only if they are one

    measured = [sysid.TimeSeries.from_names(times, data[b : b + steps + 1], base) for b in begins]
    idle = [sysid.TimeSeries(times, np.zeros((steps + 1, base.nu)))] * len(begins)
    start = states(_controls(log, 0.04, 0.0)[1])
    sequences = sysid.ModelSequences("vehicle", spec, ["flight"] * len(begins), start, idle, measured)

    def residuals(x: np.ndarray, parameters: sysid.ParameterDict):
        found, *others = sysid.model_residual(
            *(x, parameters, lambda one: with_parameters(base, values(one)), sequences.measured_rollout),
            **{"modify_residual": residual, "custom_rollout": rollout, "n_threads": 1, "resample_true": False},
        )
        columns = x.shape[1] if x.ndim > 1 else 1  # of all windows of one after those of another
        found = found.T.reshape(columns, -1).T
        return [found if x.ndim > 1 else found[:, 0]], *others

    heard = _Heard()
    with contextlib.redirect_stdout(io.StringIO()), heard:
        for last in (False, True):
            params, result = sysid.optimize(params, residuals, verbose=False, check_conditioning=last, **SEARCH)
            left = residuals(result.x, params)[0]
            if not last:
                weights = weights * np.sqrt(np.mean(np.square(left[0].reshape(-1, 4)), axis=0))
    intervals = sysid.calculate_intervals(left, result.jac)[1] / 1.96
    low, high = params.get_bounds()
    stuck = (result.x - low < 1e-3 * (high - low)) | (high - result.x < 1e-3 * (high - low))
    heard.warnings += ["a parameter is at its limit"] * bool(stuck.any())
    given = np.asarray(log.airframe.inertia)
    return Fit(given * result.x[:3], given * intervals[:3], heard.warnings)


class _Heard(logging.Handler, contextlib.AbstractContextManager):
    """Keeps what `mujoco.sysid` warns of."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.warnings: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        """Keeps a warning."""
        self.warnings.append(record.getMessage())

    def __enter__(self) -> "_Heard":
        logging.getLogger("absl").addHandler(self)
        return self

    def __exit__(self, *error: object) -> None:
        logging.getLogger("absl").removeHandler(self)
