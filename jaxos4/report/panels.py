"""Figures as data: panels of lines, bands and words, and their look, which `svg.py` and `matplotlib_figures.py` draw.

Colours are for colour-blind readers; each series has a mark and dashes too.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float, Num

INK = "#1b1e23"
GRID = "#d9dce1"
PAPER = "#ffffff"
FAINT = "#8a9099"

# A dash pattern: its offset, then lengths of ink and gap, in line widths.
Dash = tuple[float, tuple[float, ...]]
_SOLID: Dash = (0, ())
_DASHED: Dash = (0, (4, 1.6))
_DOTTED: Dash = (0, (1, 1.65))


class Style(NamedTuple):
    """The style of one series."""

    color: str
    marker: str
    dash: Dash


# Nine estimators and the ant colony, each with a colour, a mark and dashes of its own. The first colours are of Okabe
# and Ito (2008). For readers with normal vision, without red cones and without green cones, the colours are at least
# 17 apart in CIELAB; the contrast is at least 3:1 on white and on dark paper.
_STYLES = {
    "ibss": Style("#0072b2", "o", _SOLID),
    "network": Style("#d55e00", "s", _DASHED),
    "hybrid": Style("#009e73", "D", (0, (6.4, 1.6, 1, 1.6))),
    "output-error": Style("#fc486c", "^", _DOTTED),
    "filter-error": Style("#5448fc", "v", (0, (9, 2))),
    "equation-error": Style("#54783c", "P", (0, (3, 1, 1, 1, 1, 1))),
    "rls": Style("#549cc0", "X", (0, (2, 1))),
    "svsf": Style("#846084", "*", (0, (1, 2.2))),
    "kalman": Style("#d80030", "<", (0, (10, 2, 2, 2))),
    "ant-colony": Style("#4884fc", "p", (0, (5, 1, 2, 1))),
}
BOUND_DASHES = (_SOLID, _DOTTED, _DASHED)


def styles(estimators: Sequence[str]) -> dict[str, Style]:
    """A style for each estimator: its own, or an unused one if the table does not have the estimator."""
    known = list(_STYLES)
    free = (place for place in itertools.count() if place >= len(known) or known[place] not in estimators)
    return {name: _STYLES[name] if name in _STYLES else style(next(free)) for name in estimators}


def style(place: int) -> Style:
    """Style number `place`. Beyond the table, a colour comes with the marker and dashes of another row."""
    table, count = list(_STYLES.values()), len(_STYLES)
    return table[(place + place // count) % count]._replace(color=table[place % count].color)


_LINEAR = 2.0  # a "symlog" scale is linear from -2 to 2
EVERYWHERE = (-math.inf, math.inf)  # from one end of an axis to the other
_LEAST = 1e-290  # smaller numbers are 0 in a figure
Values = Sequence[float] | Num[np.ndarray, " _points"]


class Line(NamedTuple):
    """A line through points, broken where a value is NaN; or marks at the points, if its `width` is 0.

    An infinite value is at the end of the axis. `name`: in the legend. `group`: the number of the estimator of which
    the line is. `tip`: a tooltip; of a group, by default its name. `width`, `size` of marks: in pixels.
    """

    x: Values
    y: Values
    color: str = INK
    width: float = 1.8
    dash: Dash = (0, ())
    marker: str = ""
    size: float = 7.0
    hollow: bool = False
    name: str = ""
    group: int | None = None
    tip: str = ""


class Band(NamedTuple):
    """The area between two curves, broken where one is NaN."""

    x: Values
    low: Values
    high: Values
    color: str = FAINT
    opacity: float = 0.3
    name: str = ""


class Words(NamedTuple):
    """A text beside a point."""

    x: float
    y: float
    text: str
    anchor: Literal["start", "middle", "end"] = "start"


Mark = Line | Band | Words


class Scale(NamedTuple):
    """An axis. `ends`: by default those of the values. `ticks`: places and labels, by default round numbers.

    `lines`: whether there is a line at each tick.
    """

    kind: Literal["linear", "log", "symlog"] = "linear"
    ends: tuple[float, float] | None = None
    ticks: Mapping[float, str] | None = None
    label: str = ""
    lines: bool = True

    def along(self, values: Any) -> np.ndarray:
        """Values in a unit in which the axis is linear; NaN for those that a logarithmic axis cannot show."""
        values = np.asarray(values, dtype=float)
        if self.kind == "log":
            return np.asarray(np.log10(np.where(values > _LEAST, values, np.nan)))
        if self.kind == "linear":
            return values
        far = np.sign(values) * (1 + np.log10(np.maximum(np.abs(values), _LINEAR) / _LINEAR))
        return np.where(np.abs(values) > _LINEAR, far, values / _LINEAR)

    def inside(self, values: Any) -> np.ndarray:
        """Values, of which infinite ones are at an end of the axis."""
        ends = self.ends or (0.0, 1.0)
        return np.where(np.isinf(values), np.clip(values, min(ends), max(ends)), values)

    def place(self, values: Any) -> np.ndarray:
        """Values as shares of the axis, which has ends."""
        low, high = self.along(self.ends or (0.0, 1.0))
        return np.asarray((self.along(self.inside(values)) - low) / (high - low))

    def around(self, values: Float[np.ndarray, " values"]) -> "Scale":
        """The axis with ends that leave room around all values, if it has none yet."""
        known = self.along(values[np.isfinite(values)])
        known = known[np.isfinite(known)]
        if self.ends is not None or not known.size:
            return self._replace(ends=self.ends or ((1.0, 10.0) if self.kind == "log" else (0.0, 1.0)))
        low, high = float(known.min()), float(known.max())
        size = max(abs(low), abs(high))
        alone = 0.1 if self.kind == "log" else 0.1 * size if size > _LEAST else 1.0
        room = 0.05 * (high - low) if high - low > 1e-9 * size + _LEAST else alone
        low, high = low - room, high + room
        return self._replace(ends=(10**low, 10**high) if self.kind == "log" else (low, high))

    def labelled(self, least: int = 3) -> tuple[dict[float, str], int]:
        """The ticks in sight with their labels, and the power of ten by which labels are multiplied.

        `least`: there are as many on a linear axis.
        """
        low, high = sorted(self.ends or (0.0, 1.0))
        if self.ticks is not None:
            return {at: text for at, text in self.ticks.items() if low <= at <= high}, 0
        if self.kind == "log" and high / low >= 5:
            powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
            digits = (1, 2, 5) if high / low < 100 else (1,)
            few = [each for each in powers if each % -(-len(powers) // 8) == 0]
            ticks = (digit * 10.0**power for power in few for digit in digits)
            return {at: f"{at:g}".replace("e-0", "e-") for at in ticks if low <= at <= high}, 0
        ticks = round_numbers(low, high, least)
        power = math.floor(math.log10(max(map(abs, ticks), default=1.0) or 1.0))
        power = power if power < -3 or power > 4 else 0
        steps = max(map(abs, ticks), default=1.0) / (ticks[1] - ticks[0]) if len(ticks) > 1 else 1.0
        digits = max(6, math.ceil(math.log10(max(steps, 1.0))) + 1)  # so that no two labels are alike
        return {at: f"{at / 10.0**power:.{digits}g}" for at in ticks}, power


def round_numbers(low: float, high: float, least: int) -> list[float]:
    """The numbers from `low` to `high` that are multiples of 1, 2 or 5 times a power of ten, `least` or more."""
    power = 10.0 ** math.ceil(math.log10(max(high - low, 1e-300)))
    for step in (power, power / 2, power / 5, power / 10, power / 20, power / 50):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if last - first + 1 >= least:
            break
    return [step * k for k in range(first, last + 1)]


class Panel(NamedTuple):
    """Marks on a pair of axes.

    `subtitle`: below the title. `width`, `height`: [px]. `equal`: a unit is as long on both axes. `bare`: no axes.
    """

    title: str
    marks: Sequence[Mark]
    x: Scale = Scale()
    y: Scale = Scale()
    width: float = 290.0
    height: float = 185.0
    subtitle: str = ""
    equal: bool = False
    bare: bool = False

    def fitted(self) -> "Panel":
        """The panel with ends of its axes that leave room around all marks."""
        x = [mark.x for mark in self.marks]
        y = [each for m in self.marks for each in ((m.low, m.high) if isinstance(m, Band) else (m.y,))]
        x, y = (np.concatenate([np.ravel(each).astype(float) for each in every] or [np.zeros(0)]) for every in (x, y))
        return self._replace(x=self.x.around(x), y=self.y.around(y))


class Figure(NamedTuple):
    """Panels side by side, as many `columns` as there is room for. `stem`: of the names of its file and its ids."""

    stem: str
    panels: Sequence[Panel]
    columns: int = 3

    def legend(self) -> dict[str, Line | Band]:
        """The first mark of each name."""
        found: dict[str, Line | Band] = {}
        for panel in self.panels:
            for mark in panel.marks:
                if not isinstance(mark, Words) and mark.name:
                    found.setdefault(mark.name, mark)
        return found


def spread(x: Values, low: Values, high: Values, **look: Any) -> Line:
    """Bars from `low` to `high` at each x, as one line."""
    return Line(np.repeat(np.asarray(x, float), 3), _ends(low, high), **look)


def across(y: Values, low: Values, high: Values, **look: Any) -> Line:
    """Bars from `low` to `high` at each y, as one line."""
    return Line(_ends(low, high), np.repeat(np.asarray(y, float), 3), **look)


def _ends(low: Values, high: Values) -> Float[np.ndarray, " ends"]:
    return np.stack([low, high, np.full(len(low), np.nan)], axis=1).ravel()
