"""A check of a fit without parameters: the frequency response from modelled to measured angular acceleration."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Parameters, as_float
from ..flight import RATES
from ..models.state import Rates
from ..results import NINETY_FIVE
from ..shooting import ShootingProblem

# Length of a segment [s]: its inverse is the resolution in frequency [Hz].
_SEGMENT = 1.0
# With fewer averages there are no errors.
_FEWEST = 4
# The band in which the model is compared [Hz], and the smallest coherence there. Below, the flight controller's answer
# to disturbances looks like the vehicle's answer to torque. Above, few vehicles move.
_LOW, _HIGH, _COHERENT = 4.0, 20.0, 0.6
_BOUNDLESS = 700.0  # a logarithm whose factor is still a number
# The coherence is averaged over this many frequencies on either side.
_AROUND = 2
# Segments overlap by half: the correlation of their spectra, and that of frequencies 0, 1, 2 steps apart (Hann window).
_OVERLAP, _NEIGHBOURS = 1 / 6, (1.0, 4 / 9, 1 / 36)


class Agreement(NamedTuple):
    """The measured response divided by the model's: its geometric mean over frequencies with a clear response.

    Each frequency weighs as much as the coherence around it.

    - `ratio`: 1 if the model is right, 2 if the vehicle answers twice as strongly as the model says. NaN: no part of
      the band has a coherence above 0.6.
    - `error`: standard deviation of the ratio's logarithm.
    - `low`, `high`: the first and the last frequency that counted [Hz].
    """

    ratio: float
    error: float
    low: float
    high: float

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval of the ratio."""
        factor = math.exp(min(NINETY_FIVE * self.error, _BOUNDLESS))
        return self.ratio / factor, self.ratio * factor


class AxisResponse(NamedTuple):
    """The frequency response of one axis. A model that is right has gain 1 and phase 0.

    - `frequency`: [Hz].
    - `gain`: measured over modelled angular acceleration.
    - `phase`: of the measured before the modelled one [rad]. A measured response that comes late has a negative phase.
    - `coherence`: the share of the measured response that depends linearly on the modelled one, 0 to 1.
    - `error`: standard deviation of the gain's logarithm, and of the phase [rad].
    - `half_width`: of the 95 % interval of the gain, as a share of the gain, and of the phase [rad].
    - `averages`: how many independent segments of the flight were averaged.
    """

    frequency: Float[np.ndarray, " frequencies"]
    gain: Float[np.ndarray, " frequencies"]
    phase: Float[np.ndarray, " frequencies"]
    coherence: Float[np.ndarray, " frequencies"]
    error: Float[np.ndarray, " frequencies"]
    half_width: Float[np.ndarray, " frequencies"]
    averages: float

    def agreement(self, low: float = _LOW, high: float = _HIGH) -> Agreement:
        """How strongly the vehicle answers compared with the model, from `low` to `high` [Hz]."""
        clear = self.clear & np.isfinite(self.error) & (self.frequency >= low) & (self.frequency <= high)
        if not clear.any():
            return Agreement(*[math.nan] * 4)
        frequency, error = self.frequency[clear], self.error[clear]
        apart = np.rint(np.abs(frequency[:, None] - frequency) / self.frequency[0]).astype(int)
        correlation = np.append(_NEIGHBOURS, 0.0)[np.minimum(apart, len(_NEIGHBOURS))]
        # Not the frequency's own coherence: by chance, a gain that is too large comes with one that is too large.
        weight = self._smoothed[clear] / self._smoothed[clear].sum()
        ratio = math.exp(weight @ np.log(self.gain[clear]))
        deviation = math.sqrt((weight * error) @ correlation @ (weight * error))
        return Agreement(ratio, deviation, float(frequency[0]), float(frequency[-1]))

    @property
    def clear(self) -> Bool[np.ndarray, " frequencies"]:
        """Where the coherence exceeds 0.6, as the mean over five frequencies: one can pass by chance."""
        return np.isfinite(self.coherence) & (self._smoothed > _COHERENT)

    @property
    def _smoothed(self) -> Float[np.ndarray, " frequencies"]:
        """The mean coherence of five frequencies."""
        kernel, known = np.ones(2 * _AROUND + 1), np.isfinite(self.coherence)
        total, count = (np.convolve(x, kernel)[_AROUND:-_AROUND] for x in (np.where(known, self.coherence, 0.0), known))
        return total / np.maximum(count, 1)


class FrequencyResponse(NamedTuple):
    """The frequency response of each axis, from modelled to measured angular acceleration."""

    roll: AxisResponse
    pitch: AxisResponse
    yaw: AxisResponse


def frequency_response(problem: ShootingProblem, parameters: Parameters) -> FrequencyResponse:
    """The frequency response from the angular acceleration that the rotors cause in the model to the measured one.

    The input is the model's p', q', r' from the rotor speeds, at rates of 0. The output is the difference of measured
    rates over the sample time, less what the model says about these rates: in the input, that would bring the gyro's
    noise to both sides. Spectra are averaged over segments of 1 s that overlap by half (Welch 1967), in all stretches
    in which p, q and r were measured.

    **In closed loop** the response is biased where disturbances dominate: at low frequencies the flight controller
    answers a disturbance by torque against it, and at high ones it feeds back gyro noise. The vehicle then seems to
    answer torque too weakly, with high coherence. Therefore `agreement` begins at 4 Hz. A fit of the same flight can
    have the same bias: a ratio other than 1 shows that the model is wrong, a ratio of 1 does not show that it is right.

    **Arguments:** a problem, and the parameters of a fit.

    Errors are those of Gaussian signals with this coherence (Bendat and Piersol, Random Data, section 9.2).
    """
    rates = np.asarray(problem.flight.states)[:, RATES]
    dt = float(problem.flight.dt)
    known = ~np.isnan(rates.sum(axis=1))
    modelled = modelled_acceleration(problem, parameters)
    caused = np.asarray(_modelled(problem, as_float(parameters), as_float(np.zeros(rates.shape))))
    measured = np.diff(rates, axis=0) / dt - (modelled - caused)
    usable = known[1:] & known[:-1] & np.isfinite(modelled).all(axis=1)
    if problem.flight.stretch is not None:
        usable &= np.diff(np.asarray(problem.flight.stretch)) == 0
    length = max(round(_SEGMENT / dt / 2) * 2, 8)
    # As many segments as fit into each usable run of samples, overlapping by half.
    runs = np.flatnonzero(np.diff(np.concatenate([[0], usable.astype(np.int8), [0]]))).reshape(-1, 2).tolist()
    begins = [at for begin, end in runs for at in range(begin, end - length + 1, length // 2)]
    return FrequencyResponse(*(response(caused[:, i], measured[:, i], begins, length, dt) for i in range(3)))


def modelled_acceleration(problem: ShootingProblem, parameters: Parameters) -> Float[np.ndarray, "steps 3"]:
    """The model's angular acceleration from each sample to the next at the measured rates [rad/s^2].

    A rate that was not measured counts as 0.
    """
    rates = np.asarray(problem.flight.states)[:, RATES]
    known = ~np.isnan(rates.sum(axis=1))
    return np.asarray(_modelled(problem, as_float(parameters), as_float(np.where(known[:, None], rates, 0.0))))


@eqx.filter_jit
def _modelled(
    problem: ShootingProblem, parameters: Parameters, rates: Float[Array, "samples 3"]
) -> Float[Array, "steps 3"]:
    """The model's angular acceleration from each sample to the next, at the mean of their rates [rad/s^2]."""
    forcing = jax.tree.map(lambda leaf: leaf[:-1], problem.forcing(parameters))
    middle = Rates(*((rates[1:] + rates[:-1]) / 2).T)
    return jnp.stack(problem.model.angular_acceleration(middle, forcing, tuple(parameters)), axis=1)


def response(
    u: Float[np.ndarray, " samples"], y: Float[np.ndarray, " samples"], begins: Sequence[int], length: int, dt: float
) -> AxisResponse:
    """The frequency response from u to y, averaged over segments of `length` samples from `begins` on.

    **Arguments:** signals with one sample every `dt` [s], and segments that overlap by half.
    """
    from scipy.special import stdtrit  # slow to import

    window = np.sin(np.pi * (np.arange(length) + 0.5) / length) ** 2
    rows = np.asarray(begins, dtype=int)[:, None] + np.arange(length)
    parts = (x[rows] - x[rows].mean(axis=1, keepdims=True) for x in (u, y))
    # Neither the mean nor the Nyquist frequency.
    a, b = (np.fft.rfft(window * part)[:, 1 : length // 2] for part in parts)
    uu, yy, uy = (x.sum(axis=0) for x in (np.abs(a) ** 2, np.abs(b) ** 2, a.conj() * b))
    averages = len(begins) / (1 + 2 * _OVERLAP**2)
    freedom = 2 * (averages - 1) if averages >= _FEWEST else math.nan
    with np.errstate(all="ignore"):
        found = uy / uu
        coherence = np.minimum(np.abs(uy) ** 2 / (uu * yy), 1.0)
        error = np.sqrt((1 - coherence) / (coherence * freedom))
    half_width = float(stdtrit(freedom, 0.975)) * error
    frequency = np.arange(1, length // 2) / (length * dt)
    return AxisResponse(frequency, np.abs(found), np.angle(found), coherence, error, half_width, averages)
