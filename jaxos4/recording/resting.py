"""Parts of a flight in which something else than the rotors carries the vehicle: the ground, or a hand."""

import math

import numpy as np
from jaxtyping import Bool, Float

_GRAVITY = 9.80665
_BIN = 0.05  # [s], means over this time
_SMOOTH = 4  # bins: longer than the lag of any rotor
_WINDOW, _FILLED = 2.0, 5.0  # [s]; a gap between two resting windows is filled up to this length
_VARIES = 0.2  # standard deviation of thrust in a window, as a share of its mean
_UNFELT = 0.1  # relative change of the vertical force for a relative change of thrust: 1 in flight
_STEADY = 0.1  # [g], standard deviation of the force of a resting vehicle
_ONE_G = 0.15  # [g], error of an accelerometer
_TILTED, _STILL, _SHORTEST = 0.5, 0.2, 1.0  # [g] along z, [rad/s], [s]


def resting(
    omega: Float[np.ndarray, "samples 4"],
    force: Float[np.ndarray, "samples 3"],
    rates: Float[np.ndarray, "samples 3"],
    airborne: Bool[np.ndarray, " samples"],
    dt: float,
) -> Bool[np.ndarray, " samples"]:
    """Which samples are of a vehicle at rest, by its accelerometer.

    In flight the specific force along z is the thrust, divided by the mass. On the ground and in a hand it is that of
    gravity, whatever the rotors do. And a vehicle that lies on its side or back measures gravity across its rotors'
    axes.

    **Arguments:** rotor speeds or commands, specific force [m/s^2], body rates [rad/s], the samples that may be in
    flight (only these are judged), and the step [s].

    A window without changes of thrust proves nothing. Gaps of up to 5 s between windows at rest are at rest as well.
    """
    size = omega.shape[0]
    length = max(round(_BIN / dt), 1)
    bins = size // length
    if bins < 2 or np.ptp(np.nan_to_num(force), axis=0).max() == 0:  # no accelerometer lies still to the last bit
        return np.zeros(size, dtype=bool)
    sensed = np.column_stack([omega.mean(axis=1) ** 2, force / _GRAVITY, np.abs(rates).max(axis=1)])
    sensed[~airborne] = np.nan
    means = sensed[: bins * length].reshape(bins, length, -1).mean(axis=1)  # NaN where a sample is
    step = length * dt
    found = _unfelt(means, step) | _tilted(means, step)
    out = np.repeat(found, length)
    return np.append(out, np.full(size - out.size, found[-1]))


def _unfelt(means: np.ndarray, step: float) -> np.ndarray:
    """The bins of windows in which thrust changes, and the accelerometer does not."""
    smooth = np.column_stack([np.convolve(column, np.full(_SMOOTH, 1 / _SMOOTH), "same") for column in means.T])
    smooth[: _SMOOTH // 2] = smooth[-(_SMOOTH // 2) :] = np.nan
    out, felt = np.zeros(means.shape[0], dtype=bool), np.zeros(means.shape[0], dtype=bool)
    wide = max(round(_WINDOW / step), 4)
    for begin in range(0, means.shape[0] - wide // 2, max(wide // 4, 1)):
        part = smooth[begin : begin + wide]
        part = part[np.isfinite(part[:, :4]).all(axis=1)]
        if part.shape[0] < wide // 2:
            continue
        thrust, vertical = part[:, 0], part[:, 3]
        size = np.linalg.norm(part[:, 1:4], axis=1)
        mean = float(thrust.mean())
        if mean <= 0 or thrust.std() < _VARIES * mean:
            continue
        deviation = thrust - mean
        follows = (
            float(deviation @ vertical) / float(deviation @ deviation) * mean / max(abs(float(vertical.mean())), 0.1)
        )
        gravity = abs(size.mean() - 1) < _ONE_G and size.std() < _STEADY
        (out if gravity and abs(follows) < _UNFELT else felt)[begin : begin + wide] = True
    known = np.flatnonzero(out)
    for one, following in zip(known[:-1], known[1:], strict=True):
        if 1 < following - one <= _FILLED / step and not felt[one + 1 : following].any():
            out[one:following] = True
    return out


def _tilted(means: np.ndarray, step: float) -> np.ndarray:
    """The bins of a vehicle that lies on its side or back, for at least a second."""
    size = np.linalg.norm(means[:, 1:4], axis=1)
    with np.errstate(invalid="ignore"):
        lies = (np.abs(size - 1) < _ONE_G) & (means[:, 3] < _TILTED) & (means[:, 4] < _STILL)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], lies, [False]]).astype(np.int8))).reshape(-1, 2)
    for begin, end in edges:
        if end - begin < math.ceil(_SHORTEST / step):
            lies[begin:end] = False
    return np.asarray(lies)
