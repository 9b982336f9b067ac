"""References for a controller in each sample: angles of roll, pitch and yaw [rad], vertical acceleration [m/s^2]."""

import functools
import math
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._custom_types import Key, setting
from ..excitation import STANDARD_TONES, in_turn, sweep

References = Float[Array, "samples 4"]


def random_references(
    *, duration: float = 20.0, dt: float = 0.004, amplitude: Sequence[float] = (0.3, 0.3, 0.3, 1.5), key: Key
) -> References:
    """References of a standard flight: roll, pitch and yaw angle and vertical acceleration step to random levels.

    Each steps every half second, one after another. Accelerations come in pairs of opposite sign. So the vehicle gains
    little vertical velocity, as in a real flight.

    **Arguments:**

    - `duration`, `dt`: length and sample time [s].
    - `amplitude`: levels are uniform between -amplitude and amplitude: roll, pitch, yaw [rad], acceleration [m/s^2].

    **Returns:** the references in round(duration / dt) + 1 rows. The first and the last second are level.

    **Raises:** `ValueError` that names the argument.
    """
    setting("duration", positive=True)(duration)
    setting("dt", positive=True)(dt)
    if len(amplitude) != 4 or not np.all(np.isfinite(amplitude)):
        raise ValueError(f"`amplitude` must be four finite numbers, got {amplitude}.")
    time = dt * np.arange(round(duration / dt) + 1)
    steps = (time[:, None] / 0.5 + np.arange(4) / 4).astype(int)
    flown = (time >= 1) & (time <= duration - 1)
    return _levels(key, steps, int(steps[-1, -1]) + 1, flown[:, None] * np.asarray(amplitude, dtype=float))


@functools.partial(jax.jit, static_argnums=2)
def _levels(key: Key, steps: Int[Array, "samples 4"], count: int, amplitude: References) -> References:
    """Random levels in each step of the references. A second acceleration is the one before it with the other sign."""
    levels = jax.random.uniform(key, (count, 4), minval=-1, maxval=1)
    step = np.arange(count)
    levels = levels.at[:, 3].set(levels[step - step % 2, 3] * (1 - 2 * (step % 2)))
    return amplitude * jnp.take_along_axis(levels, steps, axis=0)


def standard_references(
    samples: int, dt: float, largest: Float[np.ndarray, "4"]
) -> dict[str, Float[np.ndarray, "samples 4"]]:
    """Multisine, doublet, 3-2-1-1 and chirp as references for a controller.

    A multisine excites all references at once, the others in turn. Pulses last 0.3 s, about 0.3 periods of the
    controlled vehicle's attitude, and all are of one height.

    - `largest`: the largest value of each. References are 0 if a shape does not fit into the time.
    """
    time = dt * np.arange(samples)[:, None]
    vertical = 0.4, 0.8, 1.2  # [Hz]
    sines = [np.sin(2 * math.pi * time * np.asarray(some)).sum(axis=1) for some in (*STANDARD_TONES, vertical)]
    swept, _ = sweep(max(samples // 4, 1), samples // 4 * dt, (0.2, 3.0))
    heights = {"doublet": [1, -1, 0], "3211": [1, 1, 1, -1, -1, 1, -1, 0]}
    pulses = {name: np.repeat(np.array(each, float), max(round(0.3 / dt), 1)) for name, each in heights.items()}
    shapes = {"multisine": np.stack(sines, axis=1)}
    for name, parts in ({name: (once, -once) for name, once in pulses.items()} | {"chirp": (swept,)}).items():
        shapes[name] = in_turn(parts, samples, 4, [slot % 4 for slot in range(samples // len(parts[0]))])
    return {name: with_largest(shape, largest) for name, shape in shapes.items()}


def with_largest(shape: np.ndarray, largest: Float[np.ndarray, "4"]) -> Float[np.ndarray, "samples 4"]:
    """References with these largest values."""
    return largest * shape / np.maximum(np.abs(shape).max(axis=0), 1e-9)
