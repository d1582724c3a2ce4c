"""``maxcon compile``: what it says; what it does is in ``tests/test_compiling.py``."""

import pytest


@pytest.fixture
def quick(monkeypatch):
    def compile_kernels(progress):
        progress("fits of lines")
        return 12.0

    monkeypatch.setattr("maxcon.compiling.compile_kernels", compile_kernels)
    monkeypatch.setattr("numba.core.config.DISABLE_JIT", 0)


@pytest.mark.usefixtures("quick")
def test_it_says_what_it_does_and_how_long_it_took(run):
    result = run("compile")
    assert result.exit_code == 0
    assert result.stderr == "compiling: fits of lines\n"
    assert result.stdout.startswith("all kernels are ready: 12.0 s of compiling and loading, ")
    assert result.stdout.endswith(" in all\n")


@pytest.mark.usefixtures("quick")
def test_without_a_compiler_there_is_nothing_to_do(fails, monkeypatch):
    monkeypatch.setattr("numba.core.config.DISABLE_JIT", 1)
    assert "nothing is compiled where NUMBA_DISABLE_JIT is set" in fails("compile")
