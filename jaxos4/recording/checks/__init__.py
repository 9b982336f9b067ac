"""A log is checked against itself: faults that it shows, with cause, size and remedy."""

from .between import different_vehicles as different_vehicles
from .clocks import CLOCK as CLOCK
from .finding import Finding as Finding, Limits as Limits
from .table import CHECKS as CHECKS, KINEMATIC as KINEMATIC, self_checks as self_checks
from .values import Plausible as Plausible, plausible as plausible
