"""The application: precision, and exit codes."""

import os
import sys

import jax
import typer

from ..errors import InputError, TrainingError
from .compare import compare
from .estimate import estimate
from .identifiability import identifiability
from .inspect import inspect
from .report import report
from .simulate import simulate
from .study import study
from .train import train

_INTERRUPTED = 130

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Identify the parameters of a quadrotor from its flights.",
)
app.command()(simulate)
app.command()(estimate)
app.command()(train)
app.command()(inspect)
app.command()(identifiability)
app.command()(compare)
app.command()(study)
app.command()(report)


def main() -> None:
    """Runs the command line.

    Exit code 0: done, 1: the computation failed, 2: unusable arguments or input, 130: interrupted.
    """
    jax.config.update("jax_enable_x64", True)
    try:
        app()
    except SystemExit as stop:
        if stop.code != _INTERRUPTED:
            raise
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(_INTERRUPTED)  # now, and not when threads that compile or train come to their end; files are whole
    except (InputError, OSError) as error:
        if isinstance(error, BrokenPipeError):  # whoever read our output has gone: not worth a word
            sys.stderr.close()
            raise SystemExit(1) from None
        typer.echo(f"jaxos4: {_one_line(error)}", err=True)
        raise SystemExit(2) from None
    except TrainingError as error:
        typer.echo(f"jaxos4: {_one_line(error)}", err=True)
        raise SystemExit(1) from None


def _one_line(error: InputError | OSError | TrainingError) -> str:
    if isinstance(error, OSError) and error.filename is not None:
        return f"{error.filename}: {error.strerror}; give a path that can be used."
    return " ".join(str(error).split())
