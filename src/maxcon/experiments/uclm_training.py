"""Training of UCLM (Probst et al. 2019), the unsupervised baseline of the paper's section 4, as a run in a folder.

``python -m maxcon.experiments.uclm_training FAMILY --seed 0 --updates N --out DIR`` makes ``DIR/FAMILY.safetensors``.

*The loss.* For weights w of the N points of a problem, M = [A, -b] (whitened rows, in thresholds) is its Vandermonde
matrix: its last singular value is 0 where one model explains all points. The publication maximises the number of
inliers, sum(w), against the smallest singular values of diag(w) M; where one equation is asked of each point, as here,
that is one value, s(w). In its plainest form, ``-mean(w) + lambda s(w)``, that has a trap: both terms are proportional
to w, so that wherever lambda s > mean(w), as on our data at the start, shrinking all weights to 0 pays. (The paper says
of UCLM that it "requires a certain supervised signal in order to work effectively".) What was tried before this loss
was chosen is in the model cards. The trade-off is taken in logarithms, with a floor where residuals are small enough:

    L(w) = -log mean(w) + beta / 2 log(s(w)^2 / N + c^2),      beta = 0.7, c = 0.5 thresholds.

Its gradient is that of the plain loss with a lambda that each problem sets for itself, beta mean(w) s / (s^2 + N c^2),
up to a factor. As beta < 1, weights near 0 do not pay; as c > 0, neither does a handful of points fitted exactly.
There are no labels and no ground truth in it.

The gradient of s is exact: ds/dw_i = w_i (m_i . v)^2 / s for the last right singular vector v of diag(w) M.

*Data*: problems drawn once from the seed: the paper's lines and planes with N = 100 and 1-60% outliers; fundamental
matrices of made scenes with N = 100, 10-50% outliers and threshold 0.1, half of them in the chart "auto", half in
"F32=1". (The chart "auto" is placed by a robust estimate; neither network nor loss sees where it lies, as b is taken
less its least-squares fit.)
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from maxcon.agent.uclm import CONTEXT_FLOOR, LEAK, UclmNetwork, describe_points, layer_shapes, save_uclm
from maxcon.experiments.search_instances import make_problem
from maxcon.search.anytime import Task, make_task

if TYPE_CHECKING:
    from torch import Tensor

#: Parameters (d) of each family, and the range of its outlier rates.
FAMILIES: dict[str, int] = {"line": 2, "plane": 3, "fundamental": 8}
RATES: dict[str, tuple[float, float]] = {"line": (0.01, 0.6), "plane": (0.01, 0.6), "fundamental": (0.1, 0.5)}


@dataclass(frozen=True)
class UclmRecipe:
    """The settings of a training.

    Attributes
    ----------
    n_points, n_instances
        N, and how many problems are drawn.
    batch, width
        Problems of a batch; channels of a hidden layer.
    rate, last_rate
        Adam's learning rate, falling geometrically from the first to the last over the updates.
    loss
        "log", or "plain" for ``-mean(w) + trade_off s(w) / sqrt(N)``, which is there to be compared with.
    trade_off, floor
        beta and c of the loss.
    clip
        The largest norm of a gradient.
    """

    n_points: int = 100
    n_instances: int = 16_000
    batch: int = 32
    width: int = 48
    rate: float = 2e-3
    last_rate: float = 4e-5
    loss: str = "log"
    trade_off: float = 0.7
    floor: float = 0.5
    clip: float = 1.0


@dataclass(frozen=True)
class UclmProgress:
    """What a progress callback is told: means since the last report."""

    updates: int
    total: int
    loss: float
    singular_value: float
    weight: float
    seconds: float


def draw_problem(family: str, rng: np.random.Generator, n_points: int, rate: float) -> tuple[Any, float]:
    """Return a problem of the family and its threshold; the chart of a fundamental matrix is drawn."""
    if family not in FAMILIES:
        raise ValueError(f"family must be one of {', '.join(FAMILIES)}, but it is {family!r}")
    name = "fundamental-F32" if family == "fundamental" and rng.random() < 0.5 else family
    return make_problem(name, rng, n_points, rate)


def training_data(family: str, seed: int, recipe: UclmRecipe) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    """Return what the network is told, shape (M, N, d + 4), and the Vandermonde matrices, (M, N, d + 1), in thresholds.

    Drawn by ``default_rng([seed, 1])``.
    """
    rng = np.random.default_rng([seed, 1])
    d, N, M = FAMILIES[family], recipe.n_points, recipe.n_instances
    inputs = np.empty((M, N, layer_shapes(d, recipe.width)["first"][0]), dtype=np.float32)
    matrices = np.zeros((M, N, d + 1))
    for number in range(M):
        problem, threshold = draw_problem(family, rng, N, float(rng.uniform(*RATES[family])))
        task = make_task(problem, threshold, rng)
        inputs[number] = describe_points(problem, task.rows, task.limit)
        matrix = vandermonde(task)
        matrices[number, :, : matrix.shape[1] - 1] = matrix[:, :-1]
        matrices[number, :, -1] = matrix[:, -1]
    return inputs, matrices


def vandermonde(task: Task) -> NDArray[np.float64]:
    """Return [A, -b], shape (N, r + 1): whitened rows, in thresholds."""
    return np.column_stack([task.rows.At.T, -task.rows.b]) / task.limit


def train_uclm(
    family: str,
    out: str | Path,
    *,
    seed: int = 0,
    updates: int = 10_000,
    progress: Callable[[UclmProgress], object] | None = None,
    recipe: UclmRecipe | None = None,
    report_every: int = 100,
    checkpoint_seconds: float = 20.0,
) -> UclmNetwork:
    """Train a network, or go on with the training that the folder `out` holds; return it where it stands.

    The folder gets ``config.json``, ``checkpoint.pt`` (everything that changes, replaced atomically) and, in the end,
    ``FAMILY.safetensors``. A run that was killed, or stopped by Ctrl-C, loses at most `checkpoint_seconds`; called
    again it goes on, to the same network as if it had never been stopped.

    Parameters
    ----------
    family
        "line", "plane" or "fundamental".
    out
        The folder of the run.
    seed
        Decides data, first weights and batches.
    updates
        How many gradient steps.
    progress
        Called every `report_every` updates; a true return value stops the training, as Ctrl-C does.
    recipe
        The other settings; None for those of the shipped networks.
    report_every
        Updates between two calls of `progress`.
    checkpoint_seconds
        Seconds between two checkpoints.

    Raises
    ------
    ValueError
        If an argument is out of its range, or the folder holds a run with other settings.
    ImportError
        If there is no torch.
    """
    if family not in FAMILIES:
        raise ValueError(f"family must be one of {', '.join(FAMILIES)}, but it is {family!r}")
    if isinstance(updates, bool) or not isinstance(updates, int) or updates < 1:
        raise ValueError(f"updates must be a positive integer, but it is {updates!r}")
    if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
        raise ValueError(f"seed must be a non-negative integer, but it is {seed!r}")
    torch = _torch()
    out = Path(out)
    recipe = UclmRecipe() if recipe is None else recipe
    if recipe.loss not in {"log", "plain"}:
        raise ValueError(f"loss must be 'log' or 'plain', but it is {recipe.loss!r}")
    out.mkdir(parents=True, exist_ok=True)
    _claim(out / "config.json", {"family": family, "seed": seed, "updates": updates, **asdict(recipe)})
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        run = _Run(family, seed, recipe)
        if (out / "checkpoint.pt").exists():
            run.load(out / "checkpoint.pt")
        try:
            _go_on(run, updates, progress, report_every, checkpoint_seconds, out / "checkpoint.pt")
        finally:
            if not run.half_done:
                run.save(out / "checkpoint.pt")
        network = run.network()
        if run.updates >= updates:
            notes = {"family": family, "seed": str(seed), "updates": str(updates)}
            save_uclm(network, out / f"{family}.safetensors", notes)
        return network
    finally:
        torch.set_num_threads(threads)


def _go_on(
    run: _Run,
    total: int,
    progress: Callable[[UclmProgress], object] | None,
    report_every: int,
    checkpoint_seconds: float,
    path: Path,
) -> None:
    began = saved = time.perf_counter()
    seen: list[tuple[float, float, float]] = []
    try:
        while run.updates < total:
            seen.append(run.update(total))
            now = time.perf_counter()
            if progress is not None and (run.updates % report_every == 0 or run.updates == total):
                loss, value, weight = np.mean(seen, axis=0)
                seen.clear()
                if progress(UclmProgress(run.updates, total, loss, value, weight, now - began)):
                    return
            if now - saved > checkpoint_seconds:
                run.save(path)
                saved = now
    except KeyboardInterrupt:
        return


class _Run:
    """Everything that changes during a training: weights, the optimiser's memory, the random state."""

    def __init__(self, family: str, seed: int, recipe: UclmRecipe) -> None:
        torch = _torch()
        self.family, self.recipe = family, recipe
        inputs, matrices = training_data(family, seed, recipe)
        self.inputs, self.matrices = torch.from_numpy(inputs), torch.from_numpy(matrices)
        self.rng = np.random.default_rng([seed, 3])
        self.parameters = first_parameters(FAMILIES[family], recipe.width, np.random.default_rng([seed, 0]))
        self.optimiser = torch.optim.Adam(list(self.parameters.values()), lr=recipe.rate)
        self.updates = 0
        self.half_done = False  # where Ctrl-C falls into an update, what it leaves is not to be kept

    def update(self, total: int) -> tuple[float, float, float]:
        """Make one gradient step; return the loss, the smallest singular value by sqrt(N), and the mean weight."""
        torch, recipe = _torch(), self.recipe
        self.half_done = True
        for group in self.optimiser.param_groups:
            group["lr"] = recipe.rate * (recipe.last_rate / recipe.rate) ** (self.updates / total)
        chosen = torch.from_numpy(self.rng.integers(0, len(self.inputs), recipe.batch))
        weights = torch.sigmoid(forward(self.parameters, self.inputs[chosen]).double())
        value = smallest_singular_value(weights, self.matrices[chosen])
        loss: Any = consensus_loss(weights, value, recipe).mean()
        self.optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(list(self.parameters.values()), recipe.clip)
        self.optimiser.step()
        self.updates += 1
        self.half_done = False
        return loss.item(), value.mean().item() / recipe.n_points**0.5, weights.mean().item()

    def network(self) -> UclmNetwork:
        """Return the network as it stands."""
        tensors = {name: value.detach().numpy().copy() for name, value in self.parameters.items()}
        return UclmNetwork(FAMILIES[self.family], self.recipe.width, tensors)

    def save(self, path: Path) -> None:
        """Write everything that changes; a kill at any moment leaves the old file or the new one."""
        state = {
            "updates": self.updates,
            "parameters": {name: value.detach() for name, value in self.parameters.items()},
            "optimiser": self.optimiser.state_dict(),
            "rng": self.rng.bit_generator.state,
        }
        part = path.with_suffix(".part")
        _torch().save(state, part)
        os.replace(part, path)

    def load(self, path: Path) -> None:
        """Put the run back where `save` found it."""
        torch = _torch()
        state = torch.load(path, weights_only=True)
        self.updates = state["updates"]
        with torch.no_grad():
            for name, value in state["parameters"].items():
                self.parameters[name].copy_(value)
        self.optimiser.load_state_dict(state["optimiser"])
        self.rng.bit_generator.state = state["rng"]


def first_parameters(n_params: int, width: int, rng: np.random.Generator) -> dict[str, Tensor]:
    """Return random weights of He's scale (He et al. 2015); the weight of a point starts near sigmoid(1) = 0.73."""
    torch = _torch()
    parameters = {}
    for name, (inputs, outputs) in layer_shapes(n_params, width).items():
        matrix = rng.normal(0.0, np.sqrt(2.0 / inputs), (inputs, outputs)).astype(np.float32)
        bias = np.full(outputs, 1.0 if name == "weight" else 0.0, dtype=np.float32)
        parameters[f"{name}.matrix"] = torch.from_numpy(matrix).requires_grad_()
        parameters[f"{name}.bias"] = torch.from_numpy(bias).requires_grad_()
    return parameters


def forward(parameters: dict[str, Tensor], inputs: Tensor) -> Tensor:
    """Return the logits, shape (batch, N), of `inputs`, shape (batch, N, d + 4): `UclmNetwork.logits` in torch."""
    torch = _torch()

    def affine(x: Tensor, layer: str) -> Tensor:
        return x @ parameters[f"{layer}.matrix"] + parameters[f"{layer}.bias"]

    def context(x: Tensor) -> Tensor:
        centred = x - x.mean(dim=1, keepdim=True)
        # The tiny addition keeps the gradient finite where a channel is the same for all points.
        spread: Tensor = torch.sqrt((centred * centred).mean(dim=1, keepdim=True) + 1e-20)
        return centred / (spread + CONTEXT_FLOOR)

    def hidden(x: Tensor) -> Tensor:
        activated: Tensor = torch.nn.functional.leaky_relu(x, LEAK)
        return activated

    near = hidden(context(affine(inputs, "first")))
    near = hidden(context(affine(near, "second")))
    far = hidden(context(affine(near, "third")))
    scene = affine(far.amax(dim=1), "scene")
    x = hidden(context(affine(torch.cat([near, far], dim=2), "local")) + scene[:, None])
    x = x + hidden(context(affine(x, "fifth")))
    x = x + hidden(context(affine(x, "sixth")))
    return affine(x, "weight")[..., 0]


def smallest_singular_value(weights: Tensor, matrices: Tensor) -> Tensor:
    """Return the smallest singular value of ``diag(w) M``, shape (batch,), with its exact gradient by the weights.

    Parameters
    ----------
    weights, matrices
        Shapes (batch, N) and (batch, N, k), float64.

    Notes
    -----
    With the last right singular vector v held fixed, ``|diag(w) M v|`` has the value and, as v minimises it, the
    gradient of the singular value. That spares the gradient of the decomposition, which is not finite where singular
    values coincide.
    """
    torch = _torch()
    with torch.no_grad():
        weighted = weights[..., None] * matrices
        vector = torch.linalg.eigh(weighted.transpose(1, 2) @ weighted)[1][..., :1]
    value: Tensor = torch.sqrt(((weights * (matrices @ vector)[..., 0]) ** 2).sum(dim=1) + 1e-24)
    return value


def consensus_loss(weights: Tensor, value: Tensor, recipe: UclmRecipe) -> Tensor:
    """Return the loss of each problem (see the module's text), shape (batch,), for `value` = s(w) in thresholds."""
    torch = _torch()
    square = value * value / weights.shape[1]
    if recipe.loss == "plain":
        plain: Tensor = -weights.mean(dim=1) + recipe.trade_off * torch.sqrt(square)
        return plain
    residual = square + recipe.floor * recipe.floor
    logarithmic: Tensor = -torch.log(weights.mean(dim=1) + 1e-12) + 0.5 * recipe.trade_off * torch.log(residual)
    return logarithmic


def _claim(path: Path, config: dict[str, Any]) -> None:
    """Write the settings into a new run folder, or make sure that an old one has the same."""
    if not path.exists():
        part = path.with_suffix(".part")
        part.write_text(json.dumps(config, indent=2, sort_keys=True), encoding="utf-8")
        os.replace(part, path)
        return
    before = json.loads(path.read_text(encoding="utf-8"))
    for name, value in config.items():
        if before.get(name) != value:
            raise ValueError(
                f"out must be a new folder or one of a run with the same settings, but in {path} {name} is "
                f"{before.get(name)}, not {value}"
            )


def _torch() -> Any:
    try:
        import torch  # noqa: PLC0415
    except ImportError as error:  # pragma: no cover - the tests run with the extra
        raise ImportError("training needs torch: pip install 'maxcon[train]'") from error
    return torch


def main() -> None:
    """Train from the command line."""
    parser = argparse.ArgumentParser(prog="python -m maxcon.experiments.uclm_training", description=__doc__)
    parser.add_argument("family", choices=list(FAMILIES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--updates", type=int, default=10_000)
    parser.add_argument("--width", type=int, default=UclmRecipe.width, help="channels of a hidden layer")
    parser.add_argument("--loss", choices=["log", "plain"], default="log")
    parser.add_argument("--trade-off", type=float, help="beta of the loss log (default 0.7), lambda of plain (1)")
    parser.add_argument("--out", type=Path, required=True, help="the folder of the run")
    given = parser.parse_args()

    def show(news: UclmProgress) -> None:
        print(
            f"{given.family} {news.updates}/{news.total} updates, {news.seconds:.0f} s: loss {news.loss:.3f}, "
            f"singular value {news.singular_value:.3f}, mean weight {news.weight:.3f}",
            flush=True,
        )

    trade_off = given.trade_off if given.trade_off is not None else 0.7 if given.loss == "log" else 1.0
    recipe = UclmRecipe(loss=given.loss, trade_off=trade_off, width=given.width)
    train_uclm(given.family, given.out, seed=given.seed, updates=given.updates, progress=show, recipe=recipe)


if __name__ == "__main__":
    main()
