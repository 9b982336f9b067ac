"""The report of a benchmark as tables on the terminal."""

from collections.abc import Iterator
from typing import Any

from experiments.monte_carlo import print_table

_RATIO = "times faster"
_WIDTH = 120


def print_report(report: dict[str, Any]) -> None:
    """Prints each part of the report that is there."""
    for start, rows in report["fits"].items():
        title = f"{start} initial state; median (least, most) of the laps; ratios to CasADi, single shooting"
        headings = "method", "flights", "ms / flight", _RATIO, "CPU ms", "MiB", "reached"
        print_table(title, headings, _fits(rows), _WIDTH)
    headings = "method", "M steps/s", "ms / shot", _RATIO, "MiB"
    print_table("shots; ratios to C -O3, one core", headings, _shots(report["shots"]), _WIDTH)
    if rows := report["growth"]:
        print_table("growth", ("with", "size", "ms / flight", "MiB"), _growth(rows), _WIDTH)
    if rows := report["networks"]:
        headings = "method", "training [s]", "ms / flight", "RMSE / bound"
        print_table("networks on the rates", headings, _networks(rows), _WIDTH)
    if found := report["roofline"]:
        print_table("roofline", ("", "value"), _roofline(found), _WIDTH)
    for line in report["skipped"]:
        print(f"skipped: {line}")


def _fits(rows: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, row in sorted(rows.items(), key=lambda item: item[1].get("median_seconds", float("inf"))):
        flights, reached = str(row["flights"]), f"{100 * row['reached']:.4g} %"
        if "laps" not in row:
            yield name, flights, "not timed", "", "", "", reached
        else:
            processor, peak = f"{1e3 * row['processor_seconds']:.3g}", f"{row['peak_mib']:.0f}"
            yield name, flights, _spread(row), _ratio(row), processor, peak, reached


def _shots(rows: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, row in rows.items():
        yield name, f"{row['steps_per_second'] / 1e6:.3g}", _spread(row), _ratio(row), f"{row['peak_mib']:.0f}"


def _growth(rows: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    for row in rows:
        yield row["axis"], str(row["size"]), _spread(row), f"{row['peak_mib']:.0f}"


def _networks(rows: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, row in rows.items():
        low, high = min(row["rmse_in_bounds"]), max(row["rmse_in_bounds"])
        answer = f"{1e3 * row['median_seconds']:.3g}"
        yield name, f"{row['training_seconds']:.3g}", answer, f"{low:.3g} to {high:.3g}"


def _roofline(found: dict[str, float]) -> Iterator[tuple[str, ...]]:
    operations, moved = found["operations_per_step"], found["bytes_per_step"]
    yield "operations of one step", f"{operations:.0f}"
    yield "bytes of one step, if nothing stays in a cache", f"{moved:.0f}"
    yield "peak, matrix product [Gop/s]", f"{found['peak_operations_per_second'] / 1e9:.3g}"
    yield "peak, copy of a stream [GB/s]", f"{found['peak_bytes_per_second'] / 1e9:.3g}"
    if "share" in found:
        yield "reached by our shots [Gop/s]", f"{found['operations_per_second'] / 1e9:.3g}"
        yield "share of the peak [%]", f"{100 * found['share']:.3g}"


def _spread(row: dict[str, Any]) -> str:
    median, least, most = (1e3 * row[f"{which}_seconds"] for which in ("median", "min", "max"))
    return f"{median:.3g} ({least:.3g}, {most:.3g})"


def _ratio(row: dict[str, Any]) -> str:
    if "ratio" not in row:
        return ""
    return "{:.3g} ({:.3g}, {:.3g})".format(*row["ratio"])
