"""Which of a report stands as it is, because nothing that it is made of has changed.

Neither pandas nor matplotlib is imported: to find that nothing is to be done takes milliseconds.
"""

import hashlib
import importlib.metadata
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any

from nsf.errors import SchemaError
from nsf.results.folder import MARK
from nsf.runs.manifest import altered, digest

#: Files of an evaluate run that a report reads.
FILES = ("results.csv", "series.csv", "frames.npz", "cost.json", "summary.json")
#: What draws and writes, beside the code of this package.
_LIBRARIES = ("matplotlib", "pandas", "numpy", "pillow", "jinja2")
#: Key of `sources.json` under which the sum of all that a report is made of stands.
MADE_OF = "made_of"


@dataclass(frozen=True)
class Kept:
    """Pictures of a report that is to be replaced, by what they are made of.

    Attributes:
        folder: of the report.
        drawn: by key, what `sources.json` says of the pictures.
        hashes: sha256 of each file, by name.
    """

    folder: Path
    drawn: Mapping[str, Sequence[Mapping[str, Any]]]
    hashes: Mapping[str, str]

    @classmethod
    def of(cls, folder: Path) -> "Kept":
        """Those of a folder; none where there is no report that says what it is made of."""
        told = _told(folder)
        drawn, hashes = told.get("drawn"), told.get("files")
        whole = isinstance(drawn, dict) and isinstance(hashes, dict)
        return cls(folder, drawn if whole else {}, hashes if whole else {})

    def take(self, key: str, into: Path) -> list[dict[str, Any]] | None:
        """What is known of a key's pictures, once their files are copied; None where one has changed."""
        found = self.drawn.get(key)
        if found is None:
            return None
        names = [name for picture in found for name in picture["files"]]
        if any(
            Path(name).name != name or not _is(self.folder / name, self.hashes.get(name)) for name in names
        ):
            return None
        for name in names:
            shutil.copyfile(self.folder / name, into / name)
        return [dict(picture) for picture in found]


def unchanged(folder: Path, runs: Iterable, title: str, first=None, study=None) -> Path | None:
    """The page of a report that would be written again as it is; None where something differs.

    Args:
        folder, runs, title, first, study: as for `nsf.reporting.build_report`.
    """
    folder, runs = Path(folder), list(runs)
    told = _told(folder)
    hashes = told.get("files")
    if not isinstance(hashes, dict) or told.get(MADE_OF) != made_of(runs, title, first, study):
        return None
    for run in runs:
        outputs = [output for output in run.manifest.get("outputs", ()) if output["path"] in FILES]
        if any(altered(Path(run.path), output) for output in outputs):
            return None
    there = {path.name for path in folder.iterdir()} - {MARK}
    whole = there == set(hashes) and all(_is(folder / name, wanted) for name, wanted in hashes.items())
    return folder / "index.html" if whole and "index.html" in hashes else None


def made_of(runs: Iterable, title: str, first=None, study=None) -> str:
    """sha256 of all that a report is made of: what it shows of which runs, and what writes it."""
    fine = dict(study.fine) if study else {}
    of_study = {key: value for key, value in vars(study).items() if key != "fine"} if study else {}
    content = {
        "title": title,
        "first": first.id if first else None,
        "runs": {run.id: [run.manifest, _warnings(run)] for run in runs},
        "fine": {of: [run.id, run.manifest] for of, run in fine.items()},
        "study": of_study,
        "code": code(),
    }
    return key_of(content)


def key_of(content: Any) -> str:
    """sha256 of plain values, in whatever order keys were given."""
    text = json.dumps(content, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode(errors="backslashreplace")).hexdigest()


@cache
def code() -> str:
    """sha256 of the text of what writes reports, with the versions of what it draws with."""
    here = Path(__file__).parent
    files = sorted(path for path in here.rglob("*") if path.is_file() and path.suffix != ".pyc")
    texts = {path.relative_to(here).as_posix(): digest(path) for path in files}
    versions = {}
    for name in _LIBRARIES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = None
    return key_of([texts, versions])


def _warnings(run) -> list[str]:
    """What the simulations behind a run warned of."""
    waiting, told = list(run.parent_runs), {}
    for parent in waiting:
        waiting += [one for one in parent.parent_runs if one not in waiting]
        told[parent.id] = list(parent.manifest.get("warnings", ()))
    return [line for _, lines in sorted(told.items()) for line in lines]


def _told(folder: Path) -> dict[str, Any]:
    try:
        told = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}
    return told if isinstance(told, dict) else {}


def _is(path: Path, sha256: str | None) -> bool:
    try:
        return path.is_file() and not path.is_symlink() and digest(path) == sha256
    except (OSError, SchemaError):
        return False


def _plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return asdict(value)
    if isinstance(value, Mapping):
        return dict(value)
    return (
        value.item() if hasattr(value, "item") else list(value) if isinstance(value, Iterable) else str(value)
    )
