"""The equations of `FlightModel` a second time, and a vehicle with all terms.

The reference is plain NumPy in continuous time: held commands, and rotors and body integrated together in small steps.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxos4

FULL = eqx.tree_at(lambda a: a.max_rotor_speed, jaxos4.OS4, np.asarray(500.0))
VOLTS = 11.1
# Forces along x and y have a bias only if there is a drag.
NAMES = {name: [p.name for p in term.parameters if p.force_axis not in (0, 1)] for name, term in jaxos4.TERMS.items()}
NAMES_XY = ("ax_bias", "ay_bias")
# A vehicle with all terms; its delay is a whole number of samples of the steps below.
VALUES = {
    **{"roll_offset": 0.3, "pitch_offset": -0.2, "yaw_offset": 0.1, "roll_thrust": -0.5, "pitch_thrust": 0.9},
    **{"roll_damping": 1.5, "pitch_damping": 0.8, "yaw_damping": 0.4, "roll_velocity": 0.3, "pitch_velocity": -0.4},
    **{"voltage_exponent": 0.7, "battery_fade": 0.02},
    **{"rotor_lag": 0.06, "rotor_delay": 0.02, "rotor_reaction": 0.02, "thrust_curve": 0.97, "motor_braking": 0.3},
    **{"battery_sag": 0.05},
    **{"thrust_gain": 1.2, "x_drag": 0.4, "y_drag": 0.3, "z_drag": 0.6, "ax_bias": 0.5, "ay_bias": -0.4},
    **{"az_bias": 0.2, "p_bias": 0.03, "q_bias": -0.02, "r_bias": 0.01},
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


# Of the airframe, once: each conversion costs more than all equations.
ALPHA = np.asarray(jaxos4.CorrectedOS4(FULL).alpha).tolist()
CONSTANTS = [float(getattr(FULL, n)) for n in ("thrust_coefficient", "drag_coefficient", "mass", "gravity")]
PLACES, SPINS = np.asarray(FULL.rotor_positions).T, np.asarray(FULL.rotor_spins)


def accelerations(state, speeds, change, v):
    """The derivative of the state, and what an accelerometer measures, by the values `v` of all parameters."""
    (p, q, r, phi, theta, psi), (a1, a2, a3, a4, a5, a6, a7, a8), (b, d, m, g) = state[:6], ALPHA, CONSTANTS
    (x, y), spin = PLACES, SPINS
    # The centre of mass (x_c, y_c): its torque in hover belongs to the offset.
    x_c, y_c = v["pitch_thrust"] / (a6 * m), -v["roll_thrust"] / (a3 * m)
    force = b * speeds**2
    cx, sx, cy, sy, cz, sz = (f(angle) for angle in (phi, theta, psi) for f in (np.cos, np.sin))
    turn = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ [[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]
    turn = turn @ [[1, 0, 0], [0, cx, -sx], [0, sx, cx]]
    vx, vy, vz = turn.T @ state[[7, 9, 11]]
    specific = np.array([-v["x_drag"] * vx, -v["y_drag"] * vy, v["thrust_gain"] * force.sum() / m - v["z_drag"] * vz])
    rates_dot = [
        a1 * q * r - a2 * (spin @ speeds) * q + a3 * (y @ force) + v["roll_offset"] - v["roll_damping"] * p
        + v["roll_velocity"] * vy - a3 * y_c * (force.sum() - 9.81 * m),
        a4 * p * r + a5 * (spin @ speeds) * p - a6 * (x @ force) + v["pitch_offset"] - v["pitch_damping"] * q
        + v["pitch_velocity"] * vx + a6 * x_c * (force.sum() - 9.81 * m),
        a7 * p * q - a8 * d / b * (spin @ force) + v["yaw_offset"] - v["yaw_damping"] * r
        - v["rotor_reaction"] * (spin @ change),
    ]  # fmt: skip
    turning = [p + np.tan(theta) * (q * sx + r * cx), q * cx - r * sx, (q * sx + r * cx) / cy]
    ax, ay, az = turn @ specific - [0, 0, g]
    biased = specific + [v["ax_bias"], v["ay_bias"], v["az_bias"]]
    return np.array([*rates_dot, *turning, state[7], ax, state[9], ay, state[11], az]), biased


def reference(terms, omega, dt, *, fine):
    """The states in cascade order and the specific force, on the samples: the class's equations, with Runge-Kutta."""
    v = {name: VALUES[name] if name in sum((NAMES[t] for t in terms), []) else 0.0 for name in VALUES}
    v["thrust_gain"] = VALUES["thrust_gain"] if "accelerometer" in terms else 1.0
    v["ax_bias"], v["ay_bias"] = ((VALUES[n] if {"accelerometer", "drag"} <= set(terms) else 0.0) for n in NAMES_XY)
    curve, full = VALUES["thrust_curve"] if "motor" in terms else 1.0, float(FULL.max_rotor_speed)
    omega = omega * ((battery(omega.shape[0], dt) / VOLTS) ** v["voltage_exponent"])[:, None]
    omega = omega * (1 - v["battery_fade"] * dt * np.arange(omega.shape[0]))[:, None]

    def whole(z, u):
        if not {"lag", "motor"} & set(terms):
            speeds, change = u, np.zeros(4)
        else:
            speeds = z[12:]
            u = u * (1 - v["battery_sag"] * (np.mean((speeds / float(FULL.hover_speed)) ** 3) - 1))
            drive = u - curve * speeds
            if "motor" in terms:
                brake, smooth = v["motor_braking"], 0.005 * full
                weak = brake * drive - (1 - brake) * smooth * (1 - np.exp(np.minimum(drive, 0) / smooth))
                drive = np.where(drive < 0, weak, drive)
            change = (drive - (1 - curve) * speeds**2 / full) / v["rotor_lag"]
        dz, force = accelerations(z[:12], speeds, change, v)
        return np.concatenate([dz, change]), force

    late = round(v["rotor_delay"] / dt)
    settled = 2 * omega[0] / (curve + np.sqrt(curve**2 + 4 * (1 - curve) * omega[0] / full))
    z = np.concatenate([np.zeros(12), settled])
    states, forces, h = [], [], dt / fine
    for k in range(omega.shape[0]):
        u = omega[max(k - late, 0)]
        states.append(z[:12])
        # The accelerometer measures the mean over a sample around this time.
        before = omega[max(k - 1 - late, 0)]
        forces.append((whole(z, u)[1] + whole(z, before)[1]) / 2)
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
