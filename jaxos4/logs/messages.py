"""Logs of messages: sensors that were logged at different times, brought to the rows of the gyro."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from ..flight import ANGLE_NAMES, COMMAND_NAMES, RATE_NAMES, SPEED_NAMES
from .sampling import (
    REACH,
    Rows,
    Series,
    at_most,
    at_rows,
    in_order,
    logged_rate,
    median_step,
    root_mean_square,
    unwrap,
)
from .table import MAX_ROWS, LogFacts, LogPath, Sampling, Table, order_note, refuse
from .values import dropped, without_impossible

_FASTEST_ROWS = 0.001  # [s]; a faster gyro is averaged to this step, because no vehicle's motion needs more
_FASTER = 1.1  # times the rate of another source; a smaller difference does not count

Names = tuple[str, ...]
Fields = dict[str, np.ndarray]
MessageSource = tuple[str, Sequence[str], float | Float[np.ndarray, " fields"]]
"""A kind of messages, the fields that hold some of our columns, and the factors to our units and frame."""


class Rotors(NamedTuple):
    """Speeds [rad/s] or commands [0..1] of four rotors, and their names in the log.

    - `is_measured`: whether they are speeds. `note`: what was assumed of commands.
    """

    series: Series
    names: Sequence[str]
    is_measured: bool
    note: str = ""

    @classmethod
    def of(cls, series: Series, names: Sequence[str], *, is_measured: bool) -> "Rotors | None":
        """Samples in which all rotors have a value; `None` if there are not two, or if a measured rotor never turns."""
        whole = np.isfinite(series.values).all(axis=1)
        values = series.values[whole]
        if len(values) < 2 or (is_measured and not (values > 0).any(axis=0).all()):
            return None
        return cls(Series(series.t[whole], values), names, is_measured)


def motor_order(functions: Sequence[int], motors: Sequence[int]) -> list[int] | None:
    """The places of motors 1 to 4 among the outputs with these functions; `None` if one of them is missing."""
    return [functions.index(motor) for motor in motors] if {*motors} <= {*functions} else None


def records(content: bytes, places: Sequence[int], layout: np.dtype) -> np.ndarray:
    """The records of this layout that begin at these bytes."""
    begin = np.asarray(places, dtype=np.int64)[:, None]
    return np.frombuffer(content, np.uint8)[begin + np.arange(layout.itemsize)].reshape(-1).view(layout)


@dataclasses.dataclass(frozen=True)
class Messages:
    """The decoded messages of a log. Its methods add to `names` and `notes`.

    - `fields`: by kind of message and instance, the fields of its messages as arrays of one length. `t`: times [s].
    - `remedy`: what to do if the log is corrupt.
    - `notes`: the assumptions of the reader, one line each.
    - `names`: by our column, its name in the log.
    - `parameters`: the settings of the autopilot.
    - `prefixed`: whether the name of a field begins with the name of its kind and a dot.
    """

    path: LogPath
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

    def fastest(self, columns: Sequence[str], sources: Iterable[MessageSource]) -> Series | None:
        """The source that was logged most often, in our units and frame. The first of those with nearly equal rates."""
        best, found = 0.0, None
        for kind, fields, factor in sources:
            for instance in self.fields.get(kind, ()):
                series = self.series(kind, fields, instance)
                if series is None or not np.isfinite(series.values).any():
                    continue
                if found is None or logged_rate(series.t) > _FASTER * best:
                    best, found = logged_rate(series.t), Series(series.t, series.values * factor)
                    self.name(columns, kind, fields)
        return found

    def speeds_at(self, t: Rows, series: Series, source: str) -> Rows:
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

    def table(
        self,
        found: Mapping[Names, Series | None],
        rotors: Rotors | None,
        *,
        remedies: tuple[str, str],
        is_ordered: bool = False,
        landed: Iterable[tuple[float, float]] = (),
        **facts: Any,
    ) -> tuple[Table, tuple[str, ...]]:
        """Rows at the times of the gyro, at most 1 kHz, with rotors and other columns brought to them; and all notes.

        Series are in our units and frame. Impossible samples are taken out before.

        - `found`: by the names of their columns, body rates among them; `None`: not logged.
        - `remedies`: if the log has no body rates, and if it has no rotors.
        - `is_ordered`: whether the log says which rotor is which.
        - `landed`: from when to when the vehicle was on the ground [s], in the log's time.
        - `facts`: more of `LogFacts`.

        **Raises:** `InputError` if rates or rotors are missing or do not overlap, for too many rows or impossible
        samples.
        """
        rates = found.get(RATE_NAMES)
        if rates is None:
            refuse(self.path, f"holds no body rates; {remedies[0]}")
        if rotors is None:
            refuse(self.path, f"holds no rotor speeds or commands; {remedies[1]}")
        self.names.update(zip(SPEED_NAMES if rotors.is_measured else COMMAND_NAMES, rotors.names, strict=True))
        motors, gyro = (
            Sampling(name.partition(".")[0] if self.prefixed else name, logged_rate(series.t))
            for name, series in ((rotors.names[0], rotors.series), (self.names["p"], rates))
        )
        others = {names: each for names, each in found.items() if names != RATE_NAMES}
        rows, table = self._at_rows_of(rates, rotors, others)
        first, last = float(rows[0]), float(rows[-1])
        inside = [(max(begin, first) - first, min(end, last) - first) for begin, end in landed]
        about = LogFacts(motors, gyro, landed=tuple(each for each in inside if each[0] <= each[1]), **facts)
        if not rotors.is_measured:
            plain = f"commands are {rotors.names[0]}.., taken as fractions of full-scale rotor speed"
            self.notes.append(rotors.note or plain)
        if is_ordered:
            self.notes.append(order_note(rotors.names[0]))
        return table._replace(held=True, facts=about), tuple(self.notes)

    def _at_rows_of(self, rates: Series, rotors: Rotors, others: Mapping[Names, Series | None]) -> tuple[Rows, Table]:
        """The times of the gyro while the motors were logged [s], and all columns brought to them."""
        table = Table(self.path, {}, first_row=None, names=self.names, remedy=self.remedy)
        speeds, rotor_names = rotors.series, SPEED_NAMES if rotors.is_measured else COMMAND_NAMES
        start = rates.t[min(np.count_nonzero(rates.t < speeds.t[0]), rates.t.size - 1)]

        def possible(names: Names, series: Series) -> Series:
            nonlocal table
            columns = {"t": series.t - start} | dict(zip(names, series.values.T, strict=True))
            table = without_impossible(table._replace(columns=columns))
            return Series(series.t, np.column_stack([table.columns[name] for name in names]))

        rates, speeds = at_most(possible(RATE_NAMES, rates), _FASTEST_ROWS), possible(rotor_names, speeds)
        turning = np.isfinite(speeds.values).all(axis=1)
        speeds = Series(speeds.t[turning], speeds.values[turning])
        inside = (rates.t >= speeds.t[0]) & (rates.t <= speeds.t[-1] + REACH * median_step(speeds.t))
        if np.count_nonzero(inside) < 2:
            refuse(self.path, "rates and motors were not logged at the same time; record both in one flight")
        rows = rates.t[inside]
        if rows.size > MAX_ROWS:
            refuse(self.path, f"has more than {MAX_ROWS:,} samples of the gyro; cut the log into flights")
        columns = {"t": rows - rows[0]} | dict(zip(RATE_NAMES, rates.values[inside].T, strict=True))
        columns |= zip(rotor_names, root_mean_square(speeds, linear=rotors.is_measured)(rows).T, strict=True)
        for names, series in others.items():
            if series is None:
                continue
            if names == ANGLE_NAMES:
                phi, theta, psi = series.values.T
                series = Series(series.t, np.column_stack([unwrap(phi)[0], theta, unwrap(psi)[0]]))
            columns |= zip(names, at_rows(rows, possible(names, series)).T, strict=True)
        return rows, table._replace(columns=columns)
