"""`nsf validate`: runs the problems, and writes their table, chart and page to `reports/validation`."""

from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from time import process_time

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf.config.scenes import load_scene
from nsf.results.columns import ABSENT, number
from nsf.results.folder import check_place, record, replaced
from nsf.results.formats import Rows, TerminalTable
from nsf.results.page import Page, Picture, Section, Table
from nsf.results.report import commit_text
from nsf.results.style import INK, PALETTE, figure, legend, save, styled
from nsf.results.table import parsed
from nsf.runs.provenance import provenance
from nsf.scalars import one_of

#: Modules of this package and scenes of `conf/scene`, in the order of the table.
PROBLEMS = ("taylor_bar", "cantilever", "discs", "settling", "collapse", "incline")
FILE = "validation.csv"
_LISTED = 8  # first rows of a problem, that the page of all reports has
_TEXTS = ("problem", "quantity", "unit", "published", "source", "limit", "limits", "device", "commit")
_LEAD = "How far are full-order runs from published answers?"
_OFF = (
    "off: from the nearest published value, 0 within their spread; where 0 is published, the value "
    "itself. cell, particles, steps: of the run that gave the value; steps go on from one load to the "
    "next."
)
_SCENES = (
    "Scenes stand in conf/scene. Values are taken from works that cite these sources, not from the sources' "
    "own tables."
)
_TICKS = (-50, -20, -10, -5, -2, -1, 0, 1, 2, 5, 10, 20, 50)
_CHART = "How far off each quantity is; the band is 2 %."


def validate(folder: str | Path, options: Mapping[str, str], say: Callable[[str], object]) -> Path:
    """Run problems, and write the report of these and of those that the folder has already.

    Args:
        folder: of the report; rows of other problems stay.
        options: `problems`, `scale` and `device`, as on the command line.
        say: called with a line on each answer.

    Returns:
        The report's page.

    Raises:
        ConfigError: a value is not one of those there are, or the folder is no report.
        DeviceError: the device does not exist.
    """
    folder, old = Path(folder), None
    problems = options.get("problems", ",".join(PROBLEMS)).split(",")
    names = list(dict.fromkeys(one_of("problems", name, PROBLEMS) for name in problems))
    check_place(folder)
    if (folder / FILE).is_file():
        old = parsed(folder / FILE, _TEXTS)
        old = old[~old["problem"].isin(names)]
    rows = [row for name in names for row in _rows(name, options, say)]
    frame = pd.concat([*([old] if old is not None and len(old) else []), pd.DataFrame(rows)])
    frame = frame.sort_values(
        "problem", key=lambda of: of.map(PROBLEMS.index), kind="stable", ignore_index=True
    )
    return _write(folder, frame)


def _rows(name: str, options: Mapping[str, str], say: Callable[[str], object]) -> list[dict]:
    """The answers of one problem."""
    problem, device = import_module(f"nsf.validation.{name}"), options.get("device", "cpu")
    scene = load_scene(name, [f"scale={options.get('scale', 'small')}"])
    paper = load_scene(name, ["scale=paper"])
    finer = paper if paper.dx < scene.dx else None
    start, rows = process_time(), []
    for answer in problem.answers(scene, finer, device):
        span = dict.fromkeys(map(number, sorted(answer.published)[:: max(1, len(answer.published) - 1)]))
        rows.append({
            "problem": name, "quantity": answer.quantity, "unit": answer.unit,
            "published": " to ".join(span) or ABSENT, "source": answer.source, "computed": answer.computed,
            "off": answer.difference if answer.published else np.nan,
            "cell": answer.cell, "particles": answer.particles, "steps": answer.steps, "seconds": None,
            "limit": answer.limit, "limits": problem.LIMITS,
            "device": device, "commit": commit_text(provenance()),
        })  # fmt: skip
        say(f"{name}: {answer.quantity} {number(answer.computed)}, published {rows[-1]['published']}")
    return [row | {"seconds": process_time() - start} for row in rows]


def table(frame: pd.DataFrame) -> Rows:
    """The table of the page and of `nsf reports`; the title of a problem stands in its first row."""
    first, titles = ~frame["problem"].duplicated(), frame["problem"].map(_title)
    units = frame["unit"].map(lambda unit: f" [{unit}]" if unit != "-" else "")
    columns = {"problem": titles.where(first, ""), "quantity": frame["quantity"] + units}
    columns |= {"published": frame["published"]}
    columns |= {"ours": frame["computed"].map(number), "off [%]": frame["off"].map(number)}
    for heading, key in (("cell [m]", "cell"), ("particles", "particles"), ("steps", "steps")):
        columns[heading] = frame[key].map(number)
    columns["limit"] = frame["limit"].fillna("")
    body = [list(row) for row in zip(*columns.values(), strict=True)]
    texts = ("problem", "quantity", "limit")
    return Rows(list(columns), body, [heading not in texts for heading in columns])


def _title(name: str) -> str:
    """The title of a problem."""
    return import_module(f"nsf.validation.{name}").TITLE


def chart(frame: pd.DataFrame) -> Figure:
    """A point a quantity at how far it is off [%], on a scale that is linear within 2 %."""
    frame = frame.dropna(subset="off")
    with styled():
        fig = figure(0.8 + 0.24 * len(frame))
        panel, at = fig.subplots(), np.arange(len(frame))
        panel.axvspan(-2.0, 2.0, color=PALETTE[0], alpha=0.15, lw=0, label="within 2 %")
        panel.axvline(0.0, color=INK, lw=0.8)
        panel.plot(frame["off"], at, "o", color=PALETTE[0], label="full-order run less published answer")
        panel.set_xscale("symlog", linthresh=2.0)
        panel.set_xlim(*(sign * max(60.0, 1.2 * frame["off"].abs().max()) for sign in (-1.0, 1.0)))
        panel.set_xticks(_TICKS, [f"{tick:g}" for tick in _TICKS])
        panel.set(yticks=at, yticklabels=frame["problem"].str.replace("_", " ") + ": " + frame["quantity"])
        panel.set(xlabel="off [%]", ylim=(len(frame) - 0.5, -0.5))
        panel.grid(axis="x")
        legend(fig)
    return fig


def terminal(page: Path) -> TerminalTable:
    """The table of a report for a terminal."""
    return TerminalTable(table(parsed(page.with_name(FILE), _TEXTS)))


def _write(folder: Path, frame: pd.DataFrame) -> Path:
    """The report of a table, whole or not at all."""
    rows = table(frame)
    made = frame.groupby(["device", "commit"], sort=False).size().reset_index()
    made = "; ".join(
        f"{device}, {commit}" for device, commit in zip(made["device"], made["commit"], strict=True)
    )
    stated = frame[["problem", "limits"]].drop_duplicates()
    limits = [(_title(name), f"limited by {text}") for name, text in stated.itertuples(index=False)]
    with replaced(folder) as fresh:
        frame.to_csv(fresh / FILE, index=False)
        save(chart(frame), fresh, "off", kinds=("png",))
        page = Page(
            title="Published answers", lead=_LEAD, facts=[("Made", made)], warnings=[],
            tables=[Table("Answers", rows, _OFF)], definitions=limits,
            sections=[Section("Chart", [Picture(["off.png"], _CHART, [])])],
            provenance=Table("Scenes and sources", _scenes(frame), _SCENES),
        )  # fmt: skip
        page.write(fresh)
        listed = vars(table(frame.groupby("problem").head(_LISTED))) | {"said": _OFF, "made": made}
        content = {"title": page.title, "question": _LEAD, "runs": {}, "listed": listed}
        record(fresh, content | {"chart": {"file": "off.png", "caption": _CHART}})
    return folder / "index.html"


def _scenes(frame: pd.DataFrame) -> Rows:
    """A row a problem: its scene, where its values are published, and the host's CPU time of all its runs."""
    one = frame.drop_duplicates("problem")
    columns = {
        "scene": one["problem"],
        "published": one["source"],
        "host CPU [s]": one["seconds"].map(number),
    }
    columns |= {"device": one["device"], "commit": one["commit"]}
    body = [list(row) for row in zip(*columns.values(), strict=True)]
    return Rows(list(columns), body, [heading == "host CPU [s]" for heading in columns])
