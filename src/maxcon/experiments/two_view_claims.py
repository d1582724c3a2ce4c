"""The claims of section 4.2 (fundamental matrices on ModelNet40 and KITTI), answered from records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maxcon.experiments.claims import (
    FAILS,
    HOLDS,
    NOT_RUN,
    SLOWER,
    Answer,
    Claim,
    better_than,
    compare,
    for_each_of_ours,
    median_ratio,
    median_seconds,
    of,
    paired,
    rival,
)
from maxcon.experiments.contenders import (
    AUTO,
    AUTO_LONG,
    AUTO_UCLM,
    DIBP,
    LO,
    LO_SWAP,
    RANSAC,
    UCLM,
    UCLM_SWAP,
)
from maxcon.experiments.records import EXACT, Run
from maxcon.experiments.synthetic_claims import growth

#: "Impractical" is refuted if so large a share of the optima is proven.
_PROVEN = 0.95


def modelnet_claims(records: Sequence[Run]) -> list[Claim]:
    """Return the claims on ModelNet40."""
    return [
        _ground_truth("ModelNet40 1", records),
        Claim(
            "ModelNet40 2",
            "The run time of A*-NAPA-DIBP increases exponentially with higher outlier rates.",
            "The median time grows by 1.5 times or more for every 10 points, up to the time limit.",
            tuple(growth(records, name) for name in (DIBP, EXACT)),
        ),
        Claim(
            "ModelNet40 3",
            "On average, with less time budget, we generally obtain higher consensus than RANSAC-based methods.",
            "More inliers in the mean, and fewer at no rate. LO-RANSAC with our refinement is the stronger baseline.",
            for_each_of_ours(
                records, lambda name: Answer(name, *better_than(records, name, (RANSAC, LO), (LO_SWAP,), 0.01))
            ),
        ),
        _against_uclm("ModelNet40 4", "UCLM is comparatively inexpensive; our consensus is higher.", records),
    ]


def kitti_claims(records: Sequence[Run]) -> list[Claim]:
    """Return the claims on KITTI."""
    return [
        _ground_truth("KITTI 1", records),
        _against_uclm("KITTI 2", "Our method generally achieves higher consensus than UCLM.", records),
        Claim(
            "KITTI 3",
            "Compared to RANSAC: smaller variance and higher median consensus.",
            "At every step the median is higher, and the variance of the inliers missing is smaller (that of the "
            "consensus itself is mostly the pairs').",
            for_each_of_ours(records, lambda name: _spread(records, name)),
        ),
        Claim(
            "KITTI 4",
            "Our spread is larger than RANSAC's, but only occasionally is the worst extreme case returned.",
            "On at most 10% of the pairs more inliers are missing than RANSAC ever misses.",
            for_each_of_ours(records, lambda name: _extremes(records, name)),
        ),
        Claim(
            "KITTI 5",
            "Our method achieves inlier sets of higher quality than RANSAC and UCLM (shown on one pair).",
            "Over all pairs: more inliers that the true F confirms (within 2 pixels), without a larger share that it "
            "refutes.",
            for_each_of_ours(records, lambda name: _quality(records, name)),
        ),
    ]


def targets(records: Sequence[Run]) -> list[str]:
    """Return lines that tell, for "auto" at equal time, on how many instances it has fewer inliers than each rival."""
    lines = []
    for own, baselines in (
        (AUTO, tuple(rival(each, AUTO) for each in (RANSAC, LO, LO_SWAP))),
        (AUTO_LONG, (RANSAC, LO, LO_SWAP)),
        (AUTO_UCLM, (UCLM, UCLM_SWAP)),
    ):
        for baseline in baselines:
            found = compare(records, own, baseline)
            if found is not None:
                lines.append(f"{own} beside {baseline}: {found}")
    return lines


def _ground_truth(label: str, records: Sequence[Run]) -> Claim:
    rows = of(records, EXACT)
    units = {each.unit: each for each in rows}
    share = float(np.mean([each.proven for each in units.values()])) if units else float("nan")
    astar = of(records, DIBP)
    by_astar = float(np.mean([each.status == "optimal" for each in astar])) if astar else float("nan")
    longest = max((each.seconds for each in rows), default=float("nan"))
    numbers = (
        f"{share:.1%} of {len(units)} optima proven, median {median_seconds(rows):.3g} s, longest {longest:.3g} s; "
        f"A*-NAPA-DIBP proves {by_astar:.0%} of the {len(astar)} instances that it was given"
    )
    verdict = NOT_RUN if not units else FAILS if share >= _PROVEN else HOLDS
    return Claim(
        label,
        "It is impractical to apply globally optimal methods; they take too long to arrive at an optimum.",
        f"The optimum is proven for less than {_PROVEN:.0%} of the instances within the time limit.",
        (Answer(EXACT, verdict, numbers),),
    )


def _against_uclm(label: str, quote: str, records: Sequence[Run]) -> Claim:
    def judge(name: str) -> Answer:
        told, ahead = [], []
        for baseline in (UCLM, UCLM_SWAP):
            found = compare(records, name, baseline)
            if found is not None:
                told.append(f"{baseline}: {found}")
                ahead.append(found.ahead > 0 and found.worst >= 0)
        if not ahead:
            return Answer(name, NOT_RUN, "UCLM is not installed")
        verdict = FAILS if not ahead[0] else HOLDS if all(ahead) else SLOWER
        return Answer(name, verdict, "; ".join(told))

    rule = "More inliers in the mean, and fewer at no rate or step. UCLM with our refinement is the stronger baseline."
    return Claim(label, quote, rule, for_each_of_ours(records, judge))


def _steps(records: Sequence[Run]) -> list[int]:
    return sorted({each.step for each in records if each.step is not None})


def _spread(records: Sequence[Run], name: str) -> Answer:
    told, fine = [], []
    for step in _steps(records):
        both = [pair for pair in paired(records, name, rival(RANSAC, name)) if pair[0].step == step]
        if not both:
            continue
        ours, theirs = (np.array([pair[k].consensus for pair in both], dtype=np.float64) for k in (0, 1))
        fine.append(np.median(ours) > np.median(theirs) and _deviation(both, 0) < _deviation(both, 1))
        told.append(
            f"step {step}: median {np.median(ours):g} against {np.median(theirs):g}, standard deviation of the "
            f"inliers missing {_deviation(both, 0):.2f} against {_deviation(both, 1):.2f}, of the consensus "
            f"{ours.std():.1f} against {theirs.std():.1f}, at {median_ratio(both):.2f} times the time"
        )
    if not fine:
        return Answer(name, NOT_RUN, "RANSAC has no result")
    return Answer(name, HOLDS if all(fine) else FAILS, "; ".join(told))


def _deviation(both: Sequence[tuple[Run, Run]], k: int) -> float:
    return float(np.std([pair[k].short for pair in both]))


def _extremes(records: Sequence[Run], name: str) -> Answer:
    both = paired(records, name, rival(RANSAC, name))
    if not both:
        return Answer(name, NOT_RUN, "RANSAC has no result")
    ours, theirs = ([pair[k].short for pair in both] for k in (0, 1))
    share = float(np.mean([each > max(theirs) for each in ours]))
    numbers = (
        f"at most {max(ours)} inliers missing against {max(theirs)}; beyond RANSAC's worst on {share:.0%} of "
        f"{len(both)} pairs"
    )
    return Answer(name, HOLDS if share <= 0.1 else FAILS, numbers)


def _quality(records: Sequence[Run], name: str) -> Answer:
    told, fine = [], []
    for baseline in (rival(RANSAC, name), UCLM):
        both = [pair for pair in paired(records, name, baseline) if all("confirmed" in each.measures for each in pair)]
        if not both:
            continue
        confirmed = [np.mean([pair[k].measures["confirmed"] for pair in both]) for k in (0, 1)]
        refuted = [
            np.sum([pair[k].measures["marked"] - pair[k].measures["confirmed"] for pair in both])
            / np.sum([pair[k].measures["marked"] for pair in both])
            for k in (0, 1)
        ]
        fine.append(confirmed[0] > confirmed[1] and refuted[0] <= refuted[1])
        told.append(
            f"{baseline}: {confirmed[0]:.1f} confirmed inliers a pair against {confirmed[1]:.1f}, "
            f"{refuted[0]:.2%} refuted against {refuted[1]:.2%}"
        )
    if not fine:
        return Answer(name, NOT_RUN, "no true F, or no rival")
    return Answer(name, HOLDS if all(fine) else FAILS, "; ".join(told))
