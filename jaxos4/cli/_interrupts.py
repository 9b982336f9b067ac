"""Ctrl-C ends every command, wherever it arrives."""

import _thread
import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any

_AGAIN = 0.02  # s; until then, the finaliser in which an interrupt was lost has ended


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
