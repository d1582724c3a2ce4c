"""Verdicts from records made by hand."""

from dataclasses import replace

import pytest

from maxcon.experiments.claims import (
    FAILS,
    HOLDS,
    NOT_RUN,
    SLOWER,
    better_than,
    by_rate,
    compare,
    mean_short,
    rival,
)
from maxcon.experiments.contenders import AGENT, ASTAR, AUTO, DIBP, LO, LO_SWAP, PAPER, RANSAC, RB, RB_TREE, UCLM
from maxcon.experiments.records import EXACT, Run
from maxcon.experiments.synthetic_claims import growth, line_claims, plane_claims, trajectory_claims
from maxcon.experiments.two_view_claims import kitti_claims, modelnet_claims, targets


def row(name, number, consensus, *, rate=20, best=80, seconds=0.1, n_points=100, step=None, **changes):
    base = Run(
        experiment="line",
        unit=f"{n_points} {rate} {step} {number}",
        rows=1,
        instance="",
        n_points=n_points,
        rate=rate,
        step=step,
        name=name,
        method="m",
        settings={"budget": None, "time_limit": None},
        consensus=consensus,
        before_refinement=None,
        upper_bound=best,
        proven=True,
        best=best,
        gap=best - consensus,
        status="heuristic",
        seconds=seconds,
    )
    return replace(base, **changes)


def answers(claims, label):
    (claim,) = (each for each in claims if each.label == label)
    return {answer.name: answer for answer in claim.answers}


def test_compare_by_hand():
    rows = [
        row("a", 0, 80, seconds=0.1),
        row("a", 1, 78, seconds=0.1),
        row("a", 2, 80, rate=40, seconds=0.1),
        row("b", 0, 79, seconds=0.2),
        row("b", 1, 80, seconds=0.4),
        row("b", 2, 77, rate=40, seconds=0.3),
        row("b", 3, 0, rate=40),  # "a" did not run there
        row("c", 0, 0, error="failed: x"),
    ]
    found = compare(rows, "a", "b")
    assert (found.pairs, found.wins, found.losses) == (3, 2, 1)
    assert found.ahead == pytest.approx((1 - 2 + 3) / 3)
    assert (found.worst, found.best) == (-0.5, 3.0)
    assert found.multiple == pytest.approx(3.0)
    assert compare(rows, "a", "c") is None
    assert by_rate(rows, "a", mean_short) == "20%: 1.00, 40%: 0.00"


def test_rivals_at_equal_time():
    assert rival(RANSAC, AGENT) == RANSAC
    assert rival(RANSAC, PAPER) == "RANSAC, paper's agent's time"
    assert rival(RANSAC, AUTO) == "RANSAC, auto's time"


@pytest.mark.parametrize(
    ("ours", "ransac", "lo", "swap", "verdict"),
    [
        (80, 70, 75, 79, HOLDS),
        (80, 70, 75, 80, SLOWER),
        (80, 70, 80, 79, FAILS),
        (80, 81, 75, 79, FAILS),
    ],
)
def test_better_than(ours, ransac, lo, swap, verdict):
    rows = [row(AGENT, 0, ours), row(RANSAC, 0, ransac), row(LO, 0, lo), row(LO_SWAP, 0, swap)]
    assert better_than(rows, AGENT, (RANSAC, LO), (LO_SWAP,), 0.5)[0] == verdict
    assert better_than(rows[:1], AGENT, (RANSAC, LO), (LO_SWAP,), 0.5)[0] == NOT_RUN


def test_better_in_the_mean_but_worse_somewhere():
    rows = [row(AGENT, 0, 80), row(RANSAC, 0, 70), row(AGENT, 1, 79, rate=40), row(RANSAC, 1, 80, rate=40)]
    assert better_than(rows, AGENT, (RANSAC,), (), 0.5)[0] == FAILS


def test_almost_optimal_everywhere_or_not():
    rows = [row(AGENT, i, 80) for i in range(9)] + [row(AGENT, 9, 79)] + [row(AUTO, 0, 80)]
    claims = line_claims(rows)
    assert answers(claims, "line 1")[AGENT].verdict == HOLDS
    assert answers(claims, "line 1")[AUTO].verdict == HOLDS
    assert answers(claims, "line 1")[PAPER].verdict == NOT_RUN
    bad = rows + [row(AGENT, i, 80 - 2 * (i > 7), rate=60) for i in range(10)]
    found = answers(line_claims(bad), "line 1")[AGENT]
    assert found.verdict == FAILS
    assert found.numbers.endswith("not at 60%")


@pytest.mark.parametrize(("astar", "exact", "verdict"), [(2.0, 0.2, HOLDS), (2.0, 0.01, SLOWER), (0.9, 0.01, FAILS)])
def test_an_order_of_magnitude(astar, exact, verdict):
    rows = [
        row(AGENT, 0, 80, seconds=0.1),
        row(ASTAR, 0, 80, seconds=astar),
        row(EXACT, 0, 80, seconds=exact),
    ]
    assert answers(line_claims(rows), "line 3")[AGENT].verdict == verdict


def test_growth_by_hand():
    rows = [row(DIBP, 0, 80, rate=10 * k, seconds=0.001 * 2.0**k, status="optimal") for k in range(1, 6)]
    assert growth(rows, DIBP).verdict == HOLDS
    assert growth(rows, DIBP).numbers.startswith("times 2.00 every 10 points")
    flat = [replace(each, seconds=0.001) for each in rows]
    assert growth(flat, DIBP).verdict == FAILS
    assert growth(rows[:1], DIBP).verdict == NOT_RUN
    # What is stopped has the time of the limit: it must not flatten the growth.
    limit = {"budget": None, "time_limit": 0.02}
    stopped = [row(DIBP, 0, 80, rate=10 * k, seconds=0.02, settings=limit) for k in range(6, 9)]
    assert growth(rows + stopped, DIBP).verdict == HOLDS
    assert "60%: 20 ms (1 stopped)" in growth(rows + stopped, DIBP).numbers


@pytest.mark.parametrize(("plain", "tree", "verdict"), [(70, 79, HOLDS), (70, 80, SLOWER), (80, 80, FAILS)])
def test_learning_something(plain, tree, verdict):
    rows = [row(AGENT, 0, 80), row(RB, 0, plain), row(RB_TREE, 0, tree)]
    assert answers(plane_claims(rows), "plane 1")[AGENT].verdict == verdict


def test_never():
    rows = [row(AGENT, 0, 80), row(RANSAC, 0, 79), row(AGENT, 1, 70), row(RANSAC, 1, 80)]
    assert answers(plane_claims(rows), "plane 4")[AGENT].verdict == HOLDS  # where ours is not optimal does not count
    rows += [row(AGENT, 2, 80), row(RANSAC, 2, 80)]
    assert answers(plane_claims(rows), "plane 4")[AGENT].verdict == FAILS


def test_trajectories():
    tree = {"outliers": [1, 2], "path": [], "nodes": [[-1, -1], [0, 1], [0, 3], [1, 2]], "expanded": [0, 2, 1, 3]}
    rows = [
        row(ASTAR, 0, 98, best=98, measures=tree),
        row(AGENT, 0, 98, best=98, before_refinement=98, measures={"outliers": [1, 2], "path": [2, 1]}),
        row(PAPER, 0, 97, best=98, before_refinement=95, measures={"outliers": [1, 2, 5], "path": [2, 5, 1]}),
    ]
    claims = trajectory_claims(rows)
    assert answers(claims, "figure 1, a")[AGENT].verdict == HOLDS
    assert answers(claims, "figure 1, a")[PAPER].verdict == FAILS
    assert answers(claims, "figure 1, b")[AGENT].verdict == HOLDS
    assert answers(claims, "figure 1, b")[PAPER].verdict == FAILS
    straight = [replace(rows[0], measures=tree | {"expanded": [0, 1, 3]}), *rows[1:]]
    assert answers(trajectory_claims(straight), "figure 1, b")[AGENT].verdict == FAILS


def test_modelnet():
    rows = [row(EXACT, i, 80, proven=i > 0, seconds=i) for i in range(20)]
    assert answers(modelnet_claims(rows), "ModelNet40 1")[EXACT].verdict == FAILS  # 95% are proven
    assert answers(modelnet_claims(rows[:10]), "ModelNet40 1")[EXACT].verdict == HOLDS
    rows += [row(AGENT, 0, 80), row(UCLM, 0, 75)]
    assert answers(modelnet_claims(rows), "ModelNet40 4")[AGENT].verdict == HOLDS
    assert answers(modelnet_claims(rows[:21]), "ModelNet40 4")[AGENT].numbers == "UCLM is not installed"


def test_kitti():
    rows = []
    for i, (ours, theirs) in enumerate([(500, 480), (510, 500), (505, 440)]):
        for name, found, confirmed in ((AGENT, ours, ours - 1), (RANSAC, theirs, theirs - 5)):
            measures = {"confirmed": confirmed, "marked": found}
            rows.append(row(name, i, found, best=510, rate=None, step=1, n_points=600 + i, measures=measures))
    claims = kitti_claims(rows)
    assert answers(claims, "KITTI 3")[AGENT].verdict == HOLDS
    assert answers(claims, "KITTI 4")[AGENT].verdict == HOLDS
    assert answers(claims, "KITTI 5")[AGENT].verdict == HOLDS
    assert answers(claims, "KITTI 2")[AGENT].verdict == NOT_RUN
    swapped = [replace(each, name={AGENT: RANSAC, RANSAC: AGENT}[each.name]) for each in rows]
    assert {answers(kitti_claims(swapped), f"KITTI {k}")[AGENT].verdict for k in (3, 4, 5)} == {FAILS}


def test_targets():
    rows = [row(AUTO, 0, 80), row(rival(RANSAC, AUTO), 0, 81)]
    (line,) = targets(rows)
    assert line.startswith("auto beside RANSAC, auto's time: -1.00 inliers")
    assert "fewer on 1 of 1" in line
