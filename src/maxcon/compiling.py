"""Compiles ahead what fits and proofs will need, so that no fit waits for the compiler in the middle."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np
from numba.core import config

from maxcon.certifying import certify, write_certificate
from maxcon.fitting import fit
from maxcon.minimax.jit import compile_seconds
from maxcon.problem import LinearProblem, hyperplane, line, plane
from maxcon.search.alternatives import alternative_optima
from maxcon.search.learned_kernels import begin_search_belief, finish_search, swap_search
from maxcon.search.threshold_curve import consensus_curve
from maxcon.vision import find_fundamental

if TYPE_CHECKING:
    from maxcon.problem import Consensus

#: Points of the small problems and of the large ones: beyond 400 points some searches take other kernels.
FEW, MANY = 40, 450

#: The threshold of the made problems, and that of the made scenes.
THRESHOLD, SCENE_THRESHOLD = 0.1, 0.1

#: The methods that are compiled, beside "auto", "exact", "learned" and, of the families that have one, "agent".
METHODS = ("greedy", "ransac", "lo-ransac", "gnc", "peel")

#: Seconds for what would not end by itself, or could take long: enough for every stage of a search to have its turn.
#: "auto" does something else in less than 0.09 seconds for so many points with more than three parameters.
SHORT, LONG = 0.08, 0.2


def compile_kernels(progress: Callable[[str], object] | None = None) -> float:
    """Compile all kernels that ordinary fits and proofs need, or load them where that has been done.

    A kernel is compiled when it is first called, which takes seconds, and is then kept on disk; every later process
    loads it when it first calls it, which takes a second for all. Time limits count neither, but who waits for an
    answer does: a program that must answer within milliseconds calls this once when it starts. Compiled are those of
    the methods "auto", "exact", "learned", "agent", "greedy", "ransac", "lo-ransac", "gnc" and "peel" with both
    refinements, of `certify`, `write_certificate`, `Consensus.explain`, `consensus_curve`, `alternative_optima` and
    `find_fundamental`, for any number of points and parameters: by solving small made problems.

    Parameters
    ----------
    progress
        Called with what is compiled next, in words.

    Returns
    -------
    float
        The seconds that compiling and loading took: two to five minutes the first time on a machine, later one or so.
        The made problems take some four seconds more.

    Raises
    ------
    TypeError
        If `progress` is not callable.
    """
    if progress is not None and not callable(progress):
        raise TypeError(f"progress must be callable or None, but it is a {type(progress).__name__}")
    if config.DISABLE_JIT:  # kernels are plain functions then
        return 0.0
    before = compile_seconds()
    for words, work in _tasks():
        if progress is not None:
            progress(words)
        work()
    return compile_seconds() - before


def _tasks() -> Iterator[tuple[str, Callable[[], object]]]:
    """Yield what is compiled next in words, and what calls it."""
    for d, name in ((2, "lines"), (3, "planes"), (8, "hyperplanes")):
        yield f"fits of {name}", partial(_fits, d, FEW)
        yield f"fits of {name}, many points", partial(_fits, d, MANY)
        yield f"methods by name, {name}", partial(_methods, d)
        yield f"proofs for {name}", partial(_proofs, d)
    yield "what only some clocks call", _rarely_called
    yield "curves and alternatives", _curves
    yield "fundamental matrices", partial(_scenes, 60)
    yield "fundamental matrices, many matches", partial(_scenes, MANY)


def _made(d: int, n_points: int, outlier_rate: float) -> LinearProblem:
    """Return a made problem with d parameters, one of them an intercept."""
    rng = np.random.default_rng(d)
    X = rng.uniform(-1.0, 1.0, (n_points, d - 1))
    y = X.sum(axis=1) + rng.uniform(-THRESHOLD, THRESHOLD, n_points)
    out = rng.random(n_points) < outlier_rate
    y[out] += rng.uniform(-3.0, 3.0, np.count_nonzero(out))
    if d == 2:
        return line(X[:, 0], y)
    return plane(X[:, 0], X[:, 1], y) if d == 3 else hyperplane(X, y)


def _fit(problem: LinearProblem, **arguments: Any) -> Consensus:
    return fit(problem, THRESHOLD, **arguments)


def _fits(d: int, n_points: int) -> None:
    """Fit with the usual methods: data easy and hard, with and without a time limit."""
    easy, hard = _made(d, n_points, 0.1), _made(d, n_points, 0.5)
    for problem in (easy, hard):
        for time_limit in (LONG, SHORT, 0.01):
            _fit(problem, time_limit=time_limit)
        _fit(problem, method="learned", time_limit=SHORT)
        _fit(problem, method="learned", rounds=3)
        _fit(problem, method="exact", time_limit=LONG)
    _fit(easy)


def _rarely_called() -> None:
    """Compile the steps of the learned search that the clock decides about, for the arguments of the last step."""
    for signature in finish_search.signatures:  # type: ignore[attr-defined]
        for step in (begin_search_belief, swap_search):
            step.compile(signature)  # type: ignore[attr-defined]


def _methods(d: int) -> None:
    for problem in (_made(d, FEW, 0.3), _made(d, MANY, 0.3)):
        for method in METHODS if d > 3 else ("agent", *METHODS):
            for refine in ("swap", "tree"):
                _fit(problem, method=method, refine=refine, time_limit=LONG)


def _proofs(d: int) -> None:
    problem = _made(d, FEW, 0.1)
    found = _fit(problem, method="ransac", certify=True, time_limit=LONG)
    certify(problem, THRESHOLD, found.inlier_mask, time_limit=LONG)
    certify(problem, THRESHOLD, found.model, time_limit=LONG)
    for point in np.flatnonzero(~found.inlier_mask)[:2]:
        found.explain(int(point), time_limit=LONG)
    with TemporaryDirectory() as folder:
        write_certificate(Path(folder) / "certificate.json", found, time_limit=LONG)


def _curves() -> None:
    for d in (2, 3, 8):
        problem = _made(d, FEW, 0.2)
        alternative_optima(problem, THRESHOLD, limit=3, time_limit=LONG)
        if d <= 3:
            consensus_curve(problem, (0.5 * THRESHOLD, 2.0 * THRESHOLD), time_limit=LONG)


def _scenes(n_points: int) -> None:
    from maxcon.datasets.two_view_scene import synthetic_two_view  # noqa: PLC0415  (only this needs it)

    for rate in (0.1, 0.5):
        scene = synthetic_two_view(n_points, rate, np.random.default_rng(0))
        for arguments in ({}, {"pixels": None}, {"chart": "F32=1"}, {"refit": True}):
            options: dict[str, Any] = dict(arguments)
            found = find_fundamental(scene.x1, scene.x2, SCENE_THRESHOLD, time_limit=SHORT, **options)
    find_fundamental(scene.x1, scene.x2, SCENE_THRESHOLD, method="agent", time_limit=LONG)
    found = find_fundamental(scene.x1, scene.x2, SCENE_THRESHOLD)
    _ = found.degeneracy
