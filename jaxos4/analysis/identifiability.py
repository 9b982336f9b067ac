"""What a flight can tell about each parameter, what it cannot, and why."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .._custom_types import Parameters, as_float
from ..bracket import Bracket
from ..results import NINETY_FIVE
from ..shooting import ShootingProblem
from .fisher import cramer_rao_bound, fisher_information

# Parameters that share more than this of a direction that the flight does not tell are named as partners.
_PARTNER = 0.2


class Identifiability(eqx.Module):
    """The information of a flight in the parameters, in units of the bracket's half-widths.

    - `nominal`: the size that each parameter is expected to have: what the airframe implies.
    - `half_width`: of the bracket.
    - `std`: the Cramer-Rao bound, as standard deviations in the parameters' units.
    - `std_alone`: the same if all other parameters were known.
    - `eigenvalues`: of the scaled information, rising: below 1, the flight tells less about that direction than the
      bracket did.
    - `directions`: the eigenvectors, one a column, in half-widths.
    """

    nominal: Parameters
    half_width: Parameters
    std: Parameters
    std_alone: Parameters
    eigenvalues: Parameters
    directions: Float[Array, "parameters parameters"]

    @property
    def identifiable(self) -> Bool[Array, " parameters"]:
        """Whether the flight tells more about each parameter than its bracket did."""
        return self.std <= self.half_width

    @property
    def excited(self) -> Bool[Array, " parameters"]:
        """Whether it would, if all other parameters were known."""
        return self.std_alone <= self.half_width

    @property
    def noise_limit(self) -> Parameters:
        """Multiples of the problem's sigma below which a parameter of nominal size is told apart from 0, with 95 %."""
        return jnp.abs(self.nominal) / (NINETY_FIVE * self.std)

    def notes(self, names: tuple[str, ...]) -> dict[str, str]:
        """For each parameter of which something must be said, what it is. Of one flight, not of a batch."""
        notes = {}
        told, excited, limit = (np.asarray(x) for x in (self.identifiable, self.excited, self.noise_limit))
        nominal = np.asarray(self.nominal)
        for i, name in enumerate(names):
            if not np.isfinite(self.std[i]):
                notes[name] = "not told: no trajectory, or no bracket, to judge by"
            elif not excited[i]:
                notes[name] = "not told: not excited"
            elif not told[i]:
                partners = ", ".join(names[j] for j in self._partners(i))
                notes[name] = f"not told: only together with {partners}"
            elif limit[i] < 1 and nominal[i] != 0:
                notes[name] = f"below the noise floor at this noise; identifiable below {limit[i]:.2g} of it"
        return notes

    def _partners(self, i: int) -> list[int]:
        """The parameters with which `i` can be traded without the flight telling."""
        vectors = np.asarray(self.directions) / np.sqrt(np.maximum(np.asarray(self.eigenvalues), 1e-300))
        weakest = vectors[:, np.argmax(np.abs(vectors[i]))]
        share = np.abs(weakest) / np.abs(weakest).max()
        return [j for j in range(len(share)) if j != i and share[j] > _PARTNER] or [int(np.argsort(share)[-2])]


def identifiability(
    problem: ShootingProblem,
    bracket: Bracket,
    parameters: Parameters,
    initial_state: Float[Array, " starts"] | None = None,
) -> Identifiability:
    """What a problem's flight tells about its model's parameters near `parameters`, with the problem's sigma.

    **Arguments:**

    - `bracket`: its half-widths say how well each parameter is known without the flight.
    - `initial_state`: where it is free, it is unknown too, and eliminated.

    Standard deviations are infinite where the trajectory diverges at `parameters` or the bracket is not valid.

    **Raises:** `ValueError` for parameters or a bracket of another length than the model's parameters.
    """
    parameters, names = as_float(parameters), problem.model.parameter_names
    for name, shape in (("parameters", parameters.shape), ("bracket", bracket.lower.shape)):
        if shape != (len(names),):
            raise ValueError(f"`{name}` must hold {len(names)} parameters, got shape {shape}.")
    return _identifiability(problem, bracket, parameters, initial_state)


@eqx.filter_jit
def _identifiability(
    problem: ShootingProblem, bracket: Bracket, parameters: Parameters, initial_state: Float[Array, " starts"] | None
) -> Identifiability:
    sound = bracket.valid & jnp.isfinite(problem.cost(parameters, initial_state))
    parameters, half_width = jnp.where(sound, parameters, problem.model.alpha), bracket.usable.half_width
    information = fisher_information(problem, parameters, initial_state)
    eigenvalues, directions = jnp.linalg.eigh(information * half_width[:, None] * half_width[None, :])
    diagonal = jnp.diagonal(information)
    alone = jnp.where(diagonal > 0, 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0)), jnp.inf)
    bound = cramer_rao_bound(problem, parameters, initial_state)
    std, alone = (jnp.where(sound, x, jnp.inf) for x in (jnp.sqrt(jnp.diagonal(bound)), alone))
    return Identifiability(problem.model.alpha, half_width, std, alone, eigenvalues, directions)
