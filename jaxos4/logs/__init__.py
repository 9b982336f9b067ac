"""Files of recorded flights to `Flight`, and back to CSV. Each log format is one file and one line in `FORMATS`."""

from .csv import (
    read_flight as read_flight,
    read_flight_and_notes as read_flight_and_notes,
    write_flight as write_flight,
)
from .facts import LogFacts as LogFacts, Sampling as Sampling
from .formats import (
    FORMATS as FORMATS,
    log_format as log_format,
    read_log as read_log,
    read_log_and_facts as read_log_and_facts,
)
from .table import LogFormat as LogFormat, Table as Table
