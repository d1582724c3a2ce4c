import dataclasses
import json

import numpy as np
import pytest

import maxcon
import oracles
from maxcon.datasets.synthetic import THRESHOLD
from maxcon.experiments import evaluation
from maxcon.experiments.canvas import picture
from maxcon.experiments.evaluation import (
    REFERENCE,
    Contender,
    Record,
    RecordFile,
    Settings,
    evaluate,
    instances,
    reference_consensus,
    run_instance,
    summarise,
)
from maxcon.experiments.evaluation_figure import draw_evaluation

SETTINGS = Settings(
    "line", (15, 20), (0, 40), 3, (Contender("greedy", "greedy"), Contender("five", "random", {"tries": 5}))
)


def untimed(records):
    return [dataclasses.replace(each, seconds=0.0) for each in records]


@pytest.fixture(scope="module")
def records():
    return [each for some in evaluate(SETTINGS) for each in some]


def test_instances_of_a_cell_hang_on_nothing_else():
    fewer = dataclasses.replace(SETTINGS, sizes=(20,), rates=(40,), n_instances=2)
    for one, other in zip(instances(fewer, 20, 40), instances(SETTINGS, 20, 40), strict=False):
        np.testing.assert_array_equal(one.b, other.b)
    again = np.random.default_rng([0, 3, 20, 40])  # where the evaluation's numbers come from
    np.testing.assert_array_equal(instances(SETTINGS, 20, 40)[0].A[:, 0], again.uniform(-1, 1, (20, 1))[:, 0])
    other_seed = dataclasses.replace(SETTINGS, seed=1)
    assert not np.array_equal(instances(other_seed, 20, 40)[0].b, instances(SETTINGS, 20, 40)[0].b)


def test_reference_is_the_optimum():
    for problem in instances(SETTINGS, 15, 40):
        goal, proven, seconds = reference_consensus(problem, THRESHOLD)
        assert proven
        assert seconds > 0
        assert goal == oracles.line_consensus_bruteforce(problem.A[:, 0], problem.b, THRESHOLD)


def test_a_record_for_every_fit(records):
    keys = {(each.n_points, each.rate, each.instance, each.name, each.refine) for each in records}
    assert len(keys) == len(records) == 2 * 2 * 3 * (2 * 3 + 1)
    for each in records:
        assert 0 <= each.gap <= each.n_points
        assert each.proven
        assert each.error is None
        assert each.seconds > 0


def test_records_are_what_fits_give(records):
    problem = instances(SETTINGS, 20, 40)[1]
    for refine in (None, "tree", "swap"):
        result = maxcon.fit(problem, THRESHOLD, method="random", rng=1, refine=refine, tries=5)
        expected = 20 - len(result.path) if refine is None else result.n_inliers
        (found,) = (
            each
            for each in records
            if (each.n_points, each.rate, each.instance, each.name, each.refine) == (20, 40, 1, "five", refine)
        )
        assert found.n_inliers == expected


def test_refinement_never_loses(records):
    found = {(each.n_points, each.rate, each.instance, each.name, each.refine): each.n_inliers for each in records}
    for (n_points, rate, instance, name, refine), count in found.items():
        if refine == "tree":
            assert count >= found[n_points, rate, instance, name, None]


def test_where_nothing_is_proven_the_best_is_the_reference(monkeypatch):
    real = maxcon.fit

    def without_exact(problem, threshold, *, method, **rest):
        if method == "exact":
            raise ValueError("not for this")
        return real(problem, threshold, method=method, **rest)

    monkeypatch.setattr(evaluation, "fit", without_exact)
    problem = instances(SETTINGS, 20, 40)[0]
    some = run_instance(problem, SETTINGS.contenders, 40, 0)
    assert not any(each.proven for each in some)
    assert len({each.reference for each in some}) == 1
    assert some[0].reference >= max(each.n_inliers for each in some)
    low = run_instance(problem, SETTINGS.contenders, 40, 0, (1, False, 0.0))
    assert low[0].reference == max(each.n_inliers for each in low if each.name != REFERENCE)


def test_a_failed_fit_stays_as_a_record(monkeypatch):
    real = maxcon.fit

    def failing(problem, threshold, *, method, **rest):
        if method == "random":
            raise ArithmeticError("did not converge")
        return real(problem, threshold, method=method, **rest)

    monkeypatch.setattr(evaluation, "fit", failing)
    some = run_instance(instances(SETTINGS, 15, 40)[0], SETTINGS.contenders, 40, 0)
    failed = [each for each in some if each.name == "five"]
    assert [each.error for each in failed] == ["did not converge"] * 3
    assert all(each.gap == each.reference > 0 for each in failed)
    (row,) = (each for each in summarise(failed) if each.refine == "swap")
    assert (row.failures, row.mean_gap) == (1, failed[0].reference)


def test_a_wrong_argument_is_no_failed_fit():
    wrong = dataclasses.replace(SETTINGS, contenders=(Contender("none", "random", {"tries": 0}),))
    with pytest.raises(ValueError, match="tries"):
        next(evaluate(wrong))


def test_summary_by_hand():
    base = Record(100, 10, 0, "a", None, 90, 90, True, 0.001)
    some = [
        dataclasses.replace(base, instance=i, n_inliers=90 - gap, seconds=ms / 1e3)
        for i, (gap, ms) in enumerate([(0, 1.0), (0, 2.0), (1, 3.0), (7, 6.0)])
    ]
    other = dataclasses.replace(base, name="b", proven=False)
    first, second = summarise([some[0], other, *some[1:]])
    assert (first.name, first.runs, first.mean_gap, first.median_gap, first.proven) == ("a", 4, 2.0, 0.5, True)
    assert first.mean_ms == pytest.approx(3.0)
    assert first.standard_error == pytest.approx(np.sqrt((4 + 4 + 1 + 25) / 3 / 4))
    assert (second.name, second.runs, second.proven) == ("b", 1, False)
    assert np.isnan(second.standard_error)


def test_an_evaluation_that_was_killed_goes_on(tmp_path, records):
    file = RecordFile(tmp_path, SETTINGS)
    for count, some in enumerate(evaluate(SETTINGS)):
        file.add(some)
        if count == 4:
            break
    with file.path.open("a", encoding="utf-8") as stream:  # as a kill in the middle of a write leaves it
        stream.write(json.dumps(dataclasses.asdict(records[-1])) + '\n{"n_points": 20, "ra')
    again = RecordFile(tmp_path, SETTINGS)
    assert untimed(again.done) == untimed(file.done)
    assert len(file.path.read_text(encoding="utf-8").splitlines()) == len(file.done) == 5 * 7
    seen = []
    for some in evaluate(SETTINGS, done=tuple(again.done), progress=lambda *counts: seen.append(counts)):
        again.add(some)
    assert untimed(again.done) == untimed(records)
    assert seen[-1] == (12, 12)
    assert untimed(RecordFile(tmp_path, SETTINGS).done) == untimed(records)


def test_a_folder_holds_one_evaluation(tmp_path, records):
    RecordFile(tmp_path, SETTINGS).add(records[:7])
    described = json.loads((tmp_path / "settings.json").read_text(encoding="utf-8"))
    assert described["settings"]["contenders"][1] == {"name": "five", "method": "random", "options": {"tries": 5}}
    assert described["machine"]["numpy"] == np.__version__
    with pytest.raises(ValueError, match="holds an evaluation with other settings"):
        RecordFile(tmp_path, dataclasses.replace(SETTINGS, seed=1))


@pytest.mark.parametrize("proven", [True, False])
def test_figure(records, proven):
    some = [dataclasses.replace(each, proven=proven) for each in records]
    figure = draw_evaluation(some, SETTINGS, 20)
    before, after, times = figure.axes
    assert before.get_ylabel() == f"inliers short of the {'optimum' if proven else 'best known'}"
    assert [text.get_text() for text in before.get_xticklabels()] == ["0", "40"]
    assert len(before.patches) == len(after.patches) == 4  # a box for each method and rate
    assert times.get_yscale() == "log"
    assert picture(figure, "png").startswith(b"\x89PNG")


def test_figure_of_one_cell(records):
    one = dataclasses.replace(SETTINGS, sizes=(15,), rates=(40,), contenders=SETTINGS.contenders[:1])
    some = [each for each in records if each.name in ("greedy", REFERENCE) and each.rate == 40]
    assert picture(draw_evaluation(some, one, 15), "svg")
