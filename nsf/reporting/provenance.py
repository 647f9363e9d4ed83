"""Where each number of a report comes from: for the page, and in full for `sources.json`."""

from collections.abc import Sequence
from pathlib import Path

from nsf.reporting.columns import ABSENT
from nsf.reporting.page import Page, Rows
from nsf.reporting.sources import Source, file_hash
from nsf.reporting.study import Study
from nsf.reporting.tables import VARIANT, Merged

_HEADINGS = ["run", "commit", "device", "precision", "seed", "made", "versions"]


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
    return Rows(_HEADINGS, body)


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
            **{
                key: source.manifest.get(key)
                for key in (
                    "commit",
                    "dirty",
                    "device",
                    "precision",
                    "seed",
                    "created",
                    "versions",
                    "parents",
                )
            },
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
