"""The response of gyro and accelerometer to the rotors: gains, axes and delays.

Because a controller answers gusts, a cross-spectrum of torque and turns shows the controller as well as the vehicle: in
gentle flight, a gyro seems 6 to 14 ms late. Errors of predictions from the past have no such bias, because no
controller has answered them yet. All delays of the gyro are tried, and the one with the smallest errors is taken.
Nothing answers the vertical force as fast, so a cross-spectrum shows the delay of the accelerometer. Both models
include damping or inflow, which shift the phase like a delay.

Reference: Ljung 1999, System Identification, ch. 13, the direct method in closed loop.
"""

import math
from collections.abc import Sequence

import msgspec
import numpy as np
from jaxtyping import Complex, Float, Int

from ...airframe import Airframe
from ...flight import RATES
from ...logs import Recording
from ..motion import velocity_of
from ..sensor_errors import spectra
from ..windows import averaged
from .estimates import BATCHES, Measured, interpolated, jackknife, peak

Signals = Float[np.ndarray, "samples _signals"]

STEP = 0.012  # s; samples of the gyro; shorter ones would show only the start of a filter's response
LONGEST = 0.034  # s; the longest step
ORDER = 5  # samples; the memory of the noise model
LAGS = 0.01, 0.02, 0.03, 0.04, 0.05, 0.065, 0.08, 0.1  # s; candidates for rotors that follow commands
DELAYS = -0.12, 0.12  # s; the range that is tried for gyro and accelerometer
PREDICTIONS = 20_000  # more are not needed
PASSES = 4  # of the fit of gains and of the noise model in turn
FORCE_STEP = 0.004  # s; samples of the accelerometer
SPECTRUM = 2.0  # s; duration of the samples of one spectrum
BAND = 2.0, 15.0  # Hz; below are wind and height control; above, the rotors' lag and the gyro's noise leave little
FORGETS = 2.0  # s; angle and velocity, on which damping and inflow act, are forgotten with this time constant
GAP = 0.05  # s; the longest gap that is interpolated
SECONDS = 6.0  # s; the shortest flight whose response is measured


class Response(msgspec.Struct, frozen=True):
    """The answer of roll and pitch acceleration and vertical force to the rotors.

    - `turning`: the matrix from roll and pitch torque to roll and pitch acceleration [1/(kg m^2)].
    - `delays`: the delays of gyro and accelerometer after the rotors, and of the gyro after the accelerometer [s].
    - `explained`: the shares that the rotors explain: of the squared errors with which roll and pitch rate are
      predicted, and of the power of the vertical force. NaN: not measured.
    - `lag`: lag of the rotors [s]; 0 if their speeds were measured.

    The first two are `Measured`: values, and standard errors.
    """

    turning: Float[np.ndarray, "2 2 2"]
    delays: Float[np.ndarray, "2 3"]
    explained: Float[np.ndarray, "3"]
    lag: float


def rotor_response(stretches: Sequence[Recording], airframe: Airframe) -> Response | None:
    """Compare gyro and accelerometer with the rotors. `None`: the flight is too short, too slow, or has no gyro."""
    if sum(float(np.ptp(each.time)) for each in stretches) < SECONDS:
        return None
    step = max(each.dt for each in stretches)
    if step > LONGEST:
        return None
    lags = LAGS if stretches[0].commanded else (0.0,)
    flown = [averaged(each, [max(STEP, step)])[0] for each in stretches]
    turns = {lag: _products([_turns(each, airframe, lag) for each in flown], flown[0].dt) for lag in lags}
    answers = {lag: _answer(products.sum(axis=0), flown[0].dt) for lag, products in turns.items()}
    lag = max(lags, key=lambda lag: float(-np.log1p(-np.nan_to_num(answers[lag][2])).sum()))
    if np.isnan(answers[lag][1]):
        return None
    found = jackknife(turns[lag], lambda products: np.append(*_answer(products, flown[0].dt)[:2]))
    turning, late = found[:, :4].reshape(2, 2, 2), found[:, 4:]
    felt, share = _felt([averaged(each, [max(FORCE_STEP, step)])[0] for each in stretches], airframe, lag)
    (gyro, gyro_error), (force, force_error) = late, felt
    between = np.stack([gyro - force, np.hypot(gyro_error, force_error)])
    return Response(turning, np.hstack([late, felt, between]), np.append(answers[lag][2], share), lag)


def _delays(step: float) -> tuple[int, int]:
    """The first and the last delay that are tried, in samples of this step [s]."""
    return round(DELAYS[0] / step), round(DELAYS[1] / step)


def _products(every: Sequence[np.ndarray], step: float) -> Float[np.ndarray, "batches columns columns"]:
    """Sums of products of `_lagged` signals in batches."""
    thin = max(sum(len(each) for each in every) // PREDICTIONS, 1)
    table = np.concatenate([_lagged(each, *_delays(step))[::thin] for each in every])
    return np.array([batch.T @ batch for batch in np.array_split(table, BATCHES)])


def _lagged(signals: Signals, first: int, last: int) -> Float[np.ndarray, "rows columns"]:
    """Complete rows of rates and slow motions, now and before; and of torques at all delays, and before.

    A rate depends on the integrals of both torques, and on its slow motion, which has no delay.
    """
    spans = [(0, ORDER)] * 4 + [(first, last + ORDER)] * 2
    signals = signals - np.nan_to_num(signals).sum(axis=0) / np.maximum(np.isfinite(signals).sum(axis=0), 1)
    rows = np.arange(last + ORDER, len(signals) + first)
    columns = [x[rows[:, None] - np.arange(a, b + 1)] for x, (a, b) in zip(signals.T, spans, strict=True)]
    table = np.hstack(columns)
    return table[np.isfinite(table).all(axis=1)]


def _places(shifts: int) -> Int[np.ndarray, "delays rates signals past"]:
    """By delay and rate: the columns of `_lagged` that hold it, both torques at this delay, and its slow motion."""
    past = np.arange(ORDER + 1)
    torques = 4 * past.size + (past.size + shifts - 1) * np.arange(2)[:, None] + past
    every = [
        [[past.size * i + past, *(torques + shift), past.size * (2 + i) + past] for i in range(2)]
        for shift in range(shifts)
    ]
    return np.array(every)


def _answer(
    products: Float[np.ndarray, "columns columns"], step: float
) -> tuple[Float[np.ndarray, "4"], float, Float[np.ndarray, "2"]]:
    """The gains from torques to rates, their delay [s], and the explained shares; NaN: not measured.

    Errors are those of predicting the rates, minus inputs times gains, from their past.
    """
    if not products.any():
        return np.full(4, np.nan), math.nan, np.full(2, np.nan)
    first, last = _delays(step)
    places = _places(last - first + 1)
    size = np.sqrt(np.maximum(np.diagonal(products)[places[..., 0]], 1e-300))  # of each signal
    sums = products[places[..., :, None, :, None], places[..., None, :, None, :]]
    sums = sums / (size[..., :, None] * size[..., None, :])[..., None, None]
    noise = np.zeros(places.shape[:2] + places.shape[3:])
    noise[..., 0], noise[..., 1] = 1.0, -1.0  # unknown torques add up in the rates
    alone, _ = _predicted(np.eye(size.shape[2])[0] + np.zeros(size.shape), sums)
    weights, squares = np.zeros(size.shape), alone
    for _ in range(PASSES):
        weights = _least(np.einsum("koi,koabi->koab", noise, np.einsum("koj,koabij->koabi", noise, sums)))
        squares, noise = _predicted(weights, sums)
    shares = np.where(alone > 0, 1 - squares / np.maximum(alone, 1e-300), 0.0)
    gains = (-weights * size[..., :1] / size)[..., 1:3]
    # A controller's torque opposes the motion, so the motion before it seems to answer with the opposite sign.
    along, across = np.trace(gains, axis1=1, axis2=2), np.abs(gains[:, 0, 1] - gains[:, 1, 0])
    best, after = peak(np.where(along > -across, -np.log1p(-shares).sum(axis=1), 0.0))
    return gains[best].ravel(), (first + best + after) * step, shares[best]


def _predicted(weights: np.ndarray, sums: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The squared errors of a prediction of weighted signals from their past, and its coefficients."""
    residual = np.einsum("koa,koaij->koij", weights, np.einsum("kob,koabij->koaij", weights, sums))
    noise = _least(residual)
    return np.einsum("koi,koi->ko", noise, np.einsum("koij,koj->koi", residual, noise)), noise


def _least(sums: Float[np.ndarray, "*some n n"]) -> Float[np.ndarray, "*some n"]:
    """The weights with the least sum of squares; the first weight is 1."""
    ridge = 1e-12 * np.trace(sums, axis1=-2, axis2=-1)[..., None, None] + 1e-300
    others = np.linalg.solve(sums[..., 1:, 1:] + ridge * np.eye(sums.shape[-1] - 1), sums[..., 1:, :1])[..., 0]
    return np.concatenate([np.ones_like(others[..., :1]), -others], axis=-1)


def _turns(flown: Recording, airframe: Airframe, lag: float) -> Signals:
    """Roll and pitch rate, their slow motion, and the integrals of roll and pitch torque of rotors with this lag."""
    rates, many = flown.states[:, RATES[:2]], np.asarray(flown.within).shape[1]
    rates = np.column_stack([interpolated(flown.time, flown.time, x, gap=GAP) for x in rates.T])
    angles = flown.dt * _forgetting(np.nan_to_num(rates), flown.dt / FORGETS)
    torques = _forced(flown, airframe, lag)[:, :2]
    turned = flown.dt / many * np.cumsum(torques, axis=0)[many // 2 - 1 :: many]
    return np.hstack([rates, np.vstack([angles[:1], angles[:-1]]), turned])


def _forced(flown: Recording, airframe: Airframe, lag: float) -> Float[np.ndarray, "parts 3"]:
    """Roll and pitch torque, and thrust per mass, in the parts of samples; of rotors with this lag [s]."""
    parts = np.asarray(flown.within)
    mixer = np.asarray(airframe.mixer, dtype=float)[[0, 1, 3]]
    forced = np.square(parts).reshape(-1, 4) @ mixer.T / [1.0, 1.0, float(airframe.mass)]
    forced -= forced.mean(axis=0)
    share = flown.dt / parts.shape[1] / lag if lag else math.inf
    return -math.expm1(-share) * _forgetting(forced, share) if lag else forced


def _forgetting(values: Signals, share: float) -> Signals:
    """The running sum of the values, which is multiplied by exp(-`share`) from each sample to the next."""
    kept = np.exp(-share * np.arange(min(math.ceil(20 / share), len(values))))[:, None]
    size = 1 << (len(values) + len(kept)).bit_length()
    spectrum = np.fft.rfft(values, size, axis=0) * np.fft.rfft(kept, size, axis=0)
    return np.fft.irfft(spectrum, size, axis=0)[: len(values)]


def _felt(flown: Sequence[Recording], airframe: Airframe, lag: float) -> tuple[Measured, float]:
    """The delay of the accelerometer after the rotors [s], and the share of the vertical force that they explain."""
    unknown = np.full((2, 1), np.nan), math.nan
    step, (low, high) = flown[0].dt, BAND
    every = [each for one in flown for each in _spectra(one, airframe, lag)]
    if len(every) < 2:
        return unknown
    frequency = np.fft.rfftfreq(2 * len(every[0][0]) - 2, step)
    inside = (frequency >= low) & (frequency <= min(high, 0.5 / step))
    groups = np.array_split(np.array(every)[..., inside], min(BATCHES, len(every)))
    sums = np.array([np.einsum("sif,sjf->fij", group.conj(), group) for group in groups])
    power = np.real(sums.sum(axis=0)[:, 2, 2])
    if not (power > 0).all():
        return unknown
    delays = 1e-3 * np.arange(round(1e3 * DELAYS[0]), round(1e3 * DELAYS[1]) + 1)
    late = np.exp(-2j * np.pi * frequency[inside] * delays[:, None])

    def shares(products: Complex[np.ndarray, "frequencies 3 3"]) -> Float[np.ndarray, " delays"]:
        thrust, falls, force = np.moveaxis(products / power[:, None, None], 1, 0)
        moved = np.real(falls[:, 1]).sum()
        both, across = (np.real(late.conj() @ thrust[:, i]) for i in (2, 1))
        # Inflow: a force that is proportional to the vertical velocity, at the time of the force.
        left = np.real(thrust[:, 0]).sum() - across**2 / moved
        inflow = np.real(falls[:, 2]).sum()
        gain = (both - across * inflow / moved) / left
        return np.where(gain > 0, gain**2 * left, 0.0) / np.real(force[:, 2]).sum()

    def fit(products: Complex[np.ndarray, "frequencies 3 3"]) -> Float[np.ndarray, "1"]:
        best, after = peak(shares(products))
        return np.array([delays[best] + 1e-3 * after])

    return jackknife(sums, fit), float(shares(sums.sum(axis=0)).max())


def _spectra(flown: Recording, airframe: Airframe, lag: float) -> list[Complex[np.ndarray, "3 frequencies"]]:
    """Spectra of thrust per mass, vertical velocity and vertical force, where all were measured."""
    moved = velocity_of(flown, forgets=FORGETS)
    if moved is None or flown.specific_force is None:
        return []
    thrust = _forced(flown, airframe, lag)[:, 2].reshape(len(flown.time), -1).mean(axis=1)
    force = interpolated(flown.time, flown.time, flown.specific_force[:, 2], gap=GAP)
    signals = np.column_stack([thrust, moved[0][:, 2], force])
    return [each for each in spectra(signals, round(SPECTRUM / flown.dt)) if np.isfinite(each).all()]
