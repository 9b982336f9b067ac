"""From recorded flights to an identification: prepare, fit, judge, describe."""

from .assess import FlightInformation as FlightInformation, assess as assess
from .identify import identify as identify
from .prepare import FlightSettings as FlightSettings, VehicleSettings as VehicleSettings, settings_for as settings_for
from .results import Identification as Identification
