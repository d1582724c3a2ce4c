"""The jobs of the partition search: which frame comes first on an empty stack, and what to keep when it is gone.

A job sees nothing that the jobs beside it have found, so that neither their order nor the number of threads matters.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.partition_moves import enforce_place, push
from maxcon.search.partition_state import (
    BEGAN,
    BEST,
    COLD,
    CUR,
    DEPTH,
    ENFORCED,
    EXACT,
    FIRST,
    FOUND,
    INCUMBENT,
    JOB,
    LAST,
    LINE,
    LINKS,
    NEVER,
    OPEN,
    PROVEN,
    QUEUE,
    SEEN,
    SOLVE,
    TRAIL,
    TRIAL,
    TRIAL_CUR,
    TRIAL_END,
    TRIAL_HEIGHT,
    TRIAL_LEFT,
    TRIAL_SIZE,
    WORK,
)
from maxcon.search.partition_tree import HEIGHT, HI, LEFT, LO, RIGHT, SIZE

Integers = NDArray[np.int64]
Flags = NDArray[np.uint8]

# The kinds of jobs: find the optimum of a node of `queue`; list the tasks of the root; run one of them.
SOLVE_NODES, LIST_TASKS, RUN_TASKS = range(3)

#: An inner node becomes a leaf where solving it as one takes no more than this part of the work, one in so many.
#: Small groups of real data often prove nothing, and then the work is in their merging.
LEAF_PAYS = 4


@kernel
def next_job(
    nodes: Integers,
    leaf_of: Integers,
    kept: Flags,
    held: Flags,
    enforced: Integers,
    frames: Integers,
    registers: Integers,
    queue: Integers,
    task_place: Integers,
    task_target: Integers,
    task_bounds: Integers,
    task_proven: Integers,
    best_out: Flags,
    found_out: Flags,
    n_stay: int,
) -> bool:
    """Close the job that has come to its end, and open the next one; False if there is none.

    `n_stay` is how many models of a node stay for good.
    """
    kind, job = registers[QUEUE], registers[JOB]
    if registers[OPEN]:
        if kind == SOLVE_NODES:
            t = queue[job]
            if registers[TRIAL] == 0 and nodes[t, LEFT] >= 0 and nodes[t, EXACT]:
                _try_as_leaf(nodes, leaf_of, frames, registers, t)
                return True
            for k in range(t, t + nodes[t, SIZE]):
                nodes[k, FIRST] = min(nodes[k, SEEN], n_stay)
                nodes[k, PROVEN] = nodes[k, CUR]
        elif kind == RUN_TASKS:
            task_proven[job] = nodes[0, CUR]
            for k in range(job + 1):
                kept[task_place[k]] = 1
            held[task_place[job]] = 0
            registers[ENFORCED] = 0
            registers[LINE] = -1
        if registers[BEST] < registers[FOUND]:
            registers[FOUND] = registers[BEST]
            for p in range(best_out.shape[0]):
                found_out[p] = best_out[p]
        registers[OPEN] = 0
        job += 1
        registers[JOB] = job
    if job >= registers[LAST]:
        return False

    registers[OPEN] = 1
    registers[TRIAL] = 0
    registers[BEGAN] = registers[WORK]
    registers[BEST] = registers[INCUMBENT]
    for k in range(nodes.shape[0]):
        nodes[k, SEEN] = nodes[k, FIRST]
    if kind == RUN_TASKS:
        for k in range(job):
            kept[task_place[k]] = 0
        for k in range(nodes.shape[0]):
            nodes[k, CUR] = task_bounds[job, k, 0]
            nodes[k, EXACT] = task_bounds[job, k, 1]
        enforce_place(nodes, held, enforced, registers, 0, task_place[job])
        push(frames, registers, SOLVE, 0, task_target[job], 0, COLD, 0)
        return True
    t, target = queue[job], NEVER - 1
    if kind == LIST_TASKS:
        t, target = 0, task_target[0]
        registers[LINKS] = 0
    if nodes[t, LEFT] >= 0:
        left, right = nodes[t, LEFT], nodes[t, RIGHT]
        nodes[t, HEIGHT] = 1 + max(nodes[left, HEIGHT], nodes[right, HEIGHT])
        nodes[t, CUR] = max(nodes[t, CUR], nodes[left, CUR] + nodes[right, CUR])
    push(frames, registers, SOLVE, t, target, 0, COLD, 1 if kind == LIST_TASKS else 0)
    return True


@kernel
def _try_as_leaf(nodes: Integers, leaf_of: Integers, frames: Integers, registers: Integers, t: int) -> None:
    """Begin to solve node t, whose optimum is known now, once more, as a leaf."""
    registers[TRIAL] = 1
    spent = registers[WORK] - registers[BEGAN]
    points = nodes[t, HI] - nodes[t, LO]
    registers[TRIAL_END] = registers[WORK] + spent // LEAF_PAYS + 4 * (points + 16)
    registers[TRIAL_CUR] = nodes[t, CUR]
    registers[TRIAL_LEFT] = nodes[t, LEFT]
    registers[TRIAL_SIZE] = nodes[t, SIZE]
    registers[TRIAL_HEIGHT] = nodes[t, HEIGHT]
    nodes[t, CUR] = 0
    nodes[t, EXACT] = 0
    nodes[t, LEFT] = -1
    nodes[t, SIZE] = 1
    nodes[t, HEIGHT] = 0
    for p in range(nodes[t, LO], nodes[t, HI]):
        leaf_of[p] = t
    push(frames, registers, SOLVE, t, registers[TRIAL_CUR], 0, COLD, 0)


@kernel
def end_trial(nodes: Integers, leaf_of: Integers, kept: Flags, held: Flags, registers: Integers, t: int) -> None:
    """Keep node t as a leaf, if its trial came to an end in time, or make it again what it was."""
    proven = registers[DEPTH] == 0 and nodes[t, CUR] >= registers[TRIAL_CUR]
    registers[TRIAL] = 2
    nodes[t, CUR] = registers[TRIAL_CUR]
    nodes[t, EXACT] = 1
    if proven:
        return
    registers[DEPTH] = 0
    registers[TRAIL] = 0
    registers[ENFORCED] = 0
    registers[LINE] = -1
    nodes[t, LEFT] = registers[TRIAL_LEFT]
    nodes[t, SIZE] = registers[TRIAL_SIZE]
    nodes[t, HEIGHT] = registers[TRIAL_HEIGHT]
    for p in range(nodes[t, LO], nodes[t, HI]):
        kept[p] = 1
        held[p] = 0
        k = t
        while nodes[k, LEFT] >= 0:
            k = nodes[k, LEFT] if p < nodes[nodes[k, LEFT], HI] else nodes[k, RIGHT]
        leaf_of[p] = k
