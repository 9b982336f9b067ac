"""Flight files to `Flight` and back."""

from ._formats import log_format as log_format, read_log as read_log
from .csv import (
    read_flight as read_flight,
    read_flight_and_notes as read_flight_and_notes,
    write_flight as write_flight,
)
