"""The quantities that get a verdict: of a vehicle, and of an OS4."""

from collections.abc import Iterator, Sequence

import numpy as np

from ..recording.checks import Finding
from ..results import NINETY_FIVE
from .answers import AXES, INVERSE, Answer
from .results import Constant, ParameterEstimate, PredictionSkill, RigidBody
from .uncertainty import PRIOR_NOTE
from .verdict import PREDICTIONS, RIGID_BODY, TOLERANCE, Doubt, Quantity

# Notes about a parameter that are reservations, and how they read there.
_READ = {
    "came out negative": "came out negative, which is impossible",
    "outside its bracket": "is outside its bracket; check the airframe, or give a wider `bracket`",
}
_BELOW_ONE = ("alpha1", "alpha4", "alpha7")


def vehicle_quantities(
    answer: Answer,
    table: dict[str, ParameterEstimate],
    constants: dict[str, Constant],
    skill: PredictionSkill | None,
    still: Sequence[str],
) -> dict[str, Quantity]:
    """Moments of inertia, the quantities of the terms, and predictions.

    **Arguments:** `table` and `constants` of the answer, and the `skill` about all axes but those that stand `still`.
    """
    model, own, found = answer.problem.model, answer.problem.unknowns, {}
    shares = dict(zip(own.names, np.square(answer.bound / np.asarray(own.half_width)).tolist(), strict=True))
    for (name, place), axis in zip(INVERSE.items(), AXES.values(), strict=True):
        row, alpha = constants.get(name), model.parameter_names[place]
        if row is None:
            found[name] = Quantity(missing=f"the flights say too little about {alpha}; fly more {axis}")
        else:
            found[name] = Quantity(
                _interval(row), NINETY_FIVE * row.std / row.estimate, "", _notes({alpha: table[alpha]}, shares)
            )
    for quantity, names in model.quantities.items():
        unseen = [name for name in names if name in answer.fixed and answer.fixed[name].note == PRIOR_NOTE]
        which = f"the flights say less about {', '.join(unseen)} than the bracket; fly with more motion"
        rows = {name: table[name] for name in names if name in table}
        reservations = ((which,) if unseen else ()) + _notes(rows, shares)
        found[quantity] = Quantity("", 0.0, "" if rows else which, reservations)
    return found | {PREDICTIONS: prediction_horizons(skill, still)}


def _interval(row: Constant) -> str:
    condition = f", {row.note}" if row.note else ""
    return f"{row.estimate:.4g} +- {NINETY_FIVE * row.std:.2g} {row.unit} (95 %){condition}"


def _notes(rows: dict[str, ParameterEstimate], shares: dict[str, float]) -> tuple[str, ...]:
    """Notes on parameters that rest on a bracket, lie outside it, or are at their limit."""
    found = [f"{name} {said}" for name, row in rows.items() for note, said in _READ.items() if note in row.note]
    for name in rows:
        if shares[name] > TOLERANCE.prior:
            found.append(f"{name} rests on its bracket for {shares[name]:.0%}")
    return tuple(found)


def prediction_horizons(skill: PredictionSkill | None, still: Sequence[str]) -> Quantity:
    """The horizon up to which predictions beat constant rates by a standard error, about each axis that moves."""
    if skill is None:
        return Quantity(missing="nothing was held out; give `holdout` or `validate`")
    reach = {axis: 0.0 for axis in AXES.values() if axis not in still}
    for rate, axis in AXES.items():
        own = getattr(skill, rate)
        for horizon, value, std in zip(skill.horizons, own.skill, own.std, strict=True):
            if axis not in reach or (value is not None and value <= (std or 0.0)):
                break
            reach[axis] = horizon if value is not None else reach[axis]
    unseen = (f"{' and '.join(still)} cannot be checked",) if still else ()
    ahead = ", ".join(f"{axis} {seconds:.2g} s" for axis, seconds in reach.items())
    return Quantity(f"better than constant rates up to {ahead} ahead" * bool(reach), reservations=unseen)


def flight_quantities(table: dict[str, ParameterEstimate], body: RigidBody) -> dict[str, Quantity]:
    """The alphas of an OS4, and its rigid body."""
    found = {}
    for name, row in table.items():
        if row.estimate is None:
            found[name] = Quantity(missing=row.note)
            continue
        found[name] = Quantity(reservations=tuple(filter(None, row.note.split("; "))))
    found[RIGID_BODY] = Quantity(missing="" if body.constants else "the alphas are not known well enough")
    return found


def doubts_of_flight(
    table: dict[str, ParameterEstimate], body: RigidBody, findings: Sequence[Finding]
) -> Iterator[Doubt]:
    """The doubts about the alphas of an OS4."""
    every = dict.fromkeys((*table, RIGID_BODY))
    for finding in findings:
        yield Doubt("implausible", f"{finding.cause} ({finding.size})", finding.remedy, every)
    gyro = "check the scale, the axes and the signs of the gyro, and the time stamps"
    for name in _BELOW_ONE:
        row = table[name]
        if row.estimate is not None and row.std is not None and abs(row.estimate) - TOLERANCE.sure * row.std > 1:
            cause = f"{name} = {row.estimate:.3g} is not between -1 and 1, as that of every rigid body"
            yield Doubt("implausible", cause, gyro, {name: None, RIGID_BODY: None})
    rotor = body.constants.get("J_R")
    if rotor is not None and rotor.estimate + TOLERANCE.sure * rotor.std < 0:
        cause = f"J_R = {rotor.estimate:.3g} kg m^2 is negative"
        yield Doubt("implausible", cause, "check `rotor_spins`, and which rotor is which", {RIGID_BODY: None})
    if body.consistency_p is not None and body.consistency_p < TOLERANCE.consistent:
        cause = f"the alphas are not those of one rigid body (p = {body.consistency_p:.1g})"
        yield Doubt("implausible", cause, f"{gyro}; or use another `subject`", {RIGID_BODY: None})
    elif body.is_rigid_body is False:
        cause = "one moment of inertia exceeds the sum of the other two, which no rigid body allows"
        yield Doubt("implausible", cause, "check `rotor_positions` and `drag_coefficient`", {RIGID_BODY: None})
