"""Flight files to `Flight` and back."""

from .csv import read_flight as read_flight
from .csv import read_flight_and_notes as read_flight_and_notes
from .csv import write_flight as write_flight
