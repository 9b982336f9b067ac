"""RMSE / bound against the noise scale, and coverage: with this many flights, to a hundredth."""

from pathlib import Path

import typer

from jaxos4.report import read_results
from jaxos4.report.experiment import write_figure
from jaxos4.report.figures_noise import efficiency
from jaxos4.report.figures_spread import coverage
from jaxos4.study import metrics


def main(results: Path, figures: Path) -> None:
    """Draws what `jaxos4 study` wrote."""
    data = read_results(results).squeeze([d for d in metrics.SCENARIO if d not in ("scale", "estimator")])
    write_figure(lambda: efficiency(data), figures, "scale-efficiency")
    write_figure(lambda: coverage(data), figures, "scale-coverage")


if __name__ == "__main__":
    typer.run(main)
