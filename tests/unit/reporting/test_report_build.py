"""The report folder: complete, traceable, made of the runs' numbers, and replaced whole or not at all."""

import json
import re

import pandas as pd
import pytest
from PIL import Image
from synthetic import TEST, Made, rewrite_manifest, seal, write_run

from nsf.bodies import camera
from nsf.errors import ConfigError, StorageError
from nsf.reporting import build, build_report, pictures
from nsf.reporting.sections.variant import Variant, order
from nsf.reporting.sources import Source, Study, file_hash, open_sources
from nsf.reporting.study import estimate_note, spearman, trust_note
from nsf.reporting.tables import merge
from nsf.reporting.text.columns import number
from nsf.results import style
from nsf.runs import Run

ERRORS = ("error-over-time.png", "error-over-time.svg")
TINY = Made(particles=30, frames=4, parameters=TEST[:2], splits=("test",) * 2)


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_report_has_every_file_and_links_only_what_is_there(report):
    present = {path.name for path in report.iterdir()}
    assert {"index.html", "index.md", "results.csv", "sources.json", "delta.svg", "delta.png"} <= present
    page, markdown = (report / "index.html").read_text(), (report / "index.md").read_text()
    linked = set(re.findall(r'src="([^"]+)"', page)) | set(re.findall(r"\]\(([^)]+)\)", markdown))
    assert linked <= present
    drawn = present - {"index.html", "index.md", "results.csv", "results.tex", "sources.json"}
    assert {name.rsplit(".")[0] for name in drawn} == {name.rsplit(".")[0] for name in linked}
    assert "http" not in page.replace("http-equiv", "")


def test_page_opens_with_what_it_is_then_tables_then_pictures_then_provenance(report):
    page = (report / "index.html").read_text()
    marks = [
        "<h1>Sand &amp; friends</h1>",
        "friction angle: test 22.5°",
        "71,363",
        "Results beside the paper",
    ]
    marks += [
        "Each parameter value",
        "<figure>",
        "Where the numbers come from",
        "1f2e3d4c5b6a + uncommitted changes",
    ]
    places = [page.index(mark) for mark in marks]
    assert places == sorted(places)


def test_training_time_and_scale_are_told_by_field(tmp_path, no_pictures):
    """A report that mixes fields or scales must not show one's figure for all."""
    small = {**vars(TINY), "scale": "small"}
    runs = [
        write_run(tmp_path / "runs", Made(**small | {"field": field, "training_seconds": seconds}))
        for field, seconds in (("basis", 9.0), ("mlp", 240.0))
    ]
    page = build_report(runs, tmp_path / "report", "Sand").read_text()
    assert "9 s (basis field)" in page
    assert "4.0 min (mlp field)" in page
    assert "these runs are of small scale" in page


@pytest.mark.slow
def test_pictures_of_many_variants_are_the_same_from_several_processes(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(style, "PIXELS", 2 * style.PIXELS)  # as in other processes
    monkeypatch.setattr(camera, "_OVERSAMPLE", 2 * camera._OVERSAMPLE)
    report = build_report(sweep, tmp_path / "one" / "sand", "Sand & friends").parent
    monkeypatch.setattr(pictures, "_FEW", 1)
    monkeypatch.setattr(pictures.os, "cpu_count", lambda: 2)
    asked = []
    pool = pictures.ProcessPoolExecutor
    monkeypatch.setattr(pictures, "ProcessPoolExecutor", lambda n, **how: asked.append(n) or pool(n, **how))
    again = build_report(sweep, tmp_path / "sand", "Sand & friends").parent
    assert asked == [2]
    assert files(again) == files(report)


def test_pictures_are_of_the_best_sample_of_each_method(report):
    for stem in ("final-shapes", "particle-sets"):
        drawn = {path.name for path in report.glob(f"*{stem}.png")}
        assert drawn == {f"nsf-{stem}.png", f"deformation_only-{stem}.png"}
    assert "smallest mean held-out δ" in (report / "index.md").read_text()
    assert "nsf · |S| 150" in (report / "index.html").read_text()
    assert "300 of 71,363 particles are drawn." in (report / "index.md").read_text()


def test_sources_lead_from_each_row_to_its_run(report, sweep):
    told = json.loads((report / "sources.json").read_text())
    frame = pd.read_csv(report / "results.csv")
    assert told["files"]["results.csv"] == file_hash(report / "results.csv")
    assert len(told["rows"]) == len(frame)
    for entry, row in zip(told["rows"], frame.to_dict("records"), strict=True):
        run = next(run for run in sweep if run.id == entry["run"])
        rows = pd.read_csv(run.path / "results.csv")
        assert rows.loc[rows["parameter"] == row["parameter"], "delta"].item() == row["delta"]
        assert told["runs"][run.id]["commit"] == run.manifest["commit"]
        assert told["runs"][run.id]["files"]["results.csv"] == file_hash(run.path / "results.csv")
    assert set(told["pictures"]) == {
        path.name for path in report.iterdir() if path.suffix in (".svg", ".png", ".gif")
    }


def test_numbers_on_the_page_come_from_the_csv(tmp_path, no_pictures):
    run = write_run(tmp_path, TINY)
    before = build_report([run], tmp_path / "report", "t").read_text()
    rows = pd.read_csv(run.path / "results.csv")
    rows.loc[0, "delta"] = 0.01234567
    rows.to_csv(run.path / "results.csv", index=False)
    seal(run)
    after = build_report([run], tmp_path / "report", "t").read_text()
    mean = number(rows["delta"].mean(), 100)
    assert "1.23" not in before
    assert ">1.23<" in after
    assert f">{mean}<" in after


@pytest.fixture(scope="module")
def diverged(tmp_path_factory, few_pictures):
    """A run of two values, one of which diverged, and its report of few pictures."""
    run = write_run(tmp_path_factory.mktemp("runs"), TINY)
    for name in ("results.csv", "series.csv"):
        rows = pd.read_csv(run.path / name)
        rows.loc[rows["parameter"] == TEST[0], "delta"] = float("inf")
        rows.to_csv(run.path / name, index=False)
    seal(run)
    with few_pictures():
        return run, build_report([run], tmp_path_factory.mktemp("reports") / "diverged", "t").parent


def test_a_diverged_run_still_gives_a_report_that_says_so(diverged):
    page = (diverged[1] / "index.html").read_text()
    assert page.count('<td class="number">∞</td>') == 3  # its own row, the mean, and beside other solvers


def test_a_motion_knows_when_its_run_stopped(diverged):
    lost, good = Source(diverged[0]).motions(TEST[:2])
    assert lost.stopped == 0.0
    assert good.stopped is None


def test_a_folder_that_cannot_be_made_names_the_remedy(tmp_path):
    run = write_run(tmp_path / "runs", TINY)
    (tmp_path / "reports").touch()
    with pytest.raises(StorageError, match=r"sand: File exists; make the folder above .* set report\.folder"):
        build_report([run], tmp_path / "reports" / "sand", "t")


def test_equal_runs_give_equal_files(diverged, tmp_path, few_pictures):
    run, folder = diverged
    with few_pictures():
        assert files(build_report([run], tmp_path / "again", "t").parent) == files(folder)


@pytest.mark.parametrize("fault", [KeyboardInterrupt(), RuntimeError("broke"), OSError(28, "No space left")])
def test_interrupted_build_leaves_the_old_report(tmp_path, no_pictures, monkeypatch, fault):
    run = write_run(tmp_path / "runs", TINY)
    folder = build_report([run], tmp_path / "reports" / "sand", "old").parent
    old = files(folder)

    def fails(page):
        raise fault

    monkeypatch.setattr(build, "markdown_page", fails)
    with pytest.raises(StorageError if isinstance(fault, OSError) else type(fault)):
        build_report([run], folder, "new")
    assert files(folder) == old
    assert {path.name for path in folder.parent.iterdir()} <= {"sand", ".sand.lock"}


def test_replacing_leaves_nothing_of_the_old_report(tmp_path, no_pictures):
    run = write_run(tmp_path / "runs", TINY)
    folder = build_report([run], tmp_path / "reports" / "sand", "old").parent
    (folder / "stale.png").touch()
    build_report([run], folder, "new")
    assert not (folder / "stale.png").exists()
    assert "<h1>new</h1>" in (folder / "index.html").read_text()
    assert {path.name for path in folder.parent.iterdir()} <= {"sand", ".sand.lock"}


def test_a_folder_that_is_no_report_is_not_replaced(tmp_path, no_pictures):
    run = write_run(tmp_path / "runs", TINY)
    (tmp_path / "precious").mkdir()
    (tmp_path / "precious" / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="not a report"):
        build_report([run], tmp_path / "precious", "t")
    assert (tmp_path / "precious" / "thesis.tex").exists()


def test_animation_is_small_and_has_the_frames(report):
    path = report / "nsf-animation.gif"
    assert path.stat().st_size < 3 * 2**20
    with Image.open(path) as image:
        assert image.n_frames == Made().frames
        assert image.convert("RGB").getpixel((2, 2)) == (255, 255, 255)


@pytest.mark.slow
def test_animations_of_a_crowded_page_are_of_one_value_and_fewer_frames(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "CROWDED_BYTES", 2 * pictures.ANIMATIONS_BYTES)
    monkeypatch.setattr(pictures, "CROWDED_FRAMES", 3)
    drawn = []
    monkeypatch.setattr(pictures.shapes, "animation", lambda cases, *_, **keys: drawn.append((cases, keys)))
    run = write_run(tmp_path / "runs", TINY)
    build_report([run], tmp_path / "report", "t")
    ((cases, keys),) = drawn
    rows = pd.read_csv(run.path / "results.csv").set_index("parameter")
    assert [case.motion.parameter for case in cases] == [rows["delta"].idxmax()]  # the worst
    assert keys["frames"] == 3


@pytest.mark.slow
def test_a_sweep_shows_the_best_variant_of_a_scene_and_does_not_animate_it(tmp_path):
    found, keys = [], {}
    for size, noise, method in ((20, 0.02, "nsf"), (50, 0.004, "nsf"), (50, 0.05, "neural_stress_only")):
        run = write_run(
            tmp_path / "runs", Made(**vars(TINY) | {"sample": size, "noise": noise, "method": method})
        )
        found.append(run)
        keys[run.id] = {"scene": "sand", "method": method, "sampler.size": str(size)}
    study = Study("How many?", "Two.", {}, keys, [])
    folder = build_report(found, tmp_path / "report", "t", study=study).parent
    assert {path.name for path in folder.glob("*strip*")} == {"strip.png"}
    assert not list(folder.glob("*.gif"))
    page = (folder / "index.md").read_text()
    assert "Of each scene, the pictures show" in page
    assert r"## sand · nsf · \|S\| 50" in page


@pytest.mark.slow
def test_of_very_many_methods_each_has_its_strip_and_its_error(sweep, tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "MANY", 1)
    folder = build_report(sweep, tmp_path / "report", "t").parent
    for method in ("nsf", "deformation_only"):
        drawn = {path.name for path in folder.glob(f"{method}-*")}
        assert drawn == {f"{method}-{name}" for name in ("strip.png", *ERRORS)}


def test_one_value_without_paper_or_costs(tmp_path):
    run = write_run(
        tmp_path, Made(particles=30, frames=2, parameters=TEST[:1], splits=("train",), paper=False, r=1)
    )
    rows = pd.read_csv(run.path / "results.csv")
    rows[["memory_full_mib", "memory_reduced_mib", "speedup_step"]] = float("nan")
    rows.to_csv(run.path / "results.csv", index=False)
    (run.path / "cost.json").write_text("{}")
    seal(run)
    page = build_report([run], tmp_path / "report", "t").read_text()
    assert "runtime" not in {path.stem for path in (tmp_path / "report").iterdir()}
    assert "held out from training" not in page


def test_trust_beside_the_true_error(tmp_path, no_pictures):
    made = Made(**(vars(Made(particles=30, frames=4)) | {"trust": (0.4, 0.8, 3.0, None)}))
    run = write_run(tmp_path / "runs", made)
    delta = pd.read_csv(run.path / "results.csv")["delta"]
    page = build_report([run], tmp_path / "report", "Sand").parent / "index.md"
    section = page.read_text().split("## Trust")[1].split("##")[0]
    assert "distrust ratio" in section
    assert "first distrusted [s]" in section
    rows = [line for line in section.splitlines() if line.startswith("| 36")]
    assert "∞" in rows[0]
    ranks = pd.Series([1.0, 2.0, 3.0, 4.0])
    agreement = f"{ranks.corr(delta.rank()):.2f}"
    assert (
        f"Over the 4 reduced runs of this table its Spearman rank correlation with the true δ is {agreement}"
        in section
    )


def test_runs_that_know_no_trust_show_none(tmp_path, no_pictures):
    page = build_report([write_run(tmp_path / "runs", TINY)], tmp_path / "report", "Sand")
    assert "<h2>Trust" not in page.read_text()


def test_warnings_of_the_simulations_behind_the_rows(tmp_path, no_pictures):
    """Once each, whether the evaluate run or one that it goes back to names the simulation."""
    thin, coarse = "<b>thin</b>: 0.7 cells across; dx=0.01 would do", "coarse"
    told = {"a": [thin, coarse], "b": [coarse], "c": []}
    simulations = [Run.open("simulate", "sand", {"of": of}, root=tmp_path / "runs") for of in told]
    trained = Run.open("train", "sand", {}, simulations[1:], root=tmp_path / "runs")
    for run in (*simulations, trained):
        with run.record():
            pass
    for run, warnings in zip(simulations, told.values(), strict=True):
        rewrite_manifest(run, warnings=warnings)
    run = write_run(tmp_path / "runs", TINY)
    run = Run.load(run.id, tmp_path / "runs")
    rewrite_manifest(run, parents=[simulations[0].id, trained.id])
    folder = build_report([run], tmp_path / "report", "Sand").parent
    page, text = (folder / "index.html").read_text(), (folder / "index.md").read_text()
    assert page.count("<li>") == 2
    assert "<li>&lt;b&gt;thin&lt;/b&gt;: 0.7 cells across; dx=0.01 would do</li>" in page
    assert page.index("<h2>Warnings</h2>") < page.index("<table>")
    assert "- &lt;b&gt;thin&lt;/b&gt;: 0.7 cells across; dx=0.01 would do\n- coarse\n\n## Results" in text
    rewrite_manifest(run, parents=[simulations[2].id])
    assert "Warnings" not in build_report([run], tmp_path / "report", "Sand").read_text()


@pytest.mark.parametrize(
    ("b", "expected"), [([10, 20, 30], 1.0), ([3, 2, 1], -1.0), ([1.0, float("inf"), 2.0], 0.5)]
)
def test_spearman(b, expected):
    assert spearman(pd.Series([1, 2, 3]), pd.Series(b)) == pytest.approx(expected)


def test_a_run_that_was_handed_over_does_not_count(tmp_path):
    frame = pd.DataFrame({"trust": [0.5, 1.0, 2.0, 9.0], "delta": [1.0, 2.0, 3.0, 0.0]})
    frame["handed_over_at"] = [float("nan")] * 3 + [0.1]
    assert "Over the 3 reduced runs" in trust_note(frame)
    assert "is 1.00." in trust_note(frame)
    assert "Spearman" not in trust_note(frame[1:])


def test_an_estimate_stands_beside_the_true_error():
    frame = pd.DataFrame({"estimated_error": [1.0, 2.0, 3.0, 4.0, 6.0, float("nan")]})
    frame["true_error"] = [2.0, 3.0, 4.0, 6.0, 5.0, 9.0]
    frame["handed_over"] = [0.0, 0.0, 0.5, 0.0, 0.2, 0.0]
    assert "over 5 runs is 0.90." in estimate_note(frame)
    assert estimate_note(frame[1:]) == ""


def test_captions_say_where_the_full_order_solver_goes_on(tmp_path):
    run = write_run(tmp_path / "runs", Made(**(vars(TINY) | {"trust": (0.4, 3.0)})))
    summary = json.loads((run.path / "summary.json").read_text())

    def said():
        merged = merge(open_sources([run]))
        return Variant(merged, [0, 1], "nsf").continued()

    assert said() == ""
    summary["trust"][1]["handed_over_at"] = 0.15
    (run.path / "summary.json").write_text(json.dumps(summary))
    seal(run)
    assert said() == " The full-order solver goes on at 27.5° from 0.15 s on."


@pytest.mark.parametrize(("share", "told"), [(1.0, True), (0.5, False)])
def test_captions_say_that_projected_steps_took_the_runs_of_operators(tmp_path, share, told):
    merged = merge(open_sources([write_run(tmp_path / "runs", TINY)]))
    merged.frame["engine"], merged.frame["handed_over"] = "operators", share
    taken = Variant(merged, [0, 1], "nsf")
    assert ("Projected steps took these runs" in taken.continued()) == told
    assert order(taken)[0] == told  # pictures are of a variant that took its own steps, if there is one
