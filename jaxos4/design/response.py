"""How a vehicle under its controller answers small tones of its references: flown by the simulator, tone by tone."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from .._custom_types import Key, as_float
from ..closed_loop import ClosedLoop
from .batch import LANES, batch_of, fly_batch
from .envelope import ANGLES, RATES
from .filtered import Filters, informations

# Amplitudes of the tones, for which the vehicle is linear: angles [rad] and vertical acceleration [m/s^2].
_SMALL = np.array([0.02, 0.02, 0.02, 0.2])
# The least number of flights of a batch of tones that hover in gusts instead.
_GUSTY = 8
_LIMITED = {"angle": ANGLES, "rate": RATES}


class Tones(eqx.Module):
    """Tones of which references are made, each a whole number of cycles in a period of the references.

    - `period`: in samples. `count`: the number of tones, which are the multiples of 1 / period.
    """

    period: int
    count: int

    @classmethod
    def up_to(cls, bandwidth: float, samples: int, dt: float) -> "Tones":
        """As many as fit into a batch, up to a bandwidth [Hz]: the references of a long flight repeat."""
        most = (LANES - 1 - _GUSTY) // 2
        period = (samples - 1) // max(math.ceil(samples * dt * bandwidth / most), 1)
        return cls(period, max(min(math.floor(bandwidth * period * dt + 1e-9), most), 1))

    def turns(self, periods: Float[np.ndarray, " points"]) -> Complex[np.ndarray, "points count"]:
        """exp(i angle) of each tone, at times in periods."""
        return np.exp(2j * math.pi * np.outer(periods, np.arange(1, self.count + 1)))

    def basis(self, periods: Float[np.ndarray, " points"]) -> Float[np.ndarray, "points coefficients"]:
        """Cosines of all tones, then their sines, at times in periods."""
        turns = self.turns(periods)
        return np.concatenate([np.real(turns), np.imag(turns)], axis=1)


class Response(NamedTuple):
    """What small tones of the references do. Coefficients are those of cosines, then of sines.

    - `tones`: information of a flight with a tone of each reference, for a unit of it.
    - `hovering`: information of a flight in gusts without references.
    - `signals`: change of angles and of rates by a unit of the coefficients of the reference of the same axis, by the
      name of their limit.
    - `gusty`: the largest angles and rates in gusts, by the name of their limit.
    """

    tones: Float[np.ndarray, "references count unknowns unknowns"]
    hovering: Float[np.ndarray, "unknowns unknowns"]
    signals: dict[str, Float[np.ndarray, "axes points coefficients"]]
    gusty: dict[str, Float[np.ndarray, "axes"]]


def respond(
    loop: ClosedLoop,
    filters: Filters,
    tones: Tones,
    samples: int,
    dt: float,
    points: Float[np.ndarray, " points"],
    key: Key,
) -> Response:
    """Fly each tone once in still air, and look at the flights by the filters for the true gusts.

    For small tones the vehicle is linear. So the information of a sum of tones is the sum of their informations.
    `points`: times in periods at which the search looks.
    """
    count, turns = tones.count, tones.turns(np.arange(samples) / tones.period)
    references = np.zeros((LANES, samples, 4))
    references[:count, :, :3] = _SMALL[:3] * np.real(turns).T[:, :, None]
    references[count : 2 * count, :, 3] = _SMALL[3] * np.real(turns).T
    in_gusts = np.arange(LANES) > 2 * count  # the one before is in still air, and has no reference
    names = ("gust", "thrust_gust", "gyro_noise", "attitude_noise", "force_noise")
    loops = batch_of(loop, **{name: np.multiply.outer(in_gusts, np.asarray(getattr(loop, name))) for name in names})
    flights = fly_batch(loops, jnp.asarray(references), as_float(dt), key)
    found, states = informations(filters, flights), np.asarray(flights.states)
    channels = np.asarray(found.channels)
    excess = channels - channels[2 * count]
    angular = np.moveaxis(excess[:count, :3], 1, 0) / np.square(_SMALL[:3])[:, None, None, None]
    vertical = excess[None, count : 2 * count].sum(axis=2) / _SMALL[3] ** 2
    # In still air nothing is learned about the noise.
    beyond = filters.prior.shape[0] - channels.shape[-1]
    information = np.pad(np.concatenate([angular, vertical]), ((0, 0), (0, 0), (0, beyond), (0, beyond)))
    # The answers in the last period, in which the beginning is forgotten.
    last = np.conj(turns[-tones.period :]) * 2 / tones.period
    signals = {}
    for name, columns in _LIMITED.items():
        answers = np.einsum("kta,tk->ak", states[:count, -tones.period :, columns], last) / _SMALL[:3, None]
        moving = answers[:, None] * tones.turns(points)
        signals[name] = np.concatenate([np.real(moving), np.imag(moving)], axis=2)
    gusty = {name: np.abs(states[in_gusts][..., columns]).max(axis=(0, 1)) for name, columns in _LIMITED.items()}
    return Response(information, np.asarray(found.whole)[in_gusts].mean(axis=0), signals, gusty)
