"""Shared by the commands: progress, the exit code, and files."""

import contextlib
import json
import re
import shlex
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from .._files import check_writable, write_file
from ..errors import InputError, printable
from .options import as_typed


def command() -> str:
    """The command line as the user can repeat it."""
    return printable(shlex.join(["jaxos4", *sys.argv[1:]]))


def console() -> Any:
    """A console that prints texts of the library with the options of this command in them."""
    from rich.console import Console

    class Shown(Console):
        def print(self, *given: Any, **how: Any) -> None:
            super().print(*(as_typed(each) if isinstance(each, str) else each for each in given), **how)

    return Shown(highlight=False, markup=False)


PERIOD = 10.0  # s; between lines of progress


def showing_stages(first: str, total: int | None = None) -> contextlib.AbstractContextManager[Callable[..., None]]:
    """Shows a stage, the time, and how much of a `total` is done. Yields a function that changes them.

    A terminal has one status, which moves; another stderr gets a line from time to time.
    """
    is_terminal = sys.stderr is not None and sys.stderr.isatty()
    return (_status if is_terminal else _lines)(first, total)


@contextlib.contextmanager
def _lines(first: str, total: int | None) -> Iterator[Callable[..., None]]:
    now, begin, ended = [first, None], time.monotonic(), threading.Event()

    def tell() -> None:
        while not ended.wait(PERIOD):
            stage, done = now
            share = f" ({done} of {total})" if total and done is not None else ""
            with contextlib.suppress(OSError, ValueError, AttributeError):  # a stderr that is closed, or `None`
                sys.stderr.write(f"jaxos4: {stage}{share}, {time.monotonic() - begin:.0f} s\n")
                sys.stderr.flush()

    def change(stage: str, done: int | None = None) -> None:
        now[:] = stage, done

    threading.Thread(target=tell, daemon=True).start()
    try:
        yield change
    finally:
        ended.set()


@contextlib.contextmanager
def _status(first: str, total: int | None) -> Iterator[Callable[..., None]]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        SpinnerColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    columns = (BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()) if total else ()
    columns = (SpinnerColumn(), "{task.description}", TimeElapsedColumn(), *columns)
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(first, total=total)
        yield lambda stage, done=None: bar.update(task, description=stage, completed=done)


def check_outputs(*inputs: Path | str | None, **outputs: Path | None) -> None:
    """Refuses outputs that cannot be written, overwrite an input, or are one file. `outputs`: by their options."""
    sources = [Path(source) for source in inputs if source is not None and Path(source).exists()]
    names: dict[Path, str] = {}
    for name, out in outputs.items():
        if out is None:
            continue
        target, option = check_writable(out), f"--{name.replace('_', '-')}"
        if name == "figure" and out.suffix != ".svg":
            raise InputError(f"--figure {out}: the figure is an SVG file; give it a name that ends in .svg.")
        if target.exists() and any(source.samefile(target) for source in sources):
            raise InputError(f"{out}: would overwrite an input; give the output another name.")
        if (other := names.setdefault(target, option)) != option:
            raise InputError(f"{out}: {other} and {option} name one file; give them two.")


def end(result: str) -> None:
    """Ends a command with exit code 1 if a result, by its name, is not to be trusted."""
    from ..results import meaning

    if result != "successful":
        typer.echo(f"jaxos4: {result}: {meaning(result)}", err=True)
        raise typer.Exit(1)


def write_json(report: dict[str, Any], out: Path) -> None:
    """Writes a JSON file."""
    write_file(out, json_text(report))


def json_text(report: dict[str, Any]) -> str:
    """JSON with each list of numbers on one line. A number that is not finite is an error of the program."""
    text = json.dumps(report, indent=2, allow_nan=False)
    # No string has a line break, because JSON escapes it.
    return re.sub(r"\[(\n\s+[^][{}\"]*)\]", lambda numbers: f"[{' '.join(numbers[1].split())}]", text) + "\n"
