"""The stage that a computation is in, for a terminal."""

import contextlib
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def stages(first: str) -> Iterator[Callable[[str], None]]:
    """Shows a stage and the time; gives a function that changes the stage. Shows nothing if stderr is no terminal."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    columns = (SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task(first, total=None)
        yield lambda stage: bar.update(task, description=stage)
