"""The registry of log formats, and the reader that chooses among them."""

from ..airframe import Airframe
from ..flight import Flight
from .assemble import facts_of, flight_of
from .blackbox import BLACKBOX
from .crazyflie import CRAZYFLIE
from .csv import CSV
from .facts import LogFacts
from .table import LogFormat, Path, opened_bytes
from .ulog import ULOG

FORMATS: tuple[LogFormat, ...] = (ULOG, CRAZYFLIE, BLACKBOX, CSV)
"""The formats in the order in which they are tried. A new format is one line here, before the last."""

_FIRST_BYTES = 1 << 18


def read_log(
    path: Path, airframe: Airframe | None = None, *, full_scale: float | None = None
) -> tuple[Flight, tuple[str, ...]]:
    """Read a log of any known format.

    The format is recognised from the first bytes of the file; its name does not matter. The columns of each format
    are listed in `jaxos4.logs.csv`, `jaxos4.logs.ulog` (PX4), `jaxos4.logs.blackbox` (Betaflight and INAV) and
    `jaxos4.logs.crazyflie` (micro-SD card).

    **Arguments:**

    - `airframe`: its `max_rotor_speed` turns commands into rotor speeds. A log with rotor speeds needs no airframe.
    - `full_scale`: rotor speed of command 1 [rad/s] if the airframe gives none. With 1, commands stay as they are.

    **Returns:** the flight, and notes on what the reader changed or assumed: one line each, without the file's name.

    **Raises:** `InputError`, one line: the file, the place in it, what is wrong and what to do.
    """
    flight, notes, facts = read_log_and_facts(path, airframe, full_scale=full_scale)
    return flight, (*notes, *([facts.too_slow] if facts.too_slow else []))


def read_log_and_facts(
    path: Path, airframe: Airframe | None = None, *, full_scale: float | None = None
) -> tuple[Flight, tuple[str, ...], LogFacts]:
    """Read a log as `read_log` does, and return also what it says beside the flight, before any resampling.

    The rates of logging are in the facts only, and not in the notes.
    """
    table, notes = log_format(path).read(path)
    flight, more = flight_of(table, airframe, full_scale=full_scale)
    return flight, (*notes, *more), facts_of(table)


def log_format(path: Path) -> LogFormat:
    """The format of a log: the first of `FORMATS` that recognises it, or the last (the flight CSV).

    A pipe can be read only once, so it always counts as the last.

    **Raises:** `InputError` if the file cannot be opened.
    """
    with opened_bytes(path) as file:
        begin = file.read(_FIRST_BYTES) if file.seekable() else b""
    return next((each for each in FORMATS[:-1] if each.recognises(begin)), FORMATS[-1])
