"""From recorded flights to an identification: data, likelihood, search, estimate, checks."""

from .assess import FlightInformation as FlightInformation, assess as assess
from .identify import identify as identify, settings_for as settings_for
from .problem import OS4Settings as OS4Settings
from .results import (
    Identification as Identification,
    OS4Identification as OS4Identification,
    VehicleIdentification as VehicleIdentification,
)
from .vehicle import VehicleSettings as VehicleSettings
