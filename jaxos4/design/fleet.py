"""Vehicles in closed loop that fly references through gusts, and what filter error can learn from their flights."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Key, Numeric, Parameters, Scalar, as_float
from .._xla import quick_jit
from ..airframe import INERTIAS, INVERSES, MOTIONS
from ..bracket import Bracket
from ..closed_loop import ClosedLoop, fly_closed_loop
from ..errors import InputError
from ..excitation import References
from ..flight import ANGLES, POSITION, VELOCITY, Flight
from ..models.flight_model import FlightModel
from ..models.state import Attitude, Orientation, to_earth
from ..models.terms import COMMANDS, FULL_SCALE, VERTICAL_FORCE, default_terms
from ..shooting import InnovationsProblem, ShootingProblem
from ..shooting.gains import LogNoise
from ..shooting.noise_unknowns import PRECISION, joined
from .envelope import Envelope, hover_squares
from .rotor_speeds import drawn
from .task import Series

LANES = 64
"""The number of flights in a batch. All batches share one program."""
# This many vehicles fly in still air, and show velocity and distance: gusts carry the others away.
_STILL = 16
# Disturbances are taken to have at least this standard deviation [rad/s^2, m/s^2].
_LEAST_GUST = 1e-3
# Rotors turn at least with this share of the speed in hover, and at most with this multiple if no maximum is known.
_SLOWEST, _FASTEST = 0.1, 2.0
# Gusts alone use at most this share of a limit that is not given.
_GUST_SHARE = 0.8


def model_of(loop: ClosedLoop) -> FlightModel:
    """The model that `jaxos4.identify` chooses for the log of this vehicle, without the effects of its velocity."""
    offers = {VERTICAL_FORCE}
    offers |= {COMMANDS} if loop.logged == "commands" else set()
    offers |= {FULL_SCALE} if loop.airframe.has_full_scale else set()
    return FlightModel(loop.airframe, terms=default_terms(frozenset(offers)))


def batch_of(loop: ClosedLoop, in_gusts: np.ndarray | None = None, **values: Float[ArrayLike, "lanes ..."]):
    """`LANES` copies of a loop, with some settings replaced: one value for each copy.

    - `in_gusts`: which of them have gusts and noise of gyro and attitude; by default all.
    - `values`: `inertia` is that of the airframe. The controller knows the inertia of `loop`.
    """
    known = loop.airframe.inertia if loop.controller_inertia is None else loop.controller_inertia
    loop = eqx.tree_at(lambda x: x.controller_inertia, loop, as_float(known), is_leaf=lambda x: x is None)
    if in_gusts is not None:
        names = ("gust", "thrust_gust", "gyro_noise", "attitude_noise", "force_noise")
        values = {name: np.multiply.outer(in_gusts, np.asarray(getattr(loop, name))) for name in names} | values
    copies = jax.tree.map(lambda leaf: np.broadcast_to(np.asarray(leaf), (LANES, *np.shape(leaf))), loop)
    for name, value in values.items():
        part = (lambda x: x.airframe.inertia) if name == "inertia" else (lambda x, name=name: getattr(x, name))
        copies = eqx.tree_at(part, copies, np.asarray(value, dtype=float))
    return copies


@quick_jit
def fly_batch(loops: ClosedLoop, references: Float[Array, "lanes samples 4"], dt: Scalar, key: Key) -> Flight:
    """Fly a batch. Velocity and position are integrals of measured attitude and specific force.

    Sensors measure along the body's axes: no design depends on this.
    """

    def one(loop: ClosedLoop, references: References, key: Key) -> Flight:
        loop = eqx.tree_at(lambda each: each.airframe.sensor_rotation, loop, jnp.zeros(3))
        flight = fly_closed_loop(loop, references, dt=dt, key=key)
        vertical = flight.channels[:, -1]
        nothing = jnp.zeros_like(vertical)
        force = jnp.stack(
            to_earth(Orientation.of(Attitude(*flight.states[:, ANGLES].T)), (nothing, nothing, vertical)), axis=1
        )
        velocity = dt * jnp.cumsum(force.at[:, 2].add(-loop.airframe.gravity), axis=0)
        states = flight.states.at[:, POSITION].set(dt * jnp.cumsum(velocity, axis=0)).at[:, VELOCITY].set(velocity)
        return eqx.tree_at(lambda f: f.states, flight, states)

    return eqx.filter_vmap(one)(loops, references, jax.random.split(key, LANES))


def inertias_first(of_inertias: tuple, of_parameters: tuple) -> tuple:
    """Items for Ix, Iy and Iz, then items for the parameters of a `FlightModel` that are not their reciprocals."""
    return (*of_inertias, *(one for i, one in enumerate(of_parameters) if i not in INVERSES))


class Fleet(eqx.Module):
    """A vehicle in gusts, and vehicles with moments of inertia that are drawn from a bracket, and gusts of their own.

    - `loop`: the vehicle of the airframe. `loops`: the drawn ones, as a batch, all with its controller.
    - `model`, `parameters`: of the filters, which know the true parameters, gusts and noise of `loop`.
    - `prior`: the information of the bracket, of which the half-widths are standard deviations.
    """

    loop: ClosedLoop
    loops: ClosedLoop
    model: FlightModel
    parameters: Parameters
    prior: Float[Array, " parameters"]
    dt: float = eqx.field(static=True)
    key: Key

    @classmethod
    def of(cls, loop: ClosedLoop, bracket: Bracket, dt: float, key: Key) -> "Fleet":
        """Vehicles from a bracket of the parameters of `model_of(loop)`."""
        inertia = 1 / np.asarray(drawn(bracket, key, LANES))[:, INVERSES]
        if not (np.isfinite(inertia).all() and (inertia > 0).all()):
            raise InputError("`bracket`: alpha3, alpha6 and alpha8 must be positive.")
        loops = batch_of(loop, np.arange(LANES) >= _STILL, inertia=inertia, force_noise=np.zeros(LANES))
        model, prior = model_of(loop), jnp.asarray(1 / np.square(np.asarray(bracket.half_width)))
        delay = loop.rotor_delay if loop.logged == "commands" else 0.0
        known: dict[str, Any] = {"rotor_lag": loop.rotor_lag, "rotor_delay": delay}
        for i, axis in enumerate(MOTIONS):
            known |= {f"{axis}_offset": loop.offset[i], f"{axis}_damping": loop.damping[i]}
        names, alpha = model.parameter_names, np.asarray(model.alpha)
        parameters = np.array([float(known.get(name, value)) for name, value in zip(names, alpha, strict=True)])
        return cls(loop, loops, model, jnp.asarray(parameters), prior, dt, jax.random.fold_in(key, 1))

    def about_inertias(self, information: Float[Numeric, "*some n n"]) -> Float[np.ndarray, "*some n n"]:
        """From information about the model's unknowns to that about log Ix, log Iy, log Iz, and the others."""
        alpha, slopes = np.asarray(self.parameters), np.eye(information.shape[-1])
        for place in INVERSES:  # the inertia is thrust_gain / alpha, as in the table that `jaxos4 estimate` prints
            slopes[place, place] = -alpha[place]
            if "thrust_gain" in self.model.parameter_names:
                slopes[place, self.model.parameter_names.index("thrust_gain")] = alpha[place]
        slopes = slopes[:, inertias_first(tuple(INVERSES), tuple(range(len(slopes))))]
        return slopes.T @ np.asarray(information) @ slopes

    def with_prior(self, information: Float[Numeric, "n n"]) -> Float[np.ndarray, "n n"]:
        """The information, about the inertias first, with what the bracket says."""
        beyond = information.shape[-1] - self.prior.shape[0]
        return self.about_inertias(information + np.diag(np.pad(np.asarray(self.prior), (0, beyond))))

    def bounds_from(self, information: Float[Numeric, "n n"]) -> Float[np.ndarray, " parameters"]:
        """The smallest standard deviations of Ix, Iy, Iz and the others, from information and prior."""
        total, count = self.with_prior(information), self.prior.shape[0]
        scale = np.sqrt(np.diagonal(total))
        relative = np.sqrt(np.diagonal(np.linalg.inv(total / np.outer(scale, scale)))) / scale
        unit = np.append(np.asarray(self.model.airframe.inertia), np.ones(count - len(INERTIAS)))
        return relative[:count] * unit

    @quick_jit
    def informations(
        self, flights: Flight
    ) -> tuple[Float[Array, "flights n n"], Float[Array, "flights channels parameters parameters"]]:
        """The Fisher information of each flight's innovations: all that the design knows of filter error.

        **Returns:** the information about parameters and noise, with its weak prior; and from each channel the
        information about the parameters.
        """
        loop, count = self.loop, self.parameters.shape[0]
        strength = jnp.maximum(jnp.append(loop.gust, loop.thrust_gust), _LEAST_GUST)

        def one(omega: Array, states: Array, force: Array | None) -> tuple[Array, Array]:
            flight = Flight(flights.time[0], omega, states, specific_force=force, commanded=flights.commanded)
            problem = ShootingProblem(self.model, flight, sigma=np.ones(12), channels="rates", method="rk4")
            sensor = jnp.append(jnp.repeat(loop.gyro_noise, 3), loop.force_noise)
            noise = LogNoise(jnp.log(strength), jnp.log(jnp.repeat(loop.gust_time, 4)), jnp.log(sensor))
            innovations = InnovationsProblem(problem, segments=1)
            found = innovations.innovations(self.parameters, noise)
            information = found.information.sum(axis=-1)
            whole = joined(found.gradient.sum(axis=-1), information, count)[1]
            prior = PRECISION * (np.arange(whole.shape[0]) >= count)
            return whole + jnp.diag(prior), information[:, :count, :count]

        return jax.vmap(one)(flights.omega, flights.states, flights.specific_force)

    def _fly(self, references: Series) -> tuple[np.ndarray, np.ndarray, float]:
        """Rotor speeds, states and sample time; velocity and distance only of vehicles in still air."""
        every = jnp.broadcast_to(jnp.asarray(references), (LANES, *references.shape))
        flights = fly_batch(self.loops, every, as_float(self.dt), self.key)
        states = np.array(flights.states)
        if np.isfinite(states).all():  # no vehicle turned over
            states[_STILL:, :, [*POSITION, *VELOCITY]] = 0
        return np.asarray(flights.omega), states, self.dt

    def envelope(self, references: Series, limits: Mapping[str, float]) -> Envelope:
        """The limits that these references need, with rotors by the airframe and some replaced. Raises `InputError`."""
        airframe, hover = self.loop.airframe, float(self.loop.airframe.hover_speed)
        slowest = _SLOWEST * hover
        fastest = float(airframe.max_rotor_speed) if airframe.has_full_scale else _FASTEST * hover
        rotors = {"slowest": slowest, "fastest": fastest, "slew": (fastest - slowest) / self.dt}
        unknown = Envelope(**rotors, **dict.fromkeys(("angle", "rate", "velocity", "distance"), 1.0))
        hover_squares(airframe, unknown.limited(limits))
        flights = self._fly(references), self._fly(0 * references)
        if not all(np.isfinite(states).all() for _, states, _ in flights):
            remedy = "give weaker gusts or a smaller `angle`, or narrow the `bracket`"
            raise InputError(f"some of the vehicles turn over in 3-2-1-1 references; {remedy}.")
        needed, still = (Envelope.of(*flown) for flown in flights)
        own = {}
        for name in ("angle", "rate"):  # roll and pitch may do the same
            alone = np.asarray(getattr(still, name)) / _GUST_SHARE
            roll, pitch, yaw = np.maximum(np.asarray(getattr(needed, name)), alone)
            own[name] = np.array([max(roll, pitch), max(roll, pitch), yaw])
        return needed.limited(rotors | own | dict(limits))

    def uses(self, references: Series, envelope: Envelope) -> dict[str, float]:
        """The largest share of each limit that a vehicle uses. A controller has no limit of slew."""
        shares = envelope.shares(*self._fly(references))
        return {name: share for name, share in shares.items() if name != "slew"}

    def bounds(self, references: Mapping[str, Series]) -> dict[str, Float[np.ndarray, " parameters"]]:
        """The bounds of the airframe's vehicle after a flight with each of several references, in gusts."""
        names = list(references)
        order = np.arange(LANES) % len(names)
        flown = jnp.asarray(np.stack([references[name] for name in names]))[order]
        flights = fly_batch(batch_of(self.loop), flown, as_float(self.dt), jax.random.fold_in(self.key, 1))
        found = np.asarray(self.informations(flights)[0])
        # A mean over flights, because gusts and noise differ from flight to flight.
        return {name: self.bounds_from(found[order == i].mean(axis=0)) for i, name in enumerate(names)}
