"""A verdict for each quantity: whether it can be trusted, and if not, the reasons.

A doubt counts against a quantity by how far the quantity would move if the doubt were true.
"""

from collections.abc import Collection, Sequence
from typing import NamedTuple

import msgspec

from ..airframe import INERTIAS

IDENTIFIED = "identified"
RESERVED = "identified with a reservation"
MISSING = "not identified"
CONTRADICTED = "contradicted"
STATUSES = (IDENTIFIED, RESERVED, MISSING, CONTRADICTED)
"""From the best to the worst."""
_TRUSTED = (IDENTIFIED, RESERVED)

PREDICTIONS, RIGID_BODY = "predictions", "rigid body"


class Move(msgspec.Struct, frozen=True):
    """The change of a quantity if a doubt were true.

    - `share`: of the quantity. Parameters can be 0: theirs is a share of the half-width of their bracket.
    - `deviations`: the same in standard deviations of the estimate.
    """

    share: float
    deviations: float


class Doubt(msgspec.Struct, frozen=True):
    """A reason not to trust an estimate, or a part of it.

    - `result`: the name of the result code to which it leads if it refuses the moments of inertia; `"successful"`: it
      only makes a reservation.
    - `cause`, `remedy`: what is wrong, and what to do.
    - `moves`: the quantities that it concerns, each with how far it would move if the doubt were true. `None`: nothing
      says how far.
    """

    result: str
    cause: str
    remedy: str
    moves: dict[str, Move | None] = {}

    def __str__(self) -> str:
        return f"{self.cause}; {self.remedy}"


class Tolerance(msgspec.Struct, frozen=True):
    """Limits of a verdict: the change that a doubt may cause, and the accuracy that is needed.

    - `share`, `deviations`: a doubt that moves a quantity by more than both contradicts it, by more than one of them
      makes a reservation, by less is a note. Errors of discretisation reach 3 %, and an interval allows for one
      standard deviation. Moves of reservations add up; see `weights`.
    - `vague`, `unknown`: half of the 95 % interval as a share of a moment of inertia, from which on the quantity has a
      reservation, or is not identified. With intervals of 10 % and less, 1 answer in 160 is off by more than 12 %.
    - `seconds`: how long the fitted measurements must last [s] for moments of inertia without a reservation; below half
      of it, these are not identified. Segments last 1.25 s, and the jackknife compares at least four parts.
    - `prior`: the share of the information about a parameter that its bracket may give without a reservation.
    - `late`: motors that act earlier than they are recorded by more than this are recorded late [s].
    - `sure`, `consistent`: what exceeds chance: so many standard deviations, or a probability below the second.
    """

    share: float = 0.05
    deviations: float = 1.0
    vague: float = 0.1
    unknown: float = 0.4
    seconds: float = 10.0
    prior: float = 0.25
    late: float = 0.005
    sure: float = 3.0
    consistent: float = 1e-3


TOLERANCE = Tolerance()


class Verdict(msgspec.Struct, frozen=True):
    """Whether a quantity can be trusted.

    - `status`: `identified`, `identified with a reservation`, `not identified` or `contradicted`.
    - `value`: of the quantity, with its 95 % interval and its conditions, in words; empty if parameters show it.
    - `reasons`: the reservations, or the causes with their remedies. Empty if the quantity is `identified`.
    """

    status: str
    value: str = ""
    reasons: tuple[str, ...] = ()

    @property
    def trusted(self) -> bool:
        """Whether the quantity is identified, with or without a reservation."""
        return self.status in _TRUSTED


class Quantity(NamedTuple):
    """A quantity before it is judged.

    - `value`: see `Verdict`. `spread`: half of its 95 % interval, as a share of it; 0 if it can be 0.
    - `missing`: why there is no estimate, and what to do; empty if there is one.
    - `reservations`: what is to be known beside the doubts.
    """

    value: str = ""
    spread: float = 0.0
    missing: str = ""
    reservations: tuple[str, ...] = ()


def weights(doubts: Sequence[Doubt], name: str, tolerance: Tolerance = TOLERANCE) -> list[str]:
    """The status that each doubt leaves to a quantity that has this name.

    Reservations of known size add up. If one of them is impossible, and together they exceed what one doubt may move,
    they contradict the quantity: an impossible parameter shows that the model errs, and another doubt by how much.
    """
    alone = [_weight(doubt, name, tolerance) for doubt in doubts]
    reserved = (i for i, status in enumerate(alone) if status == RESERVED)
    sized = {i: move for i in reserved if (move := doubts[i].moves[name]) is not None}
    total = Move(sum(move.share for move in sized.values()), sum(move.deviations for move in sized.values()))
    if all(doubts[i].result == "successful" for i in sized) or _far(total, tolerance) < 2:
        return alone
    return [CONTRADICTED if i in sized else status for i, status in enumerate(alone)]


def _weight(doubt: Doubt, name: str, tolerance: Tolerance) -> str:
    if name not in doubt.moves:
        return IDENTIFIED
    move = doubt.moves[name]
    if move is None:
        return {"successful": RESERVED, "implausible": CONTRADICTED}.get(doubt.result, MISSING)
    worst = RESERVED if doubt.result == "successful" else CONTRADICTED
    return (IDENTIFIED, RESERVED, worst)[_far(move, tolerance)]


def _far(move: Move, tolerance: Tolerance) -> int:
    """The number of the two limits that a move exceeds."""
    return (move.share > tolerance.share) + (move.deviations > tolerance.deviations)


def verdict_of(name: str, quantity: Quantity, doubts: Sequence[Doubt], tolerance: Tolerance = TOLERANCE) -> Verdict:
    """The verdict for a quantity. `doubts`: all of the identification."""
    causes: dict[str, list[str]] = {status: [] for status in STATUSES}
    for doubt, status in zip(doubts, weights(doubts, name, tolerance), strict=True):
        causes[status].append(_reason(doubt, name))
    causes[RESERVED] += quantity.reservations
    if quantity.missing and not causes[MISSING]:
        causes[MISSING].append(quantity.missing)
    motion = {"Ix": "roll", "Iy": "pitch", "Iz": "yaw"}.get(name, "motion")
    known = f"it is known to {quantity.spread:.0%} only; fly more {motion}, or longer"
    if quantity.spread > tolerance.unknown:
        causes[MISSING].append(known)
    elif quantity.spread > tolerance.vague:
        causes[RESERVED].append(known)
    status = next((each for each in STATUSES[:0:-1] if causes[each]), IDENTIFIED)
    return Verdict(status, quantity.value, tuple(causes[status]) if status != IDENTIFIED else ())


def _reason(doubt: Doubt, name: str) -> str:
    """The doubt in words, with how far it moves this quantity, or the inertias if it is this quantity's own."""
    if (move := doubt.moves.get(name)) is not None:
        return f"{doubt.cause} (this would move it by {100 * move.share:.2g} %)"
    moves = {each: doubt.moves.get(each) for each in INERTIAS}
    sizes = [f"{each} by {100 * move.share:.2g} %" for each, move in moves.items() if move is not None]
    return f"{doubt} (this would move {', '.join(sizes)})" if sizes else str(doubt)


def headline(verdicts: dict[str, Verdict], doubts: Sequence[Doubt]) -> list[str]:
    """The quantities by their status, then each reason with the quantities that it concerns, then mere notes."""
    return [*statuses(verdicts), *reasons(verdicts, doubts)]


def statuses(verdicts: dict[str, Verdict], tabled: Collection[str] = ()) -> list[str]:
    """The quantities by their status. `tabled`: those whose value stands in a table, and not here."""
    lines = []
    for status in STATUSES:
        shown = {name: verdict for name, verdict in verdicts.items() if verdict.status == status}
        said = [
            f"{name} {verdict.value}".strip() if verdict.trusted and name not in tabled else name
            for name, verdict in shown.items()
        ]
        lines += [f"{status}: {(', ' if tabled else '; ').join(said)}."] * bool(said)
    return lines


def reasons(verdicts: dict[str, Verdict], doubts: Sequence[Doubt]) -> list[str]:
    """Each reason with the quantities that it concerns, then mere notes."""
    concerned: dict[str, list[str]] = {}
    for status in STATUSES:
        for name, verdict in verdicts.items():
            for reason in verdict.reasons if verdict.status == status else ():
                concerned.setdefault(reason, []).append(name)
    every = [weights(doubts, name) for name in verdicts]
    notes = [doubt for i, doubt in enumerate(doubts) if all(own[i] == IDENTIFIED for own in every)]
    return [
        *(f"{', '.join(names)}: {reason}." for reason, names in concerned.items()),
        *(f"note: {doubt}. It moves nothing." for doubt in notes if verdicts),
    ]


def outcome(search: str, required: Sequence[str], verdicts: dict[str, Verdict], doubts: Sequence[Doubt]) -> str:
    """The name of the result code: `"successful"` if all required quantities can be trusted.

    Otherwise that of the first doubt that refuses one of them; `search`, of the search, if it has no answer.
    """
    refused = [name for name in required if not verdicts[name].trusted]
    if not refused:
        return "successful"
    decisive = {i for name in refused for i, status in enumerate(weights(doubts, name)) if status not in _TRUSTED}
    # A reservation that contradicts together with another decides nothing by itself.
    decided = (doubts[i].result for i in sorted(decisive) if doubts[i].result != "successful")
    return next(decided, search if search != "successful" else "unidentifiable")
