"""What flights in closed loop tell: the Fisher information of the innovations that filter error compares."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Parameters, RotorSpeeds
from ..closed_loop import ClosedLoop
from ..estimators.filter_error import BLOCK, NOISE_PRECISION, innovations_of, joint, observed_of
from ..flight import Flight
from ..models.abstract import PARAMETER_NAMES
from ..models.terms import COMMANDS, FULL_SCALE, LATERAL_FORCE, VERTICAL_FORCE, default_terms, has_full_scale
from ..models.vehicle import FlightModel
from ..shooting import ShootingProblem
from ..shooting.filtering import Noise

INERTIAS = ("Ix", "Iy", "Iz")
# The place of the alpha that is torque over each moment of inertia.
INVERSE = [PARAMETER_NAMES.index(name) for name in ("alpha3", "alpha6", "alpha8")]
# Standard deviations of disturbances below this are as good as none [rad/s^2, m/s^2].
_LEAST = 1e-3
Informations = Float[np.ndarray, "*some unknowns unknowns"]


def model_of(loop: ClosedLoop) -> FlightModel:
    """The model that `jaxos4.identify` chooses for the log of this vehicle."""
    offers = {LATERAL_FORCE, VERTICAL_FORCE}
    offers |= {COMMANDS} if loop.logged == "commands" else set()
    offers |= {FULL_SCALE} if has_full_scale(loop.airframe) else set()
    return FlightModel(loop.airframe, terms=default_terms(frozenset(offers)))


class Filters(eqx.Module):
    """How filter error looks at flights of one vehicle.

    Its unknowns are the parameters, and then strength, time constant and sensor of the noise of each channel. They all
    are estimated. A controller answers gusts, so what a flight tells about parameters and about noise is correlated.

    - `parameters`: the true ones. `noise`: disturbances and sensors of each channel.
    - `prior`: the information of the bracket, of which the half-widths are standard deviations, and of the filters.
    """

    model: FlightModel
    parameters: Parameters
    noise: Noise
    prior: Float[Array, "unknowns unknowns"]

    @classmethod
    def of(cls, loop: ClosedLoop, half_width: Parameters, dt: float) -> "Filters":
        """The filters that know the true gusts and noise."""
        model = model_of(loop)
        known: dict[str, Any] = {"rotor_lag": loop.rotor_lag, "rotor_delay": loop.rotor_delay}
        for i, axis in enumerate(("roll", "pitch", "yaw")):
            known |= {f"{axis}_offset": loop.offset[i], f"{axis}_damping": loop.damping[i]}
        names, alpha = model.parameter_names, np.asarray(model.alpha)
        parameters = np.array([float(known.get(name, value)) for name, value in zip(names, alpha, strict=True)])
        strength = np.maximum(np.append(loop.gust, loop.thrust_gust), _LEAST)
        block = max(BLOCK / dt, 1.0)
        sensor = np.append(np.full(3, loop.gyro_noise), loop.force_noise / np.sqrt(block))
        noise = Noise(*(jnp.asarray(np.log(x)) for x in (strength, np.full(4, loop.gust_time), sensor)))
        prior = np.append(1 / np.square(np.asarray(half_width)), np.full(3 * len(strength), NOISE_PRECISION))
        return cls(model, jnp.asarray(parameters), noise, jnp.asarray(np.diag(prior)))

    @property
    def names(self) -> tuple[str, ...]:
        """Ix, Iy, Iz, then the parameters of the model that are not their reciprocals."""
        return (*INERTIAS, *(self.model.parameter_names[i] for i in self._others))

    @property
    def units(self) -> tuple[str, ...]:
        """Of `names`."""
        return (*("kg m^2",) * len(INERTIAS), *(self.model.parameter_units[i] for i in self._others))

    @property
    def _others(self) -> tuple[int, ...]:
        return tuple(i for i in range(self.parameters.shape[0]) if i not in INVERSE)

    def about_inertias(self, information: Informations) -> Informations:
        """From information about the model's unknowns to that about log Ix, log Iy, log Iz, and the others.

        The inertia is thrust_gain / alpha, as in the table that `jaxos4 estimate` prints.
        """
        alpha, slopes = np.asarray(self.parameters), np.eye(information.shape[-1])
        for place in INVERSE:
            slopes[place, place] = -alpha[place]
            if "thrust_gain" in self.model.parameter_names:
                slopes[place, self.model.parameter_names.index("thrust_gain")] = alpha[place]
        slopes = slopes[:, [*INVERSE, *(i for i in range(len(slopes)) if i not in INVERSE)]]
        return slopes.T @ information @ slopes

    def bounds(self, information: Float[np.ndarray, "unknowns unknowns"]) -> Float[np.ndarray, " parameters"]:
        """The smallest standard deviations of `names`, in `units`, from information and prior."""
        total = self.about_inertias(information + np.asarray(self.prior))
        scale = np.sqrt(np.diagonal(total))
        relative = np.sqrt(np.diagonal(np.linalg.inv(total / np.outer(scale, scale)))) / scale
        unit = np.append(np.asarray(self.model.airframe.inertia), np.ones(len(self._others)))
        return relative[: unit.size] * unit


class Informed(NamedTuple):
    """The Fisher information of flights, about all unknowns together, and of each channel about the parameters."""

    whole: Float[Array, "flights unknowns unknowns"]
    channels: Float[Array, "flights channels parameters parameters"]


@eqx.filter_jit
def informations(filters: Filters, flights: Flight) -> Informed:
    """What each of a batch of flights tells."""
    count = filters.parameters.shape[0]

    def one(omega: RotorSpeeds, states: Array, force: Array | None) -> Informed:
        flight = Flight(flights.time[0], omega, states, specific_force=force, commanded=flights.commanded)
        problem = ShootingProblem(filters.model, flight, sigma=np.ones(12), channels="rates", method="rk4")
        index = np.arange(omega.shape[0])[None]
        found = innovations_of(problem, observed_of(problem, index), index)(filters.parameters, filters.noise)
        gradient, information = found.gradient.sum(axis=-1), found.information.sum(axis=-1)
        return Informed(joint(gradient, information, count)[1], information[:, :count, :count])

    return jax.vmap(one)(flights.omega, flights.states, flights.specific_force)
