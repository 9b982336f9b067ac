"""How far the quantities of a vehicle would move if one of its parameters had another value."""

import jax
import numpy as np

from ..estimators import FilterError
from ..results import result_names
from .answers import INVERSE
from .fit import Fit
from .results import Constant
from .verdict import Move

# Levenberg-Marquardt stops within so many standard deviations of the minimum.
_TOLERANCE = 0.04


def consequences(
    fit: Fit, constants: dict[str, Constant], quantities: dict[str, list[str]], name: str, value: float
) -> dict[str, Move | None]:
    """How far each quantity moves if a parameter is fixed at a value, and all others are fitted again.

    Not by the covariance: under a controller the cost is flat, and an inertia moves two to three times as far. Nothing
    moves if the search did not find this parameter. `None`: there is no such fit.

    **Arguments:**

    - `constants`: the moments of inertia.
    - `quantities`: the names of the parameters of each other quantity; see `FlightModel.quantities`.
    """
    if fit.searched is None:
        return {}
    problem, found = fit.searched
    own, values = problem.problem.unknowns, np.asarray(found.parameters)
    place = own.names.index(name)
    if not np.asarray(own.free)[place]:
        return {}
    held = problem.hold({name: np.asarray(value)}).starting_from(values)
    other = jax.block_until_ready(FilterError(tolerance=_TOLERANCE)(held))
    others = {each: names for each, names in quantities.items() if name not in names}
    if str(result_names(other.result)) != "successful":
        return dict.fromkeys((*constants, *others))
    moved, std = (
        np.asarray(other.parameters),
        np.sqrt(np.maximum(np.diagonal(np.asarray(fit.estimate.covariance)), 0.0)),
    )
    gains = [i for i, parameter in enumerate(fit.problem.model.parameters) if parameter.scales_torque]
    factor = np.prod(moved[gains] / values[gains])
    moves: dict[str, Move | None] = {}
    for inertia, row in constants.items():
        share = abs(factor * values[INVERSE[inertia]] / moved[INVERSE[inertia]] - 1)
        moves[inertia] = Move(float(share), float(share * row.estimate / row.std))
    for quantity, names in others.items():
        places = [i for i in map(own.names.index, names) if std[i] > 0]
        if places:
            change, width = np.abs(moved - values)[places], np.asarray(own.half_width)[places]
            moves[quantity] = Move(float((change / width).max()), float((change / std[places]).max()))
    return moves
