"""Design of references for a real vehicle, which flies under its controller."""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._custom_types import Key, Numeric, Scalar, as_float
from ..bracket import Bracket
from ..closed_loop import ClosedLoop
from ..errors import InputError
from .criterion import CRITERIA, criterion_of
from .envelope import Envelope, Uses
from .filtered import INERTIAS, Filters, model_of
from .fleet import Fleet
from .references import Shape, standard_references
from .response import Response, Tones, respond
from .search import PENALTIES, AbstractTask, Coefficients, begin, minimise

_STARTS = 8
# The last penalty is repeated: stages are fast, because the task is algebra.
_STAGES = (*PENALTIES, *PENALTIES[-1:] * 10)
# Times in periods at which the search looks, about eight for each cycle of the fastest tone.
_POINTS = np.arange(200) / 200
# A search starts at about this share of the largest references.
_FIRST = 0.3
# References that need too much are reduced: to about this share of a limit, so often, each time not below this factor.
_TARGET, _MOST_REDUCTIONS, _LEAST_STEP = 0.97, 8, 0.7
_FEWEST_SAMPLES, _MOST_SAMPLES = 250, 20_000
ACCELERATION = 1.5
"""The largest reference of the vertical acceleration by default [m/s^2]."""

_LARGEST_ANGLE, _LARGEST_ACCELERATION = 1.0, 5.0


class DesignedReferences(NamedTuple):
    """References for a controller, and what a flight with them tells.

    - `references`: roll, pitch and yaw angle [rad] and vertical acceleration [m/s^2] in each sample, as
      `fly_closed_loop` takes them. `dt`: the sample time [s].
    - `period`: after which designed references repeat [s].
    - `names`, `units`, `bounds`: of Ix, Iy, Iz and the other parameters: the smallest standard deviation that filter
      error can reach after this flight through gusts.
    - `uses`: by the name of the limit, the largest share of it that any of the drawn vehicles uses; at most 1.
    """

    references: Float[np.ndarray, "samples 4"]
    dt: float
    period: float
    names: tuple[str, ...]
    units: tuple[str, ...]
    bounds: Float[np.ndarray, " parameters"]
    uses: dict[str, float]

    @property
    def duration(self) -> float:
        """The length of the flight [s]."""
        return self.dt * (self.references.shape[0] - 1)

    def shortest(self, wanted: Float[Numeric, "3"]) -> Float[np.ndarray, "3"]:
        """The shortest flights [s] after which Ix, Iy and Iz can have the standard deviations `wanted` [kg m^2].

        The references are repeated, or cut. Each period adds the same information, so the bounds fall with the square
        root of the duration. This is not exact for a fraction of a period.
        """
        return self.duration * np.square(self.bounds[: len(INERTIAS)] / np.asarray(wanted))


class ReferencePlan(NamedTuple):
    """What references of one length are designed for and compared by.

    - `largest`: the largest value of each reference.
    - `standard`: the standard references with these largest values, by name.
    - `tones`: of which designed references are made. `criterion`: what they minimise.
    """

    fleet: Fleet
    filters: Filters
    envelope: Envelope
    largest: Float[np.ndarray, "4"]
    standard: dict[str, Shape]
    tones: Tones
    criterion: str

    def judged(
        self, references: Mapping[str, Shape], uses: Mapping[str, dict[str, float]]
    ) -> dict[str, DesignedReferences]:
        """Each of several references with its bounds. `uses`: of the limits, by name of those that have been flown."""
        dt, names, units = self.fleet.dt, self.filters.names, self.filters.units
        bounds, period = self.fleet.bounds(self.filters, references), self.tones.period * dt
        return {
            name: DesignedReferences(some, dt, period, names, units, bounds[name], uses.get(name, {}))
            for name, some in references.items()
        }


class _References(AbstractTask):
    """Sums of tones. A coefficient of 1 is a tone with the largest value of its reference.

    - `base`, `tones`: information without references, and of each tone, about the inertias first.
    - `basis`: the tones at the points of a period. `signals`: what they do, as shares of what gusts leave of a limit.
    """

    base: Float[Array, "unknowns unknowns"]
    tones: Float[Array, "references count unknowns unknowns"]
    basis: Float[Array, "points coefficients"]
    signals: dict[str, Float[Array, "axes points coefficients"]]
    kind: str = eqx.field(static=True)

    @classmethod
    def of(cls, plan: ReferencePlan, response: Response) -> "_References":
        """The task of a plan. Raises `InputError` if gusts leave nothing of a limit."""
        base = plan.filters.about_inertias(np.asarray(plan.filters.prior) + response.hovering)
        each = plan.filters.about_inertias(response.tones) * np.square(plan.largest)[:, None, None, None]
        scale = np.sqrt(np.diagonal(base))
        scale[: len(INERTIAS)] = 1  # their bounds are relative already
        signals = {}
        for name, gusty in response.gusty.items():
            room = np.asarray(getattr(plan.envelope, name)) - gusty
            if (room <= 0).any():
                raise _too_gusty(name)
            signals[name] = jnp.asarray(response.signals[name] * (plan.largest[:3] / room)[:, None, None])
        unit = np.outer(scale, scale)
        basis = as_float(plan.tones.basis(_POINTS))
        return cls(jnp.asarray(base / unit), jnp.asarray(each / unit), basis, signals, plan.criterion)

    def criterion(self, coefficients: Coefficients) -> Scalar:
        """See `AbstractTask`."""
        cosines, sines = jnp.moveaxis(coefficients.reshape(len(self.tones), 2, -1), 1, 0)
        information = self.base + jnp.einsum("rk,rkuv->uv", jnp.square(cosines) + jnp.square(sines), self.tones)
        return criterion_of(information, jnp.ones(len(INERTIAS), dtype=float), self.kind)

    def uses(self, coefficients: Coefficients) -> Uses:
        """See `AbstractTask`."""
        each = coefficients.reshape(len(self.tones), -1)
        flown = {name: jnp.einsum("apk,ak->pa", signal, each[:3]) for name, signal in self.signals.items()}
        return flown | {"reference": self.basis @ each.T}


def design_references(
    loop: ClosedLoop,
    *,
    angle: float = 0.3,
    acceleration: float = ACCELERATION,
    limits: Mapping[str, float] | None = None,
    bracket: Bracket | None = None,
    duration: float = 20.0,
    dt: float = 0.004,
    criterion: str = "D",
    bandwidth: float = 6.0,
    key: Key,
    progress: Callable[[str], None] = lambda _: None,
) -> DesignedReferences:
    """The references that tell filter error the most about the moments of inertia of a vehicle in closed loop.

    Each reference is a sum of tones, which repeats. The simulator flies each tone once; the search for the amplitudes
    and phases is then algebra. At the end 64 vehicles with moments of inertia from the bracket fly the references
    through gusts, and the references are reduced until all of them stay within the limits.

    **Arguments:**

    - `loop`: the vehicle, its controller, its gusts and its sensors.
    - `angle`, `acceleration`: the largest reference of roll, pitch and yaw [rad] and of the vertical acceleration
      [m/s^2].
    - `limits`: of what is flown, by the names of the fields of `Envelope`, but not `slew`. By default those that
      3-2-1-1 references with the same largest values need; those of rotor speeds are the airframe's.
    - `bracket`: what is known of the parameters of a `FlightModel` before the flight; by default the model's.
    - `duration`, `dt`: length and sample time [s].
    - `criterion`: as of `design_input`, for the logarithms of Ix, Iy and Iz.
    - `bandwidth`: the highest frequency [Hz].
    - `key`: of the draws, the gusts and the starts. `progress`: called with the name of each stage.

    **Raises:** `InputError` if an argument is out of range, or the vehicle cannot fly within the limits.
    """
    plan = plan_references(
        loop,
        angle=angle,
        acceleration=acceleration,
        limits={} if limits is None else limits,
        bracket=Bracket.default(model_of(loop)) if bracket is None else bracket,
        duration=duration,
        dt=dt,
        criterion=criterion,
        bandwidth=bandwidth,
        key=key,
        progress=progress,
    )
    found, uses = search_references(plan, key=key, progress=progress)
    progress("bounds")
    return plan.judged({"designed": found}, {"designed": uses})["designed"]


def plan_references(
    loop: ClosedLoop,
    *,
    angle: float,
    acceleration: float,
    limits: Mapping[str, float],
    bracket: Bracket,
    duration: float,
    dt: float,
    criterion: str,
    bandwidth: float,
    key: Key,
    progress: Callable[[str], None],
) -> ReferencePlan:
    """The plan of references; arguments and errors as of `design_references`."""
    for name, value, most in (("angle", angle, _LARGEST_ANGLE), ("acceleration", acceleration, _LARGEST_ACCELERATION)):
        if not 0 < value <= most:
            raise InputError(f"`{name}` must be positive and at most {most:g}, got {value:g}.")
    for name, value in (("duration", duration), ("dt", dt)):
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"`{name}` must be positive and finite [s], got {value:g}.")
    if not _FEWEST_SAMPLES <= duration / dt <= _MOST_SAMPLES:
        allowed = f"{_FEWEST_SAMPLES} to {_MOST_SAMPLES} samples of {dt:g} s (`dt`)"
        raise InputError(f"`duration` must be {allowed}, got {duration:g} s; longer flights repeat the references.")
    if criterion not in CRITERIA:
        raise InputError(f"`criterion` must be one of {', '.join(CRITERIA)}, got {criterion!r}.")
    if not 2 / duration <= bandwidth <= 0.1 / dt:
        raise InputError(
            f"`bandwidth` must lie between 2 / `duration` and a tenth of the sample rate, {2 / duration:.3g} to "
            f"{0.1 / dt:.3g} Hz, got {bandwidth:g} Hz."
        )
    progress("limits")
    samples, largest = round(duration / dt) + 1, np.array([angle, angle, angle, acceleration])
    fleet, filters = Fleet.of(loop, bracket, dt, key), Filters.of(loop, bracket.half_width, dt)
    standard, tones = standard_references(samples, dt, largest), Tones.up_to(bandwidth, samples, dt)
    envelope = fleet.envelope(standard["3211"], limits)
    return ReferencePlan(fleet, filters, envelope, largest, standard, tones, criterion)


def search_references(
    plan: ReferencePlan, *, key: Key, progress: Callable[[str], None]
) -> tuple[Shape, dict[str, float]]:
    """The best references of a plan, and what they use of the limits."""
    fleet, tones, samples = plan.fleet, plan.tones, plan.standard["3211"].shape[0]
    progress("flying tones")
    response = respond(fleet.loop, plan.filters, tones, samples, fleet.dt, _POINTS, jax.random.fold_in(key, 3))
    task = _References.of(plan, response)
    progress("search")
    first = jax.random.normal(jax.random.fold_in(key, 2), (_STARTS, 8 * tones.count), dtype=float)
    searches = begin(_FIRST / math.sqrt(tones.count) * first)
    for penalty in _STAGES:
        searches = minimise(task, searches, as_float(penalty))
    costs = np.asarray(searches.cost)
    best = np.asarray(searches.at)[np.argmin(np.where(np.isfinite(costs), costs, np.inf))]
    shape = tones.basis(np.arange(samples) / tones.period) @ best.reshape(4, -1).T
    references = plan.largest * shape / np.maximum(np.abs(shape).max(axis=0), 1e-9)
    progress("flying vehicles")
    factor, uses = _reduced(plan, references)
    return factor * references, uses | {"reference": factor}


def _reduced(plan: ReferencePlan, references: Shape) -> tuple[float, dict[str, float]]:
    """The largest factor of the references at which all vehicles keep the limits, and what they use of them."""
    uses, factor = plan.fleet.uses(references, plan.envelope), 1.0
    if max(uses.values()) <= 1:
        return factor, uses
    still = plan.fleet.uses(0 * references, plan.envelope)
    for _ in range(_MOST_REDUCTIONS):
        steps = [1.0]
        for name, share in uses.items():
            if still[name] >= 1:
                raise _too_gusty(name)
            if share > 1:  # what is used beyond the gusts' share grows about linearly with the references
                steps.append((_TARGET - still[name]) / (share - still[name]))
        factor *= max(min(steps), _LEAST_STEP)
        uses = plan.fleet.uses(factor * references, plan.envelope)
        if max(uses.values()) <= 1:
            return factor, uses
    raise InputError("no references keep the limits; give weaker gusts, or wider limits.")


def _too_gusty(name: str) -> InputError:
    return InputError(f"gusts alone need the whole `{name}`, without references; give weaker gusts, or a wider limit.")
