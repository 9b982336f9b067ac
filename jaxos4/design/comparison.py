"""A designed input beside the standard inputs, in the same envelope and time."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..bracket import Bracket
from ..errors import InputError
from ..excitation import EXCITATIONS
from ..models.abstract import AbstractModel
from ..noise import SENSOR_SIGMA
from .envelope import Envelope
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
        usual=np.asarray(model.half_width),
        vehicles=VEHICLES,
    )
