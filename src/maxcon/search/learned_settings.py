"""The settings of a round of the learned search."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from maxcon.problem.validate import check_number
from maxcon.search.belief_proposals import KEPT


class Settings(NamedTuple):
    """The settings of a round.

    Attributes
    ----------
    samples
        How many minimal samples are drawn.
    refined
        How many of them are refined, at most `KEPT`.
    local
        The refinement starts where residuals of this many limits still count.
    power, floor
        A point with belief p is drawn with a weight of p^power + floor.
    soften
        After s rounds without progress the power is divided by 1 + soften s: what the belief favours has been
        tried by then.
    reach
        A walk starts from the points within so many limits of its proposal.
    patience
        Rounds without progress after which the votes are forgotten.
    agreed
        The mean belief in the incumbent's points from which on it is swapped, one round later.
    explore
        How often a walk removes a random basis point; for training.
    variations
        How many variations of the incumbent are walked from where the mean belief in its points is above `agreed`.
    least, most
        One kind of variation is the least-squares model of a random number of the incumbent's points: between these,
        in times of r.
    forced, span, loose, pull
        The other kind, `forced` of all: a robust refit in which a random point outside, within `span` limits, has
        the weight of `pull` times all of the incumbent's points, and from there, without it, a descent that starts
        where residuals of `loose` limits still count.
    lost
        In this one of every `patience` rounds without progress, where the belief does not agree with the incumbent, the
        samples are drawn without regard to it, and refined from where half the points still count.
    tries
        A walk's set that lacks more than one point to pass the incumbent is given up after so many points in a row
        that could not be added to it.
    """

    samples: int = 100
    refined: int = 4
    local: float = 4.0
    power: float = 3.0
    soften: float = 0.3
    floor: float = 0.003
    reach: float = 1.2
    patience: int = 5
    agreed: float = 0.85
    explore: float = 0.0
    variations: int = 8
    least: int = 2
    most: int = 8
    forced: float = 0.5
    span: float = 30.0
    loose: float = 2.0
    pull: float = 1.0
    lost: int = 2
    tries: int = 4


#: The least and the largest value of each setting.
_RANGES = {
    "samples": (1, 2**31 - 1),
    "refined": (1, KEPT),
    "local": (1.0, 1e3),
    "power": (0.0, 100.0),
    "soften": (0.0, 1e3),
    "floor": (1e-12, 1.0),
    "reach": (1.0, 1e6),
    "patience": (1, 2**31 - 1),
    "agreed": (0.0, 2.0),
    "explore": (0.0, 1.0),
    "variations": (0, 10**6),
    "least": (1, 1000),
    "most": (1, 1000),
    "forced": (0.0, 1.0),
    "span": (1.0, 1e6),
    "loose": (1.0, 1e6),
    "pull": (0.0, 1e6),
    "lost": (0, 100),
    "tries": (1, 2**31 - 1),
}


def check_settings(settings: Settings) -> Settings:
    """Return the settings with plain numbers.

    Raises
    ------
    TypeError
        If they are no `Settings`, or one is not a number of its kind.
    ValueError
        If one is out of its range.
    """
    if not isinstance(settings, Settings):
        raise TypeError(f"settings must be Settings, but it is a {type(settings).__name__}")
    checked: dict[str, Any] = {}
    for name, value in settings._asdict().items():
        whole = isinstance(getattr(Settings(), name), int)
        low, high = _RANGES[name]
        if whole and (isinstance(value, bool) or not isinstance(value, (int, np.integer))):
            raise TypeError(f"settings.{name} must be an integer, but it is {value!r}")
        number = int(value) if whole else check_number(value, f"settings.{name}")
        if not low <= number <= high:
            raise ValueError(f"settings.{name} must be between {low} and {high}, but it is {value}")
        checked[name] = number
    return Settings(**checked)
