"""The folder of a report: its record, and how it is replaced, whole or not at all.

A record is one of the same form in `sources.json`, beside a report's files, and for each report by name in
`provenance.json` of a folder of reports.
"""

import json
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from nsf import schemas
from nsf.errors import ConfigError, SchemaError, StorageError
from nsf.manifest import digest
from nsf.storage import locked

MARK = "sources.json"
"""The file by which a folder is known as a report: it names every other file of the folder."""

PROVENANCE = "provenance.json"
"""The file of a folder of reports that has the record of each, as far as it is committed."""

ANY = {"title": str, "files": {...: str}, "runs": {...: dict}}
"""Of the record of any report: title, sha256 by file, origin by run id."""

RECORD = ANY | {
    "question": str,
    "paper": str,
    "missing": [str],
    "plots": ([str], None),
    "trained": {...: [dict]},
    "logarithmic": [str],
    "pictures": {...: {"caption": str, "runs": [str]}},
}
"""Of the record of a report of evaluate runs."""

COMMITTED = RECORD | {"charts": {...: str}}
"""Of the same where it is committed, with what tells whether its charts are as the table has them."""

_PAGES = ("index.html", "index.md", "results.csv", "results.tex", "superresolution.csv")
_MOST_BYTES = 2**26  # of a record


def read(path: Path, schema: Mapping = ANY) -> dict[str, Any]:
    """The record of a report, or those of a folder of reports.

    Raises:
        SchemaError: it is none.
    """
    try:
        return schemas.read(path, schema, _MOST_BYTES)
    except SchemaError as error:
        raise SchemaError(f"{path.parent}: {error}; write the report again, or take it from git") from error


def check_place(folder: Path) -> None:
    """Refuse a place where `replaced` could not put a report; the folder above it is made.

    Raises:
        ConfigError: `folder` holds a file that no report wrote.
        StorageError: the folder above it cannot be made or written.
    """
    folder = Path(folder).absolute()
    if fault := _of_others(folder):
        raise ConfigError(
            f"{folder} exists and is not a report ({fault}); name another folder or move it away"
        )
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder.parent).close()
    except OSError as error:
        raise _no_place(folder, error) from error


def check_inside(folder: Path, reports: Path) -> None:
    """Refuse a folder that a file from elsewhere names outside of the folder of reports.

    Raises:
        ConfigError: says how to allow it.
    """
    if not Path(folder).resolve().is_relative_to(Path(reports).resolve()):
        raise ConfigError(
            f"report.folder={folder} lies outside of the reports folder {reports}, and the experiment's file "
            f"says so; give report.folder={folder} on the command line if the report is to go there"
        )


def _of_others(folder: Path) -> str:
    """Why a folder may not be replaced: what is in it that no report wrote; empty where it may."""
    try:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return ""
        recorded = read(folder / MARK)["files"] if (folder / MARK).exists() else _committed(folder)
        named = {MARK, *recorded}
        others = [path for path in sorted(folder.iterdir()) if path.name not in named or not path.is_file()]
    except NotADirectoryError:
        return "it is a file"
    except PermissionError:
        return "it cannot be read"
    except (OSError, SchemaError):
        return f"its {MARK} is of another program"
    if others and not (folder / MARK).exists():
        return f"it has no {MARK}"
    return f"no report wrote its {others[0].name}" if others else ""


def _committed(folder: Path) -> set[str]:
    """Names of the files of a report that a folder of reports above has the record of; none of others.

    They are its pictures, the same as SVG, and the pages and tables that `nsf reports` makes of it.
    """
    for reports in folder.parents[:2]:
        if (reports / PROVENANCE).is_file():
            records = read(reports / PROVENANCE, {...: COMMITTED})
            record = records.get(folder.relative_to(reports).as_posix(), {})
            pictures = {Path(file) for key in ("pictures", "charts") for file in record.get(key, {})}
            files = {str(file.with_suffix(kind)) for file in pictures for kind in (".png", ".svg")}
            return files | {*_PAGES} if files else set()
    return set()


def _no_place(folder: Path, error: OSError) -> StorageError:
    return StorageError(
        f"no report can be written to {folder}: {error.strerror}; make the folder above it writable, or "
        "set report.folder or NSF_REPORTS"
    )


def record(folder: Path, content: Mapping[str, Any]) -> None:
    """Write `sources.json`: what a report says of itself, and the sha256 of each of its files."""
    files = {path.name: digest(path) for path in sorted(folder.iterdir())}
    text = json.dumps({**content, "files": files}, indent=1, ensure_ascii=False, default=plain)
    (folder / MARK).write_text(f"{text}\n", encoding="utf-8", errors="backslashreplace")


def plain(value: Any) -> Any:
    """A value as JSON has it."""
    if hasattr(value, "item"):
        return value.item()
    return dict(value) if isinstance(value, Mapping) else list(value)


@contextmanager
def replaced(folder: Path) -> Iterator[Path]:
    """An empty folder to write into; it takes `folder`'s place once the block ends without an error.

    Until then, and after any error or interrupt, whatever stood at `folder` stands there unchanged. Two
    processes that replace it do so in turn, by the lock `.<name>.lock` beside it, which stays. What a killed
    process left in `.<name>.partial` is removed, or put back, by the next one.

    Raises:
        ConfigError: `folder` holds a file that no report wrote.
        StorageError: the disk refused a file.
    """
    folder = Path(folder).absolute()
    check_place(folder)
    lock, work = (folder.with_name(f".{folder.name}.{end}") for end in ("lock", "partial"))
    fresh, old = work / "new", work / "old"
    waiting = f"waiting for another process, which writes {folder}"
    with locked(lock, waiting=lambda: print(waiting, file=sys.stderr)):
        try:
            if old.is_dir() and not folder.exists():
                old.rename(folder)
            shutil.rmtree(work, ignore_errors=True)
            fresh.mkdir(parents=True)
        except OSError as error:
            raise _no_place(folder, error) from error
        try:
            yield fresh
            _take_place(fresh, folder, old)
        except OSError as error:
            raise StorageError(
                f"the report for {folder} was not written: {error}; the old one, if any, stands"
            ) from error
        finally:
            shutil.rmtree(work, ignore_errors=True)


def _take_place(fresh: Path, folder: Path, old: Path) -> None:
    if folder.exists():
        folder.rename(old)
    try:
        fresh.rename(folder)
    except BaseException:
        if old.exists():
            old.rename(folder)
        raise
