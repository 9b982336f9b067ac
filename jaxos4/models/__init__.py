"""Models of a quadrotor: state, equations of motion, parameters."""

from .abstract import (
    DEFAULT_HALF_WIDTH as DEFAULT_HALF_WIDTH,
    PARAMETER_NAMES as PARAMETER_NAMES,
    AbstractModel as AbstractModel,
    Parameter as Parameter,
)
from .flight_model import FlightModel as FlightModel
from .os4 import CorrectedOS4 as CorrectedOS4, PublishedOS4 as PublishedOS4
from .terms import TERMS as TERMS, Term as Term, default_terms as default_terms

MODELS = {"published": PublishedOS4, "corrected": CorrectedOS4}
