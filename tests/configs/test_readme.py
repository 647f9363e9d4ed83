"""README is short, its links lead somewhere, its figures are the report's; test_docs.py tries its blocks."""

import re

import pytest
from pages import ROOT

from nsf.errors import ConfigError
from nsf.results import read
from nsf.results.readme import BEGIN, END, TABLE, updated

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_readme_links_lead_somewhere():
    links = re.findall(r"\]\(([^)]+)\)", README) + re.findall(r'(?:href|src)="([^"]+)"', README)
    links = [link.partition("#")[0] for link in links if not link.startswith(("http", "#"))]
    named = re.findall(r"`((?:nsf|conf|docs|experiments)/[\w/.]+)`", README)
    assert links
    for path in (*links, *named):
        assert (ROOT / path).exists(), path


def test_readme_figures_are_those_of_the_reports():
    assert updated(README, read(ROOT / TABLE)) == README, "run `make readme`"


@pytest.mark.parametrize(
    ("page", "words"),
    [("README.md", 700), ("docs/limits.md", 1500), ("docs/design.md", 3000), ("reports/index.md", 3000)],
)
def test_pages_are_short(page, words):
    assert len((ROOT / page).read_text(encoding="utf-8").split()) <= words


def test_figures_need_their_markers():
    frame = read(ROOT / TABLE)
    assert updated(f"a\n{BEGIN}\nold\n{END}\nb", frame).startswith(f"a\n{BEGIN}\nδ [%], means over")
    for text in ("", BEGIN, END + BEGIN, BEGIN + END + END):
        with pytest.raises(ConfigError, match="once each"):
            updated(text, frame)
