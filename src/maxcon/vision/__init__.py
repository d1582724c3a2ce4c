"""Two-view geometry: fundamental matrices from matches, matches from images, and errors in pixels."""

from maxcon.vision.epipolar import enforce_rank_two, sampson_distances, symmetric_epipolar_distances
from maxcon.vision.fundamental import CHARTS, FundamentalProblem, fundamental_problem
from maxcon.vision.matching import ImageMatches, match_images, read_image
from maxcon.vision.polish import polish_fundamental
from maxcon.vision.two_view import FundamentalFit, find_fundamental

__all__ = [
    "CHARTS",
    "FundamentalFit",
    "FundamentalProblem",
    "ImageMatches",
    "enforce_rank_two",
    "find_fundamental",
    "fundamental_problem",
    "match_images",
    "polish_fundamental",
    "read_image",
    "sampson_distances",
    "symmetric_epipolar_distances",
]
