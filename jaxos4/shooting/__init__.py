"""The mismatch between a flight and a simulation of it: cost, residuals, gradient and information."""

from .lanes import in_blocks as in_blocks
from .padding import padded as padded
from .problem import ROUNDING as ROUNDING, ShootingProblem as ShootingProblem
from .rows import Rows as Rows, each_window as each_window
from .scans import FASTEST as FASTEST, Curvature as Curvature, Length as Length, Shot as Shot
