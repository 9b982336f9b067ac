"""Logs of messages: sensors with times of their own, brought to the rows of the gyro."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float

from .sampling import (
    REACH,
    RowPositions,
    Series,
    at_most,
    at_rows,
    in_order,
    logged_rate,
    median_step,
    root_mean_square,
    unwrap,
)
from .table import COMMAND_NAMES, MAX_ROWS, SPEED_NAMES, LogFacts, Path, Sampling, Table, refuse
from .values import dropped, without_impossible

RATES, ANGLES, FORCES = ("p", "q", "r"), ("phi", "theta", "psi"), ("ax", "ay", "az")
_FASTEST_ROWS = 0.001  # [s]; a faster gyro is averaged to this step, because no vehicle's motion needs more

Names = tuple[str, ...]
Fields = dict[str, np.ndarray]
Source = tuple[str, Sequence[str], float | Float[np.ndarray, " fields"]]
"""A kind of messages, the fields that hold some of our columns, and the factors to our units and frame."""


def motor_order(functions: Sequence[int], motors: Sequence[int]) -> list[int] | None:
    """The places of motors 1 to 4 among the outputs with these functions; `None` if one of them is missing."""
    return [functions.index(motor) for motor in motors] if {*motors} <= {*functions} else None


@dataclasses.dataclass(frozen=True)
class Messages:
    """The decoded messages of a log. Its methods add to `names` and `notes`.

    - `fields`: by kind of message and instance, the fields of its messages as arrays of one length. `t`: times [s].
    - `remedy`: what to do if the log is corrupt.
    - `notes`: what was assumed, one line each.
    - `names`: by our column, what the log calls it.
    - `parameters`: the settings of the autopilot.
    - `prefixed`: whether the name of a field begins with that of its kind and a dot.
    """

    path: Path
    fields: Mapping[str, Mapping[int, Fields]]
    remedy: str
    notes: list[str] = dataclasses.field(default_factory=list)
    names: dict[str, str] = dataclasses.field(default_factory=dict)
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    prefixed: bool = True

    def of(self, kind: str, instance: int | None = None) -> Fields:
        """The fields of a kind of message, of one instance (by default the first); none if it was not logged."""
        instances = self.fields.get(kind, {})
        return instances.get(min(instances, default=0) if instance is None else instance, {})

    def latest(self, kind: str, field: str) -> float | None:
        """The last value of a field, or None if it was not logged, or is damaged."""
        values = self.of(kind).get(field, np.empty(0))
        return float(values[-1]) if values.size and np.isfinite(values[-1]) else None

    def series(
        self, kind: str, fields: Sequence[str], instance: int | None = None, *, fewest: int = 2
    ) -> Series | None:
        """Samples of fields in order of time; `None` if there are fewer than `fewest`. Raises `InputError`."""
        raw = self.of(kind, instance)
        if not fields or not raw.keys() >= {"t", *fields}:
            return None
        kept = in_order(raw["t"])
        if kept is None:
            refuse(self.path, f"time runs backward in {kind}: {self.remedy}")
        if np.count_nonzero(kept) < fewest:
            return None
        late = f"{kind}: {np.count_nonzero(~kept)} late messages are ignored"
        if not kept.all() and late not in self.notes:
            self.notes.append(late)
        with np.errstate(all="ignore"):  # a damaged float need not be finite
            values = np.column_stack([raw[name].astype(float)[kept] for name in fields])
        return Series(raw["t"][kept], np.where(np.isfinite(values), values, np.nan))

    def fastest(self, columns: Sequence[str], sources: Iterable[Source], *, faster: float = 1.1) -> Series | None:
        """The source that was logged most often in our units and frame; a later one must be `faster` by this factor."""
        best, found = 0.0, None
        for kind, fields, factor in sources:
            for instance in self.fields.get(kind, ()):
                series = self.series(kind, fields, instance)
                if series is None or not np.isfinite(series.values).any():
                    continue
                if found is None or logged_rate(series.t) > faster * best:
                    best, found = logged_rate(series.t), Series(series.t, series.values * factor)
                    self.name(columns, kind, fields)
        return found

    def speeds_at(self, t: RowPositions, series: Series, source: str) -> RowPositions:
        """The speeds of one rotor, interpolated at other times without the zeros of its telemetry."""
        values = series.values[:, 0]
        zeros = dropped(series.t, values)
        if zeros.any():
            count = np.count_nonzero(zeros)
            self.notes.append(f"impossible values count as not measured, in {source}: {count} (0 while it turns)")
        known = np.isfinite(values) & ~zeros
        return np.interp(t, series.t[known], values[known])

    def name(self, columns: Sequence[str], kind: str, fields: Sequence[str]) -> None:
        """Note which fields hold these columns."""
        begin = f"{kind}." if self.prefixed else ""
        self.names.update((column, begin + field) for column, field in zip(columns, fields, strict=True))

    def note_commands(self) -> None:
        """Note that commands are taken as they are."""
        self.notes.append(f"commands are {self.names['command1']}.., taken as fractions of full-scale rotor speed")

    def table(
        self, rates: Series, rotors: Series, others: Mapping[Names, Series | None], **facts: Any
    ) -> tuple[RowPositions, Table]:
        """Rows at the times of the gyro, at most 1 kHz, with rotors and `others` brought to them.

        Series are in our units and frame. Impossible samples are taken out before. Rotor speeds are measured if
        `omega1` has a name, else commands [0..1]. `others`: by the names of their columns; `None`: not logged. `facts`:
        more of `LogFacts`.

        **Returns:** the times of the rows [s], and the table; `t` is 0 in the first row.

        **Raises:** `InputError` if rates and rotors do not overlap, for too many rows or impossible samples.
        """
        measured = "omega1" in self.names
        rotor_names = SPEED_NAMES if measured else COMMAND_NAMES
        sources = {name: self.names[name] for name in (rotor_names[0], "p")}
        motors, gyro = (each.partition(".")[0] if self.prefixed else each for each in sources.values())
        written = Sampling(motors, logged_rate(rotors.t)), Sampling(gyro, logged_rate(rates.t))
        about = LogFacts(*written, **facts)
        table = Table(self.path, {}, first_row=None, names=self.names, remedy=self.remedy, facts=about)
        start = rates.t[min(np.count_nonzero(rates.t < rotors.t[0]), rates.t.size - 1)]

        def possible(names: Names, series: Series) -> Series:
            nonlocal table
            columns = {"t": series.t - start} | dict(zip(names, series.values.T, strict=True))
            table = without_impossible(table._replace(columns=columns))
            return Series(series.t, np.column_stack([table.columns[name] for name in names]))

        rates, rotors = at_most(possible(RATES, rates), _FASTEST_ROWS), possible(rotor_names, rotors)
        turning = np.isfinite(rotors.values).all(axis=1)
        rotors = Series(rotors.t[turning], rotors.values[turning])
        inside = (rates.t >= rotors.t[0]) & (rates.t <= rotors.t[-1] + REACH * median_step(rotors.t))
        if np.count_nonzero(inside) < 2:
            refuse(self.path, "rates and motors were not logged at the same time; record both in one flight")
        rows = rates.t[inside]
        if rows.size > MAX_ROWS:
            refuse(self.path, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
        columns = {"t": rows - rows[0]} | dict(zip(RATES, rates.values[inside].T, strict=True))
        columns |= zip(rotor_names, root_mean_square(rotors, linear=measured)(rows).T, strict=True)
        for names, series in others.items():
            if series is None:
                continue
            if names == ANGLES:
                phi, theta, psi = series.values.T
                series = Series(series.t, np.column_stack([unwrap(phi)[0], theta, unwrap(psi)[0]]))
            columns |= zip(names, at_rows(rows, possible(names, series)).T, strict=True)
        return rows, table._replace(columns=columns, held=True)
