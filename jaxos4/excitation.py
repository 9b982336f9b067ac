"""Inputs that excite the parameters: rotor speeds for a hovering quadrotor, or references for its controller.

Rotor speeds: angular accelerations are designed, and Eqs. (10)-(13) solved for the speeds that make them, by NumPy. The
paper does not state its inputs. References: roll, pitch and yaw angle [rad] and vertical acceleration [m/s^2].
"""

import functools
import math
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ._custom_types import Key, Numeric, RotorSpeeds, as_float, setting
from .airframe import AXES, Airframe

STANDARD_TONES = ((0.6, 1.1, 1.9), (0.7, 1.3, 2.3), (0.5, 0.9, 1.7))

Amplitude = float | Sequence[float] | Float[Numeric, "3"]


def multisine(
    airframe: Airframe,
    *,
    duration: float = 5.0,
    dt: float = 0.01,
    amplitude: Amplitude = 1.0,
    tones: Sequence[Sequence[float]] = STANDARD_TONES,
) -> RotorSpeeds:
    """A sum of sines about all axes at once. The default input, because it excites every parameter.

    The rate of an axis with n tones is amplitude/n sum sin(2 pi f t), which starts at rest. The axes are uncorrelated
    over a common period (10 s for the default tones) if no two axes share a tone.

    **Arguments:**

    - `duration`, `dt`: length and sample time [s].
    - `amplitude`: limit of the designed rates [rad/s]: one number, or three for roll, pitch and yaw. 0: no motion.
    - `tones`: frequencies [Hz] of roll, pitch and yaw, below half the sample rate. An empty list: no motion.

    **Returns:** rotor speeds [rad/s] in round(duration / dt) + 1 rows.

    **Raises:** `ValueError` for arguments out of range, or if the airframe cannot fly the input.
    """
    intervals, peak = _intervals(duration, dt), _peak_rates(amplitude)
    if len(tones) != 3:
        raise ValueError(f"`tones` must hold three lists (roll, pitch, yaw), got {len(tones)}.")
    time = dt * np.arange(intervals + 1)
    acceleration = np.zeros((intervals + 1, 3))
    for axis, axis_tones in enumerate(tones):
        _check_frequencies("tones", axis_tones, dt)
        for angular in 2 * math.pi * np.asarray(axis_tones):
            acceleration[:, axis] += peak[axis] * angular * np.cos(angular * time) / len(axis_tones)
    return _rotor_speeds(airframe, acceleration, dt)


def doublet(airframe: Airframe, *, duration: float = 5.0, dt: float = 0.01, amplitude: Amplitude = 1.0) -> RotorSpeeds:
    """A doublet of torque about roll, then pitch, then yaw.

    The pulses + - of 0.3 s end at rate zero and an angle of amplitude x 0.3 s. The mirror image - + brings the angle
    back, and a rest follows. The sequence repeats as often as it fits, then the quadrotor hovers. Only one axis turns
    at a time, so alpha1, alpha4 and alpha7 are not excited.

    **Arguments:** those of `multisine`.

    **Raises:** as `multisine`, and if the duration is too short.
    """
    return _pulses(airframe, (1.0, -1.0), 0.3, duration, dt, amplitude)


def step3211(airframe: Airframe, *, duration: float = 5.0, dt: float = 0.01, amplitude: Amplitude = 1.0) -> RotorSpeeds:
    """Pulses of 0.3, 0.2, 0.1 and 0.1 s and alternating sign about one axis after another; otherwise as `doublet`.

    Heights of 0.8, 1.2, 1.1 and 1.1 end at rest: 3 x 0.8 - 2 x 1.2 + 1.1 - 1.1 = 0. The angle is then amplitude x
    0.296 s.
    """
    return _pulses(airframe, (0.8, 0.8, 0.8, -1.2, -1.2, 1.1, -1.1), 0.1, duration, dt, amplitude)


def chirp(
    airframe: Airframe, *, duration: float = 5.0, dt: float = 0.01, amplitude: Amplitude = (1.0, 1.0, 0.5)
) -> RotorSpeeds:
    """A sweep from 0.6 to 3 Hz about one axis after another, faded in and out. The axes share the duration equally.

    As with `doublet`, alpha1, alpha4 and alpha7 are not excited. Arguments and errors are those of `multisine`; an axis
    needs one cycle. The yaw rate is half the others, because the yaw torque of rotors is small.
    """
    intervals = _intervals(duration, dt)
    ends = 0.6, 3.0  # [Hz]
    _check_frequencies("dt", ends, dt)
    samples = intervals // len(AXES)
    span = (samples - 1) * dt
    if span * sum(ends) / 2 < 1:
        least = len(AXES) * (2 / sum(ends) + 2 * dt)
        raise ValueError(f"`duration` must be at least {least:.3g} s for one cycle on each axis, got {duration:g} s.")
    sine, frequency = sweep(samples, span, ends)
    angle = np.pad(sine / (2 * math.pi * frequency), 1)
    rate = np.diff(angle) / dt
    shape = np.diff(rate) / dt / np.abs(rate).max()
    return _about_axes(airframe, shape, intervals, amplitude, dt)


Excite = Callable[..., RotorSpeeds]
EXCITATIONS: dict[str, Excite] = {"multisine": multisine, "doublet": doublet, "3211": step3211, "chirp": chirp}


def _pulses(airframe, heights, width, duration, dt, amplitude) -> RotorSpeeds:
    intervals = _intervals(duration, dt)
    if round(width / dt) < 1:
        raise ValueError(f"`dt` must be at most the width of a pulse, {width:g} s, got {dt:g} s.")
    once = np.repeat(heights, round(width / dt))
    shape = np.concatenate([once, -once, np.zeros(round(width / dt))])
    shape = shape / (np.abs(np.cumsum(shape)).max() * dt)
    sequence = len(AXES) * len(shape)
    if sequence > intervals:
        raise ValueError(f"`duration` must be at least {sequence * dt:.6g} s for pulses on 3 axes, got {duration:g} s.")
    return _about_axes(airframe, shape, intervals, amplitude, dt)


def _about_axes(airframe, shape: np.ndarray, intervals: int, amplitude, dt: float) -> RotorSpeeds:
    """`shape` (unit peak rate) about each axis in turn, repeated while a complete sequence fits."""
    slots = intervals // (len(AXES) * len(shape)) * [0, 1, 2]
    return _rotor_speeds(airframe, _peak_rates(amplitude) * in_turn([shape], intervals + 1, 3, slots), dt)


def _rotor_speeds(airframe: Airframe, acceleration: np.ndarray, dt: float) -> RotorSpeeds:
    """Rotor speeds [rad/s] for angular accelerations [rad/s^2] in hover. `ValueError` says which amplitude can fly."""
    torque = np.asarray(airframe.inertia, dtype=np.float64) * acceleration
    hover, fastest = airframe.hover_squares, float(airframe.max_rotor_speed)
    change = np.linalg.solve(np.asarray(airframe.mixer, dtype=np.float64), np.pad(torque, ((0, 0), (0, 1))).T).T
    if (hover < 0).any() or (hover > fastest**2).any():
        raise ValueError(
            f"`airframe` cannot hover: it needs squared rotor speeds of {np.round(hover).tolist()} rad^2/s^2, but its "
            f"`max_rotor_speed` is {fastest:g} rad/s; correct its mass, thrust coefficient or largest speed."
        )
    reserve = np.where(change > 0, fastest**2 - hover, hover)
    share = np.divide(reserve, np.abs(change), out=np.full_like(change, np.inf), where=change != 0)
    row, rotor = np.unravel_index(np.argmin(share), share.shape)
    if share[row, rotor] < 1:
        raise ValueError(
            f"`amplitude` is too large to fly: rotor {rotor + 1} would need a squared speed of "
            f"{hover[rotor] + change[row, rotor]:.5g} rad^2/s^2 at t = {row * dt:.4g} s, outside of 0 to "
            f"{fastest**2:.5g} (`max_rotor_speed`); multiply it by {0.995 * share[row, rotor]:.3g} or less."
        )
    return as_float(np.sqrt(hover + change))


def _intervals(duration: float, dt: float) -> int:
    if not (0 < dt < math.inf and dt / 2 < duration < math.inf):
        raise ValueError(f"`duration` and `dt` must be finite [s] and hold one sample, got {duration:g} and {dt:g} s.")
    return round(duration / dt)


def _peak_rates(amplitude: Amplitude) -> np.ndarray:
    peak = np.asarray(amplitude, dtype=np.float64)
    if peak.shape not in ((), (3,)) or not np.isfinite(peak).all():
        raise ValueError(f"`amplitude` must be one finite rate or three (roll, pitch, yaw) [rad/s], got {amplitude}.")
    return np.broadcast_to(peak, (3,))


def _check_frequencies(name: str, frequencies: Sequence[float], dt: float) -> None:
    if not all(0 < frequency < 0.5 / dt for frequency in frequencies):
        most, got = 0.5 / dt, list(frequencies)
        raise ValueError(f"`{name}`: frequencies must lie between 0 and half the sample rate, {most:g} Hz, got {got}.")


def in_turn(shapes: Sequence[np.ndarray], samples: int, columns: int, slots: Sequence[int]) -> np.ndarray:
    """One column after another in the order of `slots`; the next of `shapes` follows after all columns."""
    found, length = np.zeros((samples, columns)), len(shapes[0])
    for slot, column in enumerate(slots):
        found[slot * length : (slot + 1) * length, column] = shapes[slot // columns % len(shapes)]
    return found


def sweep(samples: int, span: float, frequencies: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A sine that sweeps two frequencies in `span` [s], faded in and out in a fifth of it; and its frequency."""
    share, (first, last) = np.linspace(0, 1, samples), frequencies
    phase = 2 * math.pi * span * (first * share + (last - first) * share**2 / 2)
    fade = np.sin(math.pi / 2 * np.clip(np.minimum(share, 1 - share) / 0.2, 0, 1)) ** 2
    return fade * np.sin(phase), first + (last - first) * share


References = Float[Array, "samples 4"]


def random_references(
    *, duration: float = 20.0, dt: float = 0.004, amplitude: Sequence[float] = (0.3, 0.3, 0.3, 1.5), key: Key
) -> References:
    """References of a standard flight: roll, pitch and yaw angle and vertical acceleration step to random levels.

    Each steps every half second, one after another. Accelerations come in pairs of opposite sign, for little vertical
    velocity. The first and the last second are level.

    - `duration`, `dt`: length and sample time [s]; there are round(duration / dt) + 1 rows.
    - `amplitude`: levels are uniform between -amplitude and amplitude: roll, pitch, yaw [rad], acceleration [m/s^2].

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
