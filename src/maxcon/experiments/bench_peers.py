"""Robust fitting in other libraries, behind one small protocol: for the benchmark, with nothing of ours added.

A peer fits until it has used up a number of iterations. Which number fits a time budget, and which threshold of its own
serves the one residual that all are judged by, is found by calibration (`maxcon.experiments.bench_calibration`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module, metadata
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from maxcon.experiments.bench_cells import CHARTS, Instance

Model = NDArray[np.float64]

#: What a prepared peer is called with: iterations and its own threshold. None: it found no model.
Run = Callable[[int, float], Model | None]

#: The largest confidence below 1: it is the iterations, hence the time, that end a search.
CERTAIN = float(np.nextafter(1.0, 0.0))

#: Thresholds to choose from: multiples of the threshold of a linear problem, and pixels for a fundamental matrix.
MULTIPLES = (0.5, 0.75, 1.0, 1.5, 2.0)
PIXELS = (0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 12.0)


class Peer(Protocol):
    """A method of another library."""

    @property
    def name(self) -> str:
        """What tables call it."""
        ...

    @property
    def package(self) -> str:
        """The distribution that brings it, for ``pip install``."""
        ...

    @property
    def module(self) -> str:
        """What is imported."""
        ...

    @property
    def thresholds(self) -> tuple[float, ...]:
        """The settings of its threshold to choose from."""
        ...

    @property
    def most(self) -> int:
        """More iterations than this are not tried."""
        ...

    def serves(self, family: str) -> bool:
        """Whether it fits problems of this family."""
        ...

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Bring the data into the peer's own form, outside the clock, and return what is timed."""
        ...


def installed(peer: Peer) -> str | None:
    """Return the version of a peer's package; None if it cannot be imported."""
    return _version(peer.package, peer.module)


@functools.cache
def _version(package: str, module: str) -> str | None:
    try:
        library = import_module(module)
    except ImportError:
        return None
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:  # another distribution brings the module: OpenCV has four
        return str(getattr(library, "__version__", "unknown"))


@dataclass(frozen=True)
class _Linear:
    """What the peers for linear residuals share."""

    name: str
    package: str
    module: str
    thresholds: tuple[float, ...] = MULTIPLES
    most: int = 20_000

    def serves(self, family: str) -> bool:
        return family not in CHARTS


@dataclass(frozen=True)
class SklearnRansac(_Linear):
    """`sklearn.linear_model.RANSACRegressor` over least squares, with minimal samples."""

    name: str = "sklearn-ransac"
    package: str = "scikit-learn"
    module: str = "sklearn.linear_model"

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call: building the regressor, and fitting it."""
        library: Any = import_module(self.module)
        A, b = _writable(instance)

        def run(iterations: int, threshold: float) -> Model | None:
            regressor = library.RANSACRegressor(
                library.LinearRegression(fit_intercept=False),
                min_samples=A.shape[1],
                residual_threshold=threshold * instance.threshold,
                max_trials=iterations,
                stop_probability=1.0,
                random_state=seed,
            )
            return _vector(regressor.fit(A, b).estimator_.coef_)

        return run


@dataclass(frozen=True)
class SklearnHuber(_Linear):
    """`sklearn.linear_model.HuberRegressor`; its threshold is relative to a scale that it estimates itself."""

    name: str = "sklearn-huber"
    package: str = "scikit-learn"
    module: str = "sklearn.linear_model"
    thresholds: tuple[float, ...] = (1.0, 1.1, 1.35, 2.0)
    most: int = 1_000

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call; nothing is random."""
        library: Any = import_module(self.module)
        A, b = _writable(instance)

        def run(iterations: int, threshold: float) -> Model | None:
            regressor = library.HuberRegressor(epsilon=threshold, max_iter=iterations, alpha=0.0, fit_intercept=False)
            return _vector(regressor.fit(A, b).coef_)

        return run


@dataclass(frozen=True)
class SklearnTheilSen(_Linear):
    """`sklearn.linear_model.TheilSenRegressor`: the spatial median of minimal fits; it has no threshold."""

    name: str = "sklearn-theilsen"
    package: str = "scikit-learn"
    module: str = "sklearn.linear_model"
    thresholds: tuple[float, ...] = (1.0,)

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call; an iteration is a subset of points."""
        library: Any = import_module(self.module)
        A, b = _writable(instance)

        def run(iterations: int, threshold: float) -> Model | None:
            regressor = library.TheilSenRegressor(
                fit_intercept=False,
                max_subpopulation=iterations,
                n_subsamples=A.shape[1],
                random_state=seed,
                n_jobs=1,
            )
            return _vector(regressor.fit(A, b).coef_)

        return run


class VerticalModel:
    """The model class for `skimage.measure.ransac`: rows [a_i, b_i] and the residual |a_i . theta - b_i|."""

    def __init__(self, theta: Model) -> None:
        self.theta = theta

    @classmethod
    def from_estimate(cls, rows: Model) -> VerticalModel:
        """Return the least-squares model of rows, shape (n, d + 1)."""
        return cls(_vector(np.linalg.lstsq(rows[:, :-1], rows[:, -1])[0]))

    def estimate(self, rows: Model) -> bool:
        """Fit this model to rows, as versions before 0.26 ask for."""
        self.theta = self.from_estimate(rows).theta
        return True

    def residuals(self, rows: Model) -> Model:
        """Return the residuals of rows, shape (n,)."""
        return np.abs(rows[:, :-1] @ self.theta - rows[:, -1])


@dataclass(frozen=True)
class SkimageRansac(_Linear):
    """`skimage.measure.ransac` with a model of vertical residuals."""

    name: str = "skimage-ransac"
    package: str = "scikit-image"
    module: str = "skimage.measure"

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call."""
        library: Any = import_module(self.module)
        A, b = instance.problem.A, instance.problem.b
        rows = np.column_stack([A, b])

        def run(iterations: int, threshold: float) -> Model | None:
            model, _ = library.ransac(
                rows,
                VerticalModel,
                A.shape[1],
                threshold * instance.threshold,
                max_trials=iterations,
                stop_probability=1,
                rng=seed,
            )
            return None if model is None else _vector(model.theta)

        return run


@dataclass(frozen=True)
class _TwoView:
    """What the peers for fundamental matrices share: pixels in, a matrix of rank 2 in pixels out."""

    name: str
    package: str
    module: str
    thresholds: tuple[float, ...] = PIXELS
    most: int = 1_000_000

    def serves(self, family: str) -> bool:
        return family in CHARTS


@dataclass(frozen=True)
class SkimageFundamental(_TwoView):
    """`skimage.measure.ransac` with `FundamentalMatrixTransform` (eight points, Sampson distance)."""

    name: str = "skimage-ransac"
    package: str = "scikit-image"
    module: str = "skimage.measure"
    most: int = 20_000

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call."""
        library: Any = import_module(self.module)
        transform: Any = import_module("skimage.transform").FundamentalMatrixTransform
        matches = _matches(instance)

        def run(iterations: int, threshold: float) -> Model | None:
            model, _ = library.ransac(
                matches, transform, 8, threshold, max_trials=iterations, stop_probability=1, rng=seed
            )
            return None if model is None else _matrix(model.params)

        return run


@dataclass(frozen=True)
class OpenCv(_TwoView):
    """A method of `cv2.findFundamentalMat`, on one thread.

    Its random numbers have a fixed seed: another order of the matches stands for another seed.
    """

    name: str = "opencv-ransac"
    package: str = "opencv-python-headless"
    module: str = "cv2"
    flag: str = "FM_RANSAC"

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call."""
        cv2: Any = import_module(self.module)
        cv2.setNumThreads(1)
        order = np.random.default_rng([seed, instance.number]).permutation(instance.problem.n_points)
        x1, x2 = (np.ascontiguousarray(each[order]) for each in _matches(instance))
        method = getattr(cv2, self.flag)

        def run(iterations: int, threshold: float) -> Model | None:
            return _matrix(cv2.findFundamentalMat(x1, x2, method, threshold, CERTAIN, iterations)[0])

        return run


@dataclass(frozen=True)
class PoseLib(_TwoView):
    """`poselib.estimate_fundamental`: LO-RANSAC with bundle adjustment (PoseLib 2.0, its Python interface)."""

    name: str = "poselib"
    package: str = "poselib"
    module: str = "poselib"

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call."""
        library: Any = import_module(self.module)
        x1, x2 = _matches(instance)

        def run(iterations: int, threshold: float) -> Model | None:
            options = {
                "max_iterations": iterations,
                "min_iterations": iterations,
                "max_epipolar_error": threshold,
                "success_prob": CERTAIN,
                "seed": seed,
            }
            return _matrix(library.estimate_fundamental(x1, x2, options, {})[0])

        return run


@dataclass(frozen=True)
class PyColmap(_TwoView):
    """`pycolmap.estimate_fundamental_matrix`: COLMAP's LO-RANSAC (pycolmap 3, its Python interface)."""

    name: str = "pycolmap"
    package: str = "pycolmap"
    module: str = "pycolmap"

    def prepare(self, instance: Instance, seed: int) -> Run:
        """Return the timed call; where this version takes no seed, the order of the matches stands for it."""
        library: Any = import_module(self.module)
        order = np.random.default_rng([seed, instance.number]).permutation(instance.problem.n_points)
        x1, x2 = (np.ascontiguousarray(each[order]) for each in _matches(instance))

        def run(iterations: int, threshold: float) -> Model | None:
            options = library.RANSACOptions()
            options.max_error = threshold
            options.confidence = CERTAIN
            options.min_num_trials = iterations
            options.max_num_trials = iterations
            if hasattr(options, "random_seed"):
                options.random_seed = seed
            found = library.estimate_fundamental_matrix(x1, x2, options)
            return None if found is None else _matrix(found["F"])

        return run


_OPENCV = {
    "opencv-ransac": "FM_RANSAC",
    "opencv-usac-default": "USAC_DEFAULT",
    "opencv-usac-fast": "USAC_FAST",
    "opencv-usac-accurate": "USAC_ACCURATE",
    "opencv-usac-magsac": "USAC_MAGSAC",
    "opencv-usac-parallel": "USAC_PARALLEL",
    "opencv-usac-8pts": "USAC_FM_8PTS",
}

#: All peers, in the order of the tables. Two of one name serve different families.
PEERS: tuple[Peer, ...] = (
    SklearnRansac(),
    SklearnHuber(),
    SklearnTheilSen(),
    SkimageRansac(),
    SkimageFundamental(),
    *(OpenCv(name=name, flag=flag) for name, flag in _OPENCV.items()),
    OpenCv(name="opencv-lmeds", flag="FM_LMEDS", thresholds=(1.0,)),
    PoseLib(),
    PyColmap(),
)


def peer_names() -> tuple[str, ...]:
    """Return the names of all peers, each once."""
    return tuple(dict.fromkeys(each.name for each in PEERS))


def peers_for(family: str, names: tuple[str, ...]) -> tuple[Peer, ...]:
    """Return the peers among `names` that are installed and serve a family."""
    return tuple(each for each in PEERS if each.name in names and each.serves(family) and installed(each) is not None)


def _writable(instance: Instance) -> tuple[Model, Model]:
    return instance.problem.A.copy(), instance.problem.b.copy()


def _matches(instance: Instance) -> tuple[Model, Model]:
    if instance.x1 is None or instance.x2 is None:
        raise ValueError(f"instance must be a two-view problem, but it is of the family {instance.cell.family!r}")
    return instance.x1, instance.x2


def _vector(theta: Any) -> Model:
    return np.ascontiguousarray(theta, dtype=np.float64).ravel()


def _matrix(F: Any) -> Model | None:
    """Return the first of the matrices that were found; None where there is none."""
    if F is None:
        return None
    matrix = np.asarray(F, dtype=np.float64)
    return np.ascontiguousarray(matrix[:3]) if matrix.ndim == 2 and matrix.shape[0] >= 3 and matrix.any() else None
