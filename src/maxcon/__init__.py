"""Robust geometric model fitting: the largest consensus set, with a proof or a bound.

Everything is imported when first used, so that ``import maxcon`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maxcon.certifying import certify as certify
    from maxcon.certifying import write_certificate as write_certificate
    from maxcon.fitting import fit as fit
    from maxcon.fitting import methods as methods
    from maxcon.minimax import MinimaxFit as MinimaxFit
    from maxcon.minimax import minimax_fit as minimax_fit
    from maxcon.problem import Consensus as Consensus
    from maxcon.problem import Explanation as Explanation
    from maxcon.problem import LinearProblem as LinearProblem
    from maxcon.problem import hyperplane as hyperplane
    from maxcon.problem import line as line
    from maxcon.problem import plane as plane

__version__ = "0.1.0"

_HOME = {
    "Consensus": "maxcon.problem",
    "Explanation": "maxcon.problem",
    "LinearProblem": "maxcon.problem",
    "MinimaxFit": "maxcon.minimax",
    "certify": "maxcon.certifying",
    "fit": "maxcon.fitting",
    "hyperplane": "maxcon.problem",
    "line": "maxcon.problem",
    "methods": "maxcon.fitting",
    "minimax_fit": "maxcon.minimax",
    "plane": "maxcon.problem",
    "write_certificate": "maxcon.certifying",
}

__all__ = ["__version__", *sorted(_HOME)]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'maxcon' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
