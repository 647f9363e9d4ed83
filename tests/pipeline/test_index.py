"""The page of all runs, in a real browser."""

import shutil

import pytest

from nsf.results.overview.index import thumbnail, write_index
from nsf.runs import Run


@pytest.fixture(scope="module")
def page_of(chain, tmp_path_factory):
    """The page of the tiny chain and a run that failed."""
    root = tmp_path_factory.mktemp("index")
    shutil.copytree(chain.root, root / "runs")
    failed = Run.open("train", "sand", {"latent_dim": 99}, root=root / "runs")
    with pytest.raises(ValueError, match="<lost>"), failed.record():
        raise ValueError("<lost>")
    return write_index(root / "reports" / "runs", root / "runs")


def test_thumbnails_are_drawn_once(page_of, chain):
    pictures = sorted(page_of.parent.glob("thumbnails/**/*.png"))
    # Of four trajectories, the manifold, the reduced run and the evaluation; a failed run has none.
    assert len(pictures) == 7
    before = [picture.stat().st_mtime_ns for picture in pictures]
    write_index(page_of.parent, page_of.parents[2] / "runs")
    assert [picture.stat().st_mtime_ns for picture in pictures] == before
    assert chain.pipeline.evaluation.hash in page_of.read_text()
    assert "&lt;lost&gt;" in page_of.read_text()


def test_losses_of_earlier_versions_are_drawn(tmp_path):
    run = Run.open("train", "sand", {"latent_dim": 4}, root=tmp_path)
    with run.record() as record:
        log = run.path / "stress" / "csv" / "0" / "metrics.csv"
        log.parent.mkdir(parents=True)
        log.write_text("step,loss\n0,1.0\n1,0.5\n")
        record.output(log)
    assert thumbnail(run, tmp_path / "drawn.png")


@pytest.fixture
def page(browser, page_of):
    page = browser.new_page()
    errors = []
    page.on("pageerror", lambda error: errors.append(error))
    page.on("requestfailed", lambda request: errors.append(request.url))
    page.goto(page_of.as_uri())
    yield page
    page.close()
    assert errors == []


def visible(page, column):
    """Texts of a column, of the rows that are shown."""
    return page.eval_on_selector_all(
        "tbody tr", f"rows => rows.filter(r => !r.hidden).map(r => r.cells[{column}].textContent)"
    )


STAGE, STATUS, SECONDS = 1, 5, 6


def test_filters_by_words_and_by_choice(page):
    assert len(visible(page, STAGE)) == 8
    assert page.inner_text("output") == "8 of 8 runs"
    page.fill("input", "sand TRAIN")
    assert visible(page, STAGE) == ["train", "train"]
    page.select_option("select[aria-label=status]", "failed")
    assert visible(page, STATUS) == ["failed"]
    assert page.inner_text("output") == "1 of 8 runs"
    page.fill("input", "")
    page.select_option("select[aria-label=status]", "")
    page.select_option("select[aria-label=stage]", "simulate")
    assert len(visible(page, STAGE)) == 4


def test_sorts_by_number_and_by_text_both_ways(page):
    heading = page.get_by_role("button", name="time [s]")

    def seconds():
        return [float(text.replace(",", "")) for text in visible(page, SECONDS)]

    heading.click()
    assert seconds() == sorted(seconds())
    heading.click()
    assert seconds() == sorted(seconds(), reverse=True)
    page.get_by_role("button", name="stage").click()
    assert visible(page, STAGE) == sorted(visible(page, STAGE))
    page.get_by_role("button", name="metric").click()
    assert visible(page, 7)[-1] == "–"  # runs without one come last
    page.get_by_role("button", name="metric").click()
    assert visible(page, 7)[-1] == "–"


def test_every_picture_is_one(page):
    size = "async image => { image.loading = 'eager'; await image.decode(); return image.naturalWidth; }"
    sizes = page.eval_on_selector_all("tbody img", f"images => Promise.all(images.map({size}))")
    assert sizes == [160] * 7
