"""The envelope: limits of rotor speeds, angles, rates, velocity and distance."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._custom_types import Numeric, RotorSpeeds, Scalar, setting
from ..airframe import Airframe
from ..errors import InputError, named
from ..flight import STATE_NAMES

ANGLES, RATES, POSITION, VELOCITY = (
    np.array([STATE_NAMES.index(name) for name in names])
    for names in (("phi", "theta", "psi"), ("p", "q", "r"), ("x", "y", "z"), ("vx", "vy", "vz"))
)
# Shares of the limits by the name of the limit, for each sample.
Uses = dict[str, Float[Array, "..."]]


class Envelope(eqx.Module):
    """The limits of a flight. Each holds at all times, which restricts the amplitude of an input.

    - `slowest`, `fastest`: rotor speed [rad/s].
    - `slew`: the change of a rotor's speed from sample to sample, divided by the sample time [rad/s^2].
    - `angle`: phi, theta and psi, to either side [rad]; one number or three.
    - `rate`: p, q and r, to either side [rad/s]; one number or three.
    - `velocity`: the speed of flight [m/s].
    - `distance`: from the start [m].

    **Raises:** `ValueError` for a limit that is not positive and finite, or `slowest` not below `fastest`.
    """

    slowest: Scalar = eqx.field(converter=setting("slowest", positive=True))
    fastest: Scalar = eqx.field(converter=setting("fastest", positive=True))
    slew: Scalar = eqx.field(converter=setting("slew", positive=True))
    angle: Float[Array, "3"] = eqx.field(converter=setting("angle", ("phi", "theta", "psi"), positive=True))
    rate: Float[Array, "3"] = eqx.field(converter=setting("rate", ("p", "q", "r"), positive=True))
    velocity: Scalar = eqx.field(converter=setting("velocity", positive=True))
    distance: Scalar = eqx.field(converter=setting("distance", positive=True))

    def __check_init__(self):
        ends = self.slowest, self.fastest
        if not any(isinstance(end, Tracer) for end in ends) and not float(ends[0]) < float(ends[1]):
            raise ValueError(f"`slowest` must be below `fastest`, got {float(ends[0]):g} and {float(ends[1]):g} rad/s.")

    @classmethod
    def of(
        cls, omega: Float[Numeric, "*inputs samples 4"], states: Float[Numeric, "*flights times 12"], dt: float
    ) -> "Envelope":
        """The limits that flights just keep. `dt`: of the rotor speeds; the states may be sampled more often."""
        return cls(**_needs(omega, states, dt))

    def limited(self, limits: Mapping[str, Any]) -> "Envelope":
        """This envelope with some limits replaced. Raises `InputError` if one of them is impossible."""
        with named("the envelope"):
            return Envelope(**vars(self) | dict(limits))

    def shares(
        self, omega: Float[Numeric, "*inputs samples 4"], states: Float[Numeric, "*flights times 12"], dt: float
    ) -> dict[str, float]:
        """The largest share of each limit that flights use, see `of`: 1 is the limit. Infinite if a flight failed."""
        shares = {
            name: np.max(need / np.asarray(getattr(self, name))) for name, need in _needs(omega, states, dt).items()
        }
        with np.errstate(divide="ignore"):  # a rotor that stands still
            shares["slowest"] = 1 / shares["slowest"]
        return {name: float(np.nan_to_num(share, nan=np.inf, posinf=np.inf)) for name, share in shares.items()}

    def uses(self, omega: RotorSpeeds, states: Float[Array, "times *vehicles 12"], dt: Scalar) -> Uses:
        """The share of each limit at each sample, with derivatives. The columns are rotors, or axes of all vehicles."""
        held = omega[:-1]
        of_states = {
            "angle": states[..., ANGLES] / self.angle,
            "rate": states[..., RATES] / self.rate,
            "velocity": _norm(states[..., VELOCITY]) / self.velocity,
            "distance": _norm(states[..., POSITION] - states[0][..., POSITION]) / self.distance,
        }
        return {
            "slowest": self.slowest / held,
            "fastest": held / self.fastest,
            "slew": jnp.diff(held, axis=0) / (self.slew * dt),
        } | {name: share.reshape(share.shape[0], -1) for name, share in of_states.items()}


def _needs(omega: Numeric, states: Numeric, dt: float) -> dict[str, Any]:
    held, states = np.asarray(omega)[..., :-1, :], np.asarray(states)  # the last row drives nothing
    return {
        "slowest": held.min(),
        "fastest": held.max(),
        "slew": np.abs(np.diff(held, axis=-2)).max() / dt,
        "angle": np.abs(states[..., ANGLES]).reshape(-1, 3).max(axis=0),
        "rate": np.abs(states[..., RATES]).reshape(-1, 3).max(axis=0),
        "velocity": np.linalg.norm(states[..., VELOCITY], axis=-1).max(),
        "distance": np.linalg.norm((states - states[..., :1, :])[..., POSITION], axis=-1).max(),
    }


def hover_squares(airframe: Airframe, envelope: Envelope) -> Float[np.ndarray, "4"]:
    """The squared rotor speeds that carry the weight. Raises `InputError` if they lie outside of the envelope."""
    squares = airframe.hover_squares
    slowest, fastest = float(envelope.slowest), min(float(envelope.fastest), float(airframe.max_rotor_speed))
    if not np.all((squares > slowest**2) & (squares < fastest**2)):
        speeds = ", ".join(f"{x:.4g}" for x in np.sqrt(np.maximum(squares, 0)))
        raise InputError(
            f"the vehicle cannot hover within the envelope: its rotors need {speeds} rad/s, and the limits are "
            f"{slowest:.4g} and {fastest:.4g} rad/s; correct the limits, or the airframe."
        )
    return squares


def _norm(vectors: Float[Array, "*some 3"]) -> Float[Array, "*some 1"]:
    """The length of each vector, with a derivative at 0."""
    return jnp.sqrt(jnp.square(vectors).sum(axis=-1, keepdims=True) + 1e-12)
