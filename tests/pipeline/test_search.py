"""`nsf search`: at the validation values only, and on where it stopped."""

import re
import sys

import pandas as pd
import pytest

from nsf.errors import ConfigError, MissingExtraError, MissingRunError, SchemaError
from nsf.pipeline.sweeps.search import Range, search
from nsf.runs import Run

pytest.importorskip("optuna", reason="optuna is not installed; pip install 'nsf[search]'")


@pytest.fixture
def tried(copied, tiny, tmp_path):
    """(*words) → the table of trials, and what was said."""
    root = copied("simulate")
    base = [t for t in tiny if not t.startswith(("latent_dim", "evaluation.trials", "trainer.steps"))]
    base += ["evaluation.trials=1", "trainer.steps=50", f"report.folder={tmp_path / 'reports'}"]

    def call(*words):
        said = []
        chart, _, command = search([*base, *words], said.append, root)
        assert chart.is_file()
        assert "best at the validation values" in command
        return pd.read_csv(chart.with_name("trials.csv")), said

    call.root = root
    return call


@pytest.mark.slow
def test_the_front_of_two_objectives(tried):
    words = ("scene.design.validation=[25]", "latent_dim=3..5", "field.noise=0.001..0.1:log")
    table, said = tried(*words, "search.objectives=[delta,step_ms]", "search.trials=3")
    assert list(table["trial"]) == [0, 1, 2]
    assert set(table["latent_dim"]) <= {3, 4, 5}
    assert table["field.noise"].between(0.001, 0.1).all()
    for _, row in table.iterrows():
        better = table[(table["delta"] <= row["delta"]) & (table["step_ms"] <= row["step_ms"])]
        assert row["pareto"] == (len(better) == 1)
    assert len([line for line in said if re.match(r"trial \d: latent_dim=\d", line)]) == 3


@pytest.mark.slow
def test_only_validation_values_are_deployed_and_the_search_goes_on(tried):
    words = ("scene.design.validation=[25]", "latent_dim=3..5")
    assert len(tried(*words, "search.trials=1")[0]) == 1
    table, said = tried(*words, "search.trials=2")
    assert said[0].startswith("search: 1 trials of sand_")
    assert len(table) == 2
    assert len(tried(*words, "search.trials=2")[1]) == 1  # nothing more to try
    for run in Run.find("evaluate", root=tried.root):
        assert set(pd.read_csv(run.path / "results.csv")["split"]) == {"validation"}
    assert all(
        run.config["cases"] == [{"friction_angle": 25.0}] for run in Run.find("deploy", root=tried.root)
    )


@pytest.mark.slow
def test_a_failed_trial_is_kept_and_the_others_go_on(tried, monkeypatch):
    words = ("scene.design.validation=[25]", "latent_dim=7..9", "search.trials=3", "seed=1")
    table, said = tried(*words)
    failed = table[table["error"].notna()]
    assert set(failed["latent_dim"]) <= {9}
    assert all("exceeds the 8 displacement modes" in error for error in failed["error"])
    assert len(said) == 3


@pytest.mark.parametrize(
    ("words", "quoted"),
    [
        (["latent_dim=4..6"], "no validation cases.*scene.design.validation"),
        (["latent_dim=4"], "needs a range"),
        (["latent_dim=6..4"], "nothing between"),
        (["field.noise=0.0..0.1:log"], "reaches zero"),
        (["latent_dim=0..4", "scene.design.validation=[25]"], "latent_dim=0"),
        (["latent_dim=4..6", "search.objectives=[speed]"], "delta, step_ms"),
        (["latent_dim=4..6", "search.objectives=[step_ms]", "evaluation.trials=0"], "evaluation.trials=0"),
    ],
)
def test_bad_input_is_refused_before_any_trial(tried, words, quoted):
    with pytest.raises(ConfigError, match=quoted):
        tried(*words)
    assert not Run.find("train", root=tried.root)


def test_a_damaged_data_base_is_refused(tried):
    (tried.root / "search.db").write_bytes(b"SQLite format 3\0" + bytes(4000))
    with pytest.raises(SchemaError, match=r"search\.db is damaged, .* delete it"):
        tried("latent_dim=4..6", "scene.design.validation=[25]")


def test_ranges_are_whole_where_both_ends_are():
    assert Range.parse("latent_dim=4..8") == Range("latent_dim", 4, 8, False)
    assert Range.parse("a.b=1e-4..1e-2:log") == Range("a.b", 1e-4, 1e-2, True)
    assert isinstance(Range.parse("a=1..2.0").low, float)
    assert Range.parse("scene=sand") is None


def test_a_missing_extra_names_the_remedy(tried, monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(MissingExtraError, match=r"pip install 'nsf\[search\]'"):
        tried("latent_dim=4..6")


def test_no_result_at_all(tried):
    with pytest.raises(MissingRunError, match="no trial"):
        tried("scene.design.validation=[25]", "latent_dim=7..8", "search.trials=1", "field.modes=[6,8,8]")
