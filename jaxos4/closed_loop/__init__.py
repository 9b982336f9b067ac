"""Simulation of flights in closed loop: the controller answers each gust, so inputs and disturbances are correlated."""

from .flight import fly_closed_loop as fly_closed_loop, fly_standard as fly_standard
from .settings import LOGGED as LOGGED, Air as Air, ClosedLoop as ClosedLoop, Sensors as Sensors
