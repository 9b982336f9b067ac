"""Predictions of whole flights by an identified vehicle: position, velocity, attitude and body rates, with a band."""

from .predict import predict as predict
from .prediction import QUANTITIES as QUANTITIES, FlightPrediction as FlightPrediction
