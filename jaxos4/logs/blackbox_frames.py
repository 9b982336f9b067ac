"""The frames of a blackbox session: numbers of few bits, most of them as differences from a prediction.

A frame begins with a letter: "I" (complete), "P" (differences), "S", "G", "H" (slow values, GPS, home) or "E" (event).
The settings give the fields of each kind. After a damaged frame, all are left out up to the next complete one.

Reference: Nicholas Sherlock, "Blackbox internals", Cleanflight; later encodings: sources of Betaflight and INAV.
"""

import array
import itertools
import re
from collections.abc import Collection, Iterator
from operator import itemgetter

import numpy as np

_TIME, _ITERATION = "time", "loopIteration"
_MARKER = re.compile(rb"[IPSGHE]")
_LONGEST_FRAME = 1024  # bytes
_MOST_FIELDS = 512
_FARTHEST, _MOST_ITERATIONS = 10_000_000, 5000  # [us], from one frame to the next: more is damage
_END, _BAD = b"End of log", "its header is damaged"
_I, _P, _E = b"IPE"
_ADJUSTMENT, _RESUME, _LOG_END = 13, 14, 255
_EVENTS = {0: 1, _ADJUSTMENT: 1, _RESUME: 2, 15: 1, 30: 2, 40: 1}  # event: how many numbers it has

_SIGNED, _UNSIGNED, _NEGATIVE_14, _TAG8, _TAG2_3, _TAG8_4, _NULL, _TAG2_3_V = 0, 1, 3, 6, 7, 8, 9, 10
# How many fields of an encoding are read together.
_TOGETHER = {_TAG8: 8, _TAG2_3: 3, _TAG8_4: 4, _TAG2_3_V: 3}
_TOGETHER |= dict.fromkeys((_SIGNED, _UNSIGNED, _NEGATIVE_14, _NULL), _MOST_FIELDS)
# Three numbers in 14 or 22 bits: (place, width) of each.
_IN_14_OR_22 = {
    _TAG2_3: (((8, 4), (4, 4), (0, 4)), ((16, 6), (8, 6), (0, 6))),
    _TAG2_3_V: (((9, 5), (4, 5), (0, 4)), ((14, 8), (7, 7), (0, 7))),
}
_PREVIOUS, _LINE, _AVERAGE, _MINTHROTTLE, _MOTOR0, _INCREMENT, _1500, _VBATREF, _MINMOTOR = *range(1, 7), 8, 9, 11
_CONSTANTS = {_MINTHROTTLE: "minthrottle", _VBATREF: "vbatref", _MINMOTOR: "motorOutput"}


class BadHeader(Exception):
    """A header that does not describe frames which can be decoded; the text says why."""


def decode_frames(
    settings: dict[str, str], data: bytes, wanted: Collection[str]
) -> tuple[dict[str, np.ndarray], int, bool]:
    """Decode the complete frames of a session from the bytes after its header. Raises `BadHeader`.

    **Returns:** the columns `wanted`, as far as there are, by the names of the log, with `time` [us], which increases
    from 0; the number of places where frames are damaged; whether the session has an end.
    """
    stream, values = _Stream(settings, data), array.array("d")
    names = stream.names
    places = [stream.time, *(i for i, name in enumerate(names) if name in wanted)]
    for row in map(itemgetter(*places, stream.time), stream.frames()):
        values.extend(row)
    columns = dict(zip((names[i] for i in places), np.asarray(values).reshape(-1, len(places) + 1).T, strict=False))
    time = columns[_TIME]
    # The vehicle counts the time in 32 bits, so it wraps after 72 minutes.
    columns[_TIME] = np.cumsum(np.diff(time, prepend=time[:1]) % 2.0**32)
    return columns, stream.damaged, stream.ended


def _fields(settings: dict[str, str]) -> tuple[list[str], dict[int, list[tuple[int, int]]], dict[int, list[int]]]:
    """The names of the fields of main frames; by kind of frame, groups (encoding, number of fields) and predictors.

    Raises `BadHeader`.
    """
    names, groups, predictors = [], {}, {}
    for letter in "IPSGH":
        encodings, predicted = (_numbers(settings.get(f"Field {letter} {what}")) for what in ("encoding", "predictor"))
        if not encodings:
            continue
        labels = [name.strip() for name in settings.get(f"Field {letter} name", "").split(",")]
        same = len(predicted) == len(encodings) <= _MOST_FIELDS and (letter == "P" or len(labels) == len(encodings))
        if not same or (letter == "P" and names and len(predicted) != len(names)):
            raise BadHeader(_BAD)
        names = labels if letter == "I" else names
        groups[ord(letter)], predictors[ord(letter)] = [], predicted
        for encoding, alike in itertools.groupby(encodings):
            if encoding not in _TOGETHER:
                raise BadHeader(f"its frames have an encoding that is not known, {encoding}")
            count, most = len(list(alike)), _TOGETHER[encoding]
            groups[ord(letter)] += [(encoding, min(most, count - done)) for done in range(0, count, most)]
        if _TAG8_4 in encodings and settings.get("Data version", "2") != "2":
            raise BadHeader("its frames are of version 1")
    if not {_TIME, _ITERATION} <= set(names):
        raise BadHeader("its header does not describe the frames")
    return names, groups, predictors


def _numbers(text: str | None) -> list[int]:
    return [int(cell) for cell in text.split(",")] if text and re.fullmatch(r"\d{1,3}(,\d{1,3})*", text) else []


def _whole(text: str | None, default: int) -> int:
    """The number at the beginning of a setting; without a number, or with 0, the default."""
    match = re.match(r"\d{1,9}", text or "")
    return int(match[0]) or default if match else default


class Numbers:
    """Reads numbers from `data`; `at`: the number of bytes read. Raises `IndexError` at the end of the data."""

    def __init__(self, data: bytes):
        self.data, self.at = data, 0

    def read(self, encoding: int, count: int, values: list[int]) -> None:
        """Append `count` numbers of one encoding."""
        if encoding == _SIGNED or (encoding == _TAG8 and count == 1):
            self.signed(count, values)
        elif encoding == _UNSIGNED:
            self.unsigned(count, values)
        elif encoding == _NEGATIVE_14:
            found: list[int] = []
            self.unsigned(count, found)
            values += [-_extended(value, 14) for value in found]
        elif encoding == _TAG8:
            header = self.byte()  # which of up to eight numbers are not 0
            for i in range(count):
                self.signed(header >> i & 1, values)
                values += [0] * (not header >> i & 1)
        else:
            values += ([0] * count if encoding == _NULL else self._packed(encoding))[:count]

    def byte(self) -> int:
        """The next byte."""
        self.at += 1
        return self.data[self.at - 1]

    def unsigned(self, count: int, values: list[int]) -> None:
        """Seven bits a byte, the lowest first; the eighth says that another byte follows."""
        data, at = self.data, self.at
        for _ in range(count):
            byte = data[at]
            at += 1
            value, shift = byte & 0x7F, 7
            while byte & 0x80 and shift < 35:
                byte = data[at]
                at += 1
                value |= (byte & 0x7F) << shift
                shift += 7
            values.append(value)
        self.at = at

    def signed(self, count: int, values: list[int]) -> None:
        """Numbers as `unsigned` reads them, with the sign in the lowest bit."""
        begin = len(values)
        self.unsigned(count, values)
        for i in range(begin, len(values)):
            values[i] = (values[i] >> 1) ^ -(values[i] & 1)

    def _packed(self, encoding: int) -> list[int]:
        """Three numbers of 2 bits, of `_IN_14_OR_22`, or of one to four bytes each, the lowest byte first.

        With `_TAG8_4`: four numbers of 0, 4, 8 or 16 bits, in a row of half bytes.
        """
        lead = self.byte()
        if encoding == _TAG8_4:
            values, bits, unread = [], 0, 0
            for width in ((0, 4, 8, 16)[lead >> shift & 3] for shift in (0, 2, 4, 6)):
                while unread < width:
                    bits, unread = bits << 8 | self.byte(), unread + 8
                unread -= width
                values.append(_extended(bits >> unread, width) if width else 0)
            return values
        size = lead >> 6
        if size == 0:
            return [_extended(lead >> shift, 2) for shift in (4, 2, 0)]
        if size < 3:
            bits = int.from_bytes([lead, *(self.byte() for _ in range(size))])
            return [_extended(bits >> place, width) for place, width in _IN_14_OR_22[encoding][size - 1]]
        lengths = [(lead >> shift & 3) + 1 for shift in (0, 2, 4)]
        return [_extended(sum(self.byte() << 8 * i for i in range(length)), 8 * length) for length in lengths]


def _extended(value: int, bits: int) -> int:
    """The lowest `bits` as a signed number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


class _Stream:
    """The frames of a session in order. Raises `BadHeader`."""

    def __init__(self, settings: dict[str, str], data: bytes):
        self.data, self.numbers = data, Numbers(data)
        self.names, self.groups, self.predictors = _fields(settings)
        self.damaged, self.ended = 0, False
        self.last: tuple[int, int] | None = None  # iteration and time of the last frame
        self.time, self.iteration = self.names.index(_TIME), self.names.index(_ITERATION)
        self.motor0 = self.names.index("motor[0]") if "motor[0]" in self.names else 0
        self.constants = {key: _whole(settings.get(name), 0) for key, name in _CONSTANTS.items()} | {_1500: 1500}
        first, _, last = settings.get("P interval", "").partition("/")
        self.interval = _whole(settings.get("I interval"), 1)
        self.share, self.apart = (_whole(first, 1), _whole(last, 1)) if last else (1, _whole(first, 1))
        if self.interval > 1 << 16 or not 0 < self.share <= self.apart:
            raise BadHeader(_BAD)
        self.steps: dict[int, int] = {}

    def frames(self) -> Iterator[list[int]]:
        """The values of each main frame that can be trusted: no frame was lost before the next complete one."""
        data, size = self.data, len(self.data)
        run: list[list[int]] = []  # a complete frame, and the differences after it
        intact = False  # no difference can be trusted before the first complete frame
        while self.numbers.at < size and not self.ended:
            begin, letter = self.numbers.at, data[self.numbers.at]
            self.numbers.at += 1
            try:
                values = self._values(letter)
            except IndexError:  # the end of the data, in the middle of a frame
                values = None
            whole = self.numbers.at == size or self.ended or _MARKER.match(data, self.numbers.at) is not None
            if values is None or self.numbers.at - begin > _LONGEST_FRAME or not whole:
                following = _MARKER.search(data, begin + 1)
                self.numbers.at = following.start() if following else size
                self.damaged += intact or not run
                intact = False
            elif letter == _I:
                self._complete(values, _I, values, values)
                last = self.last
                if intact and last is not None and values[self.iteration] != last[0] + self._step(last[0]):
                    self.damaged += 1  # a frame is missing between the last one and this one
                    del run[1:]
                yield from run
                intact = self._follows(values)
                run = [values] if intact else []
            elif letter == _P and intact:
                self._complete(values, _P, run[-1], run[max(len(run) - 2, 0)])
                intact = self._follows(values)
                self.damaged += not intact
                run += [values] * intact
        yield from run

    def _follows(self, values: list[int]) -> bool:
        """Whether a frame comes a moment after the last one; it is then the last one."""
        iteration, time = values[self.iteration], values[self.time]
        if self.last is not None:
            apart = (time - self.last[1]) % (1 << 32)
            if not (0 < apart < _FARTHEST and 0 < iteration - self.last[0] < _MOST_ITERATIONS):
                return False
        self.last = iteration, time
        return True

    def _complete(self, values: list[int], kind: int, before: list[int], earlier: list[int]) -> None:
        """Add the predictions from the two frames before, in place."""
        constants = self.constants
        for i, predictor in enumerate(self.predictors[kind]):
            if predictor in (_PREVIOUS, _INCREMENT):
                values[i] += before[i] + (self._step(before[i]) if predictor == _INCREMENT else 0)
            elif predictor == _AVERAGE:
                values[i] += int((before[i] + earlier[i]) / 2)
            elif predictor == _LINE:
                values[i] += 2 * before[i] - earlier[i]
            elif predictor:
                values[i] += values[self.motor0] if predictor == _MOTOR0 else constants.get(predictor, 0)

    def _step(self, iteration: int) -> int:
        """The iterations from a frame to the next one that the vehicle logs."""
        phase, step = iteration % self.interval, 1
        if phase not in self.steps:
            while ((phase + step) % self.interval + self.share - 1) % self.apart >= self.share:
                step += 1
            self.steps[phase] = step
        return self.steps[phase]

    def _values(self, letter: int) -> list[int] | None:
        """The encoded numbers of a frame; `None` for another letter. Raises `IndexError` at the end of the data."""
        values: list[int] = []
        if letter == _E:
            return values if self._event() else None
        if letter not in self.groups:
            return None
        for encoding, count in self.groups[letter]:
            self.numbers.read(encoding, count, values)
        return values

    def _event(self) -> bool:
        """Skip an event. Returns whether it is known."""
        event = self.numbers.byte()
        if event == _LOG_END:
            self.ended = self.data.startswith(_END, self.numbers.at)
            return self.ended
        if event == _ADJUSTMENT and self.numbers.byte() & 0x80:  # of a real number, else of a whole one
            self.numbers.at += 4
        else:
            self.numbers.unsigned(_EVENTS.get(event, 0), [])
        if event == _RESUME:
            self.last = None
        return event in _EVENTS
