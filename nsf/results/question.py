"""The question of a report, and whether the report that is there still answers it.

Neither pandas nor matplotlib is imported: to find that nothing is to be done takes milliseconds.
"""

import hashlib
import importlib.metadata
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from nsf.errors import SchemaError
from nsf.manifest import altered, digest
from nsf.results.folder import ANY, MARK, plain, read
from nsf.runs.run import Run

FILES = ("results.csv", "series.csv", "frames.npz", "cost.json", "summary.json")
"""Files of an evaluate run."""
_IN_COLUMNS = (
    *("scene", "model", "stress", "affine", "field"),
    *("latent_dim", "material", "seed", "scale", "precision", "device", "deploy.split"),
)
_PASSING = ("evaluation.", "data.", "super_resolution.", "report.")  # keys that tell no models apart
_LIBRARIES = ("matplotlib", "pandas", "numpy", "pillow", "jinja2")  # that draw and write


@dataclass(frozen=True)
class Question:
    """A question that a report answers.

    Attributes:
        name: of the report, as `table1/seeds`.
        title, text: of the page, and the question.
        paper: what the paper says of it.
        keys: by run id, the keys and values of its job.
        defaults: by run id, numbers of keys that its job leaves out and another job of its scene sets.
        printed: δ that the paper prints of single jobs: each {"delta": fraction} and, as text, keys of the
            job or columns that it is of. None: what the scenes' files say of them holds.
        missing: jobs without a result, with the reason.
        fine: by evaluate run id, the superresolve run of the same deployment.
        plots: names of the charts that are shown; None for all.
    """

    name: str
    title: str
    text: str = "How far is each model from the full-order run, and what does it save?"
    paper: str = ""
    keys: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    printed: Sequence[Mapping[str, Any]] | None = None
    missing: Sequence[str] = ()
    fine: Mapping[str, Run] = field(default_factory=dict)
    plots: Sequence[str] | None = None
    defaults: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @property
    def settings(self) -> dict[str, dict[str, str]]:
        """By run id, values of the keys that jobs vary, but for those that columns of the table have."""
        jobs = list(self.keys.values())
        keys = dict.fromkeys(key for job in jobs for key in job)
        varied = [
            key
            for key in keys
            if key not in _IN_COLUMNS
            and not key.startswith(_PASSING)
            and len({job.get(key) for job in jobs}) > 1
        ]
        whole = {run: {**self.defaults.get(run, {}), **job} for run, job in self.keys.items()}
        return {run: {key: values[key] for key in varied if key in values} for run, values in whole.items()}


def unchanged(folder: Path, runs: Iterable[Run], question: Question, first: Run | None = None) -> Path | None:
    """The page of a report that would be written again as it is; None where something differs."""
    folder, runs = Path(folder), list(runs)
    try:
        content = read(folder / MARK, ANY | {"made_of": str})
        files, same = content["files"], content["made_of"] == made_of(runs, question, first)
        whole = {path.name for path in folder.iterdir()} - {MARK} == set(files)
        whole = whole and all(digest(folder / name) == sha256 for name, sha256 in files.items())
    except (OSError, SchemaError):
        return None
    outputs = [(run, output) for run in runs for output in run.manifest.get("outputs", ())]
    sound = not any(altered(Path(run.path), one) for run, one in outputs if one["path"] in FILES)
    return folder / "index.html" if same and whole and sound else None


def made_of(runs: Iterable[Run], question: Question, first: Run | None = None) -> str:
    """sha256 of all that a report is made of: its runs, its question, and the code that writes it."""
    fine = {of: [run.id, run.manifest] for of, run in question.fine.items()}
    content = {
        "runs": {run.id: run.manifest for run in runs},
        "question": vars(question) | {"fine": fine},
        "first": first.id if first else None,
        "code": _code(),
    }
    return _sum(content)


@cache
def _code() -> str:
    """sha256 of the code that writes reports, with the versions of the libraries that draw."""
    package = Path(__file__).parent
    files = sorted(path for path in package.rglob("*") if path.is_file() and path.suffix != ".pyc")
    versions = {name: importlib.metadata.version(name) for name in _LIBRARIES}
    return _sum([{path.relative_to(package).as_posix(): digest(path) for path in files}, versions])


def _sum(content: Any) -> str:
    text = json.dumps(content, sort_keys=True, default=plain)
    return hashlib.sha256(text.encode(errors="backslashreplace")).hexdigest()
