"""Walks over the states of the engine: points removed, added and enforced, each step compared with an oracle."""

from __future__ import annotations

import math

import numpy as np

import instances
import oracles
from maxcon.minimax import Workspace, allocate, linear_rows
from maxcon.minimax.linear import FAILED, INFEASIBLE, OK, basis_points, cold_fit
from maxcon.minimax.refits import (
    refit_after_addition,
    refit_after_enforcement,
    refit_after_removal,
    refit_after_removals,
)
from maxcon.problem import LinearProblem

WELL_CONDITIONED = 1e8  # beyond, see `oracles.scaled_condition`: double precision cannot be held to the exact answer


def draw(name: str, *seed: int) -> instances.Instance:
    """Return an instance of a family; the seed depends on the name too."""
    return instances.FAMILIES[name](generator(name, *seed))


def generator(name: str, *seed: int) -> np.random.Generator:
    return np.random.default_rng([*seed, *name.encode()])


class Walk:
    """The engine's vertex, beside a plain record of which points are in the fit and which are enforced.

    All values are in the unit of b.
    """

    def __init__(self, A: instances.Floats, b: instances.Floats, threshold: float = 0.0) -> None:
        self.A, self.b, self.threshold = A, b, threshold
        self.rows = linear_rows(LinearProblem(A, b))
        self.workspace: Workspace = allocate(self.rows)
        self.free = np.ones(len(b), dtype=bool)
        self.enforced = np.zeros(len(b), dtype=bool)
        self.status = cold_fit(*self.workspace)

    @property
    def value(self) -> float:
        """What the engine says f is; inf where it says infeasible, NaN where it gave up."""
        if self.status == OK:
            return float(self.workspace.x[-1]) * self.rows.scale
        return math.inf if self.status == INFEASIBLE else math.nan

    @property
    def kept(self) -> np.ndarray:
        return np.flatnonzero(self.free | self.enforced)

    @property
    def basis(self) -> list[int]:
        found = np.empty(self.workspace.q.shape[0], dtype=np.int64)
        size = basis_points(self.workspace.C, self.workspace.q, found)
        assert (found[size:] == -1).all()
        return found[:size].tolist()

    def remove(self, point: int) -> int:
        self.status = refit_after_removal(*self.workspace, point)
        self.free[point] = self.enforced[point] = False
        return self.status

    def remove_all(self, points: list[int]) -> int:
        self.status = refit_after_removals(*self.workspace, np.array([*points, -1]), len(points))
        self.free[points] = self.enforced[points] = False
        return self.status

    def add(self, point: int, stop_above: float = math.inf) -> int:
        self.status = refit_after_addition(*self.workspace, point, stop_above / self.rows.scale)
        self.free[point], self.enforced[point] = True, False
        return self.status

    def enforce(self, point: int) -> int:
        self.status = refit_after_enforcement(*self.workspace, point, self.threshold / self.rows.scale)
        self.free[point], self.enforced[point] = False, True
        return self.status

    def save(self) -> list[np.ndarray]:
        """Return copies of all that makes the state, as a search keeps them to come back."""
        return [array.copy() for array in self._state()]

    def load(self, saved: list[np.ndarray]) -> None:
        """Go back to a saved state; only an optimal one may have been saved."""
        for array, copy in zip(self._state(), saved, strict=True):
            array[:] = copy
        self.status = OK

    def _state(self) -> list[np.ndarray]:
        w = self.workspace
        return [w.gain, w.cap, w.C, w.x, w.q, w.r, self.free, self.enforced]

    def rounding(self, everywhere: bool = False) -> float:
        """Return what no residual can be more exact than: some units of rounding of the numbers it is a sum of.

        That of the kept points, or, since they are whitened together, of all points ever there.
        """
        model = self.rows.model(self.workspace.x) if self.status == OK else np.zeros(self.A.shape[1])
        sizes = np.abs(self.A if everywhere else self.A[self.kept]) @ np.abs(model)
        return 4 * np.finfo(float).eps * float(sizes.max(initial=0.0))

    def check(self, everywhere: bool = False) -> None:
        """Assert that the value is f of the kept points, to 1e-9 f + 1e-12 max|b|, and that the model attains it.

        `everywhere` grants the rounding of all rows, where the removed ones may be 1e6 times longer than the kept.
        """
        assert self.status != FAILED, f"the engine gave up at |S| = {len(self.kept)} of {self.A.shape}"
        kept = self.kept
        A, b, held = self.A[kept], self.b[kept], self.enforced[kept]
        if held.any():
            slack = oracles.default_slack(self.threshold, self.b)
            low = oracles.highs_minimax(A, b, held, self.threshold + slack)
            # Enforced rows make f depend on the threshold, at times steeply: all within the slack are right.
            high = math.inf
            if self.threshold > slack:
                high = oracles.highs_minimax(A, b, held, self.threshold - slack)
        else:
            low = high = oracles.highs_minimax(A, b)
        value, largest = self.value, float(np.abs(self.b).max())
        about = f"|S| = {len(kept)} of {self.A.shape}, scaled condition {oracles.scaled_condition(A):.3g}"
        if math.isinf(low):
            assert self.status == INFEASIBLE, f"infeasible, but the engine says {value}: {about}"
            return
        if low > 1e8 * largest:  # feasible for exact arithmetic only: the rows are dependent but for rounding
            assert value > 1e7 * largest, f"f is {low}, but the engine says {value}: {about}"
            return
        rounding = 1e-12 * largest + self.rounding(everywhere)
        allowed = 1e-9 * low + rounding
        above = math.inf if math.isinf(high) else high + 1e-9 * high + rounding
        assert low - allowed <= value <= above, (
            f"f is {low!r} to {high!r}, the engine says {value!r}, {max(low - value, value - high) / allowed:.3g} times"
            f" what is allowed: {about}"
        )
        if self.status == OK:
            self.check_attained(allowed, about)

    def check_attained(self, allowed: float, about: str) -> None:
        """Assert that the model's residuals are what the vertex says."""
        residuals = np.abs(self.A @ self.rows.model(self.workspace.x) - self.b)
        allowed = 10 * allowed + self.rounding(everywhere=True)
        assert residuals[self.free].max(initial=0.0) <= self.value + allowed, about
        assert residuals[self.enforced].max(initial=0.0) <= self.threshold + allowed, about

    def well_conditioned(self) -> bool:
        return oracles.scaled_condition(self.A[self.kept]) <= WELL_CONDITIONED


def random_walk(name: str, seed: int, steps: int, enforcing: bool) -> tuple[int, int]:
    """Remove, add and enforce at random, and check after each step; what is infeasible is taken back.

    Returns
    -------
    checked, infeasible : int, int
        How many steps were compared, and how many of them were infeasible.
    """
    rng = generator(name, seed)
    A, b = instances.FAMILIES[name](rng)
    walk = Walk(A, b)
    walk.check()
    largest = float(np.abs(b).max())
    share = float(rng.choice([0.02, 0.1, 0.3, 0.5, 0.9, 1.0]))
    walk.threshold = share * walk.value if walk.value > 1e-11 * largest else 0.1 * largest + 1e-3
    checked = infeasible = 0
    for _ in range(steps):
        saved = walk.save()
        random_step(walk, rng, enforcing)
        if walk.well_conditioned():
            walk.check()
            checked += 1
        if walk.status == INFEASIBLE:
            infeasible += 1
            walk.load(saved)
    return checked, infeasible


def branching_walk(name: str, seed: int, steps: int) -> tuple[int, int]:
    """Walk as branch and bound does: a basis point is in (enforced) or, at times or where that cannot be, out.

    Returns
    -------
    checked, infeasible : int, int
        How many states were compared, and how many of them were infeasible.
    """
    rng = generator(name, seed, 1)
    walk = Walk(*draw(name, seed))
    walk.threshold = float(rng.choice([0.05, 0.2, 0.5, 0.8, 0.95, 1.0])) * walk.value
    checked = infeasible = 0
    for _ in range(steps):
        candidates = [i for i in walk.basis if walk.free[i]]
        if not candidates or walk.value <= 1e-9 * np.abs(walk.b).max():
            break
        point, saved = int(rng.choice(candidates)), walk.save()
        if rng.random() < 0.7:
            walk.enforce(point)
        else:
            walk.remove(point)
        walk.check()
        checked += 1
        if walk.status == INFEASIBLE:
            infeasible += 1
            walk.load(saved)
            walk.remove(point)
    return checked, infeasible


def random_step(walk: Walk, rng: np.random.Generator, enforcing: bool) -> None:
    """Remove (60%), add (20%) or enforce (20%) a point, one of the basis more often than others."""
    basis, kept, out = walk.basis, walk.kept, np.flatnonzero(~(walk.free | walk.enforced))
    chance = rng.random()
    if len(out) and (len(kept) == 1 or 0.6 <= chance < 0.8):
        walk.add(int(rng.choice(out)))
    elif enforcing and chance >= 0.8:
        free = [i for i in basis if walk.free[i]]
        candidates = np.flatnonzero(walk.free if rng.random() < 0.8 else ~walk.enforced)  # at times a removed one
        if free and rng.random() < 0.6:
            walk.enforce(int(rng.choice(free)))
        elif len(candidates):
            walk.enforce(int(rng.choice(candidates)))
    elif len(kept) > 1:
        walk.remove(int(rng.choice(basis if basis and rng.random() < 0.7 else kept)))
