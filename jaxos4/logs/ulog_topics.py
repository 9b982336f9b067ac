"""The decoded topics of a ULog file, as series in our frame, and the autopilot's parameters."""

import contextlib
import io
import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from .._files import BROKEN
from ..errors import InputError
from .facts import logged_rate
from .series import Series, in_order
from .table import Path, printable, refuse
from .ulog_messages import needed_messages

HALF_TURN = np.array([1.0, -1.0, -1.0])  # about x: from forward, right, down to forward, left, up

# A topic that is this much faster than another is preferred to it.
_FASTER = 1.1

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
        found = self.topics.get(topic, [])[instance : instance + 1]
        return found[0] if found else {}

    def series(self, topic: str, fields: Sequence[str], instance: int = 0) -> Series | None:
        """Samples of the fields of a topic, or None if one of them was not logged."""
        raw = self.fields(topic, instance)
        if not raw or not all(name in raw for name in fields):
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
        get, device = self.parameters.get, self.fields(source.topic, instance).get("device_id")
        turned = get("SENS_BOARD_ROT", 0.0) or any(get(f"SENS_BOARD_{axis}_OFF", 0.0) for axis in "XYZ")
        if turned or device is None or not device.size:
            return None
        for number in range(4):
            name = f"{source.calibration}{number}_"
            # A parameter is a signed number of 32 bits, the identity of a sensor an unsigned one.
            if int(get(f"{name}ID", 0.0)) % (1 << 32) == int(device[0]) != 0 and not get(f"{name}ROT", -1.0) > 0:
                offset = np.array([get(f"{name}{axis}OFF", 0.0) for axis in "XYZ"])
                scale = np.array([get(f"{name}{axis}SCALE", 1.0) for axis in "XYZ"])
                return Series(series.t, (series.values - offset) * scale)
        return None


def decoded(path: Path, topics: Sequence[str]) -> Topics:
    """Decode the topics that are needed. Raises `InputError`, one line, for a file that cannot be decoded."""
    content, parameters, cut = needed_messages(path, topics)
    notes = [f"the log ends abruptly: its last {cut} bytes are ignored"] if cut else []
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
    return Topics(path, found, parameters, {}, notes)
