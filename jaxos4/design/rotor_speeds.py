"""The design of rotor speeds for an OS4 without feedback: a multisine that all vehicles of a bracket can fly."""

from collections.abc import Mapping
from os import PathLike
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, Parameters, RotorSpeeds as Speeds, Scalar, as_float
from .._xla import quick_jit
from ..bracket import Bracket
from ..errors import InputError
from ..excitation import EXCITATIONS
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..noise import SENSOR_SIGMA
from ..simulation import simulate
from .envelope import Envelope, Uses, hover_squares, largest
from .files import write_input
from .open_loop import FINER, VEHICLES, Multisine, drawn, envelope_of, fly_finely, sense
from .task import (
    AbstractTask,
    Coefficients,
    Design,
    Designed,
    Flown,
    Inputs,
    Progress,
    Ranges,
    bounds_of,
    criterion_of,
    solve,
)

_RANGES = Ranges(samples=(50, 2500), cycles=1, fastest=0.25)
# The number of vehicles that keep the limits during the search; at the end all of them do.
_LIMITED = 64
# The number of vehicles over which the criterion is averaged.
_DRAWS = 4
# The share of a limit that an input uses at most: other vehicles from the bracket may need a little more.
_TARGET, _PRECISION = 0.95, 1e-3
_MOST_CORRECTIONS, _MOST_AMPLIFIED, _FAR = 5, 100.0, 10.0


class RotorSpeeds(AbstractTask):
    """Rotor speeds, as a multisine. The objective is the mean of the criterion over `draws`.

    - `scale`: the half-widths of the bracket. `unexcited`: those of the model's default bracket.
    - `make`: the rotor speeds for coefficients.
    - `fleet`: the parameters of the vehicles that must stay within the envelope.
    - `weights`: 1 / sigma of each channel, in cascade order.
    - `start_is_known`: whether the flight starts exactly at rest.
    """

    kind: ClassVar[str] = "rotor speeds"
    vehicles: ClassVar[int] = VEHICLES
    starts: ClassVar[int] = 4
    # About half of the envelope: a coefficient of 1 alone uses all of it.
    first: ClassVar[float] = 0.17
    steps: ClassVar[int] = 40

    envelope: Envelope
    scale: Float[Numeric, " parameters"]
    unexcited: Float[Numeric, " parameters"]
    model: AbstractModel
    make: Multisine
    fleet: Float[Array, "vehicles parameters"]
    draws: Float[Array, "draws parameters"]
    weights: Float[Array, " sensors"]
    dt: Scalar
    size: int = eqx.field(static=True)
    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    start_is_known: bool = eqx.field(static=True)
    criterion: str = eqx.field(static=True)

    def objective(self, coefficients: Coefficients) -> Scalar:
        """See `AbstractTask`."""
        omega = self.make(coefficients)

        def one(parameters: Parameters) -> Scalar:
            slopes = sense(self.model, omega, parameters, self.dt, self.weights, self.start_is_known)
            return criterion_of(jnp.einsum("tsu,tsv->uv", slopes, slopes), jnp.asarray(self.scale), self.criterion)

        return jax.vmap(one)(self.draws).mean()

    def uses(self, coefficients: Coefficients) -> Uses:
        """See `AbstractTask`. The columns of a limit of the states are those of all vehicles."""
        omega = self.make(coefficients)
        fly = jax.vmap(lambda a: simulate(self.model, a, omega, dt=self.dt).states, out_axes=1)
        of_states = jax.vmap(self.envelope.uses_of_states, in_axes=1, out_axes=1)(fly(self.fleet[:_LIMITED]))
        of_states = {name: share.reshape(share.shape[0], -1) for name, share in of_states.items()}
        return self.envelope.uses_of_rotors(omega, self.dt) | of_states

    def flown(self, coefficients: Float[np.ndarray, " coefficients"]) -> Flown:
        """See `AbstractTask`."""
        return self.within_limits(np.asarray(self.make(as_float(coefficients))))

    def within_limits(self, inputs: Inputs) -> Flown:
        """The input with the largest amplitude that all vehicles can fly.

        It is found at the sample time, and corrected until the limits hold at a tenth of it.
        """
        hover = hover_squares(self.model.airframe, self.envelope)

        def amplified(factor: float) -> Inputs:
            """The input with all accelerations multiplied."""
            return np.sqrt(np.maximum(hover + factor * (np.square(inputs) - hover), 0.0))

        def used(factor: float, finer: int = 1) -> dict[str, float]:
            shares = _largest_uses(self, as_float(amplified(factor)), finer)
            return {name: float(np.max(share)) for name, share in shares.items()}

        def excess(factor: float, target: float) -> float:
            return min(max(used(factor).values()), _FAR) - target

        target = _TARGET
        for _ in range(_MOST_CORRECTIONS):
            high = 1.0
            while high < _MOST_AMPLIFIED and excess(high, target) < 0:
                high *= 2
            if excess(0.0, target) >= 0:
                high = 0.0
            elif excess(high, target) > 0:
                found = scipy.optimize.brentq(excess, 0.0, high, (target,), _PRECISION * high)
                high = float(found)  # type: ignore[arg-type]
            uses = used(high, FINER)
            if max(uses.values()) <= 1:
                return amplified(high), uses
            target *= _TARGET / max(uses.values())
        return amplified(0.0), used(0.0, FINER)

    def standard(self) -> dict[str, Flown]:
        """See `AbstractTask`. Each has the largest amplitude that all vehicles can fly."""
        found, dt = {}, float(self.dt)
        for name, make in EXCITATIONS.items():
            try:
                omega = make(self.model.airframe, duration=(self.make.tones.shape[0] - 1) * dt, dt=dt)
            except ValueError:  # too short
                continue
            found[name] = self.within_limits(np.asarray(omega))
        return found

    def judged(self, flown: Mapping[str, Flown]) -> dict[str, Designed]:
        """See `AbstractTask`. The bounds are those of the airframe's vehicle."""
        judged, dt = {}, float(self.dt)
        for name, (omega, uses) in flown.items():
            history = np.asarray(_histories(self, as_float(omega)))
            judged[name] = Designed(omega, dt, history[-1], uses, dt * (omega.shape[0] - 1), history)
        return judged

    def write(self, designed: Designed, path: str | PathLike[str]) -> None:
        """See `write_input`."""
        write_input(designed, path)


def design_input(
    model: AbstractModel,
    *,
    limits: Envelope | Mapping[str, float] | None = None,
    bracket: Bracket | None = None,
    duration: float = 5.0,
    dt: float = 0.01,
    channels: str = "all",
    sigma: Float[Numeric, "12"] = SENSOR_SIGMA,
    start_is_known: bool = False,
    criterion: str = "D",
    bandwidth: float = 4.0,
    compare: bool = False,
    key: Key | int,
    progress: Progress = lambda _: None,
) -> Design:
    """Design the rotor speeds that identify a vehicle's parameters most accurately within an envelope.

    The input is a multisine. Its amplitudes are searched from random starts, by the gradient of the simulator. The
    criterion is the mean over vehicles from the bracket. At the end 200 vehicles fly the input with a tenth of the
    step, and its amplitude is reduced until all of them stay within the envelope.

    **Arguments:**

    - `limits`: an `Envelope`, or some of its limits by name. The others are those that the standard multisine needs
      (`envelope_of`).
    - `bracket`: the knowledge of the parameters before the flight; by default the model's.
    - `duration`, `dt`: length and sample time [s].
    - `channels`: the channels that will be measured: `"rates"`, `"attitude"` or `"all"`.
    - `sigma`: their noise, in the order of `STATE_NAMES`.
    - `start_is_known`: whether the flight starts exactly at rest. If not, the initial state will be estimated too.
    - `criterion`: `"D"`: the volume of the confidence ellipsoid; `"A"`: the mean squared bound; `"worst"`: the largest
      bound. Bounds are shares of the bracket's half-widths.
    - `bandwidth`: the highest frequency [Hz].
    - `compare`: whether to judge the standard inputs in the same envelope too.
    - `key`: for the draws and the starts, or a seed. `progress`: called with the name of each stage.

    **Raises:** `InputError` if an argument is out of range, the vehicle cannot hover within the envelope, or no input
    within it excites a parameter.
    """
    _RANGES.check(duration, dt, bandwidth, criterion)
    _check(model, channels)
    progress("envelope")
    key = jax.random.key(key) if isinstance(key, int) else key
    bracket = Bracket.default(model) if bracket is None else bracket
    envelope = limits
    if not isinstance(envelope, Envelope):
        envelope = envelope_of(model, bracket=bracket, duration=duration, dt=dt, key=key).limited(limits or {})
    center, others = np.asarray(bracket.center)[None], drawn(bracket, jax.random.fold_in(key, 1), _DRAWS - 1)
    make = Multisine.within(model.airframe, envelope, round(duration / dt) + 1, dt, bandwidth)
    task = RotorSpeeds(
        envelope=envelope,
        scale=np.asarray(bracket.half_width),
        unexcited=np.asarray(model.half_width),
        model=model,
        make=make,
        fleet=drawn(bracket, key, VEHICLES),
        draws=jnp.concatenate([center, others]),
        weights=as_float(1 / np.asarray(sigma)[CASCADE_ORDER[: CHANNELS[channels]]]),
        dt=as_float(dt),
        size=make.scale.size,
        names=model.parameter_names,
        units=model.parameter_units,
        start_is_known=start_is_known,
        criterion=criterion,
    )
    found = solve(task, compare=compare, key=key, progress=progress)
    if not (found.designed.bounds < task.unexcited).any():
        raise InputError("the limits are too narrow: no input within them excites a parameter; widen them.")
    return found


def _check(model: AbstractModel, channels: str) -> None:
    if channels not in CHANNELS:
        raise InputError(f"`channels` must be one of {', '.join(CHANNELS)}, got {channels!r}.")
    if model.forcing_parameters or model.force_axes:
        raise InputError("`model` must be an OS4 model: a real vehicle needs its controller, and `design_references`.")


@quick_jit
def _largest_uses(task: RotorSpeeds, omega: Speeds, finer: int) -> dict[str, Float[Array, " columns"]]:
    """The largest share of each limit that one of the vehicles uses."""
    flown = fly_finely(task.model, task.fleet, omega, task.dt, finer)
    of_states = jax.vmap(lambda states: largest(task.envelope.uses_of_states(states)))(flown)
    return largest(task.envelope.uses_of_rotors(omega, task.dt)) | jax.tree.map(lambda x: x.max(axis=0), of_states)


@quick_jit
def _histories(task: RotorSpeeds, omega: Speeds) -> Float[Array, "samples parameters"]:
    """The bounds after each sample of a flight of the airframe's vehicle."""
    parameters = task.model.alpha
    slopes = sense(task.model, omega, parameters, task.dt, task.weights, task.start_is_known)

    def add(total: Float[Array, "unknowns unknowns"], slopes: Float[Array, "sensors unknowns"]):
        total = total + slopes.T @ slopes
        return total, jnp.sqrt(jnp.diagonal(bounds_of(total, parameters.shape[0])[0]))

    nothing = jnp.zeros((slopes.shape[-1],) * 2, dtype=float)
    return jax.lax.scan(add, nothing, slopes)[1]
