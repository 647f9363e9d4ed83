"""Builds a report: a folder with a page, tables, charts, pictures, and where each number comes from."""

import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from nsf.reporting.finer import FineSource, fine_section, fine_table
from nsf.reporting.keeping import MADE_OF, Kept, made_of
from nsf.reporting.pictures import draw
from nsf.reporting.rivals import beside_rivals, side_by_side
from nsf.reporting.sources import Source, Study, file_hash, open_sources
from nsf.reporting.study import over_seeds, swept, trust_table
from nsf.reporting.tables import (
    PAPER,
    VARIANT,
    Merged,
    bodies,
    means,
    merge,
    rows_of,
    told_apart,
    variants,
    without_constants,
)
from nsf.reporting.text.columns import ABSENT, COSTS, RIVALS, axis, parameter_text
from nsf.results.folder import MARK, replaced
from nsf.results.formats import Rows, latex_table, spreadsheet
from nsf.results.page import Page, Table, html_page, markdown_page

_LEAD = (
    "A reduced-order model of elastoplastic material (Neural Stress Fields) runs beside the full-order "
    "material point method it was trained on, at the same parameter values; this page says how far apart "
    "the two are and what the reduced model saves."
)

_PROVENANCE = (
    "Every number above is read from these runs. sources.json names the run of each row and picture, and the "
    "hash of each file read or written; results.csv holds the rows in full precision, results.tex the first "
    "table."
)

_HEADINGS = ["run", "commit", "device", "precision", "seed", "made", "versions"]
_KEPT = ("commit", "dirty", "device", "precision", "seed", "created", "versions", "parents")


def build_report(evaluate_runs, folder, title: str, first=None, study: Study | None = None) -> Path:
    """Write a report of evaluate runs to folder, replacing a report that is there.

    Writes `index.html`, `index.md`, `results.csv`, `results.tex`, `sources.json`, charts (svg, png) and
    pictures (png, gif). Equal runs give equal files, byte for byte; pictures of a variant whose runs have not
    changed since the report that is there are taken from it.

    Args:
        evaluate_runs: runs of stage `evaluate`; those not complete are passed over.
        folder: where the report goes. It changes only once everything is written.
        title: of the page.
        first: the run that stands for its variant where several are alike in every column; else the newest.
        study: what the report is about; the variants of one scene by default.

    Returns:
        The path of `index.html`.

    Raises:
        MissingRunError: no run is complete.
        SchemaError: a run's file is missing, altered since the run, or lacks a column.
        ConfigError: folder holds something that is not a report.
        StorageError: the disk refused a file.
    """
    evaluate_runs = list(evaluate_runs)
    sources = open_sources(evaluate_runs, first)
    merged = merge(sources, study.settings if study else told_apart(sources))
    with replaced(Path(folder)) as fresh:
        merged.csv.map(spreadsheet).to_csv(fresh / "results.csv", index=False)
        fine = _fine(merged, study)
        own = [fine_section(fine, fresh)] if fine else []
        sweep = swept(merged, study, fresh) if study else []
        kept = Kept.of(Path(folder))
        sections = [*own, *sweep, *draw(merged, fresh, sweep=bool(sweep), study=study, kept=kept)]
        more = [fine_table(fine, study.settings, fresh)] if fine else []
        page = _page(title, merged, sections, study, more, fine, bool(sweep))
        (fresh / "index.html").write_text(html_page(page), encoding="utf-8")
        (fresh / "index.md").write_text(markdown_page(page), encoding="utf-8")
        first_table = page.tables[0]
        (fresh / "results.tex").write_text(
            latex_table(first_table.content, title, first_table.note), encoding="utf-8"
        )
        told = sources_json(page, merged, fresh, fine, study)
        # What the list of reports shows of this one; the last section compares all variants.
        shown = [picture for section in (*sweep, *own, *sections[-1:]) for picture in section.pictures][:1]
        told["chart"] = {"file": shown[0].files[-1], "caption": shown[0].caption} if shown else None
        told |= {
            MADE_OF: made_of(evaluate_runs, title, first, study),
            "drawn": {s.key: [asdict(picture) for picture in s.pictures] for s in sections if s.key},
        }
        text = json.dumps(told, indent=2, ensure_ascii=False) + "\n"
        (fresh / MARK).write_text(text, encoding="utf-8", errors="backslashreplace")
    return Path(folder) / "index.html"


def _fine(merged: Merged, study: Study | None) -> list[FineSource]:
    """The superresolve runs of what is shown, each once."""
    shown = {source.id: source for source in merged.source}
    return [FineSource(run, shown[of]) for of, run in (study.fine if study else {}).items() if of in shown]


def _page(title: str, merged: Merged, sections, study: Study | None, more, fine, sweep: bool) -> Page:
    merged = bodies(merged)
    found = means(merged, study)
    headline, same = without_constants(found)
    printed = found["field"].eq(PAPER).any()
    per_value, same_there = without_constants(merged.frame.drop(columns=[*COSTS, *RIVALS]))
    alike = merged.frame[["scene"] if sweep else ["scene", "method"]].drop_duplicates()
    chosen = (
        f"Of each {alike.columns[-1]}, the pictures show the variant with the smallest mean held-out δ; one "
        "whose runs another solver took over stands last. "
        if len(variants(merged)) > len(alike)
        else ""
    )
    parameter = _parameter_heading(merged)
    note = f"Means over the parameter values of a split. {chosen}{_smaller(merged)}{_said(same)}"
    return Page(
        title=title,
        lead=study.question if study else _LEAD,
        facts=[*_asked(study), *_facts(merged)],
        warnings=_warnings(merged),
        tables=[
            Table("Results beside the paper's" if printed else "Results", rows_of(headline), note),
            *side_by_side(merged),
            *beside_rivals(merged),
            *(over_seeds(merged, study) if study else ()),
            *more,
            Table("Each parameter value", rows_of(per_value, parameter), _said(same_there)),
            *trust_table(merged, parameter),
        ],
        sections=sections,
        provenance=Table("Where the numbers come from", provenance_rows(merged, fine), _PROVENANCE),
    )


def _asked(study: Study | None) -> list[tuple[str, str]]:
    if study is None:
        return []
    return [("The paper", study.paper), *(("Missing", told) for told in study.missing)]


def _warnings(merged: Merged) -> list[str]:
    """What the simulations behind the rows warned of, each once."""
    told: dict[str, None] = {}
    waiting = [source.run for source in merged.source]
    for run in waiting:
        waiting += [parent for parent in run.parent_runs if parent not in waiting]
        if run.stage == "simulate":
            told |= dict.fromkeys(map(str, run.manifest.get("warnings", [])))
    return list(told)


def _parameter_heading(merged: Merged) -> dict[str, str]:
    """The parameter column under its own name and unit, where every row has the same parameter."""
    names = {axis(*source.parameter) for source in merged.source}
    return {"parameter": names.pop()} if len(names) == 1 else {}


def _facts(merged: Merged) -> list[tuple[str, str]]:
    """Scene, parameter and particles, scene by scene."""
    facts = []
    for scene, rows in merged.frame.groupby("scene", sort=False):
        source = merged.source[rows.index[0]]
        name, unit = source.parameter
        values = {
            split: sorted(part["parameter"].unique()) for split, part in rows.groupby("split", sort=False)
        }
        told = "; ".join(
            f"{split} " + ", ".join(parameter_text(value, "", unit) for value in listed)
            for split, listed in values.items()
        )
        latent = sorted(rows["r"].unique())
        facts += [
            ("Scene", source.summary.get("title", scene) + _scale(source)),
            ("Parameter", f"{name}: {told}"),
            (
                "Particles",
                f"{source.particles:,} full-order; {', '.join(map(str, latent))} latent coordinates",
            ),
            (
                "Simulated",
                f"{source.series['t'].max():.3g} s in {int(source.series['frame'].max()):,} frames",
            ),
        ]
        if training := _training(merged, rows):
            facts.append(("Training", training))
    return facts


def _training(merged: Merged, rows) -> str:
    """How long the networks of each field took; a range where several were trained."""
    told = []
    for field, part in rows.groupby("field", sort=False):
        found = {merged.source[i].training_seconds for i in part.index} - {None}
        if found:
            shown = dict.fromkeys(_duration(seconds) for seconds in (min(found), max(found)))
            told.append(f"{' to '.join(shown)} ({field} field)")
    return ", ".join(told)


def _smaller(merged: Merged) -> str:
    """A word of caution beside the paper's figure, where a run is not of the paper's size."""
    scales = {s.summary.get("scale") for s in merged.source if s.summary.get("paper")} - {None, "paper"}
    return f"The paper's δ is of its full size, these runs are of {min(scales)} scale. " if scales else ""


def _scale(source: Source) -> str:
    scale = source.summary.get("scale")
    return f" ({scale} scale)" if scale else ""


def _duration(seconds: float) -> str:
    if seconds >= 5400:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"


def _said(same: str) -> str:
    return f"The same in every row: {same}." if same else ""


def used_sources(merged: Merged, also: Sequence = ()) -> list[Source]:
    """The runs that rows come from and those beside them, newest first."""
    unique = {source.id: source for source in (*merged.source, *also)}
    return sorted(unique.values(), key=lambda source: (source.created, source.id), reverse=True)


def provenance_rows(merged: Merged, also: Sequence = ()) -> Rows:
    """Run, commit, device and versions of everything shown, and of runs that no row of `merged` is of."""
    body = []
    for source in used_sources(merged, also):
        manifest = source.manifest
        versions = ", ".join(
            f"{name} {version}" for name, version in manifest.get("versions", {}).items() if version
        )
        kept = [manifest.get(key) for key in ("device", "precision", "seed", "created")]
        told = [ABSENT if value is None else value for value in kept]
        body.append([source.id, commit_text(manifest), *map(str, told), versions or ABSENT])
    return Rows(_HEADINGS, body, [False] * len(_HEADINGS))


def commit_text(manifest: dict) -> str:
    """The commit a run was made at; says so where the tree had uncommitted changes."""
    commit = str(manifest.get("commit") or "no commit")[:12]
    if manifest.get("dirty") is None:
        return f"{commit} (state of the tree unknown)"
    return f"{commit} + uncommitted changes" if manifest["dirty"] else commit


def sources_json(
    page: Page, merged: Merged, folder: Path, also: Sequence = (), study: Study | None = None
) -> dict:
    """What a report is, the run, commit and file hashes behind every row and picture, and its files' hashes.

    Args:
        page: all of it.
        merged: its rows.
        folder: holds every other file of the report.
        also: runs that no row of `merged` is of.
        study: what the report is about, if it is of an experiment.
    """
    frame = merged.frame
    runs = {
        source.id: {
            **{key: source.manifest.get(key) for key in _KEPT},
            "files": source.hashes,
            "paper": source.summary.get("paper"),
            "scale": source.summary.get("scale"),
            "keys": dict(study.keys.get(source.id, {})) if study else {},
        }
        for source in used_sources(merged, also)
    }
    rows = [
        {"row": i, "run": source.id}
        | {name: _plain(frame[name].iloc[i]) for name in (*VARIANT, "parameter", "split")}
        for i, source in enumerate(merged.source)
    ]
    return {
        "title": page.title,
        "question": page.lead,
        "paper": study.paper if study else None,
        "printed": list(study.printed) if study and study.printed is not None else None,
        "missing": list(study.missing) if study else [],
        "files": {path.name: file_hash(path) for path in sorted(folder.iterdir())},
        "runs": runs,
        "rows": rows,
        "pictures": {
            file: picture.runs for s in page.sections for picture in s.pictures for file in picture.files
        },
        "superseded": [{"run": source.id, "parameter": _plain(value)} for source, value in merged.superseded],
    }


def _plain(value):
    return value.item() if hasattr(value, "item") else value
