"""The quantities of a vehicle and of an OS4 that get a verdict."""

from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np

from ..airframe import AXES, YAW
from ..models.abstract import PARAMETER_NAMES
from ..models.terms import SAG, VOLTAGE_EXPONENT
from ..results import NINETY_FIVE
from .answers import Answer, drag_error
from .intervals import PRIOR_NOTE
from .issues_of_values import MEASURE
from .results import OS4Identification, ParameterEstimate, PredictionSkill, VehicleIdentification
from .verdict import MAX_PRIOR, PREDICTIONS, RIGID_BODY, UNUSUAL, Quantity, Reason

_MORE_MOTION = "fly with more motion"


def vehicle_quantities(answer: Answer, found: VehicleIdentification, still: Sequence[str]) -> dict[str, Quantity]:
    """Moments of inertia, the quantities of the terms, and predictions.

    `found`: the answer's parameters, moments of inertia and skill. `still`: axes without predictions.
    """
    model, own, quantities = answer.problem.model, answer.problem.unknowns, dict[str, Quantity]()
    table, constants = found.parameters, found.rigid_body.constants
    shares = dict(zip(own.names, np.square(answer.bound / np.asarray(own.half_width)).tolist(), strict=True))
    half_widths = dict(zip(own.names, np.asarray(own.half_width).tolist(), strict=True))
    for axis in AXES:
        row, alpha = constants.get(axis.inertia), axis.inverse
        if row is None:
            said = Reason.of(f"the flights say too little about {alpha}", f"fly more {axis.motion}")
            quantities[axis.inertia] = Quantity(missing=said)
        else:
            condition = f", {row.note}" if row.note else ""
            value = f"{row.estimate:.4g} +- {row.margin:.2g} {row.unit} (95 %){condition}"
            notes = _notes(answer, {alpha: table[alpha]}, shares)
            remedy, flying_helps = f"fly more {axis.motion}, or longer", axis != YAW or not drag_error(answer)
            if not flying_helps:
                remedy = MEASURE
            elif shares.get(SAG, 0.0) > MAX_PRIOR and VOLTAGE_EXPONENT not in own.names:
                remedy = f"log rotor speeds, or the battery's voltage at 10 Hz or more, or {remedy}"
            quantities[axis.inertia] = Quantity(
                value, row.margin / row.estimate, reservations=notes, remedy=remedy, flying_helps=flying_helps
            )
    for quantity, names in model.quantities.items():
        unseen = [name for name in names if name in answer.fixed and answer.fixed[name].note == PRIOR_NOTE]
        which = Reason.of(f"the flights say less about {', '.join(unseen)} than the bracket", _MORE_MOTION)
        rows = {name: table[name] for name in names if name in table}
        reservations = ((which,) if unseen else ()) + _notes(answer, rows, shares)
        wide = tuple(_too_wide(rows, half_widths))
        missing = which if not rows else None
        if rows and len(wide) == len(rows):
            missing = Reason("; ".join(each.words for each in wide), _MORE_MOTION)
        axes = {axis.inertia for axis in AXES for name in names if name.startswith(axis.motion) and axis != YAW}
        quantities[quantity] = Quantity("", 0.0, missing, (*reservations, *wide), requires=tuple(sorted(axes)))
    return quantities | {PREDICTIONS: prediction_horizons(found.skill, still)}


def _too_wide(rows: dict[str, ParameterEstimate], half_widths: dict[str, float]) -> Iterator[Reason]:
    """The parameters whose 95 % intervals are wider than their brackets."""
    for name, row in rows.items():
        if row.std is not None and NINETY_FIVE * row.std > half_widths[name]:
            unit = "" if row.unit == "1" else f" {row.unit}"
            yield Reason.of(f"{name} is known to +-{NINETY_FIVE * row.std:.2g}{unit} only", _MORE_MOTION)


def _notes(answer: Answer, rows: dict[str, ParameterEstimate], shares: dict[str, float]) -> tuple[Reason, ...]:
    """Notes on parameters that rest on a bracket, lie outside it, or are at their limit."""
    parameters, guessed = answer.problem.model.parameters, {axis.inverse: axis.inertia for axis in AXES}
    found, of_airframe = [], {each.name for each in parameters if each.scales_torque or callable(each.center)}
    for name, row in rows.items():
        if name in guessed and row.estimate is not None and answer.thrust > 0:
            # An inertia is compared at the airframe's thrust.
            row = msgspec.structs.replace(row, estimate=row.estimate / answer.thrust)
        if name in answer.negative:
            found.append(Reason(f"{name} is negative, which is impossible; it is 0 here"))
        elif row.is_outside_bracket() and name in guessed and row.estimate and isinstance(row.bracket, tuple):
            ratio = sum(row.bracket) / 2 / row.estimate
            check = (
                "measure `drag_coefficient`" if guessed[name] == YAW.inertia else "check `mass` and `rotor_positions`"
            )
            cause = f"{guessed[name]} is {ratio:.2g} times the guess"
            found.append(Reason.of(cause, f"{check}, or give a wider `bracket`"))
        elif row.is_outside_bracket(1.0 if (given := name in (*PARAMETER_NAMES, *of_airframe)) else UNUSUAL):
            # Only an airframe that has such a constant can be wrong about it.
            check = "check the airframe, or " if given else ""
            found.append(Reason.of(f"{name} is outside its bracket", f"{check}give a wider `bracket`"))
    resting = (name for name in rows if shares[name] > MAX_PRIOR)
    return *found, *(
        Reason(f"{100 * shares[name]:.0f} % of the information about {name} comes from its bracket") for name in resting
    )


def prediction_horizons(skill: PredictionSkill | None, still: Sequence[str]) -> Quantity:
    """The horizon up to which predictions beat constant rates by a standard error, about each axis that moves."""
    if skill is None:
        return Quantity(missing=Reason.of("nothing was held out", "give `holdout` or `validate`"))
    ahead, poor = [], []
    for axis in (each for each in AXES if each.motion not in still):
        own, longest = getattr(skill, axis.rate), 0.0
        for horizon, value, std in zip(skill.horizons, own.skill, own.std, strict=True):
            if value is not None and value <= (std or 0.0):
                break
            longest = horizon if value is not None else longest
        if longest:
            ahead.append(f"{axis.motion} {longest:.2g} s")
        else:
            poor.append(axis.motion)
    unseen = " and ".join(still)
    if poor and not ahead:
        motions = " and ".join(poor)
        cause = f"{motions} cannot be predicted better than by constant rates"
        return Quantity(missing=Reason.of(cause, f"fly more {motions}"))
    reach = f"better than constant rates up to {', '.join(ahead)} ahead" if ahead else ""
    worse = f"; no better for {' and '.join(poor)}" if poor else ""
    unchecked = (Reason.of(f"{unseen} cannot be checked", f"fly more {unseen}"),) if still else ()
    return Quantity(reach + worse, reservations=unchecked)


def os4_quantities(found: OS4Identification, notes: Mapping[str, Sequence[str]]) -> dict[str, Quantity]:
    """The alphas of an OS4, and its rigid body. `notes`: the warnings about each alpha that has an estimate."""
    quantities, remedy = {}, "fly what `jaxos4 design` proposes"
    for name, row in found.parameters.items():
        if row.estimate is None:
            quantities[name] = Quantity(missing=Reason(row.note, remedy))
        else:
            quantities[name] = Quantity(reservations=tuple(map(Reason, notes[name])))
    unknown = None if found.rigid_body.constants else Reason("the alphas are not known well enough", remedy)
    return quantities | {RIGID_BODY: Quantity(missing=unknown)}
