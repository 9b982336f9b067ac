"""The likelihoods of a flight: from unknowns to a cost with its gradient and information."""

from .abstract import (
    AbstractProblem as AbstractProblem,
    InitialGuess as InitialGuess,
    LocalModel as LocalModel,
    Parts as Parts,
    Stage as Stage,
    Stages as Stages,
    Unknowns as Unknowns,
    WindowUnknowns as WindowUnknowns,
)
from .innovations import InnovationsProblem as InnovationsProblem
from .layout import (
    capacity_of as capacity_of,
    pad_flight as pad_flight,
    padded as padded,
    with_capacity as with_capacity,
)
from .problem import ROUNDING as ROUNDING, ShootingProblem as ShootingProblem
from .scans import FASTEST as FASTEST, Length as Length, Rows as Rows
