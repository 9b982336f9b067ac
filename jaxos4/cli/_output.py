"""Output of the commands: progress, the library's messages with names of options, and files, whole or not at all."""

import contextlib
import json
import re
import secrets
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import typer

from .._files import check_writable, write_file
from ..errors import InputError, printable

_ARGUMENTS = ("angle", "bandwidth", "bracket", "channels", "criterion", "distance", "dt", "duration", "estimator")
_ARGUMENTS += ("fastest", "gust", "holdout", "horizon", "inertia_z", "initial_state", "network", "rate", "sample_time")
_ARGUMENTS += ("samples", "seed", "slew", "slowest", "spacing", "terms", "validate", "velocity", "window")
OPTIONS = {
    "an `Airframe` as `subject`": "--model flight",
    "`subject`": "--model",
    "`begin`": "--from",
    "`end`": "--to",
    **{f"`{name}`": f"--{name.replace('_', '-')}" for name in _ARGUMENTS},
}
"""Options by the library's arguments, which stand in backticks in its messages."""


def in_options(text: str, **files: Path | None) -> str:
    """A message with options for the library's arguments. `files`: names of files to print behind an option."""
    for argument, option in OPTIONS.items():
        path = files.get(argument.strip("`"))
        text = text.replace(argument, option if path is None else f"{option} {path}")
    return text


def command() -> str:
    """The command line as the user can repeat it."""
    return printable(shlex.join(["jaxos4", *sys.argv[1:]]))


@contextlib.contextmanager
def option_names(**files: Path | None) -> Iterator[None]:
    """Raises an `InputError` of the library again, in the words of the command line. `files`: see `in_options`."""
    try:
        yield
    except InputError as error:
        raise InputError(in_options(str(error), **files)) from None


@contextlib.contextmanager
def stages(first: str, total: int | None = None) -> Iterator[Callable[..., None]]:
    """Shows a stage and the time, and a bar if there is a `total`. Shows nothing if stderr is no terminal.

    Yields a function that changes the stage, and what is done of the total.
    """
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
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as bar:
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


def write_folder(texts: dict[str, str], folder: Path) -> None:
    """Writes text files, by name, into a new folder. It appears when all files are in it."""
    beside = folder.with_name(f".{folder.name[:40]}.{secrets.token_hex(4)}.part")
    try:
        beside.mkdir()
        for name, text in texts.items():
            (beside / name).write_text(text, encoding="utf-8")
        beside.rename(folder)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(folder)) from None
    finally:
        shutil.rmtree(beside, ignore_errors=True)


def write_json(report: dict[str, Any], out: Path) -> None:
    """Writes a JSON file, each list of numbers on one line. A number that is not finite is an error of the program."""
    text = json.dumps(report, indent=2, allow_nan=False)
    # No string has a line break, because JSON escapes it.
    text = re.sub(r"\[(\n\s+[^][{}\"]*)\]", lambda numbers: f"[{' '.join(numbers[1].split())}]", text)
    write_file(out, text + "\n")
