"""A ULog file: its topics as series in our frame, and the autopilot's parameters.

Only the topics that a flight needs are decoded. What a message announces is checked before memory is used for it.

Reference: the ULog file format in the PX4 user guide.
"""

import math
import re
import struct
from collections.abc import Sequence
from operator import itemgetter
from typing import IO, NamedTuple, NoReturn

import numpy as np

from .sampling import Series, in_order, logged_rate
from .table import Path, opened, printable, refuse

MAGIC = b"ULog\x01\x12\x35"
HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: from forward, right, down to forward, left, up

_FASTER = 1.1  # a topic that is this much faster than another is preferred to it
_MOST_FIELDS = 1024  # of one message, with those of arrays and nested messages; the largest of PX4 have about 200
_DEEPEST = 3  # levels of messages inside messages
_HEADER = struct.Struct("<HB")
_FIELD = re.compile(rb"([A-Za-z0-9_]+)(?:\[(\d{1,5})\])? ([A-Za-z0-9_]+)")
_BASIC = {
    f"{sign}int{8 * size}_t".encode(): f"<{code}{size}"
    for sign, code in (("", "i"), ("u", "u"))
    for size in (1, 2, 4, 8)
}
_BASIC |= {b"float": "<f4", b"double": "<f8", b"bool": "i1", b"char": "i1"}
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
    walk = _Walk(path, topics)
    with opened(path, "rb") as file:
        cut = walk.through(file)
    found: dict[str, list[Fields]] = {}
    for name, _, layout, data in sorted(filter(None, walk.announced.values()), key=itemgetter(1)):
        records = np.frombuffer(data, layout) if data else np.empty(0, layout)
        if records.size and "timestamp" in (names := layout.names or ()):
            found.setdefault(name, []).append({field: records[field] for field in names})
    notes = [f"the log ends abruptly: its last {cut} bytes are ignored"] * (cut > 0)
    return Topics(path, found, walk.parameters, {}, notes)


class _Walk:
    """One pass through a file, which keeps the samples of `topics`, and the autopilot's parameters.

    A loss of power ends a log in the middle of a message or fills its end with zeros. All messages before are kept. If
    a parameter was changed while the log was written, its last value counts.
    """

    def __init__(self, path: Path, topics: Sequence[str]):
        self.path, self.topics, self.position = path, topics, 0
        self.formats: dict[bytes, bytes] = {}
        # Name, instance, layout and samples of the topics by their numbers; None: another topic.
        self.announced: dict[int, tuple[str, int, np.dtype, bytearray] | None] = {}
        self.appended: tuple[int, ...] = ()
        self.parameters: dict[str, float] = {}

    def through(self, file: IO[bytes]) -> int:
        """Read the file; returns the number of bytes that were cut off its end. Raises `InputError`."""
        start = file.read(16)
        if not start.startswith(MAGIC):
            refuse(self.path, "is not a ULog file of version 1; give a .ulg file")
        if len(start) < 16:
            refuse(self.path, "ends within its header; copy the log again from the vehicle")
        self.position = len(start)
        while header := file.read(3):
            length, kind = _HEADER.unpack(header) if len(header) == 3 else (0, 0)
            appended = min((each for each in self.appended if each > self.position), default=math.inf)
            if self.position + 3 + length > appended:  # the message was cut by a crash; the log goes on after it
                self.position = file.seek(int(appended))
                continue
            body = file.read(length)
            if len(header) + len(body) < 3 + length:
                return len(header) + len(body)
            if kind == 0:
                rest = header + body + file.read()
                if rest.strip(b"\0"):
                    self._corrupt("no message begins there")
                return len(rest)
            self._take(chr(kind), body)
            self.position += 3 + length
        return 0

    def _take(self, kind: str, body: bytes) -> None:
        if kind == "D":
            number = int.from_bytes(body[:2], "little")
            if len(body) < 2 or number not in self.announced:
                self._corrupt("data of a topic that was never announced")
            if topic := self.announced[number]:
                if len(body) - 2 != topic[2].itemsize:
                    self._corrupt("a message does not have its topic's size")
                topic[3].extend(body[2:])
        elif kind == "F":
            name, _, fields = body.partition(b":")
            self.formats[name] = fields
        elif kind == "A":
            if len(body) < 4:
                self._corrupt("a topic without a name")
            number, name = int.from_bytes(body[1:3], "little"), body[3:].decode(errors="replace")
            fields = self._layout(body[3:]) if name in self.topics else []
            while fields and fields[-1][0].startswith("_padding"):  # not logged at the end of a message
                fields.pop()
            if len(dict(fields)) < len(fields):
                self._corrupt("a field occurs twice")
            self.announced[number] = (name, body[0], np.dtype(fields), bytearray()) if name in self.topics else None
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

    def _layout(self, name: bytes, depth: int = 0) -> list[tuple[str, str]]:
        """The fields of a message with their types for NumPy; those of nested messages as `esc[0].esc_rpm`."""
        if name not in self.formats:
            self._corrupt(f"topic {printable(name[:40].decode(errors='replace'))} has no format")
        if depth > _DEEPEST:
            self._corrupt("messages are nested too deeply")
        fields: list[tuple[str, str]] = []
        for text in filter(None, self.formats[name].split(b";")):
            parts = _FIELD.fullmatch(text)
            if parts is None:
                self._corrupt("a field cannot be read")
            kind, count, own = parts[1], int(parts[2] or 1), parts[3].decode()
            inner = [("", _BASIC[kind])] if kind in _BASIC else self._layout(kind, depth + 1) if count else []
            if len(fields) + count * max(len(inner), 1) > _MOST_FIELDS:
                self._corrupt(f"a message has more than {_MOST_FIELDS} fields")
            for element in [f"{own}[{i}]" for i in range(count)] if parts[2] else [own]:
                fields += [(f"{element}.{field}" if field else element, code) for field, code in inner]
        return fields

    def _corrupt(self, why: str) -> NoReturn:
        refuse(self.path, f"is corrupt at byte {self.position}: {why}; copy it again from the vehicle, or repair it")
