"""The figure of a consensus curve."""

import numpy as np
import pytest

import maxcon
from instances import synthetic
from maxcon.experiments.curve_figure import draw_curve
from maxcon.search.threshold_curve import consensus_curve


def line_curve(n_points=40, **arguments):
    A, b = synthetic(np.random.default_rng(1), n_points, 2, 0.4)
    return consensus_curve(maxcon.LinearProblem(A, b), **arguments)


def test_what_it_shows():
    curve = line_curve()
    figure = draw_curve(curve, "m", "A curve")
    axes = figure.axes[0]
    assert axes.get_xlabel() == "threshold, in m  (log scale)"
    assert axes.get_xscale() == "log"
    assert axes.get_ylabel() == "consensus (inliers)"
    assert figure.get_suptitle().startswith(f"A curve\n{curve.counts[curve.knees()[0]]} of 40 points within ")
    assert figure.get_suptitle().endswith("; proven")
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend[0] == "largest consensus, proven"
    steps = axes.lines[1]
    x, y = steps.get_xdata(), steps.get_ydata()
    assert steps.get_drawstyle() == "steps-post"
    np.testing.assert_array_equal(y[1:], curve.consensus(x[1:]))
    knees = curve.knees()
    assert len(knees) > 0
    assert [line.get_xydata()[0].tolist() for line in axes.lines[2:]] == [
        [curve.thresholds[knee], curve.counts[knee]] for knee in knees
    ]
    written = [text.get_text() for text in axes.texts]
    assert written == ["all 40 points", *(f"{curve.counts[k]} within {curve.thresholds[k]:.3g}" for k in knees)]


def test_a_partial_curve_shows_what_is_possible():
    curve = line_curve(callback=lambda done, total: done >= 5)
    assert not curve.complete
    figure = draw_curve(curve)
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert legend[:2] == ["possible, as far as is proven", "largest consensus known"]
    assert figure.get_suptitle().endswith("; not all of it proven")
    assert figure.axes[0].get_xlabel().startswith("threshold  (log scale)")


def test_a_short_range_is_linear():
    figure = draw_curve(line_curve(thresholds=(0.05, 0.3)))
    assert figure.axes[0].get_xscale() == "linear"
    assert figure.axes[0].get_xlim() == (0.05, 0.3)


@pytest.mark.parametrize("suffix", ["png", "svg", "pdf"])
def test_plot(tmp_path, suffix):
    problem = maxcon.LinearProblem(*synthetic(np.random.default_rng(1), 15, 2, 0.4))
    magic = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[suffix]
    for number, curve in enumerate((consensus_curve(problem), consensus_curve(problem, time_limit=1e-9))):
        for name in ("a", "b"):
            curve.plot(tmp_path / f"{name}{number}.{suffix}", unit="m", title="A curve")
        first, second = ((tmp_path / f"{name}{number}.{suffix}").read_bytes() for name in ("a", "b"))
        assert first.startswith(magic)
        assert first == second
    with pytest.raises(ValueError, match=r"path must end in .png, .svg or .pdf, but it is 'a.jpg'"):
        consensus_curve(problem).plot("a.jpg")


@pytest.mark.parametrize(
    ("A", "b"),
    [
        (np.ones((5, 1)), np.zeros(5)),
        (np.zeros((5, 1)), np.arange(5.0)),
        (np.ones((5, 1)), np.array([0, 0, 0, 0, 1e6])),
        (np.ones((5, 1)), np.full(5, 3.0)),
    ],
)
def test_degenerate_curves_can_be_drawn(tmp_path, A, b):
    problem = maxcon.LinearProblem(A, b)
    for number, thresholds in enumerate((None, (0.5, 1.0), (10.0, 20.0))):
        curve = consensus_curve(problem, thresholds)
        assert curve.complete
        curve.plot(tmp_path / f"{number}.png")
