"""Values that no sensor measured: impossible ones, and those at the end of a sensor's range."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from ...flight import CHANNEL_NAMES, FORCE_NAMES
from ..pieces import Recording

_ROTORS = tuple(f"rotor {i + 1}" for i in range(4))
_SENSED = ("p", "q", "r", *FORCE_NAMES)  # a rotor at its limit is a fact, and not an error of its sensor
_QUANTILES = (0.005, 0.995)
_NEIGHBOURS = np.array([-3, -2, -1, 1, 2, 3])
_NEAR = 0.01  # of the range between the quantiles: values this close to the largest one are its neighbours
_LEVELS = 10  # values that are repeated: those of a coarse signal
_FEWEST = 20  # values; fewer have no usual range


class Plausible(NamedTuple):
    """A recording in which faulty values count as not measured, and how many they are, by channel.

    - `impossible`: by channel, how many values, and the most extreme of them.
    - `clipped`: by channel, how many values are stuck at the end of the range, their share, and the end.
    """

    recording: Recording
    impossible: Mapping[str, tuple[int, float]]
    clipped: Mapping[str, tuple[int, float, float]]


def plausible(recording: Recording, *, spread: float = 8.0, times: float = 3.0, fewest: int = 4) -> Plausible:
    """Take out values that no sensor measured. Rotors get the value before instead.

    **Arguments:**

    - `spread`: a value is impossible if it lies so many times further from the median than 99 % of the values, and its
      neighbours do not. Fast manoeuvres last for more than three samples.
    - `times`, `fewest`: values are clipped if so many are equal to the largest one, and so many times more than lie
      just below. A signal without limits has a single largest value. A value that is held counts once.
    """
    channels, omega = recording.channels.copy(), recording.omega.copy()
    impossible, clipped = {}, {}
    for name, column in zip((*CHANNEL_NAMES, *_ROTORS), (*channels.T, *omega.T), strict=True):
        wrong = _isolated(column, spread)
        if wrong.any():
            worst = column[wrong][np.argmax(np.abs(column[wrong]))]
            impossible[name] = int(wrong.sum()), float(worst)
            column[wrong] = np.nan
        if name in _SENSED:
            known = np.count_nonzero(np.isfinite(column))
            for sign in (1.0, -1.0):
                stuck = _stuck(sign * column, times, fewest)
                if stuck.any():
                    end = float(column[stuck][0])
                    count, share, before = clipped.get(name, (0, 0.0, end))
                    clipped[name] = (
                        count + int(stuck.sum()),
                        share + float(stuck.sum() / known),
                        max(before, end, key=abs),
                    )
                    column[stuck] = np.nan
    if not impossible and not clipped:
        return Plausible(recording, {}, {})
    last = np.maximum.accumulate(np.where(np.isfinite(omega), np.arange(len(omega))[:, None], -1), axis=0)
    last = np.where(last < 0, np.isfinite(omega).argmax(axis=0), last)
    force = None if recording.specific_force is None else channels[:, 12:]
    clean = recording._replace(
        omega=np.take_along_axis(omega, last, axis=0), states=channels[:, :12], specific_force=force
    )
    return Plausible(clean, impossible, clipped)


def _isolated(values: Float[np.ndarray, " samples"], spread: float) -> Bool[np.ndarray, " samples"]:
    """Which values lie far outside of the usual range, while most of the six around them do not."""
    out, known = np.zeros(values.size, dtype=bool), np.flatnonzero(np.isfinite(values))
    if known.size < _FEWEST:
        return out
    x = values[known]
    least, middle, most = np.quantile(x, (_QUANTILES[0], 0.5, _QUANTILES[1]))
    far = (x < middle - spread * (middle - least)) | (x > middle + spread * (most - middle))
    if least == most or not far.any():
        return out
    at = np.flatnonzero(far)
    around = far[np.clip(at[:, None] + _NEIGHBOURS, 0, x.size - 1)].sum(axis=1)
    out[known[at[around < _NEIGHBOURS.size / 2]]] = True
    return out


def _stuck(values: Float[np.ndarray, " samples"], times: float, fewest: int) -> Bool[np.ndarray, " samples"]:
    """Which values are equal to the largest one, if these are too many to be chance."""
    out, known = np.zeros(values.size, dtype=bool), np.flatnonzero(np.isfinite(values))
    if known.size < _FEWEST:
        return out
    x = values[known]
    near = _NEAR * float(np.subtract(*np.quantile(x, _QUANTILES[::-1])))
    top = x >= x.max() - 1e-4 * near
    if near <= 0 or top.sum() < fewest:
        return out
    held = np.diff(np.flatnonzero(np.concatenate([[True], np.diff(x) != 0, [True]])))
    usual = float(np.quantile(held, 0.9))  # samples for which a value is held
    edges = np.flatnonzero(np.diff(np.concatenate([[0], top.astype(int), [0]])))
    at_top = np.ceil((edges[1::2] - edges[::2]) / usual).sum()
    levels, counts = np.unique(x, return_counts=True)
    levels = levels[counts > 1]
    if levels.size > _LEVELS:  # the level below the top is near
        near = max(near, 1.01 * float(np.median(np.diff(levels))))
    beside = np.count_nonzero(x[~top] >= x.max() - near) / usual
    if at_top >= max(fewest, times * (beside + 1)):
        out[known[top]] = True
    return out
