"""Logs and flights as recordings."""

import os
from collections.abc import Sequence

import numpy as np

from ..flight import CHANNEL_NAMES, Flight
from ..logs import FORMATS, Recording as Recording, Table, log_format, read_recording as read_recording


def vehicle_evidence(recording: Recording) -> str:
    """The evidence that a file is the log of a real vehicle, as the end of a sentence; empty if there is none.

    A simulation of the OS4 has rotor speeds and states. A vehicle logs commands, or has an accelerometer, or writes a
    format of its own.
    """
    if recording.commanded:
        return "has commands, not rotor speeds"
    if recording.specific_force is not None:
        return "has an accelerometer"
    if os.path.isfile(recording.name) and (kind := log_format(recording.name)) is not FORMATS[-1]:
        return f"is a log of a vehicle ({kind.label})"
    return ""


def as_recordings(
    flights: Flight | Recording | Sequence[Flight | Recording], name: str = "flight"
) -> tuple[Recording, ...]:
    """One or several flights as recordings. A flight without a name is called `name`; several are numbered from 1."""
    every = (flights,) if isinstance(flights, Flight | Recording) else tuple(flights)
    return tuple(as_recording(each, f"{name} {i + 1}" if len(every) > 1 else name) for i, each in enumerate(every))


def as_recording(flight: Flight | Recording, name: str = "flight") -> Recording:
    """A flight as a recording of this name, without impossible values. A recording stays as it is.

    **Raises:** `InputError` if more than 1 % of the values of a channel are impossible.
    """
    if isinstance(flight, Recording):
        return flight
    found = Recording.of(flight, name)
    columns = {"t": found.time, **dict(zip(CHANNEL_NAMES, found.channels.T, strict=True))}
    table = Table(name, columns, first_row=None).without_impossible()
    if not table.impossible:
        return found
    states, force = np.split(np.stack([table.columns[each] for each in CHANNEL_NAMES], axis=1), [12], axis=1)
    specific = None if found.specific_force is None else force
    return found._replace(states=states, specific_force=specific, notes=(table.impossible_note,))
