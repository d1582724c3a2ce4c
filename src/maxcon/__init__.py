"""Robust geometric model fitting: the largest consensus set, with a proof or a bound.

Everything is imported when first used, so that ``import maxcon`` costs next to nothing.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from maxcon import agent as agent
    from maxcon import certification as certification
    from maxcon import datasets as datasets
    from maxcon import experiments as experiments
    from maxcon import minimax as minimax
    from maxcon import problem as problem
    from maxcon import search as search
    from maxcon import tree as tree
    from maxcon import vision as vision
    from maxcon.certifying import certify as certify
    from maxcon.certifying import write_certificate as write_certificate
    from maxcon.compiling import compile_kernels as compile_kernels
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
    from maxcon.search.alternatives import AlternativeOptima as AlternativeOptima
    from maxcon.search.alternatives import alternative_optima as alternative_optima
    from maxcon.search.threshold_curve import ConsensusCurve as ConsensusCurve
    from maxcon.search.threshold_curve import consensus_curve as consensus_curve
    from maxcon.vision import find_fundamental as find_fundamental

__version__ = "0.1.0"

_HOME = {
    "AlternativeOptima": "maxcon.search.alternatives",
    "Consensus": "maxcon.problem",
    "ConsensusCurve": "maxcon.search.threshold_curve",
    "Explanation": "maxcon.problem",
    "LinearProblem": "maxcon.problem",
    "MinimaxFit": "maxcon.minimax",
    "alternative_optima": "maxcon.search.alternatives",
    "certify": "maxcon.certifying",
    "compile_kernels": "maxcon.compiling",
    "consensus_curve": "maxcon.search.threshold_curve",
    "find_fundamental": "maxcon.vision",
    "fit": "maxcon.fitting",
    "hyperplane": "maxcon.problem",
    "line": "maxcon.problem",
    "methods": "maxcon.fitting",
    "minimax_fit": "maxcon.minimax",
    "plane": "maxcon.problem",
    "write_certificate": "maxcon.certifying",
}

#: The subpackages that are reached as attributes, without an import of their own.
_PACKAGES = ("agent", "certification", "datasets", "experiments", "minimax", "problem", "search", "tree", "vision")

__all__ = ["__version__", *sorted(_HOME)]  # noqa: PLE0604


def __getattr__(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"maxcon.{name}")
    if name not in _HOME:
        raise AttributeError(f"module 'maxcon' has no attribute {name!r}")
    value = getattr(import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*__all__, *_PACKAGES})
