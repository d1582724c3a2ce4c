"""The small moves of the partition search: frames on the stack, bounds of nodes, points enforced and removed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.partition_state import (
    CHAIN,
    COLD,
    CUR,
    DEPTH,
    ENFORCED,
    EXACT,
    KIND,
    LINE,
    MARK,
    NEVER,
    NODE,
    ORIGIN,
    OWNER,
    PHASE,
    REFRESH,
    SOLVE,
    STAGE,
    TARGET,
    TRAIL,
    UPPER,
)
from maxcon.search.partition_tree import HEIGHT, LEFT, PARENT, RIGHT, SIZE

Integers = NDArray[np.int64]


@kernel
def push(
    frames: Integers, registers: Integers, kind: int, t: int, target: int, phase: int, origin: int, chain: int
) -> None:
    """Put a frame on the stack."""
    f = registers[DEPTH]
    registers[DEPTH] = f + 1
    for k in range(frames.shape[1]):
        frames[f, k] = 0
    frames[f, KIND] = kind
    frames[f, NODE] = t
    frames[f, TARGET] = target
    frames[f, UPPER] = NEVER
    frames[f, PHASE] = phase
    frames[f, ORIGIN] = origin
    frames[f, CHAIN] = chain
    frames[f, OWNER] = -1


@kernel
def refresh(frames: Integers, nodes: Integers, registers: Integers, f: int) -> None:
    """Take one step of a REFRESH frame: solve the descendants of one height, left to right.

    Each owes what the target lacks after the bounds of its siblings.
    """
    t, target, phase = frames[f, NODE], frames[f, TARGET], frames[f, PHASE]
    stage = frames[f, STAGE]
    while stage < 2:
        lower = nodes[nodes[t, LEFT], CUR] + nodes[nodes[t, RIGHT], CUR]
        nodes[t, CUR] = max(nodes[t, CUR], lower)
        if nodes[t, CUR] >= target or nodes[t, EXACT]:
            break
        child = nodes[t, LEFT] if stage == 0 else nodes[t, RIGHT]
        owed = target - lower + nodes[child, CUR]
        stage += 1
        if not nodes[child, EXACT]:
            frames[f, STAGE] = stage
            kind = SOLVE if nodes[child, HEIGHT] <= phase else REFRESH
            push(frames, registers, kind, child, owed, phase, COLD, 0)
            return
    nodes[t, CUR] = max(nodes[t, CUR], nodes[nodes[t, LEFT], CUR] + nodes[nodes[t, RIGHT], CUR])
    registers[DEPTH] = f


@kernel
def finish(frames: Integers, nodes: Integers, registers: Integers, f: int) -> None:
    """Take a SOLVE frame off the stack; a bound that meets a model is the optimum."""
    t = frames[f, NODE]
    if nodes[t, CUR] >= frames[f, UPPER]:
        nodes[t, CUR] = frames[f, UPPER]
        nodes[t, EXACT] = 1
    registers[DEPTH] = f


@kernel
def save_bounds(frames: Integers, nodes: Integers, registers: Integers, trail: Integers, f: int) -> None:
    """Put the bounds of the node and its descendants on the trail."""
    t = frames[f, NODE]
    top = registers[TRAIL]
    frames[f, MARK] = top
    for k in range(t, t + nodes[t, SIZE]):
        trail[top] = nodes[k, CUR]
        trail[top + 1] = nodes[k, EXACT]
        top += 2
    registers[TRAIL] = top


@kernel
def restore_bounds(frames: Integers, nodes: Integers, registers: Integers, trail: Integers, f: int) -> None:
    """Take the bounds back from the trail."""
    t = frames[f, NODE]
    top = frames[f, MARK]
    registers[TRAIL] = top
    for k in range(t, t + nodes[t, SIZE]):
        nodes[k, CUR] = trail[top]
        nodes[k, EXACT] = trail[top + 1]
        top += 2


@kernel
def enforce_place(
    nodes: Integers, held: NDArray[np.uint8], enforced: Integers, registers: Integers, t: int, p: int
) -> None:
    """Enforce place p, seen from node t: bounds stay, but an optimum may grow."""
    held[p] = 1
    enforced[registers[ENFORCED]] = p
    registers[ENFORCED] += 1
    for k in range(t, t + nodes[t, SIZE]):
        nodes[k, EXACT] = 0


@kernel
def release_place(held: NDArray[np.uint8], registers: Integers, p: int) -> None:
    """Undo the last enforcement, that of place p."""
    held[p] = 0
    registers[ENFORCED] -= 1
    if registers[ENFORCED] < registers[LINE]:
        registers[LINE] = -1


@kernel
def remove_place(nodes: Integers, kept: NDArray[np.uint8], leaf_of: Integers, t: int, p: int) -> None:
    """Remove place p: the bounds of its leaf and of the nodes above it, up to t, fall by one."""
    kept[p] = 0
    k = leaf_of[p]
    while True:
        nodes[k, CUR] = max(nodes[k, CUR] - 1, 0)
        nodes[k, EXACT] = 0
        if k == t:
            break
        k = nodes[k, PARENT]


@kernel
def sum_up(nodes: Integers, column: int) -> None:
    """Raise the bound of every inner node, in `column`, to the sum of its children's."""
    for k in range(nodes.shape[0]):
        t = nodes.shape[0] - 1 - k
        if nodes[t, LEFT] >= 0:
            lower = nodes[nodes[t, LEFT], column] + nodes[nodes[t, RIGHT], column]
            nodes[t, column] = max(nodes[t, column], lower)
