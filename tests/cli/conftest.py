from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

from maxcon.cli import main

Run = Callable[..., Result]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Call the command line in a folder of its own."""
    monkeypatch.chdir(tmp_path)

    def call(*args: object, stdin: bytes | None = None) -> Result:
        return CliRunner().invoke(main, [str(arg) for arg in args], input=stdin)

    return call


@pytest.fixture
def fails(run: Run) -> Callable[..., str]:
    """Call the command line, check that it fails with one line on stderr and exit code 2, and return that line."""

    def call(*args: object, stdin: bytes | None = None) -> str:
        result = run(*args, stdin=stdin)
        assert result.exit_code == 2, result.output
        assert result.stdout == ""
        assert result.stderr.count("\n") == 1
        assert result.stderr.startswith("maxcon")
        assert "error: " in result.stderr
        return result.stderr.strip()

    return call


@pytest.fixture
def points(tmp_path: Path) -> Path:
    """Forty points of y = 2 x - 1, eight of them far off: the rows 1, 6, 11, ..."""
    rng = np.random.default_rng(5)
    x = rng.uniform(-1, 1, 40)
    y = 2 * x - 1 + rng.uniform(-0.05, 0.05, 40)
    y[::5] += rng.choice([-1, 1], 8) * rng.uniform(1, 3, 8)
    path = tmp_path / "points.csv"
    np.savetxt(path, np.column_stack([x, y]), delimiter=",", header="dose,effect", comments="")
    return path
