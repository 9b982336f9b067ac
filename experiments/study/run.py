"""Runs the study of a folder that has no script of its own, as `jaxos4 study` does, and prints its table."""

from pathlib import Path
from typing import Annotated

import typer

from experiments.shared import run_studies
from jaxos4.study import load_study


def main(
    specification: Path, out: Annotated[Path, typer.Option(help="Folder of the study: a new one, or one to resume.")]
) -> None:
    """Run a study."""
    run_studies({"": load_study(specification)}, out)
