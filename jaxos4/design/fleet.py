"""Vehicles that fly references through gusts: what they need of a limit, and what filter error learns from them."""

import math
from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._custom_types import Key, as_float
from ..bracket import Bracket
from ..closed_loop import ClosedLoop
from ..errors import InputError
from .batch import LANES, batch_of, fly_batch
from .envelope import POSITION, VELOCITY, Envelope
from .filtered import INVERSE, Filters, informations
from .fitting import drawn
from .references import Shape
from .steering import hover_squares

# Rotors turn at least with this share of the speed in hover, and at most with this multiple if no maximum is known.
_SLOWEST, _FASTEST = 0.1, 2.0
# Gusts alone use at most this share of a limit that is not given.
_GUSTS = 0.8
# So many vehicles fly in still air: gusts carry a vehicle without a position controller away, whatever its references.
_STILL = 16


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
        names = ("gust", "thrust_gust", "gyro_noise", "attitude_noise")
        in_gusts = np.arange(LANES) >= _STILL
        settings = {name: np.multiply.outer(in_gusts, np.asarray(getattr(loop, name))) for name in names}
        inertia = 1 / np.asarray(drawn(bracket, key, LANES))[:, INVERSE]
        if not (np.isfinite(inertia).all() and (inertia > 0).all()):
            raise InputError("`bracket`: alpha3, alpha6 and alpha8 must be positive.")
        loops = batch_of(loop, inertia=inertia, force_noise=np.zeros(LANES), **settings)
        return cls(loop, loops, dt, jax.random.fold_in(key, 1))

    def needs(self, references: Shape) -> Envelope | None:
        """The limits that these flights just keep; `None` if a vehicle turns over."""
        every = jnp.broadcast_to(jnp.asarray(references), (LANES, *references.shape))
        flights = fly_batch(self.loops, every, as_float(self.dt), self.key)
        omega, states = np.array(flights.omega), np.array(flights.states)
        if not np.isfinite(states).all():
            return None
        states[_STILL:, :, [*POSITION, *VELOCITY]] = 0
        return Envelope.of(omega, states, self.dt)

    def envelope(self, references: Shape, limits: Mapping[str, float]) -> Envelope:
        """The limits that these references need, with some replaced. Limits of rotors are those of the airframe.

        **Raises:** `InputError` for a limit that is not positive, or if a vehicle turns over or cannot hover.
        """
        airframe = self.loop.airframe
        hover, fastest = float(airframe.hover_speed), float(airframe.max_rotor_speed)
        slowest, fastest = _SLOWEST * hover, fastest if math.isfinite(fastest) else _FASTEST * hover
        rotors = {"slowest": slowest, "fastest": fastest, "slew": (fastest - slowest) / self.dt}
        unknown = dict.fromkeys(("angle", "rate", "velocity", "distance"), 1.0)
        try:
            given = Envelope(**{**rotors, **unknown, **limits})
        except ValueError as error:
            raise InputError(str(error)) from None
        hover_squares(airframe, given)
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
        return Envelope(**{**rotors, **flown, **limits})

    def uses(self, references: Shape, envelope: Envelope) -> dict[str, float]:
        """The largest share of each limit that a vehicle uses. A controller has no limit of slew."""
        needed = self.needs(references)
        shares = dict.fromkeys(Envelope.__annotations__, math.inf) if needed is None else envelope.shares_of(needed)
        return {name: share for name, share in shares.items() if name != "slew"}

    def bounds(self, filters: Filters, references: Mapping[str, Shape]) -> dict[str, Float[np.ndarray, " parameters"]]:
        """The bounds of the airframe's vehicle after a flight with each of several references, in gusts.

        The information is a mean over flights, because what gusts and noise do differs.
        """
        names = list(references)
        order = np.arange(LANES) % len(names)
        flown = jnp.asarray(np.stack([references[name] for name in names]))[order]
        flights = fly_batch(batch_of(self.loop), flown, as_float(self.dt), jax.random.fold_in(self.key, 1))
        found = np.asarray(informations(filters, flights).whole)
        return {name: filters.bounds(found[order == i].mean(axis=0)) for i, name in enumerate(names)}
