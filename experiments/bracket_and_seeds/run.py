"""How do the network and the hybrid depend on the width of the bracket and on the random seed of the training?"""

from pathlib import Path
from typing import Annotated

import typer
from msgspec.structs import replace

from experiments.shared import run_studies
from jaxos4.study import load_study


def main(
    specification: Path,
    out: Annotated[Path, typer.Option(help="Folder for the studies, new or to be resumed.")],
    seeds: Annotated[list[int], typer.Option(help="Random seeds for training the networks.")] = (0, 1, 2),
) -> None:
    """Run the study once for each training seed, on the same flights, in a folder for each seed."""
    study = load_study(specification)
    run_studies({f"seed {s}": replace(study, network=replace(study.network, seed=s)) for s in seeds}, out)
