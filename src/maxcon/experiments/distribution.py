"""Independent units of work on the cores of this machine or of a cluster, through joblib and its backends."""

from __future__ import annotations

import logging
import os
import signal
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from typing import Any, TypeVar

import joblib

#: What can do the work. dask and ray are extras of the package.
BACKENDS = ("loky", "dask", "ray", "sequential")

T = TypeVar("T")
R = TypeVar("R")


def distribute(
    work: Callable[[T], R],
    units: Sequence[T],
    *,
    backend: str = "loky",
    jobs: int = 1,
    scheduler: str | None = None,
) -> Iterator[R]:
    """Yield the result of ``work(unit)`` for every unit, in the order in which they are done.

    Parameters
    ----------
    work
        A function that can be pickled. It must not depend on the order of the units.
    units
        What it is called with.
    backend
        "loky": processes of this machine; "dask": a cluster of Dask; "ray": a cluster of Ray; "sequential": this
        process.
    jobs
        How many units at a time, at least 1. A cluster given by `scheduler` has as many as it has workers.
    scheduler
        The address of a running cluster, ``tcp://host:8786`` of Dask or ``ray://host:10001`` of Ray; None starts one
        of `jobs` processes on this machine, and ends it.

    Raises
    ------
    ModuleNotFoundError
        If the backend is not installed; the message names the extra that brings it.
    ValueError
        If there is no such backend, `jobs` is below 1, or a backend without schedulers is given one.
    """
    if backend not in BACKENDS:
        raise ValueError(f"backend must be one of {', '.join(BACKENDS)}, but it is {backend!r}")
    if isinstance(jobs, bool) or not isinstance(jobs, int) or jobs < 1:
        raise ValueError(f"jobs must be a whole number of at least 1, but it is {jobs!r}")
    if scheduler is not None and backend not in ("dask", "ray"):
        raise ValueError(f"scheduler must be None for the backend {backend!r}, but it is {scheduler!r}")
    check_backend(backend)
    return _distribute(work, units, backend, jobs, scheduler)


def check_backend(backend: str) -> None:
    """Make sure that a backend is installed.

    Raises
    ------
    ModuleNotFoundError
        If it is not; the message names the extra that brings it.
    """
    needs = {"dask": "dask.distributed", "ray": "ray.util.joblib"}
    if backend in needs:
        try:
            import_module(needs[backend])
        except ImportError:
            raise ModuleNotFoundError(
                f"the backend {backend!r} needs {backend.capitalize()}, which is not installed: "
                f"pip install 'maxcon[{backend}]'"
            ) from None


def _distribute(
    work: Callable[[T], R], units: Sequence[T], backend: str, jobs: int, scheduler: str | None
) -> Iterator[R]:
    if not units:
        return
    if backend == "sequential":
        yield from map(work, units)
    elif backend == "loky":
        yield from _as_completed(work, units, jobs, "loky")
    elif backend == "dask":
        with _dask_cluster(jobs, scheduler) as n_workers:
            yield from _as_completed(work, units, n_workers, "dask")
    else:
        with _ray_cluster(jobs, scheduler):
            yield from _in_rounds(work, units, jobs)


def _as_completed(work: Callable[[T], R], units: Sequence[T], jobs: int, backend: str) -> Iterator[R]:
    # To loky, kernels being compiled in a worker look like a leak of memory: it replaces the worker; nothing is lost.
    warnings.filterwarnings("ignore", "A worker stopped while some jobs", UserWarning)
    with joblib.parallel_config(backend=backend, n_jobs=jobs):
        # Units take seconds, so that batches would only make a kill lose more.
        parallel = joblib.Parallel(return_as="generator_unordered", batch_size=1, pre_dispatch="2*n_jobs")
        results = parallel(joblib.delayed(_undisturbed)(work, unit, os.getpid()) for unit in units)
        try:
            for result in results:  # noqa: UP028  (yield from would close it out of reach of what follows)
                yield result
        finally:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # that what was under way is lost: that is meant
                results.close()


def _in_rounds(work: Callable[[T], R], units: Sequence[T], jobs: int) -> Iterator[R]:
    """Yield results a few at a time, for a backend that can only return all results of a call at once."""
    some = 4 * jobs
    for first in range(0, len(units), some):
        with joblib.parallel_config(backend="ray", n_jobs=jobs):
            yield from joblib.Parallel(batch_size=1)(
                joblib.delayed(_undisturbed)(work, unit, os.getpid()) for unit in units[first : first + some]
            )


def _undisturbed(work: Callable[[T], R], unit: T, starter: int) -> R:
    """Call `work` in a worker, deaf to Ctrl-C: that is for the process that started it, `starter`.

    `maxcon.fit` answers Ctrl-C with the best found so far, which must not pass for its result.
    """
    if os.getpid() != starter and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return work(unit)


@contextmanager
def _dask_cluster(jobs: int, scheduler: str | None) -> Iterator[int]:
    distributed: Any = import_module("dask.distributed")
    if scheduler is not None:
        with distributed.Client(scheduler) as client:
            yield max(1, len(client.ncores()))
        return
    with (
        distributed.LocalCluster(
            n_workers=jobs, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=logging.CRITICAL
        ) as cluster,
        distributed.Client(cluster),
    ):
        yield jobs


@contextmanager
def _ray_cluster(jobs: int, scheduler: str | None) -> Iterator[None]:
    ray: Any = import_module("ray")
    register_ray: Any = import_module("ray.util.joblib").register_ray
    about: dict[str, Any] = {"address": scheduler} if scheduler is not None else {"num_cpus": jobs}
    ray.init(**about, log_to_driver=False, ignore_reinit_error=True)
    try:
        register_ray()
        yield
    finally:
        ray.shutdown()
