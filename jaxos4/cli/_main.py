"""The entry point: how a command ends. Nothing that takes time is imported before Ctrl-C is taken care of."""

import io
import os
import signal
import sys

from ._interrupts import end_by_signal, kept_interrupts

_INTERRUPTED = 128 + signal.SIGINT  # the parser's code


def main() -> None:
    """Runs the command line. Exit code 0: done, 1: failed, 2: unusable arguments or input.

    A command that is interrupted ends by the signal, which a shell shows as 130: scripts that call it end too, and no
    thread that still computes meets an interpreter that has ended.
    """
    _open_streams()
    with kept_interrupts() as interrupted:
        try:
            from ._app import run_command

            code = run_command()
        except BaseException:  # an import that is interrupted can end in any error
            if not interrupted():
                raise
            code = _INTERRUPTED
    if code == _INTERRUPTED or interrupted():
        code = _INTERRUPTED
        end_by_signal()
    raise SystemExit(code)


def _open_streams() -> None:
    """Escapes characters that a stream cannot encode, and opens closed streams on the null device."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))
        elif isinstance(stream := getattr(sys, name), io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
