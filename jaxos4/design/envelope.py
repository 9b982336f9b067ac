"""The envelope: limits of rotor speeds, angles, rates, velocity and distance."""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._custom_types import Numeric, Scalar, setting
from ..airframe import Airframe
from ..errors import InputError, named
from ..flight import ANGLES, POSITION, RATES, VELOCITY

# Shares of the limits by the name of the limit, for each sample.
Uses = Mapping[str, Float[Numeric, "..."]]


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
        sizes = {name: np.abs(size) for name, size in _sizes(np.asarray(omega), np.asarray(states), dt).items()}
        largest = {name: size.max() for name, size in sizes.items()}
        each = {name: sizes[name].reshape(-1, 3).max(axis=0) for name in ("angle", "rate")}
        return cls(**largest | each | {"slowest": sizes["slowest"].min()})

    def limited(self, limits: Mapping[str, Any]) -> "Envelope":
        """This envelope with some limits replaced. Raises `InputError` if one of them is impossible."""
        if unknown := [name for name in limits if name not in vars(self)]:
            raise InputError(f"`limits`: knows no `{unknown[0]}`; the limits are {', '.join(vars(self))}.")
        with named("the envelope"):
            return Envelope(**vars(self) | dict(limits))

    def shares(
        self, omega: Float[Numeric, "*inputs samples 4"], states: Float[Numeric, "*flights times 12"], dt: float
    ) -> dict[str, float]:
        """The largest share of each limit that flights use, see `of`: 1 is the limit. Infinite if a flight failed."""
        limits = jax.tree.map(np.asarray, self)
        with np.errstate(divide="ignore"):  # a rotor that stands still
            uses = limits.uses(np.asarray(omega), np.asarray(states), dt)
        return {name: float(np.nan_to_num(np.abs(use).max(), nan=np.inf, posinf=np.inf)) for name, use in uses.items()}

    def uses(
        self,
        omega: Float[Numeric, "*inputs samples 4"],
        states: Float[Numeric, "*flights times 12"],
        dt: Scalar | float,
    ) -> Uses:
        """The share of each limit at each sample, with derivatives. The columns are rotors, or axes."""
        sizes = _sizes(omega, states, dt)
        shares = {name: size / getattr(self, name) for name, size in sizes.items()}
        return shares | {"slowest": self.slowest / sizes["slowest"]}


def _sizes(omega: Numeric, states: Numeric, dt: Scalar | float) -> dict[str, Numeric]:
    """The quantities at each sample that the limits of an envelope restrict, by the name of the limit."""
    driving, moved = omega[..., :-1, :], states - states[..., :1, :]  # the last row of rotor speeds drives nothing
    return {
        "slowest": driving,
        "fastest": driving,
        "slew": (driving[..., 1:, :] - driving[..., :-1, :]) / dt,
        "angle": states[..., ANGLES],
        "rate": states[..., RATES],
        "velocity": _norm(states[..., VELOCITY]),
        "distance": _norm(moved[..., POSITION]),
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


def _norm(vectors: Float[Numeric, "*some 3"]) -> Float[Numeric, "*some 1"]:
    """The length of each vector, with a derivative at 0."""
    return ((vectors**2).sum(axis=-1, keepdims=True) + 1e-12) ** 0.5
