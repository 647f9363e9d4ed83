"""A chain in a notebook."""

from made import Made, write_run

from nsf.results.notebook import html


def test_an_evaluated_chain_shows_errors_and_a_strip(tmp_path):
    shown = html([write_run(tmp_path, Made())])
    assert "complete" in shown
    assert "displacement error [%]" in shown
    assert '<img src="data:image/png;base64,' in shown
    assert len(shown) < 400_000
