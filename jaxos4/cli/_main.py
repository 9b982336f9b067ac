"""The entry point, and how Ctrl-C ends every command, wherever it arrives. Only fast modules are imported here."""

import _thread
import contextlib
import io
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_INTERRUPTED = 128 + signal.SIGINT  # the parser's code
_AGAIN = 0.02  # s; until then, the finaliser in which an interrupt was lost has ended


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


def end_by_signal() -> None:
    """Ends this process as the signal does, where the system has signals. Else it returns."""
    if os.name == "posix":
        if sys.stderr.isatty():
            sys.stderr.write("\033[?25h")  # the cursor, which a progress bar hides
        sys.stderr.flush()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        signal.raise_signal(signal.SIGINT)


def _importing(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


@contextlib.contextmanager
def kept_interrupts() -> Iterator[Callable[[], bool]]:
    """Raises an interrupt again if it arrived in a finaliser or a callback, where Python drops any exception.

    Yields a function that returns whether an interrupt has arrived, in case that other code has dropped it. A process
    that ignores interrupts, as shells start those in the background, still does.
    """
    arrived, running, main = False, True, threading.get_ident()
    if signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield lambda: arrived
        return

    def interrupt(_: int, frame: FrameType | None) -> None:
        nonlocal arrived
        arrived = True
        if _importing(frame):  # extension modules crash if their import ends in an exception
            end_by_signal()
        raise KeyboardInterrupt

    def again() -> None:
        time.sleep(_AGAIN)
        if running and sys.platform == "win32":
            _thread.interrupt_main()
        elif running:
            signal.pthread_kill(main, signal.SIGINT)  # also ends a call of the system in which it waits

    def keep(dropped: Any) -> None:
        nonlocal arrived
        if dropped.exc_type is KeyboardInterrupt:
            arrived = True
            _thread.start_new_thread(again, ())
        else:
            before(dropped)

    before, sys.unraisablehook = sys.unraisablehook, keep
    signal.signal(signal.SIGINT, interrupt)
    try:
        yield lambda: arrived
    finally:
        running = False
        signal.signal(signal.SIGINT, signal.default_int_handler)
        sys.unraisablehook = before
