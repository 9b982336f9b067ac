"""A shooting problem: how badly parameters of a model explain a flight."""

import dataclasses
import functools
from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from .._custom_types import Count, InitialState, InitialStates, Numeric, Parameters, Scalar, StateVector, as_float
from ..batching import in_blocks
from ..bracket import Bracket
from ..errors import check_choice
from ..flight import CHANNEL_NAMES, STATE_NAMES, Flight
from ..models.abstract import AbstractModel
from ..models.state import CASCADE_ORDER, CHANNELS, Forcing, State
from ..noise import FORCE_SIGMA
from ..simulation import METHODS
from .abstract import AbstractProblem, InitialGuess, LocalModel, Stage, Stages, Unknowns, WindowUnknowns
from .layout import each_window, windowed
from .scans import Length, Rows, predict_window, shoot, shot_with_derivatives, with_tangents

STEPS = ("euler", "rk4")
"""The methods of a shot, see `ShootingProblem.advance`."""

# Rounding errors add up over a flight, to about this many times the rounding of one measurement.
ROUNDING = 64.0
# Errors that an unmeasured initial state may have, in cascade order: rad/s, rad, then m and m/s.
_UNMEASURED = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0])


class ShootingProblem(AbstractProblem):
    """A model, a flight and weights: how badly do parameters explain the flight?

    - `model`: its parameters are the unknowns.
    - `flight`: the measurements. NaN in `flight.states` means missing.
    - `sigma`: standard deviation of each channel's noise, in the order of `CHANNEL_NAMES`; its reciprocal is the
      weight. The three values of specific force may be omitted: they are then 0.3 m/s^2.
    - `initial_state`: X at the first sample. `None`: free, and estimated with the parameters.
    - `channels`: the states that are compared and simulated: `"rates"`, `"attitude"` (with the rates), or `"all"`.
    - `method`: the stepper, `"euler"` or `"rk4"`.
    - `windows`: number of windows for multiple shooting. The flight is cut into windows of equal length, and each is
      simulated from its own free initial state, so that errors of the model add up over one window only. Windows are
      independent, so the information in a long drift is lost. Measure each channel in at least some windows: nothing
      else identifies the initial states.
    - `length`: the number of samples that count; the others are padding, in which nothing was measured. `padded` sets
      it. `None`: all samples count.
    - `unknowns`: by default all parameters of the model, in the model's bracket.

    An *initial state* below is the part of X that the channels need, in cascade order: p, q, r, then phi, theta, psi,
    then x, vx, y, vy, z, vz. The initial states of several windows follow each other in one array.

    **Raises:** `ValueError` that names the argument.
    """

    model: AbstractModel
    flight: Flight
    sigma: Float[Array, "12"] | Float[Array, "15"] = eqx.field(converter=as_float)
    unknowns: Unknowns
    initial_state: StateVector | None = None
    channels: str = eqx.field(static=True, default="all")
    method: str = eqx.field(static=True, default="euler")
    windows: int = eqx.field(static=True, default=1)
    length: Length = None

    def __init__(
        self,
        model: AbstractModel,
        flight: Flight,
        *,
        sigma: Float[Array | np.ndarray, "12"] | Float[Array | np.ndarray, "15"],
        initial_state: Float[Array | np.ndarray, "12"] | None = None,
        channels: str = "all",
        method: str = "euler",
        windows: int = 1,
        length: Length = None,
        unknowns: Unknowns | None = None,
    ):
        check_choice("channels", channels, CHANNELS)
        check_choice("method", method, STEPS)
        if np.shape(sigma) not in ((len(STATE_NAMES),), (len(CHANNEL_NAMES),)):
            raise ValueError(
                "`sigma` must hold one value for each of the 12 states, and may hold three more for specific force, "
                f"got shape {np.shape(sigma)}."
            )
        if not isinstance(sigma, Tracer) and not np.all((np.asarray(sigma) > 0) & np.isfinite(sigma)):
            raise ValueError(f"`sigma` must be positive and finite, got {np.asarray(sigma).tolist()}.")
        if initial_state is not None and np.shape(initial_state) != (12,):
            raise ValueError(f"`initial_state` must be `None` or of shape (12,), got {np.shape(initial_state)}.")
        most = max(flight.states.shape[-2] // 2, 1)
        if not isinstance(windows, int) or not 1 <= windows <= most:
            raise ValueError(f"`windows` must be an integer from 1 to {most}, two samples each, got {windows!r}.")
        if windows > 1 and initial_state is not None:
            raise ValueError("`initial_state` must be `None` if there are several windows: each has its own.")
        if windows > 1 and length is not None:
            raise ValueError("`length` must be `None` if there are several windows: only a whole flight is padded.")
        if model.force_axes and np.shape(sigma) == (len(STATE_NAMES),):
            stack = jnp.concatenate if isinstance(sigma, Tracer) else np.concatenate
            sigma = stack([sigma, np.full(3, FORCE_SIGMA)])
        self.model, self.flight, self.sigma = model, flight, as_float(sigma)
        self.initial_state = None if initial_state is None else as_float(initial_state)
        self.channels, self.method, self.windows, self.length = channels, method, windows, length
        self.unknowns = Unknowns.of(model) if unknowns is None else unknowns

    @property
    def size(self) -> int:
        """The number of states that the channels need: 3, 6 or 12."""
        return CHANNELS[self.channels]

    @property
    def free_size(self) -> int:
        """The number of unknowns in the initial state of one window: `size`, or 0 if it is known."""
        return 0 if self.initial_state is not None else self.size

    @property
    def columns(self) -> Int[np.ndarray, " columns"]:
        """The positions of the compared channels in `CHANNEL_NAMES`: states in cascade order, then specific force."""
        forces = np.asarray(self.model.force_axes, dtype=int)
        return np.concatenate([CASCADE_ORDER[: self.size], len(STATE_NAMES) + forces])

    @property
    def initial_guess(self) -> InitialGuess:
        """The center of the bracket, and `first_state`: a search in stages needs no other start."""
        usable, (first, off) = self.unknowns.usable, self.first_state()
        known = self.split(first)[:, self.free_size :]
        return InitialGuess(self.join(usable.center, first)[None], self.join(usable.half_width, off), known)

    @property
    def local_model(self) -> Callable[[WindowUnknowns], LocalModel]:
        """See `AbstractProblem`."""
        every = np.ones(self.unknowns.count + self.free_size, dtype=bool)
        return functools.partial(self._local_model(self.channels), self.length, every)

    def _local_model(self, channels: str) -> Callable[[Length, Bool[Numeric, " unknowns"], WindowUnknowns], LocalModel]:
        """The local model on fewer channels, as a function of `length`, which unknowns are searched, and unknowns."""
        forced, first, count = self.forced_rows(), self.split(self.first_state()[0]), self.unknowns.count
        fewer = self.restrict(channels)
        others = 0, self.free_size - fewer.free_size

        def local_model(length: Length, searched: Bool[Numeric, " unknowns"], unknowns: WindowUnknowns) -> LocalModel:
            rows, own = forced(unknowns[0, :count]), unknowns[:, count:] if self.free_size else first
            # The states of fewer channels, then the specific force.
            rows = rows._replace(measured=rows.measured[: fewer.size] + rows.measured[self.size :])
            window = shot_with_derivatives(fewer, length)
            model = each_window(window, rows, unknowns[:, :count], own[:, : fewer.size])
            both = searched & searched[:, None]
            return model._replace(
                gradient=jnp.where(searched, jnp.pad(model.gradient, ((0, 0), others)), 0.0),
                information=jnp.where(both, jnp.pad(model.information, ((0, 0), others, others)), 0.0),
            )

        return local_model

    def fix(self, values: Mapping[str, Float[ArrayLike, ""]], bracket: Bracket | None = None) -> "ShootingProblem":
        """See `AbstractProblem`."""
        unknowns = self.unknowns if bracket is None else self.unknowns.within(bracket)
        return dataclasses.replace(self, unknowns=unknowns.fix(values) if values else unknowns)

    def restrict(self, channels: str) -> "ShootingProblem":
        """The same problem on fewer channels."""
        return dataclasses.replace(self, channels=channels)

    def measured(self) -> Float[Array, "samples columns"]:
        """The measurements in the order of `columns`. A known first sample is NaN, because it is not fitted."""
        measured = (self.flight.channels if self.model.force_axes else self.flight.states)[:, self.columns]
        if self.initial_state is None:
            return measured
        return jnp.where((np.arange(measured.shape[0]) > 0)[:, None], measured, jnp.nan)

    def recorded(self) -> Float[np.ndarray, "samples columns"]:
        """`measured` as NumPy, without a compiled program."""
        measured = self.flight.recorded[:, self.columns]
        if self.initial_state is not None:
            measured[0] = np.nan
        return measured

    def rows(self, parameters: Parameters | None = None) -> Rows:
        """The data of all windows for a scan, with the forcing at `parameters`, by default `model.alpha`."""
        index, within = self.window_samples()
        forcing = windowed(self.forcing(self.model.alpha if parameters is None else parameters), index)
        measured = windowed(tuple(self.measured().T), index)
        return Rows(forcing, tuple(y if within.all() else jnp.where(within, y, jnp.nan) for y in measured))

    def forcing(self, parameters: Parameters) -> Forcing:
        """The forcing of the whole flight, one row for each sample."""
        return self.model.forcing(self.flight.inputs, parameters)

    def forced_rows(self) -> Callable[[Parameters], Rows]:
        """`rows` with the derivatives of the forcing, for a loop: parts that depend on no parameter are made once."""
        rows, inputs, index = self.rows(), self.flight.inputs, self.window_samples()[0]
        places = self.model.forcing_parameters

        def forced(parameters: Parameters) -> Rows:
            of = functools.partial(self.model.forcing, inputs)
            forcing, tangents = with_tangents(lambda x: windowed(of(x), index), parameters, places)
            return rows._replace(forcing=forcing, forcing_tangents=tangents)

        return forced if places else lambda parameters: rows

    def split(self, initial_state: InitialStates) -> Float[Array, "windows size"]:
        """The initial state of each window."""
        return initial_state.reshape(self.windows, self.size)

    def join(self, parameters: Parameters, initial_state: InitialStates) -> WindowUnknowns:
        """The unknowns of each window: the parameters, and the window's initial state if that is free."""
        repeated = jnp.broadcast_to(parameters, (self.windows, parameters.shape[0]))
        return jnp.concatenate([repeated, self.split(initial_state)[:, : self.free_size]], axis=1)

    def first_state(self) -> tuple[InitialStates, InitialStates]:
        """The known state, or each window's first measurement of each channel, or 0; and how far off that may be.

        Three standard deviations of a measurement; more for a state that was not measured at the start.
        """
        order = CASCADE_ORDER[: self.size]
        if self.initial_state is not None:
            return self.initial_state[order], jnp.zeros(self.size, dtype=float)
        (index, within), sigma = self.window_samples(), self.sigma[order]
        states = jnp.where(within[:, :, None], self.measured()[index, : self.size], jnp.nan)
        first = jnp.argmin(jnp.isnan(states), axis=1)
        value = jnp.take_along_axis(states, first[:, None], axis=1)[:, 0]
        start, is_first = jnp.nan_to_num(value), (first == 0) & ~jnp.isnan(value)
        return start.ravel(), (3 * sigma + jnp.where(is_first, 0.0, _UNMEASURED[: self.size])).ravel()

    @eqx.filter_jit
    def cost(self, parameters: Parameters, initial_state: InitialStates | None = None) -> Scalar:
        """1/2 |W (y - x)|^2 over the measured samples, without the first sample if the initial state is known.

        Infinite, with an undefined derivative, if the trajectory diverges or reaches theta = +-90 degrees.
        `initial_state` defaults to `first_state`.
        """
        start = self.first_state()[0] if initial_state is None else initial_state
        # A batch prepares its data in blocks too: measurements of many flights do not fit the cache.
        cost, feasible = in_blocks(ShootingProblem.shots, self, parameters, start)
        return jnp.where(feasible, cost, jnp.inf)

    @eqx.filter_jit
    def residuals(
        self, parameters: Parameters, initial_state: InitialStates | None = None
    ) -> Float[Array, " residuals"]:
        """W (y - x), sample by sample with the channels in the order of `columns`; 0 for a missing measurement."""
        start = self.first_state()[0] if initial_state is None else initial_state
        predicted, measured = self.predict(parameters, start), self.measured()
        return jnp.where(jnp.isnan(measured), 0.0, (measured - predicted) / self.sigma[self.columns]).ravel()

    @eqx.filter_jit
    def predict(self, parameters: Parameters, initial_state: InitialStates) -> Float[Array, "samples columns"]:
        """The output of noise-free sensors, in the order of `columns`."""
        _, within = self.window_samples()

        def predict(forcing: Forcing, start: InitialState) -> Float[Array, "length columns"]:
            return predict_window(self.advance, forcing, parameters, start, self.length)

        return each_window(predict, self.rows(parameters).forcing, self.split(initial_state))[within]

    def shots(self, parameters: Parameters, initial_state: InitialStates) -> tuple[Scalar, Bool[Array, ""]]:
        """The cost of all windows together, and whether all are feasible."""
        rows, starts = self.rows(parameters), self.split(initial_state)
        costs, feasible = each_window(lambda rows, start: self.shot(rows, parameters, start), rows, starts)
        return costs.sum(), feasible.all()

    def stages(self, shares: tuple[float, ...] = ()) -> Stages:
        """The body rates of a short part of the flight first, then more; the last stage fits the whole flight.

        Rates hardly depend on attitude and translation, so they are fitted first. Errors grow with time, which gives
        the cost of a long flight other minima, so the first stages are short.

        `shares`: the body rates are first fitted to these shares of the flight. If there are several windows, only a
        share of 1 counts, because windows are short enough. All stages compare specific force.
        """
        wanted = (share for share in shares if share == 1 or self.windows == 1)
        rates = tuple(("rates", share) for share in wanted if (self.channels, share) != ("rates", 1))
        stages, unknowns, off = (*rates, (self.channels, 1.0)), self.unknowns, self.initial_guess.off
        names = tuple(dict.fromkeys(name for name, _ in stages))
        place = jnp.asarray([names.index(name) for name, _ in stages])
        sizes = np.array([CHANNELS[name] for name, _ in stages])
        measured, sigma = self.measured(), self.sigma[self.columns]
        samples, columns = measured.shape[0], np.arange(measured.shape[1])
        fitted = (columns < sizes[:, None]) | (columns >= self.size)
        fitted_shares = np.array([share for _, share in stages])
        lengths = jnp.ceil(fitted_shares * (samples if self.length is None else self.length)).astype(int)
        within = (jnp.arange(samples) < lengths[:, None]).astype(float)
        known, eps = within @ (~jnp.isnan(measured)).astype(float), jnp.finfo(sigma.dtype).eps
        squares = (within @ jnp.square(jnp.nan_to_num(measured))) / jnp.maximum(known, 1)
        largest = jnp.where(fitted, jnp.sqrt(squares) / sigma, 0.0).max(axis=1)
        measurements = jnp.where(fitted, known, 0.0).sum(axis=1)
        smallest_step = jnp.maximum(jnp.sqrt(eps), ROUNDING * eps * largest)
        free = jnp.broadcast_to(unknowns.free, (len(stages), unknowns.count))
        searched = jnp.concatenate([free, np.arange(self.free_size) < sizes[:, None]], axis=1)
        local_models = [self._local_model(channels) for channels in names]

        def at(number: Count | int, before: WindowUnknowns) -> Stage:
            del before
            length = self.length if (fitted_shares == 1).all() else lengths[number]
            # The stage is the same in all lanes of a batch.
            models = [functools.partial(local_model, length, searched[number]) for local_model in local_models]
            return Stage(
                unknowns=unknowns,
                off=off,
                local_model=functools.partial(jax.lax.switch, place[number], models),
                searched=searched[number],
                measurements=measurements[number],
                smallest_step=smallest_step[number],
                last=jnp.asarray(number == len(stages) - 1),
            )

        return Stages(len(stages), 0, len(stages) - 1, at)

    def shot(self, rows: Rows, parameters: Parameters, initial_state: InitialState) -> tuple[Scalar, Bool[Array, ""]]:
        """The cost of one window and whether it is feasible, from `rows` that an inner loop prepares once."""
        return in_blocks(shoot, self.advance, rows, self.weights, parameters, initial_state, self.length)

    def reweighted(self, residuals: Float[ArrayLike, "..."]) -> "ShootingProblem":
        """The problem with each channel's sigma estimated from the weighted `residuals` of a fit, by NumPy.

        Alternating this with the fit is maximum likelihood with unknown noise, corrected for degrees of freedom. A
        channel with fewer than two measurements keeps its sigma. No sigma falls below the rounding errors that add up
        over a flight.
        """
        columns, before = self.columns, np.asarray(self.sigma)
        measured, squares = self.recorded(), np.square(np.reshape(residuals, (-1, columns.size))).sum(axis=0)
        known = ~np.isnan(measured)
        count, unknowns = known.sum(axis=0), int(np.asarray(self.unknowns.free).sum()) + self.windows * self.free_size
        freedom = max(1 - unknowns / max(count.sum(), 1), 1e-3)
        sigma = before[columns] * np.sqrt(squares / np.maximum(count * freedom, 1))
        rounding = ROUNDING * np.finfo(before.dtype).eps * np.where(known, np.abs(measured), 0.0).max(axis=0)
        sigma = np.where((count > 1) & np.isfinite(sigma), np.maximum(sigma, rounding), before[columns])
        after = before.copy()
        after[columns] = np.where(sigma > 0, sigma, before[columns])
        return eqx.tree_at(lambda p: p.sigma, self, as_float(after))

    def window_samples(self) -> tuple[Int[np.ndarray, "windows length"], Bool[np.ndarray, "windows length"]]:
        """The samples of each window, and which of them belong to it. A shorter window repeats its last sample."""
        ends = np.arange(self.windows + 1) * self.flight.states.shape[-2] // self.windows
        index = ends[:-1, None] + np.arange(np.diff(ends).max())
        within = index < ends[1:, None]
        return np.where(within, index, ends[1:, None] - 1), within

    def advance(self, forcing: Forcing, state: State, parameters) -> tuple[State, tuple[Scalar, ...]]:
        """The state one sample later, down to the same level of the cascade; what ideal sensors show at this sample."""
        following = METHODS[self.method](self.model, state, forcing, parameters, self.flight.dt)
        return following, self.model.observe(state, forcing, parameters)

    @property
    def weights(self) -> tuple[Scalar, ...]:
        """1 / sigma of each compared channel."""
        return tuple(1 / self.sigma[self.columns])
