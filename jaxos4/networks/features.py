"""The features of a flight: a few numbers in place of a measured or simulated trajectory.

Unknowns, parameters and a free initial state, are in *bracket coordinates*: 0 at the center, +-1 at the ends.
"""

import enum
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._custom_types import Key, Numeric, Parameters, Scalar
from ..bracket import Bracket
from ..linalg import unit_directions
from ..models.state import CASCADE_ORDER
from ..shooting import FASTEST, ShootingProblem

CHUNK = 1000
"""Flights that are simulated at once. All chunks share one compiled program."""

Purpose = enum.IntEnum("Purpose", "WEIGHTS LINEAR_MAP VALIDATION STEPS CALIBRATION FLIGHTS", start=0)
"""Purposes of random numbers. Numbers are drawn from a key and a place; each purpose has its own places."""


def place_of(purpose: Purpose, number: Int[np.ndarray, "*numbers"] | int) -> Int[np.ndarray, "*numbers"]:
    """The place of a number, or of each number."""
    return np.asarray(len(Purpose) * np.asarray(number) + int(purpose))


class Coordinates(eqx.Module):
    """Bracket coordinates of the unknowns of a problem.

    - `center`, `width`: in the unknowns' units; parameters first, then the initial state if it is free.
    - `first_state`: the initial state at the center, free or known, in cascade order.
    """

    center: Float[Array, " unknowns"]
    width: Float[Array, " unknowns"]
    first_state: Float[Array, " starts"]

    @classmethod
    def of(cls, problem: ShootingProblem, bracket: Bracket, noise: Scalar) -> "Coordinates":
        """Coordinates of a problem's unknowns. The largest `noise` scale widens the bracket of a free initial state."""
        (first_state, off), free = problem.first_state(), problem.windows * problem.free_size
        sigma = jnp.tile(problem.sigma[CASCADE_ORDER[: problem.size]], problem.windows)
        off = off + 3 * jnp.maximum(noise - 1, 0) * sigma
        center = jnp.concatenate([bracket.center, first_state[:free]])
        return cls(center, jnp.concatenate([bracket.half_width, off[:free]]), first_state)

    def split(self, u: Float[Array, " unknowns"], parameters: int) -> tuple[Parameters, Float[Array, " starts"]]:
        """Parameters and initial state at coordinates `u`, in their units."""
        unknowns = self.center + u * self.width
        free = unknowns.shape[0] > parameters
        return unknowns[:parameters], unknowns[parameters:] if free else self.first_state


class Features(eqx.Module):
    """The features of flights of one input, start, sampling and bracket.

    *Raw* features are the whole trajectory W (y - x) as one vector, as in the paper, where x is the trajectory at the
    bracket's center. The *score* F^-1 J^T W (y - x) is one Gauss-Newton step at the center, a number for each unknown.
    If trajectories are nearly linear in the unknowns over the bracket, the score holds nearly all information that the
    flight has about them (score compression; Alsing and Wandelt 2018). White noise passes through a linear map as
    Gaussian noise of covariance F^-1, so that a simulated flight needs no noise for each sample.

    - `problem`: only its first state is used, and which samples were measured.
    - `reference`: the trajectory at the center.
    - `jacobian`, `noise_factor`: of the score: J, and a factor of F^-1; `None` for raw features.
    """

    problem: ShootingProblem
    coordinates: Coordinates
    reference: Float[Array, "samples size"]
    jacobian: Float[Array, "samples size unknowns"] | None
    noise_factor: Float[Array, "unknowns unknowns"] | None

    @classmethod
    def of(cls, kind: str, problem: ShootingProblem, coordinates: Coordinates) -> "Features":
        """Prepares the features: one simulation gives the trajectory at the center, and its derivatives."""
        blank, center = cls.blank("raw", problem, coordinates), jnp.zeros_like(coordinates.center)
        if kind == "raw":
            return cls(problem, coordinates, blank._trajectory(center), None, None)
        trajectory_and_slope = jax.jacfwd(lambda u: (blank._deviation(u), blank._trajectory(u)), has_aux=True)
        jacobian, reference = trajectory_and_slope(center)
        return cls(problem, coordinates, reference, jacobian, _noise_factor(jacobian))

    @classmethod
    def blank(cls, kind: str, problem: ShootingProblem, coordinates: Coordinates) -> "Features":
        """Features of the right shapes, and no values."""
        nothing, size = jnp.zeros_like(problem.measured()), coordinates.center.shape[0]
        score = (None, None) if kind == "raw" else (jnp.zeros((*nothing.shape, size)), jnp.eye(size))
        return cls(problem, coordinates, nothing, *score)

    @property
    def size(self) -> int:
        """The number of features."""
        return self.reference.size if self.noise_factor is None else self.noise_factor.shape[0]

    def __call__(self, problem: ShootingProblem) -> tuple[Float[Array, " features"], Parameters]:
        """Features of a measured flight, NaN if it is not finite, and the growth of errors by missing samples."""
        needed, measured = _measured(self.problem), _measured(problem)
        mismatch = jnp.where(needed, self._weighted(problem, problem.measured()), 0.0)
        parameters = len(self.problem.model.parameter_names)
        if self.jacobian is None or self.noise_factor is None:
            inflation = jnp.where((needed & ~measured).any(), jnp.inf, jnp.ones(parameters))
            return mismatch.ravel(), inflation
        jacobian = jnp.where(measured[:, :, None], self.jacobian, 0.0)
        noise_factor = _noise_factor(jacobian)
        step = noise_factor @ (noise_factor.T @ jnp.einsum("tcu,tc->u", jacobian, mismatch))
        inflation = jnp.linalg.norm(noise_factor, axis=1) / jnp.linalg.norm(self.noise_factor, axis=1)
        return step, inflation[:parameters]

    def simulated(self, u: Float[Array, " unknowns"]) -> Float[Array, " features"]:
        """Features of the flight at `u` without noise; NaN if the flight diverges."""
        deviation = self._deviation(u).ravel()
        if self.jacobian is None or self.noise_factor is None:
            return deviation
        # As a product of matrices: `vmap` of an `einsum` takes five times as long.
        slope = deviation @ self.jacobian.reshape(-1, self.size)
        return self.noise_factor @ (self.noise_factor.T @ slope)

    def noise(self, normal: Float[Array, " features"]) -> Float[Array, " features"]:
        """The effect of white noise on the features. `normal`: standard normal numbers, times the noise scale."""
        if self.noise_factor is None:
            return jnp.where(_measured(self.problem).ravel(), normal, 0.0)
        return self.noise_factor @ normal

    def _deviation(self, u: Float[Array, " unknowns"]) -> Float[Array, "samples size"]:
        """W (x(u) - x(0)); 0 in samples that are not measured, NaN everywhere if the flight at `u` diverges."""
        trajectory = self._trajectory(u)
        feasible = (jnp.abs(trajectory[:, :3]) < FASTEST).all()
        if self.problem.size > 3:
            feasible &= (jnp.abs(trajectory[:, 4]) < jnp.pi / 2).all()
        return jnp.where(feasible, self._weighted(self.problem, trajectory), jnp.nan)

    def _trajectory(self, u: Float[Array, " unknowns"]) -> Float[Array, "samples size"]:
        return self.problem.predict(*self.coordinates.split(u, len(self.problem.model.parameter_names)))

    def _weighted(self, problem: ShootingProblem, trajectory: Array) -> Float[Array, "samples size"]:
        weight = 1 / self.problem.sigma[self.problem.columns]
        return jnp.where(_measured(problem), weight * (trajectory - self.reference), 0.0)


FEATURES = ("score", "raw")


def _measured(problem: ShootingProblem) -> Bool[Array, "samples size"]:
    return ~jnp.isnan(problem.measured())


def _noise_factor(jacobian: Float[Array, "samples size unknowns"]) -> Float[Array, "unknowns unknowns"]:
    """A factor of F^-1, the covariance of the score."""
    return unit_directions(jnp.einsum("tcu,tcv->uv", jacobian, jacobian))


class Flights(NamedTuple):
    """Simulated flights: features, the true unknowns, and the noise scale in multiples of sigma; `None`: no noise."""

    features: Float[Array, "*batch features"]
    u: Float[Array, "*batch unknowns"]
    scale: Float[Array, "*batch"] | None = None


def draw_chunks(
    features: Features, count: int, *, key: Key, purpose: Purpose, first: int = 0, uniform: bool = False
) -> list[Flights]:
    """Simulates at least `count` flights in chunks of `CHUNK`. Parameters are uniform in the bracket.

    `uniform`: whether free initial states are uniform in the bracket too. Otherwise they are denser near its center.
    Chunk i is drawn from `key` at the place `first` + i of the `purpose`.
    """
    numbers = range(first, first + math.ceil(count / CHUNK))
    return [_chunk(features, key, place_of(purpose, number), np.asarray(uniform)) for number in numbers]


@eqx.filter_jit
def _chunk(features: Features, key: Key, place: Int[Numeric, ""], uniform: Bool[Numeric, ""]) -> Flights:
    unknowns, parameters = features.coordinates.center.shape[0], len(features.problem.model.parameter_names)
    drawn = jax.random.uniform(jax.random.fold_in(key, place), (CHUNK, unknowns + 1), minval=-1, maxval=1, dtype=float)
    shrunk = jnp.where(uniform, 1.0, jnp.abs(drawn[:, -1:]))
    u = drawn[:, :-1] * jnp.where(np.arange(unknowns) < parameters, 1.0, shrunk)
    return Flights(jax.vmap(features.simulated)(u), u)


def with_noise(
    features: Features, flights: Flights, scales: Float[Numeric, "2"], uniform: Float[Array, "flights random"]
) -> Flights:
    """Adds noise to flights, of scales log-uniform between `scales`. `uniform`: in -1 to 1, for scale and features."""
    low, high = jnp.log(jnp.asarray(scales, uniform.dtype))
    scale = jnp.exp((low + high + (high - low) * uniform[:, 0]) / 2)
    most = 1 - jnp.finfo(uniform.dtype).eps  # a finite number of standard deviations
    normal = jnp.sqrt(2.0) * jax.lax.erf_inv(jnp.clip(uniform[:, 1:], -most, most))
    return Flights(flights.features + jax.vmap(features.noise)(scale[:, None] * normal), flights.u, scale)


def noisy_chunks(
    features: Features, chunks: list[Flights], scales: np.ndarray, key: Key, purpose: Purpose, turn: int = 1
) -> list[Flights]:
    """Adds noise to chunks of flights. It is drawn at the places of the `purpose` after those of `turn` such lists."""
    numbers = turn * len(chunks) + np.arange(len(chunks))
    places = zip(chunks, place_of(purpose, numbers), strict=True)
    return [_noisy_chunk(features, chunk, scales, key, place) for chunk, place in places]


@eqx.filter_jit
def _noisy_chunk(
    features: Features, chunk: Flights, scales: Float[Numeric, "2"], key: Key, place: Int[Numeric, ""]
) -> Flights:
    shape = CHUNK, 1 + features.size
    drawn = jax.random.uniform(jax.random.fold_in(key, place), shape, minval=-1, maxval=1, dtype=float)
    return with_noise(features, chunk, scales, drawn)
