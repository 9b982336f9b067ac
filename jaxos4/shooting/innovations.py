"""A problem of innovations: the likelihood of a flight with disturbances that the model does not contain.

A real vehicle flies under a controller, which answers gusts and everything else that a model lacks. So the input and
the disturbance correlate. A likelihood that treats the disturbance as noise of the sensors is then biased, however long
the flight. Here the disturbance is a part of the model. A Kalman filter estimates it from the past, and only the
innovations are compared: the part of a measurement that the past cannot predict.

References: Jategaonkar, Flight Vehicle System Identification, ch. 5; Ljung, System Identification, ch. 7 and 13.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import InitialStates, Numeric, Parameters, Scalar, as_float
from ..bracket import PROPER_PRIOR, Bracket
from ..flight import CHANNEL_NAMES, Flight
from ..models.abstract import AbstractModel, ByRecording
from ..models.state import Forcing
from .abstract import AbstractProblem, Stages, Unknowns, Values, WindowUnknowns
from .filters import innovate
from .gains import INSTANT, LogNoise, Observed, Window, first_noise, is_rate
from .problem import ShootingProblem
from .scans import Curvature, Parts, Shot
from .segments import Segments, observe_in_segments
from .sums import Innovations, joined, placed

# About how many samples a segment has by default, and how many settle its filter.
_SEGMENT, SETTLING = 384, 128
# Time constants of the disturbance at which searches start [s]: the likelihood has several maxima.
_TIMES = np.array([0.2, 0.03])
_SHORTEST, _LONGEST = 0.25, 3.0  # time constants: in samples, in seconds
# Time constant of a disturbance of specific force at least [s]: what is faster is vibration, a noise of the sensor.
_FORCE_SHORTEST = 0.25
_NOISE_REACH = 1e8  # factor to either side of the first noise levels: simulated flights have no disturbance
NOISE_PRECISION = 1e-2  # of a weak prior on each logarithm
_STRIDE = 1.0  # the cost is roughly quadratic in a logarithm over such a step


class InnovationsProblem(AbstractProblem):
    """A shooting problem's rates and specific force, compared as innovations of Kalman filters.

    Each channel has a disturbance with a strength and a time constant, and white noise of its sensor. The logarithms of
    the three are unknowns like the parameters, and follow them: `log_p_strength`, `log_p_time`, `log_p_sensor`, then
    those of q, r, and each specific force that the model predicts. The bracket is a Gaussian prior, whose standard
    deviation is its half-width. With `input_innovations`, each channel has further unknowns, `p_feedthrough_1`
    and so on: see `jaxos4.shooting.feedthrough`.

    **Arguments:**

    - `problem`: model, flight, known or free initial state, and the bracket of the parameters. Its windows and its
      sigma do not matter.
    - `segments`: the number of parts of the flight that are filtered in parallel; by default one for about 384 samples.
      A short segment loses information if the disturbance is weak, because its filter begins without memory. Padded
      flights (`ShootingProblem.length`) with equal numbers of segments and equal room share a program, whatever their
      lengths.
    - `settling`: after so many samples a filter has settled. The first innovations of a segment do not count.
    - `least_noise`: the least standard deviation of each channel's sensor, by what is known of it; 0: nothing.
    - `input_innovations`: of each body rate, what the past does not tell of its torque within a sample; by default
      nothing: the controller answers no measurement within its sample.
    - `passed`: feedthroughs that were found before, see `passing`; by default 0.
    - `start`: where searches start; NaN, or by default: the center of the bracket, with each of several time constants
      of the disturbances.
    """

    prior: ClassVar[float] = PROPER_PRIOR
    windows: ClassVar[int] = 1  # pyright: ignore[reportIncompatibleVariableOverride]  # segments share all unknowns
    free_size: ClassVar[int] = 0  # pyright: ignore[reportIncompatibleMethodOverride]  # a filter finds its own state
    problem: ShootingProblem
    start: Values = eqx.field(converter=as_float)
    least_noise: Float[Array, " channels"] = eqx.field(converter=as_float)
    input_innovations: Float[Array, "samples feedthroughs 3"] = eqx.field(converter=as_float)
    passed: Float[Array, "channels feedthroughs"] = eqx.field(converter=as_float)
    segments: int = eqx.field(static=True)
    settling: int = eqx.field(static=True, default=SETTLING)

    def __init__(
        self,
        problem: ShootingProblem,
        *,
        segments: int | None = None,
        settling: int = SETTLING,
        start: Float[ArrayLike, " unknowns"] | None = None,
        least_noise: Float[ArrayLike, " channels"] | None = None,
        input_innovations: Float[ArrayLike, "samples feedthroughs 3"] | None = None,
        passed: Float[ArrayLike, "channels feedthroughs"] | None = None,
    ):
        if segments is None:
            segments = max(round((problem.flight.time.shape[-1] - settling) / _SEGMENT), 1)
        for name, value, least in (("segments", segments, 1), ("settling", settling, 0)):
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        self.problem, self.segments, self.settling = problem.restrict("rates"), segments, settling
        each = self._by_recording
        if each is not None and segments <= len(each.places):
            raise ValueError(f"`segments` must be more than the {len(each.places)} recordings, got {segments}.")
        # An array in any case, so that all starts share one program.
        channels, samples = self.problem.columns.size, problem.flight.time.shape[-1]
        self.input_innovations = as_float(np.zeros((samples, 0, 3)) if input_innovations is None else input_innovations)
        if self.input_innovations.shape[::2] != (samples, 3):
            raise ValueError(
                f"`input_innovations` must have shape ({samples}, feedthroughs, 3), got {self.input_innovations.shape}."
            )
        nothing = np.zeros((channels, self.input_innovations.shape[1]))
        self.passed = as_float(nothing if passed is None else passed)
        unknowns = problem.unknowns.count + len(self._own) * channels
        self.start = as_float(np.full(unknowns, np.nan) if start is None else start)
        self.least_noise = as_float(np.zeros(channels) if least_noise is None else least_noise)
        if self.least_noise.shape != (channels,):
            raise ValueError(f"`least_noise` must hold {channels} channels, got shape {self.least_noise.shape}.")
        if self.start.shape != (unknowns,):
            raise ValueError(f"`start` must hold {unknowns} unknowns, got shape {self.start.shape}.")

    @property
    def model(self) -> AbstractModel:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The model of the shooting problem."""
        return self.problem.model

    @property
    def flight(self) -> Flight:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The flight of the shooting problem."""
        return self.problem.flight

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the compared channels."""
        return tuple(CHANNEL_NAMES[column] for column in self.problem.columns)

    @property
    def window(self) -> Window:
        """The part of a sample over which measurements are means, see `Flight.within`."""
        if self.flight.within is None:
            return INSTANT
        length = self.flight.averaging_time
        return Window((self.flight.dt - length) / 2, length)

    @property
    def cut(self) -> Segments:
        """The samples of each segment."""
        room, length, each = self.flight.time.shape[0], self.problem.length, self._by_recording
        begins = np.zeros(1, int)
        if each is not None:
            numpy = np if isinstance(each.number, np.ndarray) else jnp
            begins = numpy.searchsorted(each.number, np.arange(len(each.places)))
        if isinstance(length, Tracer) or isinstance(begins, jax.Array):
            edges = jnp.append(jnp.asarray(begins), room if length is None else length)
        else:  # what is known needs no compiled program
            edges = np.append(begins, room if length is None else int(length))
        return Segments.of(self.segments, room, edges, self.settling)

    @property
    def _by_recording(self) -> ByRecording | None:
        stretch = self.flight.stretch
        is_known = stretch is not None and not isinstance(stretch, Tracer)
        return self.model.by_recording(np.asarray(stretch) if is_known else stretch)

    @property
    @eqx.filter_jit  # one compiled program instead of one for each operation, and traced once
    def unknowns(self) -> Unknowns:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The parameters, then the logarithms of the noise, with their brackets from differences of measurements."""
        own, dt = self.problem.unknowns, self.flight.dt
        first = jnp.stack(first_noise(self.problem.measured(), dt, _TIMES[0]), axis=1)
        lowest, highest = first - np.log(_NOISE_REACH), first + np.log(_NOISE_REACH)
        shortest = jnp.where(is_rate(first.shape[0]), jnp.log(_SHORTEST * dt), np.log(_FORCE_SHORTEST))
        lowest, highest = lowest.at[:, 1].set(shortest), highest.at[:, 1].set(np.log(_LONGEST))
        lowest = lowest.at[:, 2].max(jnp.log(jnp.maximum(self.least_noise, jnp.finfo(float).tiny)))
        first, lowest, highest = (
            jnp.pad(x, ((0, 0), (0, len(self._own) - 3)), constant_values=value)
            for x, value in ((first, 0.0), (lowest, -np.inf), (highest, np.inf))
        )
        names = tuple(each.format(name) for name in self.channels for each in self._own)
        precision = jnp.full(first.size, NOISE_PRECISION)
        return Unknowns(
            names=own.names + names,
            units=own.units + tuple("1" if name.startswith("log") else "rad/s" for name in names),
            center=jnp.concatenate([own.center, first.ravel()]),
            half_width=jnp.concatenate([own.half_width, 1 / jnp.sqrt(precision)]),
            free=jnp.concatenate([own.free, jnp.ones(first.size, dtype=bool)]),
            precision=jnp.concatenate([1 / jnp.square(own.usable.half_width), precision]),
            lowest=jnp.concatenate([own.lowest, lowest.ravel()]),
            highest=jnp.concatenate([own.highest, highest.ravel()]),
            stride=jnp.concatenate([own.stride, jnp.full(first.size, _STRIDE)]),
        )

    @property
    def starts(self) -> Float[Array, "starts unknowns"]:
        """`start` where it is not NaN; all rows are equal if it is a whole start."""
        unknowns, count = self.unknowns.usable, self.problem.unknowns.count
        place = np.arange(unknowns.count) - count
        times = jnp.where(
            (place >= 0) & (place % len(self._own) == 1), jnp.log(jnp.asarray(_TIMES))[:, None], unknowns.center
        )
        times = jnp.clip(times, unknowns.lowest, unknowns.highest)
        return jnp.where(jnp.isnan(self.start) | ~unknowns.free, times, self.start)

    def starting_from(self, start: Float[ArrayLike, " unknowns"]) -> "InnovationsProblem":
        """The same problem, with another start."""
        return dataclasses.replace(self, start=start)

    def passing(self, unknowns: Float[ArrayLike, " unknowns"]) -> "InnovationsProblem":
        """The same problem, with what these feedthroughs explain counted as noise, which made it."""
        return dataclasses.replace(self, passed=self._of_channels(jnp.asarray(unknowns))[:, 3:])

    def hold(self, values: Mapping[str, Float[ArrayLike, ""]]) -> "InnovationsProblem":
        """The same problem with some parameters held, see `ShootingProblem.hold`."""
        return dataclasses.replace(self, problem=self.problem.hold(values))

    def within(self, bracket: Bracket | None) -> "InnovationsProblem":
        """The same problem, with another bracket for the parameters; unchanged for `None`."""
        return self if bracket is None else dataclasses.replace(self, problem=self.problem.within(bracket))

    def noise(self, unknowns: Float[Numeric, " unknowns"]) -> LogNoise:
        """The noise levels among the unknowns."""
        return LogNoise(*self._of_channels(unknowns)[:, :3].T)

    @property
    def _own(self) -> tuple[str, ...]:
        """The names of the unknowns of a channel."""
        feedthroughs = tuple(f"{{}}_feedthrough_{i + 1}" for i in range(self.input_innovations.shape[-2]))
        return ("log_{}_strength", "log_{}_time", "log_{}_sensor", *feedthroughs)

    def _of_channels(self, unknowns: Float[Numeric, " unknowns"]) -> Float[Array, "channels own"]:
        return jnp.asarray(unknowns)[self.problem.unknowns.count :].reshape(-1, len(self._own))

    def first_state(self) -> tuple[InitialStates, InitialStates]:
        """Nothing: the initial state is no unknown."""
        return jnp.zeros(0, dtype=float), jnp.zeros(0, dtype=float)

    def split(self, initial_state: InitialStates) -> Float[Array, "1 0"]:
        """See `AbstractProblem`."""
        return initial_state[None]

    def shots(self, parameters: Parameters, initial_state: InitialStates) -> Shot:
        """See `AbstractProblem`."""
        return jax.tree.map(lambda leaf: leaf[0], self.curvatures(parameters, initial_state).shot)

    def evaluator(self) -> Callable[[Parameters, InitialStates], Curvature]:
        """See `AbstractProblem`. `parts` are the segments."""
        unknowns, innovations = self.unknowns.usable, self._innovations()
        count, free = self.problem.unknowns.count, unknowns.free
        both, places = free & free[:, None], None
        if (each := self._by_recording) is not None:  # of the unknowns of each segment
            others = np.broadcast_to(np.arange(count, free.size), (self.segments, free.size - count))
            places = jnp.concatenate([jnp.asarray(each.places)[self.cut.recording], others], axis=1)

        def evaluate(values: Values, initial_state: InitialStates) -> Curvature:
            del initial_state
            found = innovations(values[:count], self.noise(values), self._of_channels(values)[:, 3:])
            own = found.gradient.shape[1] - len(self._own)
            gradient, information = jax.vmap(joined, in_axes=(-1, -1, None))(found.gradient, found.information, own)
            if places is not None:
                gradient, information = placed(gradient, information, places, free.size)
            off = values - unknowns.center
            cost = found.cost.sum() + (unknowns.precision * jnp.square(off)).sum() / 2
            slope = jnp.where(free, gradient.sum(axis=0) + unknowns.precision * off, 0.0)
            curvature = jnp.where(both, information.sum(axis=0), 0.0) + jnp.diag(unknowns.precision)
            parts = Parts(gradient, information, jnp.moveaxis(found.products, -1, 0))
            return Curvature(Shot(cost[None], found.feasible.all()[None]), slope[None], curvature[None], parts)

        return evaluate

    def stages(self, *, cascade: bool) -> Stages:
        """The whole problem: filters follow the measurements, so that errors do not grow with time."""
        del cascade
        at, nothing = self.evaluator(), jnp.zeros(0, dtype=float)

        def evaluate(stage: Int[Array, ""], unknowns: WindowUnknowns) -> Curvature:
            del stage
            return at(unknowns[0], nothing)

        def misfit(stage: Int[Array, ""], cost: Scalar) -> Scalar:
            """The residuals are as large as the noise, which is found with the parameters."""
            del stage
            return jnp.ones_like(cost)

        smallest_step = jnp.sqrt(jnp.finfo(float).eps) * jnp.ones(1)
        return Stages(1, evaluate, self.unknowns.free[None], misfit, smallest_step)

    def explains(self, cost: Scalar) -> Bool[Array, ""]:
        """False: the noise is found with the parameters, so that no cost is too large."""
        return jnp.zeros_like(cost, dtype=bool)

    @property
    def _place(self) -> Int[Array, "segments time"]:
        """The samples of each segment; the last one instead of those that do not exist."""
        return jnp.minimum(jnp.asarray(self.cut.place), self.flight.time.shape[0] - 1)

    def observed(self) -> Observed:
        """The measurements in segments, see `observe_in_segments`."""
        return observe_in_segments(self.problem, self.cut, self.settling)

    def innovations(
        self, parameters: Parameters, noise: LogNoise, feedthrough: Float[Array, "channels feedthroughs"] | None = None
    ) -> Innovations:
        """The innovations of all segments, with derivatives in the parameters of its recording. `feedthrough`: or 0."""
        nothing = jnp.zeros((self.problem.columns.size, self.input_innovations.shape[-2]))
        return self._innovations()(parameters, noise, nothing if feedthrough is None else feedthrough)

    def _innovations(self) -> Callable[[Parameters, LogNoise, Array], Innovations]:
        """`innovations` for a loop: what does not depend on parameters and noise is computed once."""
        problem, observed, forced, each = self.problem, self.observed(), self._forced(), self._by_recording
        places = None
        if each is not None:
            problem = dataclasses.replace(problem, model=each.model)
            places = jnp.asarray(each.places)[self.cut.recording].T
        model = problem.model
        inputs = jnp.moveaxis(self.input_innovations[self._place], 0, -1)
        inputs = jnp.pad(inputs, ((0, 0), (0, 0), (0, problem.columns.size - inputs.shape[2]), (0, 0)))
        settings = {"dt": self.flight.dt, "window": self.window, "rows": self.cut.rows}
        settings |= {"forcing_parameters": model.forcing_parameters}

        def at(parameters: Parameters, noise: LogNoise, feedthrough: Array) -> Innovations:
            forcing, tangents = forced(parameters)
            own = parameters if places is None else parameters[places]
            data = observed, inputs, forcing, own, noise, tuple(feedthrough.T), tuple(self.passed.T)
            functions = problem.advance, problem.average, model.observe
            return innovate(functions, *data, forcing_tangents=tangents, **settings)

        return at

    def _forced(self) -> Callable[[Parameters], tuple[Forcing, Forcing | None]]:
        """The forcing of all segments and its tangents, as functions of the parameters; segments are the last axis."""
        problem, inputs = self.problem, self.flight.inputs._replace(length=self.problem.length)
        samples = self._place

        def segments_last(forcing: Forcing) -> Forcing:
            forcing = forcing._replace(recording=())  # each segment belongs to one
            return jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), forcing)

        def of(parameters: Parameters) -> Forcing:
            return self.model.mean_forcing(inputs, parameters, samples)

        if not self.model.forcing_parameters:
            known = segments_last(of(self.model.alpha))
            return lambda parameters: (known, None)

        def forced(parameters: Parameters) -> tuple[Forcing, Forcing | None]:
            forcing, tangents = problem.forcing_and_tangents(of, parameters)
            return segments_last(forcing), segments_last(tangents)

        return forced
