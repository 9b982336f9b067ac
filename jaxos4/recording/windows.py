"""The parts of recordings that are fitted: the most informative ones, averaged, in whole windows, some held out."""

import itertools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from ..flight import SIGNALS, Flight, Signal
from ..logs import Recording, as_recording
from ..logs.sampling import averages, speeds_within
from ..logs.table import signals_of
from .stretches import MIN_STRETCH, Stretch, cut

PIECE = 30.0  # s; shorter pieces would be chosen for their gusts, which biases a fit, and begin with unsettled filters
MOST = 65_536  # samples of a fit, which takes more than a minute; flights of any length up to it share a program
_BIN = 0.02  # s; torques that change faster hardly turn a vehicle
_LEVELS = 2.0  # for each factor of 2; pieces whose torques differ only by chance count as equal
_SAME = 1e-6  # sample times that differ by less than this share are equal


def fair_share(recordings: Sequence[Recording], step: float) -> float:
    """The longest duration to fit of each recording [s], so that all together have `MOST` samples of `step` [s].

    A fit of all of a long log would take hours, and change only the last digits.
    """
    lengths, left = sorted(float(np.ptp(each.time[[0, -1]])) for each in recordings), MOST * step
    for number, length in enumerate(lengths):
        if length * (len(lengths) - number) > left:
            return left / (len(lengths) - number)
        left -= length
    return math.inf


def richest(
    recording: Recording, parts: Sequence[Stretch], torques: Float[np.ndarray, "axes 4"], seconds: float
) -> list[Stretch]:
    """The pieces of some parts in which the torques vary the most, in the order of time.

    Roll, pitch and yaw choose in turn. The first of equal pieces is chosen.

    **Arguments:**

    - `parts`: usable stretches of the recording.
    - `torques`: the matrix from squared rotor speeds to the torque about each axis. Only ratios count.
    - `seconds`: the longest total duration of the pieces [s], of which at least one is chosen. If all parts together
      are shorter, they are returned.
    """
    if sum(part.length for part in parts) <= seconds:
        return list(parts)
    longest = max(seconds / math.ceil(seconds / PIECE), MIN_STRETCH)
    pieces, varied = [], []
    for part in parts:
        edges = np.linspace(part.begin, part.end, math.ceil(part.length / longest) + 1).tolist()
        pieces += [Stretch(begin, end) for begin, end in itertools.pairwise(edges)]
    for piece in pieces:
        flown = cut(recording, piece)
        torque, length = np.square(flown.omega) @ torques.T, max(round(_BIN / flown.dt), 1)
        whole = torque[: len(torque) // length * length]
        varied.append(whole.reshape(-1, length, len(torques)).mean(axis=1).std(axis=0))
    levels = np.rint(_LEVELS * np.log2(np.maximum(varied, np.finfo(float).tiny)))
    ranks = np.argsort(-levels, axis=0, kind="stable").T.tolist()
    chosen, left = set(), seconds * (1 + 1e-9)
    for number in (number for in_turn in zip(*ranks, strict=True) for number in in_turn):
        if number not in chosen and (not chosen or pieces[number].length <= left):
            chosen.add(number)
            left -= pieces[number].length
    out: list[Stretch] = []
    for piece in (pieces[number] for number in sorted(chosen)):
        if out and out[-1].end == piece.begin:
            out[-1] = Stretch(out[-1].begin, piece.end)
        else:
            out.append(piece)
    return out


def averaged(flight: Recording, steps: Sequence[float]) -> list[Recording]:
    """A flight averaged to samples of each of these lengths [s], with the rotor speeds `within` each sample.

    A length that does not exceed the flight's own sample time leaves its samples as they are.
    """
    columns, found = flight.columns(), []
    within = speeds_within(flight.time, flight.omega, held=flight.held)
    average = averages(flight.time, flight.omega, np.column_stack([*columns.values()]), held=flight.held)
    for dt in steps:
        if dt <= flight.dt * (1 + _SAME):
            found.append(flight._replace(within=within(flight.time, flight.dt)))
            continue
        time, omega, means = average(dt)
        signals = signals_of(dict(zip(columns, means.T, strict=True))) | {"omega": omega, "within": within(time, dt)}
        # A mean of n instants has the same variance in time as a continuous mean over this shorter time.
        averaging_time = dt * math.sqrt(1 - (flight.dt / dt) ** 2)
        found.append(flight._replace(**signals, time=time, held=True, averaging_time=averaging_time))
    return found


def join(flights: Sequence[Flight], *, length: int) -> Flight:
    """Concatenate stretches of flight to one flight of whole windows of `length` samples.

    Samples at the end of a stretch that do not fill a window are dropped. Time becomes a count of samples from 0.

    **Raises:** `ValueError` if the sample times differ, or if no stretch is as long as one window.
    """
    whole = [whole_windows(as_recording(flight), length) for flight in flights]
    whole = [stretch for stretch in whole if stretch.time.size]
    if not whole:
        raise ValueError(f"`flights` must hold at least `length` = {length} samples without a break.")
    return concatenate(whole).flight


def whole_windows(recording: Recording, length: int) -> Recording:
    """The recording without the samples at its end that do not fill a window of `length` samples."""
    return recording.rows(slice(recording.time.size // length * length))


def concatenate(stretches: Sequence[Recording]) -> Recording:
    """Stretches one after the other; time counts samples from 0. Raises `ValueError` if the sample times differ."""
    steps = [stretch.dt for stretch in stretches]
    if np.ptp(steps) > _SAME * steps[0]:
        raise ValueError(f"`flights` must have one sample time, got {', '.join(f'{dt:.6g}' for dt in steps)} s.")
    sizes = [stretch.time.size for stretch in stretches]

    def whole(name: str, signal: Signal) -> np.ndarray | None:
        """A signal of all stretches: NaN in those without it, or `None` if an input is missing in one of them.

        A sensor that measured nothing in any stretch is `None`, as if the vehicle had none. States are always there.
        """
        rows = [getattr(stretch, name) for stretch in stretches]
        always = signal.is_input or name == "states"
        missing = [each is None or not (always or np.isfinite(each).any()) for each in rows]
        if all(missing) or (signal.is_input and any(missing)):
            return None
        nothing = [np.full((size, *(signal.shape or ())), np.nan) for size in sizes]
        return np.concatenate([none if each is None else each for each, none in zip(rows, nothing, strict=True)])

    signals: dict[str, Any] = {name: whole(name, signal) for name, signal in SIGNALS.items()}
    signals["stretch"] = np.repeat(np.arange(len(sizes)), sizes)
    return Recording(
        time=steps[0] * np.arange(sum(sizes)),
        **signals,
        commanded=any(stretch.commanded for stretch in stretches),
        held=all(stretch.held for stretch in stretches),
        averaging_time=stretches[0].averaging_time,
    )


BATCH = 5.0  # s; measurements are held out in batches, so short that all phases of a flight have both kinds


def hold_out(recording: Recording, length: int, share: float) -> tuple[Recording, Recording | None]:
    """Split a recording into measurements to fit and measurements to predict, in alternating batches of whole windows.

    **Arguments:**

    - `recording`: whole windows, see `whole_windows`, of `length` samples.
    - `share`: the share of the windows to hold out, 0 to 0.5.

    **Returns:** two recordings of the same samples: in each, the measurements of the other are NaN. The second keeps
    all signals besides the states, because a model may use them as inputs. `None`: nothing is held out.
    """
    if not share:
        return recording, None
    windows, rounding = recording.time.size // length, 1e-9
    batch = max(min(round(BATCH / (length * recording.dt)), int(windows * share / 2)), 1)
    number = np.arange(windows) // batch
    held_out = np.floor((number + 1) * share + rounding) > np.floor(number * share + rounding)
    held_out = np.repeat(held_out, length)
    if not held_out.any() or held_out.all():
        return recording, None
    measured = {name: getattr(recording, name) for name, signal in SIGNALS.items() if not signal.is_input}
    fitted = {name: None if rows is None else _without(rows, held_out) for name, rows in measured.items()}
    return recording._replace(**fitted), recording._replace(states=_without(recording.states, ~held_out))


def _without(rows: np.ndarray, which: Bool[np.ndarray, " samples"]) -> np.ndarray:
    """The rows of a signal, with NaN in the samples `which`."""
    kept = rows.copy()
    kept[which] = np.nan
    return kept
