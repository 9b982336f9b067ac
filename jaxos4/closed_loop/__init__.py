"""Simulation of flights in closed loop.

On a simulated flight with given rotor speeds (`jaxos4.simulate`) the inputs know nothing of the disturbances. On a real
flight the controller answers each gust, so inputs and disturbances are correlated. This package makes such flights.
"""

from .flight import (
    References as References,
    fly_closed_loop as fly_closed_loop,
    fly_standard as fly_standard,
    random_references as random_references,
)
from .settings import LOGGED as LOGGED, Air as Air, ClosedLoop as ClosedLoop, Sensors as Sensors
