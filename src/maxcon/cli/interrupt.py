"""What Ctrl-C does while a command is at work."""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from types import FrameType

from maxcon.cli import INTERRUPTED
from maxcon.waiting import solver_at_work


def deferred() -> AbstractContextManager[threading.Event]:
    """Let the first Ctrl-C only set the event, so that the unit of work is finished; a second one interrupts at once.

    `maxcon.fit` answers Ctrl-C with the best found so far: a program that makes many fits must not take that for
    their results.
    """
    return _listening(at_once=False)


def noticed() -> AbstractContextManager[threading.Event]:
    """Set the event on Ctrl-C, which interrupts as ever; the process then ends without a solver that it has left."""
    return _listening(at_once=True)


@contextmanager
def _listening(*, at_once: bool) -> Iterator[threading.Event]:
    asked = threading.Event()

    def note(_number: int, _frame: FrameType | None) -> None:
        interrupts = at_once or asked.is_set()
        asked.set()
        if interrupts:
            raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield asked
    finally:
        signal.signal(signal.SIGINT, before)
        if asked.is_set():
            atexit.register(_leave)


def _leave() -> None:
    """End the process here, on its way out, if a solver that Ctrl-C has left is still at work."""
    if solver_at_work():
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):  # of a reader that is gone
                stream.flush()
        os._exit(INTERRUPTED)
