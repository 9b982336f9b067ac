"""The most informative parts of a long log. A fit of all of it would take hours, and change only the last digits."""

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..logs import Recording
from ..logs.table import counted
from .stretches import MIN_STRETCH, Stretch, cut

PIECE = 30.0  # s; shorter pieces would be chosen for their gusts, which biases a fit, and begin with unsettled filters
MOST = 65_536  # samples of a fit, which takes more than a minute; flights of any length up to it share a program
_SAME = 1e-6  # durations that differ by less than this share are equal
_BIN = 0.02  # s; torques that change faster hardly turn a vehicle
_LEVELS = 2.0  # for each factor of 2; pieces whose torques differ only by chance count as equal


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
    pieces = [piece for part in parts for piece in _pieces(part, longest)]
    varied = np.array([_varied(cut(recording, piece), torques) for piece in pieces])
    levels = np.rint(_LEVELS * np.log2(np.maximum(varied, np.finfo(float).tiny)))
    ranks = np.argsort(-levels, axis=0, kind="stable").T.tolist()
    chosen, left = set(), seconds * (1 + 1e-9)
    for number in (number for in_turn in zip(*ranks, strict=True) for number in in_turn):
        if number not in chosen and (not chosen or pieces[number].length <= left):
            chosen.add(number)
            left -= pieces[number].length
    return _merged([pieces[number] for number in sorted(chosen)])


def fair_share(recordings: Sequence[Recording], step: float) -> float:
    """The longest duration to fit of each recording [s], so that all together have `MOST` samples of `step` [s]."""
    lengths, left = sorted(float(np.ptp(each.time[[0, -1]])) for each in recordings), MOST * step
    for number, length in enumerate(lengths):
        if length * (len(lengths) - number) > left:
            return left / (len(lengths) - number)
        left -= length
    return math.inf


def note_of(name: str, chosen: Sequence[Stretch], parts: Sequence[Stretch]) -> list[str]:
    """A note, if these are not all of the usable parts of a log."""
    seconds, usable = (sum(each.length for each in every) for every in (chosen, parts))
    if seconds > (1 - _SAME) * usable:
        return []
    return [
        f"{name}: {seconds:.1f} of {usable:.1f} usable s are fitted, because more than {MOST:,} samples take minutes: "
        f"the {counted(len(chosen), 'part')} whose torques vary the most (a longer `sample_time` fits more; `begin` "
        "and `end` choose another part)"
    ]


def _pieces(part: Stretch, longest: float) -> list[Stretch]:
    """Divides a part into equal pieces."""
    edges = np.linspace(part.begin, part.end, math.ceil(part.length / longest) + 1).tolist()
    return [Stretch(begin, end) for begin, end in zip(edges, edges[1:], strict=False)]


def _varied(piece: Recording, torques: Float[np.ndarray, "axes 4"]) -> Float[np.ndarray, " axes"]:
    """The standard deviation of each torque, without the fastest changes."""
    torque = np.square(piece.omega) @ torques.T
    length = max(round(_BIN / piece.dt), 1)
    whole = torque[: len(torque) // length * length]
    return whole.reshape(-1, length, len(torques)).mean(axis=1).std(axis=0)


def _merged(pieces: Sequence[Stretch]) -> list[Stretch]:
    """Joins adjacent pieces; they are in the order of time."""
    out: list[Stretch] = []
    for piece in pieces:
        if out and out[-1].end == piece.begin:
            out[-1] = Stretch(out[-1].begin, piece.end)
        else:
            out.append(piece)
    return out
