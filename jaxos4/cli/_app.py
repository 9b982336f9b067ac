"""The application: its commands, and the errors that end them."""

import functools
import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.models import OptionInfo

from ..errors import InputError, TrainingError, printable
from . import options
from ._jax import NO_CACHE, platform_fault, prepare
from .estimate import estimate, identifiability, inspect, train
from .identified import export, predict
from .new_flights import design, simulate
from .studies import compare, report, study

_EPILOG = f"Compiled programs are kept. Those in your cache folder take at most 1 GB. {NO_CACHE}=1: nothing is kept."


def _prepared(command: Callable[..., None]) -> Callable[..., None]:
    """The command, which prepares JAX first. Its arguments are parsed before: help and mistakes need no JAX."""
    kinds = {name: getattr(kind, "__metadata__", (None,))[0] for name, kind in command.__annotations__.items()}

    @functools.wraps(command)
    def run(**given: Any) -> None:
        options.ASKED |= {name: value for name, value in given.items() if isinstance(kinds[name], OptionInfo)}
        options.check_sizes()
        prepare(batch=command is study)
        command(**given)

    return run


app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
for command in (simulate, design, estimate, predict, export, train, inspect, identifiability, compare, study, report):
    app.command()(_prepared(command))


def _show_version(wanted: bool) -> bool:
    if wanted:
        from .._version import __version__

        typer.echo(f"jaxos4 {__version__}")
        raise typer.Exit
    return wanted


@app.callback(epilog=_EPILOG)
def _jaxos4(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Identify the parameters of a quadrotor from its flights."""


def run_command() -> int:
    """Runs the command, and prints the error that ended it. Returns the exit code."""
    options.ASKED.clear()
    try:
        code = app(prog_name="jaxos4", standalone_mode=False) or 0
        sys.stdout.flush()
        return code
    except BrokenPipeError:  # the reader of our output has gone
        code, what = 1, ""
    except (InputError, OSError, TrainingError) as error:
        code, what = 1 if isinstance(error, TrainingError) else 2, options.as_typed(" ".join(str(error).split()))
        if isinstance(error, OSError) and error.filename is not None:
            what = f"{error.filename}: {error.strerror}; give a path that can be used."
        elif isinstance(error, OSError) and error.strerror:
            what = f"standard output: {error.strerror}; print elsewhere. Files that you asked for are written."
    except Exception as error:
        if hasattr(error, "format_message"):  # what all errors of the parser have, in every version of typer
            return _explain(error)
        if not (what := platform_fault()):
            raise
        code = 2
    if what:
        typer.echo(f"jaxos4: {printable(what)}", err=True)
    try:
        sys.stdout.flush()
    except OSError:  # what could not be printed is dropped: Python would complain about it at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return code


def _explain(mistake: Any) -> int:
    """Prints what the parser could not read."""
    message, ctx = mistake.format_message().removesuffix(".").replace("Value error, ", ""), mistake.ctx
    if "\n" not in message:  # else it is the help, because there are no arguments
        message = f"jaxos4: {message}; see `{ctx.command_path if ctx else 'jaxos4'} --help`."
    typer.echo(message, err=True)
    return 2
