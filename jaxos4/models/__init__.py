"""Models of a quadrotor: states, equations of motion, parameters."""

from .abstract import (
    DEFAULT_HALF_WIDTH as DEFAULT_HALF_WIDTH,
    PARAMETER_NAMES as PARAMETER_NAMES,
    AbstractModel as AbstractModel,
)
from .corrected import CorrectedOS4 as CorrectedOS4
from .inertial import InertialOS4 as InertialOS4
from .published import PublishedOS4 as PublishedOS4

MODELS = {"published": PublishedOS4, "corrected": CorrectedOS4}
