"""RMSE / bound and coverage against the noise scale; with 10,000 flights their error is below 0.01."""

import sys
from pathlib import Path

import typer

from jaxos4.report.study_page import coverage, efficiency
from jaxos4.study import metrics, read_results

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import write_figure


def main(results: Path, figures: Path) -> None:
    """Draws the results of `jaxos4 study`."""
    data = read_results(results).squeeze([d for d in metrics.SCENARIO if d not in ("scale", "estimator")])
    write_figure(lambda: efficiency(data), figures, "scale-efficiency")
    write_figure(lambda: coverage(data), figures, "scale-coverage")


if __name__ == "__main__":
    typer.run(main)
