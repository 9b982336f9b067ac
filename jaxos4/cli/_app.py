"""The application: its commands, their exit codes, and how JAX is prepared for them."""

import functools
import io
import os
import sys
import tempfile
import warnings
from collections.abc import Callable
from typing import Annotated, Any

import typer

from .._xla import add_flags
from ..errors import InputError, TrainingError, printable
from .estimate import estimate, train
from .identified import export, predict
from .information import identifiability, inspect
from .new_flights import design, simulate
from .studies import compare, report, study

NO_CACHE = "JAXOS4_NO_CACHE"
"""The environment variable that switches off the cache of compiled programs."""


def prepare(*, batch: bool) -> None:
    """Prepares this process for JAX. A cache folder that was chosen before is kept, unless the cache is off.

    `batch`: whether the command computes many flights at once; those of a single one should compile quickly.
    """
    if not batch:
        add_flags(quick=True)

    import jax

    jax.config.update("jax_enable_x64", True)
    if os.environ.get(NO_CACHE):
        jax.config.update("jax_enable_compilation_cache", False)
        return
    if jax.config.values["jax_compilation_cache_dir"] is None:
        import platformdirs

        # JAX removes the oldest programs only from a folder that has had a limit since its first one.
        folder = platformdirs.user_cache_path("jaxos4", appauthor=False) / "compiled"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=folder):
                pass
        except OSError:
            return
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_compilation_cache_max_size", 1 << 30)  # 1 GB
    if jax.config.values["jax_persistent_cache_min_compile_time_secs"] == 1.0:  # JAX's default [s]
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0)  # many small programs take long together
    # Another process may be writing the same program, or remove it: it is then compiled again.
    warnings.filterwarnings("ignore", "Error (reading|writing) persistent compilation cache")


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
    """Runs the command line. Exit code 0: done, 1: failed, 2: unusable arguments or input, 130: interrupted."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")  # names of files may hold what no encoding can print
    try:
        code = app(prog_name="jaxos4", standalone_mode=False) or 0
        sys.stdout.flush()
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
