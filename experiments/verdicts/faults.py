"""Faults of real logs: each spoils a good recording, in three sizes, and has the cause that an answer must name."""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np

from jaxos4.flight import ANGLES, RATES
from jaxos4.recording import Recording
from jaxos4.rotations import rotations_to_body

FORCE = slice(12, 15)  # of the channels


class Fault(NamedTuple):
    """`spoil`: makes spoiled recordings of a good one and a size. `cause`: words of the right cause; empty: none."""

    spoil: Callable[[Recording, float], Recording | list[Recording]]
    sizes: tuple[float, ...]
    cause: str


def changed(recording: Recording, channels: np.ndarray) -> Recording:
    """The recording with other states and specific force."""
    return recording._replace(states=channels[:, :12], specific_force=channels[:, FORCE])


def of_each(
    columns: Iterable[int], change: Callable[[np.ndarray, np.ndarray, float], np.ndarray]
) -> Callable[[Recording, float], Recording]:
    """A fault of some channels, one by one.

    `change`: takes a channel, the times and the size, and returns the spoiled channel.
    """

    def spoil(recording: Recording, size: float) -> Recording:
        channels = recording.channels.copy()
        for i in columns:
            channels[:, i] = change(channels[:, i], recording.time, size)
        return changed(recording, channels)

    return spoil


def scaled(columns: Iterable[int]) -> Callable[[Recording, float], Recording]:
    """Some channels have another scale."""
    return of_each(columns, lambda channel, _, size: size * channel)


def late(columns: Iterable[int]) -> Callable[[Recording, float], Recording]:
    """Some channels are recorded late by `size` [s]; negative: early."""
    return of_each(columns, lambda channel, time, size: np.interp(time - size, time, channel))


def clipped(column: int) -> Callable[[Recording, float], Recording]:
    """The range of a sensor ends at this share of its largest value."""

    def clip(channel: np.ndarray, _: np.ndarray, size: float) -> np.ndarray:
        end = size * np.nanmax(np.abs(channel))
        return np.clip(channel, -end, end)

    return of_each([column], clip)


def turned(recording: Recording, degrees: float) -> Recording:
    """Gyro and accelerometer are mounted at an angle about z."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    channels = recording.channels.copy()
    for x, y in ((RATES[0], RATES[1]), (12, 13)):
        channels[:, [x, y]] = channels[:, [x, y]] @ np.array([[cos, -sin], [sin, cos]])
    return changed(recording, channels)


def along_the_earth(recording: Recording, size: float) -> Recording:
    """Specific force is along the axes of the earth; `size`: the share of the turn."""
    channels = recording.channels.copy()
    turns = rotations_to_body(size * channels[:, ANGLES])
    channels[:, FORCE] = np.einsum("tji,tj->ti", turns, channels[:, FORCE])
    return changed(recording, channels)


def impossible(recording: Recording, size: float) -> Recording:
    """Two impossible rotor speeds: 60 and `size` times the mean."""
    omega = recording.omega.copy()
    omega[[len(omega) // 3, len(omega) // 2], 3] = np.array([60.0, size]) * omega[:, 3].mean()
    return recording._replace(omega=omega)


def noisy(recording: Recording, size: float) -> Recording:
    """White noise of the motors, as a share of their changes from sample to sample."""
    change = np.mean(np.median(np.abs(np.diff(recording.omega, axis=0)), axis=0))
    noise = np.random.default_rng(0).normal(0.0, size * change, recording.omega.shape)
    return recording._replace(omega=np.maximum(recording.omega + noise, 0.0))


def shortened(recording: Recording, seconds: float) -> Recording:
    """The first seconds of a flight."""
    return recording.rows(recording.time <= recording.time[0] + seconds)


def without_rows(recording: Recording, lost: float) -> Recording:
    """This share of the rows is missing, at random."""
    return recording.rows(np.random.default_rng(0).uniform(size=recording.time.size) >= lost)


def two_vehicles(recording: Recording, size: float) -> list[Recording]:
    """Two halves; the second is of a vehicle whose mass and moments of inertia are this many times smaller.

    With rotor speeds that are smaller by the root, it flies the same path.
    """
    first = recording.time <= (recording.time[0] + recording.time[-1]) / 2
    second = recording.rows(~first)
    return [recording.rows(first), second._replace(omega=second.omega / np.sqrt(size), name="second flight")]


def thinned(recording: Recording, every: float) -> Recording:
    """Motors are logged once in this many samples."""
    rows = np.arange(len(recording.omega)) // int(every) * int(every)
    return recording._replace(omega=recording.omega[rows])


FAULTS = {
    "gyro scale": Fault(scaled(RATES), (0.5, 0.8, 1.25), "the attitude turns"),
    "time scale": Fault(lambda r, size: r._replace(time=size * r.time), (2.0, 1.25, 0.8), "the attitude turns"),
    "attitude scale": Fault(scaled(ANGLES), (0.5, 0.8, 1.25), "the attitude turns"),
    "attitude late": Fault(late(ANGLES), (0.2, 0.1, 0.05), "attitude is recorded"),
    "gyro clipped": Fault(clipped(int(RATES[0])), (0.5, 0.65, 0.8), "is clipped"),
    "force clipped": Fault(clipped(14), (0.9, 0.85, 0.8), "is clipped"),
    "gyro early": Fault(late(RATES), (-0.05, -0.03, -0.02), "gyro is recorded"),
    "force late": Fault(late((12, 13, 14)), (0.05, 0.03, 0.02), "accelerometer is recorded"),
    "turned": Fault(turned, (30.0, 20.0, 10.0), "at an angle about the vertical axis"),
    "earth's axes": Fault(along_the_earth, (1.0,), "along the axes of the earth"),
    "impossible speeds": Fault(impossible, (40.0, 19.0, 5.0), "are impossible"),
    "noisy motors": Fault(noisy, (0.3, 1.0, 3.0), ""),
    "short": Fault(shortened, (2.0, 4.0, 6.0), "s were fitted"),
    "rows missing": Fault(without_rows, (0.1, 0.3, 0.5), "is not uniform"),
    "two vehicles": Fault(two_vehicles, (1.1, 1.2, 1.3), "of different mass or thrust"),
    "rare motors": Fault(thinned, (5.0, 10.0, 20.0), "more rarely"),
}
