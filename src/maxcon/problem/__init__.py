"""What is fitted: data, residual and threshold, validated once and then frozen; and the result type."""

from maxcon.problem.consensus import Consensus, Status
from maxcon.problem.explanation import Explanation
from maxcon.problem.frozen import freeze_arrays
from maxcon.problem.linear import LinearProblem, hyperplane, line, plane
from maxcon.problem.protocol import Problem
from maxcon.problem.tolerance import inlier_slack
from maxcon.problem.validate import check_indices, check_model, check_threshold

__all__ = [
    "Consensus",
    "Explanation",
    "LinearProblem",
    "Problem",
    "Status",
    "check_indices",
    "check_model",
    "check_threshold",
    "freeze_arrays",
    "hyperplane",
    "inlier_slack",
    "line",
    "plane",
]
