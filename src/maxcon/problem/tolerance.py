"""The one slack for rounding by which "residual <= threshold" is judged, everywhere in the package."""

from __future__ import annotations

#: Relative part. A residual at exactly the threshold (quantised data make many of these) is a closed
#: inlier, and the arithmetic that got it there is good to a few units in 1e-13; 1e-9 leaves four digits of room.
RELATIVE_SLACK = 1e-9

#: Absolute part, as a fraction of max|b|. A residual is a difference of numbers as large as b,
#: so it carries an error of some 1e-16 x max|b| however small the threshold is.
ABSOLUTE_SLACK = 1e-12


def inlier_slack(threshold: float, b_max: float) -> float:
    """Return how far above the threshold a residual may be and still count as an inlier.

    Parameters
    ----------
    threshold
        The inlier threshold, in the unit of the residual.
    b_max
        ``max|b|`` of the data, in the same unit.
    """
    return RELATIVE_SLACK * threshold + ABSOLUTE_SLACK * b_max
