"""A walk's points side by side, and the refinement of its end among them: of many points few matter to a local search.

Around a model, the points far outside its threshold will not be added, and those deep inside are not what stands
against another one. A window holds the rest: copies of their rows, the set among them, its vertex. What is found there
is a model like any other; how many of all points it explains is counted before it is believed.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from maxcon.minimax.jit import kernel
from maxcon.search.refine_kernels import RefineScratch
from maxcon.search.vertex_kernels import VertexCopies

#: A window holds the points with residuals between so many limits. With a larger core, points of it are lost at the end
#: of a walk; a window that looks farther out only takes longer.
CORE, OUTER = 0.15, 2.5

#: A walk that ends with so many points fewer than it would take is swapped in its window, too.
NEAR_MISS = 1

#: A swap in a window gives up on the point that it has dropped after so many others in a row that do not fit.
SWAP_TRIES = 3


@kernel
def choose_window(r: NDArray[np.float64], core: float, outer: float, points: NDArray[np.int64]) -> tuple[int, int]:
    """Write the points with residuals from `core` to `outer` into `points`; return how many, and how many are below."""
    m = below = 0
    for i in range(r.shape[0]):
        size = abs(r[i])
        points[m] = i
        m += (size >= core) & (size <= outer)
        below += size < core
    return m, below


@kernel
def window_scratch(m: int, scratch: RefineScratch) -> RefineScratch:
    """Return scratch space for m points out of that for all; it keeps nothing for the latter."""
    copies = scratch.copies
    r = copies.r.reshape(copies.r.size)[: copies.r.shape[0] * m].reshape(copies.r.shape[0], m)
    return RefineScratch(
        VertexCopies(copies.C, copies.x, copies.q, r),
        scratch.tried[:m],
        scratch.fresh[:m],
        scratch.waiting[:m],
        scratch.bound[:m],
        scratch.leave[:m],
        scratch.certificate[:m],
        scratch.before[:m],
        scratch.basis,
        scratch.kept[:m],
        scratch.dropped[:m],
        scratch.blame[:m],
        scratch.near,
    )
