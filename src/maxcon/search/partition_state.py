"""The arrays of one partition search: what its kernels read and write, allocated once and grown where a stack is full.

A search may stop after any step and go on later: all of its state is here. A `place` is a point's number in the order
of the merge tree.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maxcon.search.partition_tree import HEIGHT, N_TREE_COLUMNS, MergeTree

#: A lower bound that stands for "no model keeps all enforced points": more than any number of outliers.
NEVER = 1 << 20

# The columns of `nodes` after those of the tree.
CUR = N_TREE_COLUMNS  # a proven lower bound on the outliers of the node's points, in the present state
EXACT = CUR + 1  # 1 where that is the optimum
PROVEN = CUR + 2  # a proven lower bound with no point removed or enforced, good at any moment
SEEN = CUR + 3  # how many models were met at this node
FIRST = CUR + 4  # how many of them stay for good
N_NODE_COLUMNS = CUR + 5

# The registers.
DEPTH = 0  # frames on the stack
TRAIL = 1  # entries on the trail
ENFORCED = 2  # points enforced
WORK = 3  # columns of all linear programmes solved so far: what budgets are counted in
LINE = 4  # how many enforced points the line of `partition_line` hangs on; -1: there is none
QUEUE = 5  # which kind of jobs is done; see `partition_jobs`
JOB = 6  # the present job, or the next one
LAST = 7  # the job to stop before
OPEN = 8  # 1 while a job is under way
BEGAN = 9  # the work counter when it began
TRIAL = 10  # 1 while a node is tried as a leaf
TRIAL_END = 11  # the work counter at which the trial fails
TRIAL_CUR = 12  # what the node was before the trial: bound, left child, subtree size, height
TRIAL_LEFT = 13
TRIAL_SIZE = 14
TRIAL_HEIGHT = 15
LINKS = 16  # tasks that the root has been cut into
INCUMBENT = 17  # outliers of the incumbent
BEST = 18  # outliers of the best model met in the present job (those of the incumbent at first)
FOUND = 19  # outliers of the best model of all jobs; the first one met of its size
EXPANDED = 20  # how often the search has branched
N_REGISTERS = 21

# The columns of a frame.
KIND = 0  # SOLVE or REFRESH
NODE = 1
TARGET = 2  # prove at least so many outliers
UPPER = 3  # the node's optimum is at most this
STAGE = 4
PHASE = 5  # descendants up to this height are refreshed
ORIGIN = 6  # COLD, or the frame below with its branching point under ENFORCE or REMOVE
COLUMN = 7  # the branching point, as a column of the node's programme
LOWER_IN = 8  # what the child with that point enforced has proven
MARK = 9  # the trail's length before branching
CHAIN = 10  # 1: list the children with a point enforced as tasks instead of solving them
OWNER = 11  # the frame whose BASE vertex holds the points enforced now; -1: there is no programme yet
BASES = 12  # disjoint infeasible bases known
POOLED = 13  # 1 where the frame has a POOL vertex
N_FRAME_COLUMNS = 14

SOLVE, REFRESH = 0, 1
COLD, ENFORCE, REMOVE = 0, 1, 2

# The vertices of a frame: of its whole programme, of its enforced points only, of what its bases leave over.
WHOLE, BASE, POOL = 0, 1, 2

# The columns of `heights`, for the linear programmes of nodes of one height.
OFFSET, COLUMNS, ENDS = 0, 1, 2  # where they lie; how many points; 1 where the intervals are those of the line

# The rows of `lp`: right sides, modes, residuals and the ends of the intervals on the line.
RIGHT_SIDE, GAIN, CAP, RESIDUAL, BEGIN, END = range(6)

#: Models that each node keeps; a third of them stay from before the root is solved.
MODELS_KEPT = 48

#: The models of all nodes may take about this many bytes: each node keeps fewer where there are many.
MODEL_BYTES = 64 << 20


class SearchState(NamedTuple):
    """The arrays of one search.

    Attributes
    ----------
    At, b, limit
        Rows in the order of places, shapes (d, N) and (N,); shape (1,): residuals up to it are inliers.
    rank
        Shape (N,): residual of each point under the incumbent, or doubt; branching takes the largest.
    nodes
        The merge tree and what is known of each node, shape (T, 12).
    leaf_of
        Shape (N,): the leaf that owns each place.
    kept, held
        Shape (N,), 0 or 1: the point is not removed; the point is enforced.
    enforced
        Shape (N,): the enforced places; ``registers[ENFORCED]`` of them.
    models
        Shape (T + 1, K, N), 0 or 1: the outliers of models met at each node; row T: of the incumbent.
    best_out, found_out
        Shape (N,): the outliers of the models that ``registers[BEST]`` and ``registers[FOUND]`` count.
    registers
        The numbers that change.
    frames, C, x, q, labels
        The stack; the vertices of each frame, shapes (F, 3, d + 1, d + 1), (F, 3, d + 1) twice; to which of its bases
        each column of its programme belongs (0: none), shape (F, N).
    trail
        Saved bounds.
    heights, lp_rows, lp, lp_place
        The linear programmes, in one place for each height of the tree: rows; right sides and more, shape (6, ...);
        the place of each column.
    spare, work, table, far
        Scratch space.
    line, line_place
        The line that d - 1 enforced points leave, shape (2 d + 3, d), and these points.
    queue
        Shape (T,): the nodes that jobs solve.
    task_place, task_target, task_bounds, task_proven
        The tasks that the root is cut into: in task k the points of the tasks before it are removed and its own is
        enforced. Its place, what is to be proven of the rest, the bounds before it is enforced, and what was proven.
    """

    At: NDArray[np.float64]
    b: NDArray[np.float64]
    limit: NDArray[np.float64]
    rank: NDArray[np.float64]
    nodes: NDArray[np.int64]
    leaf_of: NDArray[np.int64]
    kept: NDArray[np.uint8]
    held: NDArray[np.uint8]
    enforced: NDArray[np.int64]
    models: NDArray[np.uint8]
    best_out: NDArray[np.uint8]
    found_out: NDArray[np.uint8]
    registers: NDArray[np.int64]
    frames: NDArray[np.int64]
    C: NDArray[np.float64]
    x: NDArray[np.float64]
    q: NDArray[np.int64]
    labels: NDArray[np.int32]
    trail: NDArray[np.int64]
    heights: NDArray[np.int64]
    lp_rows: NDArray[np.float64]
    lp: NDArray[np.float64]
    lp_place: NDArray[np.int64]
    spare: NDArray[np.float64]
    work: NDArray[np.float64]
    table: NDArray[np.float64]
    far: NDArray[np.float64]
    line: NDArray[np.float64]
    line_place: NDArray[np.int64]
    queue: NDArray[np.int64]
    task_place: NDArray[np.int64]
    task_target: NDArray[np.int64]
    task_bounds: NDArray[np.int64]
    task_proven: NDArray[np.int64]


def allocate_state(
    At: NDArray[np.float64], b: NDArray[np.float64], limit: float, tree: MergeTree, residuals: NDArray[np.float64]
) -> SearchState:
    """Return the state in which nothing is removed, enforced or proven; `residuals` are those of the incumbent."""
    d, N = At.shape
    n, T = d + 1, len(tree.nodes)
    widest, depth = max(2 * N, n), 64  # every enforced point may come on top of a node's own
    heights = np.zeros((int(tree.nodes[0, HEIGHT]) + 1, 3), dtype=np.int64)
    heights[:, OFFSET] = widest * np.arange(len(heights))
    total = widest * len(heights)
    nodes = np.zeros((T, N_NODE_COLUMNS), dtype=np.int64)
    nodes[:, :N_TREE_COLUMNS] = tree.nodes
    state = SearchState(
        At=np.ascontiguousarray(At[:, tree.order]),
        b=b[tree.order],
        limit=np.array([limit]),
        rank=residuals[tree.order],
        nodes=nodes,
        leaf_of=tree.leaf_of.copy(),
        kept=np.ones(N, dtype=np.uint8),
        held=np.zeros(N, dtype=np.uint8),
        enforced=np.zeros(N, dtype=np.int64),
        models=np.ones((T + 1, _models_kept(N, T), N), dtype=np.uint8),
        best_out=np.ones(N, dtype=np.uint8),
        found_out=np.ones(N, dtype=np.uint8),
        registers=np.zeros(N_REGISTERS, dtype=np.int64),
        frames=np.zeros((depth, N_FRAME_COLUMNS), dtype=np.int64),
        C=np.zeros((depth, 3, n, n)),
        x=np.zeros((depth, 3, n)),
        q=np.zeros((depth, 3, n), dtype=np.int64),
        labels=np.zeros((depth, N), dtype=np.int32),
        trail=np.zeros(64 + 32 * T, dtype=np.int64),
        heights=heights,
        lp_rows=np.zeros(total * d),
        lp=np.zeros((6, total)),
        lp_place=np.zeros(total, dtype=np.int64),
        spare=np.zeros((3, widest)),
        work=np.zeros((3, widest)),
        table=np.zeros((n + 2, n)),
        far=np.zeros(N),
        line=np.zeros((2 * d + 3, d)),
        line_place=np.zeros(n, dtype=np.int64),
        queue=np.zeros(T, dtype=np.int64),
        task_place=np.zeros(N + 1, dtype=np.int64),
        task_target=np.zeros(N + 1, dtype=np.int64),
        task_bounds=np.zeros((8, T, 2), dtype=np.int64),
        task_proven=np.zeros(N + 1, dtype=np.int64),
    )
    state.registers[[BEST, FOUND, INCUMBENT]] = N
    state.registers[LINE] = -1
    return state


def state_bytes(n_params: int, n_points: int, tree: MergeTree) -> int:
    """Return about how many bytes `allocate_state` takes."""
    n, heights = n_params + 1, int(tree.nodes[0, HEIGHT]) + 1
    programmes = heights * 2 * n_points * (n_params + 7)
    stack = 64 * (N_FRAME_COLUMNS + 3 * n * (n + 2) + 2 * n_points)
    rest = programmes + stack + n_points * (n_params + 20) + 64 * len(tree.nodes)
    return 8 * rest + model_bytes(n_points, len(tree.nodes))


def model_bytes(n_points: int, n_nodes: int) -> int:
    """Return how many bytes the models of the nodes take; `allocate_state` writes them all, which takes its time."""
    return (n_nodes + 1) * _models_kept(n_points, n_nodes) * n_points


def _models_kept(n_points: int, n_nodes: int) -> int:
    """Return how many models each node keeps: of many nodes few, but three at least, whatever that takes."""
    return int(np.clip(MODEL_BYTES // (n_nodes * n_points), 3, MODELS_KEPT))


def grow(state: SearchState) -> SearchState:
    """Return the same state with twice the room on its stacks."""
    grown = {}
    for name in ("frames", "C", "x", "q", "labels", "trail", "task_bounds"):
        array = getattr(state, name)
        grown[name] = np.zeros((2 * len(array), *array.shape[1:]), dtype=array.dtype)
        grown[name][: len(array)] = array
    return state._replace(**grown)
