"""What a report shows of reduced runs at many more points."""

import shutil
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from nsf.reporting.sources import Source, checked_hash
from nsf.reporting.text.columns import Column, parameter_text
from nsf.results.formats import Rows, file_name, spreadsheet
from nsf.results.page import Picture, Section, Table

_TABLE, _PICTURE = "superresolution.csv", "superresolution.png"
_HEADING = "At many more points"
_PERCENT = ("%", 100.0)
_COLUMNS = (
    Column("factor", "points for each particle"),
    Column("points", "points"),
    Column("delta", "δ at the points", *_PERCENT),
    Column("particles_delta", "δ at the particles", *_PERCENT),
    Column("displacement_error", "displacement error at the points", *_PERCENT),
    Column("particles_displacement_error", "displacement error at the particles", *_PERCENT),
    Column("full_order_difference", "displacement error, few beside many full-order particles", *_PERCENT),
    Column("interpolation_error", "displacement error of interpolation", *_PERCENT),
    Column("smeared", "smeared", *_PERCENT),
    Column("seconds", "query", "s"),
    Column("full_order_seconds", "fine full-order run", "s"),
)
_NOTE = (
    "The reduced run's fields, beside a full-order run of as many particles on the same grid, at the frames "
    "that super_resolution.frames spreads over the run. The training particles are among the points. "
    "Displacement errors too: of a full-order run of the training particles beside the fine one, at those "
    "they share, which is what no field can know (few beside many); and of the fine run's own positions at "
    "the training particles, interpolated to the points left out (interpolation). Smeared is the share of "
    "these that interpolation puts more than half a grid cell away in the last frame. The query is of all "
    "these frames together; values are queried together too, and share its time equally."
)
_MEANS = (
    "points", "displacement_error", "particles_displacement_error", "full_order_difference",
    "interpolation_error", "seconds", "full_order_seconds",
)  # fmt: skip
_TOLD = ("scene", "method", "field", "r", "engine", "sample")  # of a variant, in results.csv


class FineSource:
    """A superresolve run whose files are whole, and the evaluate run of the same deployment.

    Raises:
        SchemaError: a file is missing or differs from its manifest.
    """

    def __init__(self, run, source: Source):
        self.run, self.id, self.manifest, self.of = run, run.id, run.manifest, source
        self.hashes = {name: checked_hash(run, name) for name in (_TABLE, _PICTURE)}
        self.table = pd.read_csv(Path(run.path) / _TABLE)
        self.summary: dict = {}

    @property
    def created(self) -> str:
        """When the run was made (ISO), by its manifest."""
        return str(self.manifest.get("created", ""))


def fine_table(fine: Sequence[FineSource], settings, folder: Path) -> Table:
    """A row a run and parameter value; the numbers in full go to `superresolution.csv` in the folder.

    Args:
        fine: runs.
        settings: by evaluate run id, what tells jobs of a scene apart; empty where nothing does.
        folder: of the report.
    """
    variants = [_variant(f, settings) for f in fine]
    varied = [name for name in variants[0] if len({variant[name] for variant in variants}) > 1]
    known = ["scene", *(name for name in varied if name != "scene")]
    frames = [f.table.assign(**variant) for f, variant in zip(fine, variants, strict=True)]
    frame = pd.concat(frames, ignore_index=True)[[*known, *fine[0].table]]
    frame.map(spreadsheet).to_csv(folder / _TABLE, index=False)
    units = {f.of.results["scene"].iloc[0]: f.of.parameter[1] for f in fine}
    body = [
        [
            *(str(row[name]) for name in known),
            parameter_text(row["parameter"], "", units[row["scene"]]),
            *(column.text(row[column.name]) for column in _COLUMNS),
        ]
        for row in frame.to_dict("records")
    ]
    headings = [*known, "parameter", *(c.heading for c in _COLUMNS)]
    return Table(_HEADING, Rows(headings, body, [False] * len(headings)), _NOTE)


def fine_means(folder: Path) -> Rows:
    """Means over parameter values of a report's `superresolution.csv`, a row a variant."""
    frame = pd.read_csv(folder / _TABLE)
    known = list(frame.columns[: frame.columns.get_loc("parameter")])
    columns = [column for column in _COLUMNS if column.name in _MEANS]
    means = frame.groupby(known, sort=False, as_index=False)[[column.name for column in columns]].mean()
    body = [
        [*(str(row[name]) for name in known), *(column.text(row[column.name]) for column in columns)]
        for row in means.to_dict("records")
    ]
    headings = [*known, *(column.heading for column in columns)]
    return Rows(headings, body, [i >= len(known) for i in range(len(headings))])


def _variant(f: FineSource, settings) -> dict:
    """What tells a job from others."""
    return f.of.results.iloc[0][list(_TOLD)].to_dict() | {"setting": settings.get(f.of.id, "")}


def fine_section(fine: Sequence[FineSource], folder: Path) -> Section:
    """The picture of each run."""
    pictures = []
    for index, f in enumerate(fine):
        variant = _variant(f, {})
        name = file_name(f"{variant['scene']}-{variant['field']}-superresolution{index or ''}") + ".png"
        shutil.copyfile(Path(f.run.path) / _PICTURE, folder / name)
        caption = (
            f"The last frame of {variant['scene']} ({variant['field']} field): the reduced run at its "
            "particles, the same at many more points, and a full-order run of as many particles; whole "
            "bodies, coloured by how far they moved."
        )
        pictures.append(Picture([name], caption, [f.id]))
    return Section(_HEADING, pictures)
