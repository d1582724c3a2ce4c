"""A* tree search for the largest consensus, plain and accelerated: the paper's two exact baselines.

Chin, Purkait, Eriksson, Suter, "Efficient globally optimal consensus maximisation with tree search" (CVPR
2015); Cai, Chin, Koltun, "Consensus maximization tree search revisited" (ICCV 2019). Written from the papers;
what the published code of the second does where the papers are silent is said where it matters.

Why non-adjacent path avoidance loses nothing
---------------------------------------------
Let C be a best set, f(C) <= threshold, and W_0 = C. Let g_k be the smallest f(W_{k-1} + v) of any point v not
in W_{k-1}, and W_k a largest set that holds W_{k-1} and has f(W_k) = g_k. So g_1 < g_2 < ..., and the last W_k
is all points, where the search starts. Now let S lie between, W_{k-1} < S <= W_k: then f(S) = g_k, so that a
basis of S, whichever it is where there are several, is not within W_{k-1}: it has a point i to remove such that
S - i holds W_{k-1} still. So there is a path down to C. It has no child that is left out: let T be a set on it,
T = W_{k-1} or as S above but with f(T) = g for its own g = g_j, and assume that some removed point p lies
within the fit of T, its residual less than g. T holds W_{j-1}, whose own fit has f < g. A step from the fit of
T towards that one makes the residuals of all of W_{j-1} less than g, and if it is short keeps that of p less
than g: f(W_{j-1} + p) < g, against the choice of g.

This needs "less", where the papers, for data without ties, have "not greater": where points are duplicates of
each other or quantised, the published rule can leave out all paths.

Together with branch pruning the argument fails, for the path may lead through a pruned branch. So there, as in
the latest published code, a non-adjacent child is not left out but stands for the larger set that its fit
explains, with the points that lie within it put back, on a lower level.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax import allocate
from maxcon.minimax.clock import read_clock
from maxcon.minimax.linear import OK, cold_fit
from maxcon.problem import check_indices
from maxcon.search.anytime import Step, Task
from maxcon.search.astar_kernels import (
    ATTEMPTS,
    COUNTED_OUT,
    EXPANDED,
    FINISHED,
    FULL,
    GENERATED,
    NON_ADJACENT,
    PAUSED,
    PRUNED,
    REPEATED,
    Search,
    advance,
    allocate_search,
    plant,
    proven_outliers,
)
from maxcon.search.astar_nodes import MADE, QUEUED, allocate_nodes, bytes_needed, enlarged
from maxcon.search.insertion_kernels import FEWEST, FITS, note_model
from maxcon.search.learned import learned as learned_search
from maxcon.search.sampling import check_count

#: Nodes that there is room for at first.
FIRST_NODES = 1024

#: What the nodes may take in all, unless the caller says otherwise: 1 GiB.
MEMORY_LIMIT = 1 << 30

#: Fits before the first look at the clock, and the seconds that pass between two looks from then on.
FIRST_FITS, PAUSE = 200, 0.02


@dataclass
class AStarStats:
    """What an A* search has done; pass one as the option `stats`, and it is kept up to date.

    Attributes
    ----------
    unique
        Nodes made, the root among them: distinct sets whose heuristic was computed. (What the published code
        of Cai et al. calls the number of unique nodes.)
    expanded
        Nodes taken from the queue.
    generated
        Children looked at.
    repeated
        Children that were a node already.
    non_adjacent
        Children at which NAPA stepped in.
    attempts, pruned
        Bounds computed for DIBP, and branches pruned by them.
    queued
        Nodes that wait.
    fits
        Minimax fits made.
    outliers, proven
        The fewest outliers found, and how many are proven.
    stopped
        Why the search ended without a proof: "node_limit", "memory_limit" or "rounding"; empty where it did
        not.
    """

    unique: int = 0
    expanded: int = 0
    generated: int = 0
    repeated: int = 0
    non_adjacent: int = 0
    attempts: int = 0
    pruned: int = 0
    queued: int = 0
    fits: int = 0
    outliers: int = 0
    proven: int = 0
    stopped: str = ""

    def _update(self, search: Search, proven: int) -> None:
        tally, counts, sizes = search.tally, search.scratch.counts, search.nodes.sizes
        self.unique, self.queued = int(sizes[MADE]), int(sizes[QUEUED])
        self.expanded, self.generated = int(tally[EXPANDED]), int(tally[GENERATED])
        self.repeated, self.non_adjacent = int(tally[REPEATED]), int(tally[NON_ADJACENT])
        self.attempts, self.pruned = int(tally[ATTEMPTS]), int(tally[PRUNED])
        self.fits, self.outliers, self.proven = int(counts[FITS]), int(counts[FEWEST]), proven


def astar(
    task: Task,
    *,
    napa: bool = False,
    dibp: bool = False,
    improve: bool = True,
    learned: bool = False,
    start: NDArray[np.bool_] | None = None,
    node_limit: int | None = None,
    memory_limit: int = MEMORY_LIMIT,
    stats: AStarStats | None = None,
) -> Iterator[Step]:
    """Find the largest consensus and prove it, by A* search through the tree of minimax fits.

    A node is a set S of points; its children are S - i for each point i of its basis; its level is the number
    of points removed, and e = level + h, with the heuristic h of `insertion_kernels` and never less than the
    parent's e where the levels follow each other (for S - i, h is at least the parent's h - 1, and 1). The
    node with the smallest e is expanded first; of equal ones that with the smallest f(S), and of equal ones
    again the one made first. Its children are taken in the order of their residuals under the best model
    known, largest first. A set is made a node only once. All models met while bounding are counted; the
    search ends when no e in the queue is less than the fewest outliers found. Nothing depends on the clock but
    where a time limit cuts the search off.

    Parameters
    ----------
    task
        What is fitted.
    napa
        Non-adjacent path avoidance (Cai et al.): a child whose fit explains, within its f, a
        point removed earlier is left out. With `dibp`, it is replaced by the set with all such points put
        back, where its f is smaller than the parent's. (A residual that ties with f is not "within".)
    dibp
        Dimension-insensitive branch pruning (Cai et al.): if a set would cost too much with the first few of
        its basis points enforced as inliers, then one of these must go, and the other branches are left out.
        Points whose children were nodes before are enforced from the start. The number of others grows by one
        at a time from the least that can work, in the order above.
    improve
        Refine each best set by swaps (`maxcon.search.refine`), where the published code uses another local
        method of its authors (IBCO). False for the bare search.
    learned
        Begin with the learned search (`maxcon.search.learned`): with its set, and with its belief for the heuristic,
        which removes first what is probably an outlier, and puts points back by falling belief. Neither paper has
        this; where the heuristic is not at its limit of N / (d + 1), it makes several times fewer nodes.
    start
        Shape (N,), bool, or indices: a feasible set to begin with, from another method. The better it is, the
        more is pruned.
    node_limit
        Stop, with the bound reached, once so many nodes were made, or up to d more.
    memory_limit
        Stop when the nodes would need more bytes than this, above a first 1024 nodes. A node takes about N / 8
        + 44 bytes; there are twice as many for a moment whenever room is made.
    stats
        Is told what the search does.

    Yields
    ------
    Step
        About every 20 ms: a larger set if one was found, and the bound, N - the smallest e of any node that
        waits.

    Raises
    ------
    TypeError, ValueError
        If an option has the wrong type or is out of its range, or `start` is not feasible.
    ArithmeticError
        If the fit of all points or of `start` does not converge. (Where any other does not, the proof goes no
        further than what is known about its node.)

    Notes
    -----
    Differences from the published code, beside the above: it expands at once, and drops but one of, all nodes
    of equal e and f, which with ties can be different sets; it takes two sets with the same basis for the
    same, likewise; and it keeps nodes whose e is equal to the outliers of the best set, which cannot improve
    it.
    """
    for name, value in (("napa", napa), ("dibp", dibp), ("improve", improve), ("learned", learned)):
        if not isinstance(value, (bool, np.bool_)):
            raise TypeError(f"{name} must be True or False, but it is {value!r}")
    most = np.iinfo(np.int32).max if node_limit is None else check_count(node_limit, "node_limit", 1)
    memory = check_count(memory_limit, "memory_limit", 0)
    if stats is None:
        stats = AStarStats()
    elif not isinstance(stats, AStarStats):
        raise TypeError(f"stats must be an AStarStats or None, but it is a {type(stats).__name__}")
    n = task.rows.At.shape[0] + 1
    nodes = allocate_nodes(task.problem.n_points, max(FIRST_NODES, n + 1))
    search = allocate_search(task.rows, nodes, bool(learned))
    if start is not None:
        _begin_with(task, search, check_indices(start, task.problem.n_points, "start"))
    steps = _steps(task, search, bool(napa), bool(dibp), bool(improve), most, memory, stats)
    return chain(_learn(task, search), steps) if learned else steps


def astar_napa(
    task: Task,
    *,
    improve: bool = True,
    learned: bool = False,
    start: NDArray[np.bool_] | None = None,
    node_limit: int | None = None,
    memory_limit: int = MEMORY_LIMIT,
    stats: AStarStats | None = None,
) -> Iterator[Step]:
    """`astar` with non-adjacent path avoidance; its other options, steps and errors are the same."""
    return astar(
        task,
        napa=True,
        improve=improve,
        learned=learned,
        start=start,
        node_limit=node_limit,
        memory_limit=memory_limit,
        stats=stats,
    )


def astar_napa_dibp(
    task: Task,
    *,
    improve: bool = True,
    learned: bool = False,
    start: NDArray[np.bool_] | None = None,
    node_limit: int | None = None,
    memory_limit: int = MEMORY_LIMIT,
    stats: AStarStats | None = None,
) -> Iterator[Step]:
    """`astar` with non-adjacent path avoidance and branch pruning; the other options, steps and errors are the same."""
    return astar(
        task,
        napa=True,
        dibp=True,
        improve=improve,
        learned=learned,
        start=start,
        node_limit=node_limit,
        memory_limit=memory_limit,
        stats=stats,
    )


def _begin_with(task: Task, search: Search, subset: NDArray[np.bool_]) -> None:
    """Let the search know a feasible set."""
    workspace = allocate(task.rows, subset)
    if cold_fit(*workspace) != OK:
        raise ArithmeticError("the minimax fit of start did not converge; please report the data")
    if workspace.x[-1] > task.limit:
        raise ValueError(
            f"start must be feasible, f(S) <= threshold = {task.threshold:g}, but f(S) = "
            f"{workspace.x[-1] * task.rows.scale:g} for its {int(subset.sum())} points"
        )
    note_model(workspace, task.limit, search.scratch)


def _learn(task: Task, search: Search) -> Iterator[Step]:
    """Let the search know the set of the learned search, and its belief."""
    best, belief = np.zeros(task.problem.n_points, dtype=np.bool_), search.scratch.doubt
    for step in learned_search(replace(task, deadline=np.inf), belief_out=belief):  # so that it ends by itself
        if step.subset is not None:
            best = step.subset
        yield step
    belief[:] = 1.0 - belief
    workspace = allocate(task.rows, best)
    if best.any() and cold_fit(*workspace) == OK:
        note_model(workspace, task.limit, search.scratch)


def _steps(
    task: Task,
    search: Search,
    napa: bool,
    dibp: bool,
    improve: bool,
    most_nodes: int,
    memory: int,
    stats: AStarStats,
) -> Iterator[Step]:
    N = task.problem.n_points
    if plant(search, task.limit) != OK:
        raise ArithmeticError("the minimax fit of all points did not converge; please report the data")
    fewest, proven, fits, status = N, 0, FIRST_FITS, PAUSED
    while True:
        counts = search.scratch.counts
        proven = max(proven, proven_outliers(search))
        stats._update(search, proven)
        better = counts[FEWEST] < fewest
        fewest = int(counts[FEWEST])
        yield Step(subset=search.scratch.inliers.copy() if better else None, upper_bound=N - proven)
        if status in (FINISHED, COUNTED_OUT):
            break
        if status == FULL:
            grown = _grown(search, memory)
            if grown is None:
                break
            search = grown
        began = read_clock()
        status = advance(search, task.limit, napa, dibp, improve, fits, most_nodes)
        fits = _next_budget(fits, read_clock() - began)
    if status != FINISHED:
        stats.stopped = "node_limit" if status == COUNTED_OUT else "memory_limit"
    elif proven < fewest:
        stats.stopped = "rounding"


def _next_budget(fits: int, seconds: float) -> int:
    return max(1, int(fits * min(max(PAUSE / max(seconds, 1e-9), 0.5), 2.0)))


def _grown(search: Search, memory: int) -> Search | None:
    """Return the search with room for up to twice as many nodes, or None where memory ends."""
    nodes = search.nodes
    N, capacity = len(search.names), len(nodes.key)
    for eighths in (16, 14, 12, 10, 9):
        wanted = capacity * eighths // 8
        if bytes_needed(N, wanted) + bytes_needed(N, capacity) <= memory:  # both are there for a moment
            return search._replace(nodes=enlarged(nodes, wanted))
    return None
