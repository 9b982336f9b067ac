"""From recorded flights to an identification: data, likelihood, search, estimate, checks."""

from .assess import FlightInformation as FlightInformation, assess as assess
from .identify import identify as identify
from .results import Identification as Identification
from .settings import (
    FlightSettings as FlightSettings,
    VehicleSettings as VehicleSettings,
    settings_for as settings_for,
)
