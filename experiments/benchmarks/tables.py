"""The report of a benchmark as tables on the terminal."""

from collections.abc import Iterator

import numpy as np

from experiments.benchmarks.contenders import is_ours
from experiments.monte_carlo import Column, Row, print_rows, print_table


def print_report(report: Row) -> None:
    """Prints each part of the report that is there."""
    for start, rows in report["fits"].items():
        print_rows(f"fits, {start} initial state", _named(dict(sorted(rows.items(), key=_place))), FITS)
    print_rows("shots", _named(report["shots"]), SHOTS)
    if rows := report["growth"]:
        print_rows("growth", rows, {"with": "axis", "size": lambda row: f"{row['size']:,}", **TIME, **MEMORY})
        headings = "with", "from", "to", "exponent of time", "exponent of memory"
        print_table("growth: exponents", headings, _exponents(rows))
    if rows := report["networks"]:
        print_rows("networks on the rates", _named(rows), NETWORKS)
    if found := report["roofline"]:
        print_table("roofline", ("", "value"), _roofline(found))
    for line in report["skipped"]:
        print(f"skipped: {line}")


def _named(rows: dict[str, Row]) -> list[Row]:
    return [{"name": name} | row for name, row in rows.items()]


def _place(item: tuple[str, Row]) -> tuple[bool, float]:
    """The opponents from the fastest to the slowest, and then the methods of this package."""
    name, row = item
    return is_ours(name), row.get("median_seconds", np.inf)


def _exponents(rows: list[Row]) -> Iterator[tuple[str, ...]]:
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


def _roofline(found: dict[str, float]) -> Iterator[tuple[str, ...]]:
    yield "operations of one step", f"{found['operations_per_step']:.0f}"
    yield "bytes of one step, if nothing stays in a cache", f"{found['bytes_per_step']:.0f}"
    yield "peak, matrix product [Gop/s]", f"{found['peak_operations_per_second'] / 1e9:.3g}"
    yield "peak, copy of a stream [GB/s]", f"{found['peak_bytes_per_second'] / 1e9:.3g}"
    if "share" in found:
        yield "reached by our shots [Gop/s]", f"{found['operations_per_second'] / 1e9:.3g}"
        yield "share of the peak [%]", f"{100 * found['share']:.3g}"


def _spread(row: Row) -> str:
    if "laps" not in row:
        return "not timed"
    median, least, most = (1e3 * row[f"{which}_seconds"] for which in ("median", "min", "max"))
    return f"{median:.3g} ({least:.3g}, {most:.3g})"


def _ratio(row: Row, tool: str) -> str | None:
    """How many times as fast as its rival of this tool it is: median, least and most."""
    found = next((ratio for rival, ratio in row["ratios"].items() if rival.startswith(tool)), None)
    return "{:.3g} ({:.3g}, {:.3g})".format(*found) if found else None


TIME: dict[str, Column] = {"ms / flight (least, most)": _spread}
MEMORY: dict[str, Column] = {"memory [MiB]": lambda row: f"{row['peak_mib']:.0f}" if "laps" in row else None}
FITS: dict[str, Column] = {
    "method": "name",
    "flights": "flights",
    **TIME,
    "times as fast as compiled CasADi": lambda row: _ratio(row, "CasADi"),
    "times as fast as C": lambda row: _ratio(row, "C,"),
    "processor [ms / flight]": lambda row: 1e3 * row["processor_seconds"] if "laps" in row else None,
    **MEMORY,
    "optimum reached [%]": lambda row: f"{100 * row['reached']:.4g}",
}
SHOTS: dict[str, Column] = {
    "method": "name",
    "million steps / s": lambda row: row["steps_per_second"] / 1e6,
    "ms / shot (least, most)": _spread,
    "times as fast as C, 8 lanes": lambda row: _ratio(row, "C,"),
    **MEMORY,
}
NETWORKS: dict[str, Column] = {
    "method": "name",
    "training [s]": "training_seconds",
    "ms / flight": lambda row: 1e3 * row["median_seconds"],
    "RMSE / bound": lambda row: f"{min(row['rmse_in_bounds']):.3g} to {max(row['rmse_in_bounds']):.3g}",
}
