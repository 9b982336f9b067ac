"""A ULog file: its topics as series in our frame, and the autopilot's parameters.

A walk over the messages checks the file, and keeps only what a flight needs, before pyulog decodes it. pyulog alone
does not return within 20 s from a file of 500 bytes whose formats nest arrays in arrays (1e8 fields), takes the zeros
that a loss of power leaves at the end of a file for corruption, and names no place in the file.

Reference: the ULog file format in the PX4 user guide.
"""

import contextlib
import io
import math
import os
import re
import struct
from collections.abc import Sequence
from typing import IO, NamedTuple, NoReturn

import numpy as np

from .._files import BROKEN
from ..errors import InputError
from .sampling import Series, in_order, logged_rate
from .table import Path, opened, printable, refuse

MAGIC = b"ULog\x01\x12\x35"
HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: from forward, right, down to forward, left, up

_FASTER = 1.1  # a topic that is this much faster than another is preferred to it
_MOST_FIELDS = 1024  # of one message, with those of arrays and nested messages; the largest of PX4 have about 200
_DEEPEST = 3  # levels of messages inside messages
_HEADER = struct.Struct("<HB")
_FIELD = re.compile(rb"([A-Za-z0-9_]+)(?:\[(\d{1,5})\])? ([A-Za-z0-9_]+)")
_BASIC = re.compile(rb"u?int(8|16|32|64)_t|float|double|bool|char")
_PARAMETER = re.compile(rb"(int32_t|float) ([A-Za-z0-9_]{1,32})")

Fields = dict[str, np.ndarray]


class Source(NamedTuple):
    """Three fields of a topic that measure a vector along the body's axes, and how to calibrate them.

    `calibration`: the beginning of the parameters' names, for the raw values of a sensor.
    """

    topic: str
    fields: tuple[str, str, str]
    calibration: str = ""


class Topics(NamedTuple):
    """The decoded topics, each with its instances; the parameters; the log's names of our columns; the notes."""

    path: Path
    topics: dict[str, list[Fields]]
    parameters: dict[str, float]
    names: dict[str, str]
    notes: list[str]

    def latest(self, topic: str, field: str) -> float | None:
        """The last value of a field, or None if it was not logged."""
        values = self.fields(topic).get(field)
        return None if values is None or not values.size else float(values[-1])

    def fields(self, topic: str, instance: int = 0) -> Fields:
        """The fields of a topic; none if it was not logged."""
        found = self.topics.get(topic, [])
        return found[instance] if instance < len(found) else {}

    def series(self, topic: str, fields: Sequence[str], instance: int = 0) -> Series | None:
        """Samples of the fields of a topic, or None if one of them was not logged."""
        raw = self.fields(topic, instance)
        if not raw or not raw.keys() >= set(fields):
            return None
        stamp = raw.get("timestamp_sample", raw["timestamp"])
        stamp = np.asarray(stamp if np.all(stamp > 0) else raw["timestamp"], dtype=float)
        kept = in_order(stamp)
        if kept is None:
            refuse(self.path, f"time runs backward in {topic}: it is corrupt; copy the log again from the vehicle")
        if not kept.all():
            self.notes.append(f"{topic}: {np.count_nonzero(~kept)} late samples are ignored")
        with np.errstate(all="ignore"):  # a damaged float need not be finite
            values = np.column_stack([np.asarray(raw[name], dtype=float)[kept] for name in fields])
        return Series(stamp[kept] / 1e6, np.where(np.isfinite(values), values, np.nan))

    def fastest(self, sources: Sequence[Source], columns: Sequence[str]) -> tuple[Series, str] | None:
        """The source that was logged most often, in our frame, and its topic. Of equals, the first.

        Raw values of a sensor count only if they can be calibrated.
        """
        best: tuple[float, Series, Source] | None = None
        for source in sources:
            for instance in range(len(self.topics.get(source.topic, []))):
                series = self.series(source.topic, source.fields, instance)
                if series is not None and source.calibration:
                    series = self._calibrated(series, source, instance)
                if series is None or not np.isfinite(series.values).any():
                    continue
                rate = logged_rate(series.t)
                if best is None or rate > _FASTER * best[0]:
                    best = rate, series, source
        if best is None:
            return None
        _, series, source = best
        self.names.update((c, f"{source.topic}.{f}") for c, f in zip(columns, source.fields, strict=True))
        return Series(series.t, series.values * HALF_TURN), source.topic

    def _calibrated(self, series: Series, source: Source, instance: int) -> Series | None:
        """Raw values with the offset and scale of their sensor; None if the board is turned, or they are unknown.

        Reference: `calibration::Gyroscope::Correct` and `calibration::Accelerometer::Correct` of PX4.
        """
        get, device = self.parameters.get, self.fields(source.topic, instance).get("device_id", np.empty(0))
        if get("SENS_BOARD_ROT", 0.0) or any(get(f"SENS_BOARD_{axis}_OFF", 0.0) for axis in "XYZ"):
            return None
        for name in (f"{source.calibration}{number}_" for number in range(4)):
            # A parameter is a signed number of 32 bits, the identity of a sensor an unsigned one.
            known = device.size and int(get(f"{name}ID", 0.0)) % (1 << 32) == int(device[0]) != 0
            if known and not get(f"{name}ROT", -1.0) > 0:
                offset = np.array([get(f"{name}{axis}OFF", 0.0) for axis in "XYZ"])
                scale = np.array([get(f"{name}{axis}SCALE", 1.0) for axis in "XYZ"])
                return Series(series.t, (series.values - offset) * scale)
        return None


def decoded(path: Path, topics: Sequence[str]) -> Topics:
    """Decode the topics that are needed. Raises `InputError`, one line, for a file that cannot be decoded."""
    walk = _Walk(path, {name.encode() for name in topics})
    with opened(path, "rb") as file:
        content, cut = walk.through(file)
    try:
        from pyulog.core import ULog
        from pyulog.exceptions import ULogException
    except ImportError:
        name = printable(os.fspath(path))
        raise InputError(f"{name}: reading a ULog file needs pyulog; install jaxos4[ulog].") from None
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            log = ULog(io.BytesIO(content))
    except (*BROKEN, ULogException) as error:
        refuse(path, f"cannot be decoded ({type(error).__name__}); copy the log again from the vehicle")
    if log.file_corruption:
        refuse(path, "is corrupt: a message does not have its topic's size; copy the log again from the vehicle")
    found: dict[str, list[Fields]] = {}
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if "timestamp" in data.data:
            found.setdefault(data.name, []).append(data.data)
    notes = [f"the log ends abruptly: its last {cut} bytes are ignored"] * (cut > 0)
    return Topics(path, found, walk.parameters, {}, notes)


class _Walk:
    """One pass through a file, which keeps the formats and data of `topics`, and the autopilot's parameters.

    A loss of power ends a log in the middle of a message or fills its end with zeros. All messages before are kept. If
    a parameter was changed while the log was written, its last value counts.
    """

    def __init__(self, path: Path, topics: set[bytes]):
        self.path, self.topics, self.position = path, topics, 0
        self.formats: dict[bytes, bytes] = {}
        self.definitions: dict[bytes, bytes] = {}
        self.data = bytearray()
        self.appended: tuple[int, ...] = ()
        self.parameters: dict[str, float] = {}
        self.wanted: dict[int, bool] = {}  # of the topics' numbers

    def through(self, file: IO[bytes]) -> tuple[bytes, int]:
        """A smaller file, and the number of bytes that were cut off its end. Raises `InputError`."""
        start = file.read(16)
        if not start.startswith(MAGIC):
            refuse(self.path, "is not a ULog file of version 1; give a .ulg file")
        if len(start) < 16:
            refuse(self.path, "ends within its header; copy the log again from the vehicle")
        self.position, cut = len(start), 0
        while header := file.read(3):
            length, kind = _HEADER.unpack(header) if len(header) == 3 else (0, 0)
            appended = min((each for each in self.appended if each > self.position), default=math.inf)
            if self.position + 3 + length > appended:  # the message was cut by a crash; the log goes on after it
                self.position = file.seek(int(appended))
                continue
            message = header + (body := file.read(length))
            if len(message) < 3 + length:
                cut = len(message)
                break
            if kind == 0:
                while message:
                    if message.strip(b"\0"):
                        self._corrupt("no message begins there")
                    cut += len(message)
                    message = file.read(1 << 20)
                break
            self._take(chr(kind), message, body)
            self.position += len(message)
        return start + b"".join(self.definitions.values()) + bytes(self.data), cut

    def _take(self, kind: str, message: bytes, body: bytes) -> None:
        if kind == "D":
            wanted = self.wanted.get(int.from_bytes(body[:2], "little")) if len(body) > 1 else None
            if wanted is None:
                self._corrupt("data of a topic that was never announced")
            if wanted:
                self.data += message
        elif kind == "F":
            self.formats[body.partition(b":")[0]] = message
        elif kind == "A":
            if len(body) < 4:
                self._corrupt("a topic without a name")
            wanted = self.wanted[int.from_bytes(body[1:3], "little")] = body[3:] in self.topics
            if wanted:
                self._define(body[3:], 0)
                self.data += message
        elif kind == "P":
            # A damaged parameter is ignored: the flight does not depend on most of them.
            parts = _PARAMETER.fullmatch(body[1:-4])
            if parts is not None and body[0] == len(parts[0]):
                (value,) = struct.unpack("<i" if parts[1] == b"int32_t" else "<f", body[-4:])
                self.parameters |= {parts[2].decode(): float(value)} if math.isfinite(value) else {}
        elif kind == "B":
            if len(body) >= 16 and (body[8] & 0xFE or any(body[9:16])):
                refuse(self.path, "has a newer ULog format than this reader knows; update jaxos4")
            if len(body) >= 40 and body[8] & 1:
                self.appended = struct.unpack_from("<QQQ", body, 16)
        elif not "A" <= kind <= "Z":
            self._corrupt("no message begins there")

    def _define(self, name: bytes, depth: int) -> int:
        """Keep the format of a message and the formats inside it. Returns the number of its fields."""
        message = self.formats.get(name)
        if message is None:
            self._corrupt(f"topic {printable(name[:40].decode(errors='replace'))} has no format")
        if depth > _DEEPEST:
            self._corrupt("messages are nested too deeply")
        total = 0
        for field in filter(None, message[3:].partition(b":")[2].split(b";")):
            parts = _FIELD.fullmatch(field)
            if parts is None:
                self._corrupt("a field cannot be read")
            count = int(parts[2] or 1)
            total += count * (1 if _BASIC.fullmatch(parts[1]) else self._define(parts[1], depth + 1) if count else 0)
            if total > _MOST_FIELDS:
                self._corrupt(f"a message has more than {_MOST_FIELDS} fields")
        self.definitions.setdefault(name, message)
        return total

    def _corrupt(self, why: str) -> NoReturn:
        refuse(self.path, f"is corrupt at byte {self.position}: {why}; copy it again from the vehicle, or repair it")
