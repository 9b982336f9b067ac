"""The design of references, as `fly_closed_loop` takes them, for a real vehicle: sums of tones, which repeat."""

import math
from collections.abc import Mapping
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .._custom_types import Key, Numeric, Scalar, as_float
from ..airframe import INERTIAS
from ..bracket import Bracket
from ..closed_loop import ClosedLoop
from ..errors import InputError
from ..excitation import standard_references, with_largest
from ..flight import ANGLES, RATES
from . import task
from .envelope import Envelope, Uses
from .fleet import LANES, Fleet, batch_of, fly_batch, inertias_first, model_of
from .task import Coefficients, Designed, Flown

# Tones of these amplitudes are flown: angles [rad] and vertical acceleration [m/s^2]. The vehicle is linear for them.
_SMALL = np.array([0.02, 0.02, 0.02, 0.2])
# The search checks the limits at these times, in periods: about eight for each cycle of the fastest tone.
_POINTS = np.arange(200) / 200
_TARGET = 0.995  # references that exceed a limit are reduced to about this share of it
_REDUCTIONS, _LEAST_STEP = 8, 0.7  # the most reductions, and the smallest factor of one of them
_LITTLE = 0.9  # a parameter is excited if its bound is below this share of the bracket's standard deviation


def _tones(bandwidth: float, samples: int, dt: float) -> tuple[int, int]:
    """The period of the references in samples, and the number of tones: the multiples of 1 / period up to a bandwidth.

    There are as many tones as fit into a batch beside eight hovering flights.
    """
    most = (LANES - 1 - 8) // 2
    period = (samples - 1) // max(math.ceil(samples * dt * bandwidth / most), 1)
    return period, max(min(math.floor(bandwidth * period * dt + 1e-9), most), 1)


def _turns(tones: int, periods: Float[np.ndarray, " points"]) -> np.ndarray:
    """exp(i angle) of each of so many tones, at times in periods."""
    return np.exp(2j * math.pi * np.outer(periods, np.arange(1, tones + 1)))


def _parts(turns: np.ndarray) -> Float[np.ndarray, "*some coefficients"]:
    """Cosines of all tones, then their sines."""
    return np.concatenate([np.real(turns), np.imag(turns)], axis=-1)


def _response(
    fleet: Fleet,
    envelope: Envelope,
    largest: Float[np.ndarray, "4"],
    *,
    period: int,
    tones: int,
    samples: int,
    key: Key,
) -> dict[str, Any]:
    """The fields `base`, `added` and `signals` of `ReferenceTask`: each of the `tones` flies in still air.

    For small tones the vehicle is linear. So the information of a sum of tones is the sum of their informations.

    **Raises:** `InputError` if gusts alone use a limit.
    """
    turns = _turns(tones, np.arange(samples) / period)
    references = np.zeros((LANES, samples, 4))
    references[:tones, :, :3] = _SMALL[:3] * np.real(turns).T[:, :, None]
    references[tones : 2 * tones, :, 3] = _SMALL[3] * np.real(turns).T
    in_gusts = np.arange(LANES) > 2 * tones  # the one before is in still air, and has no reference
    flights = fly_batch(batch_of(fleet.loop, in_gusts), jnp.asarray(references), as_float(fleet.dt), key)
    states, (whole, by_channel) = np.asarray(flights.states), map(np.asarray, fleet.informations(flights))
    excess = by_channel - by_channel[2 * tones]
    each = np.stack([*np.moveaxis(excess[:tones, :3], 1, 0), excess[tones : 2 * tones].sum(axis=1)])
    # In still air nothing is learned about the noise.
    beyond = whole.shape[-1] - by_channel.shape[-1]
    each = fleet.about_inertias(np.pad(each, ((0, 0), (0, 0), (0, beyond), (0, beyond))))
    base = fleet.with_prior(whole[in_gusts].mean(axis=0))
    scale = np.sqrt(np.diagonal(base))
    scale[: len(INERTIAS)] = 1  # their bounds are relative already
    unit = np.outer(scale, scale)
    # The responses in the last period, in which the beginning is forgotten.
    last = np.conj(turns[-period:]) * 2 / period
    signals = {}
    for name, columns in (("angle", ANGLES), ("rate", RATES)):
        left = np.asarray(getattr(envelope, name)) - np.abs(states[in_gusts][..., columns]).max(axis=(0, 1))
        if (left <= 0).any():
            raise _too_gusty(name)
        responses = np.einsum("kta,tk->ak", states[:tones, -period:, columns], last) / _SMALL[:3, None]
        moving = _parts(responses[:, None] * _turns(tones, _POINTS))
        signals[name] = jnp.asarray(moving * (largest[:3] / left)[:, None, None])
    relative = np.square(largest / _SMALL)[:, None, None, None]
    return {"base": jnp.asarray(base / unit), "added": jnp.asarray(relative * each / unit), "signals": signals}


class ReferenceTask(task.AbstractTask):
    """References for a controller. The targets are Ix, Iy and Iz; a coefficient of 1 is a tone of the largest value.

    - `scale`: the moments of inertia [kg m^2]. `unexcited`: almost the standard deviations of the bracket.
    - `base`: information of a flight in gusts without references, with the prior. `added`: by a unit of each tone of
      each reference. Both are about the inertias first.
    - `signals`: the angles and rates of an axis by a unit of the coefficients of its reference, cosines first, as a
      share of the part of the limit that gusts leave; by the name of the limit.
    - `largest`: the largest value of each reference.
    - `period`: in samples, after which the references repeat. `tones`: their number.
    """

    kind: ClassVar[str] = "references"
    vehicles: ClassVar[int] = LANES
    starts: ClassVar[int] = 8
    first: ClassVar[float] = 0.85
    steps: ClassVar[int] = 100

    names: tuple[str, ...] = eqx.field(static=True)
    units: tuple[str, ...] = eqx.field(static=True)
    envelope: Envelope
    scale: Float[Numeric, "3"]
    unexcited: Float[Numeric, " parameters"]
    fleet: Fleet
    base: Float[Numeric, "unknowns unknowns"]
    added: Float[Numeric, "references tones unknowns unknowns"]
    signals: dict[str, Float[Numeric, "axes points coefficients"]]
    largest: Float[Numeric, "4"]
    period: int = eqx.field(static=True)
    tones: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    criterion: str = eqx.field(static=True)

    write = staticmethod(task.write_references)

    @property
    def size(self) -> int:
        """A cosine and a sine for each tone of each reference."""
        return 8 * self.tones

    def objective(self, coefficients: Coefficients) -> Scalar:
        """See `AbstractTask`."""
        cosines, sines = jnp.moveaxis(coefficients.reshape(4, 2, -1), 1, 0)
        added = jnp.einsum("rk,rkuv->uv", jnp.square(cosines) + jnp.square(sines), self.added)
        return task.criterion_of(jnp.asarray(self.base) + added, jnp.ones(len(INERTIAS), dtype=float), self.criterion)

    def uses(self, coefficients: Coefficients) -> Uses:
        """See `AbstractTask`."""
        each = coefficients.reshape(4, -1)
        moved = {name: jnp.einsum("apk,ak->pa", some, each[:3]) for name, some in self.signals.items()}
        return moved | {"reference": as_float(_parts(_turns(self.tones, _POINTS))) @ each.T}

    def flown(self, coefficients: Float[np.ndarray, " coefficients"]) -> Flown:
        """See `AbstractTask`. The references have their largest values, or are reduced to a share of them."""
        basis = _parts(_turns(self.tones, np.arange(self.samples) / self.period))
        inputs = with_largest(basis @ coefficients.reshape(4, -1).T, np.asarray(self.largest))
        uses, factor, still = self.fleet.uses(inputs, self.envelope), 1.0, None
        for _ in range(_REDUCTIONS):
            if max(uses.values()) <= 1:
                break
            still = still or self.fleet.uses(0 * inputs, self.envelope)
            steps = [1.0]
            for name, share in uses.items():
                if still[name] >= 1:
                    raise _too_gusty(name)
                if share > 1:  # the share that gusts do not use grows about linearly with the references
                    steps.append((_TARGET - still[name]) / (share - still[name]))
            factor *= max(min(steps), _LEAST_STEP)
            uses = self.fleet.uses(factor * inputs, self.envelope)
        if max(uses.values()) > 1:
            raise InputError("no references keep the limits; give weaker gusts, or wider limits.")
        return factor * inputs, uses | {"reference": factor}

    def standard(self) -> dict[str, Flown]:
        """See `AbstractTask`. They have the largest values of the references, whatever the limits."""
        shapes = standard_references(self.samples, self.fleet.dt, np.asarray(self.largest))
        return {name: (shape, {}) for name, shape in shapes.items()}

    def judged(self, flown: Mapping[str, Flown]) -> dict[str, Designed]:
        """See `AbstractTask`. The bounds are those of filter error, after a flight through gusts."""
        bounds, dt = self.fleet.bounds({name: references for name, (references, _) in flown.items()}), self.fleet.dt
        period = dt * self.period
        return {name: Designed(inputs, dt, bounds[name], uses, period) for name, (inputs, uses) in flown.items()}


def design_references(
    loop: ClosedLoop,
    *,
    angle: float = 0.3,
    acceleration: float = 1.5,
    limits: Mapping[str, float] | None = None,
    bracket: Bracket | None = None,
    duration: float = 20.0,
    dt: float = 0.004,
    criterion: str = "D",
    bandwidth: float = 6.0,
    compare: bool = False,
    key: Key | int,
    progress: task.Progress = lambda _: None,
) -> task.Design:
    """Design the references with which filter error identifies the moments of inertia of a vehicle most accurately.

    Each reference is a sum of tones, which repeats. The simulator flies each tone once; the search for the amplitudes
    and phases is then algebra. At the end 64 vehicles from the bracket fly the references through gusts, and the
    references are reduced until all of them stay within the limits.

    - `loop`: the vehicle, its controller, its gusts and its sensors.
    - `angle`: the largest reference of roll, pitch and yaw [rad], at most 1. `acceleration`: the largest vertical one
      [m/s^2], at most 5.
    - `limits`: some limits of an `Envelope`, by name, but not `slew`. The others are those that 3-2-1-1 references with
      the same largest values need; those of rotor speeds are the airframe's.
    - `bracket`: of a `FlightModel`; by default the model's.
    - The others: as of `design_input`. The criterion is of the logarithms of Ix, Iy and Iz.

    **Raises:** `InputError` if an argument is out of range, or the vehicle cannot fly within the limits.
    """
    for name, value, most in (("angle", angle, 1.0), ("acceleration", acceleration, 5.0)):
        if not 0 < value <= most:
            raise InputError(f"`{name}` must be positive and at most {most:g}, got {value:g}.")
    if "slew" in (limits or {}):
        raise InputError("`limits`: `slew` is a limit of rotor speeds, and a controller has none; leave it out.")
    task.check_settings(duration, dt, bandwidth, criterion, samples=(250, 20_000), cycles=2, fastest=0.1)
    progress("limits")
    key = jax.random.key(key) if isinstance(key, int) else key
    bracket = Bracket.default(model_of(loop)) if bracket is None else bracket
    samples, largest = round(duration / dt) + 1, np.array([angle, angle, angle, acceleration])
    fleet = Fleet.of(loop, bracket, dt, key)
    envelope = fleet.envelope(standard_references(samples, dt, largest)["3211"], limits or {})
    period, tones = _tones(bandwidth, samples, dt)
    progress("flying tones")
    references = ReferenceTask(
        names=inertias_first(INERTIAS, fleet.model.parameter_names),
        units=inertias_first(("kg m^2",) * len(INERTIAS), fleet.model.parameter_units),
        envelope=envelope,
        scale=np.asarray(loop.airframe.inertia),
        unexcited=_LITTLE * fleet.bounds_from(np.zeros((fleet.prior.shape[0],) * 2)),
        fleet=fleet,
        largest=largest,
        period=period,
        tones=tones,
        samples=samples,
        criterion=criterion,
        **_response(
            fleet,
            envelope,
            largest,
            period=period,
            tones=tones,
            samples=samples,
            key=jax.random.fold_in(key, 3),
        ),
    )
    return task.design(references, compare=compare, key=key, progress=progress)


def _too_gusty(name: str) -> InputError:
    return InputError(f"gusts alone need the whole `{name}`, without references; give weaker gusts, or a wider limit.")
