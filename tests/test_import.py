"""What ``import maxcon`` does and, above all, what it does not do; each in a process of its own."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

import maxcon
from test_layers import CORE

PACKAGE = Path(maxcon.__file__).parent
HEAVY = ("numba", "torch", "scipy", "matplotlib", "sklearn", "cv2", "gymnasium")


NEEDS_EXTRAS = {
    "tree/environments.py",
    "tree/registration.py",
    "agent/network.py",
    "agent/learn.py",
    "agent/train.py",
}


def run(code: str) -> subprocess.CompletedProcess:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)


def test_import_is_silent_and_light():
    found = run(
        "import sys, maxcon; names = set(sys.modules); import json; sys.stderr.write(json.dumps(sorted(names)))"
    )
    assert found.stdout == ""
    loaded = {name.split(".")[0] for name in json.loads(found.stderr)}
    assert not loaded & set(HEAVY)


def test_import_writes_nothing():
    found = run("import maxcon")
    assert (found.stdout, found.stderr) == ("", "")


@pytest.mark.parametrize("name", ["maxcon", "maxcon.minimax", "maxcon.fitting"])
def test_import_leaves_random_state_alone(name):
    code = (
        "import random, numpy as np\n"
        "random.seed(1); np.random.seed(1)\n"
        "expected = random.random(), np.random.rand(3).tolist()\n"
        "random.seed(1); np.random.seed(1)\n"
        f"import {name}\n"
        "assert (random.random(), np.random.rand(3).tolist()) == expected\n"
    )
    run(code)


def test_core_needs_no_extra():
    """With torch and the rest out of reach, all of the core can be imported."""
    extras = ["torch", "matplotlib", "sklearn", "cv2", "gymnasium", "tensorboard", "stable_baselines3"]
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        name = path.relative_to(PACKAGE).as_posix()
        if name.split("/")[0].removesuffix(".py") in CORE and name not in NEEDS_EXTRAS:
            names.append("maxcon." + name.removesuffix(".py").removesuffix("/__init__").replace("/", "."))
    assert "maxcon.minimax.linear" in names
    blocked = f"import sys, importlib; sys.modules.update(dict.fromkeys({extras!r}))\n"
    found = run(blocked + f"for name in {names!r}: importlib.import_module(name)")
    assert (found.stdout, found.stderr) == ("", "")


def test_every_public_name_is_there():
    assert set(dir(maxcon)) >= set(maxcon.__all__)
    for name in maxcon.__all__:
        assert getattr(maxcon, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nonsense'"):
        maxcon.nonsense  # noqa: B018


@pytest.mark.parametrize("first", ["maxcon.methods()", "import maxcon.fitting", "maxcon.minimax_fit", "pass"])
def test_functions_are_functions_whatever_came_first(first):
    """Importing a module binds its name in the package: no public function may be called like one."""
    run(f"import maxcon\n{first}\nassert callable(maxcon.fit) and callable(maxcon.minimax_fit)")


def test_no_public_name_is_a_module():
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {
        path.parent.name for path in PACKAGE.glob("*/__init__.py")
    }
    assert not modules & set(maxcon.__all__)


def test_documented_subpackages_are_attributes():
    """``import maxcon; maxcon.vision.polish_fundamental``, whatever was imported before."""
    packages = {path.parent.name for path in PACKAGE.glob("*/__init__.py")} - {"cli"}
    assert set(maxcon._PACKAGES) == packages
    assert packages <= set(dir(maxcon))
    assert not packages & set(maxcon.__all__)
    for name in sorted(packages):
        run(f"import maxcon\nassert maxcon.{name}.__name__ == 'maxcon.{name}'")
    run("import maxcon\nassert callable(maxcon.vision.polish_fundamental)")
