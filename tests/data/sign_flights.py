"""Flights whose signs and orders of rotors are known."""

import equinox as eqx
import numpy as np

from jaxos4.recording import Recording

DT = 0.004


def flown(airframe, seed, *, gust=20.0, reference=2.0, lag=0.04, seconds=15.0, name="a.bbl"):
    """Rates of a vehicle under a rate controller with damping, references and gusts; the rotors lag their commands."""
    rng, samples = np.random.default_rng(seed), round(seconds / DT)
    inertia, mixer = np.asarray(airframe.inertia, dtype=float), np.asarray(airframe.mixer, dtype=float)
    hover, inverse = np.full(4, float(airframe.hover_speed) ** 2), np.linalg.inv(mixer)
    noise = rng.normal(0, 0.01, (samples, 3))
    wanted = np.repeat(reference * rng.normal(size=(-(-samples // 60), 3)), 60, axis=0)
    push = gust * np.sqrt(2 * DT / 0.25) * np.array([1, 1, 0.2]) * rng.normal(size=(samples, 3))
    rate, last, disturbance, real = np.zeros(3), np.zeros(3), np.zeros(3), hover.copy()
    squared, rates = np.empty((samples, 4)), np.empty((samples, 3))
    gain = np.array([15.0, 15.0, 6.0])
    for k in range(samples):
        measured = rate + noise[k]
        torque = inertia * gain * (wanted[k] - measured - 0.01 / DT * (measured - last))
        command = np.minimum(np.maximum(hover + inverse[:, :3] @ torque, 0.1 * hover), 3 * hover)
        squared[k], rates[k], last = command, measured, measured
        real = real + DT / lag * (command - real)
        disturbance = disturbance - DT / 0.25 * disturbance + push[k]
        rate = rate + DT * ((mixer @ real)[:3] / inertia + disturbance)
    states = np.full((samples, 12), np.nan)
    states[:, [7, 9, 11]] = rates
    return Recording(DT * np.arange(samples), np.sqrt(squared), states, commanded=True, name=name)


def turned(airframe, what):
    return eqx.tree_at(lambda a: getattr(a, what), airframe, -np.asarray(getattr(airframe, what)))
