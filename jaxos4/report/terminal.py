"""The table of a study's errors, for a terminal."""

import rich.box
import xarray as xr
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from . import tables
from .scenario import scenarios


def error_table(dataset: xr.Dataset) -> RenderableType:
    """`tables.error_table` of each scenario, then the notes that explain the marks."""
    parts: list[RenderableType] = []
    notes: dict[str, None] = {}
    for scenario in scenarios(dataset):
        table = tables.error_table(scenario.data, digits=2)
        parts += [Text(f"RMS error [%], {scenario.label}"), _rich(table)]
        notes |= dict.fromkeys(table.notes)
    return Group(*parts, *(Text(note) for note in notes))


def _rich(table: tables.Table) -> Table:
    made = Table(box=rich.box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=0)  # 80 columns must do
    rows = [row for group in table.groups for row in group.rows]
    labels = (*(row.label for row in rows), *(group.label for group in table.groups))
    made.add_column("", no_wrap=True, min_width=max(map(len, labels), default=0))
    for i, heading in enumerate(table.headings):
        cells = (row.cells[i] for row in rows)
        widest = max(len(heading), *(len(cell.text) + len(cell.mark) for cell in cells))
        made.add_column(Text(heading), justify="right", no_wrap=True, min_width=widest)
    for group in table.groups:
        made.add_row(Text(group.label, style="bold"))
        for row in group.rows:
            last = row is group.rows[-1] and group is not table.groups[-1]
            made.add_row(Text(row.label), *(Text(f"{cell.text}{cell.mark}") for cell in row.cells), end_section=last)
    return made
