"""How gyro and accelerometer answer the rotors: gains, axes and delays, by cross-spectra."""

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Complex, Float

from ...airframe import Airframe
from ...flight import CHANNEL_NAMES
from ...logs.sampling import averages
from ..pieces import Recording
from .attitude import interpolated, peak
from .finding import Measured

_STEP, _SEGMENT = 0.004, 2.0  # [s], of the samples and of the segments that are transformed
_GAP = 0.05  # [s], the longest that is interpolated
_BAND = (2.0, 15.0)  # [Hz]: gusts are slower; rotors, and noise of the gyro, leave little above
_LAGS = (0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1)  # [s], of rotors that follow commands
_DELAYS = 0.001 * np.arange(-150, 181)  # [s]
_BLOCKS, _FEWEST_SEGMENTS = 12, 6  # of the jackknife; fewer segments have no standard error
_SENSED = [CHANNEL_NAMES.index(name) for name in ("p", "q", "az")]
_ROLL_PITCH, _VERTICAL = slice(0, 2), slice(2, 3)

Products = Complex[np.ndarray, "frequencies 6 6"]


class Response(msgspec.Struct, frozen=True):
    """The answer of roll and pitch acceleration and vertical force to the rotors, at 2 to 15 Hz.

    - `turning`: the matrix from roll and pitch torque to roll and pitch acceleration [1/(kg m^2)].
    - `delays`: of gyro and accelerometer after the rotors, and of the gyro after the accelerometer [s].
    - `coherent`: the shares of roll acceleration, pitch acceleration and vertical force that the rotors explain. NaN:
      not measured.
    - `lag`: of the rotors [s]; 0 if their speeds were measured.
    """

    turning: Measured
    delays: Measured
    coherent: Float[np.ndarray, "3"]
    lag: float


class _Fit(NamedTuple):
    turning: np.ndarray
    delays: np.ndarray
    coherent: np.ndarray


def rotor_response(pieces: Sequence[Recording], airframe: Airframe) -> Response | None:
    """Compare gyro and accelerometer with the rotors. `None`: the flight is too short, too slow, or has no gyro."""
    step = max(_STEP, *(piece.dt for piece in pieces))
    if step > 0.5 / _BAND[1]:
        return None
    segments = [segment for piece in pieces for segment in _segments(piece, airframe, step)]
    if len(segments) < _FEWEST_SEGMENTS:
        return None
    frequency = np.fft.rfftfreq(round(_SEGMENT / step), step)
    inside = (frequency >= _BAND[0]) & (frequency <= _BAND[1])
    omega = 2j * np.pi * frequency[inside]
    # Rotor speeds are those of the step after their time. Angular accelerations are the derivatives of rates.
    factors = np.stack([np.exp(-omega * step / 2)] * 3 + [omega, omega, np.ones_like(omega)])
    groups = np.array_split(np.array(segments)[:, :, inside] * factors, min(_BLOCKS, len(segments)))
    blocks = np.array([np.einsum("sif,sjf->fij", group.conj(), group) for group in groups])
    whole = blocks.sum(axis=0)
    lags = _LAGS if pieces[0].commanded else (0.0,)
    fits = [_fit(whole, whole, omega, lag) for lag in lags]
    best = int(np.argmax([np.nansum(fit.coherent) for fit in fits]))
    without = [_fit(whole - block, whole, omega, lags[best]) for block in blocks]
    turning, delays = (Measured.of(fits[best][i], np.array([fit[i] for fit in without])) for i in (0, 1))
    return Response(turning, delays, fits[best].coherent, lags[best])


def _segments(piece: Recording, airframe: Airframe, step: float) -> list[Complex[np.ndarray, "6 frequencies"]]:
    """Spectra of roll and pitch torque, thrust per mass, roll and pitch rate and vertical force, by segment.

    Thrust and force are 0 in a segment in which the force was not measured.
    """
    time, omega, sensed = averages(piece.time, piece.omega, piece.channels[:, _SENSED], held=piece.held)(step)
    for column in sensed.T:
        if np.isfinite(column).sum() > 1:
            column[:] = interpolated(time, time, column, gap=_GAP)
    mixer = np.asarray(airframe.mixer, dtype=float)[[0, 1, 3]]
    forced = omega**2 @ mixer.T / [1.0, 1.0, float(airframe.mass)]
    signals, length = np.hstack([forced, sensed]).T, round(_SEGMENT / step)
    found, window = [], np.hanning(length)
    for begin in range(0, time.size - length, length // 2):
        part = signals[:, begin : begin + length]
        spectra = np.fft.rfft(window * (part - part.mean(axis=1, keepdims=True)))
        if np.isnan(spectra[5]).any():
            spectra[[2, 5]] = 0.0
        if np.isfinite(spectra).all():
            found.append(spectra)
    return found


def _fit(products: Products, all_products: Products, omega: Complex[np.ndarray, " frequencies"], lag: float) -> _Fit:
    """Gains and delays by least squares, for rotors with this lag [s].

    Outputs weigh by their power in the whole flight, `all_products`.
    """
    lagged = 1 / (1 + omega * lag)
    late = np.exp(-omega * _DELAYS[:, None]).conj()
    power = np.real(np.diagonal(all_products, axis1=1, axis2=2))
    turning, delays, coherent = np.full((2, 2), np.nan), np.full(3, np.nan), np.full(3, np.nan)
    for place, rows in enumerate((_ROLL_PITCH, _VERTICAL)):
        outputs = slice(3 + rows.start, 3 + rows.stop)
        inverse = 1 / np.maximum(power[:, outputs], 1e-300)
        inputs = np.real(products[:, rows, rows]) * np.square(np.abs(lagged))[:, None, None]
        forced = np.einsum("fij,fo->oij", inputs, inverse)
        both = np.real(
            np.einsum("df,fio->doi", late, products[:, rows, outputs] * lagged.conj()[:, None, None] * inverse[:, None])
        )
        total = np.einsum("foo,fo->o", np.real(products[:, outputs, outputs]), inverse)
        if (total <= 0).any() or np.linalg.cond(forced).max() > 1e12:
            continue
        gains = np.linalg.solve(forced, both[..., None])[..., 0]
        shares = (gains * both).sum(axis=2) / total
        best = int(np.clip(np.argmax(shares.sum(axis=1)), 1, _DELAYS.size - 2))
        delays[place] = _DELAYS[best] + peak(shares.sum(axis=1), best) * (_DELAYS[1] - _DELAYS[0])
        coherent[rows] = shares[best]
        if rows is _ROLL_PITCH:
            turning = gains[best]
    delays[2] = delays[0] - delays[1]
    return _Fit(turning, delays, coherent)
