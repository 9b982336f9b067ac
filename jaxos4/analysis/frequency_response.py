"""A check of a fit without parameters: the frequency response from modelled to measured angular acceleration."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import jax
import jax.numpy as jnp
import msgspec
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Arrays, Parameters, as_float
from .._xla import compiled_cheaply
from ..flight import RATES
from ..models.state import Forcing, Rates
from ..results import NINETY_FIVE
from ..shooting import ShootingProblem

# Of the regression, as a share of the sum of squares.
_RIDGE = 1e-13
_BOUNDLESS = 700.0  # a logarithm whose factor is still a number


LOW, HIGH = 4.0, 20.0  # Hz; the band in which the model is compared
HIGHEST = 40.0  # Hz; few vehicles move faster
UNCLEAR = 0.5  # a gain does not count if its standard deviation exceeds this share of the model's


class Agreement(NamedTuple):
    """The measured response divided by the model's: its geometric mean over frequencies with a clear response.

    Each frequency weighs as much as is known about the response there.

    - `ratio`: 1 if the model is right, 2 if the vehicle responds twice as strongly as the model says. NaN: no part
      of the band has a clear response.
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

    def excludes_one(self, share: float) -> bool:
        """Whether the interval is beyond 1 by more than this share."""
        low, high = self.interval
        return low > 1 + share or high < 1 - share


class AxisResponse(Arrays, frozen=True, eq=False):
    """The frequency response of one axis. A model that is right has gain 1 and phase 0.

    - `frequency`: [Hz].
    - `gain`: measured over modelled angular acceleration.
    - `phase`: lead of the measured over the modelled acceleration [rad]: negative if the vehicle responds late.
    - `coherence`: the power of the modelled acceleration, as a share of itself and the disturbance's, 0 to 1. It does
      not depend on the gain.
    - `covariance`: covariance of the gain's logarithm between frequencies.
    - `averages`: how many seconds were compared, over the inverse of the resolution in frequency.
    """

    frequency: Float[np.ndarray, " frequencies"]
    gain: Float[np.ndarray, " frequencies"]
    phase: Float[np.ndarray, " frequencies"]
    coherence: Float[np.ndarray, " frequencies"]
    covariance: Float[np.ndarray, "frequencies frequencies"]
    averages: float

    def agreement(self, low: float = LOW, high: float = HIGH) -> Agreement:
        """How strongly the vehicle responds compared with the model, from `low` to `high` [Hz]."""
        clear = self.clear & (self.frequency >= low) & (self.frequency <= high)
        if not clear.any():
            return Agreement(*[math.nan] * 4)
        frequency, gain = self.frequency[clear], self.gain[clear]
        # By the error of the gain and not of its logarithm: that would prefer gains that are too large by chance.
        weight = 1 / np.square(gain * self.error[clear])
        weight /= weight.sum()
        deviation = math.sqrt(weight @ self.covariance[np.ix_(clear, clear)] @ weight)
        return Agreement(math.exp(weight @ np.log(gain)), deviation, float(frequency[0]), float(frequency[-1]))

    def rounded(self, digits: int = 4) -> "AxisResponse":
        """The same with this many significant digits, which is what files keep."""
        arrays = {name: each for name, each in msgspec.structs.asdict(self).items() if name != "averages"}
        return msgspec.structs.replace(self, **{name: significant(each, digits) for name, each in arrays.items()})

    @property
    def error(self) -> Float[np.ndarray, " frequencies"]:
        """Standard deviation of the gain's logarithm, and approximately of the phase [rad]."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def half_width(self) -> Float[np.ndarray, " frequencies"]:
        """Half of the 95 % interval of the gain, as a share of the gain, and of the phase [rad]."""
        return NINETY_FIVE * self.error

    @property
    def clear(self) -> Bool[np.ndarray, " frequencies"]:
        """Whether the standard deviation of the gain at each frequency is below half of the model's gain."""
        return self.gain * self.error < UNCLEAR


class FrequencyResponse(msgspec.Struct, frozen=True, eq=False):
    """The frequency response of each axis, from modelled to measured angular acceleration."""

    roll: AxisResponse
    pitch: AxisResponse
    yaw: AxisResponse

    def __iter__(self) -> Iterator[AxisResponse]:
        """Roll, pitch and yaw."""
        return iter((self.roll, self.pitch, self.yaw))


def frequency_response(problem: ShootingProblem, parameters: Parameters) -> FrequencyResponse:
    """The frequency response from the angular acceleration that the rotors cause in the model to the measured one.

    The input is the model's p', q', r' from the rotor speeds, at rates of 0. The output is the difference of measured
    rates over the sample time, less what the model says about these rates: in the input, that would bring the gyro's
    noise to both sides. If the rates are means, the input is averaged over the same times.

    The flight controller responds to disturbances, so in a ratio of spectra the vehicle seems to respond 25 to 40 % too
    strongly. Here the output is predicted from the past (`response`): what remains of it is new, so that no controller
    has responded to it yet. A fit of the same flight has been compared with these data: a ratio other than 1 shows that
    the model is wrong, a ratio of 1 does not show that it is right.

    **Arguments:** a problem, and the parameters of a fit.
    """
    rates = np.asarray(problem.flight.states)[:, RATES]
    dt = float(problem.flight.dt)
    known = ~np.isnan(rates.sum(axis=1))
    caused, damped = map(np.asarray, _parts(problem, as_float(parameters)))
    measured = np.diff(rates, axis=0) / dt - damped
    usable = known[1:] & known[:-1] & np.isfinite(caused).all(axis=1)
    if problem.flight.stretch is not None:
        usable &= np.diff(np.asarray(problem.flight.stretch)) == 0
    return FrequencyResponse(*(response(caused[:, i], measured[:, i], usable, dt).rounded() for i in range(3)))


def significant(values: Float[np.ndarray, "..."], digits: int) -> Float[np.ndarray, "..."]:
    """Numbers with this many significant digits."""
    return np.array([float(f"{x:.{digits - 1}e}") for x in values.ravel()]).reshape(values.shape)


@compiled_cheaply
def modelled_acceleration(problem: ShootingProblem, parameters: Parameters) -> Float[Array, "steps 3"]:
    """The model's angular acceleration from each sample to the next, at the mean of their measured rates [rad/s^2]."""
    rates = _measured_rates(problem)
    forcing = jax.tree.map(lambda leaf: leaf[:-1], problem.forcing(parameters))
    middle = Rates(*((rates[1:] + rates[:-1]) / 2).T)
    return jnp.stack(problem.model.angular_acceleration(middle, forcing, tuple(parameters)), axis=1)


def _measured_rates(problem: ShootingProblem) -> Float[Array, "samples 3"]:
    """The measured rates, and 0 in a sample that lacks one."""
    rates = jnp.asarray(problem.flight.states)[:, RATES]
    return jnp.where(jnp.isnan(rates).any(axis=1, keepdims=True), 0.0, rates)


@compiled_cheaply
def _parts(problem: ShootingProblem, parameters: Parameters) -> tuple[Float[Array, "steps 3"], Float[Array, "steps 3"]]:
    """The model's change of the measured rates over each step [rad/s^2]: by the rotors, and by the rates."""
    rates, forcing = _measured_rates(problem), problem.model.centered_forcing(problem.flight.inputs, parameters)

    def at(rates: Array, forcing: Forcing) -> Array:
        return jnp.stack(problem.model.angular_acceleration(Rates(*rates.T), forcing, tuple(parameters)), axis=1)

    caused, still = at(jnp.zeros_like(rates), forcing)[:-1], jnp.zeros_like(rates)
    middle, begins = (rates[1:] + rates[:-1]) / 2, jax.tree.map(lambda leaf: leaf[:-1], forcing)
    by_rates = at(middle, begins) - caused
    if forcing.early is not None:  # the mean over a sample lacks what the torque makes at its end
        early = at(still, forcing.early._replace(recording=forcing.recording, velocity=forcing.velocity))
        caused += (early[1:] - early[:-1]) / 2
    return caused, by_rates


RESOLUTION = 1.0  # Hz; between frequencies
MEMORY = 0.1  # s; as long as the flight controller's response. A longer one finds the same, less precisely.
MIN_LAGS = 4  # samples of a memory
REACTION = 0.016  # s; for this long, rotors and controller show what the controller knows and the log does not
SAMPLES = 8  # for each coefficient of the regression, at the least


def response(
    u: Float[np.ndarray, " samples"],
    y: Float[np.ndarray, " samples"],
    usable: Bool[np.ndarray, " samples"],
    dt: float,
) -> AxisResponse:
    """The frequency response from u to y, in closed loop too.

    A regression predicts y - u from its own past, A(z) (y - u) = B(z) u + e with white noise e, so that the response is
    1 + B / A (the direct method, Ljung, System Identification, section 13.5). A controller that responds to e within
    its sample, or that measures more often than the log, biases the first coefficients of B. So the errors contain what
    changes without these coefficients.

    **Arguments:** signals with one sample every `dt` [s], and which of them are `usable`.
    """
    lags, apart = max(round(MEMORY / dt), MIN_LAGS), RESOLUTION
    frequency = np.arange(apart, min(0.4 / dt, HIGHEST + apart / 2), apart)
    rows = np.flatnonzero(np.convolve(usable, np.ones(lags + 1))[: usable.size] > lags + 0.5)
    if rows.size < SAMPLES * (2 * lags + 2):
        nothing = np.full(frequency.size, np.nan)
        return AxisResponse(frequency, nothing, nothing, nothing, np.diag(nothing), 0.0)
    before = rows[:, None] - np.arange(lags + 1)
    off, shift = y - u, np.exp(-2j * np.pi * dt * np.outer(frequency, np.arange(lags + 1)))

    def regression(first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The logarithm of the response, its derivatives times the standard deviations, and the disturbance's power."""
        regressors = np.hstack([off[before[:, 1:]], u[before[:, first:]], np.ones((rows.size, 1))])
        sizes, directions = np.linalg.eigh(regressors.T @ regressors)
        # An input that hardly varies carries no information.
        inverse_root = directions / np.sqrt(np.maximum(sizes, 0) + _RIDGE * sizes.sum())
        found = inverse_root @ (inverse_root.T @ (regressors.T @ off[rows]))
        variance = np.square(off[rows] - regressors @ found).sum() / (rows.size - found.size)
        a, b = 1 - shift[:, 1:] @ found[:lags], shift[:, first:] @ found[lags:-1]
        slopes = np.hstack([(b / a**2)[:, None] * shift[:, 1:], shift[:, first:] / a[:, None]]) / (1 + b / a)[:, None]
        root = np.sqrt(variance) * inverse_root[:-1]
        return np.log(1 + b / a), slopes @ root, variance / np.abs(a) ** 2

    (whole, spread, disturbed), (late, *_) = regression(0), regression(max(round(REACTION / dt), 1))
    reacted = np.real(late - whole)
    caused = np.real(np.einsum("fi,ij,fj->f", shift.conj(), np.cov(u[before].T), shift)) / (lags + 1)
    return AxisResponse(
        frequency,
        np.exp(np.real(whole)),
        np.imag(whole),
        caused / (caused + disturbed),
        np.real(spread) @ np.real(spread).T + np.outer(reacted, reacted),
        rows.size * dt * apart,
    )
