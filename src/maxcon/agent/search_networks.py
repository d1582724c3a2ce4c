"""The pair of networks of the learned search, from a file or from the wheel."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from maxcon.agent.peel_features import N_PEEL_FEATURES
from maxcon.agent.perceptron import Perceptron, load_perceptrons, save_perceptrons
from maxcon.agent.point_features import N_POINT_FEATURES

#: Inputs, hidden widths and output of the two networks as trained by this package.
POINT_WIDTHS = (N_POINT_FEATURES, 24, 24, 1)
PEEL_WIDTHS = (N_PEEL_FEATURES, 16, 16, 1)

_SHIPPED = Path(str(resources.files("maxcon.agent"))) / "shipped_search" / "search.safetensors"


class SearchNetworks(NamedTuple):
    """The point network, which says how likely a point is an inlier, and the peel network, which says what to remove.

    Attributes
    ----------
    points
        Logit that a point is in the best set, from the features of `maxcon.agent.point_features`.
    peel
        Logit that a basis point is not, from those of `maxcon.agent.peel_features`.
    """

    points: Perceptron
    peel: Perceptron


def save_search_networks(networks: SearchNetworks, path: Path, notes: Mapping[str, str] | None = None) -> None:
    """Write the pair into a safetensors file, replacing it atomically; `notes` go into its header."""
    save_perceptrons({"points": networks.points, "peel": networks.peel}, path, notes)


def load_search_networks(path: Path) -> SearchNetworks:
    """Return the pair in a file.

    Raises
    ------
    ValueError
        If there is no such file, or it does not hold the two networks with their numbers of inputs.
    """
    nets = load_perceptrons(path, {"points": N_POINT_FEATURES, "peel": N_PEEL_FEATURES})
    return SearchNetworks(nets["points"], nets["peel"])


@cache
def shipped_search_networks() -> SearchNetworks:
    """Return the pair in the wheel."""
    return load_search_networks(_SHIPPED)
