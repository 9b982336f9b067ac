"""The page that `jaxos4 estimate` prints."""

from typing import Any

import rich.box
from rich.console import Console
from rich.table import Table

from ..identification.vehicle import NO_ANSWER
from ..results import NINETY_FIVE

# Residuals whose neighbours correlate by more than this are not noise.
COLOURED = 0.3
# The share of fits of true models that a test of all channels' residuals may call wrong.
SIGNIFICANCE = 0.01


def print_flight(console: Console, report: dict[str, Any]) -> None:
    """An OS4: parameters, constants, and whether the model explains the flight."""
    if report["result"] == "nonfinite_trajectory":
        shoots = report["estimator"] in ("ibss", "hybrid", "output-error", "network")
        remedy = " (try a --window, or a shorter one)" if shoots else ""
        console.print(
            "No estimate: wherever the search went, the model's trajectory left this flight before its end. The "
            f"vehicle may do what the model lacks{remedy}, or the airframe's constants or the units are far off.",
            highlight=False,
        )
    if report["result"] in NO_ANSWER:
        return
    table = _table(("parameter", "unit", "estimate", "95 % interval", "bound", "note"))
    for name, row in report["parameters"].items():
        if row["estimate"] is None:
            table.add_row(name, row["unit"], "-", "-", "-", row["note"])
            continue
        low, high = row["ci95"]
        interval = f"[{low:.5g}, {high:.5g}]"
        table.add_row(name, row["unit"], f"{row['estimate']:.5g}", interval, f"{row['bound']:.2g}", row["note"])
    console.print(table, markup=False)
    below = [
        f"{name} {row['noise_limit']:.2g}"
        for name, row in report["parameters"].items()
        if "below noise" in row["note"] and row["noise_limit"]
    ]
    if below:
        console.print(
            "below noise: cannot be distinguished from 0. The airframe's values would show below this share of the "
            f"noise found: {', '.join(below)}.",
            highlight=False,
        )
    fit = report["fit"]
    shares = ", ".join(f"{name} {row['percent']:.1f}" for name, row in fit.items() if row["percent"] is not None)
    console.print("bound: Cramer-Rao, the least standard deviation that the noise found allows.", highlight=False)
    console.print(f"fit [%], 100 is a perfect prediction: {shares}.", highlight=False, markup=False)
    coloured = [name for name, row in fit.items() if row["correlation"] > COLOURED]
    if coloured and report["estimator"] == "network":
        console.print(
            f"The residuals of {', '.join(coloured)} are more than noise: the network's answer is not the best fit, "
            "within its intervals. The hybrid goes on from there, and says whether the model explains this flight.",
            highlight=False,
        )
    elif coloured:
        console.print(
            f"The residuals of {', '.join(coloured)} are not noise: the model does not explain this flight fully. The "
            "intervals allow for their colour where the estimator shoots, and are still too narrow for slow errors.",
            highlight=False,
        )
    _print_tests(console, fit, report["provenance"]["windows"])
    _print_constants(console, report["constants"])
    _print_validation(console, report["validation"])
    console.print(
        f"{report['estimator']}, {report['model']} model, {report['provenance']['channels']} channels: "
        f"{report['result']}, {report['rollouts']} rollouts, {report['seconds']:.1f} s",
        highlight=False,
    )


def _print_tests(console: Console, fit: dict[str, Any], windows: int) -> None:
    if not fit:
        return
    for what, key in (("white (Ljung-Box)", "white_p"), ("free of the inputs (cross-correlation)", "input_p")):
        failed = [name for name, row in fit.items() if row[key] * len(fit) < SIGNIFICANCE]
        if key == "white_p" and windows > 1:
            continue
        said = f"not those of {', '.join(failed)}" if failed else "all"
        console.print(f"residuals {what}, tests at {SIGNIFICANCE:.0%}: {said}.", highlight=False)


def _print_constants(console: Console, constants: dict[str, Any]) -> None:
    if not constants:
        return
    parts = [
        f"{name} {row['estimate']:.4g} +- {NINETY_FIVE * row['std']:.2g}"
        if abs(row["estimate"]) > NINETY_FIVE * row["std"]
        else f"{name} below noise"
        for name, row in constants.items()
        if isinstance(row, dict)
    ]
    agree = f"the alphas agree with one rigid body, p = {constants['consistency_p']:.2g}"
    if constants["consistency_p"] < SIGNIFICANCE:
        agree = f"the alphas are not those of one rigid body, p = {constants['consistency_p']:.1g}"
    elif not constants["rigid_body"]:
        agree = "no body has such inertias: one exceeds the sum of the others"
    console.print(f"inertias [kg m^2]: {', '.join(parts)}; {agree}.", highlight=False, markup=False)


def _print_validation(console: Console, validation: dict[str, Any] | None) -> None:
    if validation is None:
        return
    if validation["fit"] is None:
        console.print(
            f"validation on {validation['flight']}: the model's trajectory leaves it before its end.", highlight=False
        )
        return
    parts = [
        f"{name} {row['percent']:.1f} ({row['level'] ** 0.5:.2g})"
        for name, row in validation["fit"].items()
        if row["percent"] is not None
    ]
    console.print(
        f"validation on {validation['flight']} [%] (residuals in multiples of the noise): {', '.join(parts)}.",
        highlight=False,
        markup=False,
    )


def print_vehicle(console: Console, report: dict[str, Any]) -> None:
    """A real vehicle: parameters, inertias, and what the fit is worth on what it did not see."""
    if report["result"] in NO_ANSWER:
        return
    table = _table(("parameter", "unit", "estimate", "95 % interval", "note"))
    for name, row in report["parameters"].items():
        if row["estimate"] is None:
            table.add_row(name, row["unit"], "-", "-", row["note"])
            continue
        low, high = row["ci95"]
        table.add_row(name, row["unit"], f"{row['estimate']:.4g}", f"[{low:.4g}, {high:.4g}]", row["note"])
    console.print(table, markup=False)
    reasons: dict[str, list[str]] = {}
    for name, row in report["held"].items():
        reasons.setdefault(row["note"], []).append(f"{name} {row['value']:.4g}")
    for why, held in reasons.items():
        console.print(f"held, {why}: {', '.join(held)}.", highlight=False, markup=False)
    inertias = {name: row for name, row in report["constants"].items() if isinstance(row, dict)}
    if inertias:
        told = [
            f"{name} {row['estimate']:.4g} +- {NINETY_FIVE * row['std']:.2g} ({row['note']})"
            for name, row in inertias.items()
        ]
        console.print(f"inertias [kg m^2], 95 %: {', '.join(told)}.", highlight=False, markup=False)
    noise = ", ".join(f"{name} {value:.2g}" for name, value in report["noise"].items())
    console.print(
        f"left unexplained in a window (rad/s, m/s^2): {noise}; the intervals allow for its colour. "
        f"Outliers cut: {100 * report['cut']:.0f} % (of Gaussian noise it would be 18 %).",
        highlight=False,
    )
    _print_skill(console, report["skill"])
    used = report["provenance"]
    console.print(
        f"{report['estimator']}, flight model ({', '.join(used['terms'])}), {used['fitted_seconds']:.0f} s in windows "
        f"of {used['window']:g} s, a sample every {1e3 * used['sample_time']:g} ms: {report['result']}, "
        f"{report['rollouts']} rollouts, {report['seconds']:.0f} s",
        highlight=False,
    )


def _print_skill(console: Console, skill: dict[str, Any] | None) -> None:
    if skill is None:
        return
    console.print(
        "Predictions of what was not fitted: 1 is perfect, 0 as good as rates that stay as they are; +- one standard "
        f"error ({skill['starts']} starts).",
        highlight=False,
    )
    table = _table(("ahead", "p", "q", "r", "equation error: p, q, r"))
    for i, horizon in enumerate(skill["horizons"]):
        cells = [f"{_number(skill[rate]['skill'][i])} +- {_number(skill[rate]['std'][i])}" for rate in "pqr"]
        theirs = ", ".join(_number(skill[rate]["equation_error"][i]) for rate in "pqr")
        table.add_row(f"{horizon:.2f} s", *cells, theirs)
    console.print(table, markup=False)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"


def _table(headings: tuple[str, ...]) -> Table:
    table = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, 1, 0, 0))
    for heading in headings:
        right = heading in ("estimate", "bound")
        table.add_column(heading, justify="right" if right else "left", no_wrap=heading != "note")
    return table
