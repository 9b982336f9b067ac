"""Column maps: which column or topic of a log holds which quantity, and its unit, sign and frame. See docs/logs.md."""

import functools
import math
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from .._files import check_plain, read_toml
from ..errors import listed, quoted
from ..flight import ANGLE_NAMES, SIGNALS, SPEED_NAMES
from ..rotations import euler_angles
from .table import LogPath, Table, refuse
from .values import COLUMNS, PWM, PWM_ZERO, ColumnLimits

ColumnsGiven = LogPath | Mapping[str, Any] | None
"""A column map as users give it: the path of a TOML file, the name of a preset, or the table in such a file."""

QUATERNION = ("qw", "qx", "qy", "qz")
_QUATERNION = ColumnLimits("of a quaternion", -math.inf, math.inf, "")
_COLUMNS = COLUMNS | dict.fromkeys(QUATERNION, _QUATERNION)
_VECTORS = [tuple(signal.columns) for signal in SIGNALS.values() if len(signal.columns) == 3]
_ALONG_YZ = [name for vector in _VECTORS for name in vector[1:]]
_TURNED = {"q", "r", "theta", "psi", "y", "z", "vy", "vz", "qy", "qz", *_ALONG_YZ}
"""The columns that have the opposite sign after half a turn about x."""
_REMEDY = "correct its unit or sign in the column map"


class ColumnSource(NamedTuple):
    """The source of a column: the first of `names` that a log holds. Its values: (value - `zero`) * `factor`."""

    names: tuple[str, ...]
    factor: float = 1.0
    zero: float = 0.0


class ColumnMap(NamedTuple):
    """A column map.

    - `name`: in messages.
    - `sources`: by column of the flight CSV, or `qw, qx, qy, qz`, the attitude from the body to the earth.
    - `needed`: the columns that a log must hold.
    - `recorded`: whether messages have the time at which they were recorded, instead of the time of their stamp.
    """

    name: str
    sources: dict[str, ColumnSource]
    needed: frozenset[str] = frozenset()
    recorded: bool = False

    def chosen(self, path: LogPath, find: Callable[[str], str | None], names: Sequence[str]) -> dict[str, str]:
        """By column, its place in a log.

        - `find`: takes a source; returns its name in the log, or `None` if it is not there.
        - `names`: all columns or topics of the log, for the `InputError` about a column that is needed.
        """
        found = {}
        for column, source in self.sources.items():
            place = next(filter(None, map(find, source.names)), None)
            if place is not None:
                found[column] = place
            elif column in self.needed:
                what = f"there is no {quoted(source.names[0])}, which {self.name} names for {column}"
                refuse(path, f"{what}. There are {listed(names)}: name one of them")
        return found

    def converted(self, column: str, values: np.ndarray) -> np.ndarray:
        """Values of a column in our unit and frame. The sign of a rotor speed is dropped."""
        source = self.sources[column]
        values = (values - source.zero) * source.factor
        if column in SPEED_NAMES:
            return np.abs(values)
        return np.clip(values, 0.0, 1.0) if source.zero else values


@functools.cache
def presets() -> dict[str, Any]:
    """The tables of the presets by name, read when they are first asked for."""
    return read_toml(Path(__file__).with_name("presets.toml"))


def column_map(given: ColumnsGiven) -> ColumnMap:
    """A checked column map; `None`: the columns of the flight CSV. Raises `InputError`, one line, or `OSError`."""
    if given is None:
        return ColumnMap("flight CSV", {name: ColumnSource((name,)) for name in _COLUMNS})
    if isinstance(given, Mapping):
        name, table = "columns", dict(given)
        check_plain(name, table, "correct it")
    else:
        name = os.fspath(given)
        try:
            table = dict(presets().get(name) or read_toml(given))
        except FileNotFoundError:
            refuse(name, f"neither a file nor a preset; give a TOML file or one of {', '.join(presets())}")
        if not table:
            refuse(name, "names no column; a column map has a table [columns]")
    columns = table.pop("columns", {})
    settings = {"preset": ("", *presets()), "frame": ("FLU", "FRD"), "time": ("stamp", "recorded")}
    preset, frame, time = chosen = [table.pop(key, values[0]) for key, values in settings.items()]
    for (key, values), value in zip(settings.items(), chosen, strict=True):
        if value not in values:
            refuse(name, f"{key} is {quoted(str(value))}; give one of {', '.join(filter(None, values))}")
    if table or not isinstance(columns, dict):
        wrong = quoted(str(next(iter(table), "columns")))
        refuse(name, f"{wrong} cannot be used; a column map has preset, frame, time, and a table [columns]")
    begin = column_map(preset or None)
    sources = begin.sources | {column: _source(name, column, value) for column, value in columns.items()}
    for column in _TURNED & (columns.keys() if preset else _TURNED) if frame == "FRD" else ():
        sources[column] = sources[column]._replace(factor=-sources[column].factor)
    needed = () if name in presets() else columns
    return ColumnMap(quoted(name), sources, frozenset(needed), time == "recorded")


def _source(name: str, column: str, value: Any) -> ColumnSource:
    """The source of one column, as it stands in the map. Raises `InputError`."""
    if column not in _COLUMNS:
        refuse(name, f"there is no column {quoted(str(column))}; the columns are {', '.join(_COLUMNS)}")
    entry = value if isinstance(value, dict) else {"source": value}
    names, unit, sign = entry.get("source", column), entry.get("unit"), entry.get("sign", 1)
    names = [names] if isinstance(names, str) else names
    if not isinstance(names, list) or not names or not all(isinstance(each, str) and each for each in names):
        refuse(name, 'has no source; give a name, as in p = "gyro x"', column=column)
    quantity, factor = _COLUMNS[column], 1.0 if unit is None else unit
    if isinstance(factor, str):
        factor = 1.0 if factor == quantity.unit else quantity.others.get(factor, math.nan)
    usable = isinstance(factor, int | float) and math.isfinite(factor) and factor != 0
    if not usable or sign not in (1, -1) or not entry.keys() <= {"source", "unit", "sign"}:
        units = ", ".join([quantity.unit, *quantity.others])
        refuse(
            name, f"may have a source, a unit ({units}, or a factor) and a sign (1 or -1); correct it", column=column
        )
    return ColumnSource(tuple(names), float(factor) * sign, PWM_ZERO if unit == PWM else 0.0)


def mapped_rows(table: Table, columns: ColumnMap) -> Table:
    """A table whose columns are named by its log, with our columns. Raises `InputError` if one is missing."""
    raw, names = table.columns, [*table.columns, *table.unknown]
    chosen = columns.chosen(table.path, lambda name: name if name in raw else None, names)
    found = {column: columns.converted(column, raw[place]) for column, place in chosen.items()}
    if found.keys() >= set(QUATERNION):
        angles = euler_angles(np.column_stack([found[name] for name in QUATERNION]))
        found |= {name: x for name, x in zip(ANGLE_NAMES, angles.T, strict=True) if name not in found}
        chosen |= dict.fromkeys(ANGLE_NAMES, chosen["qw"])
    found = {name: values for name, values in found.items() if name not in QUATERNION}
    unknown = tuple(name for name in names if name not in chosen.values())
    return table._replace(columns=found, names=chosen, unknown=unknown, remedy=_REMEDY)


def array_table(data: Any, columns: ColumnMap) -> Table:
    """The table of a mapping of arrays, DataFrame or Dataset; matrices have columns `name[i]`. Raises `InputError`."""
    names = getattr(data, "columns", None)
    if names is None and not hasattr(data, "keys"):
        refuse("data", f"is of type {type(data).__name__}; give the path of a log, or a mapping of arrays")
    names = [*data.keys(), *getattr(data, "coords", ())] if names is None else [*names]
    raw: dict[str, np.ndarray] = {}
    for name in dict.fromkeys(names):
        values = np.asarray(data[name])
        if values.dtype.kind == "M":
            values = (values - values.flat[0]) / np.timedelta64(1, "s") if values.size else np.empty(0)
        if values.shape[1:] == (1,):  # a matrix of one column
            values = values.ravel()
        if values.dtype.kind in "fiu" and values.ndim in (1, 2):
            every = np.atleast_2d(values.T).astype(float)
            raw |= {f"{name}[{i}]" if values.ndim == 2 else str(name): own for i, own in enumerate(every)}
    unread = tuple(str(name) for name in names if not any(key.partition("[")[0] == str(name) for key in raw))
    table = mapped_rows(Table("data", raw, unread, first_row=None), columns)
    sizes = {name: values.size for name, values in table.columns.items()}
    if len({*sizes.values()}) > 1 or min(sizes.values(), default=0) < 2:
        shown = ", ".join(f"{name} has {size}" for name, size in sizes.items())
        refuse(
            "data", f"needs two rows or more, and as many in each column ({shown or 'there are none'}); correct them"
        )
    for name, values in table.columns.items():
        if np.isinf(values).any():
            refuse("data", "holds an infinity; write NaN if it was not measured", column=name, kind="array")
    return table
