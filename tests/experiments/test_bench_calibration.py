from types import SimpleNamespace

import pytest

from maxcon.experiments import bench_calibration
from maxcon.experiments.bench_calibration import FIRST, calibrate


class Peer:
    """A peer whose clock and luck are formulas, not measurements."""

    thresholds = (1.0, 2.0, 3.0)
    most = 100_000

    def __init__(self, seconds, inliers):
        self.seconds, self.inliers = seconds, inliers
        self.asked = []

    def prepare(self, instance, seed):
        return instance.name


@pytest.fixture
def calibrated(monkeypatch):
    def run(peer, budgets, instances=3):
        def timed(name, iterations, threshold):
            peer.asked.append((name, iterations, threshold))
            return peer.inliers(iterations, threshold), peer.seconds(name, iterations, threshold), None

        monkeypatch.setattr(bench_calibration, "timed", timed)
        sources = [SimpleNamespace(name=name, count_model=lambda model: model) for name in range(instances)]
        return calibrate(peer, sources, budgets)

    return run


def test_the_best_threshold_and_the_iterations_that_fit(calibrated):
    best = {1.0: 40, 2.0: 60, 3.0: 50}
    peer = Peer(lambda name, n, threshold: 1e-4 + 1e-5 * n, lambda n, threshold: min(best[threshold], n))
    choices = calibrated(peer, [0.001, 0.01])
    assert [choice.threshold for choice in choices.values()] == [2.0, 2.0]
    for budget, choice in choices.items():  # the clock is linear, so that nothing of the budget is left
        assert peer.seconds(0, choice.iterations, 2.0) == pytest.approx(budget, rel=0.02)
        assert choice.seconds <= budget
    assert choices[0.01].inliers == 60


def test_each_budget_has_its_own_threshold(calibrated):
    """A threshold that is better later is not chosen for a budget in which it is worse."""
    peer = Peer(lambda name, n, threshold: 1e-5 * n, lambda n, threshold: n if threshold == 3.0 else 100 * (n > 1))
    choices = calibrated(peer, [0.0005, 0.1])
    assert choices[0.0005].threshold != 3.0
    assert choices[0.1].threshold == 3.0


def test_too_slow_for_the_budget(calibrated):
    choices = calibrated(Peer(lambda name, n, threshold: 0.5 * n, lambda n, threshold: 10), [0.001])
    assert choices[0.001].iterations == FIRST


def test_a_threshold_that_fits_is_preferred(calibrated):
    """Not the one with the most inliers where that takes longer than the budget even with the least iterations."""
    slow = 1.0
    peer = Peer(lambda name, n, threshold: 1.0 if threshold == slow else 1e-4 * n, lambda n, threshold: 9 / threshold)
    assert calibrated(peer, [0.01])[0.01].threshold == 2.0


def test_interrupted_calls_do_not_count(calibrated):
    """One of three calls takes ten times as long: the median does not."""
    peer = Peer(lambda name, n, threshold: 1e-5 * n * (10 if name == 1 else 1), lambda n, threshold: 5)
    choice = calibrated(peer, [0.01])[0.01]
    assert choice.iterations == pytest.approx(1000, rel=0.02)


def test_a_peer_that_stops_by_itself(calibrated):
    peer = Peer(lambda name, n, threshold: min(1e-5 * n, 2e-3), lambda n, threshold: 5)
    choice = calibrated(peer, [0.1])[0.1]
    assert 256 <= choice.iterations <= 4096  # the ladder ends soon after nothing more happens
    assert max(n for _, n, _ in peer.asked) <= 4096


def test_no_more_than_the_most(calibrated):
    peer = Peer(lambda name, n, threshold: 1e-9 * n, lambda n, threshold: 5)
    peer.most = 50
    assert calibrated(peer, [0.1])[0.1].iterations == 32
