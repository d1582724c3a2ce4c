import subprocess
import sys

import pytest

import maxcon

COMMANDS = (
    "fit",
    "fit-pair",
    "curve",
    "alternatives",
    "demo",
    "methods",
    "compile",
    "agents",
    "train",
    "evaluate",
    "reproduce",
    "bench",
    "verify",
)


def python(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)


def test_help_lists_every_command(run):
    for args in ((), ("-h",), ("--help",)):
        result = run(*args)
        assert result.exit_code == 0
        for name in COMMANDS:
            assert f"  {name} " in result.stdout
        assert "..." not in result.stdout.split("Commands:")[1]  # no description is cut short


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_a_command(run, command):
    result = run(command, "-h")
    assert result.exit_code == 0
    assert result.stdout == run(command, "--help").stdout
    assert result.stdout.startswith(f"Usage: maxcon {command}")


def test_version(run):
    assert run("--version").stdout == f"maxcon, version {maxcon.__version__}\n"


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("fot",), "maxcon: error: No such command 'fot'"),
        (("--foo",), "maxcon: error: No such option"),
        (("fit",), "maxcon fit: error: Missing argument 'FILE' (see maxcon fit --help)"),
        (("fit", "a.csv"), "maxcon fit: error: Missing option '--model'"),
        (("fit", "a.csv", "--model", "cubic"), "Invalid value for '--model': 'cubic' is not one of"),
        (("fit", "a.csv", "--model", "line", "--threshold", "x"), "'x' is not a valid float"),
        (("fit", "a.csv", "--model", "line", "--threshold", "1", "--seed", "-1"), "Invalid value for '--seed'"),
        (("evaluate",), "Missing argument"),
        (("train", "circle"), "is not one of 'line', 'plane'"),
    ],
)
def test_wrong_usage_is_one_line(fails, args, message):
    assert message in fails(*args)


def test_as_a_program():
    result = python("import sys; sys.argv = ['maxcon', 'fit', 'none.csv', '--model', 'line', '--threshold', '1']\n"
                    "from maxcon.cli import main; sys.exit(main())")  # fmt: skip
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == (
        "maxcon fit: error: there is no file 'none.csv', and no table of that name: belgian_calls, cyg_ob1\n"
    )


def test_help_imports_no_heavy_package():
    result = python(
        "import sys\nfrom maxcon.cli import main\n"
        "try:\n    main(['--help'])\nexcept SystemExit as end:\n    assert not end.code\n"
        "heavy = {'torch', 'matplotlib', 'tensorboard', 'gymnasium'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    assert result.returncode == 0, result.stderr


def test_a_fit_imports_neither_torch_nor_matplotlib(points):
    result = python(
        "import sys\nfrom maxcon.cli import main\n"
        f"try:\n    main(['fit', {str(points)!r}, '--model', 'line', '--threshold', '0.1', '--method', 'agent'])\n"
        "except SystemExit as end:\n    assert not end.code\n"
        "heavy = {'torch', 'matplotlib'} & set(sys.modules)\nassert not heavy, heavy"
    )
    assert result.returncode == 0, result.stderr
    assert "32 of 40" in result.stdout


def test_ctrl_c_is_no_traceback(run, monkeypatch):
    def interrupted():
        raise KeyboardInterrupt

    monkeypatch.setattr("maxcon.agent.shipped.agent_names", interrupted)
    result = run("agents")
    assert result.exit_code == 130
    assert "interrupted" in result.stderr
    assert "Traceback" not in result.stderr


def test_a_mistake_of_ours_shows_its_traceback(run, monkeypatch):
    def broken():
        raise RuntimeError("a bug")

    monkeypatch.setattr("maxcon.agent.shipped.agent_names", broken)
    assert isinstance(run("agents").exception, RuntimeError)


def test_methods(run):
    result = run("methods")
    assert result.exit_code == 0
    for name in maxcon.methods():
        assert f"\n{name} " in result.stdout
    assert "tries=1" in result.stdout
