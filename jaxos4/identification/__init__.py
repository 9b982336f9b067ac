"""From recorded flights to an identification: prepare, fit, judge, describe."""

from .identify import assess as assess, identify as identify
from .prepare import FlightSettings as FlightSettings, VehicleSettings as VehicleSettings, settings_for as settings_for
from .results import FlightInformation as FlightInformation, Identification as Identification
