"""One identified vehicle as one HTML page that needs no other file: `jaxos4 estimate --report`."""

import json
import os
from typing import Any, NamedTuple

import numpy as np

from .._files import check_writable, write_atomically
from ..analysis.frequency_response import FrequencyResponse
from ..analysis.prediction import Predictions
from ..identification.results import Constant, PredictionSkill, RateSkill, VehicleIdentification
from ..results import NINETY_FIVE
from .figures_prediction import BAND, predicted_rates
from .figures_response import frequency_responses
from .inline import Drawing, drawings
from .numbers import MISSING, plain
from .page import environment
from .style import Style, drawing, styles, svg

# The horizon that the page shows first [s], and the digits of its estimates.
_SHOWN, _DIGITS = 0.25, 4
# The page shows these entries of the provenance in a place of their own.
_APART = ("command", "notes")


class ParameterRow(NamedTuple):
    """A row of the table of parameters, as text."""

    name: str
    unit: str
    estimate: str
    interval: str = ""
    bound: str = ""
    note: str = ""
    held: bool = False


def write_flight_page(path: str | os.PathLike[str], found: VehicleIdentification, *, title: str) -> None:
    """Writes the page of an identified vehicle, completely or not at all. Raises `OSError` if it cannot be written."""
    check_writable(path)
    text = _page(found, title)
    with write_atomically(path) as beside:
        beside.write_text(text, encoding="utf-8")


def _page(found: VehicleIdentification, title: str) -> str:
    body, provenance = found.rigid_body, found.provenance
    look = styles([found.estimator])[found.estimator]
    return (
        environment()
        .get_template("flight.html.j2")
        .render(
            title=title,
            about=_about(found),
            doubts=[str(doubt) for doubt in found.doubts],
            disturbances=[
                (name, row.unit, _number(row.strength, 2), _number(row.time_constant, 2), _number(row.sensor, 2))
                for name, row in found.disturbances.items()
            ],
            widened=", ".join(f"{name} {factor:.1f}" for name, factor in found.widened.items()),
            parameters=_parameters(found),
            constants=[_constant(name, row) for name, row in body.constants.items()],
            consistency="" if body.consistency_p is None else plain(body.consistency_p, 2),
            skill=[] if found.skill is None else _skill(found.skill),
            starts=None if found.skill is None else found.skill.starts,
            drawings=() if found.predictions is None else _drawn(found.predictions, provenance["sample_time"], look),
            band=f"{100 * BAND:g}",
            responses=() if found.response is None else _responses(found.response, look),
            command=provenance.get("command", ""),
            notes=provenance.get("notes", ()),
            provenance=[(name.replace("_", " "), _text(x)) for name, x in provenance.items() if name not in _APART],
        )
    )


def _drawn(predicted: Predictions, sample_time: float, look: Style) -> tuple[Drawing, ...]:
    chosen = int(np.argmin(np.abs(predicted.horizons - _SHOWN)))
    labels = [f"{horizon:.3g} s ahead" for horizon in predicted.horizons]
    with drawing():
        files = [svg(predicted_rates(predicted, sample_time, at, look)) for at in range(len(labels))]
    return drawings(files, labels, chosen, stem="predictions", description="Measured and predicted body rates p, q, r")


def _responses(found: FrequencyResponse, look: Style) -> tuple[Drawing, ...]:
    with drawing():
        file = svg(frequency_responses(found, look))
    return drawings([file], [""], 0, stem="response", description="Frequency response of roll, pitch and yaw")


def _about(found: VehicleIdentification) -> str:
    parts = [found.estimator, f"{found.model} model", found.result.replace("_", " "), f"{found.rollouts} rollouts"]
    cost = [] if found.cost is None else [f"cost {plain(found.cost)}"]
    return ", ".join([*parts, f"{plain(found.seconds)} s", *cost])


def _parameters(found: VehicleIdentification) -> list[ParameterRow]:
    estimated = [
        ParameterRow(name, row.unit, _number(row.estimate), _interval(row.ci95), _number(row.bound, 2), row.note)
        for name, row in found.parameters.items()
    ]
    held = [
        ParameterRow(name, row.unit, _number(row.value), note=row.note, held=True) for name, row in found.held.items()
    ]
    return estimated + held


def _constant(name: str, row: Constant) -> ParameterRow:
    half_width = NINETY_FIVE * row.std
    interval = _interval((row.estimate - half_width, row.estimate + half_width))
    note = row.note if isinstance(row.note, str) else ""
    return ParameterRow(name, row.unit, _number(row.estimate), interval, note=note)


def _skill(skill: PredictionSkill) -> list[tuple[str, list[dict[str, str]]]]:
    """For each rate, a row for each horizon: all as text."""

    def row(rate: RateSkill, i: int) -> dict[str, str]:
        return {
            "horizon": plain(skill.horizons[i]),
            "skill": _share(rate.skill[i]),
            "error": "" if rate.std[i] is None else f"± {_share(rate.std[i])}",
            "equation_error": _share(rate.equation_error[i]),
            "rmse": _number(rate.rmse[i], 3),
            "persistence": _number(rate.persistence[i], 3),
        }

    rates = {"p": skill.p, "q": skill.q, "r": skill.r}
    return [(name, [row(rate, i) for i in range(len(skill.horizons))]) for name, rate in rates.items()]


def _share(value: float | None) -> str:
    return MISSING if value is None else f"{value:.2f}"


def _number(value: float | None, digits: int = _DIGITS) -> str:
    return MISSING if value is None else plain(value, digits)


def _interval(ends: tuple[float, float] | None) -> str:
    return "" if ends is None else f"{_number(ends[0])} to {_number(ends[1])}"


def _text(x: Any) -> str:
    if isinstance(x, str):
        return x
    return MISSING if x is None else json.dumps(x, ensure_ascii=False)
