"""A ULog file, decoded by pyulog: its topics as series in our frame, and the autopilot's parameters."""

import contextlib
import functools
import io
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from .._files import BROKEN
from .sampling import HALF_TURN, Series, in_order, logged_rate
from .table import Path, read_bytes, refuse

MAGIC = b"ULog\x01\x12\x35"
_FASTER = 1.1  # a topic that is this much faster than another is preferred to it
_MOST_FIELDS = 1024  # of one message, with those of arrays and nested messages; the largest of PX4 have about 200
_DEEPEST = 3  # levels of messages inside messages
_LARGEST = 1 << 31  # bytes of a file
_LOST = bytes(64)
_MOST_SEEKS = 1000  # pyulog seeks for each corrupt byte, and a few times in an intact file

Fields = dict[str, np.ndarray]


class Topics(NamedTuple):
    """The decoded topics, each with its instances; the parameters; the log's names of our columns; the notes."""

    path: Path
    topics: dict[str, list[Fields]]
    parameters: dict[str, float]
    names: dict[str, str]
    notes: list[str]

    def latest(self, topic: str, field: str) -> float | None:
        """The last value of a field, or None if it was not logged, or is damaged."""
        values = self.fields(topic).get(field)
        last = math.nan if values is None or not values.size else float(values[-1])
        return last if math.isfinite(last) else None

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

    def fastest(self, sources: Mapping[str, str], columns: Sequence[str]) -> tuple[Series, str] | None:
        """The vector that was logged most often, in our frame, and its topic. Of equals, the first.

        `sources`: by topic, the field with three numbers along the body's axes.
        """
        best, found = 0.0, None
        for topic, field in sources.items():
            fields = [f"{field}[{i}]" for i in range(3)]
            for instance in range(len(self.topics.get(topic, []))):
                series = self.series(topic, fields, instance)
                if series is None or not np.isfinite(series.values).any():
                    continue
                if found is None or logged_rate(series.t) > _FASTER * best:
                    best, found = logged_rate(series.t), (Series(series.t, series.values * HALF_TURN), topic)
                    self.names.update((c, f"{topic}.{f}") for c, f in zip(columns, fields, strict=True))
        return found


def decoded(path: Path, topics: Sequence[str]) -> Topics:
    """Decode the topics that are needed. Raises `InputError`, one line, for a file that cannot be decoded."""
    try:
        from pyulog.core import ULog
        from pyulog.exceptions import ULogException
    except ImportError:
        refuse(path, "reading a ULog file needs pyulog; install jaxos4[ulog]")
    content = read_bytes(path, _LARGEST)
    if content.endswith(_LOST):  # a loss of power leaves zeros at the end
        content = content.rstrip(b"\0")
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            _check_formats(ULog(_Content(content), parse_header_only=True).message_formats)
            log = ULog(_Content(content), list(topics))
    except (*BROKEN, ULogException) as error:
        what = " ".join(str(error).split())[:120] or type(error).__name__
        refuse(path, f"cannot be decoded ({what}); copy the log again from the vehicle")
    if log.file_corruption:
        refuse(path, "is corrupt; copy the log again from the vehicle, or repair it")
    found: dict[str, list[Fields]] = {}
    for data in sorted(log.data_list, key=lambda data: data.multi_id):
        if "timestamp" in data.data:
            found.setdefault(data.name, []).append(data.data)
    changed = {name: value for _, name, value in log.changed_parameters}
    numbers = {k: v for k, v in (log.initial_parameters | changed).items() if isinstance(v, int | float)}
    return Topics(path, found, {k: float(v) for k, v in numbers.items() if math.isfinite(v)}, {}, [])


class _Content(io.BytesIO):
    """Ends the search for the next message in a corrupt file, because pyulog tries every byte."""

    seeks = 0

    def seek(self, offset: int, whence: int = 0, /) -> int:
        self.seeks += 1
        if self.seeks > _MOST_SEEKS:
            raise EOFError("it is corrupt")
        return super().seek(offset, whence)


def _check_formats(formats: Mapping[str, Any]) -> None:
    """Refuse formats with too many fields: pyulog makes an object of each, also of arrays inside arrays."""

    @functools.cache
    def count(name: str, depth: int) -> int:
        if depth > _DEEPEST:
            raise ValueError("messages are nested too deeply")
        each = (
            (max(size, 1), count(kind, depth + 1) if kind in formats else 1) for kind, size, _ in formats[name].fields
        )
        if (total := sum(size * fields for size, fields in each)) > _MOST_FIELDS:
            raise ValueError(f"a message has more than {_MOST_FIELDS} fields")
        return max(total, 1)

    for name in formats:
        count(name, 0)
