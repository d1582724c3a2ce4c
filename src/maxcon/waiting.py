"""Waiting for a solver of others that does not look up, such that Ctrl-C is heard all the same.

Below the search and the checker, which share nothing else of this package: it knows nothing of either.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

T = TypeVar("T")

#: The name of the threads in which solvers work.
SOLVER = "maxcon solver"

#: Seconds between two looks at whether Ctrl-C was pressed, where waiting would not be cut short by it.
LOOK = 0.1


def interruptible(function: Callable[[], T]) -> T:
    """Call `function` in a thread such that Ctrl-C ends the wait for it, and return or raise what it does.

    After Ctrl-C the solver is left to its own: it ends with the process or by itself (`solver_at_work`).
    """
    returned: list[T] = []
    raised: list[BaseException] = []

    def work() -> None:
        try:
            returned.append(function())
        except BaseException as error:  # for the caller, whatever it is
            raised.append(error)

    thread = threading.Thread(target=work, name=SOLVER, daemon=True)
    thread.start()
    while thread.is_alive():
        thread.join(LOOK)
    if raised:
        raise raised[0]
    return returned[0]


def solver_at_work() -> bool:
    """Whether a solver that Ctrl-C has left to its own is still at work.

    It cannot be told to stop. Should it end while the interpreter is being taken down, its thread would abort the
    process, with a core dump: a program that ends nevertheless had better do so by `os._exit`.
    """
    return any(thread.name == SOLVER for thread in threading.enumerate())
