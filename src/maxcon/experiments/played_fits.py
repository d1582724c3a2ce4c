"""Fits that are played for the search networks to learn from: the label of each, and what the networks saw.

A label is the best set that anything has found, or the proven optimum; it says what was right (see
`maxcon.experiments.self_imitation`, which plays the rounds and makes the updates).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.peel_features import N_PEEL_FEATURES
from maxcon.agent.search_networks import SearchNetworks
from maxcon.search.anytime import Task, make_task, run
from maxcon.search.exact import exact
from maxcon.search.gnc import gnc
from maxcon.search.learned import learned
from maxcon.search.learned_kernels import (
    BELIEVE,
    PARTS,
    PROPOSE,
    SWAP,
    WALK,
    begin_search,
    finish_search,
    play_parts,
)
from maxcon.search.learned_memory import ROUND, STEPS, WALKS, Search, allocate_arena, carve
from maxcon.search.learned_settings import Settings
from maxcon.search.random_kernels import seed_state
from maxcon.search.refine import swap_refinement
from maxcon.search.sampling import lo_ransac

#: How long a proof may take where labels are proven optima; the best set known stands in where it takes longer.
PROOF_SECONDS = 0.2

#: Removals of a walk that are recorded.
LOG_STEPS = 60

#: Rows of a round that are kept of the point records, each round of each fit: so many points at random.
POINTS_KEPT = 48

#: The most points that a basis has: d + 1 of the largest d.
WIDEST_BASIS = 10


@dataclass
class Records:
    """What the networks saw in some fits, and what was right.

    Attributes
    ----------
    points, points_right
        Shapes (n, 18) and (n,).
    steps, steps_right
        Shapes (m, K, 12) and (m, K): -1 where a slot is empty; K = the largest d + 1.
    """

    points: NDArray[np.float32]
    points_right: NDArray[np.float32]
    steps: NDArray[np.float32]
    steps_right: NDArray[np.float32]


def best_known(
    problem: Any, threshold: float, samples: int, rng: np.random.Generator, nets: SearchNetworks | None, rounds: int
) -> NDArray[np.bool_]:
    """Return the largest of the sets that LO-RANSAC, graduated non-convexity and the search find, swapped."""
    task = make_task(problem, threshold, rng)
    found = [
        run(task, lo_ransac(task, samples=samples), swap_refinement),
        run(task, gnc(task, restarts=5), swap_refinement),
    ]
    if nets is not None:
        found.append(run(task, learned(task, network=nets, rounds=rounds), swap_refinement))
    best = max(found, key=lambda each: each.size)
    return best.subset if best.subset is not None else np.zeros(problem.n_points, dtype=np.bool_)


def proven_optimum(problem: Any, threshold: float, seconds: float) -> NDArray[np.bool_] | None:
    """Return the largest consensus set where that can be proven in so many seconds on one thread, else None."""
    task = make_task(problem, threshold, np.random.default_rng(0), seconds)
    best = run(task, exact(task, n_jobs=1), swap_refinement)
    return best.subset if best.gap <= 0 else None


def random_settings(rng: np.random.Generator, explore: float) -> Settings:
    """Return settings for a training fit: all that a user may meet, and a random removal so often as `explore` says."""
    return Settings(
        samples=int(np.exp(rng.uniform(np.log(48), np.log(200)))),
        refined=int(rng.integers(2, 7)),
        local=float(rng.uniform(3.0, 6.0)),
        reach=float(np.exp(rng.uniform(np.log(1.05), np.log(2.5)))),
        power=float(rng.choice([1.0, 2.0, 3.0, 4.0])),
        floor=float(np.exp(rng.uniform(np.log(0.001), np.log(0.01)))),
        patience=int(rng.integers(3, 7)),
        explore=explore,
    )


class Recorder:
    """Plays fits with the present networks and keeps what these saw."""

    def __init__(self) -> None:
        self.points: list[NDArray[np.float64]] = []
        self.points_right: list[NDArray[np.bool_]] = []
        self.steps: list[NDArray[np.float32]] = []
        self.steps_right: list[NDArray[np.float64]] = []

    def fit(
        self, task: Task, nets: SearchNetworks, label: NDArray[np.bool_], settings: Settings, rounds: int
    ) -> tuple[int, int]:
        """Play one fit; return the sizes of the label given and of the set found."""
        arena = allocate_arena(task.rows, seed_state(task.rng), nets.points, nets.peel, LOG_STEPS)
        search = carve(arena)
        seen: list[tuple[NDArray[np.float64], NDArray[np.int64]]] = []
        looks: list[tuple[NDArray[np.float64], NDArray[np.int64]]] = []
        begin_search(arena, task.limit)
        looks.append(self._look(search, task.rng))
        while search.counts[ROUND] < rounds:
            play_parts(arena, task.limit, settings, PROPOSE, WALK)
            for part in range(WALK, BELIEVE):
                walks = search.counts[WALKS]
                play_parts(arena, task.limit, settings, part, part + 1)
                if search.counts[WALKS] > walks:
                    steps = min(int(search.counts[STEPS]), LOG_STEPS)
                    seen.append((search.walk.log[:steps].copy(), search.walk.log_basis[:steps].copy()))
            play_parts(arena, task.limit, settings, BELIEVE, SWAP)
            looks.append(self._look(search, task.rng))
            play_parts(arena, task.limit, settings, SWAP, PARTS)
        finish_search(arena, task.limit)
        known, found = int(label.sum()), int(search.member.sum())
        right = search.member if found > known else label
        for features, points in looks:
            self.points.append(features)
            self.points_right.append(right[points])
        for features, basis in seen:
            self._keep_steps(features, basis, right)
        return known, found

    @staticmethod
    def _look(search: Search, rng: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        N = search.member.shape[0]
        points = rng.permutation(N)[:POINTS_KEPT]
        return search.belief.features[:, points].T.copy(), points

    def _keep_steps(self, features: NDArray[np.float64], basis: NDArray[np.int64], right: NDArray[np.bool_]) -> None:
        n, wide = basis.shape[1], WIDEST_BASIS
        padded = np.zeros((len(basis), wide, features.shape[2]), dtype=np.float32)
        padded[:, :n] = np.where(basis[:, :, None] >= 0, features, 0.0)
        outside = np.full((len(basis), wide), -1.0)
        outside[:, :n] = np.where(basis >= 0, ~right[basis], -1.0)
        self.steps.append(padded)
        self.steps_right.append(outside)

    def records(self) -> Records:
        """Return all that was kept."""
        empty = [np.zeros((0, WIDEST_BASIS, N_PEEL_FEATURES), dtype=np.float32)]
        return Records(
            np.concatenate(self.points).astype(np.float32),
            np.concatenate(self.points_right).astype(np.float32),
            np.concatenate(self.steps or empty).astype(np.float32),
            np.concatenate(self.steps_right or [np.zeros((0, WIDEST_BASIS))]).astype(np.float32),
        )
