"""The partition search as a machine with an explicit stack: it may stop between any two steps and go on later.

A SOLVE frame raises the proven lower bound on the outliers of a node's points, in the present state (points removed,
points enforced), to its target, or finds the optimum:

1. a known model that keeps all enforced points and has no more outliers than the bound makes it exact;
2. disjoint infeasible bases are packed, and where d - 1 points are enforced, intervals on a line counted;
3. the node's descendants are refreshed, lower ones first, each with no more effort than the node lacks after the bounds
   of its siblings;
4. the search branches on a basis point: enforced, or removed.

A child that branches off keeps its parent's bases, less the one that held the point removed.
"""

from __future__ import annotations

import numpy as np

from maxcon.minimax.jit import kernel
from maxcon.minimax.linear import INFEASIBLE
from maxcon.search.partition_jobs import end_trial, next_job
from maxcon.search.partition_kernels import (
    CONFLICT,
    FEASIBLE,
    branching_column,
    copy_vertex,
    enforce_in_vertex,
    fewest_outliers,
    hold_column,
    inherit_bases,
    label_basis,
    pack_programme,
    solve_from,
    start_programme,
    write_outliers,
)
from maxcon.search.partition_line import find_line, line_bound, line_intervals
from maxcon.search.partition_moves import (
    enforce_place,
    finish,
    push,
    refresh,
    release_place,
    remove_place,
    restore_bounds,
    save_bounds,
)
from maxcon.search.partition_state import (
    BASE,
    BASES,
    BEGIN,
    BEST,
    CAP,
    CHAIN,
    COLD,
    COLUMN,
    COLUMNS,
    CUR,
    DEPTH,
    END,
    ENDS,
    ENFORCE,
    ENFORCED,
    EXACT,
    EXPANDED,
    FIRST,
    GAIN,
    JOB,
    KIND,
    LINE,
    LINKS,
    LOWER_IN,
    NEVER,
    NODE,
    OFFSET,
    ORIGIN,
    OWNER,
    PHASE,
    POOL,
    POOLED,
    REFRESH,
    REMOVE,
    RESIDUAL,
    RIGHT_SIDE,
    SEEN,
    SOLVE,
    STAGE,
    TARGET,
    TRAIL,
    TRIAL,
    TRIAL_END,
    UPPER,
    WHOLE,
    WORK,
    SearchState,
)
from maxcon.search.partition_tree import HEIGHT, HI, LO

# What `advance` returns: the queue is done; the budget is spent; a stack is full (`grow` it and go on).
DONE, BUSY, FULL = 0, 1, 2

# The stages of a SOLVE frame.
ENTER, BOUND, PHASES, BRANCH, INSIDE, OUTSIDE = range(6)


@kernel
def advance(s: SearchState, budget: int) -> int:
    """Work on the queue until it is done (DONE), the budget is spent (BUSY) or a stack is full (FULL)."""
    At, b, limit, rank, nodes, leaf_of = s.At, s.b, s.limit[0], s.rank, s.nodes, s.leaf_of
    kept, held, enforced, models, best_out = s.kept, s.held, s.enforced, s.models, s.best_out
    registers, frames, labels, trail, heights = s.registers, s.frames, s.labels, s.trail, s.heights
    vertex_C, vertex_x, vertex_q, lp_rows, lp, lp_place = s.C, s.x, s.q, s.lp_rows, s.lp, s.lp_place
    work, table, far, line, line_place = s.work, s.table, s.far, s.line, s.line_place
    d, N = At.shape
    T, slots = nodes.shape[0], models.shape[1]
    n_stay = slots // 3
    stop_at = registers[WORK] + budget
    while True:
        if registers[TRIAL] == 1 and (registers[DEPTH] == 0 or registers[WORK] >= registers[TRIAL_END]):
            end_trial(nodes, leaf_of, kept, held, registers, s.queue[registers[JOB]])
        if registers[DEPTH] == 0:
            if not next_job(
                nodes,
                leaf_of,
                kept,
                held,
                enforced,
                frames,
                registers,
                s.queue,
                s.task_place,
                s.task_target,
                s.task_bounds,
                s.task_proven,
                best_out,
                s.found_out,
                n_stay,
            ):
                return DONE
            continue
        if registers[WORK] >= stop_at:
            return BUSY
        f = registers[DEPTH] - 1
        if (
            f + 2 >= frames.shape[0]
            or registers[TRAIL] + 2 * T >= trail.shape[0]
            or registers[LINKS] >= s.task_bounds.shape[0]
        ):
            return FULL
        if frames[f, KIND] == REFRESH:
            refresh(frames, nodes, registers, f)
            continue

        t, origin, stage = frames[f, NODE], frames[f, ORIGIN], frames[f, STAGE]
        lo, hi, height = nodes[t, LO], nodes[t, HI], nodes[t, HEIGHT]
        n_enforced = registers[ENFORCED]
        offset = heights[height, OFFSET]

        if stage == ENTER:
            if nodes[t, EXACT] or nodes[t, CUR] >= frames[f, TARGET]:
                registers[DEPTH] = f
                continue
            upper = fewest_outliers(models, T, 1, kept, enforced, n_enforced, lo, hi, NEVER)
            seen = min(nodes[t, SEEN], slots)
            upper = fewest_outliers(models, t, seen, kept, enforced, n_enforced, lo, hi, upper)
            frames[f, UPPER] = upper
            frames[f, TARGET] = min(frames[f, TARGET], upper)
            frames[f, PHASE] = -1
            if nodes[t, CUR] >= frames[f, TARGET]:
                finish(frames, nodes, registers, f)
                continue
            stage = PHASES if origin == COLD and height > 0 else BOUND

        if stage == PHASES:
            if nodes[t, CUR] >= frames[f, TARGET]:
                finish(frames, nodes, registers, f)
                continue
            frames[f, PHASE] += 1
            if frames[f, PHASE] < height:
                frames[f, STAGE] = PHASES
                push(frames, registers, REFRESH, t, frames[f, TARGET], frames[f, PHASE], COLD, 0)
                continue
            stage = BOUND if frames[f, OWNER] < 0 else BRANCH

        if stage in (INSIDE, OUTSIDE):
            # A child has ended: undo its branch.
            at = offset + frames[f, COLUMN]
            p = lp_place[at]
            lower = nodes[t, CUR]
            exact = nodes[t, EXACT]
            lp[GAIN, at] = 1.0
            lp[CAP, at] = 0.0
            restore_bounds(frames, nodes, registers, trail, f)
            if stage == OUTSIDE:
                kept[p] = 1
                lower = min(lower + 1, NEVER)
            else:
                release_place(held, registers, p)
            if exact:
                frames[f, UPPER] = min(frames[f, UPPER], lower)
            if stage == OUTSIDE:
                nodes[t, CUR] = max(nodes[t, CUR], min(lower, frames[f, LOWER_IN]))
                finish(frames, nodes, registers, f)
                continue
            frames[f, LOWER_IN] = lower
            frames[f, TARGET] = min(frames[f, TARGET], lower)  # the outcome is the smaller of the two children's
            if nodes[t, CUR] >= frames[f, TARGET]:
                finish(frames, nodes, registers, f)
                continue
            save_bounds(frames, nodes, registers, trail, f)
            frames[f, STAGE] = OUTSIDE
            remove_place(nodes, kept, leaf_of, t, p)
            push(frames, registers, SOLVE, t, frames[f, TARGET] - 1, 0, REMOVE, 0)
            continue

        if stage == BOUND and origin == COLD:
            heights[height, ENDS] = 0
            heights[height, COLUMNS] = pack_programme(
                At, b, limit, kept, held, enforced, n_enforced, lo, hi, offset, lp_rows, lp, lp_place
            )
        m = heights[height, COLUMNS]
        own = min(m, N)  # the node's own columns are among these
        registers[WORK] += m + 16
        A = lp_rows[d * offset : d * (offset + m)].reshape((d, m))
        right_side = lp[RIGHT_SIDE, offset : offset + m]
        gain, cap = lp[GAIN, offset : offset + m], lp[CAP, offset : offset + m]
        column = frames[f - 1, COLUMN] if origin != COLD else -1

        if stage == BOUND:
            r, free_gain, free_cap = s.spare[0, :m], s.spare[1, :m], s.spare[2, :m]
            if origin != COLD:
                gain[column] = 0.0
                cap[column] = limit if origin == ENFORCE else np.inf

            if n_enforced >= d - 1 and d > 0:
                if registers[LINE] < 0:
                    registers[LINE] = find_line(At, b, enforced, n_enforced, line, line_place)
                    for h in range(heights.shape[0]):
                        heights[h, ENDS] = 0
                if registers[LINE] >= 0:
                    begin, end = lp[BEGIN, offset : offset + m], lp[END, offset : offset + m]
                    if heights[height, ENDS] == 0:
                        heights[height, ENDS] = 1
                        line_intervals(A, right_side, limit, line, begin, end, work)
                    lower = line_bound(gain, cap, begin, end, work, frames[f, TARGET], NEVER)
                    if lower <= frames[f, UPPER]:
                        nodes[t, CUR] = max(nodes[t, CUR], lower)
                    if nodes[t, CUR] >= frames[f, TARGET]:
                        finish(frames, nodes, registers, f)
                        continue

            # The basis of all enforced points, from which programmes start; removing a point leaves it as it is.
            owner = f
            if origin == REMOVE:
                owner = frames[f - 1, OWNER]
            base_C, base_x, base_q = vertex_C[owner, BASE], vertex_x[owner, BASE], vertex_q[owner, BASE]
            if origin == COLD:
                start_programme(A, right_side, gain, cap, base_C, base_x, base_q, table)
            elif origin == ENFORCE:
                k = frames[f - 1, OWNER]
                copy_vertex(vertex_C[k, BASE], vertex_x[k, BASE], vertex_q[k, BASE], base_C, base_x, base_q)
                hold_column(A, right_side, cap, base_C, base_x, base_q, table, column)
            frames[f, OWNER] = owner

            # What the bases known leave over, from its vertex in the frame below where there is one.
            bases = 0
            if origin == COLD:
                for c in range(own):
                    labels[f, c] = 0
            else:
                bases = inherit_bases(labels, f, own, frames[f - 1, BASES], column, origin == REMOVE)
            for c in range(m):
                free_gain[c] = gain[c]
                free_cap[c] = cap[c]
                if c < own and labels[f, c] > 0:
                    free_gain[c] = 0.0
                    free_cap[c] = np.inf
            C, x, q = vertex_C[f, POOL], vertex_x[f, POOL], vertex_q[f, POOL]
            warm = False
            if origin != COLD and frames[f - 1, POOLED]:
                copy_vertex(vertex_C[f - 1, POOL], vertex_x[f - 1, POOL], vertex_q[f - 1, POOL], C, x, q)
                if origin == ENFORCE:
                    warm = enforce_in_vertex(A, right_side, cap, C, x, q, table, column)
                else:
                    warm = True
                    for k in range(d + 1):
                        warm = warm and (q[k] < 0 or q[k] >> 1 != column)
            status = CONFLICT
            while status == CONFLICT and bases < frames[f, TARGET]:
                if not warm:
                    copy_vertex(base_C, base_x, base_q, C, x, q)
                warm = False
                registers[WORK] += m + 16
                status = solve_from(A, right_side, free_gain, free_cap, C, x, q, r, work, table, limit, False)
                if status == CONFLICT:
                    bases += 1
                    label_basis(C, q, free_gain, free_cap, labels[f], bases)
            frames[f, BASES] = bases
            nodes[t, CUR] = max(nodes[t, CUR], bases)
            if status == INFEASIBLE:
                if frames[f, UPPER] == NEVER:
                    nodes[t, CUR] = NEVER
                    registers[DEPTH] = f
                    continue
            elif status == FEASIBLE:
                frames[f, POOLED] = 1
                outliers = 0
                for c in range(m):
                    outliers += (gain[c] > 0.0) & (abs(r[c]) > limit)
                if outliers < frames[f, TARGET] and outliers < frames[f, UPPER]:
                    # A witness that the target is out of reach.
                    frames[f, UPPER] = outliers
                    frames[f, TARGET] = outliers
                    seen, first = nodes[t, SEEN], min(nodes[t, FIRST], n_stay)
                    slot = seen if seen < slots else first + (seen - first) % (slots - first)
                    nodes[t, SEEN] = seen + 1
                    outliers = write_outliers(At, b, x, limit, far, models[t, slot])
                    if outliers < registers[BEST]:
                        registers[BEST] = outliers
                        for p in range(N):
                            best_out[p] = models[t, slot, p]
            if nodes[t, CUR] >= frames[f, TARGET]:
                finish(frames, nodes, registers, f)
                continue
            frames[f, STAGE] = BRANCH if frames[f, PHASE] + 1 >= height else PHASES
            continue

        # The whole programme, for its basis.
        C, x, q = vertex_C[f, WHOLE], vertex_x[f, WHOLE], vertex_q[f, WHOLE]
        warm = False
        if origin == ENFORCE:
            copy_vertex(vertex_C[f - 1, WHOLE], vertex_x[f - 1, WHOLE], vertex_q[f - 1, WHOLE], C, x, q)
            warm = enforce_in_vertex(A, right_side, cap, C, x, q, table, column)
        if not warm:
            k, kind = (f, POOL) if frames[f, POOLED] else (frames[f, OWNER], BASE)
            copy_vertex(vertex_C[k, kind], vertex_x[k, kind], vertex_q[k, kind], C, x, q)
        r = lp[RESIDUAL, offset : offset + m]
        status = solve_from(A, right_side, gain, cap, C, x, q, r, work, table, limit, True)
        if status == INFEASIBLE and frames[f, UPPER] == NEVER:
            nodes[t, CUR] = NEVER
        if status == FEASIBLE:
            frames[f, UPPER] = 0
            finish(frames, nodes, registers, f)
            continue
        column, count = branching_column(C, q, gain, lp_place[offset : offset + m], rank)
        if status != CONFLICT or column < 0:  # after a failure of the arithmetic the last bound stands
            registers[DEPTH] = f
            continue
        frames[f, COLUMN] = column
        registers[EXPANDED] += 1
        p = lp_place[offset + column]
        save_bounds(frames, nodes, registers, trail, f)
        if count > 1 and not frames[f, CHAIN]:
            frames[f, STAGE] = INSIDE
            enforce_place(nodes, held, enforced, registers, t, p)
            push(frames, registers, SOLVE, t, frames[f, TARGET], 0, ENFORCE, 0)
            continue
        # Alone against the enforced points it cannot be one of them; in the chain its child is a task of its own.
        frames[f, LOWER_IN] = NEVER
        if frames[f, CHAIN]:
            link = registers[LINKS]
            registers[LINKS] = link + 1
            s.task_place[link] = p
            s.task_target[link] = frames[f, TARGET] if count > 1 else 0
            for k in range(T):
                s.task_bounds[link, k, 0] = nodes[k, CUR]
                s.task_bounds[link, k, 1] = nodes[k, EXACT]
        frames[f, STAGE] = OUTSIDE
        remove_place(nodes, kept, leaf_of, t, p)
        push(frames, registers, SOLVE, t, frames[f, TARGET] - 1, 0, REMOVE, frames[f, CHAIN])
