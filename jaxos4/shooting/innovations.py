"""A problem of innovations: the likelihood of a flight with disturbances that the model does not contain.

A controller answers gusts and all other disturbances, so input and disturbance correlate. A likelihood that takes the
disturbance for sensor noise is therefore biased, however long the flight. Here a Kalman filter estimates the
disturbance from the past, and only the innovations are compared: the part of a measurement that the past cannot
predict.

References: Jategaonkar, Flight Vehicle System Identification, ch. 5; Ljung, System Identification, ch. 7 and 13.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float

from .._custom_types import Count, Numeric, Parameters, as_float
from ..bracket import Bracket
from ..flight import CHANNEL_NAMES, Flight
from ..models.abstract import AbstractModel, ByRecording
from ..models.state import Forcing, State
from ..simulation import midpoint_step
from .abstract import AbstractProblem, InitialGuess, LocalModel, Parts, Stage, Stages, Unknowns, Values, WindowUnknowns
from .filter_lanes import innovate
from .filters import LAGS, Point, Segmented, SegmentLikelihoods
from .gains import INSTANT, LogNoise
from .layout import Segments, observe_in_segments
from .noise_unknowns import TIMES, joined, levels, own_names, placed, with_noise
from .problem import ShootingProblem
from .scans import with_tangents

SETTLING = 128
"""After this many samples a filter has settled, by default."""


class InnovationsProblem(AbstractProblem):
    """A shooting problem's rates and specific force, compared as innovations of Kalman filters.

    Each channel has a disturbance with a strength and a time constant, and white sensor noise. The logarithms of these
    three follow the parameters as further unknowns: `log_p_strength`, `log_p_time`, `log_p_sensor`, then the same for
    q, r, and each specific force that the model predicts. With forces there is also `log_az_smoothing`, the time
    constant of the low-pass filter of the disturbance (fixed for rates, which have none), and with `input_innovations`
    `p_rate_gain_1`, `p_disturbance_gain_1`, `p_feedthrough_1` and so on. The bracket is a Gaussian prior, whose
    standard deviation is its half-width.

    - `problem`: model, flight, known or free initial state, and the bracket of the parameters. Its windows and its
      sigma do not matter.
    - `segments`: the number of parts of the flight that are filtered in parallel; by default one for about 384 samples.
      Short segments lose information, because a filter begins without memory. Padded flights with equal numbers of
      segments and equal capacity share a program.
    - `settling`: after this many samples a filter has settled. The first innovations of a segment do not count.
    - `least_noise`: a lower limit of the standard deviation of each channel's sensor noise; 0: none is known.
    - `input_innovations`: for each channel, the part of torque or thrust within a sample that the past does not
      predict, see `jaxos4.shooting.feedthrough`. By default none: the controller knows no more than the log.
    - `answers_within`: whether the controller answers a rate within its sample; otherwise feedthroughs are 0.
    - `lagged`: whether input innovations after the first belong to earlier samples, see `feedthrough.lagged`. They get
      no gain on the disturbance of a rate, which would repeat a gain of the earlier sample, less a step of the rate.
    - `noise_feedthrough`: feedthroughs that were found before. The squares of what they explain are added to those of
      the innovations, but only in the cost and its slope along the noise: the noise is then as large as without
      feedthroughs. NaN (default): unknown. A search then has two stages: the first finds them, the second
      adds these squares.
    - `start`: where searches start. NaN (default): the center of the bracket, with each of several time constants.
    """

    problem: ShootingProblem
    start: Values = eqx.field(converter=as_float)
    least_noise: Float[Array, " channels"] = eqx.field(converter=as_float)
    input_innovations: Float[Array, "samples feedthroughs channels"] = eqx.field(converter=as_float)
    noise_feedthrough: Float[Array, "channels feedthroughs"] = eqx.field(converter=as_float)
    answers_within: Bool[Array, ""]
    lagged: Bool[Array, ""]
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
        input_innovations: Float[ArrayLike, "samples feedthroughs channels"] | None = None,
        noise_feedthrough: Float[ArrayLike, "channels feedthroughs"] | None = None,
        answers_within: Bool[ArrayLike, ""] = True,
        lagged: Bool[ArrayLike, ""] = False,
    ):
        if segments is None:
            segments = max(round((problem.flight.time.shape[-1] - settling) / (3 * SETTLING)), 1)
        for name, value, least in (("segments", segments, 1), ("settling", settling, 0)):
            if not isinstance(value, int) or value < least:
                raise ValueError(f"`{name}` must be an integer of at least {least}, got {value!r}.")
        self.problem, self.segments, self.settling = problem.restrict("rates"), segments, settling
        each = self._by_recording
        if each is not None and segments <= len(each.places):
            raise ValueError(f"`segments` must be more than the {len(each.places)} recordings, got {segments}.")
        # Always an array, so that all starts share one program.
        channels, samples = self.problem.columns.size, problem.flight.time.shape[-1]
        nothing = np.zeros((samples, 0, channels))
        self.input_innovations = as_float(nothing if input_innovations is None else input_innovations)
        if self.input_innovations.shape[::2] != (samples, channels):
            raise ValueError(
                f"`input_innovations` must have shape ({samples}, feedthroughs, {channels}), "
                f"got {self.input_innovations.shape}."
            )
        unknown = np.full((channels, self.input_innovations.shape[1]), np.nan)
        self.noise_feedthrough = as_float(unknown if noise_feedthrough is None else noise_feedthrough)
        self.answers_within, self.lagged = (jnp.asarray(x, dtype=bool) for x in (answers_within, lagged))
        unknowns = problem.unknowns.count + len(self._own) * channels
        self.start = as_float(np.full(unknowns, np.nan) if start is None else start)
        self.least_noise = as_float(np.zeros(channels) if least_noise is None else least_noise)
        if self.least_noise.shape != (channels,):
            raise ValueError(f"`least_noise` must hold {channels} channels, got shape {self.least_noise.shape}.")
        if self.start.shape != (unknowns,):
            raise ValueError(f"`start` must hold {unknowns} unknowns, got shape {self.start.shape}.")

    @property
    def model(self) -> AbstractModel:
        """The model of the shooting problem."""
        return self.problem.model

    @property
    def flight(self) -> Flight:
        """The flight of the shooting problem."""
        return self.problem.flight

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of the compared channels."""
        return tuple(CHANNEL_NAMES[column] for column in self.problem.columns)

    @property
    def segmentation(self) -> Segments:
        """The samples of each segment."""
        capacity, length, each = self.flight.time.shape[0], self.problem.length, self._by_recording
        begins = np.zeros(1, int)
        if each is not None:
            numpy = np if isinstance(each.number, np.ndarray) else jnp
            begins = numpy.searchsorted(each.number, np.arange(len(each.places)))
        if isinstance(length, Tracer) or isinstance(begins, jax.Array):
            edges = jnp.append(jnp.asarray(begins), capacity if length is None else length)
        else:  # known numbers need no compiled program
            edges = np.append(begins, capacity if length is None else int(length))
        return Segments.of(self.segments, capacity, edges, self.settling)

    @property
    def _by_recording(self) -> ByRecording | None:
        stretch = self.flight.stretch
        is_known = stretch is not None and not isinstance(stretch, Tracer)
        return self.model.by_recording(np.asarray(stretch) if is_known else stretch)

    @property
    @eqx.filter_jit  # one compiled program instead of one for each operation, and traced once
    def unknowns(self) -> Unknowns:  # pyright: ignore[reportIncompatibleVariableOverride]  # derived, not stored
        """The parameters, then the noise in brackets from differences of measurements, then the feedthroughs."""
        return with_noise(self)

    @property
    def initial_guess(self) -> InitialGuess:
        """`start` where it is not NaN; a complete one makes all starts equal. Filters estimate the initial state."""
        unknowns, count = self.unknowns.usable, self.problem.unknowns.count
        place, times = np.arange(unknowns.count) - count, jnp.log(jnp.asarray(TIMES))
        is_time = (place >= 0) & (place % len(self._own) == 1)
        starts = jnp.where(is_time, times[:, None], unknowns.center)
        starts = jnp.clip(starts, unknowns.lowest, unknowns.highest)
        starts = jnp.where(jnp.isnan(self.start) | ~unknowns.free, starts, self.start)
        return InitialGuess(starts[:, None], unknowns.half_width[None], jnp.zeros((1, 0), dtype=float))

    def starting_from(self, start: Float[ArrayLike, " unknowns"]) -> "InnovationsProblem":
        """The same problem, with another start."""
        return dataclasses.replace(self, start=start)

    def with_noise_feedthrough(self, found: Float[ArrayLike, "channels feedthroughs"]) -> "InnovationsProblem":
        """The same problem; the innovations that these feedthroughs explain count as noise."""
        return dataclasses.replace(self, noise_feedthrough=found)

    def fix(self, values: Mapping[str, Float[ArrayLike, ""]], bracket: Bracket | None = None) -> "InnovationsProblem":
        """See `AbstractProblem`. Only parameters can be fixed."""
        return dataclasses.replace(self, problem=self.problem.fix(values, bracket))

    def noise(self, unknowns: Float[Numeric, " unknowns"]) -> LogNoise:
        """The noise levels among the unknowns."""
        return LogNoise(*self._of_channels(unknowns)[:, : self._levels].T)

    @property
    def _own(self) -> tuple[str, ...]:
        """The names of the unknowns of a channel."""
        return own_names(self._levels, self.input_innovations.shape[-2])

    @property
    def _levels(self) -> int:
        return levels(self.problem.columns.size)

    def _of_channels(self, unknowns: Float[Numeric, " unknowns"]) -> Float[Numeric, "channels own"]:
        return unknowns[self.problem.unknowns.count :].reshape(-1, len(self._own))

    def _input_unknowns(self, unknowns: Float[Numeric, " unknowns"]) -> Float[Array, "3 channels feedthroughs"]:
        """The gains of input innovations on rate and disturbance, then the feedthroughs."""
        own = self._of_channels(unknowns)[:, self._levels :]
        return jnp.moveaxis(own.reshape(len(own), 3, self.input_innovations.shape[-2]), 1, 0)

    @property
    def local_model(self) -> Callable[[WindowUnknowns], LocalModel]:
        """See `AbstractProblem`. `parts` are the segments."""
        return functools.partial(self._local_model(), jnp.nan_to_num(self.noise_feedthrough))

    @property
    def no_parts(self) -> Parts:
        """See `AbstractProblem`."""
        segments, count, channels = self.segments, self.unknowns.count, self.noise_feedthrough.shape[0]
        return Parts(
            gradient=jnp.zeros((segments, count), dtype=float),
            information=jnp.zeros((segments, count, count), dtype=float),
            products=jnp.zeros((segments, channels, LAGS + 1), dtype=float),
            noise_feedthrough=jnp.zeros_like(self.noise_feedthrough),
        )

    def stages(self, shares: tuple[float, ...] = ()) -> Stages:
        """The whole problem. With input innovations, a second stage counts as noise what their feedthroughs explain."""
        del shares
        number, model_at, unknowns = 2 if self.noise_feedthrough.size else 1, self._local_model(), self.unknowns
        is_known = ~jnp.isnan(self.noise_feedthrough).any()

        def at(stage: Count | int, before: WindowUnknowns) -> Stage:
            found = jnp.where(is_known, self.noise_feedthrough, self._input_unknowns(before[0])[2])
            noise_feedthrough = jnp.where(is_known | (stage > 0), found, 0.0)
            return Stage(
                unknowns=unknowns,
                off=unknowns.usable.half_width[None],
                local_model=functools.partial(model_at, noise_feedthrough),
                searched=unknowns.free,
                measurements=jnp.zeros((), dtype=float),
                smallest_step=jnp.sqrt(jnp.finfo(float).eps),
                last=jnp.asarray(stage == number - 1),
            )

        first = is_known.astype(int) if number == 2 else 0
        return Stages(number, first, first, at)  # all stages fit the whole flight

    def _local_model(self) -> Callable[[Float[Array, "channels feedthroughs"], WindowUnknowns], LocalModel]:
        """`local_model` as a function of `noise_feedthrough` and of the unknowns."""
        unknowns, innovations = self.unknowns.usable, self._innovations()
        count, free = self.problem.unknowns.count, unknowns.free
        both, places = free & free[:, None], None
        if (each := self._by_recording) is not None:  # indices of each segment's unknowns
            others = np.broadcast_to(np.arange(count, free.size), (self.segments, free.size - count))
            places = jnp.concatenate([jnp.asarray(each.places)[self.segmentation.recording], others], axis=1)

        def at(noise_feedthrough: Float[Array, "channels feedthroughs"], row: WindowUnknowns) -> LocalModel:
            values = row[0]
            found = innovations(values[:count], self.noise(values), self._input_unknowns(values), noise_feedthrough)
            shared = found.gradient.shape[1] - len(self._own)
            gradient, information = jax.vmap(joined, in_axes=(-1, -1, None))(found.gradient, found.information, shared)
            if places is not None:
                gradient, information = placed(gradient, information, places, free.size)
            off = values - unknowns.center
            cost = found.cost.sum() + (unknowns.precision * jnp.square(off)).sum() / 2
            slope = jnp.where(free, gradient.sum(axis=0) + unknowns.precision * off, 0.0)
            whole = jnp.where(both, information.sum(axis=0), 0.0) + jnp.diag(unknowns.precision)
            parts = Parts(gradient, information, jnp.moveaxis(found.products, -1, 0), noise_feedthrough)
            return LocalModel(cost[None], found.feasible.all()[None], slope[None], whole[None], parts)

        return at

    def innovations(
        self,
        parameters: Parameters,
        noise: LogNoise,
        input_unknowns: Float[Array, "3 channels feedthroughs"] | None = None,
    ) -> SegmentLikelihoods:
        """The likelihoods of all segments, with derivatives in the parameters of the segment's recording.

        `input_unknowns`: the gains of input innovations on rate and disturbance, and the feedthroughs; by default 0.
        """
        nothing = jnp.zeros((3, self.problem.columns.size, self.input_innovations.shape[-2]))
        input_unknowns = nothing if input_unknowns is None else input_unknowns
        noise_feedthrough = jnp.nan_to_num(self.noise_feedthrough)
        return self._innovations()(parameters, noise, input_unknowns, noise_feedthrough)

    def _innovations(self) -> Callable[[Parameters, LogNoise, Array, Array], SegmentLikelihoods]:
        """`innovations` for a loop: everything that does not depend on parameters and noise is computed once."""
        observed = observe_in_segments(self)
        problem, forced, by_recording = self.problem, self._forced(), self._by_recording
        places = None
        if by_recording is not None:
            problem = dataclasses.replace(problem, model=by_recording.model)
            places = jnp.asarray(by_recording.places)[self.segmentation.recording].T
        model = problem.model
        inputs = jnp.moveaxis(self.input_innovations[observed["place"]], 1, -1)
        rows, dt, window = self.segmentation.rows, self.flight.dt, INSTANT
        # Samples are centred on `time[k]`, and measurements are means around it, or instants in the middle.
        if self.flight.within is not None:
            window = (dt - self.flight.averaging_time) / 2, self.flight.averaging_time
        functions = eqx.Partial(_move, problem), eqx.Partial(_average, problem), model.observe

        def at(
            parameters: Parameters, noise: LogNoise, input_unknowns: Array, noise_feedthrough: Array
        ) -> SegmentLikelihoods:
            forcing, tangents = forced(parameters)
            own = parameters if places is None else parameters[places]
            flight = Segmented(
                **observed,
                inputs=inputs,
                forcing=forcing,
                forcing_tangents=tangents,
                rows=rows,
                dt=dt,
                window=window,
            )
            driven, disturbance, feedthrough = (tuple(each.T) for each in input_unknowns)
            point = Point(own, noise, feedthrough, tuple(noise_feedthrough.T), (driven, disturbance))
            return innovate(functions, model.forcing_parameters, flight, point)

        return at

    def _forced(self) -> Callable[[Parameters], tuple[Forcing, Forcing | None]]:
        """The forcing of all samples and its tangents, as functions of the parameters."""
        inputs, model = self.flight.inputs._replace(length=self.problem.length), self.model

        def of(parameters: Parameters) -> Forcing:
            # A segment belongs to one recording, so its forcing names none.
            return model.centered_forcing(inputs, parameters)._replace(recording=())

        if not model.forcing_parameters:
            known = of(model.alpha)
            return lambda parameters: (known, None)

        def forced(parameters: Parameters) -> tuple[Forcing, Forcing]:
            forcing, tangents = with_tangents(of, parameters, model.forcing_parameters)
            return forcing, jax.tree.map(jnp.transpose, tangents)  # positions first

        return forced


def _move(problem: ShootingProblem, state: State, forcing: Forcing, parameters) -> State:
    """The rates one sample later: by the midpoint rule if samples are centred, else by the problem's method."""
    if forcing.early is None:
        return problem.advance(forcing, state, parameters)[0]
    return midpoint_step(problem.model, state, forcing, parameters, problem.flight.dt)


def _average(problem: ShootingProblem, state: State, forcing: Forcing, parameters) -> State:
    """The mean of the state over a measurement's window, from the rates at the beginning of a sample."""
    if forcing.early is None:  # samples begin with their measurement
        return state
    early = forcing.early._replace(recording=forcing.recording, velocity=forcing.velocity)
    slope = problem.model.angular_acceleration(state.rates, early, parameters)
    return State(jax.tree.map(lambda x, dx: x + problem.flight.dt / 2 * dx, state.rates, slope))
