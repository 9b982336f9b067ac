"""Simulation of flights in closed loop: the controller answers each gust, so inputs and disturbances are correlated."""

from ..excitation import (
    References as References,
    random_references as random_references,
    standard_references as standard_references,
    with_largest as with_largest,
)
from .flight import fly_closed_loop as fly_closed_loop, fly_standard as fly_standard
from .settings import LOGGED as LOGGED, Air as Air, ClosedLoop as ClosedLoop, Sensors as Sensors
