import dataclasses

import numpy as np
import pytest

import maxcon
from maxcon.cli.labels import number_points
from maxcon.cli.picture import NUMBERED, draw_fit, draw_line
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.experiments.canvas import look, new_figure, picture

MAGIC = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}


def fitted(n_params, n_points=60, rate=0.4, method="random", refine="tree"):
    problem = synthetic_hyperplane(np.random.default_rng(n_params), n_points, rate, n_params)
    return problem, maxcon.fit(problem, 0.1, method=method, refine=refine)


def names(n_params):
    return [*(f"x{i}" for i in range(1, n_params)), "y"]


@pytest.mark.parametrize("n_params", [2, 3, 5])
def test_pictures_are_drawn_without_a_warning(n_params):
    problem, consensus = fitted(n_params)
    figure = draw_fit(problem, consensus, names(n_params), "A fit")
    assert picture(figure, "png").startswith(MAGIC["png"])
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    regained = np.intersect1d(consensus.path, np.flatnonzero(consensus.inlier_mask))
    assert len(regained) > 0
    assert f"removed, then regained: {len(regained)}" in legend
    assert f"inlier: {consensus.n_inliers - len(regained)}" in legend
    assert f"outlier: {60 - consensus.n_inliers}" in legend
    assert "threshold ±0.1" in legend
    assert figure.get_suptitle().startswith("A fit\n")
    assert f"{consensus.n_inliers} of 60 points within 0.1" in figure.get_suptitle()


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_equal_pictures_are_equal_files(kind):
    problem, consensus = fitted(2, 30)
    first, second = (picture(draw_fit(problem, consensus, names(2), "A fit"), kind) for _ in range(2))
    assert first.startswith(MAGIC[kind])
    assert first == second


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_from_the_command_line(run, points, tmp_path, suffix):
    result = run("fit", points, "--model", "line", "--threshold", 0.06, "--method", "greedy", "--plot", f"a.{suffix}")
    assert result.exit_code == 0, result.output
    assert (tmp_path / f"a.{suffix}").read_bytes().startswith(MAGIC[suffix])


def labels_of(figure):
    """Return what is written beside points, and where."""
    figure.draw_without_rendering()
    return [
        (text.get_text(), text.get_window_extent())
        for axes in figure.axes
        for text in axes.texts
        if text.get_text().isdecimal()
    ]


def test_every_removal_is_numbered_where_there_is_room():
    x = np.arange(24.0)
    y = np.where(x < 16, 0.0, 3.0 * x)
    problem = maxcon.line(x, y)
    consensus = maxcon.fit(problem, 0.1, method="greedy")
    figure = draw_fit(problem, consensus, names(2), "A fit")
    written = dict(labels_of(figure))
    assert set(written) == {str(step) for step in range(1, len(consensus.path) + 1)}
    at = figure.axes[0].transData.transform(np.column_stack([x, y]))
    for step, point in enumerate(consensus.path, start=1):
        box = written[str(step)]
        middle = np.array([(box.x0 + box.x1) / 2, (box.y0 + box.y1) / 2])
        assert np.argmin(np.linalg.norm(at - middle, axis=1)) == point


@pytest.mark.parametrize("n_params", [2, 5])
def test_no_label_covers_another(n_params):
    problem, consensus = fitted(n_params, 300, 0.6, refine=None)
    assert len(consensus.path) > 3 * NUMBERED
    written = labels_of(draw_fit(problem, consensus, names(n_params), "A fit"))
    assert 5 <= len(written) <= NUMBERED
    assert all(int(text) <= NUMBERED for text, _ in written)
    for i, (_, one) in enumerate(written):
        for _, other in written[:i]:
            assert not one.shrunk(0.9, 0.7).overlaps(other.shrunk(0.9, 0.7))


def test_labels_without_room_are_left_out():
    with look():
        axes = new_figure(3.0, 3.0).subplots()
        axes.set(xlim=(0, 1), ylim=(0, 1))
        points = np.full((200, 2), 0.5)
        assert 1 <= number_points(axes, points, [str(i) for i in range(200)], points) < 100
        assert number_points(axes, np.empty((0, 2)), [], points) == 0


def test_a_line_without_a_model_shows_its_points():
    problem, consensus = fitted(2, 20)
    nothing = dataclasses.replace(
        consensus,
        status="infeasible",
        model=np.full(2, np.nan),
        inlier_mask=np.zeros(20, dtype=bool),
        n_inliers=0,
        path=np.empty(0, dtype=np.int64),
    )
    with look():
        axes = new_figure(3.0, 3.0).subplots()
        draw_line(axes, problem, nothing)
        assert len(axes.lines) == 0
    assert picture(draw_fit(problem, nothing, names(2), "A fit"), "png")


@pytest.mark.parametrize("threshold", [1e-6, 0.3, 1e5])
@pytest.mark.parametrize("n_params", [2, 3, 4])
def test_any_scale(n_params, threshold):
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (25, n_params - 1))
    y = X.sum(axis=1)
    y[:5] += 100.0
    problem = maxcon.hyperplane(X, y)
    consensus = maxcon.fit(problem, threshold, method="greedy")
    assert consensus.n_inliers == (25 if threshold > 100 else 20)
    assert picture(draw_fit(problem, consensus, names(n_params), "A fit"), "png")


def test_a_constant_column():
    problem = maxcon.line(np.ones(10), np.zeros(10))
    consensus = maxcon.fit(problem, 0.1)
    assert picture(draw_fit(problem, consensus, ["x", "y"], "A fit"), "png")
