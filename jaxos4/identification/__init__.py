"""From recorded flights to an identification: data, likelihood, search, estimate, checks."""

from .assess import FlightInformation as FlightInformation, assess as assess
from .identify import identify as identify, settings_for as settings_for
from .prepare_os4 import OS4Settings as OS4Settings
from .prepare_vehicle import VehicleSettings as VehicleSettings
from .results import (
    Identification as Identification,
    OS4Identification as OS4Identification,
    VehicleIdentification as VehicleIdentification,
)
