"""What is fitted: data, residual and threshold, validated once and then frozen; and the result type."""

from maxcon.problem.consensus import Consensus, Status
from maxcon.problem.explanation import Explanation
from maxcon.problem.frozen import ReadOnlyArrays
from maxcon.problem.linear import LinearProblem, hyperplane, line, plane
from maxcon.problem.protocol import Problem
from maxcon.problem.tolerance import inlier_slack
from maxcon.problem.validate import check_indices, check_model, check_threshold

__all__ = [
    "Consensus",
    "Explanation",
    "LinearProblem",
    "Problem",
    "ReadOnlyArrays",
    "Status",
    "check_indices",
    "check_model",
    "check_threshold",
    "hyperplane",
    "inlier_slack",
    "line",
    "plane",
]
