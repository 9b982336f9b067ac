"""A study in a terminal: a progress bar while it runs, and at its end the outcomes and the table of errors."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import xarray as xr
from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.text import Text

from ..study import OUTCOMES, Step, Store, Study, carry_out, device_name, run_here
from . import study_tables
from .study_data import scenarios
from .text import Listing


def run_with_bar(
    study: Study, out: Path, *, device: str | None = None, run: Callable[[Store], Iterator[Step]] = run_here
) -> xr.Dataset:
    """`jaxos4.study.carry_out` with a progress bar on stderr. `device`: by default the devices of this process."""
    console = Console(stderr=True)
    columns = (BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn())
    columns = (SpinnerColumn(), "{task.description}", *columns)
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


def error_table(dataset: xr.Dataset) -> RenderableType:
    """The table of errors of each scenario, then the notes that explain the marks."""
    parts: list[RenderableType] = []
    notes: dict[str, None] = {}
    for scenario in scenarios(dataset):
        table, rows = study_tables.error_table(scenario.data, digits=2), []
        headings = [heading for heading, _ in table.headings]
        blank = [""] * len(headings)
        for label, group in table.groups:
            rows += [["", *blank]] * bool(rows) + [[label, *blank]]
            rows += [[row.label, *(cell.text + cell.mark for cell in row.cells)] for row in group]
        listing = Listing(["", *headings], rows, headings, apart=1)  # 80 columns must do
        parts += [Text(f"RMS error [%], {scenario.label}"), listing.table()]
        notes |= dict.fromkeys(table.notes)
    return Group(*parts, *(Text(note) for note in notes))
