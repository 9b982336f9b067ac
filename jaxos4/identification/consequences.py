"""How far the quantities of a vehicle would move if one of its parameters had another value."""

import numpy as np

from .answers import INVERSE
from .fit import Fit
from .results import Constant
from .verdict import Move


def consequences(
    fit: Fit, constants: dict[str, Constant], quantities: dict[str, list[str]], name: str, value: float
) -> dict[str, Move]:
    """The quantities that move if a parameter has this value and the others are fitted again, by the covariance.

    Empty if the parameter is not among those that the search found.

    **Arguments:**

    - `constants`: the moments of inertia.
    - `quantities`: the names of the parameters of each other quantity; see `FlightModel.quantities`.
    """
    if fit.searched is None:
        return {}
    problem, found = fit.searched
    own, covariance, values = problem.problem.unknowns, np.asarray(found.covariance), np.asarray(found.parameters)
    place = own.names.index(name)
    if not covariance[place, place] > 0:
        return {}
    change = (covariance[:, place] / covariance[place, place] * (value - values[place]))[: own.count]
    moved, widths = values[: own.count] + change, np.asarray(own.half_width)
    std = np.sqrt(np.maximum(np.diagonal(np.asarray(fit.estimate.covariance)), 0.0))[: own.count]
    factor = 1.0
    for i, parameter in enumerate(fit.problem.model.parameters):
        if parameter.scales_torque:
            factor *= moved[i] / values[i]
    found_moves = {}
    for inertia, row in constants.items():
        share = abs(factor * values[INVERSE[inertia]] / moved[INVERSE[inertia]] - 1)
        found_moves[inertia] = Move(float(share), float(share * row.estimate / row.std))
    for quantity, names in quantities.items():
        places = [i for each in names if each != name and std[i := own.names.index(each)] > 0]
        if places and name not in names:
            size = np.abs(change[places])
            found_moves[quantity] = Move(float((size / widths[places]).max()), float((size / std[places]).max()))
    return found_moves
