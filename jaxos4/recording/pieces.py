"""Flights as recordings, and their pieces: cut, averaged, joined, divided into measurements to fit and to predict."""

import math
import os
from collections.abc import Sequence
from typing import Any, NamedTuple, cast

import numpy as np

from ..airframe import Airframe
from ..errors import InputError
from ..flight import CHANNEL_NAMES, STATE_NAMES, Flight
from ..logs import FORMATS, Recording as Recording, Table, read_recording
from ..logs.sampling import averages, speeds_within

# Sample times that differ by less than this share are equal.
_EQUAL_STEPS = 1e-6
# Length of a block that is held out [s]: each part of a flight then has blocks of both kinds.
_BLOCK = 5.0
_ROUNDING = 1e-9  # of sums of shares


Source = Flight | Recording | str | os.PathLike[str] | Any
"""A flight, the path of a log, or its arrays as `jaxos4.read_log` takes them."""


class Stretch(NamedTuple):
    """A part of a flight, from the sample at `begin` to the sample at `end` [s].

    `reason`: why the part is not usable; empty if it is.
    """

    begin: float
    end: float
    reason: str = ""

    @property
    def length(self) -> float:
        """Its duration [s]."""
        return self.end - self.begin


def as_recordings(
    flights: Source | Sequence[Source], name: str = "flight", airframe: Airframe | None = None
) -> tuple[Recording, ...]:
    """One or several flights as recordings. A flight without a name is called `name`; several are numbered from 1.

    `airframe`: of logs that are read, see `jaxos4.read_log`.
    """
    single = isinstance(flights, Recording | str) or not isinstance(flights, Sequence)
    every = [flights] if single else cast(Sequence[Any], flights)
    names = [f"{name} {i + 1}" if len(every) > 1 else name for i in range(len(every))]
    return tuple(as_recording(each, one, airframe) for each, one in zip(every, names, strict=True))


def as_recording(flight: Source, name: str = "flight", airframe: Airframe | None = None) -> Recording:
    """A flight as a recording of this name, without impossible values. A recording stays as it is.

    A path, or arrays by their names, are read as a log of this `airframe`.

    **Raises:** `InputError` if more than 1 % of the values of a channel are impossible, or if a log cannot be used.
    """
    if isinstance(flight, Recording):
        return flight
    if not isinstance(flight, Flight):
        return read_recording(flight, airframe)
    found = Recording.of(flight, name)
    columns = {"t": found.time, **dict(zip(CHANNEL_NAMES, found.channels.T, strict=True))}
    table = Table(name, columns, first_row=None).without_impossible()
    if not table.impossible:
        return found
    states, force = np.split(np.stack([table.columns[each] for each in CHANNEL_NAMES], axis=1), [12], axis=1)
    specific = None if found.specific_force is None else force
    return found._replace(states=states, specific_force=specific, notes=(table.impossible_note,))


def vehicle_evidence(recording: Recording) -> str:
    """The evidence that a file is the log of a real vehicle, as the end of a sentence; empty if there is none.

    A simulation of the OS4 has rotor speeds and states. A vehicle logs commands, or has an accelerometer, or writes a
    format of its own.
    """
    if recording.commanded:
        return "has commands, not rotor speeds"
    if recording.specific_force is not None:
        return "has an accelerometer"
    if (kind := recording.facts.format) not in (None, FORMATS[-1]):
        return f"is a log of a vehicle ({kind.label})"
    return ""


def cut(flight: Recording, stretch: Stretch) -> Recording:
    """The part of a flight from `stretch.begin` to `stretch.end`; its time stays as recorded.

    **Raises:** `InputError` if the part has fewer than two samples.
    """
    time, half = flight.time, flight.dt / 2
    inside = np.flatnonzero((time >= stretch.begin - half) & (time <= stretch.end + half))
    if inside.size < 2:
        raise InputError(
            f"from {stretch.begin:g} s to {stretch.end:g} s: fewer than two samples; the flight lasts from "
            f"{time[0]:.6g} s to {time[-1]:.6g} s."
        )
    return flight.rows(slice(int(inside[0]), int(inside[-1]) + 1))


def averaged(flight: Recording, steps: Sequence[float]) -> list[Recording]:
    """A flight averaged to samples of each length [s], see `averages`, with the rotor speeds `within` each.

    Measurements stay as they are where its own samples are not shorter.
    """
    within = speeds_within(flight.time, flight.omega, held=flight.held)
    columns = [flight.channels] if flight.voltage is None else [flight.channels, flight.voltage[:, None]]
    average = averages(flight.time, flight.omega, np.hstack(columns), held=flight.held)

    def at(dt: float) -> Recording:
        if dt <= flight.dt * (1 + _EQUAL_STEPS):
            return flight._replace(within=within(flight.time, flight.dt))
        time, omega, means = average(dt)
        return flight._replace(
            time=time,
            omega=omega,
            states=means[:, :12],
            specific_force=None if flight.specific_force is None else means[:, 12:15],
            voltage=None if flight.voltage is None else means[:, 15],
            body_velocity=None,
            stretch=None,
            held=True,
            within=within(time, dt),
            # Means of as many instants have the same variance in time as a mean over this time.
            averaging_time=dt * math.sqrt(1 - (flight.dt / dt) ** 2),
        )

    return [at(dt) for dt in steps]


def join(flights: Sequence[Flight], *, length: int) -> Flight:
    """Put stretches of flight one after the other, as one flight of whole windows.

    Samples at the end of a stretch that do not fill a window are dropped, as are stretches shorter than one window.
    Time becomes a count of samples from 0. Measurements do not change.

    **Arguments:**

    - `flights`: the stretches.
    - `length`: of a window, in samples.

    **Raises:** `ValueError` if the sample times differ, or if no stretch is as long as one window.
    """
    whole = [whole_windows(as_recording(flight), length) for flight in flights]
    whole = [piece for piece in whole if piece.time.size]
    if not whole:
        raise ValueError(f"`flights` must hold at least `length` = {length} samples without a break.")
    return joined(whole).flight


def whole_windows(recording: Recording, length: int) -> Recording:
    """The recording without the samples at its end that do not fill a window of `length` samples."""
    return recording.rows(slice(recording.time.size // length * length))


def joined(pieces: Sequence[Recording]) -> Recording:
    """Pieces of recordings one after the other; each becomes a stretch, and time a count of samples from 0.

    **Raises:** `ValueError` if the sample times differ.
    """
    steps = [piece.dt for piece in pieces]
    if np.ptp(steps) > _EQUAL_STEPS * steps[0]:
        raise ValueError(f"`flights` must have one sample time, got {', '.join(f'{dt:.6g}' for dt in steps)} s.")
    states, force = np.split(np.concatenate([piece.channels for piece in pieces]), [len(STATE_NAMES)], axis=1)
    sizes = [piece.time.size for piece in pieces]
    return Recording(
        time=steps[0] * np.arange(sum(sizes)),
        omega=np.concatenate([piece.omega for piece in pieces]),
        states=states,
        specific_force=None if np.isnan(force).all() else force,
        voltage=_of_all(pieces, "voltage"),
        body_velocity=_of_all(pieces, "body_velocity"),
        stretch=np.repeat(np.arange(len(sizes)), sizes),
        commanded=any(piece.commanded for piece in pieces),
        held=all(piece.held for piece in pieces),
        within=_of_all(pieces, "within"),
        averaging_time=pieces[0].averaging_time,
    )


def _of_all(pieces: Sequence[Recording], name: str) -> np.ndarray | None:
    """A channel, if all pieces have it."""
    values = [getattr(piece, name) for piece in pieces]
    return None if any(each is None for each in values) else np.concatenate(values)


def hold_out(recording: Recording, length: int, share: float) -> tuple[Recording, Recording | None]:
    """Split a recording into measurements to fit and measurements to predict, in alternating blocks of whole windows.

    **Arguments:**

    - `recording`: whole windows, see `whole_windows`.
    - `length`: of a window, in samples.
    - `share`: of the windows to hold out, 0 to 0.5.

    **Returns:** two recordings of the same samples: in each, the measurements of the other are missing (NaN). The
    second keeps the specific force everywhere, because a model may use it as an input. `None`: nothing is held out.
    """
    if not share:
        return recording, None
    windows = recording.time.size // length
    block = max(min(round(_BLOCK / (length * recording.dt)), int(windows * share / 2)), 1)
    number = np.arange(windows) // block
    held_out = np.floor((number + 1) * share + _ROUNDING) > np.floor(number * share + _ROUNDING)
    held_out = np.repeat(held_out, length)[:, None]
    if not held_out.any() or held_out.all():
        return recording, None
    force = recording.specific_force
    fitted = recording._replace(
        states=np.where(held_out, np.nan, recording.states),
        specific_force=None if force is None else np.where(held_out, np.nan, force),
    )
    return fitted, recording._replace(states=np.where(held_out, recording.states, np.nan))
