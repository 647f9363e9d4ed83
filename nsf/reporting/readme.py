"""The figures of README.md: pictures and table of one report, written between two markers.

`make readme` calls it, so that no result in README.md is typed by hand.
"""

import sys
from functools import cache
from pathlib import Path

import pandas as pd
from omegaconf import DictConfig

from nsf import config
from nsf.errors import ConfigError
from nsf.reporting.tables import VARIANT, markdown_table, without_constants

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
REPORT, EXPERIMENT = Path("reports/table1"), "table1"
_PICTURE = "{}-nsf-strip.png"  # of a scene
_ACROSS = 2  # pictures in a row
_ERRORS = ("delta", "displacement_error", "stress_error")
_COSTS = ("speedup_step", "memory_full_mib", "memory_reduced_mib")
_PAPER = "paper_delta"
_PENDING = (
    f"`{REPORT}` holds no report yet: `nsf run +experiment={EXPERIMENT}` writes one, "
    "`make readme` shows it here."
)


def figures(report: Path) -> str:
    """Pictures and the mean held-out results of a report beside the paper's δ, as markdown.

    Args:
        report: folder of the report, relative to README.md.
    """
    if not (report / "results.csv").is_file():
        return _PENDING
    folder = report.as_posix()
    frame = pd.read_csv(report / "results.csv")
    frame = frame[frame["split"] == "test"]
    variants = frame.groupby([name for name in VARIANT if name in frame], sort=False, as_index=False)
    # A value that diverged leaves the mean infinite, one that was not measured leaves it empty.
    means = variants[[*_ERRORS, *_COSTS]].agg(lambda values: values.mean(skipna=False))
    means[_PAPER] = [_printed(row["scene"], row["method"]) for row in means.to_dict("records")]
    described = [name for name in means if name not in (*_ERRORS, *_COSTS, _PAPER)]
    table, same = without_constants(means[[*described, _PAPER, *_ERRORS, *_COSTS]], keep=("scene", "method"))
    gallery = _gallery(report, list(dict.fromkeys(frame["scene"])))
    return (
        f"{gallery}Means over held-out parameter values at the paper's size ({same}).\n\n"
        + markdown_table(table, {_PAPER: "paper's δ [%]"})
        + f"\n\nFrom [`{folder}/results.csv`]({folder}/results.csv); the whole report is "
        f"[`index.md`]({folder}/index.md)."
    )


def _gallery(report: Path, scenes: list[str]) -> str:
    """The strips of the scenes that have one, in a table; each leads to its full size."""
    pictures = {scene: report / _PICTURE.format(scene) for scene in scenes}
    cells = [
        f'<td width="{100 // _ACROSS}%">{_title(scene)}<br>'
        f'<a href="{path.as_posix()}"><img src="{path.as_posix()}" alt="{_title(scene)}: full-order above, '
        f'reduced below"></a></td>'
        for scene, path in pictures.items()
        if path.is_file()
    ]
    if not cells:
        return ""
    rows = ["".join(cells[i : i + _ACROSS]) for i in range(0, len(cells), _ACROSS)]
    told = "Full-order above, reduced below, at a parameter value that was not trained on."
    return "\n".join([told, "", "<table>", *(f"<tr>{row}</tr>" for row in rows), "</table>", "", ""])


def _title(scene: str) -> str:
    return _described(scene).title


def _printed(scene: str, method: str) -> float:
    """δ [%] that the paper prints of a scene and method, NaN where it prints none."""
    return 100 * _described(scene).paper.get(method, {}).get("delta", float("nan"))


@cache
def _described(scene: str) -> DictConfig:
    """A scene's configuration at the paper's size."""
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
