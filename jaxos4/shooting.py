"""The mismatch between a flight and what a model makes of its rotor speeds: cost, residuals, slope, curvature.

Every quantity is one scan over the flight that carries the state and a sum, so that memory does not grow with the
flight; derivatives are forward-mode. Rows are never stacked inside the scan: see `dynamics`.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from ._custom_types import Parameters, Scalar, StateVector, as_float
from .flight import CHANNEL_NAMES, STATE_NAMES, Flight, Inputs
from .models.abstract import AbstractModel
from .models.state import CASCADE_ORDER, CHANNELS, Forcing, State, unstack
from .noise import FORCE_SIGMA
from .simulation import STEPPERS

# A body rate [rad/s] that no quadrotor reaches, and no gyro measures: beyond it a trial trajectory has diverged.
FASTEST = 1e3

# Rounding errors add up over a flight: to about this many times the rounding of one measurement.
ROUNDING = 64.0

# How far off an initial state may be that was not measured, in cascade order: rad/s, rad, then m and m/s.
_UNMEASURED = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5, 2.0, 2.0, 2.0, 2.0, 2.0, 2.0])


class Rows(NamedTuple):
    """A window as the scan reads it, or a batch of them: a leaf a channel. `measured` is NaN where it says nothing.

    `forcing_tangents` is the forcing's derivative in the parameters that it depends on, of a model in which it does.
    """

    forcing: Forcing
    measured: tuple[Float[Array, "*windows rows"], ...]
    forcing_tangents: Forcing | None = None


class Shot(NamedTuple):
    """One simulated window: the cost of its sound part, and whether that is all of it.

    A trajectory that passes theta = +-90 degrees or turns faster than anything flies is compared up to there: its
    slope still says which way to go, while its cost means nothing.
    """

    cost: Scalar
    sound: Bool[Array, ""]


class Curvature(NamedTuple):
    """A shot with its first two derivatives in (parameters, initial state), in the Gauss-Newton approximation."""

    shot: Shot
    gradient: Float[Array, " unknowns"]
    information: Float[Array, "unknowns unknowns"]


class ShootingProblem(eqx.Module):
    """A model, a flight, and weights: how badly parameters explain the flight.

    **Arguments:**

    - `model`, `flight`: what is fitted to what; NaN in `flight.states` means not measured.
    - `sigma`: standard deviation of each channel's noise, in the order of `CHANNEL_NAMES`; its reciprocal is the
      weight. Of a model that predicts specific force, that may be left out: it is then 0.3 m/s^2.
    - `initial_state`: X at the first sample. `None`: free, estimated with the parameters.
    - `channels`: `"rates"`, `"attitude"` (with the rates), or `"all"`: what is compared, and how much is simulated.
    - `method`: the stepper, `"euler"` or `"rk4"`.
    - `windows`: multiple shooting: the flight is cut into this many windows of equal length, each simulated from an
      initial state of its own, so that what the model lacks adds up over a window only. Nothing ties the end of one to
      the beginning of the next, which costs the information in the long drift of a flight that the model explains.
      Initial states are then free, and each simulated channel should be measured in some windows at least: nothing
      else tells where a window began.

    An *initial state* below is the part of X at the first sample that the channels need, in cascade order: p, q, r,
    then phi, theta, psi, then x, vx, y, vy, z, vz; of several windows, one after the other.
    """

    model: AbstractModel
    flight: Flight
    sigma: Float[Array, "12"] | Float[Array, "15"] = eqx.field(converter=as_float)
    initial_state: StateVector | None = None
    channels: str = eqx.field(static=True, default="all")
    method: str = eqx.field(static=True, default="euler")
    windows: int = eqx.field(static=True, default=1)

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
    ):
        if channels not in CHANNELS:
            raise ValueError(f"`channels` must be one of {', '.join(CHANNELS)}, got {channels!r}.")
        if method not in STEPPERS:
            raise ValueError(f"`method` must be one of {', '.join(STEPPERS)}, got {method!r}.")
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
            raise ValueError("`initial_state` must be `None` where there are several windows: each has its own.")
        if model.force_axes and np.shape(sigma) == (len(STATE_NAMES),):
            sigma = jnp.concatenate([as_float(sigma), jnp.full(3, FORCE_SIGMA)])
        self.model, self.flight, self.sigma = model, flight, as_float(sigma)
        self.initial_state = None if initial_state is None else as_float(initial_state)
        self.channels, self.method, self.windows = channels, method, windows

    @property
    def size(self) -> int:
        """How many states the channels need: 3, 6 or 12."""
        return CHANNELS[self.channels]

    @property
    def free_size(self) -> int:
        """How many unknowns an initial state adds to a window's parameters: `size`, or 0 where it is known."""
        return 0 if self.initial_state is not None else self.size

    @property
    def columns(self) -> Int[np.ndarray, " columns"]:
        """Which of `CHANNEL_NAMES` are compared: the states in cascade order, then the specific force."""
        forces = np.asarray(self.model.force_axes, dtype=int)
        return np.concatenate([CASCADE_ORDER[: self.size], len(STATE_NAMES) + forces])

    def restrict(self, channels: str) -> "ShootingProblem":
        """The same problem on fewer channels."""
        return ShootingProblem(
            self.model,
            self.flight,
            sigma=self.sigma,
            initial_state=self.initial_state,
            channels=channels,
            method=self.method,
            windows=self.windows,
        )

    def measured(self) -> Float[Array, "samples columns"]:
        """What is compared, in the order of `columns`; without the first sample where the initial state is known."""
        measured = (self.flight.channels if self.model.force_axes else self.flight.states)[:, self.columns]
        return measured if self.initial_state is None else measured.at[0].set(jnp.nan)

    def rows(self, parameters: Parameters | None = None) -> Rows:
        """All windows as the scan reads them, with nothing measured beyond the end of one that is shorter.

        `parameters`: of the forcing, where it depends on some; what the airframe implies by default.
        """
        index, within = self.cut()
        forcing = self._windowed(self.forcing(self.model.alpha if parameters is None else parameters))
        return Rows(forcing, tuple(jnp.where(within, y[index], jnp.nan) for y in self.measured().T))

    def forcing(self, parameters: Parameters) -> Forcing:
        """What the rotors do in the whole flight, sample by sample."""
        return self.model.forcing(self.flight.inputs, parameters)

    def with_forcing(
        self, rows: Rows, parameters: Parameters, *, inputs: Inputs | None = None, tangents: bool = False
    ) -> Rows:
        """`rows` with the forcing of these parameters, and its tangents if wanted; untouched where it has none.

        `inputs`: `flight.inputs`, prepared once where this is called in a loop.
        """
        driving = np.asarray(self.model.forcing_parameters, dtype=int)
        if not driving.size:
            return rows
        inputs = self.flight.inputs if inputs is None else inputs

        def forcing(values: Float[Array, " driving"]) -> Forcing:
            # What parameters do not change is taken from `rows`.
            made = self.model.forcing(inputs, parameters.at[driving].set(values))
            return self._windowed(made._replace(recording=(), velocity=None, lateral=None))

        def whole(forcing: Forcing, of: Forcing) -> Forcing:
            return forcing._replace(recording=of.recording, velocity=of.velocity, lateral=of.lateral)

        values = parameters[driving]
        if not tangents:
            return rows._replace(forcing=whole(forcing(values), rows.forcing))
        slopes, made = jax.jacfwd(lambda x: (forcing(x),) * 2, has_aux=True)(values)
        still = jax.tree.map(lambda leaf: jnp.zeros((*leaf.shape, driving.size), leaf.dtype), rows.forcing)
        return rows._replace(forcing=whole(made, rows.forcing), forcing_tangents=whole(slopes, still))

    def _windowed(self, forcing: Forcing) -> Forcing:
        """Sample by sample into window by window: without a copy where all windows are of one length."""
        index, _ = self.cut()
        even = index.size == self.flight.time.shape[0]
        return jax.tree.map(lambda leaf: leaf.reshape(index.shape) if even else leaf[index], forcing)

    def split(self, initial_state: Float[Array, " starts"]) -> Float[Array, "windows size"]:
        """The initial state of each window."""
        return initial_state.reshape(self.windows, self.size)

    def first_state(self) -> tuple[Float[Array, " starts"], Float[Array, " starts"]]:
        """The initial state where the search starts, and how far off it may be.

        It is the known state, or in each window each channel's first measurement (0 where there is none).
        """
        order = CASCADE_ORDER[: self.size]
        if self.initial_state is not None:
            return self.initial_state[order], jnp.zeros(self.size, dtype=float)
        states, sigma = jnp.stack(self.rows().measured[: self.size], axis=-1), self.sigma[order]
        first = jnp.argmin(jnp.isnan(states), axis=1)
        value = jnp.take_along_axis(states, first[:, None], axis=1)[:, 0]
        off = 3 * sigma + jnp.where((first == 0) & ~jnp.isnan(value), 0.0, _UNMEASURED[: self.size])
        return jnp.where(jnp.isnan(value), 0.0, value).ravel(), off.ravel()

    @eqx.filter_jit
    def cost(self, parameters: Parameters, initial_state: Float[Array, " starts"] | None = None) -> Scalar:
        """1/2 |W (y - x)|^2 over the measured samples, after the first where the initial state is known.

        Infinite where the trajectory diverges or passes theta = +-90 degrees, and without a derivative there.
        `initial_state` defaults to `first_state`.
        """
        start = self.first_state()[0] if initial_state is None else initial_state
        cost, sound = self.shots(parameters, start)
        return jnp.where(sound, cost, jnp.inf)

    @eqx.filter_jit
    def residuals(
        self, parameters: Parameters, initial_state: Float[Array, " starts"] | None = None
    ) -> Float[Array, " residuals"]:
        """W (y - x), sample by sample with the channels in the order of `columns`; 0 where nothing was measured."""
        start = self.first_state()[0] if initial_state is None else initial_state
        predicted, measured = self.predict(parameters, start), self.measured()
        return jnp.where(jnp.isnan(measured), 0.0, (measured - predicted) / self.sigma[self.columns]).ravel()

    @eqx.filter_jit
    def predict(
        self, parameters: Parameters, initial_state: Float[Array, " starts"]
    ) -> Float[Array, "samples columns"]:
        """What would be measured without noise, in the order of `columns`."""
        scalars = tuple(parameters)

        def step(state: State, forcing: Forcing) -> tuple[State, tuple[Scalar, ...]]:
            return self.step(state, forcing, scalars), self.model.observe(state, forcing, scalars)

        def window(start: Float[Array, " size"], forcing: Forcing) -> Float[Array, "length columns"]:
            return jnp.stack(jax.lax.scan(step, unstack(start), forcing)[1], axis=-1)

        _, within = self.cut()
        return jax.vmap(window)(self.split(initial_state), self.rows(parameters).forcing)[within]

    def shots(self, parameters: Parameters, initial_state: Float[Array, " starts"]) -> Shot:
        """All windows, as one."""
        each = jax.vmap(self.shot, in_axes=(0, None, 0))(self.rows(parameters), parameters, self.split(initial_state))
        return Shot(each.cost.sum(), each.sound.all())

    def curvatures(self, parameters: Parameters, initial_state: Float[Array, " starts"]) -> Curvature:
        """Of each window, in the parameters and its own initial state."""
        rows = self.with_forcing(self.rows(), parameters, tangents=True)
        return jax.vmap(self.curvature, in_axes=(0, None, 0))(rows, parameters, self.split(initial_state))

    def shot(self, rows: Rows, parameters: Parameters, initial_state: Float[Array, " size"]) -> Shot:
        """The cost of one window of `rows`, prepared once: what a shooting method calls in its inner loop."""
        scalars, weights = tuple(parameters), self._weights()

        def step(carry: tuple[State, Shot], row: Rows) -> tuple[tuple[State, Shot], None]:
            state, shot = carry
            sound = shot.sound & _sound(state)
            seen = self.model.observe(state, row.forcing, scalars)
            shot = Shot(shot.cost + _half_square(_errors(row, seen, weights, sound)), sound)
            return (self.step(state, row.forcing, scalars), shot), None

        return jax.lax.scan(step, (unstack(initial_state), _unfired()), rows)[0][1]

    def curvature(self, rows: Rows, parameters: Parameters, initial_state: Float[Array, " size"]) -> Curvature:
        """Of one window: cost, gradient, Fisher information J^T W^2 J in the parameters and, where free, initial state.

        Forward mode: one tangent for each unknown travels with the state, and their products are summed on the way.
        """
        count = parameters.shape[0]
        unknowns = count + self.free_size
        identity = jnp.eye(unknowns, dtype=float)
        scalars, weights = tuple(parameters), self._weights()
        parameter_tangents = tuple(identity[:, :count].T)
        start_tangents = jnp.zeros((unknowns, self.size), dtype=float).at[:, : self.free_size].set(identity[:, count:])

        def advance(state: State, forcing: Forcing, scalars) -> tuple[State, tuple[Scalar, ...]]:
            return self.step(state, forcing, scalars), self.model.observe(state, forcing, scalars)

        def linearised(state: State, tangent: State, row: Rows):
            if row.forcing_tangents is None:
                at, push = jax.linearize(lambda x, a: advance(x, row.forcing, a), state, scalars)
                return at, jax.vmap(push)(tangent, parameter_tangents)
            at, push = jax.linearize(advance, state, row.forcing, scalars)
            driving = np.asarray(self.model.forcing_parameters)
            forcing = jax.tree.map(
                lambda slope: jnp.zeros(unknowns, dtype=float).at[driving].set(slope), row.forcing_tangents
            )
            return at, jax.vmap(push)(tangent, forcing, parameter_tangents)

        def step(carry: tuple[State, State, Curvature], row: Rows):
            state, tangent, total = carry
            sound = total.shot.sound & _sound(state)
            (following, seen), (moved, slope) = linearised(state, tangent, row)
            errors = _errors(row, seen, weights, sound)
            slopes = [
                jnp.where(jnp.isnan(y) | ~sound, 0.0, -w * dx)
                for y, w, dx in zip(row.measured, weights, slope, strict=True)
            ]
            total = Curvature(
                Shot(total.shot.cost + _half_square(errors), sound),
                total.gradient + sum(e * s for e, s in zip(errors, slopes, strict=True)),
                total.information + sum(s[:, None] * s[None, :] for s in slopes),
            )
            return (following, moved, total), None

        zero = Curvature(_unfired(), jnp.zeros(unknowns, dtype=float), 0 * identity)
        tangents = jax.vmap(unstack)(start_tangents)
        return jax.lax.scan(step, (unstack(initial_state), tangents, zero), rows)[0][2]

    @eqx.filter_jit
    def reweighted(self, residuals: Float[Array, " residuals"]) -> "ShootingProblem":
        """The problem with each channel's sigma set to what its weighted `residuals` at a fit say it is.

        Alternating this with the fit is maximum likelihood with unknown noise levels, corrected for the degrees of
        freedom that the unknowns took. A channel with fewer than two measurements keeps its sigma, and none falls
        below what rounding adds up to over a flight: residuals can be rounding alone.
        """
        columns = self.columns
        measured = self.measured()
        count = (~jnp.isnan(measured)).sum(axis=0)
        unknowns = len(self.model.parameter_names) + self.windows * self.free_size
        left = jnp.maximum(1 - unknowns / jnp.maximum(count.sum(), 1), 1e-3)
        squares = jnp.square(residuals.reshape(-1, columns.size)).sum(axis=0)
        sigma = self.sigma[columns] * jnp.sqrt(squares / jnp.maximum(count * left, 1))
        rounding = ROUNDING * jnp.finfo(sigma.dtype).eps * jnp.nan_to_num(jnp.nanmax(jnp.abs(measured), axis=0))
        sigma = jnp.where((count > 1) & jnp.isfinite(sigma), jnp.maximum(sigma, rounding), self.sigma[columns])
        sigma = jnp.where(sigma > 0, sigma, self.sigma[columns])
        return eqx.tree_at(lambda p: p.sigma, self, self.sigma.at[columns].set(sigma))

    def step(self, state: State, forcing: Forcing, parameters) -> State:
        """The state one sample later, as far down the cascade as `state` goes."""
        return STEPPERS[self.method](self.model, state, forcing, parameters, self.flight.dt)

    def window_of_samples(self) -> Int[np.ndarray, " samples"]:
        """The window in which each sample lies."""
        return np.nonzero(self.cut()[1])[0]

    def cut(self) -> tuple[Int[np.ndarray, "windows length"], Bool[np.ndarray, "windows length"]]:
        """The samples of each window, and which of them are its own: some are a sample shorter than others."""
        samples = self.flight.states.shape[-2]
        ends = np.arange(self.windows + 1) * samples // self.windows
        index = ends[:-1, None] + np.arange(np.diff(ends).max())
        within = index < ends[1:, None]
        return np.where(within, index, ends[1:, None] - 1), within

    def _weights(self) -> tuple[Scalar, ...]:
        return tuple(1 / self.sigma[self.columns])


def _unfired() -> Shot:
    return Shot(jnp.zeros((), dtype=float), jnp.ones((), dtype=bool))


def _sound(state: State) -> Bool[Array, ""]:
    p, q, r = state.rates
    sound = (jnp.abs(p) < FASTEST) & (jnp.abs(q) < FASTEST) & (jnp.abs(r) < FASTEST)
    return sound if state.attitude is None else sound & (jnp.abs(state.attitude.theta) < jnp.pi / 2)


def _errors(row: Rows, seen: tuple[Scalar, ...], weights: tuple[Scalar, ...], sound: Bool[Array, ""]) -> list[Scalar]:
    return [
        jnp.where(jnp.isnan(y) | ~sound, 0.0, w * (y - x)) for y, w, x in zip(row.measured, weights, seen, strict=True)
    ]


def _half_square(errors: list[Scalar]) -> Scalar:
    return functools.reduce(lambda total, e: total + e * e, errors, jnp.zeros_like(errors[0])) / 2
