"""The equations of `FlightModel` a second time, and a vehicle with all terms."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

import jaxos4

FULL = eqx.tree_at(lambda a: a.max_rotor_speed, jaxos4.OS4, np.asarray(500.0))
VOLTS = 11.1
# A vehicle with all terms; its delay is a whole number of samples of the steps below.
VALUES = {
    **{"roll_offset": 0.3, "pitch_offset": -0.2, "yaw_offset": 0.1, "roll_thrust": -0.5, "pitch_thrust": 0.9},
    **{"roll_damping": 1.5, "pitch_damping": 0.8, "yaw_damping": 0.4, "roll_velocity": 0.3, "pitch_velocity": -0.4},
    **{"voltage_exponent": 0.7, "battery_fade": 0.02},
    **{"rotor_lag": 0.06, "rotor_delay": 0.02, "rotor_reaction": 0.02, "thrust_curve": 0.97, "motor_braking": 0.3},
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
