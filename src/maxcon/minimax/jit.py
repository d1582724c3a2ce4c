"""How kernels are compiled: one decorator, cached on disk, honest about the first wait."""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from threading import RLock, get_ident
from typing import Any, TypeVar, cast

import numba
from numba.core import config, event

from maxcon.minimax.clock import read_clock

F = TypeVar("F", bound=Callable[..., Any])

_PACKAGE = Path(__file__).resolve().parents[1]


_IMPORT = re.compile(r"^\s*(?:from|import) maxcon\.([\w.]+)", re.MULTILINE)


@cache
def _digest(module: str) -> str:
    """Return a digest of a module of the package and of all that it imports from the package.

    Numba notices a change only in the file that holds a kernel, not in the files that the kernel calls
    into. With this digest as the stamp of its cache, no kernel outlives a change anywhere below it.
    """
    seen: dict[str, str] = {}
    waiting = [module]
    while waiting:
        name = waiting.pop()
        path = _PACKAGE.joinpath(*name.split("."))
        source = path.with_suffix(".py") if path.with_suffix(".py").exists() else path / "__init__.py"
        if name in seen or not source.exists():
            continue
        seen[name] = source.read_text(encoding="utf-8")
        waiting += _IMPORT.findall(seen[name])
    return hashlib.sha256("".join(seen[name] for name in sorted(seen)).encode()).hexdigest()


def kernel(function: F) -> F:
    """Compile `function` with numba: no Python objects, no GIL, no fastmath, cached on disk.

    The cache lies beside the source, or, where that folder is read-only, in the user's cache folder
    (numba chooses). With ``NUMBA_DISABLE_JIT=1`` the function is returned as it is.
    """
    return _compiled(function, False)


def sum_kernel(function: F) -> F:
    """Compile `function`, which does nothing but sum, as `kernel` does, but let the compiler reorder its additions.

    In order, one addition waits for the one before. Reordered they fill a vector register, three times as fast (LLVM's
    "reassoc", without the other liberties of "fastmath": infinities and NaNs stay what they are). The last bits then
    hang on the width of the machine's registers: equal results of equal seeds are promised on one kind of machine only.
    """
    return _compiled(function, {"reassoc"})


def _compiled(function: F, liberties: bool | set[str]) -> F:
    dispatcher = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath=liberties)(function)
    cache_file = getattr(getattr(dispatcher, "_cache", None), "_cache_file", None)
    if cache_file is not None and function.__module__.startswith("maxcon."):
        cache_file._source_stamp = _digest(function.__module__.removeprefix("maxcon."))
    return cast(F, dispatcher)


class _FirstCompilation(event.Listener):  # type: ignore[misc]
    """Says once, on stderr, why the first call takes long."""

    said = False

    def on_start(self, event: Any) -> None:
        dispatcher = event.data.get("dispatcher")
        module = getattr(getattr(dispatcher, "py_func", None), "__module__", None)  # None: of a user's own `exec`
        if not self.said and str(module).startswith("maxcon."):
            self.said = True
            print(
                "maxcon: compiling its kernels for this machine (once; they are kept on disk) ...",
                file=sys.stderr,
            )

    def on_end(self, event: Any) -> None:
        pass


class _Making(event.Listener):  # type: ignore[misc]
    """Keeps the time that kernels take to be compiled or, in every later process, to be loaded from disk."""

    seconds = 0.0

    def __init__(self) -> None:
        self._threads: list[int] = []  # those at it, or waiting for one that is; once for each kernel in another
        self._since = 0.0
        self._lock = RLock()  # numba notes the end after it has let go of its own lock

    def on_start(self, event: Any) -> None:
        with self._lock:
            if not self._threads:
                self._since = read_clock()
            self._threads.append(get_ident())

    def on_end(self, event: Any) -> None:
        with self._lock:
            if get_ident() in self._threads:
                self._threads.remove(get_ident())
                if not self._threads:
                    self.seconds += read_clock() - self._since

    def so_far(self) -> float:
        """Return the seconds of all kernels, with the one that another thread may be at."""
        with self._lock:
            # A thread that asks is at no kernel: Ctrl-C has met it while it waited for the lock, and it got no end.
            while get_ident() in self._threads:
                self._threads.remove(get_ident())
            return self.seconds + (read_clock() - self._since if self._threads else 0.0)


_making = _Making()
if not config.DISABLE_JIT:
    event.register("numba:compile", _FirstCompilation())
    event.register("numba:compiler_lock", _making)


def compile_seconds() -> float:
    """Return how long this process has compiled and loaded kernels so far; time limits do not count it."""
    return _making.so_far()


def working_clock() -> float:
    """Return the time in seconds, from some moment on, without what compiling and loading kernels takes."""
    return read_clock() - compile_seconds()
