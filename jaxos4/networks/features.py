"""What a network sees of a flight, and of simulated ones with their noise: a few numbers in place of a trajectory.

Unknowns are the parameters and, where it is free, the initial state, in *bracket coordinates*: 0 at the center of the
bracket, +-1 at its ends.
"""

import abc
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .._custom_types import Key, Parameters, Scalar
from ..bracket import Bracket
from ..linalg import cholesky, invert_factor
from ..models.state import CASCADE_ORDER
from ..shooting import FASTEST, ShootingProblem


class Seen(NamedTuple):
    """What features say of a measured flight.

    - `values`: the network's input, in units in which it was trained.
    - `inflation`: by how much less each parameter is known than in training, because samples are missing.
    """

    values: Float[Array, " features"]
    inflation: Parameters


class Coordinates(eqx.Module):
    """Bracket coordinates of the unknowns of a problem.

    **Arguments:**

    - `center`, `width`: in the unknowns' units; the parameters first, then the initial state where it is free.
    - `first_state`: the initial state at the center, whether free or not, in cascade order.
    """

    center: Float[Array, " unknowns"]
    width: Float[Array, " unknowns"]
    first_state: Float[Array, " starts"]

    @classmethod
    def of(cls, problem: ShootingProblem, bracket: Bracket, noise: Scalar) -> "Coordinates":
        """Of a problem's unknowns: an initial state lies as far from the first measurement as `noise` puts it."""
        first_state, off = problem.first_state()
        free = problem.windows * problem.free_size
        sigma = jnp.tile(problem.sigma[CASCADE_ORDER[: problem.size]], problem.windows)
        off = off + 3 * jnp.maximum(noise - 1, 0) * sigma
        return cls(
            jnp.concatenate([bracket.center, first_state[:free]]),
            jnp.concatenate([bracket.half_width, off[:free]]),
            first_state,
        )

    def split(self, u: Float[Array, " unknowns"], parameters: int) -> tuple[Parameters, Float[Array, " starts"]]:
        """Parameters and initial state at coordinates `u`, in their units."""
        unknowns = self.center + u * self.width
        free = unknowns.shape[0] > parameters
        return unknowns[:parameters], unknowns[parameters:] if free else self.first_state


class AbstractFeatures(eqx.Module):
    """What a network sees, prepared for one input, start, sampling and bracket.

    - `problem`: what it was prepared for; of the flight's states it uses which are measured, and the first.
    - `coordinates`: of the unknowns.
    - `reference`: the trajectory at the bracket's center.
    """

    problem: eqx.AbstractVar[ShootingProblem]
    coordinates: eqx.AbstractVar[Coordinates]
    reference: eqx.AbstractVar[Float[Array, "samples size"]]

    @property
    @abc.abstractmethod
    def size(self) -> int:
        """How many numbers."""

    @abc.abstractmethod
    def __call__(self, problem: ShootingProblem) -> Seen:
        """Of a measured flight. NaN where its numbers are not finite."""

    @abc.abstractmethod
    def simulated(self, u: Float[Array, " unknowns"], scale: Scalar, *, key: Key) -> Float[Array, " features"]:
        """Of the flight at `u`, with white noise of `scale` times the problem's sigma; NaN where it cannot be flown."""

    def _deviation(self, u: Float[Array, " unknowns"]) -> Float[Array, "samples size"]:
        """W (x(u) - x(0)), 0 where nothing is measured; NaN throughout where the flight at `u` diverges."""
        trajectory = self.problem.predict(*self.coordinates.split(u, len(self.problem.model.parameter_names)))
        sound = (jnp.abs(trajectory[:, :3]) < FASTEST).all()
        if self.problem.size > 3:
            sound &= (jnp.abs(trajectory[:, 4]) < jnp.pi / 2).all()
        return jnp.where(sound, self._weighted(self.problem, trajectory), jnp.nan)

    def _mismatch(self, problem: ShootingProblem) -> Float[Array, "samples size"]:
        """W (y - x(0)) of a measured flight, with the weights of training; 0 where nothing is measured in both."""
        mismatch = self._weighted(problem, problem.measured())
        return jnp.where(_measured(self.problem), mismatch, 0.0)

    def _weighted(
        self, problem: ShootingProblem, trajectory: Float[Array, "samples size"]
    ) -> Float[Array, "samples size"]:
        weight = 1 / self.problem.sigma[self.problem.columns]
        return jnp.where(_measured(problem), weight * (trajectory - self.reference), 0.0)


class Score(AbstractFeatures):
    """F^-1 J^T W (y - x) at the bracket's center: one Gauss-Newton step, a number for each unknown.

    Nearly everything that the flight tells about the parameters is in these numbers, as long as the trajectories of the
    bracket are nearly a linear manifold (score compression; Alsing and Wandelt 2018). White noise passes through a
    linear map as Gaussian noise of covariance F^-1: simulated flights need no noise drawn sample by sample.
    """

    problem: ShootingProblem
    coordinates: Coordinates
    reference: Float[Array, "samples size"]
    jacobian: Float[Array, "samples size unknowns"]
    noise_factor: Float[Array, "unknowns unknowns"]

    @classmethod
    def of(cls, problem: ShootingProblem, coordinates: Coordinates) -> "Score":
        """Prepares the features for a problem's inputs, start and missing samples."""
        reference, size = _reference(problem, coordinates), coordinates.center.shape[0]
        bare = cls(problem, coordinates, reference, jnp.zeros((*reference.shape, size)), jnp.eye(size))
        jacobian = jax.jacfwd(bare._deviation)(jnp.zeros(size))
        return eqx.tree_at(
            lambda f: (f.jacobian, f.noise_factor), bare, (jacobian, invert_factor(cholesky(_squares(jacobian))).T)
        )

    @property
    def size(self) -> int:
        """One for each unknown."""
        return self.noise_factor.shape[0]

    def __call__(self, problem: ShootingProblem) -> Seen:
        """See `AbstractFeatures`. Samples that were measured in training and are missing here only cost precision."""
        jacobian = jnp.where(_measured(problem)[:, :, None], self.jacobian, 0.0)
        noise_factor = invert_factor(cholesky(_squares(jacobian))).T
        step = noise_factor @ (noise_factor.T @ jnp.einsum("tcu,tc->u", jacobian, self._mismatch(problem)))
        lost = jnp.linalg.norm(noise_factor, axis=1) / jnp.linalg.norm(self.noise_factor, axis=1)
        return Seen(step, lost[: len(self.problem.model.parameter_names)])

    def simulated(self, u: Float[Array, " unknowns"], scale: Scalar, *, key: Key) -> Float[Array, " features"]:
        """See `AbstractFeatures`."""
        slope = jnp.einsum("tcu,tc->u", self.jacobian, self._deviation(u))
        return self.noise_factor @ (self.noise_factor.T @ slope + scale * jax.random.normal(key, u.shape, u.dtype))


class Raw(AbstractFeatures):
    """The flattened trajectory, as its difference from that at the bracket's center: the paper-style input."""

    problem: ShootingProblem
    coordinates: Coordinates
    reference: Float[Array, "samples size"]

    @classmethod
    def of(cls, problem: ShootingProblem, coordinates: Coordinates) -> "Raw":
        """Prepares the features for a problem's inputs, start and missing samples."""
        return cls(problem, coordinates, _reference(problem, coordinates))

    @property
    def size(self) -> int:
        """One for each sample and channel."""
        return self.reference.size

    def __call__(self, problem: ShootingProblem) -> Seen:
        """See `AbstractFeatures`. Samples that were measured in training must be measured here."""
        lost = (_measured(self.problem) & ~_measured(problem)).any()
        inflation = jnp.where(lost, jnp.inf, jnp.ones(len(self.problem.model.parameter_names)))
        return Seen(self._mismatch(problem).ravel(), inflation)

    def simulated(self, u: Float[Array, " unknowns"], scale: Scalar, *, key: Key) -> Float[Array, " features"]:
        """See `AbstractFeatures`."""
        deviation = self._deviation(u)
        noise = scale * jax.random.normal(key, deviation.shape, u.dtype)
        return (deviation + jnp.where(_measured(self.problem), noise, 0.0)).ravel()


FEATURES: dict[str, type[Score] | type[Raw]] = {"score": Score, "raw": Raw}


def _reference(problem: ShootingProblem, coordinates: Coordinates) -> Float[Array, "samples size"]:
    count = len(problem.model.parameter_names)
    return problem.predict(*coordinates.split(jnp.zeros_like(coordinates.center), count))


def _measured(problem: ShootingProblem) -> Bool[Array, "samples size"]:
    return ~jnp.isnan(problem.measured())


def _squares(jacobian: Float[Array, "samples size unknowns"]) -> Float[Array, "unknowns unknowns"]:
    return jnp.einsum("tcu,tcv->uv", jacobian, jacobian)
