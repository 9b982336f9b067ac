"""Which format a log is in, by how it begins, and its reader."""

import os

from ..airframe import Airframe
from ..flight import Flight
from . import crazyflie
from ._assemble import flight_of
from ._table import opened_bytes, printable, refuse
from .blackbox import is_blackbox, read_blackbox
from .csv import read_flight_and_notes
from .ulog import read_ulog

_BEGIN = 1 << 18
_RAW_BLACKBOX = b"H Product:Blackbox"


def read_log(
    path: str | os.PathLike[str], airframe: Airframe | None = None, *, full_scale: float | None = None
) -> tuple[Flight, tuple[str, ...]]:
    """The flight in a log, whichever of the formats that are known it is in, and what was done to it.

    The formats are described where they are read: `jaxos4.logs.csv` (the project's own), `jaxos4.logs.ulog` (PX4),
    `jaxos4.logs.blackbox` (Betaflight and INAV, as CSV), `jaxos4.logs.crazyflie` (micro-SD card).

    **Arguments:**

    - `path`: the file; its name does not matter.
    - `airframe`: needed where a log holds commands and no rotor speeds: its `max_rotor_speed` is their full scale.
    - `full_scale`: the rotor speed of command 1 [rad/s] where there is no such airframe; 1 leaves commands as they are.

    **Returns:** the flight, and notes: one line each, without the file's name.

    **Raises:** `InputError`, one line: file, place in it, what is wrong and what to do.
    """
    reader = _READERS.get(log_format(path))
    if reader is None:
        return read_flight_and_notes(path, airframe, full_scale=full_scale)
    table, notes = reader(path)
    flight, more = flight_of(table, airframe, full_scale=full_scale)
    return flight, (*notes, *more)


def log_format(path: str | os.PathLike[str]) -> str:
    """`"ULog"`, `"Crazyflie"`, `"blackbox"`, or `"CSV"`, which is whatever is none of the others, and any pipe.

    **Raises:** `InputError` where the file cannot be read, or is a blackbox log that must be decoded first.
    """
    with opened_bytes(path) as file:
        if not file.seekable():  # a pipe can be read once: the most usual format it is
            return "CSV"
        begin = file.read(_BEGIN)
    if begin.startswith(b"ULog"):
        return "ULog"
    if begin.startswith(crazyflie.MAGIC):
        return "Crazyflie"
    if begin.startswith(_RAW_BLACKBOX):
        refuse(
            printable(os.fspath(path)),
            "is a blackbox log as it was recorded; decode it by blackbox_decode, or export it as CSV by Blackbox "
            "Explorer",
        )
    return "blackbox" if is_blackbox(begin.decode("utf-8-sig", errors="replace")) else "CSV"


_READERS = {"ULog": read_ulog, "Crazyflie": crazyflie.read_crazyflie, "blackbox": read_blackbox}
