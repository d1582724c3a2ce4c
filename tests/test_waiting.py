"""Waiting for a solver: what it returns and raises arrives, and Ctrl-C ends the wait."""

import os
import signal
import threading
import time

import pytest

from maxcon.waiting import interruptible, solver_at_work


def test_what_it_returns_or_raises_arrives():
    assert interruptible(lambda: 7) == 7
    assert interruptible(lambda: None) is None
    with pytest.raises(ZeroDivisionError):
        interruptible(lambda: 1 // 0)
    with pytest.raises(SystemExit):
        interruptible(lambda: (_ for _ in ()).throw(SystemExit))
    assert not solver_at_work()


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_ends_the_wait(heard):
    done = threading.Event()

    def solver():
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        done.wait(10)

    began = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interruptible(solver)
    assert time.monotonic() - began < 9
    assert solver_at_work()
    done.set()
    while solver_at_work():
        time.sleep(0.01)
