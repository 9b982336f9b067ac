"""Design of rotor speeds for a flight without feedback."""

import math
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, Parameters, Scalar, as_float
from ..bracket import Bracket
from ..errors import InputError
from ..excitation import multisine
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS
from ..noise import SENSOR_SIGMA
from ..simulation import simulate
from .criterion import CRITERIA, criterion_of
from .envelope import Envelope, Uses
from .fitting import VEHICLES, DesignedInput, Plan, drawn, fitted, fly_finely
from .information import sense
from .search import PENALTIES, AbstractTask, Coefficients, begin, minimise
from .steering import Steering

_STARTS, _DRAWS = 4, 4
# The number of vehicles that keep the limits during the search; at the end all of them do.
_LIMITED = 64
# A search starts at about half of the envelope: the length of its coefficients, of which 1 alone uses all of it.
_FIRST = 0.17
_FEWEST_SAMPLES, _MOST_SAMPLES = 50, 2500


class _OpenLoop(AbstractTask):
    """Rotor speeds. The criterion is the mean over `draws`, and the first vehicles of the plan keep the limits."""

    plan: Plan
    steering: Steering
    draws: Float[Array, "draws parameters"]
    half_width: Parameters
    kind: str = eqx.field(static=True)

    def criterion(self, coefficients: Coefficients) -> Scalar:
        """See `AbstractTask`."""
        plan, omega = self.plan, self.steering(coefficients)

        def one(parameters: Parameters) -> Scalar:
            sensed = sense(plan.model, omega, parameters, plan.dt, plan.weights, plan.start_is_known)
            return criterion_of(sensed.information, self.half_width, self.kind)

        return jax.vmap(one)(self.draws).mean()

    def uses(self, coefficients: Coefficients) -> Uses:
        """See `AbstractTask`. The columns of a limit of the states are those of all vehicles."""
        plan, omega, vehicles = self.plan, self.steering(coefficients), self.plan.vehicles[:_LIMITED]
        states = jax.vmap(lambda a: simulate(plan.model, a, omega, dt=plan.dt).states, out_axes=1)(vehicles)
        of_states = jax.vmap(plan.envelope.uses_of_states, in_axes=1, out_axes=1)(states)
        of_states = {name: share.reshape(share.shape[0], -1) for name, share in of_states.items()}
        return plan.envelope.uses_of_rotors(omega, plan.dt) | of_states


def design_input(
    model: AbstractModel,
    *,
    envelope: Envelope | None = None,
    bracket: Bracket | None = None,
    duration: float = 5.0,
    dt: float = 0.01,
    channels: str = "all",
    sigma: Float[Numeric, "12"] = SENSOR_SIGMA,
    start_is_known: bool = False,
    criterion: str = "D",
    bandwidth: float = 4.0,
    key: Key,
    progress: Callable[[str], None] = lambda _: None,
) -> DesignedInput:
    """The rotor speeds that tell the most about a vehicle's parameters within an envelope.

    The input is a multisine. Its amplitudes are searched from several random starts, by the gradient of the simulator.
    The criterion is the mean over vehicles that are drawn from the bracket. At the end 200 vehicles fly the input with
    a tenth of the step, and its amplitude is reduced until all of them stay within the envelope.

    **Arguments:**

    - `envelope`: the limits; by default those that the standard multisine needs (`envelope_of`).
    - `bracket`: what is known of the parameters before the flight; by default the model's.
    - `duration`, `dt`: length and sample time [s].
    - `channels`: what will be measured: `"rates"`, `"attitude"` or `"all"`. `sigma`: its noise, in the order of
      `STATE_NAMES`.
    - `start_is_known`: whether the flight starts exactly at rest. If not, the initial state will be estimated too.
    - `criterion`: `"D"`: the volume of the confidence ellipsoid; `"A"`: the mean squared bound; `"worst"`: the largest
      bound. Bounds are shares of the bracket's half-widths.
    - `bandwidth`: the highest frequency [Hz].
    - `key`: of the draws and the starts. `progress`: called with the name of each stage.

    **Raises:** `InputError` if an argument is out of range or the vehicle cannot hover within the envelope.
    """
    _check_time(duration, dt)
    _check(model, duration, dt, channels, criterion, bandwidth)
    progress("envelope")
    bracket = Bracket.default(model) if bracket is None else bracket
    envelope = envelope_of(model, bracket=bracket, duration=duration, dt=dt, key=key) if envelope is None else envelope
    plan = plan_of(model, envelope, bracket, dt, channels, sigma, start_is_known, key)
    steering = Steering.within(model.airframe, envelope, round(duration / dt) + 1, dt, bandwidth)
    center, others = np.asarray(bracket.center)[None], drawn(bracket, jax.random.fold_in(key, 1), _DRAWS - 1)
    draws = jnp.concatenate([center, others])
    task = _OpenLoop(plan, steering, draws, as_float(bracket.half_width), criterion)
    progress("compiling the search")
    first = jax.random.normal(jax.random.fold_in(key, 2), (_STARTS, steering.scale.size), dtype=float)
    searches = begin(_FIRST / math.sqrt(first.shape[1]) * first)
    for number, penalty in enumerate(PENALTIES, start=1):
        searches = jax.block_until_ready(minimise(task, searches, as_float(penalty)))
        progress(f"search, stage {number} of {len(PENALTIES)}")
    costs = np.asarray(searches.cost)
    best = int(np.argmin(np.where(np.isfinite(costs), costs, np.inf)))
    progress(f"flying {VEHICLES} vehicles")
    return fitted(plan, steering(searches.at[best]))


def envelope_of(
    model: AbstractModel, *, bracket: Bracket | None = None, duration: float = 5.0, dt: float = 0.01, key: Key
) -> Envelope:
    """The envelope that the standard multisine needs, for all vehicles of a bracket.

    **Raises:** `InputError` if it cannot be flown.
    """
    _check_time(duration, dt)
    bracket = Bracket.default(model) if bracket is None else bracket
    try:
        omega = multisine(model.airframe, duration=duration, dt=dt)
    except ValueError as error:
        raise InputError(f"the standard multisine, which sets the envelope: {error}") from None
    states = np.asarray(fly_finely(model, drawn(bracket, key, VEHICLES), omega, as_float(dt)))
    if not np.isfinite(states).all():
        raise InputError("`bracket`: some of its vehicles turn over in the standard multisine; narrow it.")
    return Envelope.of(omega, states, dt)


def plan_of(
    model: AbstractModel,
    envelope: Envelope,
    bracket: Bracket,
    dt: float,
    channels: str,
    sigma: Float[Numeric, "12"],
    start_is_known: bool,
    key: Key,
) -> Plan:
    """What inputs are compared by; arguments as of `design_input`."""
    weights = as_float(1 / np.asarray(sigma)[CASCADE_ORDER[: CHANNELS[channels]]])
    return Plan(model, envelope, drawn(bracket, key, VEHICLES), weights, as_float(dt), start_is_known)


def _check(model: AbstractModel, duration: float, dt: float, channels: str, criterion: str, bandwidth: float) -> None:
    if model.forcing_parameters or model.force_axes:
        raise InputError(
            "`model` must be an OS4 model: a real vehicle needs its controller, and a design of references."
        )
    if not 1 / duration <= bandwidth <= 0.25 / dt:
        raise InputError(
            f"`bandwidth` must lie between 1 / `duration` and a quarter of the sample rate, {1 / duration:.3g} to "
            f"{0.25 / dt:.3g} Hz, got {bandwidth:g} Hz."
        )
    for name, value, choices in (("channels", channels, CHANNELS), ("criterion", criterion, CRITERIA)):
        if value not in choices:
            raise InputError(f"`{name}` must be one of {', '.join(choices)}, got {value!r}.")


def _check_time(duration: float, dt: float) -> None:
    for name, value in (("duration", duration), ("dt", dt)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"`{name}` must be positive and finite [s], got {value:g}.")
    if not _FEWEST_SAMPLES <= duration / dt <= _MOST_SAMPLES:
        most = f"{_FEWEST_SAMPLES} to {_MOST_SAMPLES} samples of {dt:g} s"
        raise InputError(f"`duration` must be {most} (`dt`), got {duration:g} s.")
