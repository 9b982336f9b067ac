"""The design of rotor speeds for an OS4 without feedback: a multisine that all vehicles of a bracket can fly."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.optimize
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, Parameters, RotorSpeeds, Scalar, as_float
from .._xla import quick_jit
from ..airframe import Airframe
from ..bracket import Bracket
from ..errors import InputError, check_choice, named
from ..excitation import EXCITATIONS, multisine
from ..flight import Inputs
from ..linalg import covariance_of_shared
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS, Forcing, State, unstack
from ..noise import SENSOR_SIGMA
from ..simulation import euler_step, simulate, trajectory
from . import task
from .envelope import Envelope, Uses, hover_squares
from .task import Coefficients, Designed, Flown, Series

_VEHICLES, _CORNERS = 200, 100  # that must keep the limits; the last of them are corners of the bracket
_AVERAGED = 4  # the criterion is the mean over this many of them
# Vehicles that each stage of the search watches. The first of them become those that use the most of a limit by then.
_WATCHED = 40
_TARGET = 0.95  # the largest share of a limit: other vehicles from the bracket may need a little more
_FINER = 10  # steps in a sample of the flights that must keep the limits
_SLOWEST_TONE = 0.3  # Hz; a slower tone has the amplitude of this one, because angles would allow almost none
_LEAST = 1e-6  # rad^2/s^2; squared rotor speeds stay above this, which is outside of the envelope
_AMPLIFIED = 100.0  # a standard input is multiplied by at most about this factor
_PRECISION = 1e-3  # relative, of that factor
_FAR = 10.0  # an input that uses a larger share of a limit counts as if it used this share
_REDUCED, _SMALLEST = 0.9, 1e-3  # the factor of one reduction of an amplitude, and of all reductions together
_CORRECTIONS = 5  # times that the margin is widened, at most, until the limits are kept between samples too


class RotorSpeedTask(task.AbstractTask):
    """Rotor speeds for which angular and vertical accelerations are sums of cosines.

    The frequencies are the multiples of 1 / (2 duration) up to a bandwidth. Such cosines can make every input of this
    bandwidth, so only amplitudes are searched: a phase follows from neighbouring tones.

    - `scale`: the half-widths of the bracket. `unexcited`: those of the model's default bracket.
    - `tones`: each tone at each sample. `weights`: 1 / sigma of each channel, in cascade order.
    - `amplitudes`: of each tone for a coefficient of 1, about as large as the envelope allows: for roll, pitch, yaw
      [rad/s^2] and vertical acceleration [m/s^2].
    - `hover`: squared rotor speeds that carry the weight [rad^2/s^2]. `action`: their change by a unit of each
      acceleration.
    - `fleet`: the parameters of the vehicles that must stay within the envelope, of which the first are averaged over.
      `watched`: of those that do so in the search.
    """

    kind: ClassVar[str] = "rotor speeds"
    vehicles: ClassVar[int] = _VEHICLES
    starts: ClassVar[int] = 2
    first: ClassVar[float] = 0.1  # a coefficient of 1 alone uses the whole envelope
    steps: ClassVar[int] = 60  # 100 find no better inputs, 40 find worse ones

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    envelope: Envelope
    scale: Float[Numeric, " parameters"]
    unexcited: Float[Numeric, " parameters"]
    model: AbstractModel
    tones: Float[Array, "samples tones"] = eqx.field(converter=as_float)
    amplitudes: Float[Array, "4 tones"] = eqx.field(converter=as_float)
    hover: Float[Array, "4"] = eqx.field(converter=as_float)
    action: Float[Array, "4 4"] = eqx.field(converter=as_float)
    fleet: Float[Array, "vehicles parameters"]
    watched: Float[Array, "watched parameters"]
    weights: Float[Array, " sensors"]
    dt: Scalar
    start_is_known: bool = eqx.field(static=True)
    criterion: str = eqx.field(static=True)

    write = staticmethod(task.write_input)

    @property
    def size(self) -> int:
        """A coefficient for each tone of each acceleration."""
        return self.amplitudes.size

    def _omega(self, coefficients: Coefficients) -> RotorSpeeds:
        """The rotor speeds [rad/s]."""
        acceleration = self.tones @ (self.amplitudes * coefficients.reshape(self.amplitudes.shape)).T
        return jnp.sqrt(jnp.maximum(self.hover + acceleration @ self.action.T, _LEAST))

    def objective(self, coefficients: Coefficients) -> Scalar:
        """See `AbstractTask`."""
        omega = self._omega(coefficients)

        def one(parameters: Parameters) -> Scalar:
            slopes = self._sense(omega, parameters)
            information = jnp.einsum("tsu,tsv->uv", slopes, slopes)
            return task.criterion_of(information, jnp.asarray(self.scale), self.criterion)

        return jax.vmap(one)(self.fleet[:_AVERAGED]).mean()

    def uses(self, coefficients: Coefficients) -> Uses:
        """See `AbstractTask`."""
        omega = self._omega(coefficients)
        rest = jnp.zeros(12, dtype=float)
        states = jax.vmap(lambda a: trajectory(self.model, a, omega, self.dt, rest, euler_step))(self.watched)
        return {name: use / _TARGET for name, use in self.envelope.uses(omega, states, self.dt).items()}

    def watching(self, coefficients: Coefficients) -> "RotorSpeedTask":
        """See `AbstractTask`. Some make room for those that now use the most of a limit."""
        omega = self._omega(coefficients)
        states = np.asarray(fly_finely(self.model, self.fleet, omega, self.dt, 1))
        uses = jax.tree.map(np.asarray, self.envelope).uses(np.asarray(omega), states, float(self.dt))
        largest = [np.nan_to_num(np.abs(use).max(axis=1), nan=np.inf) for use in uses.values() if use.ndim == 3]
        most = self.fleet[np.concatenate(largest, axis=1).argmax(axis=0)]
        return dataclasses.replace(self, watched=jnp.concatenate([most, self.watched[: -len(most)]]))

    def flown(self, coefficients: Float[np.ndarray, " coefficients"]) -> Flown:
        """See `AbstractTask`."""
        omega = np.asarray(self._omega(as_float(coefficients)))
        found = self._amplified(omega, 1.0, _FINER)
        return found if max(found[1].values()) <= 1 else self._within_limits(omega)

    def _amplified(self, inputs: Series, factor: float, finer: int = 1) -> Flown:
        """The input with all accelerations multiplied, and the largest share of each limit of all vehicles."""
        hover = np.asarray(self.hover)
        omega = np.sqrt(np.maximum(hover + factor * (np.square(inputs) - hover), 0.0))
        states = fly_finely(self.model, self.fleet, as_float(omega), self.dt, finer)
        return omega, dict(sorted(self.envelope.shares(omega, states, float(self.dt)).items()))

    def _within_limits(self, inputs: Series) -> Flown:
        """The input with the largest amplitude that all vehicles can fly, also with finer steps than samples.

        A smaller amplitude may need more of a limit, so the one next to that of `inputs` is taken.
        """

        def excess(factor: float, target: float) -> float:
            return min(max(self._amplified(inputs, factor)[1].values()), _FAR) - target

        target = _TARGET
        for _ in range(_CORRECTIONS):
            low, high = 1.0, 1.0
            while high < _AMPLIFIED and excess(high, target) < 0:
                low, high = high, 2 * high
            while low > _SMALLEST and excess(low, target) >= 0:
                low, high = _REDUCED * low, low
            if low <= _SMALLEST:
                break
            if excess(high, target) > 0:
                low = float(scipy.optimize.brentq(excess, low, high, (target,), _PRECISION * high))  # type: ignore[arg-type]
            found = self._amplified(inputs, low, _FINER)
            if max(found[1].values()) <= 1:
                return found
            target *= _TARGET / max(found[1].values())
        return self._amplified(inputs, 0.0, _FINER)

    def standard(self) -> dict[str, Flown]:
        """See `AbstractTask`. Each has the largest amplitude that all vehicles can fly."""
        found, dt = {}, float(self.dt)
        for name, make in EXCITATIONS.items():
            try:
                omega = make(self.model.airframe, duration=(self.tones.shape[0] - 1) * dt, dt=dt)
            except ValueError:  # too short
                continue
            found[name] = self._within_limits(np.asarray(omega))
        return found

    def judged(self, flown: Mapping[str, Flown]) -> dict[str, Designed]:
        """See `AbstractTask`. The bounds are those of the airframe's vehicle."""
        judged, dt = {}, float(self.dt)
        for name, (omega, uses) in flown.items():
            history = np.asarray(self._history(as_float(omega)))
            judged[name] = Designed(omega, dt, history[-1], uses, dt * (omega.shape[0] - 1), history)
        return judged

    @quick_jit
    def _history(self, omega: RotorSpeeds) -> Float[Array, "samples parameters"]:
        """The bounds after each sample of a flight of the airframe's vehicle."""
        parameters = self.model.alpha
        slopes = self._sense(omega, parameters)

        def add(total: Float[Array, "unknowns unknowns"], slopes: Float[Array, "sensors unknowns"]):
            total = total + slopes.T @ slopes
            return total, jnp.sqrt(jnp.diagonal(covariance_of_shared(total[None], parameters.shape[0])))

        return jax.lax.scan(add, jnp.zeros((slopes.shape[-1],) * 2, dtype=float), slopes)[1]

    def _sense(self, omega: RotorSpeeds, parameters: Parameters) -> Float[Array, "samples sensors unknowns"]:
        """The derivatives of the weighted outputs of a flight from rest, in the parameters and an unknown start."""
        count, sensors = parameters.shape[0], self.weights.shape[0]
        unknowns = count + (0 if self.start_is_known else sensors)
        identity, scalars = np.eye(unknowns), tuple(parameters)
        starts = np.zeros((12, unknowns))
        starts[: unknowns - count, count:] = np.eye(unknowns - count)
        first, first_slopes = unstack(jnp.zeros(12, dtype=float)), jax.vmap(unstack)(jnp.asarray(starts.T))

        def step(carry: tuple[State, State], forcing: Forcing):
            state, slopes = carry
            following, push = jax.linearize(lambda x, a: euler_step(self.model, x, forcing, a, self.dt), state, scalars)
            carry = following, jax.vmap(push)(slopes, tuple(identity[:, :count].T))
            return carry, carry[1]

        forcing = jax.tree.map(lambda leaf: leaf[:-1], self.model.forcing(Inputs(omega, self.dt), parameters))
        # Recomputing a step is faster than keeping its intermediate values for the reverse pass.
        slopes = jax.lax.scan(jax.checkpoint(step), (first, first_slopes), forcing)[1]
        rows = jnp.concatenate([starts[None, :sensors], jnp.stack(jax.tree.leaves(slopes)[:sensors], axis=1)])
        return self.weights[:, None] * rows


@quick_jit
def drawn(bracket: Bracket, key: Key, count: int) -> Float[Array, "count parameters"]:
    """Vehicles drawn uniformly from the bracket."""
    lower, upper = bracket.lower, bracket.upper
    return lower + (upper - lower) * jax.random.uniform(key, (count, lower.shape[0]), dtype=float)


@quick_jit
def fly_finely(
    model: AbstractModel,
    vehicles: Float[Array, "vehicles parameters"],
    omega: RotorSpeeds,
    dt: Scalar,
    finer: int = _FINER,
) -> Float[Array, "vehicles times 12"]:
    """The states of all vehicles from rest, with `finer` steps in a sample."""
    repeated = jnp.concatenate([jnp.repeat(omega[:-1], finer, axis=0), omega[-1:]])
    return jax.vmap(lambda a: simulate(model, a, repeated, dt=dt / finer).states)(vehicles)


def _tones(airframe: Airframe, envelope: Envelope, samples: int, dt: float, bandwidth: float) -> dict[str, Any]:
    """The fields `tones`, `amplitudes`, `hover` and `action` of `RotorSpeedTask`, with tones up to `bandwidth` [Hz]."""
    duration = (samples - 1) * dt
    frequency = np.arange(math.floor(2 * duration * bandwidth + 1e-9) + 1) / (2 * duration)
    hover = hover_squares(airframe, envelope)
    action = np.linalg.solve(np.asarray(airframe.mixer), np.diag(np.append(airframe.inertia, airframe.mass)))
    speed, limits = np.sqrt(hover), np.asarray([envelope.slowest, envelope.fastest])
    change = (np.abs(action) / (2 * speed)[:, None]).max(axis=0)[:, None]  # of rotor speed, by one unit
    angular = 2 * math.pi * np.maximum(frequency, _SLOWEST_TONE)
    uses = (
        change / np.abs(speed[:, None] - limits).min(),
        change * angular / np.asarray(envelope.slew),
        1 / (angular * np.append(envelope.rate, envelope.velocity)[:, None]),
        1 / (angular**2 * np.append(envelope.angle, envelope.distance)[:, None]),
    )
    tones = np.cos(2 * math.pi * frequency * dt * np.arange(samples)[:, None])
    amplitudes = 1 / np.linalg.norm(np.broadcast_arrays(*uses), axis=0)
    return {"tones": tones, "amplitudes": amplitudes, "hover": hover, "action": action}


def _standard_envelope(model: AbstractModel, vehicles: Array, duration: float, dt: float) -> Envelope:
    with named("the standard multisine, which sets the envelope"):
        omega = multisine(model.airframe, duration=duration, dt=dt)
    states = np.asarray(fly_finely(model, vehicles, omega, as_float(dt)))
    if not np.isfinite(states).all():
        raise InputError("`bracket`: some of its vehicles turn over in the standard multisine; narrow it.")
    return Envelope.of(omega, states, dt)


def design_input(
    model: AbstractModel,
    *,
    limits: Mapping[str, float] | None = None,
    bracket: Bracket | None = None,
    duration: float = 5.0,
    dt: float = 0.01,
    channels: str = "all",
    start_is_known: bool = False,
    criterion: str = "A",
    bandwidth: float = 4.0,
    compare: bool = False,
    key: Key | int,
    progress: task.Progress = lambda _: None,
) -> task.Design:
    """Design the rotor speeds that identify a vehicle's parameters most accurately within an envelope.

    The input is a multisine. Its amplitudes are searched from two random starts, by the gradient of the simulator, for
    the mean criterion over vehicles from the bracket. At the start of each stage of the search, 200 vehicles fly the
    input; at the end they fly it with a tenth of the step too. If one then leaves the envelope, the amplitude is
    reduced.

    - `limits`: some limits of an `Envelope`, by name. The others are those that the standard multisine needs, for all
      vehicles of the `bracket`, which is by default the model's.
    - `duration`, `dt`: length and sample time [s]. `bandwidth`: the highest frequency [Hz].
    - `channels`: what will be measured, with the noise of the standard sensors: `"rates"`, `"attitude"` or `"all"`.
    - `start_is_known`: whether the flight starts exactly at rest. If not, the initial state will be estimated too.
    - `criterion`: `"A"`: the mean squared bound; `"D"`: the volume of the confidence ellipsoid, in which bounds may be
      larger if the parameters correlate; `"worst"`: the largest bound. Bounds are shares of the bracket's half-widths.
    - `compare`: whether to judge the standard inputs in the envelope too.
    - `key`: for the draws and the starts, or a seed. `progress`: called with the name of each stage.

    **Raises:** `InputError` if an argument is out of range, or no input within the envelope hovers and excites a
    parameter.
    """
    task.check_settings(duration, dt, bandwidth, criterion, samples=(50, 2500), cycles=1, fastest=0.25)
    check_choice("channels", channels, CHANNELS)
    if model.forcing_parameters or model.force_axes:
        raise InputError("`model` must be an OS4 model: a real vehicle needs its controller, and `design_references`.")
    progress("envelope")
    key = jax.random.key(key) if isinstance(key, int) else key
    bracket = Bracket.default(model) if bracket is None else bracket
    above = drawn(bracket, jax.random.fold_in(key, 1), _CORNERS) > bracket.center
    inside = drawn(bracket, key, _VEHICLES - _CORNERS - 1)
    vehicles = jnp.concatenate([bracket.center[None], inside, jnp.where(above, bracket.upper, bracket.lower)])
    envelope = _standard_envelope(model, vehicles, duration, dt).limited(limits or {})
    rotor_speeds = RotorSpeedTask(
        **_tones(model.airframe, envelope, round(duration / dt) + 1, dt, bandwidth),
        model=model,
        names=model.parameter_names,
        units=model.parameter_units,
        scale=np.asarray(bracket.half_width),
        unexcited=np.asarray(model.half_width),
        envelope=envelope,
        fleet=vehicles,
        watched=vehicles[:_WATCHED],
        weights=as_float(1 / SENSOR_SIGMA[CASCADE_ORDER[: CHANNELS[channels]]]),
        dt=as_float(dt),
        start_is_known=start_is_known,
        criterion=criterion,
    )
    found = task.design(rotor_speeds, compare=compare, key=key, progress=progress)
    if not (found.designed.bounds < rotor_speeds.unexcited).any():
        raise InputError("the limits are too narrow: no input within them excites a parameter; widen them.")
    return found
