"""The standard references for a controller: multisine, doublet, 3-2-1-1 and chirp.

References are roll, pitch and yaw angle [rad] and vertical acceleration [m/s^2] in each sample, as `fly_closed_loop`
takes them.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float

from ..excitation import DOUBLET, STANDARD_TONES, TAPER

# Pulses of a reference last about 0.3 periods of the controlled vehicle's attitude [s].
WIDTH = 0.3
# Each pulse of a reference is as high as the others, unlike those of torque in `excitation`.
STEP_3211 = (1.0, 1.0, 1.0, -1.0, -1.0, 1.0, -1.0)
_VERTICAL_TONES = (0.4, 0.8, 1.2)
_FREQUENCIES = (0.2, 3.0)

Shape = Float[np.ndarray, "samples 4"]


def _tones(samples: int, dt: float) -> Shape:
    """All references at once."""
    time = dt * np.arange(samples)[:, None]
    tones = [np.sin(2 * math.pi * time * np.asarray(some)).sum(axis=1) for some in (*STANDARD_TONES, _VERTICAL_TONES)]
    return np.stack(tones, axis=1)


def pulses(heights: Sequence[float], width: float, samples: int, dt: float) -> Shape:
    """Pulses of a `width` [s] in one reference after another, each time with the other sign, as often as they fit."""
    once = np.repeat([*heights, 0.0], max(round(width / dt), 1))
    return _in_turn([once, -once], samples)


def _sweeps(samples: int, dt: float) -> Shape:
    """A linear sweep of frequencies in one reference after another."""
    share = np.linspace(0, 1, samples // 4)
    first, last = _FREQUENCIES
    phase = 2 * math.pi * share.size * dt * (first * share + (last - first) * share**2 / 2)
    fade = np.sin(math.pi / 2 * np.clip(np.minimum(share, 1 - share) / TAPER, 0, 1)) ** 2
    return _in_turn([fade * np.sin(phase)], samples)


def _in_turn(shapes: Sequence[np.ndarray], samples: int) -> Shape:
    found, length = np.zeros((samples, 4)), len(shapes[0])
    for slot in range(samples // length):
        found[slot * length : (slot + 1) * length, slot % 4] = shapes[slot // 4 % len(shapes)]
    return found


_STANDARD: dict[str, Callable[[int, float], Shape]] = {
    "multisine": _tones,
    "doublet": lambda samples, dt: pulses(DOUBLET, WIDTH, samples, dt),
    "3211": lambda samples, dt: pulses(STEP_3211, WIDTH, samples, dt),
    "chirp": _sweeps,
}


def standard_references(samples: int, dt: float, largest: Float[np.ndarray, "4"]) -> dict[str, Shape]:
    """The standard references, each with these `largest` values; 0 if a shape does not fit into the time."""
    shapes = {name: make(samples, dt) for name, make in _STANDARD.items()}
    return {name: largest * shape / np.maximum(np.abs(shape).max(axis=0), 1e-9) for name, shape in shapes.items()}
