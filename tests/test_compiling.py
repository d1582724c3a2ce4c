"""Compiling ahead: after it, fits of other sizes, data and kinds compile and load nothing more."""

import numpy as np
import pytest
from numba.core import config

import maxcon
from maxcon.datasets.two_view_scene import synthetic_two_view
from maxcon.minimax.jit import compile_seconds
from maxcon.vision import polish_fundamental

pytestmark = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="nothing is compiled")


def made(d, n_points, rate, seed):
    rng = np.random.default_rng(seed)
    X = rng.standard_normal((n_points, d))
    y = X @ rng.uniform(-2, 2, d) + rng.uniform(-0.1, 0.1, n_points)
    out = rng.random(n_points) < rate
    y[out] = rng.uniform(-9, 9, out.sum())
    return maxcon.LinearProblem(X, y)


@pytest.fixture(scope="module")
def compiled():
    said = []
    seconds = maxcon.compile_kernels(said.append)
    assert 0.0 <= seconds < compile_seconds() + 1e-9
    assert said[0] == "fits of lines"
    assert len(said) == len(set(said)) > 10


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("n_points", [25, 100, 500, 1200])
@pytest.mark.parametrize("d", [1, 2, 3, 5, 8])
def test_fits(d, n_points):
    before = compile_seconds()
    for rate in (0.05, 0.3, 0.6):
        problem = made(d, n_points, rate, n_points)
        for method in ("auto", "learned", "exact", "ransac", "lo-ransac", "gnc", "peel"):
            for time_limit in (0.01, 0.1):
                maxcon.fit(problem, 0.1, method=method, time_limit=time_limit)
        assert compile_seconds() == before
    result = maxcon.fit(problem, 0.1, method="peel", refine="tree", certify=True, time_limit=0.1)
    for point in np.flatnonzero(~result.inlier_mask)[:1]:
        result.explain(int(point), time_limit=0.1)
    maxcon.certify(problem, 0.1, result.model, time_limit=0.1)
    assert compile_seconds() == before


@pytest.mark.usefixtures("compiled")
def test_certificates_and_curves(tmp_path):
    before = compile_seconds()
    for d in (2, 3, 8):
        problem = made(d, 70, 0.2, d)
        maxcon.write_certificate(tmp_path / "c.json", maxcon.fit(problem, 0.1, time_limit=0.1), time_limit=0.2)
        maxcon.alternative_optima(problem, 0.1, limit=2, time_limit=0.2)
        if d <= 3:
            maxcon.consensus_curve(problem, (0.05, 0.3), time_limit=0.2)
    assert compile_seconds() == before


@pytest.mark.usefixtures("compiled")
@pytest.mark.parametrize("n_points", [40, 300, 900])
def test_two_views(n_points):
    before = compile_seconds()
    for rate in (0.1, 0.5):
        scene = synthetic_two_view(n_points, rate, np.random.default_rng(n_points))
        for time_limit in (0.01, 0.1):
            found = maxcon.find_fundamental(scene.x1, scene.x2, 0.1, time_limit=time_limit)
        maxcon.find_fundamental(scene.x1, scene.x2, 0.1, time_limit=0.05, chart="F33=1", pixels=None)
        _ = found.degeneracy, found.within()
        polish_fundamental(found.F, scene.x1, scene.x2)
    assert compile_seconds() == before


def test_without_a_compiler_there_is_nothing_to_do(monkeypatch):
    monkeypatch.setattr("numba.core.config.DISABLE_JIT", 1)
    said = []
    assert maxcon.compile_kernels(said.append) == 0.0
    assert said == []


def test_progress_must_be_callable():
    with pytest.raises(TypeError, match="progress must be callable or None, but it is a int"):
        maxcon.compile_kernels(3)
