"""Blackbox logs as the vehicle wrote them (`.bbl`, `.BFL`, INAV's `.TXT`): their sessions and settings.

A file holds one session for each time that the vehicle was armed. A session begins with settings, one line of text
each, as `H acc_1G:2048`. The frames follow, see `jaxos4.logs.blackbox_frames`.
"""

import math
import os
import re
import struct
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from .blackbox_frames import BadHeader, decode_frames
from .sampling import in_order
from .table import Path, opened, read_bytes, refuse

MAGIC = b"H Product:Blackbox"
DECODE = "decode it by blackbox_decode (of blackbox-tools), and give its CSV"
BETWEEN = 1.0  # [s], put between sessions

# A session is read with the longest one only if they agree in these settings.
_USED = ("acc_1G", "gyro_scale", "blackbox_high_resolution", "maxthrottle", "motorOutput", "motor_poles")
_LARGEST = 1 << 29  # bytes of a file: more than an hour of flight
_LONGEST_LINE = 1 << 14
_FEWEST_ROWS = 2


class Session(NamedTuple):
    """One session of a file: its settings, and the bytes of its frames."""

    settings: dict[str, str]
    frames: bytes

    @property
    def used(self) -> list[str | None]:
        """The settings that say what the numbers mean."""
        return [self.settings.get(name) for name in _USED]


def is_raw(path: Path) -> bool:
    """Whether a file is a blackbox log that was not decoded."""
    with opened(path, "rb") as file:
        return file.seekable() and file.read(len(MAGIC)) == MAGIC


def sessions(path: Path) -> list[Session]:
    """The sessions of a file, in order; none if it is no blackbox log. Raises `InputError`."""
    if not is_raw(path):
        return []
    content = read_bytes(path, _LARGEST)
    places = [match.start() for match in re.finditer(re.escape(MAGIC), content)]
    return [_session(content[begin:end]) for begin, end in zip(places, [*places[1:], len(content)], strict=True)]


def _session(content: bytes) -> Session:
    """A session from its bytes. Its header ends at the first line that does not begin with `H `, or is not text."""
    settings: dict[str, str] = {}
    at = 0
    while content.startswith(b"H ", at):
        stop = content.find(b"\n", at, at + _LONGEST_LINE)
        line = content[at:stop]
        if stop < 0 or not line.isascii():
            break
        name, _, value = line[2:].decode().partition(":")
        settings.setdefault(name.strip(), value.strip())
        at = stop + 1
    return Session(settings, content[at:])


def read_sessions(path: Path, wanted: Collection[str]) -> tuple[dict[str, np.ndarray], dict[str, str], list[str]]:
    """Decode the columns `wanted` of all sessions, one after the other. Raises `InputError`.

    **Returns:** the columns by their names in the log, with `time (us)` from 0; the settings; notes.
    """
    notes: list[str] = []
    found: list[tuple[Session, dict[str, np.ndarray]]] = []
    every = sessions(path)
    for number, session in enumerate(every, start=1):
        columns, remark = _columns(session, wanted)
        if remark:
            notes.append((f"session {number}: " if len(every) > 1 else "") + remark)
        if columns is not None:
            found.append((session, columns))
    if not found:
        why = f" ({notes[0]})" if notes else ""
        refuse(path, f"no frame of it can be decoded{why}: it is corrupt, or of another kind; {DECODE}")
    longest = max(found, key=lambda each: each[1]["time"][-1])[0]
    same = [columns for session, columns in found if session.used == longest.used]
    if len(same) < len(found):
        what = f"{len(found) - len(same)} of {len(found)} sessions are ignored"
        notes.append(f"{what}: their settings are not those of the longest one")
    if len(same) > 1:
        lengths = ", ".join(f"{columns['time'][-1] / 1e6:.1f}" for columns in same)
        notes.append(f"{len(same)} sessions, of {lengths} s, follow each other with {BETWEEN:g} s between them")
    begin = 0.0
    for columns in same:
        columns["time"] += begin
        begin = columns["time"][-1] + 1e6 * BETWEEN
    joined = {name: np.concatenate([columns[name] for columns in same]) for name in set.intersection(*map(set, same))}
    joined["time (us)"] = joined.pop("time")
    return joined, longest.settings, notes


def _columns(session: Session, wanted: Collection[str]) -> tuple[dict[str, np.ndarray] | None, str]:
    """The columns of one session with the time from 0, or `None`, and a remark on what is lost."""
    try:
        decoded = decode_frames(session.settings, session.frames, wanted)
    except BadHeader as error:
        return None, f"{error}: it is ignored"
    time = decoded.columns["time"]
    later = in_order(time)
    if time.size < _FEWEST_ROWS or later is None:
        return None, "holds no frames that can be decoded: it is ignored"
    remarks = []
    if decoded.damaged:
        places = "1 place" if decoded.damaged == 1 else f"{decoded.damaged} places"
        remarks.append(f"is damaged in {places}; what follows up to the next complete frame is ignored")
    if not decoded.ended:
        remarks.append("has no end: it was cut while it was written, or is corrupt")
    return {name: column[later] for name, column in decoded.columns.items()}, "; ".join(remarks)


def settings_beside(path: Path) -> tuple[dict[str, str], str]:
    """The settings of the log that a CSV of `blackbox_decode` was made from, if it lies beside it, and its name.

    `LOG00001.02.csv` was made from the second session of `LOG00001.BFL`, or of `.bbl` or `.TXT`.
    """
    folder, name = os.path.split(os.fspath(path))
    match = re.fullmatch(r"(.+?)(?:\.(\d{2}))?\.csv", name, re.IGNORECASE)
    if match is None:
        return {}, ""
    for ending in ("bbl", "BBL", "bfl", "BFL", "txt", "TXT"):
        beside = os.path.join(folder, f"{match[1]}.{ending}")
        if not os.path.isfile(beside):
            continue
        every = sessions(beside)
        number = int(match[2]) if match[2] else 1 if len(every) == 1 else 0
        if 0 < number <= len(every):
            return every[number - 1].settings, os.path.basename(beside)
    return {}, ""


def gyro_unit(settings: dict[str, str]) -> float:
    """The unit of the gyro [deg/s], by the setting `gyro_scale`, as `0x3f800000`; 1 if there is none."""
    text = settings.get("gyro_scale", "")
    if not re.fullmatch("0x[0-9a-fA-F]{1,8}", text):
        return 1.0
    value = struct.unpack("<f", int(text, 16).to_bytes(4, "little"))[0]
    return value if math.isfinite(value) and 1e-3 <= value <= 1 else 1.0
