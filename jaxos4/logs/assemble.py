"""Columns of a log become a `Recording`: checks of time and units, rotor speeds from commands, a uniform grid."""

import os

import jax.numpy as jnp
import numpy as np

from ..airframe import Airframe
from ..errors import counted, listed, printable
from ..flight import COMMAND_NAMES, FORCE_NAMES, RATE_NAMES, SIGNALS, SPEED_NAMES, STATE_NAMES, last_measured
from .sampling import UNIFORM, grid_size, held_regularly, logged_rate, resample, unwrap
from .table import MAX_ROWS, Recording, Sampling, Table, signals_of
from .values import COLUMNS, PITCH, without_impossible


def recording_of(
    table: Table, notes: tuple[str, ...] = (), airframe: Airframe | None = None, *, full_scale: float | None = None
) -> Recording:
    """Make a recording from the columns of a log and the `notes` of its reader; see `read_log`."""
    found = [*notes, *([f"unknown columns are ignored: {listed(table.unknown, 8)}"] if table.unknown else [])]
    table = table._replace(columns={n: column for n, column in table.columns.items() if not np.isnan(column).all()})
    if not table.holds("t"):
        names = listed([*(table.names.get(each, each) for each in table.columns), *table.unknown])
        what = f"there is no time; each row needs its time [s]. There are {names}: rename one, or give a column map"
        table.refuse(what, column="t")
    if not any(map(table.holds, STATE_NAMES)):
        table.refuse(f"no state was measured; a flight needs at least one of the columns {', '.join(STATE_NAMES)}")
    # A column of empty cells was not logged, also if it is a rotor's.
    motors = SPEED_NAMES if any(map(table.holds, SPEED_NAMES)) else COMMAND_NAMES
    dt = _check_time(table)
    rarest = {"motors": _slowest(table, motors), "gyro": _slowest(table, RATE_NAMES)}
    facts = table.facts._replace(**{name: getattr(table.facts, name) or slowest for name, slowest in rarest.items()})
    for name in filter(table.holds, motors):
        if np.isnan(table.columns[name][0]):
            table.refuse("is empty, with no earlier value to hold; delete the row", index=0, column=name)
    table = without_impossible(table, COLUMNS | PITCH)
    if table.holds("psi"):
        psi = table.columns["psi"]
        measured, jumps = np.flatnonzero(np.isfinite(psi)), np.zeros(psi.size, dtype=bool)
        jumps[measured[1:]] = np.abs(np.abs(np.diff(psi[measured])) - 360) < 20
        _refuse_any(table, "psi", jumps, "jumps by about 360: it looks like degrees, divide by 57.3")
    if table.impossible:
        found.append(table.impossible_note)
    omega = _rotor_speeds(table, airframe, full_scale, found)
    columns, inputs = _measured(table, found), _inputs(table)
    commanded = motors is COMMAND_NAMES
    t = table.columns["t"]
    table = table._replace(columns={"t": t})  # frees the memory of a long log
    samples = grid_size(t, dt)
    if samples > min(MAX_ROWS, 10_000 + 10 * t.size):  # a log that consists mostly of gaps is more than one flight
        row = int(np.argmax(np.diff(t)))
        what = f"comes after a gap of {t[row + 1] - t[row]:.6g} s: at the median step of {dt:.3g} s the flight would "
        table.refuse(what + f"have {samples:.3g} samples; cut the file there", index=row + 1, column="t")
    held = commanded or table.held
    (time, omega, rows), figures = resample(t, omega, np.column_stack([*columns.values()]), dt, held=held)
    if figures:  # resampled speeds are means from sample to sample
        held = True
        found.append(figures)
        inputs = {name: np.interp(time, t, column) for name, column in inputs.items()}
    columns = {name: column for name, column in zip(columns, rows.T, strict=True) if np.isfinite(column).any()}
    if not columns.keys() & {*STATE_NAMES}:
        table.refuse("every measured sample is too far from its neighbours (1.5 steps); record at even times")
    dt = float(time[-1] - time[0]) / (time.size - 1)
    if np.finfo(jnp.result_type(float)).eps * abs(time[0]) > UNIFORM * dt:
        found.append(f"t starts at {time[0]:.10g} s, too late for this precision: it was shifted to 0")
        time = dt * np.arange(time.size)
    about = {"commanded": commanded, "held": held, "name": printable(os.fspath(table.path))}
    about |= {"notes": tuple(found), "facts": facts}
    return Recording(time=time, **signals_of(columns | inputs) | {"omega": omega}, **about)


def _slowest(table: Table, names: tuple[str, ...]) -> Sampling | None:
    """The column that was logged most rarely. Rows that repeat a value were filled in by programs that join topics."""
    found = []
    for name in filter(table.holds, names):
        logged = np.isfinite(table.columns[name])
        source, at = table.names.get(name, name), table.columns["t"][logged]
        changes = at[1:][np.diff(table.columns[name][logged]) != 0]
        rate, of_changes = logged_rate(at), logged_rate(changes)
        if held_regularly(changes) and of_changes < 0.9 * rate:
            source, rate = f"the values of {source} change so often", of_changes
        found.append(Sampling(source, rate))
    return min(found, key=lambda each: each.rate, default=None)


MIN_STEP, MAX_STEP = 1e-6, 2.0  # s; the median time between rows of a flight


def _check_time(table: Table) -> float:
    """The median time between rows [s], refused outside of `MIN_STEP` to `MAX_STEP`, or if times do not increase."""
    t = table.columns["t"]
    _refuse_any(table, "t", np.isnan(t), "is empty; each row needs its time")
    _refuse_any(table, "t", np.abs(t) > COLUMNS["t"].largest, f"is {{:g}} s; {COLUMNS['t'].advice}")
    step = np.diff(t)
    if (step <= 0).any():
        index = int(np.argmax(step <= 0))
        what = f"runs backward, from {t[index]:.9g} s to {t[index + 1]:.9g} s; sort the rows, or cut the file there"
        if step[index] == 0:
            row = index + (table.first_row or 0)
            what = f"repeats {t[index]:.9g} s of row {row}; time must increase: delete one of the two rows"
        table.refuse(what, index=index + 1, column="t")
    dt = float(np.median(step))
    if dt < MIN_STEP:
        table.refuse(f"has rows {dt:.3g} s apart, less than a microsecond; t is in seconds: multiply", column="t")
    if dt > MAX_STEP:
        what = f"has rows {dt:.4g} s apart, too far for a flight; t is in seconds: if these are ms or us, divide"
        table.refuse(what, column="t")
    return dt


def _refuse_any(table: Table, name: str, wrong: np.ndarray, what: str) -> None:
    """Refuse the first value of a column that is `wrong`; `what` may hold a place for the value."""
    if wrong.any():
        index = int(np.argmax(wrong))
        table.refuse(what.format(table.columns[name][index]), index=index, column=name)


def _rotor_speeds(table: Table, airframe: Airframe | None, full_scale: float | None, notes: list[str]) -> np.ndarray:
    """Measured speeds, or commands times the speed of full command [rad/s], shape (rows, 4)."""
    speeds, commands = (list(filter(table.holds, names)) for names in (SPEED_NAMES, COMMAND_NAMES))
    names = speeds or commands
    if len(names) < 4:
        wanted = COMMAND_NAMES if commands and not speeds else SPEED_NAMES
        lacking = next(name for name in wanted if name not in names)
        what = "is missing; a flight needs omega1..4 [rad/s] or command1..4 [0..1], all four"
        table.refuse(what, column=lacking)
    if speeds and commands:
        notes.append(f"measured {speeds[0]}..{speeds[-1]} are used; {', '.join(commands)} are ignored")
    omega, t = np.column_stack([table.columns[name] for name in names]), table.columns["t"]
    for name, column in zip(names, omega.T, strict=True):
        empty = np.isnan(column)
        if not empty.any():
            continue
        # A cell gets the value before it; an impossible first one gets the next.
        last, cells = last_measured(~empty), int(np.count_nonzero(empty)) - table.impossible.get(name, (0, ""))[0]
        if cells:
            filled = f"filled with the value before, for up to {(t - t[last]).max():.3g} s"
            notes.append(f"{name}: {counted(cells, 'empty cell')} {filled}")
        column[:] = column[last]
    if speeds:
        return omega
    known = np.inf if airframe is None else float(airframe.max_rotor_speed)
    if full_scale is None or np.isfinite(known):
        full_scale = known
    if not np.isfinite(full_scale):
        what = "the rotor speed of full command is not known; set max_rotor_speed [rad/s] in the airframe's TOML file"
        table.refuse(what, column=names[0])
    return omega * full_scale


def _measured(table: Table, notes: list[str]) -> dict[str, np.ndarray]:
    """The columns of measurements, in which NaN marks gaps, with unwrapped angles."""
    every = [name for signal in SIGNALS.values() if not signal.is_input for name in signal.columns]
    columns = {name: table.columns[name] for name in filter(table.holds, every)}
    for name in filter(columns.__contains__, ("phi", "psi")):
        columns[name], jumps = unwrap(columns[name])
        if jumps:
            notes.append(f"{name}: {counted(jumps, 'jump')} of 2 pi removed")
    force = [columns[name] for name in FORCE_NAMES if name in columns and np.isfinite(columns[name]).any()]
    # No accelerometer lies still to the last bit for this many samples.
    if force and len(force[0]) >= 100 and all(np.nanmax(each) == np.nanmin(each) for each in force):
        notes.append("the accelerometer does not change at all: it is off, and counts as not measured")
        columns = {name: column for name, column in columns.items() if name not in FORCE_NAMES}
    return columns


def _inputs(table: Table) -> dict[str, np.ndarray]:
    """The columns of inputs at every row, interpolated linearly between measured cells."""
    t, found = table.columns["t"], {}
    every = [name for signal in SIGNALS.values() if signal.is_input for name in signal.columns]
    for name in filter(table.holds, every):
        measured = np.isfinite(table.columns[name])
        if measured.any():
            found[name] = np.interp(t, t[measured], table.columns[name][measured])
    return found
