"""The kernels as plain Python: the same answers as compiled, for those who debug and for those without a compiler."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import config

import instances
from maxcon.minimax import allocate, linear_rows, minimax_fit
from maxcon.minimax.linear import OK, basis_points, cold_fit
from maxcon.minimax.refits import refit_after_addition, refit_after_enforcement, refit_after_removal
from maxcon.problem import LinearProblem

NAMES = ["random_instance", "quantised", "repeated_column", "duplicate_rows", "years", "far_outliers", "minimal"]


def report(name: str) -> dict[str, list[float]]:
    """Return what a cold fit, and a chain of removals, an addition and enforcements, come to."""
    rng = np.random.default_rng([7, *name.encode()])
    A, b = instances.BUILDERS[name](rng, 25, 3)
    problem = LinearProblem(A, b)
    found = minimax_fit(problem)
    rows = linear_rows(problem)
    workspace = allocate(rows)
    basis = np.empty(workspace.q.shape[0], dtype=np.int64)
    statuses, values = [cold_fit(*workspace)], []
    threshold, removed = 0.5 * float(workspace.x[-1]), []
    for step in range(min(10, len(b) - 1)):
        size = basis_points(workspace.C, workspace.q, basis)
        point = int(basis[step % size]) if size else int(rng.integers(len(b)))
        if step == 5:
            statuses.append(refit_after_addition(*workspace, removed[-1], np.inf))
        elif step == 7:
            statuses.append(refit_after_enforcement(*workspace, point, threshold))
        else:
            removed.append(point)
            statuses.append(refit_after_removal(*workspace, point))
        if statuses[-1] != OK:
            break
        values += [float(workspace.x[-1]) * rows.scale, *rows.model(workspace.x).tolist()]
    return {
        "statuses": statuses,
        "values": values,
        "fit": [found.value, *found.model.tolist()],
        "basis": found.basis.tolist(),
    }


@pytest.fixture(scope="module")
def plain() -> dict[str, dict[str, list[float]]]:
    folder = Path(__file__).parent
    code = f"import json, test_no_jit as t; print(json.dumps({{name: t.report(name) for name in {NAMES!r}}}))"
    paths = [str(folder), os.environ.get("PYTHONPATH", "")]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": os.pathsep.join(filter(None, paths))}
    found = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=300, env=environment
    )
    return json.loads(found.stdout)


@pytest.mark.skipif(bool(config.DISABLE_JIT), reason="there is nothing compiled to compare with")
@pytest.mark.parametrize("name", NAMES)
def test_the_same_without_compilation(name, plain):
    compiled = report(name)
    assert compiled["statuses"] == plain[name]["statuses"]
    assert compiled["basis"] == plain[name]["basis"]
    assert len(compiled["values"]) > 4
    for key in ("values", "fit"):
        size = np.abs(compiled[key]).max()
        assert plain[name][key] == pytest.approx(compiled[key], rel=1e-12, abs=1e-12 * size)
