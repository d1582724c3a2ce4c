"""Some 20,000 states, compared with the exact fit one by one: minutes, so only with ``-m slow``."""

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from walks import Walk, branching_walk, draw, generator, random_walk

import instances
import oracles
from maxcon.minimax import minimax_fit
from maxcon.minimax.linear import OK
from maxcon.problem import LinearProblem

NAMES = sorted(instances.FAMILIES)

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", NAMES)
def test_cold_fits(name):
    for seed in range(1000, 1040):
        A, b = draw(name, seed)
        found = minimax_fit(LinearProblem(A, b))
        oracles.assert_minimax_value(found.value, A, b)
        # The basis of nearly dependent points is one in exact arithmetic only.
        if len(found.basis) and oracles.scaled_condition(A[found.basis]) <= 1e8 and name != "tenths":
            oracles.assert_minimax_value(found.value, A[found.basis], b[found.basis])


@pytest.mark.parametrize("name", NAMES)
def test_removal_chains(name):
    """All the way down to one point, each state compared."""
    for seed in range(1100, 1103):
        walk, rng = Walk(*draw(name, seed)), generator(name, seed, 1)
        while len(walk.kept) > 1:
            choice = walk.basis if walk.basis and rng.random() < 0.8 else walk.kept
            assert walk.remove(int(rng.choice(choice))) == OK
            if walk.well_conditioned():
                walk.check()


@pytest.mark.parametrize("name", NAMES)
def test_mixed_walks(name):
    checked = sum(random_walk(name, seed, 30, enforcing=seed % 2 == 1)[0] for seed in range(1200, 1208))
    assert checked >= 200


@pytest.mark.parametrize("name", NAMES)
def test_walks_of_branch_and_bound(name):
    for seed in range(1300, 1305):
        branching_walk(name, seed, 25)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("unit", [1e-6, 1e6])
def test_chains_in_other_units(name, unit):
    """A walk in other units of a and b goes the same way, and its values are in those units."""
    for seed in range(1400, 1403):
        A, b = draw(name, seed)
        walk, scaled, rng = Walk(A, b), Walk(A * unit, b * unit**2), generator(name, seed, 1)
        for _ in range(min(10, len(b) - 1)):
            point = int(rng.choice(walk.basis or walk.kept))
            assert walk.remove(point) == OK
            assert scaled.remove(point) == OK
            allowed = 1e-12 * np.abs(b).max() + 2 * walk.rounding()
            assert scaled.value / unit**2 == pytest.approx(walk.value, rel=1e-9, abs=allowed)


ENTRIES = st.one_of(
    st.integers(-4, 4).map(float),
    st.floats(-100, 100).map(lambda value: value if abs(value) > 1e-2 else 0.0),
    st.sampled_from([0.1, 0.2, 0.3, -0.1, -0.7]),
)
VALUES = st.one_of(ENTRIES, st.sampled_from([1e-6, -1e-6, 1e6, -1e6, 1e9]))


@settings(max_examples=1500, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data(), d=st.integers(1, 5), extra=st.integers(0, 20))
def test_anything(data, d, extra):
    """Integers, tenths and floats in one matrix, and extremes in b; the exact fit judges where doubles can follow."""
    A = data.draw(hnp.arrays(float, (d + 1 + extra, d), elements=ENTRIES))
    b = data.draw(hnp.arrays(float, d + 1 + extra, elements=VALUES))
    assume(oracles.scaled_condition(A) <= 1e6)
    walk = Walk(A, b)
    walk.check(everywhere=True)
    rng = np.random.default_rng(0)
    for _ in range(min(3, d)):
        walk.remove(int(rng.choice(walk.basis or walk.kept)))
        if oracles.scaled_condition(A[walk.kept]) <= 1e6:
            walk.check(everywhere=True)
