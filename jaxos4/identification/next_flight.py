"""Advice for the next flight: which motion to fly and how long, or the remedy, for each poorly known quantity."""

import math
from collections.abc import Mapping, Sequence

from ..airframe import AXES, INERTIAS
from ..errors import percent
from .results import Identification
from .verdict import IDENTIFIED, RESERVED, UNCERTAIN, pooled_status

_ROUND = 5.0  # s; flights are not planned more precisely
_MOST = 300.0  # s, about one battery: beyond it a stronger motion is the better advice
_REPEAT = "nothing is missing; repeat the flight and compare the results with `jaxos4 compare`"


def next_flight(results: Sequence[Identification], spreads: Mapping[str, float]) -> str:
    """Advice for the next flight, in one line, for one result or for the mean of several.

    `spreads`: the relative half-width of the 95 % interval of each moment of inertia. Reservations about a vehicle's
    other quantities are no reason to fly.
    """
    counted = {
        name: [each for each in results if name in each.verdicts and each.verdicts[name].status == status]
        for name, status in pooled_statuses(results).items()
        if status != IDENTIFIED and (name in INERTIAS or status != RESERVED or not results[0].is_vehicle)
    }
    motions, known, flown, advised = [], [], set(), {}
    for axis in AXES:
        spread, fitted = spreads.get(axis.inertia, 0.0), counted.get(axis.inertia, [])
        helps = any(each.verdicts[axis.inertia].flying_helps for each in fitted)
        if helps and UNCERTAIN < spread < math.inf:
            every = (each.provenance.fitted_seconds for each in fitted)
            motions.append(_more(axis.motion, spread, sum(x for x in every if isinstance(x, float))))
            flown.add(f"fly more {axis.motion}")
            known.append(f"{axis.inertia} {percent(spread, 3)}")
    if motions:
        advised[f"fly {', '.join(motions)}"] = [f"known now: {', '.join(known)}; needed: {100 * UNCERTAIN:.0f} %"]
    for name, own in counted.items():
        remedies = dict.fromkeys(remedy for each in own for remedy in each.verdicts[name].remedies)
        # "fly more roll, or ..." adds nothing to how much more roll to fly.
        for remedy in (each for each in remedies if each.split(",")[0] not in flown):
            # A remedy that begins another one adds nothing to it.
            same = next((each for each in advised if each.startswith(remedy)), remedy)
            advised.setdefault(same, []).append(name)
    said = "; ".join(f"{advice} ({', '.join(names)})" for advice, names in advised.items())
    return f"{said or (_REPEAT if len(results) == 1 else 'nothing is missing')}."


def pooled_statuses(results: Sequence[Identification]) -> dict[str, str]:
    """The status of each quantity that any of the results judges; see `pooled_status`."""
    names = dict.fromkeys(name for each in results for name in each.verdicts)
    return {
        name: pooled_status(each.verdicts[name].status for each in results if name in each.verdicts) for name in names
    }


def spreads_of(found: Identification) -> dict[str, float]:
    """The relative half-width of the 95 % interval of each moment of inertia of a result."""
    constants = found.rigid_body.constants if found.is_vehicle else {}
    return {name: row.margin / abs(row.estimate) for name, row in constants.items() if row.estimate}


def _more(motion: str, spread: float, seconds: float) -> str:
    """How much more of a motion to fly: intervals shrink with the root of the time and with the amplitude.

    `seconds`: duration of the data fitted so far [s].
    """
    lacking = (spread / UNCERTAIN) ** 2 - 1  # missing information, in multiples of the flights' so far
    if not seconds:
        return f"more {motion}"
    if seconds * lacking <= _MOST:
        return f"{_ROUND * math.ceil(seconds * lacking / _ROUND):.0f} s more {motion}"
    return f"{motion} as long as before but {lacking**0.5:.2g} times as strong"
