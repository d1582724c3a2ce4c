"""``maxcon train search``: the learners of the learned search from the command line."""

import numpy as np
import pytest

pytest.importorskip("torch")

from maxcon.agent.search_networks import load_search_networks
from maxcon.datasets.synthetic import synthetic_hyperplane
from maxcon.experiments.search_instances import table_source


@pytest.fixture
def small(monkeypatch):
    """Rounds of a few fits and updates."""
    import maxcon.experiments.self_imitation as module  # noqa: PLC0415

    usual = module.Recipe

    def recipe(**options):
        return usual(fits=2, updates=2, samples=50, label_rounds=2, **options)

    monkeypatch.setattr(module, "Recipe", recipe)
    monkeypatch.setattr(module, "held_out_gaps", lambda *_, **__: {"line": 0.5})


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("learner", ["self-imitation", "optima"])
def test_each_learner_makes_networks_that_fit(run, tmp_path, points, learner):
    result = run("train", "search", "--learner", learner, "--updates", 2, "--out", "nets")
    assert result.exit_code == 0, result.output
    assert "round 2 of 2" in result.stderr
    assert "held-out gap at 3 ms: line 0.50" in result.stderr
    weights = tmp_path / "nets" / "search.safetensors"
    load_search_networks(weights)
    options = ("--method", "learned", "--option", f"network={weights}")
    assert run("fit", points, "--model", "line", "--threshold", 0.06, *options).exit_code == 0


@pytest.mark.usefixtures("small")
def test_on_tables_of_ones_own(run, fails, tmp_path):
    folder = tmp_path / "mine"
    folder.mkdir()
    for seed in range(2):
        problem = synthetic_hyperplane(np.random.default_rng(seed), 80, 0.3, 3)
        np.save(folder / f"{seed}.npy", np.column_stack([problem.A, problem.b]))
    args = ("train", "search", "--data", "mine", "--updates", 1, "--out", "nets")
    assert "--data needs --threshold" in fails(*args)
    assert run(*args, "--threshold", 0.1).exit_code == 0
    (folder / "x.csv").write_text("a,b\n1,2\n3,x\n")
    assert "x.csv must be a table of numbers" in fails(*args, "--threshold", 0.1)
    assert "there is no folder" in fails("train", "search", "--data", "none", "--threshold", 0.1, "--out", "other")
    assert "has none" in fails("train", "search", "--data", tmp_path, "--threshold", 0.1, "--out", "other")


def test_the_help_tells_what_each_kind_of_training_writes(run):
    text = " ".join(run("train", "--help").stdout.split())
    assert "For an agent DIR gets config.json, log.jsonl" in text
    assert "DIR gets checkpoint.pt, from which it goes on as well, and after every round search.safetensors" in text


def test_learners_and_families_must_fit(fails):
    assert "--learner dqn teaches the EdgeConv agents" in fails("train", "search", "--learner", "dqn")
    assert "--learner optima teaches search, not line" in fails("train", "line", "--learner", "optima")
    assert "--paper, --from and --set are for agents" in fails("train", "search", "--paper")
    assert "--threshold is for the tables" in fails("train", "line", "--threshold", 0.1)


def test_tables_with_a_header(tmp_path):
    (tmp_path / "x.csv").write_text("# made\na,b\n" + "".join(f"1,{k / 7}\n" for k in range(60)), encoding="utf-8")
    problem, threshold = table_source(tmp_path, 0.1)(np.random.default_rng(0))
    assert threshold == 0.1
    assert problem.n_params == 1
    assert set(problem.b) <= {k / 7 for k in range(60)}
    (tmp_path / "x.csv").write_text("a,b\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"x.csv must be a table of numbers: it holds no data"):
        table_source(tmp_path, 0.1)
