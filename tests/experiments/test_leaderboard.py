import math
import statistics

import numpy as np
import pytest

from maxcon.experiments.bench_records import Row, Unit
from maxcon.experiments.bench_scores import (
    Change,
    best_of,
    compare,
    families,
    is_late,
    late_rivals,
    lost_cells,
    mean_and_error,
    summarise,
)
from maxcon.experiments.leaderboard import change_lines, family_lines, page_text, write_page
from maxcon.experiments.leaderboard_figure import draw_family

HEADER = {
    "settings": {"instances": 4, "seed": 0, "seeds": 2, "jobs": 1},
    "versions": {"maxcon": "0.1.0"},
    "processor": "an abacus, 1 cores",
}


def units(found, *, cell=("line", 50, 30), reference=30, ms=1.0, budget=1.0, seed=0, **more):
    """Return a unit for each instance; `found` holds, for each method, the inliers of both seeds of each instance."""
    count = len(next(iter(found.values())))
    return [
        Unit(
            *cell,
            number,
            seed,
            reference,
            True,
            "exact",
            [
                Row(method, budget, list(values[number]), [ms[method] if isinstance(ms, dict) else ms] * 2)
                for method, values in found.items()
            ],
            **more,
        )
        for number in range(count)
    ]


def score(scores, method, **where):
    (only,) = [
        each for each in scores if each.method == method and all(getattr(each, k) == v for k, v in where.items())
    ]
    return only


def test_scores_by_hand():
    found = {"auto": [(30, 30), (29, 30), (30, 28), (30, 30)], "gnc": [(20, 22), (30, 30), (25, 25), (10, 30)]}
    scores = summarise(units(found))
    gaps = [0.0, 0.5, 1.0, 0.0]
    auto = score(scores, "auto")
    assert list(auto.gaps.values()) == gaps
    assert auto.mean == pytest.approx(statistics.mean(gaps))
    assert auto.error == pytest.approx(statistics.stdev(gaps) / 2)
    assert (auto.runs, auto.late, auto.failed, auto.violations) == (8, 0, 0, 0)
    assert score(scores, "gnc").mean == pytest.approx((9 + 0 + 5 + 10) / 4)
    assert best_of(scores) == auto
    assert lost_cells(scores) == []
    assert math.isnan(mean_and_error([3.0])[1])


@pytest.mark.parametrize(
    ("ms", "budget", "late"),
    [(1.0, 1.0, False), (1.4, 1.0, False), (1.41, 1.0, True), (12.2, 10.0, False), (13, 10, True)],
)
def test_late(ms, budget, late):
    assert is_late(ms, budget) == late


def test_who_is_late_competes_with_nobody():
    found = {"auto": [(29, 29)] * 3, "slow": [(30, 30)] * 3}
    scores = summarise(units(found, ms={"auto": 1.0, "slow": 1.5}))
    assert score(scores, "slow").over
    assert score(scores, "slow").late == 6
    assert best_of(scores).method == "auto"
    assert lost_cells(scores) == []
    (lost,) = lost_cells(summarise(units(found)))
    assert (lost.best.method, lost.difference, lost.error) == ("slow", 1.0, 0.0)
    assert [(auto.method, rival.method) for auto, rival in late_rivals(scores)] == [("auto", "slow")]
    assert late_rivals(summarise(units(found))) == []
    late = lost_cells(summarise(units({"auto": [(30, 30)] * 3}, ms=1.5)))
    assert [each.best for each in late] == [None]  # "auto" itself is late, and nobody else is there


def test_within_a_twentieth_is_not_lost():
    many = [(30, 30)] * 9
    near, far = {"auto": [*many, (30, 29)]}, {"auto": [*many, (30, 28)]}
    best = {"gnc": [*many, (30, 30)]}
    assert lost_cells(summarise(units(near | best))) == []  # behind by exactly 0.05
    (lost,) = lost_cells(summarise(units(far | best)))
    assert lost.difference == pytest.approx(0.1)
    assert lost.error == pytest.approx(0.1)


def test_equal_is_best():
    scores = summarise(units({"gnc": [(30, 30)] * 2, "auto": [(30, 30)] * 2}))
    assert best_of(scores).method == "auto"


def test_families_weigh_cells_the_same():
    one = units({"auto": [(30, 30), (28, 28)]})
    two = units({"auto": [(20, 20)] * 7 + [(26, 26)]}, cell=("line", 50, 60))
    (family,) = families(summarise(one + two))
    errors = statistics.stdev([0, 2]) / math.sqrt(2), statistics.stdev([10] * 7 + [4]) / math.sqrt(8)
    assert family.mean == pytest.approx((1.0 + 9.25) / 2)
    assert family.error == pytest.approx(math.hypot(*errors) / 2)
    assert (family.cells, family.over) == (2, 0)


def test_changes_are_paired():
    """Instances differ by far more than the methods changed: only the pairs show it."""
    rng = np.random.default_rng(0)
    before = rng.integers(5, 30, 40)
    change = (np.arange(40) % 4 == 0).astype(int)
    old = units({"auto": [(int(n), int(n)) for n in before]})
    new = units({"auto": [(int(n), int(n)) for n in before - change]})
    (worse,) = compare(old, new)
    assert worse.mean == pytest.approx(0.25)
    assert worse.error == pytest.approx(statistics.stdev(change.tolist()) / math.sqrt(40))
    assert worse.real
    assert worse.worse
    (better,) = compare(new, old)
    assert better.mean == pytest.approx(-0.25)
    assert better.real
    assert not better.worse
    (same,) = compare(old, old)
    assert (same.mean, same.error, same.real) == (0.0, 0.0, False)


def test_a_larger_best_known_is_no_change_of_a_method():
    found = {"auto": [(20, 21), (22, 22)]}
    (change,) = compare(units(found, reference=25), units(found, reference=30))
    assert change.mean == 0.0


def test_only_what_both_have_is_compared():
    old = units({"auto": [(20, 20), (22, 22), (25, 25)], "gnc": [(1, 1)] * 3})
    new = units({"auto": [(19, 19), (23, 23)], "peel": [(1, 1)] * 2})
    (change,) = compare(old, new)
    assert (change.method, change.instances, change.mean) == ("auto", 2, 0.0)
    for other in (units({"auto": [(1, 1)]}, seed=5), units({"auto": [(1, 1)]}, budget=3.0)):
        with pytest.raises(ValueError, match="must have instances in common"):
            compare(old, other)


def test_one_instance_shows_nothing():
    (change,) = compare(units({"auto": [(20, 20)]}), units({"auto": [(10, 10)]}))
    assert change.mean == 10.0
    assert not change.real
    assert "+10.00" in "\n".join(change_lines([change]))


def test_the_lines_of_a_comparison():
    changes = [
        Change(("line", 50, 30), 1.0, "auto", 8, 0.5, 0.1),
        Change(("line", 50, 30), 3.0, "auto", 8, -0.5, 0.1),
        Change(("line", 50, 30), 1.0, "gnc", 8, 0.15, 0.1),
    ]
    text = "\n".join(change_lines(changes))
    assert "line, N = 50, 30% outliers (8 instances)" in text
    assert "2 of 3 changes exceed two standard errors" in text
    assert "worse: auto, line N = 50 30%, 1 ms: +0.50 +-0.10" in text
    assert "better: auto, line N = 50 30%, 3 ms: -0.50 +-0.10" in text
    assert "+0.15 +-0.10 " in text


@pytest.fixture
def some():
    found = {
        "auto": [(30, 30), (29, 30), (30, 28), (30, 30)],
        "gnc": [(30, 30)] * 4,
        "slow": [(30, 30)] * 4,
        "opencv-ransac": [(9, 9)] * 4,
    }
    speed = {"auto": 0.9, "gnc": 1.0, "slow": 2.0, "opencv-ransac": 0.8}
    one = units(found, ms=speed, missing={"agent": "no such agent"})
    two = units(found, ms=0.5, cell=("line", 50, 60))
    three = units(found, ms=0.5, cell=("plane", 100, 60), above_proven=1, code="other")
    return [*one, *two, *three]


def test_the_page(some):
    some[0].rows[0] = Row("auto", 1.0, [30, 30], [0.9, 0.9], violations=2)
    some[1].rows[3] = Row("opencv-ransac", 1.0, [0, 9], [0.8, 0.8], error="cv2.error: no")
    text = page_text(HEADER, some, {"poselib": "poselib"})
    assert "an abacus" in text
    assert "- poselib: not installed (pip install poselib)" in text
    assert "- agent: does not serve line" in text
    assert "2 states of it are in the records" in text
    assert "- 96 runs, of which 2 returned a set that its model does not explain, and 4 more points" in text
    assert "- 12 of 12 references are proven optima." in text
    assert "- 8 of 96 runs were late (8.3%)." in text
    assert "count as 0 inliers: opencv-ransac 1." in text
    assert '"auto" is the best or within 0.05 of it in 0 of 3' in text
    assert "| line | 50 | 30% | 1 ms | 0.38 +-0.24 | gnc | 0.00 +-0.00 | 0.38 +-0.24 |" in text
    assert "| slow | 0.00 +-0.00 (! 2 ms) | **0.00** +-0.00 |" in text
    assert "| gnc | **0.00** +-0.00 | **0.00** +-0.00 |" in text
    assert "![gap against time](gap-plane.png)" in text
    assert "Not complete" not in text
    assert "it is behind a method that takes more than the budget: slow in 1 (line N = 50 30% at 1 ms)." in text
    assert "Not complete: 11 of 12" in page_text(HEADER, some[1:], {})


def test_a_page_without_losses_or_without_auto(some):
    won = units({"auto": [(30, 30)] * 2})
    assert '"auto" is the best or within 0.05 of it in all 1' in page_text(HEADER, won, {})
    other = units({"gnc": [(30, 30)] * 2})
    assert '"auto" did not run' in page_text(HEADER, other, {})
    busy = page_text(HEADER, units({"auto": [(30, 30)]}, core=0.5), {})
    assert "50% of a core: the machine was busy" in busy


def test_files(some, tmp_path):
    written = write_page(tmp_path, HEADER, some, {})
    assert [each.name for each in written] == ["leaderboard.md", "gap-line.png", "gap-plane.png"]
    assert all(each.read_bytes()[:4] == b"\x89PNG" for each in written[1:])
    with pytest.raises(ValueError, match="at least one record"):
        write_page(tmp_path, HEADER, [], {})
    assert any("gnc" in line and "0.00 +-0.00" in line for line in family_lines(summarise(some)))


def test_panels(some):
    figure = draw_family(summarise(some), "line")
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["N = 50, 30% outliers", "N = 50, 60% outliers"]
    (label,) = [each for each in figure.axes[0].containers if each.get_label() == "auto"]
    assert label.lines[0].get_ydata()[0] == pytest.approx(0.375)
    with pytest.raises(ValueError, match="scores must hold some of the family 'circle'"):
        draw_family(summarise(some), "circle")
