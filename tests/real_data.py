"""Real data for tests, which skip where they are absent."""

from pathlib import Path

import pytest

from maxcon.datasets import data_folder


def real_data(*parts: str) -> Path:
    """Return a path in the folder of the data sets; skip the test where it is absent."""
    path = data_folder().joinpath(*parts)
    if not path.exists():
        pytest.skip(f"needs the real data {'/'.join(parts)}, which are not at {data_folder()} (MAXCON_DATA)")
    return path
