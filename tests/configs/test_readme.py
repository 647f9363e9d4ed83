"""README is short, its links lead somewhere, its figures are the report's; test_docs.py tries its blocks."""

import re
from pathlib import Path

import pandas as pd
import pytest
from pages import ROOT

from nsf.errors import ConfigError
from nsf.reporting import COLUMNS
from nsf.reporting.committed import BEGIN, END, REPORT, figures, updated

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_links_lead_somewhere():
    links = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r'(?:href|src)="([^"]+)"', README)
    links = [link for link in links if not link.startswith(("http", "#"))]
    named = re.findall(r"`((?:nsf|conf|docs|experiments)/[\w/.]+)`", README)
    assert links
    for path in (*links, *named):
        assert (ROOT / path).exists(), path


def test_readme_figures_are_those_of_the_report(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert updated(README, REPORT) == README, "run `make readme`"


def test_readme_is_short():
    generated = README[README.index(BEGIN) : README.index(END)]
    assert len(README.replace(generated, "").split()) <= 560


def results(tmp_path: Path, deltas: dict[str, float]) -> Path:
    rows = [
        dict.fromkeys(COLUMNS, 1.0)
        | {
            "scene": "sand",
            "method": method,
            "field": "basis",
            "split": split,
            "device": "cpu",
            "precision": "fp64",
        }
        | {"parameter": value, "delta": delta * scale, "commit": "abc"}
        for method, delta in deltas.items()
        for value, split, scale in ((26.0, "test", 0.5), (33.0, "test", 1.5), (21.0, "train", 99.0))
    ]
    pd.DataFrame(rows, columns=list(COLUMNS)).to_csv(tmp_path / "results.csv", index=False)
    return tmp_path


def test_figures_are_means_of_held_out_values(tmp_path):
    text = figures(results(tmp_path, {"nsf": 0.00123, "deformation_only": 0.0456}))
    assert "| sand | 0.400 | 0.123 |" in text  # the paper's, then ours
    assert "4.56" not in text  # one row a scene
    assert "paper's δ [%] | δ [%]" in text


def test_figures_are_of_operators_over_seeds_and_the_projected_error_stands_beside_them(tmp_path):
    whole = pd.read_csv(results(tmp_path, {"nsf": 0.002}) / "results.csv")
    parts = [
        whole.assign(engine=engine, setting=f"seed={seed}", sample=50 + seed, delta=whole["delta"] * factor)
        for engine, seed, factor in (("modal", 0, 1.0), ("operators", 0, 0.5), ("operators", 1, 1.0))
    ]
    pd.concat(parts).to_csv(tmp_path / "results.csv", index=False)
    text = figures(tmp_path)
    assert "| scene | \\|S\\| | paper's δ [%] | δ, projected steps [%] | δ, operators [%] |" in text
    assert "| sand | – | 0.400 | 0.200 | 0.150 |" in text
    assert "engine operators" in text


@pytest.mark.parametrize(("projected", "operators", "beside"), [(0.04, 0.09, "4 %"), (0.09, 0.05, "5 %")])
def test_rivals_are_held_to_the_best_reduced_run_of_both_engines(tmp_path, projected, operators, beside):
    whole = pd.read_csv(results(tmp_path, {"nsf": 0.002}) / "results.csv")
    whole = whole.assign(displacement_interpolated=0.01)
    errors = {"modal": projected, "operators": operators}
    parts = [whole.assign(engine=engine, displacement_error=error) for engine, error in errors.items()]
    pd.concat(parts).to_csv(tmp_path / "results.csv", index=False)
    assert f"on sand interpolated latents (1 %) beside {beside}" in figures(tmp_path)


def test_figures_do_not_hide_divergence(tmp_path):
    assert "| sand | 0.400 | ∞ |" in figures(results(tmp_path, {"nsf": float("inf")}))


def test_figures_need_their_markers(tmp_path):
    assert updated(f"a\n{BEGIN}\nold\n{END}\nb", tmp_path).startswith(f"a\n{BEGIN}\n`")
    for text in ("", BEGIN, END + BEGIN, BEGIN + END + END):
        with pytest.raises(ConfigError, match="once each"):
            updated(text, tmp_path)
