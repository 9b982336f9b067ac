"""The messages of a ULog file that are needed, checked, so that whatever decodes them meets nothing it cannot bear.

A decoder of whole logs takes a file at its word: a format that nests arrays in arrays, or a length that points beyond
the end, costs it all memory or an endless search. Here a file is walked once, message by message, at its own size.

Reference: the ULog file format of the PX4 user guide.
"""

import math
import os
import re
import struct
from collections.abc import Collection
from typing import BinaryIO, NamedTuple, NoReturn

from ._table import opened_bytes, printable, refuse

MAGIC = b"ULog\x01\x12\x35"
MOST_FIELDS = 1024  # of one message, arrays and nested messages counted field by field; PX4's largest have about 200
_DEEPEST = 3  # messages in messages
_HEADER = struct.Struct("<HB")
_FIELD = re.compile(rb"([A-Za-z0-9_]+)(?:\[(\d{1,5})\])? ([A-Za-z0-9_]+)")
_BASIC = {
    b"int8_t", b"uint8_t", b"int16_t", b"uint16_t", b"int32_t", b"uint32_t", b"int64_t", b"uint64_t",
    b"float", b"double", b"bool", b"char",
}  # fmt: skip
_REMEDY = "copy it again from the vehicle, or repair it"


class Messages(NamedTuple):
    """A smaller ULog file, of the topics asked for, and how many bytes at the end were no whole message."""

    content: bytes
    left_out: int


def needed_messages(path: str | os.PathLike[str], topics: Collection[str]) -> Messages:
    """What a log holds of `topics`.

    A log that ends in the middle of a message, or in zeros, was cut by a loss of power: what comes before is whole.

    **Raises:** `InputError`, one line, for a file that is no ULog, is corrupt, or is of a newer format.
    """
    shown = printable(os.fspath(path))
    with opened_bytes(path) as file:
        return _Walk(shown, {name.encode() for name in topics}).through(file)


class _Walk:
    """One pass through a file."""

    def __init__(self, path: str, topics: Collection[bytes]):
        self.path, self.topics = path, topics
        self.position = 0
        self.formats: dict[bytes, bytes] = {}
        self.used: set[bytes] = set()
        self.definitions, self.data = bytearray(), bytearray()
        self.appended: tuple[int, ...] = ()
        self.wanted: set[int] = set()
        self.others: set[int] = set()

    def through(self, file: BinaryIO) -> Messages:
        start = file.read(16)
        if not start.startswith(MAGIC):
            refuse(self.path, "is no ULog: it does not begin as one; give a .ulg file")
        if len(start) < 16:
            refuse(self.path, "ends within its header; copy the log again from the vehicle")
        self.position = len(start)
        left_out = 0
        while header := file.read(3):
            length, kind = _HEADER.unpack(header) if len(header) == 3 else (0, 0)
            appended = min((each for each in self.appended if each > self.position), default=math.inf)
            if self.position + 3 + length > appended:  # cut there, and continued after a restart
                self.position = file.seek(int(appended))
                continue
            body = file.read(length)
            if len(header) < 3 or len(body) < length:
                left_out = len(header) + len(body)
                break
            if kind == 0:
                left_out = len(header) + len(body) + self._zeros(file, header + body)
                break
            self._take(kind, header, body)
            self.position += len(header) + length
        return Messages(bytes(start + self.definitions + self.data), left_out)

    def _take(self, kind: int, header: bytes, body: bytes) -> None:
        if kind == ord("D"):
            number = int.from_bytes(body[:2], "little")
            if number in self.wanted:
                self.data += header + body
            elif number not in self.others or len(body) < 2:
                self._corrupt("data of a topic that was never announced")
        elif kind == ord("F"):
            self.formats[body.partition(b":")[0]] = body
        elif kind == ord("A"):
            self._announce(header, body)
        elif kind == ord("B"):
            if len(body) >= 16 and (body[8] & 0xFE or any(body[9:16])):
                refuse(self.path, "is of a newer ULog format than this reader knows; update jaxos4")
            if len(body) >= 40 and body[8] & 1:
                self.appended = struct.unpack_from("<QQQ", body, 16)
        elif not ord("A") <= kind <= ord("Z"):
            self._corrupt("no message begins there")

    def _announce(self, header: bytes, body: bytes) -> None:
        if len(body) < 4:
            self._corrupt("a topic without a name")
        number, name = int.from_bytes(body[1:3], "little"), body[3:]
        if name not in self.topics:
            self.others.add(number)
            return
        self._define(name, 0)
        self.wanted.add(number)
        self.others.discard(number)
        self.data += header + body

    def _define(self, name: bytes, depth: int) -> int:
        """Keep a format and those inside it; the number of its fields."""
        body = self.formats.get(name)
        if body is None:
            self._corrupt(f"topic {printable(name[:40].decode(errors='replace'))} has no format")
        if depth > _DEEPEST:
            self._corrupt("messages are nested too deeply")
        total = 0
        for field in filter(None, body.partition(b":")[2].split(b";")):
            parts = _FIELD.fullmatch(field)
            if parts is None:
                self._corrupt("a field cannot be read")
            count = int(parts[2] or 1)
            total += count * (1 if parts[1] in _BASIC else self._define(parts[1], depth + 1) if count else 0)
            if total > MOST_FIELDS:
                self._corrupt(f"a message has more than {MOST_FIELDS} fields")
        if name not in self.used:
            self.used.add(name)
            self.definitions += _HEADER.pack(len(body), ord("F")) + body
        return total

    def _zeros(self, file: BinaryIO, begun: bytes) -> int:
        """The length of the rest, which must be zeros."""
        size = 0
        rest = begun
        while rest:
            if rest.strip(b"\0"):
                self._corrupt("no message begins there")
            rest = file.read(1 << 20)
            size += len(rest)
        return size

    def _corrupt(self, why: str) -> NoReturn:
        refuse(self.path, f"is corrupt at byte {self.position}: {why}; {_REMEDY}")
