"""The table of parameters: estimates with intervals, and notes."""

from collections.abc import Callable

import equinox as eqx
import msgspec
import numpy as np
from jaxtyping import Float

from .._custom_types import Numeric, Parameters
from ..bracket import NO_PRIOR, Bracket, is_identifiable
from ..estimate import Estimate
from ..models.abstract import AbstractModel
from .results import ParameterEstimate, finite_or_none


def parameter_table(
    model: AbstractModel,
    estimate: Estimate,
    bound: Float[Numeric, " parameters"],
    bracket: Bracket,
    *,
    prior: float = NO_PRIOR,
    reason: Callable[[int], str] = lambda i: "not identifiable from these flights",
    noise_limit: Callable[[int], float | None] | None = None,
) -> dict[str, ParameterEstimate]:
    """Estimates by parameter name. `bracket` and `prior` decide which are identifiable, see `Bracket.identifies`.

    - `bound`: standard deviations of the Cramer-Rao bound.
    - `reason`: why a parameter is not identifiable, by its place.
    - `noise_limit`: by place; see `ParameterEstimate`.
    """
    std, half_width = map(np.asarray, _intervals(estimate))
    values, bounds = np.asarray(estimate.parameters), np.asarray(bound)
    identifiable = is_identifiable(std, np.asarray(bracket.half_width), prior)
    return {
        name: ParameterEstimate(
            estimate=float(values[i]) if identifiable[i] else None,
            std=finite_or_none(std[i]),
            bound=finite_or_none(bounds[i]),
            ci95=(float(values[i] - half_width[i]), float(values[i] + half_width[i])) if identifiable[i] else None,
            unit=unit,
            note=_note(estimate, bracket, i, float(half_width[i])) if identifiable[i] else reason(i),
            noise_limit=msgspec.UNSET if noise_limit is None else noise_limit(i),
        )
        for i, (name, unit) in enumerate(zip(model.parameter_names, model.parameter_units, strict=True))
    }


@eqx.filter_jit  # one compiled program instead of one for each operation
def _intervals(estimate: Estimate) -> tuple[Parameters, Parameters]:
    return estimate.std, estimate.half_width(0.95)


def _note(estimate: Estimate, bracket: Bracket, i: int, half_width: float) -> str:
    value, seed = float(np.asarray(estimate.parameters)[i]), estimate.seed
    notes = ["below noise"] if abs(value) < half_width else []
    if not np.asarray(bracket.lower)[i] <= value <= np.asarray(bracket.upper)[i]:
        notes.append("outside its bracket")
    if seed is not None and not np.asarray(seed.lower)[i] <= value <= np.asarray(seed.upper)[i]:
        notes.append("outside the network's interval")
    return "; ".join(notes)
