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
        How many variations of the incumbent are walked from where the mean belief in its points is above `agreed`; of
        more than 400 points twice, as walks are a smaller part of a round there.
    least, most, foreign, spread
        A variation is the least-squares model of some points of the incumbent, between `least` and `most` times r of
        them, and of at most `foreign` points outside, within `spread` limits of the incumbent.
    loose
        It is refined from where residuals of `loose` limits still count.
    straight
        So many of the variations, and all in a round without a stall, are not refined, but made from twice as many
        points of the incumbent and from points outside that are twice as near.
    lost, strays
        In one of every `lost` rounds without progress, where the belief does not agree with the incumbent, `strays`
        samples are drawn without regard to it, and `KEPT` of them refined, from where half the points still count.
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
    least: int = 1
    most: int = 2
    foreign: int = 4
    spread: float = 10.0
    straight: float = 0.5
    loose: float = 2.0
    lost: int = 2
    strays: int = 32
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
    "foreign": (0, 1000),
    "spread": (1.0, 1e6),
    "straight": (0.0, 1.0),
    "loose": (1.0, 1e6),
    "lost": (1, 2**31 - 1),
    "strays": (1, 2**31 - 1),
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
