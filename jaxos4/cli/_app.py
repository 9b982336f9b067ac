"""The application: its commands, and their exit codes."""

import functools
import io
import os
import signal
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from ..errors import InputError, TrainingError, printable
from ._jax import NO_CACHE, prepare
from .estimate import estimate, train
from .identified import export, predict
from .information import identifiability, inspect
from .new_flights import design, simulate
from .studies import compare, report, study

_INTERRUPTED = 128 + signal.SIGINT  # the parser's code
_EPILOG = f"Compiled programs are kept. Those in your cache folder take at most 1 GB. {NO_CACHE}=1: nothing is kept."


def _prepared(command: Callable[..., None]) -> Callable[..., None]:
    """The command, which prepares JAX first. Its arguments are parsed before: help and mistakes need no JAX."""

    @functools.wraps(command)
    def run(*args, **kwargs) -> None:
        prepare(batch=command is study)
        command(*args, **kwargs)

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


def main() -> None:
    """Runs the command line. Exit code 0: done, 1: failed, 2: unusable arguments or input.

    A command that is interrupted ends by the signal, which a shell shows as 130: scripts that call it end too, and no
    thread that still computes meets an interpreter that has ended.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may hold what no encoding can print
    try:
        code = app(prog_name="jaxos4", standalone_mode=False) or 0
        sys.stdout.flush()
        if code == _INTERRUPTED and os.name == "posix":
            sys.stderr.flush()
            signal.signal(signal.SIGINT, signal.SIG_DFL)
            signal.raise_signal(signal.SIGINT)
    except BrokenPipeError:  # the reader of our output has gone: Python would complain about what is left of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(1) from None
    except (InputError, OSError, TrainingError) as error:
        what = " ".join(str(error).split())
        if isinstance(error, OSError) and error.filename is not None:
            what = f"{error.filename}: {error.strerror}; give a path that can be used."
        typer.echo(f"jaxos4: {printable(what)}", err=True)
        raise SystemExit(1 if isinstance(error, TrainingError) else 2) from None
    except Exception as error:
        if not hasattr(error, "format_message"):  # what all errors of the parser have, in every version of typer
            raise
        mistake: Any = error
        message, ctx = mistake.format_message().removesuffix(".").replace("Value error, ", ""), mistake.ctx
        if "\n" not in message:  # else it is the help, because there are no arguments
            message = f"jaxos4: {message}; see `{ctx.command_path if ctx else 'jaxos4'} --help`."
        typer.echo(message, err=True)
        raise SystemExit(2) from None
    raise SystemExit(code)
