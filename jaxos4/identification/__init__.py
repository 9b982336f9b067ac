"""From recorded flights to an identification: parameters with intervals, constants, quality of fit, predictions."""

from .entry import identify as identify
from .information import assess as assess
from .results import (
    FlightIdentification as FlightIdentification,
    FlightInformation as FlightInformation,
    Identification as Identification,
    VehicleIdentification as VehicleIdentification,
)
from .vehicle import VehicleFit as VehicleFit, fit_vehicle as fit_vehicle, refit as refit
