"""A study in a terminal: a progress bar while it runs, and at its end the outcomes and the table of errors."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import rich.box
import xarray as xr
from rich.console import Console, Group, RenderableType
from rich.progress import BarColumn, MofNCompleteColumn, Progress, SpinnerColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from ..study import OUTCOMES, Step, Store, Study, carry_out, device_name, run_here
from . import study_tables
from .study_data import scenarios


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
        table = study_tables.error_table(scenario.data, digits=2)
        parts += [Text(f"RMS error [%], {scenario.label}"), _rich(table)]
        notes |= dict.fromkeys(table.notes)
    return Group(*parts, *(Text(note) for note in notes))


def _rich(table: study_tables.Table) -> Table:
    made = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=0)  # 80 columns must do
    rows = [row for _, rows in table.groups for row in rows]
    labels = [*(row.label for row in rows), *(label for label, _ in table.groups)]
    made.add_column("", no_wrap=True, min_width=max(map(len, labels), default=0))
    for i, (heading, _) in enumerate(table.headings):
        widest = max(len(heading), *(len(row.cells[i].text) + len(row.cells[i].mark) for row in rows))
        made.add_column(Text(heading), justify="right", no_wrap=True, min_width=widest)
    for label, group in table.groups:
        made.add_row(Text(label, style="bold"))
        for row in group:
            made.add_row(Text(row.label), *(Text(f"{cell.text}{cell.mark}") for cell in row.cells))
        made.add_section()
    return made
