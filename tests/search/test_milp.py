"""The MILP by HiGHS: the optimum of enumerating subsets, from boxes that hold what they promise to hold."""

import itertools
import os
import signal
import threading
import time

import numpy as np
import pytest
import scipy.optimize
from scipy.optimize import linprog

from instances import BUILDERS, synthetic
from maxcon.minimax import allocate, linear_rows
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import LinearProblem
from maxcon.search import milp as milp_module
from maxcon.search import milp_box
from maxcon.search.anytime import Best, Task, make_task, run
from maxcon.search.milp import LARGEST_M, milp
from maxcon.search.milp_box import model_box
from maxcon.search.sweep import exact_sweep
from maxcon.waiting import solver_at_work
from oracles import brute_force_consensus, highs_minimax

#: Families whose thresholds are so far below their residuals that no M is small enough for HiGHS.
TOO_FAR = {"huge", "far_outliers", "leverage", "leverage_outliers"}


def task_of(A, b, threshold, **limits) -> Task:
    return make_task(LinearProblem(A, b), threshold, np.random.default_rng(0), **limits)


def judged(task: Task, **options) -> Best:
    best = run(task, milp(task, **options))
    if best.subset is not None:
        value = highs_minimax(task.problem.A[best.subset], task.problem.b[best.subset])
        assert value <= task.limit * task.rows.scale * (1 + 1e-12) + 1e-13 * task.problem.scale
    return best


def small_instance(name: str, seed: int, most: int = 14):
    rng = np.random.default_rng([seed, len(name)])
    d = int(rng.integers(1, 5))
    A, b = BUILDERS[name](rng, int(rng.integers(d + 1, most + 1)), d)
    some = rng.uniform(0.01, 0.5) * np.abs(b[:most]).max() + 1e-12
    return A[:most], b[:most], float(rng.choice([0.05, 0.1, 0.5, 1.0, 1.5, 2.0, some]))


def compare(name: str, seed: int) -> bool:
    """Compare with all subsets; return whether HiGHS was able to prove it."""
    A, b, threshold = small_instance(name, seed)
    expected = brute_force_consensus(A, b, threshold)
    best = judged(task_of(A, b, threshold))
    assert best.size == expected, (name, seed)
    assert best.upper_bound in (expected, len(b)), (name, seed)
    return best.upper_bound == expected


@pytest.mark.parametrize("name", BUILDERS)
def test_every_family(name):
    proven = [compare(name, seed) for seed in range(6)]
    assert all(proven) or name in TOO_FAR


@pytest.mark.slow
@pytest.mark.parametrize("name", BUILDERS)
def test_every_family_at_length(name):
    proven = [compare(name, seed) for seed in range(100, 125)]
    assert all(proven) or name in TOO_FAR


@pytest.mark.parametrize("rate", [0.2, 0.4, 0.6])
def test_lines_as_the_sweep(rate):
    A, b = synthetic(np.random.default_rng(1), 100, 2, rate)
    task = task_of(A, b, 0.1)
    best = judged(task)
    assert best.size == best.upper_bound == run(task, exact_sweep(task)).size


def test_eight_dimensions():
    A, b = synthetic(np.random.default_rng(0), 60, 8, 0.1)
    best = judged(task_of(A, b, 0.1))
    assert best.size == best.upper_bound == 54


def test_a_given_box():
    A, b = synthetic(np.random.default_rng(0), 50, 2, 0.3)
    task = task_of(A, b, 0.1)
    expected = run(task, exact_sweep(task)).size
    assert judged(task, box=(-2, 2)).upper_bound == expected
    assert judged(task, box=([-2, -2], [2, 2])).upper_bound == expected
    assert judged(task, box=(5, 6)).upper_bound < expected  # where no good model is


def test_hopeless_points_do_not_count():
    """Points far from all models have the largest M; HiGHS never sees them."""
    A, b = synthetic(np.random.default_rng(0), 30, 2, 0.2)
    b[:4] += 1e9
    best = judged(task_of(A, b, 0.1))
    assert best.size == best.upper_bound


def test_rank_zero_and_no_inlier():
    best = judged(task_of(np.zeros((4, 2)), np.array([0.5, 1.0, 2.0, -1.0]), 1.0))
    assert best.size == best.upper_bound == 3
    best = judged(task_of(np.zeros((3, 1)), np.array([2.0, -3.0, 4.0]), 1.0))
    assert best.subset is None
    assert best.upper_bound == 0


def test_a_time_limit_leaves_a_set_and_a_bound():
    A, b = synthetic(np.random.default_rng(0), 100, 8, 0.3)
    task = task_of(A, b, 0.1, time_limit=4.0)
    bounds = [step.upper_bound for step in milp(task) if step.upper_bound is not None]
    assert all(70 <= bound <= 100 for bound in bounds)
    assert len(bounds) == 1


def test_called_again_for_longer_where_there_is_no_limit(monkeypatch):
    monkeypatch.setattr(milp_module, "FIRST_SLICE", 0.01)
    A, b = synthetic(np.random.default_rng(0), 60, 8, 0.12)
    steps = [step for step in milp(task_of(A, b, 0.1)) if step.upper_bound is not None]
    assert len(steps) > 1
    assert steps[-1].upper_bound == 53


@pytest.mark.skipif(os.name != "posix", reason="sends SIGINT")
def test_ctrl_c_leaves_the_solver_and_keeps_the_best(monkeypatch, heard):
    """HiGHS does not look up, here for ten seconds: what the short peel before it has found is returned at once."""
    done = threading.Event()
    solve = scipy.optimize.milp

    def solver(*_args, **_options):
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)
        done.wait(10)

    monkeypatch.setattr("scipy.optimize.milp", solver)
    A, b = synthetic(np.random.default_rng(0), 30, 3, 0.2)
    began = time.monotonic()
    best = judged(task_of(A, b, 0.1))
    assert time.monotonic() - began < 9
    assert best.interrupted
    assert best.size >= 24
    assert best.upper_bound == 30
    assert solver_at_work()
    monkeypatch.setattr("scipy.optimize.milp", solve)
    assert judged(task_of(A, b, 0.1)).gap == 0  # beside the one that is left to its own
    done.set()
    while solver_at_work():
        time.sleep(0.01)


def test_options():
    task = task_of(*synthetic(np.random.default_rng(0), 20, 2, 0.3), 0.1)
    for options, error, message in [
        ({"node_limit": 0}, ValueError, "node_limit must be at least 1"),
        ({"box": 3}, TypeError, "box must be a pair"),
        ({"box": (1.0, -1.0)}, ValueError, "box must have finite ends"),
        ({"box": (-np.inf, np.inf)}, ValueError, "box must have finite ends"),
        ({"box": ([0, 0, 0], 1)}, ValueError, "box must have ends that are numbers or of shape"),
    ]:
        with pytest.raises(error, match=message):
            milp(task, **options)


# -------------------------------------------------------------------------------------------- the box


def fits(rows, limit, mask) -> bool:
    workspace = allocate(rows, mask)
    assert cold_fit(*workspace) == OK
    return bool(workspace.x[-1] <= limit)


def best_sets(rows, limit):
    """All largest subsets that fit; `limit` is in the unit of the rows."""
    N = len(rows.b)
    for size in range(N, 0, -1):
        masks = []
        for chosen in itertools.combinations(range(N), size):
            mask = np.zeros(N, dtype=bool)
            mask[list(chosen)] = True
            if fits(rows, limit, mask):
                masks.append(mask)
        if masks:
            return masks
    return []


def extent(rows, limit, mask, low, high, objective):
    """Minimise objective . phi over the models of a set within a box; None if it has none there."""
    At, b = rows.At[:, mask], rows.b[mask]
    scale = np.maximum(np.abs(At).max(axis=0), 1e-300)
    A_ub = np.vstack([At.T / scale[:, None], -At.T / scale[:, None]])
    b_ub = np.r_[(b + limit) / scale, (limit - b) / scale]
    answer = linprog(objective, A_ub=A_ub, b_ub=b_ub + 1e-9 * np.abs(b_ub), bounds=np.column_stack([low, high]))
    return answer.fun if answer.status == 0 else None


@pytest.mark.parametrize("blocks", [False, True])
@pytest.mark.parametrize("tight", [0.0, np.inf])
@pytest.mark.parametrize("name", ["synthetic_some", "quantised", "duplicate_a", "uniform_noise", "one_x", "zero_rows"])
def test_box_holds_a_model_of_every_best_set(name, tight, blocks, monkeypatch):
    for seed in range(4):
        rng = np.random.default_rng([seed, len(name)])
        A, b = BUILDERS[name](rng, 10, 2)
        rows = linear_rows(LinearProblem(A, b))
        limit = 0.25 * float(np.abs(rows.b).max())
        sets = best_sets(rows, limit)
        known = int(sets[0].sum()) - seed % 2  # the count that is known need not be the best
        if blocks and seed % 2 == 0:
            monkeypatch.setattr(milp_box, "MOST_MINORS", 25)  # not all 45 pairs: two blocks of 5 have 20
        box = model_box(rows.At, rows.b, limit, known, tight, np.random.default_rng(seed))
        monkeypatch.undo()
        if not box.proven:
            assert blocks
            continue
        assert (box.low <= box.high).all()
        zero = np.zeros(len(box.low))
        for mask in sets:
            assert extent(rows, limit, mask, box.low, box.high, zero) is not None


def test_counted_box_holds_all_models_of_all_best_sets():
    """Where the best sets span, the models at their ends are within the box, which is not much larger."""
    for seed in range(5):
        A, b = synthetic(np.random.default_rng(seed), 12, 2, 0.25)
        rows = linear_rows(LinearProblem(A, b))
        limit = 0.1 / rows.scale
        sets = best_sets(rows, limit)
        box = model_box(rows.At, rows.b, limit, int(sets[0].sum()), 0.0, np.random.default_rng(0))
        assert box.proven
        for mask, j in itertools.product(sets, range(2)):
            towards = np.eye(2)[j]
            lowest = extent(rows, limit, mask, -np.full(2, np.inf), np.full(2, np.inf), towards)
            highest = -extent(rows, limit, mask, -np.full(2, np.inf), np.full(2, np.inf), -towards)
            assert box.low[j] - 1e-7 <= lowest <= highest <= box.high[j] + 1e-7
            assert box.high[j] - box.low[j] <= 20 * (highest - lowest)


def test_box_of_degenerate_data_is_a_guess_only_where_both_arguments_fail(monkeypatch):
    rng = np.random.default_rng(0)
    A = np.outer(rng.integers(1, 5, 12), [1.0, 2.0, 3.0])  # all on one line through 0, but for three
    A[:3] = np.eye(3)
    rows = linear_rows(LinearProblem(A, rng.uniform(-1, 1, 12)))
    arguments = (rows.At, rows.b, 0.1 / rows.scale, 4, LARGEST_M)
    assert model_box(*arguments, np.random.default_rng(0)).proven
    monkeypatch.setattr(milp_box, "MOST_MINORS", 300)  # all 220 triples, but not all 455 minors
    assert not model_box(*arguments, np.random.default_rng(0)).proven
