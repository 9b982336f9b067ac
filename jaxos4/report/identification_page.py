"""An identification as text, for a terminal."""

from collections.abc import Iterator

from rich.console import Console

from ..estimators import ESTIMATORS
from ..identification.quality import COLOURED
from ..identification.results import (
    FlightIdentification,
    Identification,
    PredictionSkill,
    RigidBody,
    Validation,
    VehicleIdentification,
)
from ..results import NINETY_FIVE
from .whole import Listing

# The share of fits of true models that a test of all channels' residuals may reject.
_SIGNIFICANCE = 0.01


def print_identification(console: Console, found: Identification) -> None:
    """Prints doubts, notes, parameters, moments of inertia and the quality of the fit; without an answer, why."""
    for part in _parts(found):
        if isinstance(part, Listing):
            part.print_on(console)
        else:
            console.print(part, markup=False, highlight=False)


def _parts(found: Identification) -> Iterator[str | Listing]:
    if isinstance(found, VehicleIdentification):
        yield from (f"not to be trusted because {doubt}." for doubt in found.doubts)
    yield from (f"note: {note}" for note in found.provenance.get("notes", ()))
    if found.result == "nonfinite_trajectory" and isinstance(found, FlightIdentification):
        shoots = ESTIMATORS[found.estimator].shoots or ESTIMATORS[found.estimator].needs_network
        yield (
            "No estimate: the model's trajectory diverged wherever the search went. The vehicle may do something that "
            f"the model lacks{' (try --window, or a shorter window)' if shoots else ''}, or the airframe's constants "
            "or the units of the flight are wrong."
        )
    if not found.has_answer:
        return
    if isinstance(found, FlightIdentification):
        yield from _of_flight(found)
    elif isinstance(found, VehicleIdentification):
        yield from _of_vehicle(found)


def _of_flight(found: FlightIdentification) -> Iterator[str | Listing]:
    yield _parameters(found, digits=5, with_bound=True)
    limits = [
        f"{name} {row.noise_limit:.2g}"
        for name, row in found.parameters.items()
        if "below noise" in row.note and row.noise_limit
    ]
    if limits:
        yield (
            "below noise: cannot be distinguished from 0. The airframe's values could be distinguished at this "
            f"multiple of the noise: {', '.join(limits)}."
        )
    yield "bound: Cramer-Rao bound, the smallest possible standard deviation at the noise that was found."
    percents = [f"{name} {row.percent:.1f}" for name, row in found.fit.items() if row.percent is not None]
    yield f"fit [%], 100 is a perfect prediction: {', '.join(percents)}."
    yield from _residuals(found)
    yield from _rigid_body(found.rigid_body)
    if found.validation is not None:
        yield _validation(found.validation)
    yield (
        f"{found.estimator}, {found.model} model, {found.provenance['channels']} channels: {found.result}, "
        f"{found.rollouts} rollouts, {found.seconds:.1f} s"
    )


def _residuals(found: FlightIdentification) -> Iterator[str]:
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
    tests = {"free of the inputs (cross-correlation)": "input_p"}
    if found.provenance["windows"] == 1:  # the free initial states of windows mislead the test
        tests = {"white (Ljung-Box)": "white_p"} | tests
    for property_, p_value in tests.items() if found.fit else ():
        failed = [name for name, row in found.fit.items() if getattr(row, p_value) * len(found.fit) < _SIGNIFICANCE]
        answer = f"not those of {', '.join(failed)}" if failed else "all"
        yield f"residuals {property_}, tests at {_SIGNIFICANCE:.0%}: {answer}."


def _rigid_body(body: RigidBody) -> Iterator[str]:
    if not body.constants or body.consistency_p is None:
        return
    inertias = [
        f"{name} {row.estimate:.4g} +- {NINETY_FIVE * row.std:.2g}"
        if abs(row.estimate) > NINETY_FIVE * row.std
        else f"{name} below noise"
        for name, row in body.constants.items()
    ]
    if body.consistency_p < _SIGNIFICANCE:
        verdict = f"the alphas are not those of one rigid body, p = {body.consistency_p:.1g}"
    elif not body.is_rigid_body:
        verdict = "no rigid body has such inertias: one exceeds the sum of the other two"
    else:
        verdict = f"the alphas agree with one rigid body, p = {body.consistency_p:.2g}"
    yield f"inertias [kg m^2], 95 %: {', '.join(inertias)}; {verdict}."


def _validation(validation: Validation) -> str:
    if validation.fit is None:
        return f"validation on {validation.flight}: the model's trajectory diverges before the flight ends."
    channels = [
        f"{name} {row.percent:.1f} ({row.level**0.5:.2g})"
        for name, row in validation.fit.items()
        if row.percent is not None
    ]
    return f"validation on {validation.flight} [%] (residuals in multiples of the noise): {', '.join(channels)}."


def _of_vehicle(found: VehicleIdentification) -> Iterator[str | Listing]:
    yield _parameters(found, digits=4, with_bound=False)
    reasons: dict[str, list[str]] = {}
    for name, row in found.held.items():
        reasons.setdefault(row.note, []).append(f"{name} {row.value:.4g}")
    for reason, held in reasons.items():
        yield f"held, {reason}: {', '.join(held)}."
    inertias = [
        f"{name} {row.estimate:.4g} +- {NINETY_FIVE * row.std:.2g} ({row.note})"
        for name, row in found.rigid_body.constants.items()
    ]
    if inertias:
        yield f"inertias [kg m^2], 95 %: {', '.join(inertias)}."
    yield from _disturbances(found) if found.disturbances else _residual_levels(found)
    if found.widened:
        factors = ", ".join(f"{name} {factor:.1f}" for name, factor in found.widened.items())
        yield f"intervals widened, because parts of the flights disagree, by the factor: {factors}."
    if found.skill is not None:
        yield (
            "Predictions of data that were not fitted: 1 is perfect, 0 as good as constant rates; +- one standard "
            f"error ({found.skill.starts} starts)."
        )
        yield _skill(found.skill)
    used = found.provenance
    windows = "" if found.disturbances else f" in windows of {used['window']:g} s"
    yield (
        f"{found.estimator}, flight model ({', '.join(used['terms'])}), {used['fitted_seconds']:.0f} s{windows}, "
        f"a sample every {1e3 * used['sample_time']:g} ms: {found.result}, {found.rollouts} rollouts, "
        f"{found.seconds:.0f} s"
    )


def _disturbances(found: VehicleIdentification) -> Iterator[str]:
    rows = (f"{name} {x.strength:.2g} {x.unit} over {x.time_constant:.2g} s" for name, x in found.disturbances.items())
    yield f"disturbances that the model lacks, and their correlation time: {', '.join(rows)}."
    sensors = ", ".join(f"{name} {row.sensor:.2g}" for name, row in found.disturbances.items())
    yield f"white noise of the sensors [rad/s; m/s^2, of means over 0.25 s]: {sensors}."


def _residual_levels(found: VehicleIdentification) -> Iterator[str]:
    noise = ", ".join(f"{name} {sigma:.2g}" for name, sigma in found.noise.items())
    yield (
        f"residuals in a window [rad/s, m/s^2]: {noise}; the intervals allow for their correlation. "
        f"Outliers cut: {100 * found.cut:.0f} % (18 % is normal for Gaussian noise)."
    )


def _skill(skill: PredictionSkill) -> Listing:
    rows = []
    rates = (skill.p, skill.q, skill.r)
    for i, horizon in enumerate(skill.horizons):
        cells = [f"{_share(rate.skill[i])} +- {_share(rate.std[i])}" for rate in rates]
        rows.append((f"{horizon:.2f} s", *cells, ", ".join(_share(rate.equation_error[i]) for rate in rates)))
    return Listing(("ahead", "p", "q", "r", "equation error: p, q, r"), rows)


def _parameters(found: Identification, *, digits: int, with_bound: bool) -> Listing:
    rows = []
    for name, row in found.parameters.items():
        cells = ["-", "-", "-"]
        if row.estimate is not None and row.ci95 is not None:
            low, high = row.ci95
            bound = "-" if row.bound is None else f"{row.bound:.2g}"
            cells = [f"{row.estimate:.{digits}g}", f"[{low:.{digits}g}, {high:.{digits}g}]", bound]
        rows.append((name, row.unit, *cells[: 2 + with_bound]))
    headings = ("parameter", "unit", "estimate", "95 % interval", *["bound"] * with_bound)
    return Listing(headings, rows, ("estimate", "bound"), [row.note for row in found.parameters.values()])


def _share(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.2f}" if abs(value) < 100 else f"{value:.1e}"
