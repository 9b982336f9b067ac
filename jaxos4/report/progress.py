"""A study run with a progress bar in the terminal."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from ..study import OUTCOMES, Step, Store, Study, carry_out, device_name, run_here


def run_with_bar(
    study: Study, out: Path, *, device: str | None = None, run: Callable[[Store], Iterator[Step]] = run_here
) -> xr.Dataset:
    """`jaxos4.study.carry_out` with a progress bar on stderr. `device`: by default the devices of this process."""
    console = Console(stderr=True)
    label = TextColumn("{task.description}")
    columns = (SpinnerColumn(), label, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("compiling", total=study.count)

        def show(step: Step) -> None:
            bar.update(task, completed=step.done, description=step.label)

        try:
            return carry_out(study, out, device or device_name(), run=run, progress=show)
        except KeyboardInterrupt:
            text = f"jaxos4: {out}: interrupted; run the same command again to continue."
            console.print(text, soft_wrap=True, markup=False, highlight=False)
            raise


def count_outcomes(dataset: xr.Dataset) -> str:
    """The number of estimates in a study's Dataset, and how they ended, in words."""
    codes, counts = np.unique(dataset["result"].to_numpy(), return_counts=True)
    outcomes = ", ".join(f"{count} {OUTCOMES[code]}" for code, count in zip(codes, counts, strict=True))
    return f"{dataset['result'].size} estimates: {outcomes}"
