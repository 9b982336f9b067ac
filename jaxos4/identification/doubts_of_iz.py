"""Doubts about Iz, which rests on the yaw torque of the rotors: a drag coefficient that few people measure."""

import math
from collections.abc import Iterator, Mapping

from ..airframe import PITCH, ROLL, YAW
from .answers import Answer, drag_error, thrust_excess
from .results import Constant, ParameterEstimate
from .verdict import MAX_PRIOR, SIGNIFICANT, Doubt, Move, refusal, reservation

_FLAT = 0.6  # Iz over Ix + Iy of a vehicle with its rotors in a plane is rarely smaller; of a lamina it is 1
MEASURE = "measure the yaw torque of a rotor, or swing the vehicle as a pendulum"
_REACTION = "rotor_reaction"


def doubts_of_iz(
    answer: Answer, table: Mapping[str, ParameterEstimate], constants: Mapping[str, Constant]
) -> Iterator[Doubt]:
    """The doubts about Iz. `table`: of the parameters. `constants`: the moments of inertia that are judged."""
    if YAW.inertia in constants:
        yield from _drag(answer)
        # All of these would be one fault: a wrong drag coefficient.
        signs = [*_flat(constants), *_rotor_inertia(table, constants[YAW.inertia])]
        yield from sorted(signs, key=lambda doubt: doubt.share_of(YAW.inertia))[-1:]


def _drag(answer: Answer) -> Iterator[Doubt]:
    """A ratio of drag to thrust that nobody measured: Iz is proportional to it."""
    excess, moves = thrust_excess(answer), {YAW.inertia: None}
    if answer.problem.model.airframe.guesses_drag:
        yield refusal("unidentifiable", "`drag_coefficient` is a guess, to which Iz is proportional", MEASURE, moves)
    elif drag_error(answer):
        cause = (
            f"the rotors give {100 * abs(excess):.0f} % {'more' if excess > 0 else 'less'} thrust than the airframe "
            "says, so that the ratio of drag to thrust, to which Iz is proportional, may be off as much"
        )
        yield refusal("unidentifiable", cause, MEASURE, moves)


def _flat(constants: Mapping[str, Constant]) -> Iterator[Doubt]:
    """An Iz that is too small beside Ix + Iy for a flat vehicle."""
    if not {ROLL.inertia, PITCH.inertia} <= constants.keys():
        return
    x, y, z = (constants[axis.inertia] for axis in (ROLL, PITCH, YAW))
    least, error = _FLAT * (x.estimate + y.estimate), math.hypot(z.std, _FLAT * x.std, _FLAT * y.std)
    if least - z.estimate > SIGNIFICANT * error:
        share = z.estimate / (x.estimate + y.estimate)
        yield reservation(
            f"Iz is only {share:.2g} times Ix + Iy; of a flat vehicle it is {_FLAT:g} to 1 times",
            f"if `drag_coefficient` is uncertain, {MEASURE}",
            {YAW.inertia: Move(least / z.estimate - 1, (least - z.estimate) / z.std)},
        )


def _rotor_inertia(table: Mapping[str, ParameterEstimate], iz: Constant) -> Iterator[Doubt]:
    """The moments of inertia of a rotor by its reaction in yaw and by its gyroscopic torque in roll and pitch.

    With the reaction J_R / Iz, and alpha2 = J_R / Ix beside alpha3 = 1 / Ix, the two agree if Iz is right.
    """
    by_yaw = _quotient(table, _REACTION, YAW.inverse)
    for gyroscopic, axis in (("alpha2", ROLL), ("alpha5", PITCH)):
        by_axis = _quotient(table, gyroscopic, axis.inverse)
        if by_yaw is None or by_axis is None:
            continue
        off = by_axis[0] - by_yaw[0]
        if abs(off) > SIGNIFICANT * math.hypot(by_axis[1], by_yaw[1]):
            yield reservation(
                f"by {axis.motion}, the inertia of the rotors is {by_axis[0] / by_yaw[0]:.2g} times that by their "
                "reaction in yaw",
                f"fly more yaw; if `drag_coefficient` is uncertain, {MEASURE}",
                {YAW.inertia: Move(abs(off) / by_yaw[0], abs(off) / by_yaw[0] * iz.estimate / iz.std)},
            )


def _quotient(table: Mapping[str, ParameterEstimate], name: str, inverse: str) -> tuple[float, float] | None:
    """One parameter over another, if both are positive and no bracket gives more than a share of what is known."""
    rows = [table.get(name), table.get(inverse)]
    values, squares = [], 0.0
    for row in rows:
        if row is None or not row.estimate or row.estimate <= 0 or not row.std or not isinstance(row.bracket, tuple):
            return None
        if (row.std / (row.bracket[1] - row.bracket[0]) * 2) ** 2 > MAX_PRIOR:
            return None
        values.append(row.estimate)
        squares += (row.std / row.estimate) ** 2
    ratio = values[0] / values[1]
    return ratio, ratio * math.sqrt(squares)
