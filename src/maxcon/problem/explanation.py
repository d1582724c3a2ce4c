"""Why a point is no inlier: the answer of `Consensus.explain`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxcon.problem.frozen import ReadOnlyArrays


@dataclass(frozen=True, eq=False)
class Explanation(ReadOnlyArrays):
    """Why a point is no inlier.

    Attributes
    ----------
    point
        Its index.
    basis
        Indices, ascending: the point and at most d inliers that no model explains together within the
        threshold. Empty if the inliers and the point can be explained together (then the consensus was not
        the largest).
    consensus_with_point
        The most inliers that were found for a model that explains the point; 0 if none does.
    lost
        How many inliers forcing it in costs: those of the consensus minus these.
    proven
        Whether no model that explains the point has more inliers than that.
    """

    point: int
    basis: NDArray[np.int64]
    consensus_with_point: int
    lost: int
    proven: bool
