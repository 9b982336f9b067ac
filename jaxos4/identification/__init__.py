"""From recorded flights to an identification: prepare, fit, judge, describe."""

from .identify import identify as identify
from .information import assess as assess
from .results import FlightInformation as FlightInformation, Identification as Identification
from .settings import (
    FlightSettings as FlightSettings,
    VehicleSettings as VehicleSettings,
    settings_for as settings_for,
)
