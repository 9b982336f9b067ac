"""The frames of a blackbox session: numbers of few bits, most of them as differences from a prediction.

A frame begins with a letter: "I" (complete), "P" (differences from the frames before), "S", "G", "H" (slow values, GPS,
home) or "E" (an event). The header gives the fields of each kind with their encodings and predictors. If a frame is
damaged, all differences after it are wrong up to the next complete frame: they are left out.

Reference: the description of the format by Nicholas Sherlock ("Blackbox internals", Cleanflight), and the sources of
Betaflight and INAV for the encodings that came later.
"""

import re
from collections.abc import Collection, Iterator
from operator import itemgetter
from typing import NamedTuple

import numpy as np

from .blackbox_numbers import TAG8_4, TOGETHER, Numbers

_TIME, _ITERATION = "time", "loopIteration"
_MARKER = re.compile(rb"[IPSGHE]")
_LONGEST_FRAME = 1024  # bytes
_MOST_FIELDS = 512
_FARTHEST, _MOST_ITERATIONS = 10_000_000, 5000  # [us], from one frame to the next: more is damage
_AT_ONCE = 4096  # rows
_END = b"End of log"

(_PREVIOUS, _LINE, _AVERAGE, _MINTHROTTLE, _MOTOR0, _INCREMENT) = range(1, 7)
(_1500, _VBATREF, _MINMOTOR) = (8, 9, 11)


class BadHeader(Exception):
    """A header that does not describe frames which can be decoded; the text says why."""


class Decoded(NamedTuple):
    """The complete frames of a session.

    - `columns`: by the names of the log; `time` [us] increases, from 0.
    - `damaged`: the number of places where frames are damaged.
    - `ended`: whether the session has an end.
    """

    columns: dict[str, np.ndarray]
    damaged: int
    ended: bool


class _Kind(NamedTuple):
    """The fields of one kind of frame: `groups` are (encoding, number of fields)."""

    names: list[str]
    groups: list[tuple[int, int]]
    predictors: list[int]


def decode_frames(settings: dict[str, str], data: bytes, wanted: Collection[str]) -> Decoded:
    """Decode the columns `wanted`, as far as there are, from the bytes after the header. Raises `BadHeader`."""
    kinds = {letter: kind for letter in "IPSGH" if (kind := _kind(settings, letter)) is not None}
    if not {_TIME, _ITERATION} <= set(kinds["I"].names if "I" in kinds else ()):
        raise BadHeader("its header does not describe the frames")
    names = kinds["I"].names
    if "P" in kinds and len(kinds["P"].predictors) != len(names):
        raise BadHeader("its header is damaged")
    places = [i for i, name in enumerate(names) if name in wanted]
    stream = _Stream(data, kinds, _Predictor(settings, names))
    pick = itemgetter(names.index(_TIME), *places)
    times, blocks, block = [], [], []

    def store() -> None:
        rows = np.array(block, dtype=float).reshape(len(block), 1 + len(places))
        times.append(rows[:, 0])
        blocks.append(rows[:, 1:].astype(np.float32))
        block.clear()

    for values in stream.frames():
        block.append(pick(values) if places else (pick(values),))
        if len(block) == _AT_ONCE:
            store()
    store()
    table = np.concatenate(blocks)
    columns = {names[place]: table[:, i].astype(float) for i, place in enumerate(places)}
    columns[_TIME] = _unwrapped(np.concatenate(times))
    return Decoded(columns, stream.damaged, stream.ended)


def _unwrapped(time: np.ndarray) -> np.ndarray:
    """Time [us] from 0; the vehicle counts it in 32 bits, so it wraps after 72 minutes."""
    return np.concatenate([np.zeros(min(time.size, 1)), np.cumsum(np.diff(time) % 2.0**32)])


def _kind(settings: dict[str, str], letter: str) -> _Kind | None:
    encodings, predictors = (_numbers(settings, f"Field {letter} {what}") for what in ("encoding", "predictor"))
    if not encodings:
        return None
    names = [name.strip() for name in settings.get(f"Field {letter} name", "").split(",")]
    if len(encodings) > _MOST_FIELDS or len(predictors) != len(encodings):
        raise BadHeader("its header is damaged")
    if letter != "P" and len(names) != len(encodings):
        raise BadHeader("its header is damaged")
    groups: list[tuple[int, int]] = []
    for encoding in encodings:
        if encoding not in TOGETHER:
            raise BadHeader(f"its frames have an encoding that is not known, {encoding}")
        if groups and groups[-1][0] == encoding and groups[-1][1] < TOGETHER[encoding]:
            groups[-1] = (encoding, groups[-1][1] + 1)
        else:
            groups.append((encoding, 1))
    if TAG8_4 in encodings and settings.get("Data version", "2") != "2":
        raise BadHeader("its frames are of version 1")
    return _Kind(names, groups, predictors)


def _numbers(settings: dict[str, str], name: str) -> list[int]:
    text = settings.get(name, "")
    return [int(cell) for cell in text.split(",")] if re.fullmatch(r"\d{1,3}(,\d{1,3})*", text) else []


def _whole(settings: dict[str, str], name: str) -> int:
    """The first number of a setting, or 0."""
    match = re.match(r"\d{1,9}", settings.get(name, ""))
    return int(match[0]) if match else 0


class _Predictor:
    """Adds predictions to the values of main frames."""

    def __init__(self, settings: dict[str, str], names: list[str]):
        self.motor0 = names.index("motor[0]") if "motor[0]" in names else 0
        self.constants = {
            _MINTHROTTLE: _whole(settings, "minthrottle"),
            _1500: 1500,
            _VBATREF: _whole(settings, "vbatref"),
            _MINMOTOR: _whole(settings, "motorOutput"),
        }
        first, _, last = settings.get("P interval", "").partition("/")
        apart = _whole({"": last or first}, "") or 1
        self.interval, self.share, self.apart = _whole(settings, "I interval") or 1, _whole({"": first}, "") or 1, apart
        if not last:
            self.share = 1
        if self.interval > 1 << 16 or not 0 < self.share <= self.apart:
            raise BadHeader("its header is damaged")
        self.steps: dict[int, int] = {}

    def step(self, iteration: int) -> int:
        """The iterations from a frame to the next one that the vehicle logs."""
        phase = iteration % self.interval
        if phase not in self.steps:
            step = 1
            while ((phase + step) % self.interval + self.share - 1) % self.apart >= self.share:
                step += 1
            self.steps[phase] = step
        return self.steps[phase]

    def complete(self, values: list[int], kind: _Kind, before: list[int], earlier: list[int]) -> None:
        """Add the predictions from the two frames before, in place."""
        constants = self.constants
        for i, predictor in enumerate(kind.predictors):
            if predictor == _PREVIOUS:
                values[i] += before[i]
            elif predictor == _AVERAGE:
                total = before[i] + earlier[i]
                values[i] += total // 2 if total >= 0 else -(-total // 2)
            elif predictor == _LINE:
                values[i] += 2 * before[i] - earlier[i]
            elif predictor == _MOTOR0:
                values[i] += values[self.motor0]
            elif predictor == _INCREMENT:
                values[i] += before[i] + self.step(before[i])
            elif predictor in constants:
                values[i] += constants[predictor]


class _Stream:
    """The frames of a session in order."""

    def __init__(self, data: bytes, kinds: dict[str, _Kind], predictor: _Predictor):
        self.data, self.kinds, self.predictor = data, {ord(letter): kind for letter, kind in kinds.items()}, predictor
        self.numbers = Numbers(data)
        self.damaged, self.ended = 0, False
        self.time, self.iteration = kinds["I"].names.index(_TIME), kinds["I"].names.index(_ITERATION)
        self.last: tuple[int, int] | None = None  # iteration and time of the last frame

    def frames(self) -> Iterator[list[int]]:
        """The values of each main frame that can be trusted.

        Frames are trusted when the next complete one follows the last of them: else one was lost among them.
        """
        data, size = self.data, len(self.data)
        block: list[list[int]] = []  # a complete frame, and the differences after it
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
                self.damaged += intact or not block
                intact = False
            elif letter == _I:
                self.predictor.complete(values, self.kinds[_I], values, values)
                follows = self._follows(values)
                if intact and self.last is not None and not self._is_next(values):
                    self.damaged += 1
                    del block[1:]
                yield from block
                block = [values] if follows else []
                intact = follows
                self.last = self._moment(values) if follows else self.last
            elif letter == _P and intact:
                self.predictor.complete(values, self.kinds[_P], block[-1], block[max(len(block) - 2, 0)])
                intact = self._follows(values)
                self.damaged += not intact
                if intact:
                    block.append(values)
                    self.last = self._moment(values)
        yield from block

    def _moment(self, values: list[int]) -> tuple[int, int]:
        return values[self.iteration], values[self.time]

    def _is_next(self, values: list[int]) -> bool:
        """Whether no frame is missing between the last one and this one."""
        return self.last is not None and values[self.iteration] == self.last[0] + self.predictor.step(self.last[0])

    def _follows(self, values: list[int]) -> bool:
        """Whether a frame comes a moment after the last one."""
        if self.last is None:
            return True
        iteration, time = self._moment(values)
        later = 0 < (time - self.last[1]) % (1 << 32) < _FARTHEST
        return later and 0 < iteration - self.last[0] < _MOST_ITERATIONS

    def _values(self, letter: int) -> list[int] | None:
        """The encoded numbers of a frame; `None` if it is none. Raises `IndexError` at the end of the data."""
        if letter == _E:
            return self._event()
        kind = self.kinds.get(letter)
        if kind is None:
            return None
        values: list[int] = []
        for encoding, count in kind.groups:
            self.numbers.read(encoding, count, values)
        return values

    def _event(self) -> list[int] | None:
        """Skip an event; `None` if it is not known."""
        event, values = self.numbers.byte(), []
        if event == 255:
            self.ended = self.data.startswith(_END, self.numbers.at)
            return [] if self.ended else None
        if event == 13:  # an adjustment, of a whole number or of a real one
            if self.numbers.byte() & 0x80:
                self.numbers.at += 4
            else:
                self.numbers.unsigned(1, values)
        elif event in _EVENTS:
            self.numbers.unsigned(_EVENTS[event], values)
        else:
            return None
        if event == 14:  # logging goes on after a pause
            self.last = None
        return values


_I, _P, _E = b"IPE"
_EVENTS = {0: 1, 14: 2, 15: 1, 30: 2, 40: 1}  # event: how many numbers it has
