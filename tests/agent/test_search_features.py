"""The features of the point and the peel network: against their definitions, and the same in any unit."""

import numpy as np
import pytest

from maxcon.agent.peel_features import N_PEEL_FEATURES, PEEL_FEATURES, write_peel_features
from maxcon.agent.point_features import (
    BEST_MEMBER,
    BEST_RANK,
    BEST_SHARE,
    BEST_SIZE,
    BINS,
    GNC_SHARE,
    GNC_WEIGHT,
    L1_RANK,
    L1_SHARE,
    L1_SIZE,
    LEVERAGE,
    N_POINT_FEATURES,
    POINT_FEATURES,
    RAW_VOTES,
    ROUND,
    log_size,
    write_best_features,
    write_ranks,
    write_root_features,
    write_round_features,
)
from maxcon.minimax import linear_rows
from maxcon.problem import LinearProblem


def all_features(rows, r_l1, r_gnc, r_best, limit):
    N = rows.b.shape[0]
    features, bins = np.full((N_POINT_FEATURES, N), np.nan), np.zeros(BINS, dtype=np.int64)
    write_root_features(rows.At, r_l1, r_gnc, limit, bins, features)
    write_best_features(r_best, np.abs(r_best) <= limit, limit, bins, features)
    votes = np.vstack([np.ones(N), np.arange(N) / N, np.zeros(N)])
    write_round_features(votes, np.array([2.0, 1.0, 0.0]), 3, features)
    return features


def draw(N, d, seed=0):
    rng = np.random.default_rng(seed)
    rows = linear_rows(LinearProblem(rng.normal(size=(N, d)), rng.normal(size=N)))
    return rows, *(rng.standard_cauchy((3, N)))


@pytest.mark.parametrize(("N", "d"), [(3, 1), (20, 3), (300, 8)])
def test_all_are_written_and_mean_what_they_say(N, d):
    rows, r_l1, r_gnc, r_best = draw(N, d)
    features = all_features(rows, r_l1, r_gnc, r_best, 0.5)
    assert np.isfinite(features).all()
    assert len(POINT_FEATURES) == len(features)
    np.testing.assert_allclose(features[L1_SIZE], 0.5 * np.log(np.minimum(np.abs(r_l1) / 0.5, 1e4) + 0.05))
    np.testing.assert_allclose(features[GNC_WEIGHT], 1 / (1 + (r_gnc / 0.5) ** 2) ** 2, atol=1e-12)
    np.testing.assert_array_equal(features[BEST_MEMBER], np.abs(r_best) <= 0.5)
    for share, r in ((L1_SHARE, r_l1), (GNC_SHARE, r_gnc), (BEST_SHARE, r_best)):
        np.testing.assert_allclose(features[share], np.mean(np.abs(r) <= 0.5))
    hat = rows.At.T @ np.linalg.solve(rows.At @ rows.At.T, rows.At)
    np.testing.assert_allclose(features[LEVERAGE], 0.5 * np.log(np.diag(hat) * N / d + 0.01))
    np.testing.assert_allclose(features[RAW_VOTES], 0.5)
    np.testing.assert_allclose(features[RAW_VOTES + 1], np.arange(N) / N)
    np.testing.assert_array_equal(features[RAW_VOTES + 2], 0)  # nobody voted
    np.testing.assert_allclose(features[ROUND], 0.5 * np.log(4))


@pytest.mark.parametrize("seed", range(5))
def test_ranks_are_ranks_up_to_the_width_of_a_bin(seed):
    rng = np.random.default_rng(seed)
    r = np.abs(rng.standard_cauchy(200)) * 10.0 ** rng.integers(-3, 4)
    r[:10] = r[0]  # ties share one rank
    sizes = np.array([log_size(x, 1.0) for x in r])
    ranks, bins = np.empty(200), np.zeros(BINS, dtype=np.int64)
    write_ranks(sizes, bins, ranks)
    width = np.log(1e4 / 0.05) / 2 / (BINS - 1)
    for i in range(200):
        assert np.mean(sizes < sizes[i] - width) <= ranks[i] <= np.mean(sizes <= sizes[i] + width)
    assert len(set(ranks[:10])) == 1
    write_ranks(np.full(200, log_size(0.0, 1.0)), bins, ranks)
    np.testing.assert_array_equal(ranks, 0.5)
    write_ranks(np.full(200, log_size(np.inf, 1.0)), bins, ranks)
    np.testing.assert_array_equal(ranks, 0.5)


def test_units_do_not_matter():
    rows, r_l1, r_gnc, r_best = draw(50, 4)
    one = all_features(rows, r_l1, r_gnc, r_best, 0.5)
    other = all_features(rows, 1024 * r_l1, 1024 * r_gnc, 1024 * r_best, 512.0)
    np.testing.assert_array_equal(one, other)


def peel_matrix(scale=1.0):
    rng = np.random.default_rng(3)
    rows, r_l1, r_gnc, r_best = draw(30, 3)
    features = all_features(rows, r_l1, r_gnc, r_best, 0.5)
    out = np.full((4, N_PEEL_FEATURES), np.nan)
    basis = np.array([4, 9, 22, -1])
    sides, logit = np.array([1.0, -1.0, 1.0, 0.0]), rng.normal(size=30) * 20
    args = (basis, 3, np.array([0.5, 0.3, 0.2, 0.0]), sides, 0.8 * scale, 0.5 * scale, 0.7, r_l1 * scale, 0.4)
    write_peel_features(*args, logit, features, out)
    return out, r_l1, logit, features, basis


def test_peel_features_mean_what_they_say():
    out, proposal, logit, features, basis = peel_matrix()
    rows, chosen = out[:3], basis[:3]
    assert len(PEEL_FEATURES) == N_PEEL_FEATURES
    assert np.isfinite(rows).all()
    assert np.isnan(out[3]).all()
    np.testing.assert_allclose(rows[:, 0], np.log(0.8 / 0.5))
    np.testing.assert_allclose(rows[:, 1], 0.7)
    np.testing.assert_allclose(rows[:, 2], np.array([0.5, 0.3, 0.2]) * 2)
    np.testing.assert_allclose(rows[:, 3], features[L1_SIZE, chosen])
    np.testing.assert_allclose(rows[:, 5], np.clip(logit[chosen], -12, 12) / 4)
    np.testing.assert_allclose(rows[:, [4, 6]].sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(rows[:, 4] - rows[0, 4], rows[:, 3] - rows[0, 3])
    np.testing.assert_allclose(rows[:, 7], features[BEST_SIZE, chosen])
    np.testing.assert_allclose(rows[:, 8], features[BEST_MEMBER, chosen])
    np.testing.assert_allclose(rows[:, 10], np.array([1, -1, 1]) * np.clip(proposal[chosen] / 0.5, -2, 2))
    assert BEST_RANK != L1_RANK
    np.testing.assert_array_equal(out, peel_matrix(1024.0)[0])
