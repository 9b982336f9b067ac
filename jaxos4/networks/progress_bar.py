"""A bar in the terminal that shows how far a training is."""

import contextlib
from collections.abc import Iterator

from rich.console import Console
from rich.progress import BarColumn, Progress as Bar, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .training import Progress


@contextlib.contextmanager
def training_bar(steps: int) -> Iterator[Progress]:
    """Shows a bar on the error output while the block runs; shows nothing unless that is a terminal."""
    name, loss = TextColumn("training the network"), TextColumn("loss {task.fields[loss]}")
    console = Console(stderr=True)
    columns = (name, BarColumn(), loss, TimeElapsedColumn(), TimeRemainingColumn())
    with Bar(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("", total=steps, loss="-")

        def update(done: int, steps: int, loss: float) -> None:
            bar.update(task, completed=done, total=steps, loss=f"{loss:.4g}")

        yield update
