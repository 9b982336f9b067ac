"""Predictions of whole flights by an identified vehicle: position, velocity, attitude and body rates, with a band."""

from .predict import predict as predict
from .prediction import QUANTITIES as QUANTITIES, FlightPrediction as FlightPrediction, check_suffix as check_suffix
from .vehicle import Vehicle as Vehicle, vehicle_of as vehicle_of
