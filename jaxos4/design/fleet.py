"""Vehicles in closed loop that fly references through gusts, in batches of one size that share one program."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._custom_types import Key, Scalar, as_float
from .._xla import quick_jit
from ..bracket import Bracket
from ..closed_loop import ClosedLoop, References, fly_closed_loop
from ..errors import InputError
from ..flight import Flight
from ..models.rotation import to_earth
from ..models.state import Attitude
from .envelope import ANGLES, POSITION, VELOCITY, Envelope, hover_squares
from .filtered import INVERSE, Filters
from .open_loop import drawn
from .task import Inputs

LANES = 64
"""The number of flights in a batch."""

# Physics steps in a sample: twice as many as `fly_closed_loop` takes by default.
_SUBSTEPS = 8
# Rotors turn at least with this share of the speed in hover, and at most with this multiple if no maximum is known.
_SLOWEST, _FASTEST = 0.1, 2.0
# Gusts alone use at most this share of a limit that is not given.
_GUSTS = 0.8
# So many vehicles fly in still air: gusts carry a vehicle without a position controller away, whatever its references.
_STILL = 16


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
    """Fly a batch. Velocity and position are integrals of measured attitude and specific force."""

    def one(loop: ClosedLoop, references: References, key: Key) -> Flight:
        flight = fly_closed_loop(loop, references, dt=dt, key=key, substeps=_SUBSTEPS)
        vertical = flight.channels[:, -1]
        nothing = jnp.zeros_like(vertical)
        force = jnp.stack(to_earth(Attitude(*flight.states[:, ANGLES].T), (nothing, nothing, vertical)), axis=1)
        velocity = dt * jnp.cumsum(force.at[:, 2].add(-loop.airframe.gravity), axis=0)
        states = flight.states.at[:, POSITION].set(dt * jnp.cumsum(velocity, axis=0)).at[:, VELOCITY].set(velocity)
        return eqx.tree_at(lambda f: f.states, flight, states)

    return eqx.filter_vmap(one)(loops, references, jax.random.split(key, LANES))


class Fleet(NamedTuple):
    """Vehicles with moments of inertia that are drawn from a bracket, and gusts of their own.

    - `loop`: the vehicle of the airframe. `loops`: the drawn ones, as a batch. All have the controller of the airframe.
      Some fly in still air. Only they show velocity and distance.
    """

    loop: ClosedLoop
    loops: ClosedLoop
    dt: float
    key: Key

    @classmethod
    def of(cls, loop: ClosedLoop, bracket: Bracket, dt: float, key: Key) -> "Fleet":
        """Vehicles from a bracket of the parameters of a `FlightModel`."""
        inertia = 1 / np.asarray(drawn(bracket, key, LANES))[:, INVERSE]
        if not (np.isfinite(inertia).all() and (inertia > 0).all()):
            raise InputError("`bracket`: alpha3, alpha6 and alpha8 must be positive.")
        loops = batch_of(loop, np.arange(LANES) >= _STILL, inertia=inertia, force_noise=np.zeros(LANES))
        return cls(loop, loops, dt, jax.random.fold_in(key, 1))

    def needs(self, references: Inputs) -> Envelope | None:
        """The limits that these flights just keep; `None` if a vehicle turns over."""
        every = jnp.broadcast_to(jnp.asarray(references), (LANES, *references.shape))
        flights = fly_batch(self.loops, every, as_float(self.dt), self.key)
        omega, states = np.array(flights.omega), np.array(flights.states)
        if not np.isfinite(states).all():
            return None
        states[_STILL:, :, [*POSITION, *VELOCITY]] = 0
        return Envelope.of(omega, states, self.dt)

    def envelope(self, references: Inputs, limits: Envelope | Mapping[str, float]) -> Envelope:
        """The limits that these references need, with some replaced. Limits of rotors are those of the airframe.

        **Raises:** `InputError` for a limit that is not positive, or if a vehicle turns over or cannot hover.
        """
        airframe = self.loop.airframe
        hover, fastest = float(airframe.hover_speed), float(airframe.max_rotor_speed)
        slowest, fastest = _SLOWEST * hover, fastest if math.isfinite(fastest) else _FASTEST * hover
        rotors = {"slowest": slowest, "fastest": fastest, "slew": (fastest - slowest) / self.dt}
        unknown = Envelope(**rotors, **dict.fromkeys(("angle", "rate", "velocity", "distance"), 1.0))
        hover_squares(airframe, unknown.limited(limits))
        needed, still = self.needs(references), self.needs(0 * references)
        if needed is None or still is None:
            raise InputError(
                "some of the vehicles turn over in 3-2-1-1 references; give weaker gusts or a smaller `angle`, or "
                "narrow the `bracket`."
            )
        flown = {"velocity": needed.velocity, "distance": needed.distance}
        for name in ("angle", "rate"):  # roll and pitch may do the same
            alone = np.asarray(getattr(still, name)) / _GUSTS
            roll, pitch, yaw = np.maximum(np.asarray(getattr(needed, name)), alone)
            flown[name] = as_float(np.array([max(roll, pitch), max(roll, pitch), yaw]))
        return Envelope(**rotors, **flown).limited(limits)

    def uses(self, references: Inputs, envelope: Envelope) -> dict[str, float]:
        """The largest share of each limit that a vehicle uses. A controller has no limit of slew."""
        needed = self.needs(references)
        shares = dict.fromkeys(Envelope.__annotations__, math.inf) if needed is None else envelope.shares_of(needed)
        return {name: share for name, share in shares.items() if name != "slew"}

    def bounds(self, filters: Filters, references: Mapping[str, Inputs]) -> dict[str, Float[np.ndarray, " parameters"]]:
        """The bounds of the airframe's vehicle after a flight with each of several references, in gusts.

        The information is a mean over flights, because gusts and noise differ from flight to flight.
        """
        names = list(references)
        order = np.arange(LANES) % len(names)
        flown = jnp.asarray(np.stack([references[name] for name in names]))[order]
        flights = fly_batch(batch_of(self.loop), flown, as_float(self.dt), jax.random.fold_in(self.key, 1))
        found = np.asarray(filters.informations(flights).whole)
        return {name: filters.bounds(found[order == i].mean(axis=0)) for i, name in enumerate(names)}
