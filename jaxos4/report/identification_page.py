"""The page of an identified vehicle or OS4, which needs no other file: `jaxos4 estimate --report`."""

import json
import os
from pathlib import Path

import msgspec
import numpy as np
from markupsafe import Markup

from ..airframe import INERTIAS, MOTIONS
from ..errors import printable
from ..identification.results import Identification, OS4Identification, VehicleIdentification
from ..identification.tables import centers_of_mass, physical_quantities
from ..identification.verdict import headline, statuses_of
from ..results import NINETY_FIVE, meaning
from . import identification_figures as figures
from .identification_signals import BAND, identified_signals
from .identification_text import next_lines, notes_of, quantity_rows, share, warning_lines, why_no_value
from .page import Section, picture, signals, table, template, text, write_page
from .panels import Style, styles
from .text import DASH, plain, span

# The page shows these entries of the provenance in a place of their own.
_ELSEWHERE = ("command", "notes")
_ESTIMATE = ("unit", "estimate", "95 % interval")


def write_flight_page(path: str | os.PathLike[str], found: Identification, *, title: str = "") -> None:
    """Writes the page of an identification, completely or not at all. Raises `OSError`.

    `title`: by default the names of the logs.
    """
    look, used = styles([found.estimator])[found.estimator], found.provenance
    cost = "" if found.cost is None else f", cost {plain(found.cost)}"
    how = f"{found.estimator}, {found.model} model, {found.result.replace('_', ' ')}, {found.rollouts} rollouts"
    top = [text(verdict(found), "verdict" if found.successful else "verdict warning")]
    top.append(text(warning_lines(found)))
    top += [text(each[0].upper() + each[1:], id="next") for each in next_lines(found)]
    is_vehicle = isinstance(found, VehicleIdentification)
    drawn, notes = _signals(found, look), notes_of(found)
    sections = [
        Section("quantities", "Physical quantities", _quantities(found), "Quantities"),
        Section("predictions", "Measured, predicted, residual", drawn and [*drawn, text(notes)], "Signals"),
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
    write_page(
        path,
        title=title or ", ".join(printable(Path(name).name) for name in found.logs),
        about=f"Parameters of a quadrotor from its recorded flights: {how}, {plain(found.seconds)} s{cost}.",
        top=top,
        sections=sections,
        end=[] if drawn else [text(notes)],
        command=used.command or "",
        provenance=[
            (
                name.replace("_", " "),
                x if isinstance(x, str) else DASH if x is None else json.dumps(x, ensure_ascii=False),
            )
            for name, x in msgspec.to_builtins(used).items()
            if name not in _ELSEWHERE
        ],
    )


def _quantities(found: Identification) -> list[Markup]:
    p = found.rigid_body.consistency_p
    tested = [] if p is None else [f"Test whether the alphas are those of one rigid body: p = {plain(p, 2)}."]
    rows = [(name, unit, value, ends, note) for name, value, ends, unit, note in quantities(found)]
    headings = ("quantity", *_ESTIMATE, "note")
    caption = "Estimates with their 95 % intervals"
    return [table("quantities-table", caption, headings, rows, tested)]


def _signals(found: Identification, look: Style) -> list[Markup]:
    if not (drawn := identified_signals(found, look)):
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
    return [signals(drawn, words, choice="Show")]


def _vehicle(found: Identification, look: Style) -> Markup:
    center = centers_of_mass(found)
    where = [f"{x.axis} {plain(1e3 * x.value)} ± {plain(NINETY_FIVE * (1e3 * x.std), 2)} mm" for x in center]
    known = f"{', '.join(where)} (95 %), if all rotors are alike" if center else "not estimated"
    return picture(
        figures.vehicle(found.airframe, found.rigid_body.constants, center, look),
        "Left: rotors with their number and the direction in which they turn; the cross: centre of mass, "
        f"{known}. Right: moments of inertia.",
    )


def _sample_times(found: VehicleIdentification, look: Style) -> list[Markup]:
    if not found.sample_times:
        return []
    figure = figures.inertias_by_sample_time(found.sample_times, found.provenance.sample_time, look)
    caption = (
        "The same flight, fitted with several sample times. Short samples contain the vibration of the sensors, long "
        "samples hide motion. A moment of inertia that depends on the sample time is not to be trusted."
    )
    return [picture(figure, caption)]


def _parameters(found: Identification) -> Markup:
    rows: list[str | tuple[str, ...]] = []
    fixed, widened = (found.held, found.widened) if isinstance(found, VehicleIdentification) else ({}, {})
    for name, x in found.parameters.items():
        within = f"\nbracket {span(x.bracket)}" if x.bracket else ""
        rows.append((name, x.unit, plain(x.estimate, 4), span(x.ci95) + within, plain(x.bound, 2), x.note))
    for why in dict.fromkeys(x.note for x in fixed.values()):
        of_why = {name: x for name, x in fixed.items() if x.note == why}
        rows += [f"fixed: {why}", *((name, x.unit, plain(x.value, 4), "", "", "") for name, x in of_why.items())]
    note = (
        "Bound: Cramer-Rao bound, the smallest possible standard deviation at the noise that was found. A dash: not "
        "identifiable. Fixed: not estimated, but kept at this value."
    )
    if widened:
        factors = ", ".join(f"{name} {factor:.1f}" for name, factor in widened.items())
        note += f" Parts of the flights disagree, so that these intervals were widened by the factor: {factors}."
    headings = ("parameter", *_ESTIMATE, "bound", "note")
    return table("parameters", "Estimated parameters, then fixed parameters", headings, rows, [note])


def _posteriors(found: Identification, look: Style) -> list[Markup]:
    parts = []
    if (figure := figures.priors(found, look)) is not None:
        prior = " The bracket is the prior: its half-width is one standard deviation." if found.is_vehicle else ""
        caption = (
            "An interval as long as its bracket means that the flight adds nothing; one at an end or outside, that the "
            f"bracket may be wrong.{prior}"
        )
        parts.append(picture(figure, caption))
    if found.covariance is not None and len(found.covariance) > 1:
        pairs = ", ".join(f"{one} and {other} ({value:.2f})" for one, other, value in figures.strongest(found))
        most = f" Strongest: {pairs}. This flight cannot separate such parameters." if pairs else ""
        caption = (
            "Correlations of the estimates: marks as large as the correlation. A name stands at the end of its row, "
            f"and where its column begins.{most}"
        )
        parts.append(picture(figures.correlation_matrix(found, look), caption))
    return parts


def _residuals(found: Identification) -> list[Markup]:
    parts = []
    if isinstance(found, OS4Identification) and found.fit:
        headings = ("channel", "unit", "fit [%]", "RMS", "level", "neighbours", "p, white", "p, inputs")
        rows = [
            (
                *(name, x.unit, plain(x.percent, 3), plain(x.rms, 3), plain(x.level, 3)),
                *(plain(each, 2) for each in (x.correlation, x.white_p, x.input_p)),
            )
            for name, x in found.fit.items()
        ]
        note = (
            "Fit: 100 is a perfect prediction, 0 as good as the mean. Level: mean square of the residuals over that of "
            "the noise. p: the probability of such residuals if the model is right."
        )
        parts.append(table("fit", "Fit of each channel", headings, rows, [note]))
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
        parts.append(picture(figure, caption + what))
    return parts


def _path(found: Identification, look: Style) -> list[Markup]:
    if found.traces is None or not np.isfinite(found.traces.position).any():
        return []
    return [picture(figures.path(found.traces, look), "The path of the vehicle, with one scale on both axes.")]


def _disturbances(found: VehicleIdentification) -> list[Markup]:
    rows = [
        (name, x.unit, *(plain(each, 2) for each in (x.strength, x.correlation_time, x.sensor)))
        for name, x in found.disturbances.items()
    ]
    headings = ("channel", "unit", "strength", "correlation time [s]", "sensor noise [rad/s, m/s²]")
    note = (
        "Strength: standard deviation of gusts and of effects that the model lacks. It is estimated with the "
        "parameters, because the controller reacts to it."
    )
    caption = "Disturbances of each channel, which the model does not explain"
    return [table("disturbances-table", caption, headings, rows, [note])]


def _skill(found: VehicleIdentification) -> list[Markup]:
    if (skill := found.skill) is None:
        return []
    rows: list[str | tuple[str, ...]] = []
    for name, rate in (("p", skill.p), ("q", skill.q), ("r", skill.r)):
        rows.append(name)
        for i, horizon in enumerate(skill.horizons):
            std = "" if rate.std[i] is None else f"\n± {share(rate.std[i])}"
            shares = f"{share(rate.skill[i])}{std}", share(rate.equation_error[i])
            rows.append((plain(horizon), *shares, plain(rate.rmse[i]), plain(rate.persistence[i])))
    note = (
        "1 - (RMSE / persistence)²: 1 is perfect, 0 is as good as the assumption that rates stay constant "
        "(persistence), and below 0 is worse. ±: one standard error, estimated by leaving out a tenth of the flight at "
        "a time. Equation error: the skill of a regression with the same terms."
    )
    headings = ("ahead [s]", "skill", "equation error", "RMSE [rad/s]", "persistence [rad/s]")
    starts = f", {skill.starts} starts" if skill.starts else ""
    return [table("skill", f"Skill by rate and horizon{starts}", headings, rows, [note])]


def _response(found: VehicleIdentification, look: Style) -> list[Markup]:
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
    return [text(f"{'; '.join(gains)}."), picture(figures.frequency_responses(found.response, look), caption)]


def quantities(found: Identification) -> list[tuple[str, ...]]:
    """The cells of each quantity, and of each moment of inertia even if it was not identified; the last is a note."""
    rows = []
    for *cells, note in quantity_rows(physical_quantities(found)):
        own = found.parameters.get(cells[0].replace(" ", "_"))
        said = dict.fromkeys([note, "" if own is None else own.note])
        rows.append((*cells, "; ".join(filter(None, said))))
    listed = {row[0] for row in rows}
    for name, row in {} if found.is_vehicle else found.rigid_body.constants.items():
        if name not in listed:  # a J_R of -3 kg m^2 would be read as a value
            low, high = row.ci95
            rows.append((name, DASH, f"{low:.4g} to {high:.4g}", row.unit, why_no_value(row)))
    for name in INERTIAS:
        if name in found.verdicts and name not in listed:
            rows.append((name, DASH, "", "kg m^2", found.verdicts[name].status))
    return sorted(rows, key=lambda row: INERTIAS.index(row[0]) if row[0] in INERTIAS else len(INERTIAS))


def identification_html(found: Identification) -> str:
    """Verdict, physical quantities and reservations, for a notebook."""
    lines = [*warning_lines(found), *(f"note: {note}" for note in notes_of(found)), *next_lines(found)]
    rows = quantity_rows(physical_quantities(found))
    return template("summary.html.j2").render(verdict=verdict(found), rows=rows, lines=lines)


def verdict(found: Identification) -> str:
    """Whether to trust the quantities, in a sentence for each status. The page shows the reasons below it."""
    if not found.has_answer:
        return f"There is no answer: {meaning(found.result)}."
    if found.verdicts:
        return " ".join(headline(statuses_of(found.verdicts)).values())
    return "No quantity was judged." if found.successful else f"Not to be trusted: {meaning(found.result)}."
