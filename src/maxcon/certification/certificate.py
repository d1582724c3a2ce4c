"""The certificate: what was found, what is claimed, and what the file itself proves; a JSON file.

It holds no code's word for anything that can be checked: the inliers follow from the model, and the bound from
`Group`s, whose every step is a linear system or a count (`maxcon.certification.verify`).
"""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

FORMAT = "maxcon certificate"
VERSION = 1

#: How far above the threshold a residual may be: ``relative * threshold + absolute * max|b|``. A certificate
#: states its rule, and is refused under any other; that this is the rule of `maxcon.problem`, a test makes
#: sure.
SLACK = {"relative": 1e-9, "absolute": 1e-12}

_KEYS = (
    "format",
    "version",
    "data",
    "threshold",
    "slack",
    "model",
    "inliers",
    "n_inliers",
    "upper_bound",
    "claimed_by",
    "proven_bound",
    "groups",
    "seal",
)


class CertificateError(ValueError):
    """What is wrong with a certificate that cannot be read."""


class Group(NamedTuple):
    """Points that no model explains without leaving out `needed` of them.

    Attributes
    ----------
    needed
        How many points at least hit all bases.
    bases
        Sets of at most d + 1 points that no model explains together.
    proof
        Why fewer than `needed` points do not hit all bases: the nodes of a tree, each before its children.
        ``0, k``: one point of basis k must be out: the first that is neither out nor kept, or it is kept and
        the next is out, and so on, a child for each. ``m, k1, ..., km``: these bases have no point that is
        out, and share none but kept ones, so that m more points must go out, which are too many; or m = 1 and
        all its points are kept.
    """

    needed: int
    bases: tuple[tuple[int, ...], ...]
    proof: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Certificate:
    """A model, its inliers, an upper bound on any model's inliers, and a proof of a (perhaps weaker) upper bound.

    Attributes
    ----------
    digest
        SHA-256 of the data, see `data_digest`.
    n_points, n_params
        N and d.
    family
        What kind of model this is: "line", "plane", "hyperplane" or "linear".
    threshold
        The inlier threshold, in the unit of b.
    model
        Shape (d,); all NaN if no model explains even one point.
    inlier_mask
        Shape (N,), bool.
    n_inliers
        How many inliers the model has.
    upper_bound
        The claim: no model has more inliers.
    method, seconds, package
        Who claims it: the name of the search, how long it took, and the program.
    groups
        The witness, which proves `proven_bound`.
    """

    digest: str
    n_points: int
    n_params: int
    family: str
    threshold: float
    model: NDArray[np.float64]
    inlier_mask: NDArray[np.bool_]
    n_inliers: int
    upper_bound: int
    method: str
    seconds: float
    package: str
    groups: tuple[Group, ...]

    def __post_init__(self) -> None:
        self._freeze_arrays()

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)  # a pickle and a deep copy bring arrays back writeable
        self._freeze_arrays()

    def _freeze_arrays(self) -> None:
        """Make the arrays read-only, as those of results are, but by code of its own: the checker shares none."""
        self.model.setflags(write=False)
        self.inlier_mask.setflags(write=False)

    @property
    def proven_bound(self) -> int:
        """What the file proves: N minus all points that its groups need."""
        return self.n_points - sum(group.needed for group in self.groups)

    def __repr__(self) -> str:
        return (
            f"Certificate({self.n_inliers} of {self.n_points} points within {self.threshold:g}, "
            f"claimed: at most {self.upper_bound}, by {self.method!r}; proven by the file: at most {self.proven_bound})"
        )


def data_digest(A: NDArray[np.float64], b: NDArray[np.float64]) -> str:
    """Return the SHA-256, in hexadecimal, of the shape of A, and the little-endian doubles of A and b."""
    digest = hashlib.sha256(f"{A.shape[0]} {A.shape[1]}\n".encode())
    digest.update(np.ascontiguousarray(A, dtype="<f8").tobytes())
    digest.update(np.ascontiguousarray(b, dtype="<f8").tobytes())
    return digest.hexdigest()


def inlier_limit(threshold: float, b: NDArray[np.float64]) -> float:
    """Return the largest residual of an inlier: the threshold and its slack for rounding."""
    slack = SLACK["relative"] * threshold + SLACK["absolute"] * float(np.abs(b).max())
    return threshold + slack


def save(certificate: Certificate, path: str | os.PathLike[str]) -> None:
    """Write the certificate; a kill at any moment leaves the old file or the new one.

    Raises
    ------
    OSError
        If the file cannot be written.
    """
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise FileNotFoundError(errno.ENOENT, "there is no such folder", str(target.parent))
    handle, part = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.", suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(dumps(certificate))
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(part, 0o666 & ~mask)  # as if it had been opened
        os.replace(part, target)
    except BaseException:
        Path(part).unlink(missing_ok=True)
        raise


def load(path: str | os.PathLike[str]) -> Certificate:
    """Read a certificate; this checks that it is one, not that it is right.

    Raises
    ------
    OSError
        If the file cannot be read.
    CertificateError
        If it holds no certificate, or one that has been changed or cut off.
    """
    return loads(Path(path).read_bytes())


def dumps(certificate: Certificate) -> bytes:
    """Return the certificate as JSON, one line for each field and each group."""
    found = bool(np.isfinite(certificate.model).all())
    record: dict[str, Any] = {
        "format": FORMAT,
        "version": VERSION,
        "data": {
            "sha256": certificate.digest,
            "n_points": certificate.n_points,
            "n_params": certificate.n_params,
            "family": certificate.family,
        },
        "threshold": certificate.threshold,
        "slack": SLACK,
        "model": certificate.model.tolist() if found else None,
        "inliers": np.packbits(certificate.inlier_mask).tobytes().hex(),
        "n_inliers": certificate.n_inliers,
        "upper_bound": certificate.upper_bound,
        "claimed_by": {
            "method": certificate.method,
            "seconds": certificate.seconds,
            "package": certificate.package,
        },
        "proven_bound": certificate.proven_bound,
        "groups": [
            {"needed": group.needed, "bases": [list(basis) for basis in group.bases], "proof": list(group.proof)}
            for group in certificate.groups
        ],
    }
    record["seal"] = _seal(record)
    lines = []
    for key, value in record.items():
        if key == "groups" and certificate.groups:
            text = "[\n" + ",\n".join(_compact(group) for group in record["groups"]) + "\n]"
        else:
            text = _compact(value)
        lines.append(f'"{key}":{text}')
    return ("{\n" + ",\n".join(lines) + "\n}\n").encode("ascii")


def loads(content: bytes) -> Certificate:
    """Read a certificate from JSON; `CertificateError` as `load`."""
    try:
        record = json.loads(content.decode("ascii"), parse_constant=_no_constant)
    except (UnicodeDecodeError, RecursionError):
        raise CertificateError("this is no certificate: it is not JSON") from None
    except json.JSONDecodeError as error:
        raise CertificateError(f"this is no certificate, or one that has been cut off: {error}") from None
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise CertificateError(f'this is no certificate: it does not say "format": "{FORMAT}"')
    if record.get("version") != VERSION:
        raise CertificateError(f"it is of version {record.get('version')!r}, and only version {VERSION} can be read")
    if sorted(record) != sorted(_KEYS):
        lacking = ", ".join(key for key in _KEYS if key not in record)
        extra = ", ".join(key for key in record if key not in _KEYS)
        raise CertificateError(f"it lacks {lacking}" if lacking else f"it has what no certificate has: {extra}")
    if record["seal"] != _seal({key: value for key, value in record.items() if key != "seal"}):
        raise CertificateError("it has been changed since it was written: its content does not match its seal")
    return _parse(record)


def _parse(record: Mapping[str, Any]) -> Certificate:
    data = _fields(record, "data", ("sha256", "n_points", "n_params", "family"))
    claim = _fields(record, "claimed_by", ("method", "seconds", "package"))
    if record["slack"] != SLACK:
        raise CertificateError(f"its slack is {record['slack']}, but version {VERSION} has {SLACK}")
    n_points = _whole(data["n_points"], "n_points", 1)
    n_params = _whole(data["n_params"], "n_params", 1)
    threshold = _real(record["threshold"], "threshold")
    if threshold <= 0:
        raise CertificateError(f"threshold must be positive, but it is {threshold}")
    model = record["model"]
    if model is None:
        model = [math.nan] * n_params
    elif not isinstance(model, list) or len(model) != n_params:
        raise CertificateError(f"model must be a list of {n_params} numbers")
    else:
        model = [_real(value, "model") for value in model]
    certificate = Certificate(
        digest=_text(data["sha256"], "sha256"),
        n_points=n_points,
        n_params=n_params,
        family=_text(data["family"], "family"),
        threshold=threshold,
        model=np.array(model, dtype=np.float64),
        inlier_mask=_mask(record["inliers"], n_points),
        n_inliers=_whole(record["n_inliers"], "n_inliers", 0, n_points),
        upper_bound=_whole(record["upper_bound"], "upper_bound", 0, n_points),
        method=_text(claim["method"], "method"),
        seconds=_real(claim["seconds"], "seconds"),
        package=_text(claim["package"], "package"),
        groups=_groups(record["groups"], n_points, n_params),
    )
    if record["proven_bound"] != certificate.proven_bound:
        raise CertificateError(
            f"proven_bound is {record['proven_bound']!r}, but its groups need "
            f"{n_points - certificate.proven_bound} of {n_points} points"
        )
    return certificate


def _groups(value: Any, n_points: int, n_params: int) -> tuple[Group, ...]:
    if not isinstance(value, list):
        raise CertificateError("groups must be a list")
    groups = []
    for number, each in enumerate(value, start=1):
        name = f"group {number}"
        if not isinstance(each, dict) or sorted(each) != ["bases", "needed", "proof"]:
            raise CertificateError(f"{name} must have needed, bases and proof")
        needed = _whole(each["needed"], f"needed of {name}", 1, n_points)
        if not isinstance(each["bases"], list) or not isinstance(each["proof"], list):
            raise CertificateError(f"{name}: bases and proof must be lists")
        bases = tuple(_basis(basis, name, n_points, n_params) for basis in each["bases"])
        proof = tuple(_whole(entry, f"proof of {name}", 0) for entry in each["proof"])
        groups.append(Group(needed, bases, proof))
    return tuple(groups)


def _basis(value: Any, name: str, n_points: int, n_params: int) -> tuple[int, ...]:
    if not isinstance(value, list) or not 1 <= len(value) <= n_params + 1:
        raise CertificateError(f"a basis of {name} must be a list of 1 to {n_params + 1} points")
    basis = tuple(_whole(point, f"point of a basis of {name}", 0, n_points - 1) for point in value)
    if len(set(basis)) < len(basis):
        raise CertificateError(f"a basis of {name} names a point twice")
    return basis


def _fields(record: Mapping[str, Any], key: str, names: tuple[str, ...]) -> dict[str, Any]:
    value = record[key]
    if not isinstance(value, dict) or sorted(value) != sorted(names):
        raise CertificateError(f"{key} must have {', '.join(names)}")
    return value


def _whole(value: Any, name: str, least: int, most: int | None = None) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least or (most is not None and value > most):
        span = f"at least {least}" if most is None else f"from {least} to {most}"
        raise CertificateError(f"{name} must be a whole number {span}, but it is {value!r}")
    return value


def _real(value: Any, name: str) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise CertificateError(f"{name} must be a finite number, but it is {value!r}")
    return float(value)


def _text(value: Any, name: str) -> str:
    if not isinstance(value, str):
        raise CertificateError(f"{name} must be text, but it is {value!r}")
    return value


def _mask(value: Any, n_points: int) -> NDArray[np.bool_]:
    try:
        packed = np.frombuffer(bytes.fromhex(_text(value, "inliers")), dtype=np.uint8)
    except ValueError:
        raise CertificateError("inliers must be hexadecimal") from None
    bits = np.unpackbits(packed)
    if len(packed) != (n_points + 7) // 8 or bits[n_points:].any():
        raise CertificateError(f"inliers must hold a bit for each of {n_points} points")
    return bits[:n_points].astype(np.bool_)


def _no_constant(name: str) -> NoReturn:
    raise CertificateError(f"this is no certificate: {name} is not a number")


def _compact(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), allow_nan=False)


def _seal(record: Mapping[str, Any]) -> str:
    """Return a digest of the content: it tells a file that was damaged, by chance or by hand, at once."""
    return hashlib.sha256(json.dumps(record, sort_keys=True, separators=(",", ":")).encode()).hexdigest()
