"""The response of gyro and accelerometer to the rotors: gains, axes and delays, by cross-spectra."""

from collections.abc import Sequence
from typing import NamedTuple

import msgspec
import numpy as np
from jaxtyping import Complex, Float

from ...airframe import Airframe
from ...flight import CHANNEL_NAMES
from ...logs import Recording
from ...logs.sampling import averages
from .estimates import BATCHES, Measured, interpolated, peak

_SENSED = [CHANNEL_NAMES.index(name) for name in ("p", "q", "az")]
_ROLL_PITCH, _VERTICAL = slice(0, 2), slice(2, 3)

Products = Complex[np.ndarray, "frequencies 6 6"]


class Spectra(NamedTuple):
    """Settings with which the response to the rotors is measured.

    - `step`, `seconds`: of the samples, and how long those of one spectrum last [s].
    - `gap`: the longest that is interpolated [s].
    - `band`: [Hz]; gusts are slower; rotors, and noise of the gyro, leave little above.
    - `lags`: of rotors that follow commands, of which one is chosen [s].
    - `delays`: first and last, in steps of 1 ms [s].
    - `fewest`: spectra; fewer have no standard error.
    """

    step: float = 0.004
    seconds: float = 2.0
    gap: float = 0.05
    band: tuple[float, float] = (2.0, 15.0)
    lags: tuple[float, ...] = (0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1)
    delays: tuple[float, float] = (-0.15, 0.18)
    fewest: int = 6


SPECTRA = Spectra()


class Response(msgspec.Struct, frozen=True):
    """The answer of roll and pitch acceleration and vertical force to the rotors.

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


def rotor_response(stretches: Sequence[Recording], airframe: Airframe, settings: Spectra = SPECTRA) -> Response | None:
    """Compare gyro and accelerometer with the rotors. `None`: the flight is too short, too slow, or has no gyro."""
    step = max(settings.step, *(each.dt for each in stretches))
    if step > 0.5 / settings.band[1]:
        return None
    spectra = [each for flown in stretches for each in _spectra(flown, airframe, step, settings)]
    if len(spectra) < settings.fewest:
        return None
    frequency = np.fft.rfftfreq(round(settings.seconds / step), step)
    inside = (frequency >= settings.band[0]) & (frequency <= settings.band[1])
    omega = 2j * np.pi * frequency[inside]
    # Rotor speeds are those of the step after their time. Angular accelerations are the derivatives of rates.
    factors = np.stack([np.exp(-omega * step / 2)] * 3 + [omega, omega, np.ones_like(omega)])
    groups = np.array_split(np.array(spectra)[:, :, inside] * factors, min(BATCHES, len(spectra)))
    sums = np.array([np.einsum("sif,sjf->fij", group.conj(), group) for group in groups])
    whole = sums.sum(axis=0)
    first, last = settings.delays
    delays = 1e-3 * np.arange(round(1e3 * first), round(1e3 * last) + 1)
    lags = settings.lags if stretches[0].commanded else (0.0,)
    best = max(lags, key=lambda lag: np.nansum(_fit(whole, whole, omega, lag, delays)[2]))

    def fit(products: Products) -> Float[np.ndarray, "7"]:
        turning, late, _ = _fit(products, whole, omega, best, delays)
        return np.append(turning, late)

    found = Measured.of(sums, fit)
    turning = Measured(found.value[:4].reshape(2, 2), found.error[:4].reshape(2, 2))
    return Response(turning, found[4:], _fit(whole, whole, omega, best, delays)[2], best)


def _spectra(
    flown: Recording, airframe: Airframe, step: float, settings: Spectra
) -> list[Complex[np.ndarray, "6 frequencies"]]:
    """Spectra of roll and pitch torque, thrust per mass, roll and pitch rate and vertical force.

    Thrust and force are 0 if the force was not measured.
    """
    time, omega, sensed = averages(flown.time, flown.omega, flown.channels[:, _SENSED], held=flown.held)(step)
    for column in sensed.T:
        if np.isfinite(column).sum() > 1:
            column[:] = interpolated(time, time, column, gap=settings.gap)
    mixer = np.asarray(airframe.mixer, dtype=float)[[0, 1, 3]]
    forced = omega**2 @ mixer.T / [1.0, 1.0, float(airframe.mass)]
    signals, length = np.hstack([forced, sensed]).T, round(settings.seconds / step)
    found, weight = [], np.hanning(length)
    for begin in range(0, time.size - length, length // 2):
        own = signals[:, begin : begin + length]
        spectra = np.fft.rfft(weight * (own - own.mean(axis=1, keepdims=True)))
        if np.isnan(spectra[5]).any():
            spectra[[2, 5]] = 0.0
        if np.isfinite(spectra).all():
            found.append(spectra)
    return found


def _fit(
    products: Products,
    all_products: Products,
    omega: Complex[np.ndarray, " frequencies"],
    lag: float,
    delays: Float[np.ndarray, " delays"],
) -> tuple[Float[np.ndarray, "2 2"], Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
    """Gains, delays and coherent shares by least squares, for rotors with this lag [s].

    Outputs weigh by their power in the whole flight, `all_products`.
    """
    lagged = 1 / (1 + omega * lag)
    late = np.exp(-omega * delays[:, None]).conj()
    power = np.real(np.diagonal(all_products, axis1=1, axis2=2))
    turning, found, coherent = np.full((2, 2), np.nan), np.full(3, np.nan), np.full(3, np.nan)
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
        best, after = peak(shares.sum(axis=1))
        found[place] = delays[best] + after * (delays[1] - delays[0])
        coherent[rows] = shares[best]
        if rows is _ROLL_PITCH:
            turning = gains[best]
    found[2] = found[0] - found[1]
    return turning, found, coherent
