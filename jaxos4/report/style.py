"""Colours for colour-blind readers, marks and dashes: the look of a series on pages and in figures."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

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
