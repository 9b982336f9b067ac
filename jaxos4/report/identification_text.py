"""Identifications, and what a flight of an OS4 can identify, as text for a terminal."""

import io
import math
from collections.abc import Iterator, Sequence

from rich.console import Console

from ..estimators import ESTIMATORS
from ..identification import FlightInformation
from ..identification.issues import much_widened
from ..identification.next_flight import next_flight, spreads_of
from ..identification.results import COLOURED, Constant, Identification, OS4Identification, VehicleIdentification
from ..identification.tables import PhysicalQuantity, physical_quantities, possible
from ..identification.verdict import (
    CONTRADICTED,
    IDENTIFIED,
    IMPROBABLE,
    MISSING,
    RESERVED,
    headline,
    reason_lines,
    statuses_of,
)
from .text import DASH, Listing, plain, say

# The share of fits of true models that a test of all channels' residuals may reject.
_SIGNIFICANCE = 0.01

# Of the sentences of the headline, on terminals that have colours.
_COLOURS = {IDENTIFIED: "green", RESERVED: "yellow", MISSING: "yellow", CONTRADICTED: "bold red"}

Lines = Iterator[str | Listing]


def print_identification(console: Console, found: Identification, *, verbose: bool = False) -> None:
    """Prints verdicts, quantities, reservations and notes; without an answer only notes, and why a trajectory diverged.

    `verbose`: for a vehicle, also all parameters, the noise and the quality of predictions. An OS4 always has its
    parameters.
    """
    notes = [f"note: {note}" for note in notes_of(found)]
    parts: list[str | Listing] = [*warning_lines(found), *notes]
    if not found.has_answer:
        parts = [*notes, *_failure(found)]
    elif isinstance(found, OS4Identification):
        parts += [*_parameters(found), *_fit(found), *_inertias(found), *_validation(found)]
    elif isinstance(found, VehicleIdentification):
        if rows := quantity_rows(physical_quantities(found)):
            headings = ("quantity", "estimate", "95 % interval", "unit", "note")
            parts.insert(0, Listing(headings, rows, ("estimate",)))
        parts += [*_parameters(found), *_held(found), *_inertias(found), *_of_vehicle(found)] if verbose else []
    if found.has_answer:
        parts += [_summary(found), *next_lines(found)]
        for status, sentence in headline(statuses_of(found.verdicts)).items():
            say(console, sentence, _COLOURS[status])
    for part in parts:
        if isinstance(part, Listing):
            part.print_on(console)
        else:
            say(console, part)


def identification_summary(found: Identification, *, verbose: bool = False, width: int = 80) -> str:
    """The text of `print_identification` on a terminal of this width [columns]."""
    text = io.StringIO()
    print_identification(Console(width=width, file=text, force_jupyter=False), found, verbose=verbose)
    return "\n".join(line.rstrip() for line in text.getvalue().splitlines())


def quantity_rows(quantities: Sequence[PhysicalQuantity]) -> list[tuple[str, ...]]:
    """The cells of physical quantities: name, estimate, interval, unit, and a note."""
    rows = []
    for each in quantities:
        status = "" if each.verdict is None or each.trusted else each.verdict.status
        note = "; ".join(filter(None, (status, each.condition)))
        unit = "" if each.unit == "1" else each.unit
        rows.append((each.name, f"{each.value:.4g}", " to ".join(f"{end:.4g}" for end in each.ci95), unit, note))
    return rows


def warning_lines(found: Identification) -> list[str]:
    """The reasons of the verdicts, and a warning of intervals that had to be widened much; for terminal and page."""
    wide = much_widened(found) if isinstance(found, VehicleIdentification) else {}
    factors = dict.fromkeys(f"{pick(wide.values(), default=1.0):.1f}" for pick in (min, max))
    flights, other = (
        ("flights", "flights are not of one vehicle") if len(found.logs) > 1 else ("flight", "vehicle changed")
    )
    said = f"warning: parts of the {flights} disagree, so that intervals were widened {' to '.join(factors)} times: "
    lacking = f"{said}{', '.join(wide)}. The model lacks an effect, or the {other}."
    return [*reason_lines(found.verdicts, found.issues), *[lacking] * bool(wide)]


def notes_of(found: Identification) -> list[str]:
    """The notes on the data, and the clock of the motors if it is not the gyro's."""
    clock = [f"{found.motor_clock} (rotor_delay)"] if found.motor_clock else []
    return [*found.provenance.notes, *clock]


def _failure(found: Identification) -> Lines:
    if found.result != "nonfinite_trajectory" or found.is_vehicle:
        return
    kind = ESTIMATORS.get(found.estimator)
    shoots = kind is not None and (kind.shoots or kind.needs_network)
    yield (
        "No estimate: the model's trajectory diverged wherever the search went. The vehicle may do something that "
        f"the model lacks{' (try `window`, or a shorter one)' if shoots else ''}, or the airframe's constants "
        "or the units of the flight are wrong."
    )


def _parameters(found: Identification) -> Lines:
    of_os4 = not found.is_vehicle
    digits = 5 if of_os4 else 4
    rows = []
    for name, row in found.parameters.items():
        cells = ["-", "-", "-"]
        if row.estimate is not None and row.ci95 is not None:
            low, high = row.ci95
            bound = "-" if row.bound is None else f"{row.bound:.2g}"
            cells = [f"{row.estimate:.{digits}g}", f"[{low:.{digits}g}, {high:.{digits}g}]", bound]
        rows.append((name, row.unit, *cells[: 2 + of_os4], row.note))
    headings = ("parameter", "unit", "estimate", "95 % interval", *["bound"] * of_os4, "note")
    yield Listing(headings, rows, ("estimate", "bound"))
    limits = [
        f"{plain(1 / row.noise_limit, 2)} ({name})"
        for name, row in found.parameters.items()
        if row.is_below_noise and row.noise_limit and row.noise_limit < 1
    ]
    if limits:
        yield (
            "below noise: cannot be distinguished from 0. You would need sensors that are quieter by a factor of "
            f"{', '.join(limits)}."
        )
    if of_os4:
        yield "bound: Cramer-Rao bound, the smallest possible standard deviation at the noise that was found."


def _held(found: VehicleIdentification) -> Lines:
    reasons: dict[str, list[str]] = {}
    for name, row in found.held.items():
        reasons.setdefault(row.note, []).append(f"{name} {row.value:.4g}")
    yield from (f"fixed, {reason}: {', '.join(rows)}." for reason, rows in reasons.items())


def _fit(found: OS4Identification) -> Lines:
    percents = [f"{name} {row.percent:.1f}" for name, row in found.fit.items() if row.percent is not None]
    yield f"fit [%], 100 is a perfect prediction: {', '.join(percents)}."
    coloured = ", ".join(name for name, row in found.fit.items() if row.correlation > COLOURED)
    if coloured and found.estimator == "network":
        yield (
            f"The residuals of {coloured} are not white noise: the network's answer is not the best fit, but lies "
            "within its intervals of it. The hybrid continues the search from there and tests the model."
        )
    elif coloured:
        yield (
            f"The residuals of {coloured} are not white noise: the model does not explain this flight completely. The "
            "intervals of estimators that shoot allow for correlated residuals, but are too narrow for slow errors."
        )
    tests = {"free of the inputs (cross-correlation)": {name: row.input_p for name, row in found.fit.items()}}
    if found.provenance.windows == 1:  # the free initial states of windows mislead the test
        tests = {"white (Ljung-Box)": {name: row.white_p for name, row in found.fit.items()}} | tests
    for claim, p_values in tests.items() if found.fit else ():
        failed = [name for name, p_value in p_values.items() if p_value * len(p_values) < _SIGNIFICANCE]
        passed = f"not those of {', '.join(failed)}" if failed else "all"
        yield f"residuals {claim}, tests at {100 * _SIGNIFICANCE:.0f} %: {passed}."


def why_no_value(row: Constant) -> str:
    """Why a constant of a rigid body is not among the physical quantities."""
    return "below noise" if abs(row.estimate) <= row.margin else "impossible"


def _inertias(found: Identification) -> Lines:
    body = found.rigid_body
    inertias = [
        f"{name} {row.estimate:.4g} +- {row.margin:.2g}{f' ({row.note})' if row.note else ''}"
        if name in possible(body)
        else f"{name} {why_no_value(row)}"
        for name, row in body.constants.items()
    ]
    verdict = ""
    if body.consistency_p is not None:
        if body.consistency_p < IMPROBABLE:
            verdict = f"; the alphas are not those of one rigid body, p = {body.consistency_p:.1g}"
        elif not body.is_rigid_body:
            verdict = "; no rigid body has such inertias: one exceeds the sum of the other two"
        else:
            verdict = f"; the alphas agree with one rigid body, p = {body.consistency_p:.2g}"
    if inertias:
        yield f"inertias [kg m^2], 95 %: {', '.join(inertias)}{verdict}."


def _validation(found: OS4Identification) -> Lines:
    if found.validation is None:
        return
    flight, fit = found.validation.flight, found.validation.fit
    if fit is None:
        yield f"validation on {flight}: the model's trajectory diverges before the flight ends."
        return
    channels = [f"{name} {x.percent:.1f} ({x.level**0.5:.2g})" for name, x in fit.items() if x.percent is not None]
    yield f"validation on {flight} [%] (residuals in multiples of the noise): {', '.join(channels)}."


def _of_vehicle(found: VehicleIdentification) -> Lines:
    rows = []
    for each in found.sample_times:
        chosen = " (chosen)" if math.isclose(each.sample_time, found.provenance.sample_time) else ""
        inertias = [f"{name} {row.estimate:.3g}" for name, row in each.constants.items()]
        rows.append(f"{1e3 * each.sample_time:.3g} ms {' '.join(inertias) or 'no answer'}{chosen}")
    if rows:
        yield f"sample times: {', '.join(rows)}."
    if found.disturbances:
        levels = found.disturbances.items()
        gusts = ", ".join(f"{name} {x.strength:.2g} {x.unit} over {x.correlation_time:.2g} s" for name, x in levels)
        yield f"disturbances that the model does not explain, with their correlation time: {gusts}."
        sensors = ", ".join(f"{name} {x.sensor:.2g}" for name, x in levels)
        yield f"white noise of the sensors [rad/s; m/s^2]: {sensors}."
    if found.widened:
        factors = ", ".join(f"{name} {factor:.1f}" for name, factor in found.widened.items())
        yield f"intervals widened, because parts of the flights disagree, by the factor: {factors}."
    if found.skill is None:
        return
    skill, table = found.skill, []
    yield (
        "Predictions of data that were not fitted: 1 is perfect, 0 as good as constant rates; +- one standard "
        f"error ({skill.starts} starts)."
    )
    rates = (skill.p, skill.q, skill.r)
    for i, horizon in enumerate(skill.horizons):
        cells = [f"{share(rate.skill[i])} +- {share(rate.std[i])}" for rate in rates]
        table.append((f"{horizon:.2f} s", *cells, ", ".join(share(rate.equation_error[i]) for rate in rates)))
    yield Listing(("ahead", "p", "q", "r", "equation error: p, q, r"), table)


def _summary(found: Identification) -> str:
    used = found.provenance
    if found.is_vehicle:
        how = f"flight model ({', '.join(used.terms or ())}), {used.fitted_seconds:.0f} s, a sample every "
        how, digits = f"{how}{1e3 * used.sample_time:g} ms", 0
    else:
        how, digits = f"{found.model} model, {used.channels} channels", 1
    return f"{found.estimator}, {how}: {found.result}, {found.rollouts} rollouts, {found.seconds:.{digits}f} s"


def next_lines(found: Identification) -> list[str]:
    """Advice on the next flight, if anything was judged."""
    return [f"next: {next_flight([found], spreads_of(found))}"] if found.verdicts and found.has_answer else []


def share(value: float | None) -> str:
    """A skill: 1 is perfect, and it may be far below 0."""
    if value is None:
        return DASH
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.1e}"


def print_information(console: Console, found: FlightInformation) -> None:
    """Prints a row for each parameter: its bound, and whether it is identifiable."""
    if not found.fitted:
        say(console, "note: no fit; all numbers below hold at the bracket's centre")
    rows = []
    for name, row in found.parameters.items():
        bound, alone = (float("inf") if x is None else x for x in (row.bound, row.others_known))
        limit = f"{row.noise_limit:.2g} x" if bound <= row.half_width and row.noise_limit else "-"
        rows.append((name, row.unit, f"{bound:.2g}", f"{alone:.2g}", f"{bound / row.half_width:.2g}", limit, row.note))
    numbers = ("bound", "others known", "of bracket", "noise limit")
    Listing(("parameter", "unit", *numbers, "note"), rows, numbers).print_on(console)
    say(
        console,
        "bound: the smallest possible standard deviation at the noise that was found; others known: the same if all "
        "other parameters were known; of bracket: bound / half-width of the bracket, above 1 the parameter is not "
        "identifiable; noise limit: the largest noise, in multiples of the noise that was found, at which the "
        "airframe's value can be distinguished from 0.",
    )
