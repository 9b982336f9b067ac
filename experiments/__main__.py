"""Runs a script of an experiment in double precision: `python -m experiments closed_loop.effects --help`.

With `--publish NAME`, the tables that it prints become a result file, see `published.py`. `python -m experiments
render` writes the tables of the pages from these files. `python -m experiments again NAME ...` computes published
results once more, and `again all` every one.
"""

import importlib
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import typer

from experiments.monte_carlo import machine
from experiments.published import FOLDER, RECORDER, read, render
from jaxos4.errors import InputError

MODULES = ("studies", "standard_flights", "real_flights", "figures")  # of several scripts, by their names in `SCRIPTS`


def scripts() -> Iterator[str]:
    """The names of all scripts: the modules with a `main`, and those of `MODULES`."""
    for path in sorted(Path(__file__).parent.glob("*/*.py")):
        if "\ndef main(" in path.read_text(encoding="utf-8"):
            yield f"{path.parent.name}.{path.stem}"
    yield from shared_modules()


def shared_modules() -> dict[str, Callable[..., None]]:
    """The functions of `MODULES`, by the names of their scripts."""
    modules = (importlib.import_module(f"experiments.{name}") for name in MODULES)
    return {name: main for module in modules for name, main in module.SCRIPTS.items()}


def main_of(name: str) -> Callable[..., None]:
    """The function of a script."""
    return shared_modules().get(name) or importlib.import_module(f"experiments.{name}").main


def published(arguments: list[str]) -> str | None:
    """Takes `--publish NAME` out of the arguments. `None`: it is not there."""
    if "--publish" not in arguments:
        return None
    place = arguments.index("--publish")
    name = arguments[place + 1] if place + 1 < len(arguments) else ""
    if not name.isidentifier():
        raise InputError("--publish: needs a name of letters, digits and _.")
    del arguments[place : place + 2]
    return name


def run(name: str, arguments: list[str]) -> None:
    """Runs a script with its arguments."""
    jax.config.update("jax_enable_x64", True)
    if name not in scripts():
        raise InputError(f"{name}: no such script; give one of {', '.join(scripts())}, again or render.")
    result = published(arguments)
    command = [name, *arguments]
    app = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    app.command()(RECORDER.watching(main_of(name)))
    try:
        app(arguments, prog_name=f"python -m experiments {name}")
    except SystemExit as end:
        if end.code:
            raise
    if result is not None:
        RECORDER.publish(result, command, machine())


def commands(names: list[str], folder: Path = FOLDER) -> dict[str, list[str]]:
    """The arguments that compute published results once more, by their names; `all`: every result.

    A script that finds its `--out` file continues it: remove the file first.
    """
    every = sorted(path.stem for path in folder.glob("*.json"))
    chosen = every if names == ["all"] else names
    return {name: [*shlex.split(read(name, folder).command), "--publish", name] for name in chosen}


def again(names: list[str]) -> None:
    """Computes published results once more, each in a process of its own. Ends with 1 if a script failed."""
    if not names:
        raise InputError("again: no name; give names of files in experiments/results, without .json, or all.")
    failed = False
    for name, arguments in commands(names).items():
        begin = time.perf_counter()
        ended = subprocess.run([sys.executable, "-m", "experiments", *arguments], check=False).returncode
        print(f"{name}: {time.perf_counter() - begin:.0f} s{f', ended with {ended}' if ended else ''}")
        failed |= ended != 0
    if failed:
        raise SystemExit(1)


def usage() -> str:
    """The text of `--help`."""
    return "\n".join(
        (
            "python -m experiments SCRIPT ...    runs a script; SCRIPT --help shows its options,",
            "                                    --publish NAME makes a result file of its tables",
            "python -m experiments again NAME    computes a published result once more; all: every one",
            "python -m experiments render        writes the tables of the pages from the result files",
            "",
            "scripts:",
            *(f"  {name}" for name in scripts()),
        )
    )


def main(arguments: list[str]) -> None:
    """Runs the command line. A user's mistake is one line, and ends with 2."""
    try:
        match arguments:
            case [] | ["--help"]:
                print(usage())
            case ["render"]:
                render()
            case ["again", *names]:
                again(names)
            case [name, *options]:
                run(name, options)
    except (InputError, FileNotFoundError) as error:
        print(InputError(str(error)), file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    main(sys.argv[1:])
