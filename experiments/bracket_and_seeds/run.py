"""What network and hybrid owe to the width of the bracket, and to the seed of the training: a folder for each seed."""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from jaxos4.report.experiment import run_studies, use_all_cores
from jaxos4.study import load_study


def main(
    specification: Path,
    out: Annotated[Path, typer.Option(help="Folder for the studies: new, or to be resumed.")],
    seeds: Annotated[list[int], typer.Option(help="Of the networks.")] = (0, 1, 2),
) -> None:
    """Runs the study once for each seed of the networks; the flights are the same."""
    study = load_study(specification)
    run_studies({f"seed {s}": replace(study, network=replace(study.network, seed=s)) for s in seeds}, out)


if __name__ == "__main__":
    use_all_cores()
    typer.run(main)
