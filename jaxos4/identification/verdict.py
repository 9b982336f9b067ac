"""A verdict for each quantity: whether it can be trusted, and if not, the reasons.

An issue counts against a quantity by how far the quantity would move if the issue were true.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import msgspec

from ..airframe import INERTIAS
from ..errors import percent

IDENTIFIED = "identified"
RESERVED = "identified with a reservation"
MISSING = "not identified"
CONTRADICTED = "contradicted"
STATUSES = (IDENTIFIED, RESERVED, MISSING, CONTRADICTED)
"""From the best to the worst."""
_TRUSTED = (IDENTIFIED, RESERVED)
ADVICE = {
    IDENTIFIED: "identified",
    RESERVED: "use with care",
    MISSING: "refused (not identified)",
    CONTRADICTED: "refused (contradicted)",
}
"""Whether to use a quantity, by its status, in words."""

PREDICTIONS, RIGID_BODY = "predictions", "rigid body"
RESERVATION, CONTRADICTION = "successful", "implausible"
"""Severities of an issue: the result code that an estimate gets by it. A reservation refuses nothing: `successful`."""


# An issue that moves a quantity by more than this share *and* by more than these standard deviations contradicts it. If
# it exceeds only one of the limits, it makes a reservation; if neither, it is a note. A `RESERVATION` contradicts only
# if the quantity moves by more than its own size. Errors of discretisation reach 3 %. Moves add up.
MAX_SHARE, MAX_DEVIATIONS = 0.05, 1.0
# Relative half-widths of a 95 % interval above which a moment of inertia has a reservation, or is not identified. With
# intervals of 10 % and less, 1 answer in 160 is off by more than 12 %.
UNCERTAIN, TOO_UNCERTAIN = 0.1, 0.4
MAX_PRIOR = 0.25  # share of the information about a parameter that its bracket may give without a reservation
UNUSUAL = 2.0  # times the width of a prior's bracket; 5 % of usual values are outside
SIGNIFICANT = 3.0  # standard deviations that exceed chance
IMPROBABLE = 1e-3  # a smaller probability exceeds chance


class Move(msgspec.Struct, frozen=True):
    """The change of a quantity if an issue were true.

    - `share`: relative to the quantity; for parameters, which can be 0, relative to the half-width of their bracket.
    - `deviations`: the same in standard deviations of the estimate.
    """

    share: float
    deviations: float

    @property
    def limits_exceeded(self) -> int:
        """How many of the two limits the change exceeds."""
        return (self.share > MAX_SHARE) + (self.deviations > MAX_DEVIATIONS)


Moves = Mapping[str, Move | None]
"""How far each quantity would move, by name; `None`: unknown."""


class Issue(msgspec.Struct, frozen=True):
    """Evidence against an estimate, or against a part of it.

    - `severity`: `CONTRADICTION` by physics, the airframe or the data; `RESERVATION`, which refuses nothing; or the
      name of another result code, if the flights or the search do not determine the quantities.
    - `cause`, `remedy`: what is wrong, and what to do.
    - `moves`: the quantities that it concerns, and how far they would move if the issue were true.
    """

    severity: str = msgspec.field(name="result")
    cause: str
    remedy: str
    moves: Moves = {}

    def __post_init__(self) -> None:
        msgspec.structs.force_setattr(self, "moves", dict(self.moves))  # a copy

    def __str__(self) -> str:
        return f"{self.cause}; {self.remedy}"

    @property
    def status(self) -> str:
        """The status of a quantity with this issue, if it is unknown how far the quantity would move."""
        return {RESERVATION: RESERVED, CONTRADICTION: CONTRADICTED}.get(self.severity, MISSING)

    @property
    def warning(self) -> str:
        """Whether the estimate can be used in spite of the issue, and the issue; one line."""
        refused = [name for name in self.moves if self.status_allowed(name) not in _TRUSTED]
        if refused:
            return f"{', '.join(refused)}: not to be trusted because {self}"
        if self.moves or self.severity == RESERVATION:
            return f"use with care: {self}"
        return f"not to be trusted because {self}"

    def share_of(self, name: str) -> float:
        """The share by which the quantity of this name would move; 0 if unknown."""
        return 0.0 if (move := self.moves.get(name)) is None else move.share

    def status_allowed(self, name: str) -> str:
        """The status of the quantity of this name if this were the only issue."""
        if name not in self.moves:
            return IDENTIFIED
        if (move := self.moves[name]) is None:
            return self.status
        # Nobody can use a value that may be off by more than itself.
        worst = RESERVED if self.severity == RESERVATION and move.share <= 1 else CONTRADICTED
        return (IDENTIFIED, RESERVED, worst)[move.limits_exceeded]


class Verdict(msgspec.Struct, frozen=True):
    """Whether a quantity can be trusted.

    - `status`: `identified`, `identified with a reservation`, `not identified` or `contradicted`.
    - `value`: the quantity's value, 95 % interval and conditions, in words; empty for quantities
      that consist of parameters, whose table shows them.
    - `reasons`: the reservations, or the causes with their remedies; without a remedy if the size of the move is known:
      `next_flight` gives it, unless a vehicle's quantity other than an inertia has a reservation only. Empty if the
      quantity is `identified`.
    - `remedies`: what to do about these reasons, except those for a long interval.
    - `flying_helps`: whether a long interval calls for more flight, not for a measured drag coefficient.
    """

    status: str
    value: str = ""
    reasons: tuple[str, ...] = ()
    remedies: tuple[str, ...] = ()
    flying_helps: bool = True

    @property
    def trusted(self) -> bool:
        """Whether the quantity is identified, with or without a reservation."""
        return self.status in _TRUSTED


class Reason(NamedTuple):
    """Why a quantity has a reservation or is refused.

    - `words`: the cause, and the remedy if there is one. `remedy`: what to do; empty if nothing can be done.
    """

    words: str
    remedy: str = ""

    @classmethod
    def of(cls, cause: str, remedy: str) -> "Reason":
        """The reason with this cause and remedy."""
        return cls(f"{cause}; {remedy}", remedy)


class Quantity(NamedTuple):
    """A quantity before it is judged.

    - `value`: see `Verdict`. `spread`: relative half-width of the 95 % interval; 0 if the quantity can be 0.
    - `missing`: why there is no estimate; `None` if there is one.
    - `reservations`: caveats that are not issues.
    - `remedy`: what to do if the interval is too long. `flying_helps`: see `Verdict`.
    - `requires`: the quantities that must be trusted too.
    """

    value: str = ""
    spread: float = 0.0
    missing: Reason | None = None
    reservations: tuple[Reason, ...] = ()
    remedy: str = "fly more, or longer"
    flying_helps: bool = True
    requires: tuple[str, ...] = ()


def verdicts_of(quantities: Mapping[str, Quantity], issues: Sequence[Issue]) -> dict[str, Verdict]:
    """The verdict for each quantity. `issues`: all issues of the identification."""
    verdicts = {}
    for name, quantity in quantities.items():
        causes: dict[str, list[Reason]] = {status: [] for status in STATUSES}
        for issue, status in zip(issues, _statuses_allowed(issues, name), strict=True):
            causes[status].append(Reason(_in_words(issue, name), issue.remedy))
        causes[RESERVED] += quantity.reservations
        if quantity.missing is not None and not causes[MISSING]:
            causes[MISSING].append(quantity.missing)
        known = Reason(f"it is known to {100 * quantity.spread:.0f} % only; {quantity.remedy}")
        if quantity.spread > TOO_UNCERTAIN:
            causes[MISSING].append(known)
        elif quantity.spread > UNCERTAIN:
            causes[RESERVED].append(known)
        status = next((each for each in reversed(STATUSES[1:]) if causes[each]), IDENTIFIED)
        counted = causes[status] if status != IDENTIFIED else []
        verdicts[name] = Verdict(
            status,
            quantity.value,
            reasons=tuple(each.words for each in counted),
            remedies=tuple(dict.fromkeys(each.remedy for each in counted if each.remedy)),
            flying_helps=quantity.flying_helps,
        )
    for name, quantity in quantities.items():
        lacking = [each for each in quantity.requires if each in verdicts and not verdicts[each].trusted]
        if lacking and verdicts[name].trusted:
            why = f"it cannot be trusted without {' and '.join(lacking)}"
            verdicts[name] = Verdict(MISSING, quantity.value, (why,))
    return verdicts


def result_of(verdicts: Mapping[str, Verdict], issues: Sequence[Issue], search: str, required: Iterable[str]) -> str:
    """The name of the result code: `"successful"` if all required quantities can be trusted.

    Otherwise the code of the first issue that refuses one of them. If there is no such issue, the code of the `search`,
    or `"unidentifiable"` if the search was successful.
    """
    refused = [name for name in required if not verdicts[name].trusted]
    if not refused:
        return "successful"
    left = {name: _statuses_allowed(issues, name) for name in refused}
    for place, issue in enumerate(issues):
        for name in (each for each in refused if left[each][place] not in _TRUSTED):
            if issue.severity != RESERVATION:
                return issue.severity
            # A reservation that contradicts only together with another issue does not decide the code.
            if issue.status_allowed(name) not in _TRUSTED:
                return CONTRADICTION
    return search if search != "successful" else "unidentifiable"


def _statuses_allowed(issues: Sequence[Issue], name: str) -> list[str]:
    """The status that each issue leaves to the quantity of this name.

    Issues of known size add up. If one of them is more severe than a reservation, such as an impossible parameter, and
    their sum exceeds both limits, they contradict the quantity: that one shows that the model is wrong, the others show
    by how much.
    """
    alone = [issue.status_allowed(name) for issue in issues]
    reserved = (i for i, status in enumerate(alone) if status == RESERVED)
    sized = {i: move for i in reserved if (move := issues[i].moves[name]) is not None}
    total = Move(sum(move.share for move in sized.values()), sum(move.deviations for move in sized.values()))
    if all(issues[i].severity == RESERVATION for i in sized) or total.limits_exceeded < 2:
        return alone
    return [CONTRADICTED if i in sized else status for i, status in enumerate(alone)]


def _in_words(issue: Issue, name: str) -> str:
    """The issue in words, and how far it moves this quantity, or else the inertias."""
    if (move := issue.moves.get(name)) is not None:
        return f"{issue.cause} (this would move it by {percent(move.share)})"
    moves = {each: issue.moves.get(each) for each in INERTIAS}
    sizes = [f"{each} by {percent(move.share)}" for each, move in moves.items() if move is not None]
    return f"{issue} (this would move {', '.join(sizes)})" if sizes else str(issue)


def headline(statuses: Mapping[str, str]) -> dict[str, str]:
    """Whether to use the quantities of each status that occurs, in one sentence, from the best status to the worst.

    Terminal, page, notebook and comparison all begin with these sentences. `statuses`: by quantity.
    """
    named = {status: [name for name, own in statuses.items() if own == status] for status in STATUSES}
    return {status: f"{', '.join(names)}: {ADVICE[status]}." for status, names in named.items() if names}


def statuses_of(verdicts: Mapping[str, Verdict]) -> dict[str, str]:
    """The status of each quantity."""
    return {name: verdict.status for name, verdict in verdicts.items()}


def pooled_status(statuses: Iterable[str]) -> str:
    """The status of the mean of several results: the worst of the trusted results, or of all if none is trusted."""
    given = list(statuses)
    return max([each for each in given if each in _TRUSTED] or given, key=STATUSES.index)


def reason_lines(verdicts: dict[str, Verdict], issues: Sequence[Issue]) -> list[str]:
    """How far predictions reach; each reason with the quantities that it concerns; then mere notes."""
    concerned: dict[str, list[str]] = {}
    for status in STATUSES:
        for name, verdict in verdicts.items():
            for reason in verdict.reasons if verdict.status == status else ():
                concerned.setdefault(reason, []).append(name)
    notes = [issue for issue in issues if all(issue.status_allowed(name) == IDENTIFIED for name in verdicts)]
    predicted = verdicts.get(PREDICTIONS)
    return [
        *([f"{PREDICTIONS}: {predicted.value}."] if predicted is not None and predicted.trusted else []),
        *(f"{', '.join(names)}: {reason}." for reason, names in concerned.items()),
        *(f"note: {issue}. It affects no quantity." for issue in notes if verdicts),
    ]
