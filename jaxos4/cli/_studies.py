"""What `study` and `compare` share: a bar over the cells, and the Dataset at the end."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import typer
import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

from ..study import OUTCOMES, Step, Store, Study, assemble, open_store, save_dataset


def carry_out(study: Study, out: Path, device: str, run: Callable[[Store], Iterator[Step]]) -> xr.Dataset:
    """Runs what is missing of a study, with a bar, and writes its Dataset. Raises as `open_store` and the run do."""
    console = Console(stderr=True)
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    with open_store(out, study, device) as store:
        bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        task = bar.add_task("", total=study.count)
        with bar:
            try:
                for step in run(store):
                    bar.update(task, completed=step.done, description=step.label)
            except KeyboardInterrupt:
                typer.echo(f"jaxos4: {out}: interrupted; the same command goes on where it was.", err=True)
                raise
            bar.update(task, description="writing the Dataset")
            dataset = assemble(store)
            save_dataset(dataset, out)
    return dataset


def summary(dataset: xr.Dataset) -> str:
    """How many estimates there are, and how they ended."""
    codes, counts = np.unique(dataset["result"].to_numpy(), return_counts=True)
    ends = ", ".join(f"{count} {OUTCOMES[code]}" for code, count in zip(codes, counts, strict=True))
    return f"{dataset['result'].size} estimates: {ends}"
