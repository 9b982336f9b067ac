"""Rotors between command and thrust: a delay, a first-order lag, and the thrust that the speeds make."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, Num

from .._custom_types import RotorSpeeds, Scalar
from ..flight import Inputs

# The lag that acts is at least this share of a sample, so that the filter stays stable wherever a search looks.
_SHORTEST_LAG = 0.05


class Grid(NamedTuple):
    """The sample time [s], and for each sample: its uninterrupted stretch, and the first and last sample of that.

    `voltage`: the battery's, divided by the voltage to which the airframe's rotor speeds belong.
    """

    dt: Scalar
    stretch: Int[Array, " samples"]
    first: Int[Array, " samples"]
    last: Int[Array, " samples"]
    voltage: Float[Array, " samples"] | None = None

    @classmethod
    def of(cls, inputs: Inputs, battery_voltage: Scalar | None = None) -> "Grid":
        """The grid of a flight's inputs. `battery_voltage`: to which the airframe's rotor speeds belong [V]."""
        voltage = inputs.voltage
        voltage = None if voltage is None or battery_voltage is None else voltage / battery_voltage
        if inputs.stretches is not None:
            return cls(inputs.dt, *inputs.stretches, voltage)
        zeros = jnp.zeros(inputs.omega.shape[0], dtype=int)
        return cls(inputs.dt, zeros, zeros, zeros + inputs.omega.shape[0] - 1, voltage)


class Speeds(NamedTuple):
    """Rotor speeds over each sample [rad/s]: at its begin, at its end, and their change up to the next sample."""

    begin: RotorSpeeds
    end: RotorSpeeds
    change: RotorSpeeds


class SquaredSpeeds(NamedTuple):
    """The thrust of each rotor divided by b [rad^2/s^2]: its mean over the sample, and its value at the begin."""

    mean: RotorSpeeds
    begin: RotorSpeeds


def measured_speeds(omega: RotorSpeeds, grid: Grid) -> Speeds:
    """Speeds that are held over each sample. The last row of a stretch changes nothing."""
    is_last = (jnp.arange(omega.shape[0]) == grid.last)[:, None]
    following = jnp.where(is_last, omega, jnp.roll(omega, -1, axis=0))
    return Speeds(omega, omega, following - omega)


def squared(speeds: Speeds) -> SquaredSpeeds:
    """Squares of speeds that change linearly over a sample: the mean square makes the mean torque."""
    begin, end, _ = speeds
    return SquaredSpeeds((begin * begin + begin * end + end * end) / 3, begin * begin)


def delayed(omega: RotorSpeeds, delay: Scalar, grid: Grid) -> RotorSpeeds:
    """Commands that act `delay` [s] later.

    Before its first command, a stretch has its first command. After its last command, it has its last command.

    Cubics interpolate between samples (Catmull and Rom 1974): a delay of whole samples is exact, and the derivative in
    the delay has no jumps at which a search could end.
    """
    count, samples = omega.shape[0], delay / grid.dt
    floor = jnp.floor(jax.lax.stop_gradient(samples))
    f = samples - floor
    weights = (
        f * (-0.5 + f - f * f / 2),
        1 + f * f * (1.5 * f - 2.5),
        f * (0.5 + 2 * f - 1.5 * f * f),
        f * f * (f - 1) / 2,
    )
    # One slice holds the four samples around each point; samples beyond the stretch are replaced below.
    shift = jnp.clip(floor, -count, count).astype(int)
    padded = jnp.pad(omega, ((count + 2, count + 2), (0, 0)))
    near = jax.lax.dynamic_slice_in_dim(padded, count - shift, count + 3)
    begin, end = omega[grid.first], omega[grid.last]
    row = jnp.arange(count) - shift
    total = jnp.zeros_like(omega)
    for weight, ahead in zip(weights, (1, 0, -1, -2), strict=True):
        value = near[2 + ahead : 2 + ahead + count]
        value = jnp.where((row + ahead < grid.first)[:, None], begin, value)
        total += weight * jnp.where((row + ahead > grid.last)[:, None], end, value)
    return total


def lagged(omega: RotorSpeeds, lag: Scalar, grid: Grid) -> Speeds:
    """Speeds of rotors that follow their commands as first-order systems with the time constant `lag` [s].

    In each stretch the rotors begin at their first command. The recursion w_{k+1} = a w_k + (1 - a) u_k runs in all
    blocks of samples in parallel, each from rest; then each block adds the effect of earlier blocks. This takes as many
    steps as the square root of the number of samples.
    """
    lag = jnp.maximum(lag, _SHORTEST_LAG * grid.dt)
    decay, samples = jnp.exp(-grid.dt / lag), omega.shape[0]
    length = max(int(np.sqrt(samples)), 1)
    blocks = -(-samples // length)

    def in_blocks(x: Num[Array, "samples columns"]) -> Num[Array, "length blocks columns"]:
        padded = jnp.pad(x, ((0, blocks * length - samples), (0, 0)))
        return jnp.swapaxes(padded.reshape(blocks, length, x.shape[1]), 0, 1)

    # The first sample of a stretch forgets the past and takes its own command.
    is_first = (grid.first == jnp.arange(samples))[:, None]
    before = jnp.concatenate([omega[:1], omega[:-1]])
    rows = in_blocks(jnp.where(is_first, 0.0, decay)), in_blocks(jnp.where(is_first, omega, (1 - decay) * before))

    def step(speed: Float[Array, "blocks 4"], row):
        speed = row[0] * speed + row[1]
        return speed, speed

    last, from_rest = jax.lax.scan(step, jnp.zeros((blocks, omega.shape[1]), omega.dtype), rows)
    # A later block of the same stretch adds the end of each earlier block, decayed over the samples between them.
    begins = length * np.arange(blocks)
    stretch_begins = in_blocks(grid.first[:, None])[:, :, 0]
    apart = np.maximum(begins[:, None] - begins, 0) - length
    reaches = (apart >= 0) & (stretch_begins[0][:, None] < begins + length)
    inherited = jnp.where(reaches, decay ** np.maximum(apart, 0), 0.0) @ last
    kept = jnp.where(stretch_begins < begins, decay ** np.arange(1, length + 1)[:, None], 0.0)
    begin = jnp.swapaxes(from_rest + kept[:, :, None] * inherited, 0, 1).reshape(blocks * length, -1)[:samples]
    end = decay * begin + (1 - decay) * omega
    return Speeds(begin, end, end - begin)
