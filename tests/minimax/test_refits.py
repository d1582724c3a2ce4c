"""The kernels that move from one state to the next: after a removal, an addition, an enforcement."""

import math

import numpy as np
import pytest
from numba import config
from walks import Walk, branching_walk, draw, generator, random_walk

import instances
import oracles
from maxcon.minimax.linear import INFEASIBLE, OK, STOPPED, basis_multipliers, cold_fit

NAMES = sorted(instances.FAMILIES)

compiled = pytest.mark.skipif(bool(config.DISABLE_JIT), reason="takes too long without compilation")


def start(name: str, *seed: int) -> tuple[Walk, np.random.Generator]:
    walk = Walk(*draw(name, *seed))
    assert walk.status == OK
    return walk, generator(name, *seed, 1)


def tight_rows(walk: Walk) -> np.ndarray:
    """Rebuild the rows that the vertex says are tight, from their names."""
    w = walk.workspace
    n = len(w.x)
    G = np.zeros((n, n))
    for k, name in enumerate(w.q.tolist()):
        if name < 0:
            G[k, -1 - name] = 1.0
        else:
            G[k, :-1] = (1 - 2 * (name % 2)) * w.At[:, name // 2]
            G[k, -1] = w.gain[name // 2]
    return G


# --------------------------------------------------------------------------------------------------- removal


@pytest.mark.parametrize("name", NAMES)
def test_removals_down_to_one_point(name):
    """Basis points until f is 0, then any; |S| <= d included. f only falls."""
    walk, rng = start(name, 100)
    N = len(walk.b)
    compared = {N // 2, N // 4, *range(1, walk.A.shape[1] + 3)}
    while len(walk.kept) > 1:
        before = walk.value
        candidates = walk.basis or walk.kept
        assert walk.remove(int(rng.choice(candidates))) == OK
        assert walk.value <= before + 1e-12 * np.abs(walk.b).max() + walk.rounding()
        if len(walk.kept) in compared:
            walk.check()


@pytest.mark.parametrize("name", NAMES)
def test_removing_what_holds_nothing_changes_nothing(name):
    walk, rng = start(name, 110)
    value, basis = walk.value, walk.basis
    others = np.setdiff1d(np.arange(len(walk.b)), basis)
    for i in rng.permutation(others)[:8]:
        assert walk.remove(int(i)) == OK
        assert walk.value == pytest.approx(value, rel=1e-9, abs=1e-12 * np.abs(walk.b).max())
    walk.check()


@pytest.mark.parametrize("name", NAMES)
def test_removing_a_point_twice_changes_nothing(name):
    walk, rng = start(name, 120)
    for i in rng.permutation(len(walk.b))[: len(walk.b) // 2]:
        walk.remove(int(i))
    value = walk.value
    for i in np.flatnonzero(~walk.free)[:5]:
        assert walk.remove(int(i)) == OK
        assert walk.value == pytest.approx(value, rel=1e-12, abs=1e-12 * np.abs(walk.b).max())


@pytest.mark.parametrize("name", NAMES)
def test_removals_together(name):
    """Of the basis, and of others with it, down to nothing but a few."""
    walk, rng = start(name, 125)
    while len(walk.kept) > walk.A.shape[1] + 4:
        basis = walk.basis or walk.kept[:1].tolist()
        chosen = [int(i) for i in rng.permutation(basis)[: rng.integers(1, len(basis) + 1)]]
        others = np.setdiff1d(walk.kept, chosen)
        chosen += [int(i) for i in rng.permutation(others)[: rng.integers(0, 3)]]
        before = walk.value
        assert walk.remove_all(chosen[: len(walk.kept) - 1]) == OK
        assert walk.value <= before + 1e-12 * np.abs(walk.b).max() + walk.rounding()
        walk.check()


# -------------------------------------------------------------------------------------------------- addition


@pytest.mark.parametrize("name", NAMES)
def test_back_up_the_same_way(name):
    """Removed and added back in the opposite order, the states have the same values."""
    walk, rng = start(name, 130)
    values, removed = [walk.value], []
    for _ in range(min(15, len(walk.b) - 1)):
        removed.append(int(rng.choice(walk.basis or walk.kept)))
        walk.remove(removed[-1])
        values.append(walk.value)
    allowed = 1e-12 * np.abs(walk.b).max()
    for point in reversed(removed):
        assert walk.value == pytest.approx(values.pop(), rel=1e-9, abs=allowed + walk.rounding())
        assert walk.add(point) == OK
    assert walk.value == pytest.approx(values.pop(), rel=1e-9, abs=allowed + walk.rounding())
    walk.check()


@pytest.mark.parametrize("name", NAMES)
def test_adding_stops_above(name):
    """STOPPED says that f is above, OK that it is not or that the point changes nothing."""
    walk, rng = start(name, 140)
    for i in rng.permutation(len(walk.b))[: max(1, len(walk.b) // 3)]:
        walk.remove(int(i))
    saved, before = walk.save(), walk.value
    unit = 1e-12 * np.abs(walk.b).max()
    for point in rng.permutation(np.flatnonzero(~walk.free))[:4]:
        walk.load(saved)
        kept = np.append(walk.kept, point)
        f = oracles.highs_minimax(walk.A[kept], walk.b[kept])
        allowed = 1e-9 * f + unit + walk.rounding()
        for stop in (0.0, before, (before + f) / 2, f - 3 * allowed, f, f + 3 * allowed, 2 * f + 1, math.inf):
            walk.load(saved)
            status = walk.add(int(point), stop)
            if status == STOPPED:
                assert f > stop - allowed
                assert stop < walk.workspace.x[-1] * walk.rows.scale <= f + allowed  # a lower bound of f, all the same
            else:
                assert status == OK
                assert abs(walk.value - f) <= allowed
                assert walk.value <= stop + allowed or walk.value <= before + allowed


# ------------------------------------------------------------------------------------------------ mixed walks


@pytest.mark.parametrize("name", NAMES)
def test_walk_of_removals_and_additions(name):
    checked, _ = random_walk(name, 150, 12, enforcing=False)
    assert checked == 12


@pytest.mark.parametrize("name", NAMES)
def test_walk_with_enforced_points(name):
    checked, _ = random_walk(name, 160, 15, enforcing=True)
    assert checked == 15


@pytest.mark.parametrize("name", NAMES)
def test_walk_of_branch_and_bound(name):
    branching_walk(name, 165, 8)


def test_walks_of_branch_and_bound_meet_both_answers():
    checked, infeasible = branching_walk("synthetic_some", 166, 20)
    assert 3 < infeasible < checked - 3


# ----------------------------------------------------------------------------------------------- enforcement


def test_enforced_by_hand():
    """Heights 0, 1 and 4: with the first within 0.5, the others are at best 3.5 away; within 2 and with the last, 1."""
    A, b = np.ones((3, 1)), np.array([0.0, 1.0, 4.0])
    walk = Walk(A, b, 0.5)
    walk.enforce(0)
    assert walk.value == pytest.approx(3.5)
    walk = Walk(A, b, 2.0)
    walk.enforce(0)
    walk.enforce(2)
    assert walk.value == pytest.approx(1.0)
    assert walk.enforce(1) == OK
    assert walk.value == pytest.approx(0.0, abs=1e-12)
    walk = Walk(A, b, 1.9)
    walk.enforce(0)
    assert walk.enforce(2) == INFEASIBLE


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("share", [0.3, 0.7, 1.0, 1.5])
def test_enforcing_all_basis_points_in_turn(name, share):
    """Below f they cannot all be kept; from f on they can, and nothing moves."""
    walk, _ = start(name, 170)
    value, largest = walk.value, np.abs(walk.b).max()
    if value <= 1e-9 * largest:
        pytest.skip("f is 0")
    walk.threshold = share * value + (2 * oracles.default_slack(value, walk.b) if share == 1.0 else 0.0)
    status = OK
    for i in walk.basis:
        status = walk.enforce(i)
        walk.check()
        if status == INFEASIBLE:
            break
    assert status == (OK if share >= 1.0 else INFEASIBLE)


@pytest.mark.parametrize("name", NAMES)
def test_enforced_then_others_removed(name):
    walk, rng = start(name, 180)
    walk.threshold = 0.6 * walk.value + 1e-9 * np.abs(walk.b).max() + 1e-9
    for i in rng.permutation(len(walk.b))[:3]:
        saved = walk.save()
        if walk.enforce(int(i)) == INFEASIBLE:
            walk.check()
            walk.load(saved)
    for _ in range(min(10, len(walk.b) - 3)):
        candidates = [i for i in walk.basis if walk.free[i]] or np.flatnonzero(walk.free)
        if len(candidates) == 0:
            break
        before = walk.value
        assert walk.remove(int(rng.choice(candidates))) == OK
        assert walk.value <= before + 1e-12 * np.abs(walk.b).max() + walk.rounding()
    walk.check()
    for i in np.flatnonzero(walk.enforced):  # and the enforced ones too
        if len(walk.kept) > 1:
            assert walk.remove(int(i)) == OK
    walk.check()


@pytest.mark.parametrize("name", NAMES)
def test_an_enforced_point_comes_back_into_the_fit(name):
    """Enforced within less than it had, tight, then free again: f is what it was."""
    walk, rng = start(name, 190)
    value = walk.value
    walk.threshold = 0.5 * value + 1e-9 * np.abs(walk.b).max() + 1e-9
    for i in [*walk.basis, *rng.permutation(len(walk.b))[:5].tolist()]:
        saved = walk.save()
        if walk.enforce(i) == INFEASIBLE:
            walk.load(saved)
            continue
        assert walk.add(i) == OK
        assert walk.value == pytest.approx(value, rel=1e-9, abs=1e-12 * np.abs(walk.b).max() + walk.rounding())


@pytest.mark.parametrize("name", NAMES)
def test_enforcing_where_f_is_zero(name):
    """Often both sides of one point are tight there: they become one row once it is enforced."""
    walk, rng = start(name, 195)
    largest = np.abs(walk.b).max()
    while walk.basis and walk.value > 1e-12 * largest and len(walk.kept) > 1:
        walk.remove(int(rng.choice(walk.basis)))
    walk.threshold = float(rng.choice([0.01, 0.5])) * largest + 1e-9
    for side in rng.permutation(walk.workspace.q[walk.workspace.q >= 0])[:4]:
        assert walk.enforce(int(side) // 2) == OK
        walk.check()


def test_a_threshold_can_be_tightened_and_loosened():
    walk, _ = start("random_instance", 200)
    point, value = walk.basis[0], walk.value
    for share in (0.5, 0.2, 0.9, 0.1, 2.0):
        walk.threshold = share * value
        assert walk.enforce(point) == OK
        walk.check()


@compiled
def test_infeasible_is_only_said_of_enforced_points():
    """Sorted points leave a narrow range on which the whitened rows are dependent but for rounding.

    Rounding may then defeat the pivots, which is FAILED; INFEASIBLE would let a search drop the best set.
    """
    for name, N, d in (("vandermonde", 300, 8), ("chebyshev", 1000, 8), ("vandermonde", 1000, 10)):
        A, b = instances.BUILDERS[name](np.random.default_rng([0, N, d]), N, d)
        walk = Walk(A, b)
        for i in np.argsort(A[:, -2])[: N - 1]:
            if walk.remove(int(i)) != OK:
                break
            w = walk.workspace
            assert np.abs(w.r[walk.free]).max() <= w.x[-1] + 1e-13 * (1 + np.abs(w.x).sum())  # as OK means
        assert walk.status != INFEASIBLE


# ---------------------------------------------------------------------------------------------- the vertex


@pytest.mark.parametrize("name", NAMES)
def test_vertex_is_consistent(name):
    """After every step: C inverts the tight rows, x lies on them, r are the residuals, the multipliers prove f."""
    walk, rng = start(name, 210)
    w = walk.workspace
    walk.threshold = 0.5 * walk.value + 1e-9
    for step in range(12):
        saved = walk.save()
        point = int(rng.choice(walk.basis or walk.kept))
        status = walk.enforce(point) if step % 4 == 3 else walk.remove(point) if len(walk.kept) > 1 else OK
        if status == INFEASIBLE:
            walk.load(saved)
            continue
        assert status == OK
        G = tight_rows(walk)
        size = 1 + np.abs(w.C).max()
        assert np.abs(G @ w.C - np.eye(len(G))).max() <= 1e-10 * size
        assert np.abs(w.r - (w.b - w.At.T @ w.x[:-1])).max() <= 1e-13 * (1 + np.abs(w.x).sum())
        tight = [k for k in range(len(G)) if w.q[k] >= 0]
        points = w.q[tight] // 2
        signed = (1 - 2 * (w.q[tight] % 2)) * w.r[points]
        off = np.abs(signed - w.gain[points] * w.x[-1] - w.cap[points])
        assert (off <= 1e-12 * (size + w.cap[points])).all()
        multipliers = w.C[-1]
        assert multipliers[tight].min(initial=0.0) >= -1e-11
        dual = (multipliers[tight] * ((1 - 2 * (w.q[tight] % 2)) * w.b[points] - w.cap[points])).sum()
        assert dual == pytest.approx(w.x[-1], abs=1e-11 * (size + w.cap[points].max(initial=0.0)))


@pytest.mark.parametrize("name", NAMES)
def test_multipliers_of_the_basis(name):
    """They are positive and, with all points free and f > 0, sum to 1; the points alone have the same f."""
    walk, _ = start(name, 220)
    basis = walk.basis
    found = np.full(walk.workspace.q.shape[0], -1)
    found[: len(basis)] = basis
    multipliers = np.empty(len(found))
    basis_multipliers(walk.workspace.C, walk.workspace.q, found, multipliers)
    assert (multipliers[: len(basis)] > 1e-10).all()
    assert (multipliers[len(basis) :] == 0).all()
    if walk.value > 1e-9 * np.abs(walk.b).max():
        assert multipliers.sum() == pytest.approx(1.0, abs=1e-8)
        oracles.assert_minimax_value(walk.value, walk.A[basis], walk.b[basis])


@pytest.mark.parametrize("name", NAMES)
def test_warm_is_cold(name):
    """A warm re-fit and a cold fit of the same modes agree, and the same steps give the same bits twice."""
    first, rng = start(name, 230)
    second = Walk(first.A, first.b)
    for point in rng.permutation(len(first.b))[: min(8, len(first.b) - 1)]:
        first.remove(int(point))
        second.remove(int(point))
    assert (first.workspace.x == second.workspace.x).all()
    assert (first.workspace.q == second.workspace.q).all()
    warm, rounding = first.value, first.rounding()
    assert cold_fit(*first.workspace) == OK
    assert first.value == pytest.approx(warm, rel=1e-9, abs=1e-12 * np.abs(first.b).max() + rounding)


# -------------------------------------------------------------------------------------------------- extremes


@compiled
@pytest.mark.parametrize("name", ["random_instance", "quantised", "grid_points", "duplicate_a", "large_offset"])
def test_long_chain_of_many_points(name):
    """N = 2000, d = 12, 1950 removals: what one re-fit loses, the next ones must not add up."""
    A, b = instances.BUILDERS[name](np.random.default_rng(240), 2000, 12)
    walk, rng = Walk(A, b), np.random.default_rng(241)
    for count in range(1950):
        assert walk.remove(int(rng.choice(walk.basis or walk.kept))) == OK
        if count in (1000, 1900, 1949):
            w = walk.workspace
            warm = walk.value
            saved = walk.save()
            assert cold_fit(*w) == OK
            assert walk.value == pytest.approx(warm, rel=1e-9, abs=1e-12 * np.abs(b).max())
            walk.load(saved)
    walk.check()


@pytest.mark.parametrize("size", [1e3, 1e6, 1e9, 1e12])
def test_huge_outliers_are_removed(size):
    """What is left when they are gone is fitted to 1e-12 of the largest b there ever was."""
    rng = np.random.default_rng(250)
    A, b = instances.synthetic(rng, 60, 4, 0.0)
    outliers = rng.permutation(60)[:12]
    b[outliers] += rng.choice([-1, 1], 12) * size * rng.uniform(0.1, 1, 12)
    walk = Walk(A, b)
    for i in outliers:
        assert walk.remove(int(i)) == OK
    walk.check()


@pytest.mark.parametrize("size", [1e2, 1e4, 1e6])
def test_leverage_is_removed(size):
    """The long rows rule the whitening; the short ones that stay are fitted all the same."""
    rng = np.random.default_rng(260)
    A, b = instances.random_instance(rng, 50, 5)
    A[:7] *= size
    walk = Walk(A, b)
    for i in range(7):
        assert walk.remove(i) == OK
        walk.check()
    for _ in range(10):
        assert walk.remove(int(rng.choice(walk.basis))) == OK
    walk.check()


@pytest.mark.parametrize("noise", [0.0, 1e-14, 1e-11])
def test_near_ties_at_the_threshold(noise):
    """Quantised data enforced at a threshold that many residuals are equal to, but for `noise`."""
    rng = np.random.default_rng(270)
    A = np.c_[rng.integers(-3, 4, 30), np.ones(30)].astype(float)
    b = rng.integers(-2, 3, 30) / 2 + noise * rng.standard_normal(30)
    walk = Walk(A, b, 0.5)
    seen = set()
    for _ in range(3):
        for i in rng.permutation(30):
            saved = walk.save()
            seen.add(walk.enforce(int(i)))
            walk.check()
            if walk.status == INFEASIBLE:
                walk.load(saved)
                walk.remove(int(i))
    assert seen == {OK, INFEASIBLE}
