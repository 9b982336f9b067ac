"""The mismatch between a flight and a simulation of it: cost, residuals, gradient and information."""

from .abstract import AbstractProblem as AbstractProblem, Stages as Stages, Unknowns as Unknowns
from .batching import cores as cores, for_threads as for_threads, in_blocks as in_blocks, on_all_cores as on_all_cores
from .innovations import InnovationsProblem as InnovationsProblem
from .padding import capacity_of as capacity_of, pad_flight as pad_flight, padded as padded, with_room as with_room
from .problem import ShootingProblem as ShootingProblem
from .scans import (
    FASTEST as FASTEST,
    Curvature as Curvature,
    Length as Length,
    Parts as Parts,
    Rows as Rows,
    Shot as Shot,
    each_window as each_window,
)
from .stages import ROUNDING as ROUNDING
