"""The reports of a folder: what they found, in the order of a paper, and whether they are as generated.

`make readme` calls it as a program: the pictures and the table of one report are written between two
markers of README.md, so that no result there is typed by hand.
"""

import json
import re
import sys
from collections import Counter
from functools import cache
from math import nan
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from nsf.errors import ConfigError, SchemaError
from nsf.reporting.build import commit_text
from nsf.reporting.finer import fine_means
from nsf.reporting.headline import headline
from nsf.reporting.rivals import where_rivals_win
from nsf.reporting.sources import file_hash
from nsf.reporting.summary import Report
from nsf.reporting.tables import VARIANT, rows_of, without_constants
from nsf.reporting.text.columns import ABSENT, RIVALS, SETTING
from nsf.results.folder import MARK
from nsf.results.formats import Rows, markdown, markdown_document, markdown_table, unescaped
from nsf.results.page import DEFINITIONS
from nsf.runs.provenance import not_ignored
from nsf.storage import writing

LIST = "index.md"
#: Headings, and the folders under each in their order; the last heading is of all others.
CHAPTERS = {
    "Main results": ("table1", "table1_seeds", "operators", "operators_seeds", "forcing"),
    "What the method needs": (
        "ablation", "mlp", "mlp_steps", "width", "latent_dim", "forcing_r", "noise_floor", "floors",
        "sample_size", "sampler", "cells", "timestep", "training", "cake_noise", "cake_runs", "stress",
        "training_runs",
    ),
    "Beyond what was trained": ("extrapolation", "weak_elements", "super_resolution"),
    "At small scale, on a CPU": (
        "small", "inverse", "calibration", "calibration_frame",
        "sensitivities", "tilt", "design", "figures", "quickstart",
    ),
    "One scene in detail, and speed": ("sand", "large", "speed"),
}  # fmt: skip
_OTHERS = "Further reports"
#: The paper's figures and tables with a number or a picture: what they show, and (report, file) for each.
OF_THE_PAPER = (
    ("Figure 1, section 6.1", "cake, cut at several angles", ("table1", "cake-nsf-final-shapes.png")),
    ("Figure 4", "sample and integration particles", ("figures", "sand-nsf-particle-sets.png"),
     ("table1", "cake-nsf-particle-sets.png")),
    ("Figure 5", "bread beside the baseline", ("table1", "bread-nsf-strip.png"),
     ("table1", "bread-deformation_only-strip.png")),
    ("Figure 6", "sand at many more points", ("super_resolution", "sand-basis-superresolution.png")),
    ("Figure 7", "sand at several friction angles", ("sand", "nsf-final-shapes.png")),
    ("Table 1", "seven scenes", ("table1", "delta.png")),
    ("Figures 8 and 9", "metal at several hardening coefficients", ("table1", "metal-nsf-final-shapes.png"),
     ("table1_seeds", "metal-nsf-final-shapes.png")),
    ("Figure 10", "toothpaste at several inclinations", ("table1", "toothpaste-nsf-final-shapes.png")),
    ("Figure 11", "toothpaste with fewer sample particles", ("figures", "toothpaste-settings.png"),
     ("sample_size", "toothpaste-settings.png"), ("sample_size", "delta-over-sampler-size.png")),
    ("Figure 12", "jelly cube beside the baseline", ("table1", "jelly_cube-nsf-strip.png"),
     ("table1", "jelly_cube-deformation_only-strip.png")),
    ("Figure 13", "squishy ball beside the baseline", ("table1", "squishy_ball-nsf-strip.png"),
     ("table1", "squishy_ball-deformation_only-strip.png")),
    ("Figure 14", "bread with perturbed weak elements, 8 and 30 %",
     ("weak_elements", "1-nsf-final-shapes.png"), ("weak_elements", "2-nsf-final-shapes.png"),
     ("weak_elements", "delta.png")),
    ("Figure 15", "training data of bread", ("figures", "bread-nsf-final-shapes.png")),
    ("Figure 16", "training data of sand", ("figures", "sand-nsf-final-shapes.png")),
    ("Figure 17", "sand beyond the friction angles of training", ("extrapolation", "final-shapes.png"),
     ("extrapolation", "error-over-time.png")),
    ("Figure 18", "where the time of a step goes", ("table1", "cake-nsf-runtime.png"),
     ("table1", "metal-nsf-runtime.png")),
    ("Sections 6.1 and 6.3", "1.5 Δt", ("timestep", "delta-over-deploy-dt-multiplier.png"),
     ("figures", "cake-settings.png"), ("figures", "metal-settings.png")),
)  # fmt: skip
#: Charts that the list shows below the main one of each report that has them, and what they show.
FURTHER = {
    "error-map.png": "Displacement error of held-out cases in the plane of both parameters: a panel for each "
    "method, the best first, with the training cases as grey crosses.",
    "error-over-cost.png": "Displacement error over the time for one full-order Δt, for each solver of a "
    "scene; horizontal lines are rivals that take no step.",
    "step-over-particles.png": "Time for one full-order Δt over the particles of the scene, for each solver.",
}
_CHART = {"file": "delta.png", "caption": "Mean δ, each value, and the paper's."}  # of reports that name none
_REBUILD = "build it again with `nsf report`"
_MADE_ANEW = (".gif", ".html", ".svg", ".tex")  # of a report, and not committed

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
REPORT, EXPERIMENT = Path("reports/table1_seeds"), "table1_seeds"
_SHOWN = {"method": "nsf", "field": "basis"}  # one row a scene
#: Whose runs are shown, where there are any, and whose δ stands beside theirs.
_ENGINE, _BESIDE = "operators", "modal"
_PROJECTED = "projected_delta"
_OF_SEEDS = (SETTING, "sample")  # columns in which seeds may differ
_ERRORS = ("delta", "displacement_error", "stress_error")
_STEPS, _MEMORY = ("step_ms_full", "step_ms_reduced"), ("memory_full_mib", "memory_reduced_mib")
_PAPER = "paper_delta"
_PENDING = (
    f"`{REPORT}` holds no report yet: `nsf run +experiment={EXPERIMENT}` writes one, "
    "`make readme` shows it here."
)


def write_list(folder: Path) -> Path:
    """Write `index.md` of a folder of reports, and give it.

    Raises:
        SchemaError: a report's sources.json lacks what the list tells.
        StorageError: the disk refused the file.
    """
    text = _list(folder)
    with writing(folder / LIST) as partial:
        partial.write_text(text, encoding="utf-8")
    return folder / LIST


def faults(folder: Path) -> list[str]:
    """What differs from what was generated, each with its remedy: files of reports, or the list of them.

    Raises:
        SchemaError: a report's sources.json lacks the hashes.
    """
    found = [fault for report in _reports(folder) for fault in _changed(report)]
    if found:
        return found  # a list made from changed files would be no better
    path = folder / LIST
    if not path.is_file() or path.read_text(encoding="utf-8") != _list(folder):
        command = f"nsf reports folder={folder}"
        return [f"{path} does not list the reports as they are; write it with `{command}`"]
    return []


def _changed(report: Path) -> list[str]:
    """Files of a report that are not those whose hashes it holds."""
    known = _sources(report)["files"]
    present = {path.name: file_hash(path) for path in sorted(report.iterdir()) if path.name != MARK}
    missing = {name for name in known.keys() - present.keys() if not name.endswith(_MADE_ANEW)}
    told = {
        "is missing": missing,
        "is not of the report": present.keys() - known.keys(),
        "was changed": {name for name in known.keys() & present.keys() if known[name] != present[name]},
    }
    return [f"{report / name} {what}; {_REBUILD}" for what, names in told.items() for name in sorted(names)]


def _list(folder: Path) -> str:
    sections = {report.name: _section(report, _sources(report)) for report in _reports(folder)}
    sections |= {report.name: _bench_section(report) for report in _benches(folder)}
    titles = Counter(section["title"] for section in sections.values())
    for name, section in sections.items():
        if titles[section["title"]] > 1:
            section["title"] += f" ({name})"
    chapters: dict[str, list[dict]] = {heading: [] for heading in (*CHAPTERS, _OTHERS)}
    for name in sorted(sections, key=_place):
        chapters[_place(name)[1]].append(sections[name] | {"name": name})
    filled = {heading: reports for heading, reports in chapters.items() if reports}
    return markdown_document(
        "list.md", chapters=filled, definitions=DEFINITIONS, of_the_paper=_of_the_paper(folder)
    )


def _of_the_paper(folder: Path) -> list[dict]:
    """Where each of the paper's figures has its like here; those whose report is not there have none."""
    known = {report.name: _sources(report)["files"] for report in _reports(folder)}
    found = []
    for figure, shows, *pictures in OF_THE_PAPER:
        here = [f"{name}/{file}" for name, file in pictures if file in known.get(name, {})]
        found.append({"figure": figure, "shows": shows, "pictures": here})
    return found if any(entry["pictures"] for entry in found) else []


def _place(name: str) -> tuple[int, str, int, str]:
    """Number and heading of a report's chapter, its place in there, and its name."""
    for number, (heading, names) in enumerate(CHAPTERS.items()):
        if (whole := name.removesuffix("_small")) in names:
            return number, heading, names.index(whole), name
    return len(CHAPTERS), _OTHERS, 0, name


def _section(folder: Path, told: dict) -> dict:
    """What the list says of a report; one that is of no evaluate runs says so itself."""
    if listed := told.get("listed"):
        table = Rows(listed["headings"], listed["body"], listed["numeric"])
        kept = {"title": told["title"], "lead": told["question"], "paper": told.get("paper"), "finer": None}
        charts = [{"alt": told["title"]} | told["chart"]] if told.get("chart") else []
        return kept | {"table": table, "said": listed["said"], "charts": charts, "made": listed["made"]}
    report = Report(folder, told)
    table, said = headline(report)
    chart = told.get("chart") or _CHART
    return {
        "title": told["title"],
        "lead": told["question"],
        "paper": told.get("paper"),
        "table": table,
        "said": said,
        "finer": fine_means(folder) if (folder / "superresolution.csv").is_file() else None,
        "charts": [
            *([{"alt": told["title"]} | chart] if chart["file"] in told["files"] else []),
            *(
                {"alt": shows, "file": file, "caption": shows}
                for file, shows in FURTHER.items()
                if file in told["files"] and file != chart["file"]
            ),
        ],
        "made": _made(report),
    }


def _made(report: Report) -> str:
    """How many runs, where, when and from what code, as sentences."""
    runs = report.told["runs"].values()
    days = sorted({str(run["created"])[:10] for run in runs})
    scales = sorted({f"{run['scale']} scale" for run in runs if run.get("scale")})
    where = [
        *(["at " + " and ".join(scales)] if scales else []),
        "on " + ", ".join(sorted(set(report.rows["device"].astype(str)))),
        "in " + ", ".join(sorted(set(report.rows["precision"].astype(str)))),
    ]
    commits = ", ".join(sorted({commit_text(run) for run in runs}))
    count = "1 run" if len(runs) == 1 else f"{len(runs)} runs"
    made = f"{count} {' '.join(where)}, {' to '.join(dict.fromkeys((days[0], days[-1])))}, {commits}."
    missing = len(report.told.get("missing") or ())
    return f"{made} Missing jobs: {missing}, with the reasons in the report." if missing else made


def _bench_section(folder: Path) -> dict:
    """The same of a page of benchmarks: its title, first lines and first chart."""
    page = (folder / LIST).read_text(encoding="utf-8")
    title, lead = map(unescaped, page.split("\n\n")[:2])
    charts = re.findall(r"^!\[(.*)\]\(([\w-]+\.png)\)$", page, re.MULTILINE)
    shown = [{"alt": unescaped(alt), "file": file, "caption": unescaped(alt)} for alt, file in charts[:1]]
    rows = pd.read_csv(folder / "bench.csv")
    devices, commits = (", ".join(sorted(rows[name].astype(str).unique())) for name in ("device", "commit"))
    return {
        "title": title.removeprefix("# "),
        "lead": lead,
        "charts": shown,
        "made": f"{len(rows)} rows on {devices}, {commits}.",
    } | dict.fromkeys(("paper", "table", "said", "finer"))


def _reports(folder: Path) -> list[Path]:
    """Folders of reports that git does not ignore; every one where there is no git."""
    marks = not_ignored(sorted(folder.glob(f"*/{MARK}")))
    return [mark.parent for mark in marks]


def _benches(folder: Path) -> list[Path]:
    """The same of what `nsf bench` wrote."""
    marks = not_ignored(sorted(folder.glob("*/bench.csv")))
    return [mark.parent for mark in marks]


def _sources(report: Path) -> dict:
    told = json.loads((report / MARK).read_text(encoding="utf-8"))
    absent = [key for key in ("title", "question", "runs", "rows", "files") if key not in told]
    if absent:
        raise SchemaError(f"{report / MARK} lacks {', '.join(absent)}; {_REBUILD}")
    return told


def figures(report: Path) -> str:
    """The mean held-out results of this project's method beside the paper's δ, as markdown.

    Means are over all settings of a scene, which are to be seeds. Runs by operators are shown where there are
    any, and the δ of projected steps beside theirs.

    Args:
        report: folder of the report, relative to README.md.
    """
    if not (report / "results.csv").is_file():
        return _PENDING
    folder = report.as_posix()
    frame = pd.read_csv(report / "results.csv")
    for column, value in {"split": "test", **_SHOWN}.items():
        frame = frame[frame[column] == value]
    alike = [name for name in VARIANT if name in frame and name not in _OF_SEEDS]
    frame = frame.assign(**{name: nan for name in RIVALS if name not in frame})
    frame = frame.fillna(dict.fromkeys(alike, ""))
    variants = frame.groupby(alike, sort=False, as_index=False)
    means = variants[[*_ERRORS, *_STEPS, *_MEMORY, *RIVALS]].agg(_mean)
    means["speedup_step"] = means["step_ms_full"] / means["step_ms_reduced"]
    sizes = variants["sample"].agg(lambda values: values.iloc[0] if values.nunique() == 1 else ABSENT)
    means["sample"] = sizes["sample"]
    rivals, projected, own = where_rivals_win(means), {}, "δ [%]"
    if (by_operators := means["engine"] == _ENGINE).any():
        projected = means[means["engine"] == _BESIDE].groupby("scene")["delta"].agg(_mean)
        means, own = means[by_operators].reset_index(drop=True), "δ, operators [%]"
    means[_PAPER] = [_printed(row["scene"], row["method"]) for row in means.to_dict("records")]
    means[_PROJECTED] = [100 * projected.get(scene, nan) for scene in means["scene"]]
    titles = {_PAPER: "paper's δ [%]", _PROJECTED: "δ, projected steps [%]", "delta": own}
    columns = [*alike, "sample", _PAPER, _PROJECTED, *_ERRORS, "speedup_step", *_MEMORY]
    table, same = without_constants(means[columns], keep=("scene",))
    return (
        f"Means over held-out parameter values and seeds ({markdown(same)}).\n\n"
        + markdown_table(rows_of(table, titles))
        + (f"\n\n{markdown(rivals)}" if rivals else "")
        + f"\n\nFrom [`{folder}/results.csv`]({folder}/results.csv); the whole report is "
        f"[`index.md`]({folder}/index.md)."
    )


def _mean(values: pd.Series) -> float:
    """Infinite where one diverged, NaN where one was not measured."""
    return values.mean(skipna=False)


def _printed(scene: str, method: str) -> float:
    """δ [%] that the paper prints of a scene and method, NaN where it prints none."""
    return 100 * _described(scene).paper.get(method, {}).get("delta", float("nan"))


@cache
def _described(scene: str) -> DictConfig:
    """A scene's configuration at the paper's size."""
    from nsf import config  # 0.3 s that `nsf reports` need not pay

    return config.load([f"scene={scene}", "scale=paper"]).scene


def updated(text: str, report: Path) -> str:
    """README.md's text with the figures of a report between the markers.

    Raises:
        ConfigError: the markers are not there once each, in order.
    """
    if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
        raise ConfigError(f"README must hold {BEGIN} and, after it, {END}, once each")
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    return f"{head}{BEGIN}\n{figures(report)}\n{END}{tail}"


if __name__ == "__main__":
    readme = Path(sys.argv[1])
    readme.write_text(updated(readme.read_text(encoding="utf-8"), REPORT), encoding="utf-8")
