"""Predictions of whole flights by an identified vehicle: position, velocity, attitude and body rates, with a band."""

from .flight_prediction import (
    QUANTITIES as QUANTITIES,
    FlightPrediction as FlightPrediction,
    Quality as Quality,
    check_suffix as check_suffix,
)
from .predict import Vehicle as Vehicle, predict as predict, vehicle_of as vehicle_of
