"""Predictions of whole flights by an identified vehicle: position, velocity, attitude and body rates, with a band."""

from .flight_prediction import (
    QUANTITIES as QUANTITIES,
    FlightPrediction as FlightPrediction,
    Quality as Quality,
    check_suffix as check_suffix,
)
from .predict import predict as predict
from .vehicle import Vehicle as Vehicle, vehicle_of as vehicle_of
