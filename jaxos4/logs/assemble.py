"""A `Recording`, which holds the samples of one flight as NumPy arrays, and how a log's columns become one."""

import os
import re
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from ..airframe import Airframe
from ..flight import CHANNEL_NAMES, FORCE_NAMES, STATE_NAMES, Flight
from .sampling import UNIFORM, grid_size, held_regularly, logged_rate, resample, uniform_grid, unwrap
from .table import MAX_ROWS, LogFacts, Sampling, Table, quoted
from .units import check_time, check_units, force_note, thrust_note

SPEED_NAMES = ("omega1", "omega2", "omega3", "omega4")
COMMAND_NAMES = ("command1", "command2", "command3", "command4")
COLUMN_NAMES = ("t", *SPEED_NAMES, *COMMAND_NAMES, *CHANNEL_NAMES, "voltage")

_OTHER_NAMES = {  # names that other loggers use, for the question "should 'time' be t?"
    **dict.fromkeys(("time", "timestamp", "times"), "t"),
    **{"roll": "phi", "pitch": "theta", "yaw": "psi"},
    **{"gyrox": "p", "gyroy": "q", "gyroz": "r", "accx": "ax", "accy": "ay", "accz": "az"},
    **dict.fromkeys(("vbat", "vbatt", "batteryvoltage"), "voltage"),
}
_MOST_SAMPLES = 10_000  # plus ten for each row: a log that consists mostly of gaps is more than one flight
_STILL = 100  # samples of an accelerometer that never change: it is off
_NO_FACTS = LogFacts()
_REPEATED = 0.9  # values that change at less than this share of the rate of their rows were repeated


class Recording(NamedTuple):
    """A recorded flight as NumPy arrays in double precision, its name, and what its log says beside it.

    `time`, `omega`, `states`, `specific_force`, `voltage`, `body_velocity`, `stretch` and `commanded` are as in
    `Flight`, in SI units. A recording is cleaned, cut and joined as it is, and becomes a `Flight` once, at the end.

    - `name`: in messages and in the provenance. Usually the path of the file.
    - `notes`: what the reader changed in the data, one line each.
    - `facts`: what the log says beside the flight, such as how often motors and gyro were written.
    """

    time: Float[np.ndarray, " samples"]
    omega: Float[np.ndarray, "samples 4"]
    states: Float[np.ndarray, "samples 12"]
    specific_force: Float[np.ndarray, "samples 3"] | None = None
    voltage: Float[np.ndarray, " samples"] | None = None
    body_velocity: Float[np.ndarray, "samples 3"] | None = None
    stretch: Int[np.ndarray, " samples"] | None = None
    commanded: bool = False
    name: str = "flight"
    notes: tuple[str, ...] = ()
    facts: LogFacts = _NO_FACTS

    @classmethod
    def of(
        cls, flight: Flight, name: str = "flight", notes: tuple[str, ...] = (), facts: LogFacts = _NO_FACTS
    ) -> "Recording":
        """A recording of a `Flight`."""
        time, omega, states = (np.asarray(each, dtype=float) for each in (flight.time, flight.omega, flight.states))
        optional = {field: np.asarray(value) for field in _OPTIONAL if (value := getattr(flight, field)) is not None}
        optional = {field: value.astype(int if field == "stretch" else float) for field, value in optional.items()}
        return cls(time, omega, states)._replace(
            **optional, commanded=flight.commanded, name=name, notes=notes, facts=facts
        )

    @property
    def flight(self) -> Flight:
        """The `Flight`, in the precision of JAX."""
        stretch = None if self.stretch is None else jnp.asarray(self.stretch)
        return Flight(
            self.time,
            self.omega,
            self.states,
            self.specific_force,
            body_velocity=self.body_velocity,
            stretch=stretch,
            commanded=self.commanded,
            voltage=self.voltage,
        )

    @property
    def dt(self) -> float:
        """The sample time [s]."""
        return float((self.time[-1] - self.time[0]) / (self.time.size - 1))

    @property
    def channels(self) -> Float[np.ndarray, "samples 15"]:
        """Every channel in the order of `CHANNEL_NAMES`; NaN: not measured."""
        nothing = np.full((self.time.size, len(FORCE_NAMES)), np.nan)
        return np.column_stack([self.states, nothing if self.specific_force is None else self.specific_force])

    def rows(self, part: slice) -> "Recording":
        """Some samples of the recording; their time stays as recorded."""
        fields = {field: getattr(self, field) for field in ("time", "omega", "states", *_OPTIONAL)}
        return self._replace(**{field: value[part] for field, value in fields.items() if value is not None})

    @property
    def named_notes(self) -> tuple[str, ...]:
        """The notes, each with the name in front."""
        return tuple(f"{self.name}: {note}" for note in self.notes)

    def same_data(self, other: "Recording") -> bool:
        """Whether both hold the same samples: times, rotor speeds and states."""
        return all(np.array_equal(a, b, equal_nan=True) for a, b in zip(self[:3], other[:3], strict=True))


_OPTIONAL = ("specific_force", "voltage", "body_velocity", "stretch")


def recording_of(
    table: Table, notes: tuple[str, ...] = (), airframe: Airframe | None = None, *, full_scale: float | None = None
) -> Recording:
    """Make a recording from the columns of a log and the `notes` of its reader; see `read_log`."""
    found = [*notes, *([_unknown_note(table.unknown)] if table.unknown else [])]
    columns = {name: column for name, column in table.columns.items() if not np.isnan(column).all()}
    table = table._replace(columns=columns)
    _check_columns(table)
    facts = _facts(table)
    dt = check_time(table)
    check_units(table)
    omega = _rotor_speeds(table, airframe, full_scale, found)
    commanded = not any(name in table.columns for name in SPEED_NAMES)
    if airframe is not None:
        thrust = np.median((omega**2).sum(axis=1)) * airframe.thrust_coefficient
        found.extend(thrust_note(float(thrust / (airframe.mass * airframe.gravity))))
    channels = _channels(table, found)
    with_force = any(name in table.columns for name in FORCE_NAMES)
    voltage = _voltage(table)
    table = table._replace(columns={"t": table.columns["t"]})  # frees the memory of a long log
    time, omega, channels, voltage = _evenly(table, dt, omega, channels, voltage, found)
    dt = float(time[-1] - time[0]) / (time.size - 1)
    if np.finfo(jnp.result_type(float)).eps * abs(time[0]) > UNIFORM * dt:
        found.append(f"t starts at {time[0]:.10g} s, too late for this precision: it was shifted to 0")
        time = dt * np.arange(time.size)
    states, force = np.split(channels, [len(STATE_NAMES)], axis=1)
    return Recording(
        time,
        omega,
        states,
        specific_force=force if with_force else None,
        voltage=voltage,
        commanded=commanded,
        name=os.fspath(table.path),
        notes=tuple(found),
        facts=facts,
    )


def _facts(table: Table) -> LogFacts:
    """The facts beside the columns. Cells that hold no value were not logged, also those of a rotor."""
    facts = table.facts
    speeds = any(name in table.columns for name in SPEED_NAMES)
    motors = facts.motors or _slowest(table, SPEED_NAMES if speeds else COMMAND_NAMES)
    return facts._replace(motors=motors, gyro=facts.gyro or _slowest(table, ("p", "q", "r")))


def _slowest(table: Table, names: tuple[str, ...]) -> Sampling | None:
    """The column that was logged most rarely, of those that were logged at all.

    Rows that repeat the values of the row before were not logged: programs that join topics fill them in.
    """
    t, found = table.columns["t"], []
    for name in names:
        logged = np.isfinite(table.columns.get(name, np.full(t.size, np.nan)))
        if not logged.any():
            continue
        source, at = table.names.get(name, name), t[logged]
        changes = at[1:][np.diff(table.columns[name][logged]) != 0]
        rate, of_changes = logged_rate(at), logged_rate(changes)
        if held_regularly(changes) and of_changes < _REPEATED * rate:
            source, rate = f"the values of {source} change so often", of_changes
        found.append(Sampling(source, rate))
    return min(found, key=lambda each: each.rate, default=None)


def _check_columns(table: Table) -> None:
    """Refuse a log without time or without any state."""
    columns = table.columns
    if "t" not in columns:
        table.refuse(_missing("there is no time", ("t",), table) + "; each row needs its time [s]", column="t")
    if not any(name in columns for name in STATE_NAMES):
        what = _missing("no state was measured", STATE_NAMES, table)
        table.refuse(f"{what}; a flight needs at least one of the columns {', '.join(STATE_NAMES)}")


def _missing(what: str, wanted: tuple[str, ...], table: Table) -> str:
    hints = [f"{quoted(name)} be {_meant(name)}" for name in table.unknown if _meant(name) in wanted]
    return f"{what} (should {hints[0]}?)" if hints else what


def _meant(name: str) -> str | None:
    """The column that an unknown name may mean: in another case, with other separators, or as other loggers say."""
    plain = re.sub(r"[\W_]", "", name).lower()
    return _OTHER_NAMES.get(plain, plain if plain in COLUMN_NAMES else None)


def _unknown_note(unknown: tuple[str, ...]) -> str:
    shown = [quoted(name) + (f" (did you mean {_meant(name)}?)" if _meant(name) else "") for name in unknown[:8]]
    more = f" and {len(unknown) - 8} more" if len(unknown) > 8 else ""
    return f"unknown columns are ignored: {', '.join(shown)}{more}"


def _rotor_speeds(table: Table, airframe: Airframe | None, full_scale: float | None, notes: list[str]) -> np.ndarray:
    speeds, commands = ([name for name in names if name in table.columns] for names in (SPEED_NAMES, COMMAND_NAMES))
    names = speeds or commands
    if len(names) < 4:
        wanted = COMMAND_NAMES if commands and not speeds else SPEED_NAMES
        lacking = next(name for name in wanted if name not in names)
        what = _missing("is missing", wanted, table)
        table.refuse(f"{what}; a flight needs omega1..4 [rad/s] or command1..4 [0..1], all four", column=lacking)
    if speeds and commands:
        notes.append(f"measured {speeds[0]}..{speeds[-1]} are used; {', '.join(commands)} are ignored")
    omega = np.column_stack([_held(table, name, notes) for name in names])
    if speeds:
        return omega
    known = np.inf if airframe is None else float(airframe.max_rotor_speed)
    if full_scale is None or np.isfinite(known):
        full_scale = known
    if not np.isfinite(full_scale):
        what = "the rotor speed of full command is not known; set max_rotor_speed [rad/s] in the airframe's TOML file"
        table.refuse(what, column=names[0])
    return omega * full_scale


def _held(table: Table, name: str, notes: list[str]) -> np.ndarray:
    """The column of a rotor. An empty cell gets the value before it."""
    column = table.columns[name]
    empty = np.isnan(column)
    if not empty.any():
        return column
    if empty[0]:
        table.refuse("is empty, with no earlier value to hold; delete the row", index=0, column=name)
    last = np.maximum.accumulate(np.where(empty, 0, np.arange(column.size)))
    t = table.columns["t"]
    longest = (t - t[last]).max()
    notes.append(f"{name}: {np.count_nonzero(empty)} empty cells hold the value before them, for up to {longest:.3g} s")
    return column[last]


def _voltage(table: Table) -> np.ndarray | None:
    """The battery's voltage at every row [V], interpolated linearly between measured cells; 0 is not measured."""
    if "voltage" not in table.columns:
        return None
    t, voltage = table.columns["t"], table.columns["voltage"]
    measured = voltage > 0
    return np.interp(t, t[measured], voltage[measured]) if measured.any() else None


def _channels(table: Table, notes: list[str]) -> np.ndarray:
    """States and specific force, shape (rows, 15), with unwrapped angles."""
    channels = np.full((table.columns["t"].size, len(CHANNEL_NAMES)), np.nan)
    for i, name in enumerate(CHANNEL_NAMES):
        if name not in table.columns:
            continue
        channels[:, i] = table.columns[name]
        if name in ("phi", "psi"):
            channels[:, i], jumps = unwrap(table.columns[name])
            if jumps:
                notes.append(f"{name}: {jumps} {'jump' if jumps == 1 else 'jumps'} of 2 pi removed")
    force = channels[:, len(STATE_NAMES) :]
    measured = force[:, np.isfinite(force).any(axis=0)]
    # No accelerometer lies still to the last bit.
    if len(measured) >= _STILL and measured.size and (np.nanmax(measured, 0) == np.nanmin(measured, 0)).all():
        notes.append("the accelerometer does not change at all: it is off, and counts as not measured")
        force[:] = np.nan
    notes.extend(force_note(force))
    return channels


def _evenly(
    table: Table, dt: float, omega: np.ndarray, channels: np.ndarray, voltage: np.ndarray | None, notes: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Time, rotor speeds, channels and voltage on a uniform grid. Rows that already lie on one keep their values."""
    t = table.columns["t"]
    time = uniform_grid(t)
    if time is not None:
        return time, omega, channels, voltage
    samples = grid_size(t, dt)
    if samples > min(MAX_ROWS, _MOST_SAMPLES + 10 * t.size):
        row = int(np.argmax(np.diff(t)))
        what = f"comes after a gap of {t[row + 1] - t[row]:.6g} s: at the median step of {dt:.3g} s the flight would "
        table.refuse(what + f"have {samples:.3g} samples; cut the file there", index=row + 1, column="t")
    (time, omega, channels), figures = resample(t, omega, channels, dt)
    notes.append(figures)
    if not np.isfinite(channels[:, : len(STATE_NAMES)]).any():
        table.refuse("every measured sample is too far from its neighbours (1.5 steps); record at even times")
    return time, omega, channels, None if voltage is None else np.interp(time, t, voltage)
