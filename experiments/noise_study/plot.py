"""RMS error and bound of each parameter, and RMSE / bound, against the noise scale."""

import sys
from pathlib import Path

import typer

from jaxos4.report.study_page import efficiency, errors
from jaxos4.study import metrics, read_results

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from shared import write_figure


def main(results: Path, figures: Path) -> None:
    """Draws the results of `jaxos4 study`."""
    data = read_results(results).squeeze([d for d in metrics.SCENARIO if d not in ("scale", "estimator")])
    write_figure(lambda: errors(data), figures, "noise_study-error")
    write_figure(lambda: efficiency(data), figures, "noise_study-efficiency")


if __name__ == "__main__":
    typer.run(main)
