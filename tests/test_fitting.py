"""The front door: its arguments, its result, and the loop behind it."""

import dataclasses
import threading
import time

import numpy as np
import pytest
from numba import config
from numba.core import event

import maxcon
import maxcon.fitting
from instances import FAMILIES
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.minimax import jit
from maxcon.minimax.jit import compile_seconds, working_clock
from maxcon.search.anytime import Progress, Step, make_task, run
from maxcon.search.conclusion import conclude
from maxcon.search.milp import milp
from maxcon.search.witness import make_witness
from oracles import default_slack, highs_minimax

METHODS = tuple(maxcon.methods())


@pytest.fixture
def problem():
    return synthetic_hyperplane(np.random.default_rng(1), 60, 0.4, 2)


def serves(method, problem):
    largest = {"sweep": 2, "agent": 3, "uclm": 3}
    return problem.n_params <= largest.get(method, 99)


def check(result, problem, threshold):
    """Everything that a Consensus promises."""
    limit = threshold + default_slack(threshold, problem.b)
    if result.status == "infeasible":
        assert result.n_inliers == result.upper_bound == 0
        assert np.isnan(result.model).all()
        return
    residuals = np.abs(problem.A @ result.model - problem.b)
    assert np.allclose(result.residuals, residuals, rtol=1e-12, atol=1e-12 * problem.scale)
    assert np.array_equal(result.inlier_mask, result.residuals <= limit)
    assert result.n_inliers == result.inlier_mask.sum() > 0
    assert result.n_inliers <= result.upper_bound <= problem.n_points
    assert result.gap == result.upper_bound - result.n_inliers
    assert result.status == {True: "optimal"}.get(result.gap == 0, result.status)
    mask = result.inlier_mask
    value = highs_minimax(problem.A[mask], problem.b[mask])
    assert residuals[mask].max() == pytest.approx(value, rel=1e-8, abs=1e-11 * problem.scale)
    assert result.inlier_mask[result.basis].all()
    assert len(set(result.path.tolist())) == len(result.path)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("n_params", [2, 3, 5])
def test_every_method_keeps_what_a_consensus_promises(method, n_params):
    problem = synthetic_hyperplane(np.random.default_rng(n_params), 40, 0.3, n_params)
    if not serves(method, problem):
        with pytest.raises(ValueError, match=r"parameters, but this one has|families"):
            maxcon.fit(problem, 0.1, method=method)
        return
    limit = 0.2 if method == "learned" else 2  # which takes all the time there is
    for refine in (None, "tree", "swap"):
        result = maxcon.fit(problem, 0.1, method=method, refine=refine, time_limit=limit)
        check(result, problem, 0.1)
        assert result.method == method
        again = maxcon.fit(problem, 0.1, method=method, refine=refine, time_limit=limit)
        if max(result.seconds, again.seconds) < 0.75 * limit:  # not cut short by the time limit
            assert np.array_equal(again.inlier_mask, result.inlier_mask)


@pytest.mark.parametrize("family", FAMILIES)
def test_degenerate_data(family):
    rng = np.random.default_rng(len(family))
    A, b = FAMILIES[family](rng)
    problem = maxcon.LinearProblem(A, b)
    threshold = float(np.quantile(np.abs(b - np.median(b)), 0.3)) + 1e-6 * problem.scale + 1e-9
    for method in ("greedy", "random", "lo-ransac", "auto"):
        check(maxcon.fit(problem, threshold, method=method, time_limit=1), problem, threshold)


def test_the_name_fit_is_the_function_whatever_was_imported_first():
    assert callable(maxcon.fit)
    assert maxcon.fit is maxcon.fitting.fit


def test_no_seed_and_the_same_seed_give_the_same_answer(problem):
    one, two = (maxcon.fit(problem, 0.1, method="random", refine=None) for _ in range(2))
    assert np.array_equal(one.path, two.path)
    assert one.seed == 0
    other = maxcon.fit(problem, 0.1, method="random", refine=None, rng=1)
    assert not np.array_equal(one.path, other.path)
    assert maxcon.fit(problem, 0.1, rng=np.random.default_rng(3)).seed is None


def test_refinement_never_loses(problem):
    for seed in range(10):
        sizes = [
            maxcon.fit(problem, 0.1, method="random", rng=seed, refine=refine).n_inliers
            for refine in (None, "tree", "swap")
        ]
        assert sizes == sorted(sizes)


def test_no_model_is_a_status():
    nothing = maxcon.LinearProblem(np.zeros((5, 2)), [1.0, 2, 3, 4, 5])
    for method in ("greedy", "random", "exact", "lo-ransac", "auto"):
        result = maxcon.fit(nothing, 0.5, method=method)
        assert result.status == "infeasible"
        assert (result.n_inliers, result.upper_bound, result.gap) == (0, 0, 0)


def test_one_feasible_point_is_a_model():
    lonely = maxcon.LinearProblem(np.zeros((5, 2)), [1.0, 2, 3, 4, 0.2])
    for method in ("greedy", "exact", "lo-ransac"):
        assert maxcon.fit(lonely, 0.5, method=method).inlier_mask.tolist() == [False] * 4 + [True]


def test_all_points_fit():
    result = maxcon.fit(maxcon.line(np.arange(9.0), np.arange(9.0)), 0.1)
    assert result.n_inliers == result.upper_bound == 9
    assert result.status == "optimal"


def test_the_result_is_frozen(problem):
    result = maxcon.fit(problem, 0.1)
    with pytest.raises(dataclasses.FrozenInstanceError):
        result.n_inliers = 3


@pytest.mark.parametrize(
    ("changes", "kind", "message"),
    [
        ({"problem": [[1, 2]]}, TypeError, "problem must be a LinearProblem"),
        ({"threshold": 0}, ValueError, "threshold must be a positive"),
        ({"threshold": -1.0}, ValueError, "threshold must be a positive"),
        ({"threshold": float("nan")}, ValueError, "threshold must be a positive"),
        ({"threshold": float("inf")}, ValueError, "threshold must be a positive"),
        ({"threshold": "1"}, TypeError, "threshold must be a number"),
        ({"method": "best"}, ValueError, "method must be one of auto, "),
        ({"method": 3}, TypeError, "method must be a string"),
        ({"rng": -1}, ValueError, "rng must be a seed"),
        ({"rng": "x"}, TypeError, "rng must be None, a seed"),
        ({"time_limit": 0}, ValueError, "time_limit must be a positive"),
        ({"time_limit": float("nan")}, ValueError, "time_limit must be a positive"),
        ({"time_limit": "1"}, TypeError, "time_limit must be a number"),
        ({"refine": "swop"}, ValueError, "refine must be 'tree', 'swap' or None"),
        ({"refine": 1}, TypeError, "refine must be 'tree', 'swap' or None"),
        ({"gap": -1}, ValueError, "gap must be at least 0"),
        ({"gap": 0.5}, TypeError, "gap must be a whole number"),
        ({"callback": 3}, TypeError, "callback must be callable"),
        ({"method": "greedy", "tries": 3}, TypeError, "unknown option 'tries' for method greedy: "),
        ({"method": "random", "tries": 0}, ValueError, "tries must be a positive integer"),
        ({"method": "agent", "temperature": 0}, ValueError, "temperature must be positive"),
        ({"method": "agent", "weights": "nowhere.safetensors"}, ValueError, "weights must name an agent file"),
    ],
)
def test_bad_arguments_are_named(problem, changes, kind, message):
    arguments = {"problem": problem, "threshold": 0.1, **changes}
    with pytest.raises(kind, match=message):
        maxcon.fit(arguments.pop("problem"), arguments.pop("threshold"), **arguments)


def feasible_sets(problem):
    """Ever larger prefixes of the inliers of an optimal fit."""
    order = np.flatnonzero(maxcon.fit(problem, 0.1).inlier_mask)
    for size in range(1, len(order) + 1):
        subset = np.zeros(problem.n_points, dtype=np.bool_)
        subset[order[:size]] = True
        yield Step(subset=subset, upper_bound=problem.n_points - size)


def test_the_loop_keeps_the_best_and_tells_the_callback(problem):
    seen: list[Progress] = []
    task = make_task(problem, 0.1, np.random.default_rng(0))
    best = run(task, feasible_sets(problem), callback=seen.append)
    assert [each.n_inliers for each in seen] == list(range(1, best.size + 1))
    assert [each.upper_bound for each in seen] == [60 - each.n_inliers for each in seen]


def test_the_loop_stops_on_the_callbacks_word(problem):
    task = make_task(problem, 0.1, np.random.default_rng(0))
    assert run(task, feasible_sets(problem), callback=lambda progress: progress.n_inliers == 5).size == 5


def test_the_loop_stops_at_the_gap(problem):
    task = make_task(problem, 0.1, np.random.default_rng(0), gap=40)
    best = run(task, feasible_sets(problem))
    assert best.size == 10
    assert best.gap == 40


def test_the_loop_stops_at_the_deadline_and_on_ctrl_c(problem):
    def endless():
        yield from list(feasible_sets(problem))[:7]
        while True:
            time.sleep(0.001)
            yield Step()

    def interrupted():
        yield from list(feasible_sets(problem))[:7]
        raise KeyboardInterrupt

    assert run(make_task(problem, 0.1, np.random.default_rng(0), time_limit=0.05), endless()).size == 7
    best = run(make_task(problem, 0.1, np.random.default_rng(0)), interrupted())
    assert best.size == 7
    assert best.interrupted


def test_stopped_before_the_first_step_there_is_still_a_model(problem):
    result = maxcon.fit(problem, 0.1, method="random", time_limit=1e-9)
    check(result, problem, 0.1)


def test_a_bound_that_is_refuted_proves_nothing(problem):
    task = make_task(problem, 0.1, np.random.default_rng(0))
    found = maxcon.fit(problem, 0.1).inlier_mask
    best = run(task, iter([Step(subset=found, upper_bound=int(found.sum()) - 1)]))
    result = conclude(task, best, "liar", None, 0.0)
    assert result.status == "heuristic"
    assert result.upper_bound == problem.n_points


def test_a_long_walk_of_the_agent_can_be_stopped():
    problem = synthetic_hyperplane(np.random.default_rng(0), 2000, 0.5, 2)
    seen = []
    result = maxcon.fit(problem, 0.1, method="agent", time_limit=0.05, callback=seen.append)
    check(result, problem, 0.1)
    assert not seen  # the walk had not ended


def test_compiling_does_not_count_against_the_time_limit(problem, monkeypatch):
    """As if every step took a minute of compiling."""
    compiled = [0.0]
    monkeypatch.setattr(maxcon.search.anytime, "compile_seconds", lambda: compiled[0])
    task = make_task(problem, 0.1, np.random.default_rng(0), time_limit=0.02)

    def steps():
        for _ in range(3):
            time.sleep(0.03)
            compiled[0] += 60
            yield Step()
        compiled[0] = 0.0
        yield Step(upper_bound=50)
        raise AssertionError("the time is over")

    assert run(task, steps()).upper_bound == 50


@pytest.mark.skipif(config.DISABLE_JIT, reason="no kernel is compiled")
def test_loading_kernels_does_not_count_either():
    """Numba holds its lock while it compiles and while it loads a kernel from disk."""
    clock, began, before = working_clock(), time.perf_counter(), compile_seconds()
    with event.trigger_event("numba:compiler_lock"):
        with event.trigger_event("numba:compiler_lock"):  # a kernel that another one calls
            time.sleep(0.05)
        time.sleep(0.05)
    taken = compile_seconds() - before
    assert 0.1 <= taken <= time.perf_counter() - began
    assert working_clock() - clock <= time.perf_counter() - began - taken + 1e-3


def test_methods_with_a_look_of_their_own_at_the_clock_count_no_compiling():
    """As if an hour of compiling had passed since the deadline was set."""
    problem = synthetic_hyperplane(np.random.default_rng(0), 40, 0.2, 2)
    mask = maxcon.fit(problem, 0.1, method="ransac").inlier_mask
    task = make_task(problem, 0.1, np.random.default_rng(0), time_limit=60.0)
    late = dataclasses.replace(task, deadline=time.perf_counter() - 1.0, compiled=compile_seconds() - 3600.0)
    assert make_witness(late, mask).upper_bound == make_witness(task, mask).upper_bound < 39
    assert run(late, milp(late)).gap == 0


@pytest.mark.skipif(config.DISABLE_JIT, reason="no kernel is compiled")
def test_kernels_that_other_threads_load():
    before = compile_seconds()
    inside, done = threading.Barrier(3), threading.Event()

    def load():
        with event.trigger_event("numba:compiler_lock"):
            inside.wait(10)
            done.wait(10)

    threads = [threading.Thread(target=load) for _ in range(2)]
    for thread in threads:
        thread.start()
    inside.wait(10)
    time.sleep(0.05)
    assert 0.05 <= compile_seconds() - before < 10  # one is at it, one waits: counted once
    done.set()
    for thread in threads:
        thread.join()
    known = compile_seconds()
    time.sleep(0.02)
    assert compile_seconds() == known


@pytest.mark.skipif(config.DISABLE_JIT, reason="no kernel is compiled")
def test_ctrl_c_while_a_kernel_is_waited_for_does_not_stop_the_clock():
    """Numba notes the start before it has its lock; interrupted there, it notes no end."""
    before = compile_seconds()
    event.start_event("numba:compiler_lock")
    clock = working_clock()
    time.sleep(0.05)
    assert working_clock() - clock >= 0.05
    assert compile_seconds() == before


def test_progress_counts_the_seconds_that_the_result_counts(monkeypatch):
    """Not those of kernels that are compiled or loaded on the way, as if one were here."""

    def slow(task):
        time.sleep(0.02)
        monkeypatch.setattr(jit._making, "seconds", jit._making.seconds + 0.02)
        yield Step(subset=np.isin(np.arange(task.problem.n_points), [0, 1]))

    monkeypatch.setattr("maxcon.search.removal.random_removal", slow)
    told = []
    problem = maxcon.line(np.arange(5.0), np.arange(5.0) ** 2)
    result = maxcon.fit(problem, 0.1, method="random", callback=lambda progress: told.append(progress.seconds))
    assert told
    assert 0.0 <= told[-1] <= result.seconds
