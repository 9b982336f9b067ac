"""Recordings as windows: averaged to longer samples, joined to a flight of whole windows, some of them held out."""

import math
from collections.abc import Sequence

import numpy as np

from ..flight import STATE_NAMES, Flight
from ..logs import Recording, as_recording
from ..logs.sampling import averages, speeds_within

_SAME = 1e-6  # sample times that differ by less than this share are equal


def averaged(flight: Recording, steps: Sequence[float]) -> list[Recording]:
    """A flight averaged to samples of each length [s], if longer than its own, with the rotor speeds `within` each."""
    within = speeds_within(flight.time, flight.omega, held=flight.held)
    columns = [flight.channels] if flight.voltage is None else [flight.channels, flight.voltage[:, None]]
    average = averages(flight.time, flight.omega, np.hstack(columns), held=flight.held)

    def at(dt: float) -> Recording:
        if dt <= flight.dt * (1 + _SAME):
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
    """Put stretches of flight one after the other, as one flight of whole windows of `length` samples.

    Samples at the end of a stretch that do not fill a window are dropped. Time becomes a count of samples from 0.

    **Raises:** `ValueError` if the sample times differ, or if no stretch is as long as one window.
    """
    whole = [whole_windows(as_recording(flight), length) for flight in flights]
    whole = [stretch for stretch in whole if stretch.time.size]
    if not whole:
        raise ValueError(f"`flights` must hold at least `length` = {length} samples without a break.")
    return joined(whole).flight


def whole_windows(recording: Recording, length: int) -> Recording:
    """The recording without the samples at its end that do not fill a window of `length` samples."""
    return recording.rows(slice(recording.time.size // length * length))


def joined(stretches: Sequence[Recording]) -> Recording:
    """Stretches one after the other; time counts samples from 0. Raises `ValueError` if the sample times differ."""
    steps = [stretch.dt for stretch in stretches]
    if np.ptp(steps) > _SAME * steps[0]:
        raise ValueError(f"`flights` must have one sample time, got {', '.join(f'{dt:.6g}' for dt in steps)} s.")
    states, force = np.split(np.concatenate([each.channels for each in stretches]), [len(STATE_NAMES)], axis=1)
    sizes = [stretch.time.size for stretch in stretches]

    def of_all(name: str) -> np.ndarray | None:
        """A channel, if all stretches have it."""
        values = [getattr(stretch, name) for stretch in stretches]
        return None if any(each is None for each in values) else np.concatenate(values)

    return Recording(
        time=steps[0] * np.arange(sum(sizes)),
        omega=np.concatenate([stretch.omega for stretch in stretches]),
        states=states,
        specific_force=None if np.isnan(force).all() else force,
        voltage=of_all("voltage"),
        body_velocity=of_all("body_velocity"),
        stretch=np.repeat(np.arange(len(sizes)), sizes),
        commanded=any(stretch.commanded for stretch in stretches),
        held=all(stretch.held for stretch in stretches),
        within=of_all("within"),
        averaging_time=stretches[0].averaging_time,
    )


def hold_out(
    recording: Recording, length: int, share: float, *, seconds: float = 5.0
) -> tuple[Recording, Recording | None]:
    """Split a recording into measurements to fit and measurements to predict, in alternating batches of whole windows.

    **Arguments:**

    - `recording`: whole windows, see `whole_windows`, of `length` samples.
    - `share`: of the windows to hold out, 0 to 0.5.
    - `seconds`: about how long a batch is [s]: short enough for all phases of a flight to have batches of both kinds.

    **Returns:** two recordings of the same samples: in each, the measurements of the other are NaN. The second keeps
    the specific force, because a model may use it as an input. `None`: nothing is held out.
    """
    if not share:
        return recording, None
    windows, rounding = recording.time.size // length, 1e-9
    batch = max(min(round(seconds / (length * recording.dt)), int(windows * share / 2)), 1)
    number = np.arange(windows) // batch
    held_out = np.floor((number + 1) * share + rounding) > np.floor(number * share + rounding)
    held_out = np.repeat(held_out, length)[:, None]
    if not held_out.any() or held_out.all():
        return recording, None
    force = recording.specific_force
    fitted = recording._replace(
        states=np.where(held_out, np.nan, recording.states),
        specific_force=None if force is None else np.where(held_out, np.nan, force),
    )
    return fitted, recording._replace(states=np.where(held_out, recording.states, np.nan))
