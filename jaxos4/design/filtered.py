"""The information of flights in closed loop: that of the innovations that filter error compares."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Numeric, Parameters
from .._xla import quick_jit
from ..closed_loop import ClosedLoop
from ..flight import Flight
from ..models.abstract import PARAMETER_NAMES
from ..models.terms import COMMANDS, FULL_SCALE, LATERAL_FORCE, VERTICAL_FORCE, default_terms, has_full_scale
from ..models.vehicle import FlightModel
from ..shooting import InnovationsProblem, ShootingProblem
from ..shooting.filters import LogNoise
from ..shooting.innovations import NOISE_PRECISION, joined

INERTIAS = ("Ix", "Iy", "Iz")
# The place of the alpha that is torque over each moment of inertia.
INVERSE = [PARAMETER_NAMES.index(name) for name in ("alpha3", "alpha6", "alpha8")]
# Disturbances are taken to have at least this standard deviation [rad/s^2, m/s^2]: less changes nothing.
_LEAST = 1e-3


def model_of(loop: ClosedLoop) -> FlightModel:
    """The model that `jaxos4.identify` chooses for the log of this vehicle."""
    offers = {LATERAL_FORCE, VERTICAL_FORCE}
    offers |= {COMMANDS} if loop.logged == "commands" else set()
    offers |= {FULL_SCALE} if has_full_scale(loop.airframe) else set()
    return FlightModel(loop.airframe, terms=default_terms(frozenset(offers)))


class Informations(NamedTuple):
    """The Fisher information of flights.

    - `whole`: about all unknowns: the parameters, then the noise of each channel, with its weak prior.
    - `channels`: that of each channel about the parameters.
    """

    whole: Float[Array, "*flights unknowns unknowns"]
    channels: Float[Array, "*flights channels parameters parameters"]


class Filters(eqx.Module):
    """The filters of one vehicle, which know its true parameters, gusts and noise.

    Parameters and noise are estimated together: a controller answers gusts, so their errors are correlated.

    - `prior`: the information of the bracket, of which the half-widths are standard deviations.
    """

    model: FlightModel
    parameters: Parameters
    loop: ClosedLoop
    prior: Float[Array, " parameters"]

    @classmethod
    def of(cls, loop: ClosedLoop, half_width: Parameters) -> "Filters":
        """The filters of a vehicle."""
        model = model_of(loop)
        known: dict[str, Any] = {
            "rotor_lag": loop.rotor_lag,
            "rotor_delay": loop.rotor_delay if loop.logged == "commands" else 0.0,
        }
        for i, axis in enumerate(("roll", "pitch", "yaw")):
            known |= {f"{axis}_offset": loop.offset[i], f"{axis}_damping": loop.damping[i]}
        names, alpha = model.parameter_names, np.asarray(model.alpha)
        parameters = np.array([float(known.get(name, value)) for name, value in zip(names, alpha, strict=True)])
        return cls(model, jnp.asarray(parameters), loop, jnp.asarray(1 / np.square(np.asarray(half_width))))

    @property
    def names(self) -> tuple[str, ...]:
        """Ix, Iy, Iz, then the parameters of the model that are not their reciprocals."""
        return (*INERTIAS, *(self.model.parameter_names[i] for i in self._others))

    @property
    def units(self) -> tuple[str, ...]:
        """The units of `names`."""
        return (*("kg m^2",) * len(INERTIAS), *(self.model.parameter_units[i] for i in self._others))

    @property
    def _others(self) -> list[int]:
        return [i for i in range(self.parameters.shape[0]) if i not in INVERSE]

    def about_inertias(self, information: Float[Numeric, "*some n n"]) -> Float[np.ndarray, "*some n n"]:
        """From information about the model's unknowns to that about log Ix, log Iy, log Iz, and the others.

        The inertia is thrust_gain / alpha, as in the table that `jaxos4 estimate` prints.
        """
        alpha, slopes = np.asarray(self.parameters), np.eye(information.shape[-1])
        for place in INVERSE:
            slopes[place, place] = -alpha[place]
            if "thrust_gain" in self.model.parameter_names:
                slopes[place, self.model.parameter_names.index("thrust_gain")] = alpha[place]
        slopes = slopes[:, [*INVERSE, *(i for i in range(len(slopes)) if i not in INVERSE)]]
        return slopes.T @ np.asarray(information) @ slopes

    def with_prior(self, information: Float[Numeric, "n n"]) -> Float[np.ndarray, "n n"]:
        """The information, about the inertias first, with what the bracket says."""
        beyond = information.shape[-1] - self.prior.shape[0]
        return self.about_inertias(information + np.diag(np.pad(np.asarray(self.prior), (0, beyond))))

    def bounds(self, information: Float[Numeric, "n n"]) -> Float[np.ndarray, " parameters"]:
        """The smallest standard deviations of `names`, in `units`, from information and prior."""
        total = self.with_prior(information)
        scale = np.sqrt(np.diagonal(total))
        relative = np.sqrt(np.diagonal(np.linalg.inv(total / np.outer(scale, scale)))) / scale
        unit = np.append(np.asarray(self.model.airframe.inertia), np.ones(len(self._others)))
        return relative[: unit.size] * unit

    @quick_jit
    def informations(self, flights: Flight) -> Informations:
        """The information of each of a batch of flights."""

        def one(omega: Array, states: Array, force: Array | None) -> Informations:
            flight = Flight(flights.time[0], omega, states, specific_force=force, commanded=flights.commanded)
            return _information(self.model, self.loop, flight, self.parameters)

        return jax.vmap(one)(flights.omega, flights.states, flights.specific_force)


def _information(model: FlightModel, loop: ClosedLoop, flight: Flight, parameters: Parameters) -> Informations:
    """The information of one flight's innovations. All that the design knows of filter error is here."""
    problem = ShootingProblem(model, flight, sigma=np.ones(12), channels="rates", method="rk4")
    innovations, count = InnovationsProblem(problem, segment=flight.time.shape[0]), parameters.shape[0]
    strength = jnp.maximum(jnp.append(loop.gust, loop.thrust_gust), _LEAST)
    sensor = jnp.append(jnp.repeat(loop.gyro_noise, 3), loop.force_noise)
    noise = LogNoise(jnp.log(strength), jnp.log(jnp.repeat(loop.gust_time, 4)), jnp.log(sensor))
    found = innovations.innovations(parameters, noise)
    information = found.information.sum(axis=-1)
    whole = joined(found.gradient.sum(axis=-1), information, count)[1]
    prior = NOISE_PRECISION * (np.arange(whole.shape[0]) >= count)
    return Informations(whole + jnp.diag(prior), information[:, :count, :count])
