"""The clock that time limits are read from: the wall's or, for benchmarks on shared machines, the processor's."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

_read = time.perf_counter


def read_clock() -> float:
    """Return the time in seconds, from some moment on."""
    return _read()


@contextmanager
def processor_time(counted: bool = True) -> Iterator[None]:
    """Count only what this process, with all its threads, works on a processor, while the context lasts.

    Unless it is not to be `counted`: then the clock stays what it is.

    Two methods are then given the same amount of work, whatever else the machine has to do meanwhile. For one thread on
    a machine of its own that is the time on the wall.
    """
    global _read  # noqa: PLW0603
    before = _read
    _read = time.process_time if counted else before
    try:
        yield
    finally:
        _read = before
