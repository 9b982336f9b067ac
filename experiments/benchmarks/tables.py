"""The report of a benchmark as tables on the terminal."""

from typing import Any

from rich.console import Console
from shared import table_of

_RATIO = "times faster"


def print_report(console: Console, report: dict[str, Any]) -> None:
    """Prints each part of the report that is there."""
    for start, rows in report["fits"].items():
        _print_fits(console, start, rows)
    _print_shots(console, report["shots"])
    _print_growth(console, report["growth"])
    _print_networks(console, report["networks"])
    _print_roofline(console, report["roofline"])
    for line in report["skipped"]:
        console.print(f"skipped: {line}", highlight=False, markup=False)


def _print_fits(console: Console, start: str, rows: dict[str, Any]) -> None:
    headings = ("method", "flights", "ms / flight", _RATIO, "CPU ms", "MiB", "reached")
    table = table_of(
        f"{start} initial state; median (least, most) of the laps; ratios to CasADi, single shooting", headings
    )
    for name, row in sorted(rows.items(), key=lambda item: item[1].get("median_seconds", float("inf"))):
        reached = f"{100 * row['reached']:.4g} %"
        if "laps" not in row:
            table.add_row(name, str(row["flights"]), "not timed", "", "", "", reached)
            continue
        table.add_row(
            name,
            str(row["flights"]),
            _spread(row),
            _ratio(row),
            f"{1e3 * row['processor_seconds']:.3g}",
            f"{row['peak_mib']:.0f}",
            reached,
        )
    console.print(table)


def _print_shots(console: Console, rows: dict[str, Any]) -> None:
    table = table_of("shots; ratios to C -O3, one core", ("method", "M steps/s", "ms / shot", _RATIO, "MiB"))
    for name, row in rows.items():
        rate = f"{row['steps_per_second'] / 1e6:.3g}"
        table.add_row(name, rate, _spread(row), _ratio(row), f"{row['peak_mib']:.0f}")
    console.print(table)


def _print_growth(console: Console, rows: list[dict[str, Any]]) -> None:
    if not rows:
        return
    table = table_of("growth", ("with", "size", "ms / flight", "MiB"))
    for row in rows:
        table.add_row(row["axis"], str(row["size"]), _spread(row), f"{row['peak_mib']:.0f}")
    console.print(table)


def _print_networks(console: Console, rows: dict[str, Any]) -> None:
    if not rows:
        return
    table = table_of("networks on the rates", ("method", "training [s]", "ms / flight", "RMSE / bound"))
    for name, row in rows.items():
        low, high = min(row["rmse_in_bounds"]), max(row["rmse_in_bounds"])
        answer = f"{1e3 * row['median_seconds']:.3g}"
        table.add_row(name, f"{row['training_seconds']:.3g}", answer, f"{low:.3g} to {high:.3g}")
    console.print(table)


def _print_roofline(console: Console, found: dict[str, float]) -> None:
    if not found:
        return
    operations, moved = found["operations_per_step"], found["bytes_per_step"]
    table = table_of("roofline", ("", "value"))
    table.add_row("operations of one step", f"{operations:.0f}")
    table.add_row("bytes of one step, if nothing stays in a cache", f"{moved:.0f}")
    table.add_row("peak, matrix product [Gop/s]", f"{found['peak_operations_per_second'] / 1e9:.3g}")
    table.add_row("peak, copy of a stream [GB/s]", f"{found['peak_bytes_per_second'] / 1e9:.3g}")
    if "share" in found:
        table.add_row("reached by our shots [Gop/s]", f"{found['operations_per_second'] / 1e9:.3g}")
        table.add_row("share of the peak [%]", f"{100 * found['share']:.3g}")
    console.print(table)


def _spread(row: dict[str, Any]) -> str:
    median, least, most = (1e3 * row[f"{which}_seconds"] for which in ("median", "min", "max"))
    return f"{median:.3g} ({least:.3g}, {most:.3g})"


def _ratio(row: dict[str, Any]) -> str:
    if "ratio" not in row:
        return ""
    return "{:.3g} ({:.3g}, {:.3g})".format(*row["ratio"])
