"""Flight files to `Flight` and back."""

from .csv import (
    read_flight as read_flight,
    read_flight_and_notes as read_flight_and_notes,
    write_flight as write_flight,
)
