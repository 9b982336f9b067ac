"""A designed input beside the standard inputs, and designed references beside standard ones, in the same time."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..bracket import Bracket
from ..closed_loop import ClosedLoop
from ..errors import InputError
from ..excitation import EXCITATIONS
from ..models.abstract import AbstractModel
from ..noise import SENSOR_SIGMA
from .batch import LANES
from .closed_loop import ACCELERATION, DesignedReferences, plan_references, search_references
from .envelope import Envelope
from .filtered import INERTIAS
from .fitting import VEHICLES, DesignedInput, fitted
from .open_loop import design_input, envelope_of, plan_of


class InputDesign(NamedTuple):
    """What `jaxos4 design` shows.

    - `standard`: the standard inputs with the largest amplitude that the envelope allows, by name. One that does not
      fit into the time is missing.
    - `names`, `units`, `half_width`: of the parameters and their bracket.
    - `usual`: the half-width of the model's default bracket.
    - `vehicles`: the number of vehicles that stayed within the envelope.
    """

    envelope: Envelope
    designed: DesignedInput
    standard: dict[str, DesignedInput]
    names: tuple[str, ...]
    units: tuple[str, ...]
    half_width: Float[np.ndarray, " parameters"]
    usual: Float[np.ndarray, " parameters"]
    vehicles: int

    def gain(self, name: str) -> tuple[float, int]:
        """The designed bounds over those of a standard input.

        **Returns:** the geometric mean over the parameters that the standard input tells anything about, NaN without
        any; and their number.
        """
        own, other = self.designed.bounds[-1], self.standard[name].bounds[-1]
        excited = other < self.usual
        mean = float(np.exp(np.log(own / other)[excited].mean())) if excited.any() else math.nan
        return mean, int(excited.sum())


def design_and_compare(
    model: AbstractModel,
    *,
    limits: Mapping[str, float],
    bracket: Bracket,
    duration: float,
    dt: float,
    channels: str,
    start_is_known: bool,
    criterion: str,
    bandwidth: float,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
) -> InputDesign:
    """Design an input in the envelope of the standard multisine, with some `limits` replaced, and compare it.

    Arguments and errors as of `design_input`.
    """
    key = jax.random.key(seed)
    envelope = envelope_of(model, bracket=bracket, duration=duration, dt=dt, key=key)
    try:
        envelope = Envelope(**{name: limits.get(name, getattr(envelope, name)) for name in Envelope.__annotations__})
    except ValueError as error:
        raise InputError(f"the envelope: {error}") from None
    designed = design_input(
        model,
        envelope=envelope,
        bracket=bracket,
        duration=duration,
        dt=dt,
        channels=channels,
        start_is_known=start_is_known,
        criterion=criterion,
        bandwidth=bandwidth,
        key=key,
        progress=progress,
    )
    usual = np.asarray(model.half_width)
    if not (designed.bounds[-1] < usual).any():
        raise InputError("the limits leave too little room: no input within them tells anything; widen them.")
    progress("the standard inputs")
    plan, standard = plan_of(model, envelope, bracket, dt, channels, SENSOR_SIGMA, start_is_known, key), {}
    for name, make in EXCITATIONS.items():
        try:
            omega = make(model.airframe, duration=duration, dt=dt)
        except ValueError:  # too short
            continue
        standard[name] = fitted(plan, omega)
    return InputDesign(
        envelope=envelope,
        designed=designed,
        standard=standard,
        names=model.parameter_names,
        units=model.parameter_units,
        half_width=np.asarray(bracket.half_width),
        usual=usual,
        vehicles=VEHICLES,
    )


class ReferenceDesign(NamedTuple):
    """What `jaxos4 design --closed-loop` shows: designed references, and the standard ones of the same length.

    - `inertia`: Ix, Iy and Iz of the airframe [kg m^2]. `prior`: what the bracket says, as standard deviations.
    - `vehicles`: the number of vehicles that stayed within the envelope.
    """

    envelope: Envelope
    designed: DesignedReferences
    standard: dict[str, DesignedReferences]
    inertia: Float[np.ndarray, "3"]
    prior: Float[np.ndarray, " parameters"]
    vehicles: int

    def gain(self, name: str) -> float:
        """The designed bounds of Ix, Iy and Iz over those of standard references, as a geometric mean."""
        own, other = (one.bounds[: len(INERTIAS)] for one in (self.designed, self.standard[name]))
        return float(np.exp(np.log(own / other).mean()))


def design_and_compare_references(
    loop: ClosedLoop,
    *,
    angle: float,
    limits: Mapping[str, float],
    bracket: Bracket,
    duration: float,
    dt: float,
    criterion: str,
    bandwidth: float,
    seed: int,
    progress: Callable[[str], None] = lambda _: None,
) -> ReferenceDesign:
    """Design references and compare them with standard ones. Arguments and errors as of `design_references`."""
    key = jax.random.key(seed)
    plan = plan_references(
        loop,
        angle=angle,
        acceleration=ACCELERATION,
        limits=limits,
        bracket=bracket,
        duration=duration,
        dt=dt,
        criterion=criterion,
        bandwidth=bandwidth,
        key=key,
        progress=progress,
    )
    found, uses = search_references(plan, key=key, progress=progress)
    progress("bounds of designed and standard references")
    judged = plan.judged({"designed": found, **plan.standard}, {"designed": uses})
    return ReferenceDesign(
        envelope=plan.envelope,
        designed=judged.pop("designed"),
        standard=judged,
        inertia=np.asarray(loop.airframe.inertia),
        prior=plan.filters.bounds(np.zeros_like(plan.filters.prior)),
        vehicles=LANES,
    )
