"""Whether columns that whitening took for dependent are so to the letter of the data, in rational arithmetic."""

from __future__ import annotations

from fractions import Fraction
from weakref import WeakKeyDictionary

import numpy as np
import scipy.linalg

from maxcon.minimax.rational import reduced
from maxcon.minimax.rows import linear_rows
from maxcon.problem import LinearProblem

_known: WeakKeyDictionary[LinearProblem, bool] = WeakKeyDictionary()


def rank_holds(problem: LinearProblem) -> bool:
    """Return whether A has exactly the rank of the whitened rows; then what is proven of these holds for the data.

    A bound proven on rows that lack a direction is no bound for models that use it.
    """
    rank = linear_rows(problem).At.shape[0]
    if rank == problem.n_params:
        return True
    holds = _known.get(problem)
    if holds is None:
        holds = _known[problem] = _dependences_hold(problem, rank)
    return holds


def _dependences_hold(problem: LinearProblem, rank: int) -> bool:
    """Solve for the dependences of the columns on `rank` of the rows; they must hold on all others."""
    A = problem.A
    d = problem.n_params
    chosen: list[int] = []
    if rank:
        chosen = scipy.linalg.qr(linear_rows(problem).At, mode="r", pivoting=True)[1][:rank].tolist()
    solved = reduced(A[chosen].tolist())
    if len(solved) < rank:
        return False
    leads = {lead for lead, _ in solved}
    columns = [[Fraction(value) for value in column] for column in np.unique(A, axis=0).T.tolist()]
    for free in range(d):
        if free in leads:
            continue
        parts = [(row[free], columns[lead]) for lead, row in solved if row[free]]
        for k, value in enumerate(columns[free]):
            if value != sum((weight * column[k] for weight, column in parts), Fraction(0)):
                return False
    return True
