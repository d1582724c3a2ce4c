"""Training of the search networks by self-imitation: their labels are the best sets that anything has found.

No ground truth enters. Each problem is fitted by LO-RANSAC, by graduated non-convexity and by the learned search as it
stands, all with swap refinement. The best of these sets is the label: a point is right to believe in if it is in
that set, and a basis point is right to remove if it is not. (Every basis of an infeasible set holds a point
outside any given feasible set, so the perfect policy is this classification.)

A round plays the search on fresh problems with the present networks and random settings, keeping what the networks saw;
then both are updated on this and the last rounds' records. Point network: binary cross entropy. Peel network: half
of that, and the cross entropy of a choice over the basis, of which every point outside the label is right.
"""

from __future__ import annotations

import json
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from maxcon.agent.peel_features import N_PEEL_FEATURES
from maxcon.agent.perceptron import LEAK, Perceptron, layers, perceptron, random_perceptron
from maxcon.agent.point_features import N_POINT_FEATURES
from maxcon.agent.search_networks import PEEL_WIDTHS, POINT_WIDTHS, SearchNetworks, save_search_networks
from maxcon.experiments.played_fits import (
    PROOF_SECONDS,
    Recorder,
    Records,
    best_known,
    proven_optimum,
    random_settings,
)
from maxcon.experiments.search_instances import FAMILIES, Ranges, draw_problem, make_problem
from maxcon.search.anytime import make_task, run
from maxcon.search.learned import learned
from maxcon.search.refine import swap_refinement

if TYPE_CHECKING:
    import torch

    from maxcon.problem import LinearProblem

#: What draws a problem with its threshold.
Source = Callable[[np.random.Generator], "tuple[LinearProblem, float]"]


@dataclass(frozen=True)
class Recipe:
    """The settings of a training.

    Attributes
    ----------
    fits, updates
        Fits and gradient steps of a round.
    replayed
        How many rounds' records are learned from.
    batch_points, batch_steps
        Rows of a point batch, and walk steps of a peel batch.
    rate, last_rate
        Adam's learning rate, falling geometrically from the first to the last over the rounds.
    explore
        How often a walk removes a random basis point.
    play_rounds
        How many rounds of the search a fit plays at least and at most.
    samples
        Samples of the LO-RANSAC that competes for the label.
    label_rounds
        Rounds of the search that competes for it, with the networks as they stand.
    point_widths, peel_widths
        Hidden widths of the networks.
    labels
        "best": the largest set known; "optima": the proven optimum where a proof takes no more than `PROOF_SECONDS`.
    ranges
        What problems are drawn from.
    """

    fits: int = 80
    updates: int = 60
    replayed: int = 25
    batch_points: int = 8192
    batch_steps: int = 1024
    rate: float = 3e-3
    last_rate: float = 5e-5
    explore: float = 0.1
    play_rounds: tuple[int, int] = (3, 9)
    samples: int = 1000
    label_rounds: int = 25
    point_widths: tuple[int, ...] = POINT_WIDTHS[1:-1]
    peel_widths: tuple[int, ...] = PEEL_WIDTHS[1:-1]
    labels: str = "best"
    ranges: Ranges = field(default_factory=Ranges)


@dataclass(frozen=True)
class TrainingProgress:
    """What a progress callback is told after each round."""

    round: int
    rounds: int
    point_loss: float
    peel_loss: float
    gained: float
    seconds: float
    held_out: dict[str, float] | None


class Learner:
    """The two networks in torch, their optimiser, and the way to and from `SearchNetworks`."""

    def __init__(self, nets: SearchNetworks, recipe: Recipe) -> None:
        torch = _torch()
        self.recipe = recipe
        self.points = _module(nets.points)
        self.peel = _module(nets.peel)
        parameters = [*self.points.parameters(), *self.peel.parameters()]
        self.optimiser = torch.optim.Adam(parameters, lr=recipe.rate)

    def networks(self) -> SearchNetworks:
        """Return the networks as they stand."""
        return SearchNetworks(_plain(self.points), _plain(self.peel))

    def learn(self, records: Sequence[Records], progress: float, rng: np.random.Generator) -> tuple[float, float]:
        """Make the updates of a round, `progress` of the way through training; return both mean losses."""
        torch = _torch()
        recipe = self.recipe
        rate = recipe.rate * (recipe.last_rate / recipe.rate) ** progress
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        X = torch.from_numpy(np.concatenate([each.points for each in records]))
        y = torch.from_numpy(np.concatenate([each.points_right for each in records]))
        S = torch.from_numpy(np.concatenate([each.steps for each in records]))
        z = torch.from_numpy(np.concatenate([each.steps_right for each in records]))
        totals = np.zeros(2)
        for _ in range(recipe.updates):
            some = torch.from_numpy(rng.integers(len(X), size=recipe.batch_points))
            loss = point_loss(self.points(X[some]).squeeze(-1), y[some])
            totals[0] += loss.item()
            if len(S):
                some = torch.from_numpy(rng.integers(len(S), size=recipe.batch_steps))
                other = peel_loss(self.peel(S[some]).squeeze(-1), z[some])
                totals[1] += other.item()
                loss = loss + other
            self.optimiser.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            self.optimiser.step()
        means = totals / recipe.updates
        return float(means[0]), float(means[1])


def point_loss(logit: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Return the binary cross entropy of the point network."""
    loss: torch.Tensor = _torch().nn.functional.binary_cross_entropy_with_logits(logit, right)
    return loss


def peel_loss(logit: torch.Tensor, outside: torch.Tensor) -> torch.Tensor:
    """Return half the binary cross entropy, and that of the choice; `outside` is -1 in empty slots."""
    there = outside >= 0
    total: torch.Tensor = 0.5 * point_loss(logit[there], outside[there])
    everything = logit.masked_fill(~there, -1e9).logsumexp(dim=1)
    chosen = logit.masked_fill(outside != 1, -1e9).logsumexp(dim=1)
    open_choice = (outside == 1).any(dim=1) & (outside == 0).any(dim=1)
    choice = (everything - chosen)[open_choice]
    return total + choice.mean() if len(choice) else total


def train_search_networks(
    out: str | Path,
    *,
    seed: int = 0,
    families: Sequence[str] = FAMILIES,
    rounds: int = 40,
    resume: bool = True,
    recipe: Recipe | None = None,
    judge_every: int = 10,
    source: Source | None = None,
    progress: Callable[[TrainingProgress], object] | None = None,
) -> SearchNetworks:
    """Train a pair of networks for the learned search by self-imitation.

    Parameters
    ----------
    out
        A folder: ``search.safetensors`` there is the pair after the last round, ``checkpoint.pt`` all that is
        needed to go on. Both are replaced atomically after each round.
    seed
        Seeds everything: the same seed makes the same networks, on the same machine.
    families
        Which families of `FAMILIES` are trained on.
    rounds
        How many rounds are made in all.
    resume
        Go on from a checkpoint in `out`, if there is one of the same seed, families, rounds and recipe.
    recipe
        All other settings; None for the defaults.
    judge_every
        After so many rounds, and after the last, the mean gap on held-out problems is measured; 0 for never.
    source
        Draws a problem and its threshold from a generator; None for made problems of the families.
    progress
        Called after each round; a true return value stops the training there, to be resumed.

    Returns
    -------
    SearchNetworks
        The pair as it stands.

    Raises
    ------
    ValueError
        If `rounds` is less than 1, or a family is unknown, or the checkpoint belongs to another training.
    ImportError
        If torch is not installed: the extra "train" brings it.
    """
    recipe = Recipe() if recipe is None else recipe
    if rounds < 1:
        raise ValueError(f"rounds must be at least 1, but it is {rounds}")
    unknown = sorted(set(families) - set(FAMILIES))
    if unknown or not families:
        raise ValueError(f"families must be some of {', '.join(FAMILIES)}, but they are {list(families)}")
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    described = json.dumps(
        {"seed": seed, "families": list(families), "rounds": rounds, "recipe": asdict(recipe)}, sort_keys=True
    )
    if recipe.labels not in ("best", "optima"):
        raise ValueError(f"labels of the recipe must be 'best' or 'optima', but it is {recipe.labels!r}")

    def made(rng: np.random.Generator) -> tuple[LinearProblem, float]:
        return draw_problem(families, rng, recipe.ranges)

    start_rng = np.random.default_rng([seed, 0])
    first = SearchNetworks(
        random_perceptron((N_POINT_FEATURES, *recipe.point_widths, 1), start_rng),
        random_perceptron((N_PEEL_FEATURES, *recipe.peel_widths, 1), start_rng),
    )
    learner = Learner(first, recipe)
    kept: deque[Records] = deque(maxlen=recipe.replayed)
    done, seconds = 0, 0.0
    if resume:
        done, seconds = _restore(folder, described, learner, kept)
    began = time.perf_counter() - seconds
    while done < rounds:
        rng = np.random.default_rng([seed, 1, done])
        records, gained = _play_round(learner.networks(), source or made, recipe, rng)
        kept.append(records)
        losses = learner.learn(list(kept), done / max(rounds - 1, 1), rng)
        done += 1
        judged = judge_every > 0 and (done == rounds or done % judge_every == 0)
        held_out = held_out_gaps(learner.networks(), families) if judged else None
        seconds = time.perf_counter() - began
        save_search_networks(learner.networks(), folder / "search.safetensors", {"training": described})
        _keep(folder, described, learner, kept, done, seconds)
        if progress is not None and progress(TrainingProgress(done, rounds, *losses, gained, seconds, held_out)):
            break
    return learner.networks()


def _play_round(
    nets: SearchNetworks, source: Source, recipe: Recipe, rng: np.random.Generator
) -> tuple[Records, float]:
    recorder = Recorder()
    gained = 0
    for _ in range(recipe.fits):
        problem, threshold = source(rng)
        optimum = proven_optimum(problem, threshold, PROOF_SECONDS) if recipe.labels == "optima" else None
        label = best_known(problem, threshold, recipe.samples, rng, nets, recipe.label_rounds)
        label = label if optimum is None else optimum
        task = make_task(problem, threshold, rng)
        rounds = int(rng.integers(recipe.play_rounds[0], recipe.play_rounds[1] + 1))
        known, found = recorder.fit(task, nets, label, random_settings(rng, recipe.explore), rounds)
        gained += found - known
    return recorder.records(), gained / recipe.fits


#: Held-out cells: family, N, outlier rate. Hard enough that networks differ.
HELD_OUT = (
    ("line", 100, 0.9),
    ("plane", 100, 0.85),
    ("hyperplane", 100, 0.75),
    ("fundamental", 100, 0.6),
    ("fundamental-F32", 100, 0.6),
)


def held_out_gaps(
    nets: SearchNetworks, families: Sequence[str], instances: int = 24, budget: float = 0.003
) -> dict[str, float]:
    """Return the mean lack of inliers at a fixed time, by family, against 30 times that time and the classics."""
    gaps = {}
    for family, n_points, rate in HELD_OUT:
        if family not in families:
            continue
        lacks = []
        for number in range(instances):
            problem, threshold = make_problem(family, np.random.default_rng([number, 77]), n_points, rate)
            known = int(best_known(problem, threshold, 2000, np.random.default_rng(number), None, 0).sum())
            sizes = []
            for limit in (budget, 30 * budget):
                task = make_task(problem, threshold, np.random.default_rng(number), limit)
                sizes.append(run(task, learned(task, network=nets), swap_refinement).size)
            lacks.append(max(known, sizes[1]) - sizes[0])
        gaps[family] = float(np.mean(lacks))
    return gaps


def _torch() -> Any:
    try:
        import torch  # noqa: PLC0415
    except ImportError as error:  # pragma: no cover - the tests run with the extra
        raise ImportError("training needs torch: pip install 'maxcon[train]'") from error
    return torch


def _module(net: Perceptron) -> Any:
    torch = _torch()
    parts: list[Any] = []
    for matrix, bias in layers(net):
        linear = torch.nn.Linear(*matrix.shape)
        with torch.no_grad():
            linear.weight.copy_(torch.from_numpy(matrix.T))
            linear.bias.copy_(torch.from_numpy(bias))
        parts += [linear, torch.nn.LeakyReLU(LEAK)]
    return torch.nn.Sequential(*parts[:-1])


def _plain(module: Any) -> Perceptron:
    linear = [part for part in module if hasattr(part, "weight")]
    return perceptron(
        [part.weight.detach().numpy().T.astype(np.float64) for part in linear],
        [part.bias.detach().numpy().astype(np.float64) for part in linear],
    )


def _keep(folder: Path, described: str, learner: Learner, kept: deque[Records], done: int, seconds: float) -> None:
    torch = _torch()
    state = {
        "described": described,
        "done": done,
        "seconds": seconds,
        "points": learner.points.state_dict(),
        "peel": learner.peel.state_dict(),
        "optimiser": learner.optimiser.state_dict(),
        "records": [{name: torch.from_numpy(value) for name, value in vars(each).items()} for each in kept],
    }
    part = folder / "checkpoint.part"
    torch.save(state, part)
    os.replace(part, folder / "checkpoint.pt")


def _restore(folder: Path, described: str, learner: Learner, kept: deque[Records]) -> tuple[int, float]:
    torch = _torch()
    path = folder / "checkpoint.pt"
    if not path.exists():
        return 0, 0.0
    state = torch.load(path, weights_only=True)
    if state["described"] != described:
        raise ValueError(
            f"out must be a folder of the same training, or hold none, but {str(path)!r} belongs to "
            f"{state['described']}: pass resume=False to start anew"
        )
    learner.points.load_state_dict(state["points"])
    learner.peel.load_state_dict(state["peel"])
    learner.optimiser.load_state_dict(state["optimiser"])
    kept.extend(Records(**{name: value.numpy() for name, value in each.items()}) for each in state["records"])
    return int(state["done"]), float(state["seconds"])
