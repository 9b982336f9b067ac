"""The report of a benchmark as tables on the terminal."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from experiments.benchmarks.contenders import is_ours
from experiments.monte_carlo import print_table

_TIME, _MEMORY = "ms / flight (least, most)", "memory [MiB]"
_WIDTH = 190


def print_report(report: dict[str, Any]) -> None:
    """Prints each part of the report that is there."""
    for start, rows in report["fits"].items():
        speeds = "times as fast as compiled CasADi", "times as fast as C"
        headings = "method", "flights", _TIME, *speeds, "processor [ms / flight]", _MEMORY, "optimum reached [%]"
        print_table(f"fits, {start} initial state", headings, _fits(rows), _WIDTH)
    headings = "method", "million steps / s", "ms / shot (least, most)", "times as fast as C, 8 lanes", _MEMORY
    print_table("shots", headings, _shots(report["shots"]), _WIDTH)
    if rows := report["growth"]:
        print_table("growth", ("with", "size", _TIME, _MEMORY), _growth(rows), _WIDTH)
        headings = "with", "from", "to", "exponent of time", "exponent of memory"
        print_table("growth: exponents", headings, _exponents(rows), _WIDTH)
    if rows := report["networks"]:
        headings = "method", "training [s]", "ms / flight", "RMSE / bound"
        print_table("networks on the rates", headings, _networks(rows), _WIDTH)
    if found := report["roofline"]:
        print_table("roofline", ("", "value"), _roofline(found), _WIDTH)
    for line in report["skipped"]:
        print(f"skipped: {line}")


def _fits(rows: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The opponents from the fastest to the slowest, and then the methods of this package."""

    def place(item: tuple[str, dict[str, Any]]) -> tuple[bool, float]:
        name, row = item
        return is_ours(name), row.get("median_seconds", np.inf)

    for name, row in sorted(rows.items(), key=place):
        flights, reached = str(row["flights"]), f"{100 * row['reached']:.4g}"
        if "laps" not in row:
            yield name, flights, "not timed", "", "", "", "", reached
        else:
            processor, peak = f"{1e3 * row['processor_seconds']:.3g}", f"{row['peak_mib']:.0f}"
            yield name, flights, _spread(row), _ratio(row, "CasADi"), _ratio(row, "C,"), processor, peak, reached


def _shots(rows: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for name, row in rows.items():
        yield name, f"{row['steps_per_second'] / 1e6:.3g}", _spread(row), _ratio(row, "C,"), f"{row['peak_mib']:.0f}"


def _growth(rows: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    for row in rows:
        yield row["axis"], f"{row['size']:,}", _spread(row), f"{row['peak_mib']:.0f}"


def _exponents(rows: list[dict[str, Any]]) -> Iterator[tuple[str, ...]]:
    """Of the time and the peak memory of all flights, fitted to the larger half of the sizes."""
    for axis in dict.fromkeys(row["axis"] for row in rows):
        some = [row for row in rows if row["axis"] == axis]
        some = some[min(len(some) // 2, max(len(some) - 2, 0)) :]
        if len(some) > 1:
            sizes = np.log([row["size"] for row in some])
            times = np.log([row["median_seconds"] * row["flights"] for row in some])
            memory = np.log([row["peak_mib"] for row in some])
            exponents = [f"{np.polyfit(sizes, y, 1)[0]:.2f}" for y in (times, memory)]
            yield axis, f"{some[0]['size']:,}", f"{some[-1]['size']:,}", *exponents


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


def _ratio(row: dict[str, Any], tool: str) -> str:
    """How many times as fast as its rival of this tool it is: median, least and most."""
    found = next((ratio for rival, ratio in row["ratios"].items() if rival.startswith(tool)), None)
    return "{:.3g} ({:.3g}, {:.3g})".format(*found) if found else ""
