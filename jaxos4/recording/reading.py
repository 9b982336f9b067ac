"""A recorded flight with its name, and the notes of its reader."""

import os
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ..airframe import Airframe
from ..flight import Flight
from ..logs import FORMATS, LogFacts, log_format, read_log_and_facts


class Recording(NamedTuple):
    """A flight with a name.

    - `flight`: what was recorded.
    - `name`: in messages and in the provenance. Usually the path of the file.
    - `notes`: what the reader changed in the data, one line each.
    - `facts`: what the log says beside the flight, such as how often motors and gyro were written.
    """

    flight: Flight
    name: str
    notes: tuple[str, ...] = ()
    facts: LogFacts = LogFacts()

    @property
    def named_notes(self) -> tuple[str, ...]:
        """The notes, each with the name in front."""
        return tuple(f"{self.name}: {note}" for note in self.notes)

    def same_data(self, other: "Recording") -> bool:
        """Whether both hold the same samples: times, rotor speeds and states."""
        mine, others = ((each.flight.time, each.flight.omega, each.flight.states) for each in (self, other))
        return all(
            np.array_equal(np.asarray(a), np.asarray(b), equal_nan=True) for a, b in zip(mine, others, strict=True)
        )


def read_recording(
    path: str | os.PathLike[str], airframe: Airframe | None = None, *, full_scale: float | None = None
) -> Recording:
    """Read a log in any format that `jaxos4.read_log` knows, named by its path. Arguments and errors are the same."""
    flight, notes, facts = read_log_and_facts(path, airframe, full_scale=full_scale)
    return Recording(flight, os.fspath(path), notes, facts)


def vehicle_evidence(recording: Recording) -> str:
    """What shows that a file is the log of a real vehicle, as the end of a sentence; empty if nothing does.

    A simulation of the OS4 has rotor speeds and states. A vehicle logs commands, or has an accelerometer, or writes a
    format of its own.
    """
    if recording.flight.commanded:
        return "has commands, not rotor speeds"
    if recording.flight.specific_force is not None:
        return "has an accelerometer"
    if os.path.isfile(recording.name) and (kind := log_format(recording.name)) is not FORMATS[-1]:
        return f"is a log of a vehicle ({kind.label})"
    return ""


def as_recordings(
    flights: Flight | Recording | Sequence[Flight | Recording], name: str = "flight"
) -> tuple[Recording, ...]:
    """One or several flights as recordings. A flight without a name is called `name`; several are numbered from 1."""
    every = (flights,) if isinstance(flights, Flight | Recording) else tuple(flights)
    return tuple(
        each if isinstance(each, Recording) else Recording(each, f"{name} {i + 1}" if len(every) > 1 else name)
        for i, each in enumerate(every)
    )
