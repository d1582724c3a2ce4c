"""The architecture, read from the imports: each layer imports only from layers above it, and the core stays light."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

import maxcon

PACKAGE = Path(maxcon.__file__).parent

#: From the bottom of the house to the top; each may import from those before it.
LAYERS = [
    "waiting",
    "problem",
    "datasets",
    "minimax",
    "tree",
    "agent",
    "search",
    "certification",
    "fitting",
    "certifying",
    "vision",
    "compiling",
    "estimators",
    "experiments",
    "cli",
    "__main__",
]

HEAVY = {"torch", "gymnasium", "sklearn", "cv2", "matplotlib", "tensorboard", "trimesh", "skimage"}

#: Files of the core that are there for what only some users have installed.
EXTRAS = {
    "tree/environments.py": {"gymnasium"},
    "tree/registration.py": {"gymnasium"},
    "agent/network.py": {"torch"},
    "agent/learn.py": {"torch"},
    "agent/train.py": {"torch"},
}
CORE = LAYERS[: LAYERS.index("vision")]

FILES = sorted(path for path in PACKAGE.rglob("*.py") if path != PACKAGE / "__init__.py")


def name_of(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def layer_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix("").parts[0]


def imports(nodes: Iterator[ast.AST] | list[ast.AST], path: Path) -> Iterator[tuple[str, int]]:
    """Yield (dotted name, line) of what is imported; ``from a import b`` gives a.b."""
    for node in nodes:
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            home = node.module or ""
            if node.level:
                folder = ["maxcon", *path.relative_to(PACKAGE).parts[: -node.level]]
                home = ".".join([*folder, home]) if home else ".".join(folder)
            for alias in node.names:
                yield f"{home}.{alias.name}", node.lineno


def at_import(tree: ast.AST) -> Iterator[ast.AST]:
    """Yield the nodes that run when the module is imported: not in functions, not for type checkers only."""
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from node.orelse
            continue
        yield node
        yield from at_import(node)


def parse(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def test_every_file_has_a_layer():
    assert {layer_of(path) for path in FILES} <= set(LAYERS)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_only_from_layers_above(path):
    """Wherever the import stands: in a function and for type checkers, a dependency is one all the same."""
    own = LAYERS.index(layer_of(path))
    for name, line in imports(list(ast.walk(parse(path))), path):
        parts = name.split(".")
        if parts[0] != "maxcon" or len(parts) < 2 or parts[1].startswith("__"):
            continue
        if parts[1] in LAYERS:
            assert LAYERS.index(parts[1]) <= own, f"{name_of(path)}:{line} imports {name}"
        else:  # the package's own names, as in ``from maxcon import fit``: that is the front door
            home = maxcon._HOME[parts[1]].split(".")[1]
            assert LAYERS.index(home) <= own, f"{name_of(path)}:{line} imports {name}"


@pytest.mark.parametrize("path", [path for path in FILES if layer_of(path) in CORE], ids=name_of)
def test_the_core_stays_light(path):
    allowed = EXTRAS.get(name_of(path), set())
    for name, line in imports(at_import(parse(path)), path):
        package = name.split(".")[0]
        assert package not in HEAVY - allowed, f"{name_of(path)}:{line} imports {name}"


@pytest.mark.parametrize("path", [path for path in FILES if layer_of(path) in CORE], ids=name_of)
def test_the_core_does_not_import_its_extras(path):
    """What needs an extra is imported where it is used, or not by the core at all."""
    if name_of(path) in EXTRAS:
        return
    extras = {"maxcon." + name.removesuffix(".py").replace("/", ".") for name in EXTRAS}
    for name, line in imports(at_import(parse(path)), path):
        assert not any(name == extra or name.startswith(extra + ".") for extra in extras), f"{name_of(path)}:{line}"


def test_the_reader_of_imports_reads():
    source = ast.parse(
        "import a.b\n"
        "if TYPE_CHECKING:\n    import c\n"
        "try:\n    from d import e\nexcept ImportError:\n    pass\n"
        "def f():\n    import g\n"
        "class H:\n    from i import j\n"
        "from . import k\nfrom ..l import m\n"
    )
    path = PACKAGE / "minimax" / "linear.py"
    all_names = {name for name, _ in imports(list(ast.walk(source)), path)}
    assert all_names == {"a.b", "c", "d.e", "g", "i.j", "maxcon.minimax.k", "maxcon.l.m"}
    assert {name for name, _ in imports(at_import(source), path)} == all_names - {"c", "g"}
