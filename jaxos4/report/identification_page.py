"""The page of an identified vehicle or OS4, which needs no other file: `jaxos4 estimate --report`."""

import json
import os
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from .._files import check_writable, write_file
from .._templates import templates
from ..airframe import INERTIAS, MOTIONS
from ..errors import printable
from ..identification.next_flight import next_flight, spreads_of
from ..identification.physical import centers_of_mass, physical_quantities
from ..identification.results import Identification, OS4Identification, VehicleIdentification
from ..identification.verdict import headline, statuses_of
from ..results import NINETY_FIVE, meaning
from . import identification_figures as figures
from .identification_signals import BAND, identified_signals
from .page import Entry, Part, Picture, Row, Section, Signals, Table, Text, number, page, span
from .style import Style, styles
from .terminal import quantity_rows, warning_lines, why_no_value
from .text import DASH, plain

# The page shows these entries of the provenance in a place of their own.
_ELSEWHERE = ("command", "notes")
_ESTIMATE = ("unit", "estimate", "95 % interval")


def write_flight_page(path: str | os.PathLike[str], found: Identification, *, title: str = "") -> None:
    """Writes the page of an identification, completely or not at all. Raises `OSError`.

    `title`: by default the names of the logs.
    """
    check_writable(path)
    look, used = styles([found.estimator])[found.estimator], found.provenance
    cost = "" if found.cost is None else f", cost {plain(found.cost)}"
    how = f"{found.estimator}, {found.model} model, {found.result.replace('_', ' ')}, {found.rollouts} rollouts"
    top: list[Part] = [Text(verdict(found), "verdict" if found.successful else "verdict warning")]
    top += [Text(lines, "verdicts") for lines in [warning_lines(found)] if lines]
    top += [Text(each[0].upper() + each[1:], id="next") for each in _next(found)]
    is_vehicle = isinstance(found, VehicleIdentification)
    signals, notes = _signals(found, look), [*used.notes, *filter(None, [found.motor_clock])]
    sections = [
        Section("quantities", "Physical quantities", _quantities(found), "Quantities"),
        Section("predictions", "Measured, predicted, residual", [*signals, Text(notes)] if signals else (), "Signals"),
        Section("vehicle", "Identified vehicle", [_vehicle(found, look)], "Vehicle"),
        Section(
            "sample-times", "Moment of inertia against sample time", _sample_times(found, look) if is_vehicle else ()
        ),
        Section("estimates", "Parameters", [_parameters(found)], "Parameters"),
        Section("posteriors", "Estimates in their brackets", _posteriors(found, look)),
        Section("residuals", "Residuals", _residuals(found), "Residuals"),
        Section("paths", "Path", _path(found, look)),
        Section("disturbances", "Disturbances", _disturbances(found) if is_vehicle else ()),
        Section("skills", "Skill of predictions", _skill(found) if is_vehicle else (), "Skill"),
        Section("responses", "Frequency response", _response(found, look) if is_vehicle else (), "Response"),
    ]
    text = page(
        title=title or ", ".join(printable(Path(name).name) for name in found.logs),
        about=f"Parameters of a quadrotor from its recorded flights: {how}, {plain(found.seconds)} s{cost}.",
        top=top,
        sections=sections,
        command=used.command or "",
        notes=() if signals else notes,
        provenance=[
            (name.replace("_", " "), _text(x))
            for name, x in msgspec.to_builtins(used).items()
            if name not in _ELSEWHERE
        ],
    )
    write_file(path, text)


def _quantities(found: Identification) -> list[Part]:
    p = found.rigid_body.consistency_p
    tested = [] if p is None else [f"Test whether the alphas are those of one rigid body: p = {plain(p, 2)}."]
    rows = [Row.of(name, unit, value, ends, note) for (name, value, ends, unit), note in quantities(found)]
    headings = ("quantity", *_ESTIMATE, "note")
    caption = "Estimates with their 95 % intervals"
    return [Table("quantities-table", caption, headings, [("", rows)], tested)] if rows else []


def _signals(found: Identification, look: Style) -> list[Part]:
    if not (signals := identified_signals(found, look)):
        return []
    words = "Dashes: measured; line: predicted; horizontal: time [s], without gaps. "
    if isinstance(found, VehicleIdentification) and found.predictions is not None:
        words += (
            "Each point is a separate prediction: it starts from the rates measured that much earlier and uses the "
            f"recorded inputs. The band holds {100 * BAND:g} % of the errors of its rate at this horizon. "
        )
        if found.trajectories is not None:
            words += "From one start, which you choose: the whole motion until the last horizon. "
        words += (
            "Grey: fitted, and not predicted. Gusts: the angular acceleration that the model does not explain, as "
            "estimated by the filters; the axis shows 99 % of it."
        )
    elif isinstance(found, OS4Identification) and found.fit:
        words += "The flight is simulated from its first sample with the estimated parameters, so that errors add up."
    return [Signals(signals, words, choice="Show")]


def _vehicle(found: Identification, look: Style) -> Part:
    center = centers_of_mass(found)
    where = [f"{x.axis} {plain(1e3 * x.value)} ± {plain(NINETY_FIVE * (1e3 * x.std), 2)} mm" for x in center]
    known = f"{', '.join(where)} (95 %), if all rotors are alike" if center else "not estimated"
    return Picture(
        figures.vehicle(found.airframe, found.rigid_body.constants, center, look),
        "Left: rotors with their number and the direction in which they turn; the cross: centre of mass, "
        f"{known}. Right: moments of inertia.",
    )


def _sample_times(found: VehicleIdentification, look: Style) -> list[Part]:
    if not found.sample_times:
        return []
    figure = figures.inertias_by_sample_time(found.sample_times, found.provenance.sample_time, look)
    caption = (
        "The same flight, fitted with several sample times. Short samples contain the vibration of the sensors, long "
        "samples hide motion. A moment of inertia that depends on the sample time is not to be trusted."
    )
    return [Picture(figure, caption)]


def _parameters(found: Identification) -> Part:
    rows = [
        Row.of(name, x.unit, number(x.estimate), span(x.ci95), number(x.bound, 2), x.note)
        for name, x in found.parameters.items()
    ]
    fixed, widened = (found.held, found.widened) if isinstance(found, VehicleIdentification) else ({}, {})
    rows += [
        Row.of(name, x.unit, number(x.value), "", "", f"fixed: {x.note}", reference=True) for name, x in fixed.items()
    ]
    note = (
        "Bound: Cramer-Rao bound, the smallest possible standard deviation at the noise that was found. A dash: not "
        "identifiable. Fixed: not estimated, but kept at this value; the note says why."
    )
    if widened:
        factors = ", ".join(f"{name} {factor:.1f}" for name, factor in widened.items())
        note += f" Parts of the flights disagree, so that these intervals were widened by the factor: {factors}."
    headings = ("parameter", *_ESTIMATE, "bound", "note")
    return Table("parameters", "Estimated parameters, then fixed parameters", headings, [("", rows)], [note])


def _posteriors(found: Identification, look: Style) -> list[Part]:
    parts: list[Part] = []
    if (figure := figures.priors(found, look)) is not None:
        prior = " The bracket is the prior: its half-width is one standard deviation." if found.is_vehicle else ""
        caption = (
            "An interval as long as its bracket means that the flight adds nothing; one at an end or outside, that the "
            f"bracket may be wrong.{prior}"
        )
        parts.append(Picture(figure, caption))
    if found.covariance is not None and len(found.covariance) > 1:
        pairs = ", ".join(f"{one} and {other} ({value:.2f})" for one, other, value in figures.strongest(found))
        most = f" Strongest: {pairs}. This flight cannot separate such parameters." if pairs else ""
        caption = (
            "Correlations of the estimates: marks as large as the correlation. A name stands at the end of its row, "
            f"and where its column begins.{most}"
        )
        parts.append(Picture(figures.correlation_matrix(found, look), caption))
    return parts


def _residuals(found: Identification) -> list[Part]:
    parts: list[Part] = []
    if isinstance(found, OS4Identification) and found.fit:
        headings = ("channel", "unit", "fit [%]", "RMS", "level", "neighbours", "p, white", "p, inputs")
        rows = [
            Row.of(
                *(name, x.unit, number(x.percent, 3), number(x.rms, 3), number(x.level, 3)),
                *(number(each, 2) for each in (x.correlation, x.white_p, x.input_p)),
            )
            for name, x in found.fit.items()
        ]
        note = (
            "Fit: 100 is a perfect prediction, 0 as good as the mean. Level: mean square of the residuals over that of "
            "the noise. p: the probability of such residuals if the model is right."
        )
        parts.append(Table("fit", "Fit of each channel", headings, [("", rows)], [note]))
    if found.correlations is not None:
        what = (
            "Residual: measured minus one-step prediction. The controller reacts to residuals, so that correlations at "
            "negative lags do not speak against the model."
            if found.is_vehicle
            else "If the model lacks an effect, residuals are slow, or follow the torque."
        )
        caption = (
            "Left: the correlation of residuals, by the number of samples between them. Right: with the torques of "
            "roll, pitch and yaw, at a positive lag before the residual. "
        )
        figure = figures.residual_figure(found.correlations)
        parts.append(Picture(figure, caption + what))
    return parts


def _path(found: Identification, look: Style) -> list[Part]:
    if found.traces is None or not np.isfinite(found.traces.position).any():
        return []
    return [Picture(figures.path(found.traces, look), "The path of the vehicle, with one scale on both axes.")]


def _disturbances(found: VehicleIdentification) -> list[Part]:
    rows = [
        Row.of(name, x.unit, *(number(each, 2) for each in (x.strength, x.correlation_time, x.sensor)))
        for name, x in found.disturbances.items()
    ]
    headings = ("channel", "unit", "strength", "correlation time [s]", "sensor noise [rad/s, m/s²]")
    note = (
        "Strength: standard deviation of gusts and of effects that the model lacks. It is estimated with the "
        "parameters, because the controller reacts to it."
    )
    caption = "Disturbances of each channel, which the model does not explain"
    return [Table("disturbances-table", caption, headings, [("", rows)], [note])] if rows else []


def _skill(found: VehicleIdentification) -> list[Part]:
    if (skill := found.skill) is None:
        return []
    groups = []
    for name, rate in (("p", skill.p), ("q", skill.q), ("r", skill.r)):
        rows = []
        for i, horizon in enumerate(skill.horizons):
            std = "" if rate.std[i] is None else f"± {_share(rate.std[i])}"
            sizes = number(rate.rmse[i], 3), number(rate.persistence[i], 3)
            rows.append(
                Row.of(plain(horizon), Entry(_share(rate.skill[i]), std), _share(rate.equation_error[i]), *sizes)
            )
        groups.append((name, rows))
    note = (
        "1 - (RMSE / persistence)²: 1 is perfect, 0 is as good as the assumption that rates stay constant "
        "(persistence), and below 0 is worse. ±: one standard error, estimated by leaving out a tenth of the flight at "
        "a time. Equation error: the skill of a regression with the same terms."
    )
    headings = ("ahead [s]", "skill", "equation error", "RMSE [rad/s]", "persistence [rad/s]")
    starts = f", {skill.starts} starts" if skill.starts else ""
    return [Table("skill", f"Skill by rate and horizon{starts}", headings, groups, [note])]


def _response(found: VehicleIdentification, look: Style) -> list[Part]:
    if found.response is None:
        return []
    gains = []
    for name, axis in zip(MOTIONS, found.response, strict=True):
        mean = axis.agreement()
        low, high = mean.interval
        known = f"{mean.ratio:.2f} ({low:.2f} to {high:.2f}) times the model"
        gains.append(f"{name}: {known if np.isfinite(mean.ratio) else 'no clear response'}")
    caption = (
        "Measured over modelled angular acceleration, from the fitted data without simulation, with 95 % bands; not "
        "clear: known to less than half of the model's gain. The verdict rests on the mean gain from 4 to 20 Hz, which "
        "stands above the figure in numbers. The coherence is the power of the modelled acceleration as a share of "
        "itself and the disturbance's. A gain of 2: the vehicle reacts twice as strongly as the model. A gain other "
        "than 1 shows that the model is wrong; a gain of 1 does not prove it right, because the same flight was fitted."
    )
    figure = figures.frequency_responses(found.response, look)
    picture = Picture(figure, caption)
    return [Text(f"{'; '.join(gains)}."), picture]


def quantities(found: Identification) -> list[tuple[tuple[str, ...], str]]:
    """The cells of each quantity, and of each moment of inertia even if it was not identified; and a note on each."""
    every, rows = physical_quantities(found), []
    for row, cells, note in zip(every, *quantity_rows(every), strict=True):
        own = found.parameters.get(row.name.replace(" ", "_"))
        said = dict.fromkeys([note, "" if own is None else own.note])
        rows.append((cells, "; ".join(filter(None, said))))
    listed = {cells[0] for cells, _ in rows}
    for name, row in {} if found.is_vehicle else found.rigid_body.constants.items():
        if name not in listed:  # a J_R of -3 kg m^2 would be read as a value
            half = NINETY_FIVE * row.std
            interval = f"{row.estimate - half:.4g} to {row.estimate + half:.4g}"
            rows.append(((name, DASH, interval, row.unit), why_no_value(row)))
    for name in INERTIAS:
        if name in found.verdicts and name not in listed:
            rows.append(((name, DASH, "", "kg m^2"), found.verdicts[name].status))
    return sorted(rows, key=lambda row: INERTIAS.index(row[0][0]) if row[0][0] in INERTIAS else len(INERTIAS))


def identification_html(found: Identification) -> str:
    """Verdict, physical quantities and reservations, for a notebook."""
    rows = list(zip(*quantity_rows(physical_quantities(found)), strict=True))
    lines = [*warning_lines(found), *(f"note: {note}" for note in found.provenance.notes), *_next(found)]
    template = templates("jaxos4.report").get_template("summary.html.j2")
    return template.render(verdict=verdict(found), rows=rows, lines=lines)


def _next(found: Identification) -> list[str]:
    return [next_flight([found], spreads_of(found))] if found.verdicts and found.has_answer else []


def verdict(found: Identification) -> str:
    """Whether to trust the quantities, in a sentence for each status. The page shows the reasons below it."""
    if not found.has_answer:
        return f"There is no answer: {meaning(found.result)}."
    if found.verdicts:
        return " ".join(headline(statuses_of(found.verdicts)).values())
    return "No quantity was judged." if found.successful else f"Not to be trusted: {meaning(found.result)}."


def _text(x: Any) -> str:
    return x if isinstance(x, str) else DASH if x is None else json.dumps(x, ensure_ascii=False)


def _share(value: float | None) -> str:
    return DASH if value is None else f"{value:.2f}"
