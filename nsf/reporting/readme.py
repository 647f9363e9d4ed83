"""The figures of README.md: picture and table of one report, written between two markers.

`make readme` calls it, so that no result in README.md is typed by hand.
"""

import sys
from pathlib import Path

import pandas as pd

from nsf import config
from nsf.errors import ConfigError
from nsf.reporting.columns import MEASURED
from nsf.reporting.tables import VARIANT, markdown_table, without_constants

BEGIN, END = "<!-- figures:begin -->", "<!-- figures:end -->"
REPORT, SCENE = Path("reports/sand"), "sand"
_PENDING = (
    f"`{REPORT}` holds no report yet: `nsf run scene={SCENE} scale=paper` writes one, "
    "`make readme` shows it here."
)


def figures(report: Path) -> str:
    """The picture and the mean held-out results of a report, as markdown.

    Args:
        report: folder of the report, relative to README.md.
    """
    if not (report / "results.csv").is_file():
        return _PENDING
    frame = pd.read_csv(report / "results.csv")
    frame = frame[frame["split"] == "test"]
    by = [name for name in VARIANT if name in frame]
    variants = frame.groupby(by, sort=False, as_index=False)
    # A value that diverged leaves the mean infinite, one that was not measured leaves it empty.
    means = variants[list(MEASURED)].agg(lambda values: values.mean(skipna=False))
    table, same = without_constants(means, keep=("method",))
    paper = config.load([f"scene={SCENE}", "scale=paper"]).scene.paper
    # A report of several methods names its pictures by method.
    several = (report / "nsf-final-shapes.png").is_file()
    picture = "nsf-final-shapes.png" if several else "final-shapes.png"
    return (
        f"![Final shapes, reduced beside full-order]({report.as_posix()}/{picture})\n\n"
        f"Means over {frame['parameter'].nunique()} held-out parameter values ({same}). "
        f"The paper prints δ = {100 * paper.nsf.delta:g} % ({paper.place}).\n\n"
        f"{markdown_table(table)}\n\n"
        f"From [`{report.as_posix()}/results.csv`]({report.as_posix()}/results.csv); "
        f"the whole report is [`index.md`]({report.as_posix()}/index.md)."
    )


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
