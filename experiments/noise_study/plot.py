"""RMS error with the bound, and RMSE / bound, of each parameter against the noise scale."""

from pathlib import Path

import typer

from jaxos4.report import read_results
from jaxos4.report.experiment import write_figure
from jaxos4.report.figures_noise import efficiency, errors
from jaxos4.study import metrics


def main(results: Path, figures: Path) -> None:
    """Draws what `jaxos4 study` wrote."""
    data = read_results(results).squeeze([d for d in metrics.SCENARIO if d not in ("scale", "estimator")])
    write_figure(lambda: errors(data), figures, "noise_study-error")
    write_figure(lambda: efficiency(data), figures, "noise_study-efficiency")


if __name__ == "__main__":
    typer.run(main)
