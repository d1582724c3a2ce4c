"""Work on cores and clusters: every unit once, whatever does it."""

import importlib
import os
import time

import pytest

from maxcon.experiments.distribution import BACKENDS, distribute


def square(i):
    time.sleep(0.02)
    return i, i * i, os.getpid()


def fail(i):
    if i == 3:
        raise ValueError("no threes")
    return i


def test_in_this_process():
    results = list(distribute(square, range(5), backend="sequential"))
    assert [each[:2] for each in results] == [(i, i * i) for i in range(5)]
    assert {each[2] for each in results} == {os.getpid()}


def test_in_processes_of_this_machine():
    results = list(distribute(square, range(20), backend="loky", jobs=2))
    assert sorted(each[:2] for each in results) == [(i, i * i) for i in range(20)]
    assert os.getpid() not in {each[2] for each in results}


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_on_a_cluster_of_two_dask_workers():
    distributed = pytest.importorskip("dask.distributed", reason="needs Dask: pip install 'maxcon[dask]'")
    results = list(distribute(square, range(20), backend="dask", jobs=2))
    assert sorted(each[:2] for each in results) == [(i, i * i) for i in range(20)]
    workers = {each[2] for each in results}
    assert len(workers) == 2
    assert os.getpid() not in workers
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        address = cluster.scheduler_address
        there = list(distribute(square, range(20), backend="dask", scheduler=address))
    assert sorted(each[:2] for each in there) == [(i, i * i) for i in range(20)]
    assert len({each[2] for each in there}) == 2
    assert not workers & {each[2] for each in there}


def test_on_ray():
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'maxcon[ray]'")
    results = list(distribute(square, range(10), backend="ray", jobs=2))
    assert sorted(each[:2] for each in results) == [(i, i * i) for i in range(10)]
    assert not ray.is_initialized()


@pytest.mark.parametrize("backend", ["sequential", "loky"])
def test_what_goes_wrong_is_told(backend):
    with pytest.raises(ValueError, match="no threes"):
        list(distribute(fail, range(6), backend=backend, jobs=2))


def test_it_can_be_left_early():
    results = distribute(square, range(1000), backend="loky", jobs=2)
    next(results)
    began = time.perf_counter()
    results.close()
    assert time.perf_counter() - began < 10.0


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_work(backend, monkeypatch):
    monkeypatch.setattr("maxcon.experiments.distribution.check_backend", lambda _: None)
    assert list(distribute(square, [], backend=backend)) == []


@pytest.mark.parametrize("backend", ["dask", "ray"])
def test_a_backend_that_is_not_installed(backend, monkeypatch):
    real = importlib.import_module

    def without(name, *args):
        if name.startswith(backend):
            raise ImportError(name)
        return real(name, *args)

    monkeypatch.setattr("maxcon.experiments.distribution.import_module", without)
    with pytest.raises(ModuleNotFoundError, match=rf"pip install 'maxcon\[{backend}\]'"):
        distribute(square, range(2), backend=backend)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"backend": "slurm"}, "backend must be one of loky, dask, ray, sequential, but it is 'slurm'"),
        ({"jobs": 0}, "jobs must be a whole number of at least 1, but it is 0"),
        ({"jobs": 1.5}, "jobs must be a whole number of at least 1, but it is 1.5"),
        ({"jobs": True}, "jobs must be a whole number of at least 1, but it is True"),
        ({"scheduler": "tcp://a:1"}, "scheduler must be None for the backend 'loky', but it is 'tcp://a:1'"),
    ],
)
def test_errors(arguments, message):
    with pytest.raises(ValueError, match=message):
        distribute(square, range(2), **arguments)
