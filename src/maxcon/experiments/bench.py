"""The benchmark: all methods and the installed peers on the same instances, with the same time, under one residual.

Every method gets a budget of time on one core, on the wall's clock or on the processor's, from the problem (for
peers: from the data in the form that they take) to its model. On each instance the methods take their turns in random
order. What counts is how many points that model explains within the threshold, recounted here. The gap is the largest
consensus known minus that count.
"""

from __future__ import annotations

import functools
import gc
import inspect
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np

from maxcon.experiments.bench_calibration import Choice, calibrate, timed
from maxcon.experiments.bench_cells import CALIBRATION, WARM_UP, Cell, Instance, grid, make_instance
from maxcon.experiments.bench_peers import PEERS, Peer, installed, peer_names, peers_for
from maxcon.experiments.bench_records import BenchFile, Row, Unit, code_digest
from maxcon.experiments.distribution import distribute
from maxcon.experiments.records import processor, versions
from maxcon.fitting import METHODS, fit
from maxcon.minimax.clock import processor_time, read_clock
from maxcon.problem import Consensus, LinearProblem

#: More samples or tries than any budget has room for: only the time ends a search.
_ENDLESS = 10**9

#: Our methods, with what makes each of them use its time; "auto" and "exact" do by themselves.
OURS: Mapping[str, tuple[str, dict[str, Any]]] = {
    "auto": ("auto", {}),
    "learned": ("learned", {}),
    "exact": ("exact", {}),
    "lo-ransac": ("lo-ransac", {"samples": _ENDLESS}),
    "ransac": ("ransac", {"samples": _ENDLESS}),
    "gnc": ("gnc", {"restarts": None}),
    "peel": ("peel", {"restarts": None}),
    "peel-gnc": ("peel", {"restarts": None, "start": "gnc"}),
    "agent": ("agent", {"tries": _ENDLESS}),
    "uclm": ("uclm", {}),
    "random": ("random", {"tries": _ENDLESS}),
}

#: Those that run where nobody says which.
USUAL = ("auto", "learned", "exact", "lo-ransac", "ransac", "gnc", "peel", "peel-gnc", "agent", "uclm")

#: Those that set the best known where nothing is proven, with more time.
LONG = ("auto", "learned", "peel", "lo-ransac")

#: A run is flagged where it takes longer than its budget by this part and so many milliseconds.
LATE, LATE_MS = 0.2, 0.2

#: Points and outlier rate of the instances that warm up.
_WARM = (40, 50)


@dataclass(frozen=True)
class Settings:
    """What is run on what.

    Attributes
    ----------
    families, sizes, rates
        The grid, see `maxcon.experiments.bench_cells.grid`.
    budgets
        Milliseconds.
    methods
        Names of ours and of peers.
    instances, seeds
        How many instances a cell has, and how often each is fitted.
    seed
        Of the instances.
    proof_time, long_time
        Seconds of the exact method for the reference, and of each method that sets the best known where it fails.
    calibration
        How many instances a cell has for the calibration of the peers.
    jobs
        How many instances are run at a time; more than one disturb each other's times.
    cpu_time
        Whether the processor's time is counted, instead of that on the wall's clock.
    """

    families: tuple[str, ...] = ("line", "plane", "hyperplane", "fundamental", "fundamental-F32")
    sizes: tuple[int, ...] = (100, 200, 1000)
    rates: tuple[int, ...] | None = None
    budgets: tuple[float, ...] = (1.0, 3.0, 10.0, 100.0)
    methods: tuple[str, ...] = ()
    instances: int = 64
    seeds: int = 2
    seed: int = 0
    proof_time: float = 1.0
    long_time: float = 0.3
    calibration: int = 4
    jobs: int = 1
    cpu_time: bool = False

    def cells(self) -> tuple[Cell, ...]:
        """Return the grid."""
        return grid(self.families, self.sizes, self.rates)


def known_methods() -> tuple[str, ...]:
    """Return the names of all that can be asked for: our methods of this version, and all peers."""
    ours = [name for name, (method, _) in OURS.items() if method in METHODS]
    return tuple(dict.fromkeys([*ours, *METHODS, *peer_names()]))


def usual_methods() -> tuple[str, ...]:
    """Return the names of our usual methods in this version and of the peers that are installed."""
    peers = [each.name for each in PEERS if installed(each) is not None]
    return tuple(dict.fromkeys([*(name for name in USUAL if OURS[name][0] in METHODS), *peers]))


def absent_peers() -> dict[str, str]:
    """Return the peers that are not installed, with the package that brings each."""
    return {each.name: each.package for each in PEERS if installed(each) is None}


def header(settings: Settings) -> dict[str, Any]:
    """Return all that the records depend on."""
    found = {each.package: installed(each) for each in PEERS if each.name in settings.methods}
    return {
        "settings": asdict(settings),
        "versions": {**versions(), **{name: version for name, version in found.items() if version is not None}},
        "processor": processor(),
    }


def check_settings(settings: Settings) -> None:
    """Raise a ValueError that names what is out of its range.

    Raises
    ------
    ValueError
        If it is.
    ModuleNotFoundError
        If a peer was asked for that is not installed; the message says how to install it.
    """
    settings.cells()
    known = known_methods()
    for name in settings.methods:
        if name not in known:
            raise ValueError(f"methods must be among {', '.join(known)}, but they hold {name!r}")
        here = [installed(each) for each in PEERS if each.name == name]
        if here and all(each is None for each in here):
            raise ModuleNotFoundError(f"the peer {name!r} is not installed: pip install {absent_peers()[name]}")
    if not settings.methods:
        raise ValueError("methods must name at least one method, but they name none")
    if not settings.budgets or not all(0 < each < np.inf for each in settings.budgets):
        raise ValueError(f"budgets must be positive numbers of milliseconds, but they are {settings.budgets}")
    for key in ("instances", "seeds", "calibration", "jobs"):
        if getattr(settings, key) < 1:
            raise ValueError(f"{key} must be at least 1, but it is {getattr(settings, key)}")
    if settings.seed < 0:
        raise ValueError(f"seed must be at least 0, but it is {settings.seed}")
    for key in ("proof_time", "long_time"):
        if not 0 < getattr(settings, key) < np.inf:
            raise ValueError(f"{key} must be a positive number of seconds, but it is {getattr(settings, key)}")


def run_bench(
    settings: Settings,
    file: BenchFile,
    progress: Callable[[str, int, int], object] | None = None,
    stop: Callable[[], bool] | None = None,
) -> Iterator[Unit]:
    """Run what the records lack, add it to them, and yield it, one instance after the other.

    Parameters
    ----------
    settings, file
        What is run, and where the records go.
    progress
        Called with what is counted ("calibrations" or "instances"), how many are done, and how many there are.
    stop
        Asked after each calibration; where it says so, nothing more is begun.

    Raises
    ------
    ValueError, ModuleNotFoundError
        As `check_settings`.
    """
    check_settings(settings)
    backend = "sequential" if settings.jobs == 1 else "loky"
    cells = settings.cells()
    known = file.choices
    raw = [each for each in cells if each.name not in known and peers_for(each.family, settings.methods)]
    if progress is not None:
        progress("calibrations", 0, len(raw))
    works = [(settings, each) for each in raw]
    for done, (name, found) in enumerate(distribute(_calibrate, works, backend=backend, jobs=settings.jobs), 1):
        file.add_choices(name, found)
        if progress is not None:
            progress("calibrations", done, len(raw))
        if stop is not None and stop():
            return
    choices, finished = file.choices, file.done
    todo = [
        _Work(settings, cell, number, choices.get(cell.name, {}))
        for cell in cells
        for number in range(settings.instances)
        if (cell.name, number) not in finished
    ]
    total = len(cells) * settings.instances
    before = total - len(todo)
    if progress is not None:
        progress("instances", before, total)
    for done, unit in enumerate(distribute(_run, todo, backend=backend, jobs=settings.jobs), before + 1):
        file.add(unit)
        if progress is not None:
            progress("instances", done, total)
        yield unit


@dataclass(frozen=True)
class _Work:
    """An instance as it travels to a worker."""

    settings: Settings
    cell: Cell
    number: int
    choices: Mapping[str, Any]


def _calibrate(work: tuple[Settings, Cell]) -> tuple[str, dict[str, Any]]:
    """Return the name of a cell, and what each peer is given there for each budget."""
    settings, cell = work
    one_core()
    instances = [make_instance(cell, number, settings.seed, CALIBRATION) for number in range(settings.calibration)]
    found = {}
    for peer in peers_for(cell.family, settings.methods):
        with processor_time(settings.cpu_time):
            best = calibrate(peer, instances, [1e-3 * budget for budget in settings.budgets])
        found[peer.name] = {f"{1e3 * budget:g}": asdict(choice) for budget, choice in best.items()}
    return cell.name, found


def _run(work: _Work) -> Unit:
    one_core()
    settings = work.settings
    instance = make_instance(work.cell, work.number, settings.seed)
    ours = [name for name in settings.methods if name not in peer_names()]
    unserved = {name: reason for name in ours if (reason := _reason(name, work.cell.family)) is not None}
    served = [name for name in ours if name not in unserved]
    with processor_time(settings.cpu_time):
        _warm_ours(work.cell, tuple(served), settings.budgets)
        _warm_peers(work.cell.family, settings.methods)
        began, worked = time.perf_counter(), time.process_time()
        rows = _rows(work, instance, served)
        core = (time.process_time() - worked) / max(time.perf_counter() - began, 1e-9)
        reference, proven, finder = _reference(instance, settings)
    best = max((max(each.inliers) for each in rows), default=0)
    above = sum(count > reference for each in rows for count in each.inliers) if proven else 0
    if best > reference and not proven:
        reference, finder = best, next(each.method for each in rows if max(each.inliers) == best)
    return Unit(
        family=work.cell.family,
        n_points=work.cell.n_points,
        rate=work.cell.rate,
        number=work.number,
        seed=settings.seed,
        reference=reference,
        proven=proven,
        reference_by=finder,
        rows=rows,
        missing=unserved,
        above_proven=above,
        core=round(core, 3),
        code=code_digest(),
    )


def _rows(work: _Work, instance: Instance, served: Sequence[str]) -> list[Row]:
    """Return what everyone finds on an instance, budget by budget, each time run in an order of its own.

    The first on an instance finds cold caches, as does whoever comes after one that fills them with other things.
    """
    settings, rows = work.settings, []
    order = np.random.default_rng([settings.seed, work.number])
    peers = {peer.name: peer for peer in peers_for(work.cell.family, settings.methods)}
    names = [*served, *peers]
    for budget in settings.budgets:
        found: dict[str, Row] = {}
        for name in map(str, order.permutation(names)):
            if name in peers:
                choice = Choice(**work.choices[name][f"{budget:g}"])
                found[name] = peer_row(instance, peers[name], choice, budget, settings.seeds)
            else:
                found[name] = our_row(instance, name, budget, settings.seeds)
        rows += [found[name] for name in names]
    return rows


def our_row(instance: Instance, name: str, budget: float, seeds: int) -> Row:
    """Return what one of our methods finds within `budget` milliseconds; every set that it returns is checked."""
    inliers, ms, violations, error = [], [], 0, None
    for seed in range(seeds):
        try:
            result, seconds = timed_fit(instance, name, 1e-3 * budget, seed)
        except ArithmeticError as raised:  # a failed run stays as a row; a wrong argument is a mistake of ours
            inliers.append(0)
            ms.append(0.0)
            error = str(raised)
            continue
        inliers.append(instance.count(result.model))
        ms.append(_rounded(seconds))
        violations += not sound(instance, result)
    return Row(name, budget, inliers, ms, violations, error)


def peer_row(instance: Instance, peer: Peer, choice: Choice, budget: float, seeds: int) -> Row:
    """Return what a peer finds with the settings that were chosen for the budget; only its call is timed."""
    inliers, ms, error = [], [], None
    for seed in range(seeds):
        model, seconds, raised = timed(peer.prepare(instance, seed), choice.iterations, choice.threshold)
        inliers.append(instance.count_model(model))
        ms.append(_rounded(seconds))
        error = raised or error
    return Row(peer.name, budget, inliers, ms, 0, error, choice.iterations, choice.threshold)


def timed_fit(instance: Instance, name: str, time_limit: float, seed: int) -> tuple[Consensus, float]:
    """Return the result of one of our methods on one core, and the seconds that it took.

    The problem is a fresh one each time, since what is computed of it once is kept with it.
    """
    method, options = OURS.get(name, (name, {}))
    if "n_jobs" in inspect.signature(METHODS[method].load()).parameters:
        options = {**options, "n_jobs": 1}
    shared = instance.problem
    problem = LinearProblem._checked(shared.A, shared.b, shared.family)
    collecting = gc.isenabled()
    gc.disable()
    try:
        began = read_clock()
        result = fit(problem, instance.threshold, method=method, rng=seed, time_limit=time_limit, **options)
        seconds = read_clock() - began
    finally:
        if collecting:
            gc.enable()
    return result, seconds


def sound(instance: Instance, result: Consensus) -> bool:
    """Return whether the model returned explains every point of the set returned, and no other, by a recount.

    Such a model proves f(S) <= epsilon. No set, and no model, is sound where it is called infeasible.
    """
    if not np.isfinite(result.model).all():
        return result.status == "infeasible" and not result.inlier_mask.any() and result.n_inliers == 0
    within = np.abs(instance.problem.A @ result.model - instance.problem.b) <= instance.limit
    return bool((within == result.inlier_mask).all()) and result.n_inliers == int(np.count_nonzero(within))


@functools.cache
def one_core() -> None:
    """Hold the libraries to one thread, as far as they can be told so in a running process; once is enough."""
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    for module, call in (("threadpoolctl", "threadpool_limits"), ("cv2", "setNumThreads")):
        try:
            getattr(import_module(module), call)(1)
        except ImportError:
            continue


def _reference(instance: Instance, settings: Settings) -> tuple[int, bool, str]:
    """Return the largest consensus that long runs find, whether it is proven to be the largest, and who found it."""
    exact, _ = timed_fit(instance, "exact", settings.proof_time, 0)
    best, finder = instance.count(exact.model), "exact"
    if exact.status == "optimal":
        return best, True, finder
    for name in LONG:
        if OURS[name][0] not in METHODS or _reason(name, instance.cell.family) is not None:
            continue
        found, _ = timed_fit(instance, name, settings.long_time, 1000)
        if instance.count(found.model) > best:
            best, finder = instance.count(found.model), name
    return best, False, finder


#: Why a method does not serve a family, or None, as this process found out when it warmed up.
_reasons: dict[tuple[str, str], str | None] = {}


def _reason(name: str, family: str) -> str | None:
    """Return why one of our methods does not serve a family; where it does, it is warm afterwards.

    It runs twice: the first time compiling may take all the time that there is, before all of it was called.
    """
    if (name, family) not in _reasons:
        instance = make_instance(Cell(family, *_WARM), 0, 0, WARM_UP)
        _reasons[name, family] = None
        try:
            for _ in range(2):
                timed_fit(instance, name, 0.1, 0)
        except (ValueError, FileNotFoundError) as raised:
            _reasons[name, family] = str(raised)
    return _reasons[name, family]


@functools.cache
def _warm_ours(cell: Cell, names: tuple[str, ...], budgets: tuple[float, ...]) -> None:
    """Fit a problem of the cell with every budget: what a method does hangs on the size and on the time."""
    instance = make_instance(cell, 0, 0, WARM_UP)
    for name in names:
        for budget in budgets:
            our_row(instance, name, budget, 1)


@functools.cache
def _warm_peers(family: str, methods: tuple[str, ...]) -> None:
    """Call each peer once, for what it loads on first use."""
    instance = make_instance(Cell(family, *_WARM), 0, 0, WARM_UP)
    for peer in peers_for(family, methods):
        timed(peer.prepare(instance, 0), 4, peer.thresholds[-1])


def _rounded(seconds: float) -> float:
    return round(1e3 * seconds, 4)


def quick(settings: Settings) -> Settings:
    """Return a small grid of the same kind, for a look within minutes."""
    return replace(
        settings,
        sizes=(100,),
        rates=(30, 60),
        budgets=(1.0, 10.0),
        instances=8,
        seeds=1,
        proof_time=0.3,
        long_time=0.1,
        calibration=2,
    )
