"""Rotors between command and thrust: a delay, the motor, and the thrust of the rotor speeds."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Numeric, RotorSpeeds, Scalar
from ..flight import Inputs

Speed = Float[Array, "*samples"]
Commands = Callable[[Int[Array, "*rows"]], Float[Array, "*rows 4"]]
"""The commands [rad/s] at the samples with these numbers."""


def of_stretches(recordings: tuple[int, ...], stretch: Int[Numeric, " samples"]) -> Int[Numeric, " samples"]:
    """The recordings of these stretches. The last of `recordings` holds for all stretches that follow."""
    xp = np if isinstance(stretch, np.ndarray) else jnp  # known numbers need no compiled program
    return xp.asarray(recordings)[xp.minimum(stretch, len(recordings) - 1)]


class Grid(NamedTuple):
    """The sample time [s], and for each sample: the first and last sample of its stretch.

    `elapsed`: the fitted time in the recording before the sample [s]. `voltage`: the battery's over `battery_voltage`.
    `are_parts`: whether the samples are parts of the flight's samples (`Flight.within`), with their mean speeds.
    """

    dt: Scalar
    first: Int[Array, " samples"]
    last: Int[Array, " samples"]
    elapsed: Float[Array, " samples"]
    voltage: Float[Array, " samples"] | None = None
    are_parts: bool = False

    @classmethod
    def of(
        cls, inputs: Inputs, battery_voltage: Scalar | None, recordings: tuple[int, ...], *, are_parts: bool
    ) -> "Grid":
        """The grid of a flight's inputs. `recordings`: see `of_stretches`."""
        voltage, samples = inputs.voltage, inputs.omega.shape[0]
        voltage = None if voltage is None or battery_voltage is None else voltage / battery_voltage
        zeros = jnp.zeros(samples, dtype=int)
        stretch, first, last = inputs.stretches or (zeros, zeros, zeros + samples - 1)
        recording, elapsed = of_stretches(recordings, stretch), inputs.dt * jnp.arange(samples)
        if max(recordings) > 0:
            elapsed = elapsed - jnp.full(max(recordings) + 1, jnp.inf).at[recording].min(elapsed)[recording]
        return cls(inputs.dt, first, last, elapsed, voltage, are_parts)


class Batch(NamedTuple):
    """Consecutive samples of a grid, computed together.

    - `rows`: the numbers of the samples.
    - `before`: the rotor speeds at the end of the sample before them [rad/s]; without effect where a stretch begins.
    """

    grid: Grid
    rows: Int[Array, " rows"]
    before: Float[Array, "4"]

    @property
    def is_first(self) -> Bool[Array, " rows"]:
        """Whether a sample begins a stretch."""
        return self.rows == self.grid.first[self.rows]


class Speeds(NamedTuple):
    """Rotor speeds [rad/s] at the beginning and at the end of each sample, and their change up to the next sample."""

    begin: RotorSpeeds
    end: RotorSpeeds
    change: RotorSpeeds


def measured_speeds(omega: Commands, batch: Batch) -> Speeds:
    """Speeds that are constant over each sample. `change` is the step to the next sample, 0 at the end of a stretch.

    If the samples are parts, `change` is the difference of the speeds at the edges of a part. The speed at an edge is
    that of the parabola with the means of the three parts before it. Later parts may hold the controller's answer to a
    measurement at the edge. Before a stretch, its first part repeats.
    """
    first, last = batch.grid.first[batch.rows], batch.grid.last[batch.rows]

    def near(offset: int) -> RotorSpeeds:
        return omega(jnp.clip(batch.rows + offset, first, last))

    speed = near(0)
    if not batch.grid.are_parts:
        return Speeds(speed, speed, near(1) - speed)
    return Speeds(speed, speed, (11 * speed - 18 * near(-1) + 9 * near(-2) - 2 * near(-3)) / 6)


def squared(speeds: Speeds, batch: Batch) -> tuple[RotorSpeeds, RotorSpeeds]:
    """The thrust of each rotor divided by b [rad^2/s^2], of speeds that change linearly over a sample.

    **Returns:** the mean over the sample; and the value at its beginning, when sensors measure: the mean of the values
    just before and just after.
    """
    begin, end, _ = speeds
    before = jnp.concatenate([batch.before[None], end[:-1]])
    before = jnp.where(batch.is_first[:, None], begin, before)
    return (begin * begin + begin * end + end * end) / 3, (before * before + begin * begin) / 2


def delayed(omega: Commands, delay: Scalar, grid: Grid) -> Commands:
    """Commands that act `delay` [s] later. Before a stretch, its first command acts, and after it, its last command.

    Cubics interpolate between samples: a delay of whole samples is exact, and the derivative in the delay has no jumps
    at which a search could end. Their slopes are those of parabolas through the three samples up to each node: a delay
    that is not negative uses no later samples, which may hold the controller's answer to a measurement. A step
    overshoots by up to 26 %.
    """
    count, samples = grid.first.shape[0], delay / grid.dt
    floor = jnp.floor(jax.lax.stop_gradient(samples))
    f = samples - floor
    g = 1 - f
    # The weights of the values at the later and at the earlier node, and of the slopes there.
    later, earlier, slope, slope_before = g * g * (1 + 2 * f), f * f * (1 + 2 * g), -g * g * f, f * f * g
    weights = jnp.stack(
        [
            later + 1.5 * slope,
            earlier - 2 * slope + 1.5 * slope_before,
            slope / 2 - 2 * slope_before,
            slope_before / 2,
        ]
    )
    shift = jnp.clip(floor, -count, count).astype(int)

    def at(rows: Int[Array, "*rows"]) -> Float[Array, "*rows 4"]:
        near = rows - shift - np.arange(4)[:, None]
        return jnp.tensordot(weights, omega(jnp.clip(near, grid.first[rows], grid.last[rows])), 1)

    return at


class Motor(NamedTuple):
    """An electric motor with a propeller, which follows a command.

    With command u and speed w as shares of the full speed, curve c, and the propeller's load k = 1 - c,

        lag w' = g(u - c w) - k w^2.

    u - c w is the voltage minus the motor's back EMF. It drives the current and so the torque, g(x) = x. Below 0 the
    motor brakes with a share of this torque, g(x) = braking x - (1 - braking) s (1 - exp(x / s)). Without a load, and
    with full braking, this is a first-order system.

    - `lag`: time constant without a load [s].
    - `curve`: 1: the thrust is quadratic in the command, as without a load. 0: it is linear.
    - `braking`: the torque of a motor that is faster than its voltage, as a share of the driving torque. 0: it coasts.
    - `full`: the speed at the full command [rad/s].
    - `sag`: the share of the battery's voltage that the load of hover takes. `hover`: the speed of all rotors in hover
      [rad/s]. The voltage falls with the sum of the rotors' currents, so a command to all rotors has less effect than a
      command to a single rotor. The current is assumed to be proportional to the cube of the speed.

    Constants of all motors:

    - `smooth`: s, the range of voltage over which a motor passes from driving to braking, as a share of the full
      voltage. It is not 0 because the current has ripple.
    - `shortest_lag`: the lag is at least this share of a sample, so that a step stays finite wherever a search goes.
    - `emptiest`: at least this share of the battery's voltage remains under any load.
    - `least`: the lower limit of numbers under a root or in a quotient.
    """

    smooth = 0.005
    shortest_lag = 0.05
    emptiest = 0.5
    least = 1e-6

    lag: Scalar
    curve: Scalar | float = 1.0
    braking: Scalar | float = 1.0
    full: Scalar | float = 1.0
    sag: Scalar | float = 0.0
    hover: Scalar | float = 1.0

    def supplied(self, command: Float[Array, "4"], omega: Float[Array, "4"]) -> Float[Array, "4"]:
        """The commands [rad/s] that act when the rotors turn at `omega`. Commands are calibrated in hover."""
        return command * jnp.maximum(1 - self.sag * (jnp.mean((omega / self.hover) ** 3) - 1), self.emptiest)

    def command(self, omega: Speed) -> Speed:
        """The command [rad/s] that maintains a speed."""
        return omega * (self.curve + (1 - self.curve) * omega / self.full)

    def settled(self, command: Speed) -> Speed:
        """The speed [rad/s] at which rotors settle under a command."""
        root = jnp.sqrt(jnp.maximum(self.curve**2 + 4 * (1 - self.curve) * command / self.full, self.least))
        return 2 * command / jnp.maximum(self.curve + root, self.least)

    def step(self, omega: Speed, command: Speed, dt: Scalar, steps: int = 2) -> Speed:
        """The speed after `dt` [s], by exponential Euler steps: stable, and exact for a first-order system."""
        w, u, lag = omega / self.full, command / self.full, jnp.maximum(self.lag, self.shortest_lag * dt)
        for _ in range(steps):
            x, load = u - self.curve * w, (1 - self.curve) * w
            weak = (1 - self.braking) * jnp.exp(jnp.minimum(x, 0.0) / self.smooth)
            braking = self.braking * x - self.smooth * (1 - self.braking - weak)
            slope = jnp.where(x >= 0, 1.0, self.braking + weak) * self.curve + 2 * load
            z = dt / steps * slope / lag
            finite = jnp.abs(z) > self.least
            share = jnp.where(finite, -jnp.expm1(-z) / jnp.where(finite, z, 1.0), 1 - z / 2)
            w = jnp.maximum(w + dt / steps / lag * share * (jnp.where(x >= 0, x, braking) - load * w), 0.0)
        return w * self.full


def commanded_speeds(omega: RotorSpeeds, motor: Motor, batch: Batch) -> Speeds:
    """Speeds of rotors whose motors follow commands [rad/s]. A stretch begins at the speed of its first command."""

    def over_a_sample(speed: Speed, row):
        command, settled, is_first = row
        begin = jnp.where(is_first, settled, speed)
        end = motor.step(begin, motor.supplied(command, begin), batch.grid.dt, 1 if batch.grid.are_parts else 2)
        return end, (begin, end)

    begin, end = jax.lax.scan(over_a_sample, batch.before, (omega, motor.settled(omega), batch.is_first))[1]
    return Speeds(begin, end, end - begin)
