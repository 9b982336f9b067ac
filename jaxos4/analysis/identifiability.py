"""Which parameters a flight can identify, and for each of the others the reason why not."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from .._custom_types import as_float
from ..bracket import Bracket, is_identifiable
from ..linalg import inverses
from ..results import NINETY_FIVE
from .evaluation import Evaluation, evaluate

PerParameter = Float[np.ndarray, " parameters"]
_PARTNER = 0.2  # a parameter with this share of a weakly determined direction is named as a partner


class Identifiability(eqx.Module):
    """The information that a flight contains about each parameter, compared with its bracket.

    - `nominal`: the value of each parameter that the airframe implies.
    - `half_width`: half-widths of the bracket.
    - `std`: the Cramer-Rao bound, as standard deviations in the units of the parameters.
    - `std_alone`: the Cramer-Rao bound if all other parameters were known.
    - `eigenvalues`: of the information in half-widths, in increasing order. Below 1 the flight contains less
      information about that direction than the bracket.
    - `directions`: the eigenvectors in half-widths, one in each column.
    """

    nominal: PerParameter
    half_width: PerParameter
    std: PerParameter
    std_alone: PerParameter
    eigenvalues: PerParameter
    directions: Float[np.ndarray, "parameters parameters"]

    @property
    def identifiable(self) -> Bool[np.ndarray, " parameters"]:
        """Whether each parameter is identifiable, by the rule of `jaxos4.bracket.is_identifiable`."""
        return is_identifiable(self.std, self.half_width)  # pyright: ignore[reportReturnType]

    @property
    def excited(self) -> Bool[np.ndarray, " parameters"]:
        """Whether each parameter would be identifiable if all others were known."""
        return is_identifiable(self.std_alone, self.half_width)  # pyright: ignore[reportReturnType]

    @property
    def noise_limit(self) -> PerParameter:
        """The largest noise, in multiples of sigma, at which the 95 % interval of the nominal value excludes 0."""
        return np.abs(self.nominal) / (NINETY_FIVE * self.std)

    def notes(self, names: tuple[str, ...]) -> dict[str, str]:
        """A note for each parameter that is not identifiable or below the noise floor."""

        def note(i: int) -> str:
            if not np.isfinite(self.std[i]):
                return "not identifiable: the trajectory is not finite, or the bracket is not valid"
            if not self.excited[i]:
                return "not identifiable: not excited"
            if not self.identifiable[i]:
                vectors = self.directions / np.sqrt(np.maximum(self.eigenvalues, 1e-300))
                weakest = np.abs(vectors[:, np.argmax(np.abs(vectors[i]))])
                share = weakest / weakest.max()  # that changes together with least effect on the flight
                partners = np.flatnonzero((share > _PARTNER) & (np.arange(share.size) != i)).tolist()
                partners = partners or [int(np.argsort(share)[-2])]
                return f"not identifiable: only together with {', '.join(names[j] for j in partners)}"
            if self.noise_limit[i] < 1 and self.nominal[i] != 0:
                limit = f"{self.noise_limit[i]:.2g} times this noise"
                return f"below the noise floor: can be distinguished from 0 below {limit}"
            return ""

        return {name: text for i, name in enumerate(names) if (text := note(i))}


def identifiability(evaluation: Evaluation, bracket: Bracket) -> Identifiability:
    """Analyse which parameters of the problem's model its flight can identify, at the problem's sigma.

    - `evaluation`: the flight, evaluated where the information is computed.
    - `bracket`: its half-widths say how well each parameter is known without the flight.

    Standard deviations are infinite if the trajectory diverges or the bracket is not valid. Raises `ValueError` for a
    bracket of another length.
    """
    if bracket.lower.shape != evaluation.nominal.shape:
        raise ValueError(f"`bracket` must hold {evaluation.nominal.size} parameters, got {bracket.lower.shape[0]}.")
    nominal, half_width = evaluation.nominal, np.asarray(bracket.half_width)
    valid = bool(((half_width > 0) & np.isfinite(half_width)).all())
    feasible = valid and evaluation.feasible
    if not evaluation.feasible:
        evaluation = evaluate(evaluation.problem, as_float(nominal))
    half_width = half_width if valid else np.ones_like(nominal)
    information = evaluation.fisher_information
    scaled = np.nan_to_num(information * half_width[:, None] * half_width, posinf=0.0, neginf=0.0)
    eigenvalues, directions = np.linalg.eigh(scaled)
    diagonal = np.diagonal(information)
    with np.errstate(divide="ignore"):
        alone = np.where(diagonal > 0, 1 / np.sqrt(np.maximum(diagonal, 0.0)), np.inf)
    std = np.sqrt(np.diagonal(inverses(information)))
    if not feasible:
        std = alone = np.full_like(std, np.inf)
    return Identifiability(nominal, half_width, std, alone, np.maximum(eigenvalues, 0.0), directions)
