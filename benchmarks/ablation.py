"""What each part of the learned search brings: the search as shipped beside itself without one of its parts.

    python benchmarks/ablation.py                        # networks and settings, a minute
    python benchmarks/ablation.py --cells hyperplane:100:0.75 --variants "no walks down" "no variations"
    python benchmarks/ablation.py --train runs/ablation  # and ten pairs of networks, a minute of training each
    python benchmarks/ablation.py --fit-rule             # where the coefficients of the linear point rule come from

All variants run in the same compiled search. Networks are left out by putting a hand-made perceptron of one layer in
their place, parts of a round by its settings. Features are left out in training: the first layer's weights of a group
are zero and stay so; such networks, and linear ones, are compared with a pair of the same rounds and seed.

On each problem (the held-out ones of benchmarks/learned.py) all variants run one after another in random order; the
first run on a problem is slower, so one is discarded. The best known of a problem is the best of all variants at
all budgets and of a long run as shipped. Printed: the mean gap to it, and in brackets the mean difference to the
reference on the same problems, with its standard error. The last rows are means over cells, which count alike.
The search as shipped runs twice: the difference between the two is what the clock alone does.
"""

from __future__ import annotations

import os

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_name] = "1"

import argparse  # noqa: E402
import json  # noqa: E402
import platform  # noqa: E402
import time  # noqa: E402
from collections.abc import Sequence  # noqa: E402
from functools import partial  # noqa: E402
from pathlib import Path  # noqa: E402
from typing import Any, NamedTuple  # noqa: E402
from unittest import mock  # noqa: E402

import numpy as np  # noqa: E402
from numpy.typing import NDArray  # noqa: E402

from learned import Method, fit  # noqa: E402
from maxcon.agent import peel_features, point_features  # noqa: E402
from maxcon.agent.perceptron import Perceptron, perceptron  # noqa: E402
from maxcon.agent.search_networks import SearchNetworks, shipped_search_networks  # noqa: E402
from maxcon.experiments import self_imitation  # noqa: E402
from maxcon.experiments.played_fits import Recorder, best_known  # noqa: E402
from maxcon.experiments.search_instances import FAMILIES, Ranges, draw_problem, make_problem  # noqa: E402
from maxcon.experiments.self_imitation import Learner, Recipe, train_search_networks  # noqa: E402
from maxcon.minimax.clock import processor_time  # noqa: E402
from maxcon.search.anytime import make_task  # noqa: E402
from maxcon.search.learned import learned  # noqa: E402
from maxcon.search.learned_settings import Settings  # noqa: E402

CELLS = (
    "hyperplane:100:0.75",
    "fundamental:100:0.6",
    "fundamental:200:0.7",
    "fundamental-F32:100:0.7",
    "fundamental:1000:0.5",
)

#: The linear point rule: a logistic regression on what the search sees, printed by --fit-rule.
RULE = {
    "size of the Geman-McClure residual": -0.428,
    "refined votes, soft": 2.805,
    "refined votes, sharp": -1.025,
    "size of the incumbent residual": -0.926,
    "member of the incumbent": 1.741,
}
RULE_BIAS = -0.704

#: Features of the two networks by group, as training leaves them out.
POINT_GROUPS = {"root": (0, 1, 2, 3, 4), "votes": (5, 6, 7), "incumbent": (8, 9, 10, 11, 12)}
PEEL_GROUPS = {"multiplier": (2,), "proposal": (3, 4, 9, 10), "belief": (5, 6), "incumbent": (7, 8)}

SHIPPED = "as shipped"


class Variant(NamedTuple):
    """A search: its networks and settings, and what it is compared with."""

    networks: SearchNetworks
    settings: Settings = Settings()
    reference: str = SHIPPED

    def method(self) -> Method:
        """Return the search as `fit` takes it."""
        return partial(learned, network=self.networks, settings=self.settings)


def linear(names: Sequence[str], coefficients: dict[str, float], bias: float = 0.0) -> Perceptron:
    """Return the perceptron of one layer with these coefficients; its other inputs count nothing."""
    matrix = np.zeros((len(names), 1))
    for name, value in coefficients.items():
        matrix[names.index(name), 0] = value
    return perceptron([matrix], [np.array([bias])])


def variants() -> dict[str, Variant]:
    """Return the search as shipped and its variants that need no training."""
    shipped = shipped_search_networks()
    points, peel = point_features.POINT_FEATURES, peel_features.PEEL_FEATURES
    rule = linear(points, RULE, RULE_BIAS)
    by_belief = linear(peel, {"logit of the point": -1.0})
    by_multiplier = linear(peel, {"dual multiplier": 1.0})
    settings = Settings()
    return {
        SHIPPED: Variant(shipped),
        "as shipped, again": Variant(shipped),  # how far the clock alone moves a mean
        "points: linear rule": Variant(shipped._replace(points=rule)),
        # Uniform samples; and since the belief never agrees with anything, no variations and one swap in the end.
        "points: all alike": Variant(shipped._replace(points=linear(points, {}))),
        "peel: least belief": Variant(shipped._replace(peel=by_belief)),
        "peel: largest multiplier": Variant(shipped._replace(peel=by_multiplier)),
        "peel: as they come": Variant(shipped._replace(peel=linear(peel, {}))),
        # With exploration the incumbent's own points may be removed, too, on the walk from it.
        "peel: at random": Variant(shipped, settings._replace(explore=1.0)),
        "long walks": Variant(shipped, settings._replace(reach=2.5)),
        "long walks, belief": Variant(shipped._replace(peel=by_belief), settings._replace(reach=2.5), "long walks"),
        "long walks, at random": Variant(shipped, settings._replace(reach=2.5, explore=1.0), "long walks"),
        "neither network": Variant(SearchNetworks(rule, by_belief)),
        # What lies within the limit of a model is feasible: nothing is removed, points are added back at once.
        "no walks down": Variant(shipped, settings._replace(reach=1.0)),
        "no variations": Variant(shipped, settings._replace(variations=0)),
        "no points from outside": Variant(shipped, settings._replace(foreign=0)),
        "all variations refined": Variant(shipped, settings._replace(straight=0.0)),
        "one proposal refined": Variant(shipped, settings._replace(refined=1)),
        "few samples": Variant(shipped, settings._replace(samples=10)),
        "nothing forgotten": Variant(shipped, settings._replace(patience=2**31 - 1)),
        "no softening": Variant(shipped, settings._replace(soften=0.0)),
        # Variations and swaps wait for an agreement that never comes; the last swap is made all the same.
        "no agreement": Variant(shipped, settings._replace(agreed=2.0)),
    }


class MaskedLearner(Learner):
    """A learner whose networks do not see some of their inputs."""

    def __init__(self, nets: SearchNetworks, recipe: Recipe, points: Sequence[int], peel: Sequence[int]) -> None:
        super().__init__(nets, recipe)
        for module, hidden in ((self.points, points), (self.peel, peel)):
            weight = module[0].weight  # (outputs, inputs)
            seen = weight.detach().new_ones(weight.shape)
            seen[:, list(hidden)] = 0.0
            weight.data.mul_(seen)
            weight.register_hook(seen.mul)  # Adam leaves alone what never has a gradient


def trained(folder: Path, rounds: int, seed: int, wanted: Sequence[str] | None) -> dict[str, Variant]:
    """Return variants that were trained for so many rounds; what `folder` does not hold yet is trained now."""
    none: Sequence[int] = ()
    whole = f"{rounds} rounds"
    recipes = {whole: (Recipe(), none, none)}
    recipes |= {f"{whole}, no {name}": (Recipe(), rows, none) for name, rows in POINT_GROUPS.items()}
    recipes |= {f"{whole}, peel no {name}": (Recipe(), none, rows) for name, rows in PEEL_GROUPS.items()}
    recipes[f"{whole}, linear points"] = (Recipe(point_widths=()), none, none)
    recipes[f"{whole}, linear peel"] = (Recipe(peel_widths=()), none, none)
    found = {}
    for name, (recipe, points, peel) in recipes.items():
        if wanted is not None and name not in {whole, *wanted}:
            continue
        place = folder / name.replace(", ", "-").replace(" ", "-")
        began = time.monotonic()
        with mock.patch.object(self_imitation, "Learner", partial(MaskedLearner, points=points, peel=peel)):
            nets = train_search_networks(place, seed=seed, rounds=rounds, recipe=recipe, judge_every=0)
        print(f"{name}: {time.monotonic() - began:.0f} s", flush=True)
        found[name] = Variant(nets, reference=whole)
    return found


def judge(cell: str, table: dict[str, Variant], options: argparse.Namespace) -> list[dict[str, Any]]:
    """Run all variants on the problems of a cell; return a record a run."""
    family, n_points, rate = cell.split(":")
    names = list(table)
    searches = {name: variant.method() for name, variant in table.items()}
    records = []
    for number in range(options.instances):
        stream = np.random.default_rng([options.seed, number])
        problem, threshold = make_problem(family, stream, int(n_points), float(rate))
        fit(problem, threshold, searches[SHIPPED], 1e-3 * max(options.budgets), 999)
        known, _, _ = fit(problem, threshold, searches[SHIPPED], options.long, 1000)
        rows = []
        for budget, seed in ((b, s) for b in options.budgets for s in range(options.seeds)):
            for name in stream.permutation(names).tolist():
                size, seconds, _ = fit(problem, threshold, searches[name], 1e-3 * budget, seed)
                known = max(known, size)
                rows.append({"cell": cell, "instance": number, "variant": name, "budget": budget, "seed": seed})
                rows[-1] |= {"size": size, "ms": 1e3 * seconds}
        records += [row | {"gap": known - row["size"], "known": known} for row in rows]
    return records


def gaps(records: list[dict[str, Any]], cell: str, name: str, budget: float) -> NDArray[np.float64]:
    """Return the mean gap over the seeds of each problem of a cell."""
    by_instance: dict[int, list[int]] = {}
    for row in records:
        if row["cell"] == cell and row["variant"] == name and row["budget"] == budget:
            by_instance.setdefault(row["instance"], []).append(row["gap"])
    return np.array([np.mean(by_instance[number]) for number in sorted(by_instance)])


def error(values: NDArray[np.float64]) -> float:
    """Return the standard error of the mean."""
    return float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0


def show(title: str, cells: Sequence[str], records: list[dict[str, Any]], table: dict[str, Variant]) -> None:
    """Print the means over some cells, each variant in a line."""
    budgets = list(dict.fromkeys(row["budget"] for row in records))
    print(f"\n{title:32}" + "".join(f"{budget:10g} ms{'':13}" for budget in budgets))
    for name, variant in table.items():
        text = f"  {name:30}"
        for budget in budgets:
            mine = [gaps(records, cell, name, budget) for cell in cells]
            text += f"{np.mean([each.mean() for each in mine]):8.2f}"
            if name == variant.reference:
                text += f"{'':17}"
                continue
            beside = [gaps(records, cell, variant.reference, budget) for cell in cells]
            differences = [one - other for one, other in zip(mine, beside, strict=True)]
            mean = np.mean([each.mean() for each in differences])
            spread = np.sqrt(np.sum([error(each) ** 2 for each in differences])) / len(cells)
            text += f" ({mean:+6.2f} +-{spread:4.2f})"
        print(text)
    taken = [np.mean([row["ms"] for row in records if row["cell"] in cells and row["budget"] == b]) for b in budgets]
    print(f"  {'time taken, ms':30}" + "".join(f"{each:8.2f}{'':17}" for each in taken), flush=True)


def fit_rule(fits: int, seed: int) -> tuple[dict[str, float], float]:
    """Return the coefficients and the bias of the logistic regression behind `RULE`.

    Half of the records are of searches as shipped, half of searches by the first half's rule.
    """
    names = point_features.POINT_FEATURES
    rows = [names.index(name) for name in RULE]
    shipped, recorder, recipe = shipped_search_networks(), Recorder(), Recipe(explore=0.0)
    nets, rng = shipped, np.random.default_rng([seed, 2])
    for number in range(fits):
        problem, threshold = draw_problem(FAMILIES, rng, Ranges())
        label = best_known(problem, threshold, recipe.samples, rng, shipped, recipe.label_rounds)
        recorder.fit(make_task(problem, threshold, rng), nets, label, Settings(), int(rng.integers(3, 10)))
        if 2 * (number + 1) in (fits, 2 * fits):
            records = recorder.records()
            beta = logistic(records.points[:, rows].astype(np.float64), records.points_right.astype(np.float64))
            rule = dict(zip(RULE, beta[1:].tolist(), strict=True))
            nets = shipped._replace(points=linear(names, rule, float(beta[0])))
    return rule, float(beta[0])


def logistic(X: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bias and the coefficients of a logistic regression, by Newton's method."""
    X = np.column_stack([np.ones(len(X)), X])
    beta = np.zeros(X.shape[1])
    for _ in range(30):
        p = 1.0 / (1.0 + np.exp(-X @ beta))
        beta += np.linalg.solve(X.T @ (X * (p * (1.0 - p))[:, None]) + 1e-3 * np.eye(len(beta)), X.T @ (y - p))
    return beta


def main() -> None:
    parser = argparse.ArgumentParser(description="Mean gap of the learned search without one of its parts.")
    parser.add_argument("--cells", nargs="+", default=CELLS)
    parser.add_argument("--variants", nargs="+", default=None, help="these only, and what they are compared with")
    parser.add_argument("--budgets", nargs="+", type=float, default=[1.0, 3.0, 10.0], help="ms")
    parser.add_argument("--instances", type=int, default=24)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--seed", type=int, default=20_000, help="of the problems; training never draws these")
    parser.add_argument("--long", type=float, default=0.1, help="seconds of the run that only sets the best known")
    parser.add_argument("--train", type=Path, default=None, help="folder of networks that this script trains")
    parser.add_argument("--rounds", type=int, default=20, help="of training")
    parser.add_argument("--train-seed", type=int, default=1)
    parser.add_argument("--fit-rule", action="store_true", help="print the linear point rule and stop")
    parser.add_argument("--cpu-time", action="store_true", help="the processor's time: for a shared machine")
    parser.add_argument("--out", type=Path, default=None, help="write all records there, JSON")
    options = parser.parse_args()
    if options.fit_rule:
        rule, bias = fit_rule(160, options.train_seed)
        print("\n".join(f"{value:8.3f}  {name}" for name, value in {**rule, "bias": bias}.items()))
        return
    table = variants()
    if options.train is not None:
        table |= trained(options.train, options.rounds, options.train_seed, options.variants)
    if options.variants is not None:
        unknown = sorted(set(options.variants) - set(table))
        if unknown:
            parser.error(f"--variants must be some of {', '.join(map(repr, table))}, not {unknown}")
        wanted = {SHIPPED, *options.variants, *(table[name].reference for name in options.variants)}
        table = {name: variant for name, variant in table.items() if name in wanted}
    with processor_time(options.cpu_time):
        compare(table, options)


def compare(table: dict[str, Variant], options: argparse.Namespace) -> None:
    print(f"{platform.processor() or platform.machine()}, one thread; {options.instances} x {options.seeds} a cell")
    records: list[dict[str, Any]] = []
    for cell in options.cells:
        found = judge(cell, table, options)
        records += found
        show(cell, [cell], found, table)
    few = [cell for cell in options.cells if int(cell.split(":")[1]) < 1000]
    if 1 < len(few) < len(options.cells):
        show("mean, N < 1000", few, records, table)
    if len(options.cells) > 1:
        show("mean", options.cells, records, table)
    if options.out is not None:
        options.out.write_text(json.dumps(records), encoding="utf-8")


if __name__ == "__main__":
    main()
