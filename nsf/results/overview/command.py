"""`nsf runs`: runs listed, shown, compared, verified and deleted."""

import json
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from nsf import words
from nsf.errors import ConfigError, StorageError
from nsf.runs import Run
from nsf.runs.columns import table
from nsf.runs.listing import FIELDS, Entry, chosen, listed, text, why_none
from nsf.runs.pruning import dependents, older, prunable, remove
from nsf.storage import bytes_text, size_of
from nsf.terminal import screen

if TYPE_CHECKING:
    import pandas as pd

USAGE = f"""\
usage: nsf runs [key=value[,value…] …] [sort=[-]key] [--json|--csv]
       nsf runs show ID
       nsf runs diff ID ID
       nsf runs verify [key=value …]
       nsf runs rm ID … [yes=true]
       nsf runs prune [key=value …] [older=AGE] [results=true] [yes=true]

Every run, the newest first: its error, which is that of displacement, the keys
in which the runs shown differ, and other results as far as the terminal, or
COLUMNS, is wide. --json and --csv print every key and metric, numbers
unrounded and errors as fractions, for other programs.

keys:
  a field    {", ".join(FIELDS[:-1])}
  a metric   displacement_error, delta, deformation_loss, training_seconds …
             as `nsf runs show ID` lists them
  a key      of the configuration of the run, or of those that it was made from,
             by its dotted name: latent_dim, seed, sampler.size, deploy …
             field=, sampler= and model= take an option
Several values are parted by commas, * stands for anything, and a key that is
filtered or sorted by has a column.

An ID is stage/scene/hash, or as much of the beginning of it, of scene/hash or
of the hash as is unique.
show     all of one run: its keys, results, files, what it was made from, what
         needs it
diff     in which keys two runs differ, and by how much their results do
verify   holds every file to its recorded sha256; exits with 2 if one differs
rm       deletes runs; says what was made from them
prune    deletes what nothing complete was made from, of those that match: runs
         that failed, and trajectories, manifolds and deployments that no result
         needs. older= takes 36h, 7d or 2w. Results (evaluate, superresolve)
         stay, unless results=true. It says how much that frees, and asks,
         unless yes=true

examples:
  nsf runs stage=evaluate scene=sand sort=displacement_error
  nsf runs stage=train latent_dim=4,6 'seed=*'
  nsf runs 'status=failed,interrupted,killed'
  nsf runs diff 1a2b 3c4d
  nsf runs prune scene=cake older=2w"""


def main(arguments: Sequence[str]) -> int:
    """`nsf runs`; gives the exit code.

    Args:
        arguments: of the command line.

    Raises:
        NSFError: a word, key or id is refused.
    """
    arguments = list(arguments)
    if {"-h", "--help"} & set(arguments):
        print(USAGE)
        return 0
    tools = {"show": _show, "diff": _diff, "verify": _verify, "rm": _remove, "prune": _prune}
    if arguments and arguments[0] in tools:
        return tools[arguments[0]](arguments[1:])
    formats = [word for word in arguments if word in ("--json", "--csv")]
    filters = words.pairs("runs", [word for word in arguments if word not in formats])
    sort = filters.pop("sort", "")
    every = listed()
    runs = _matching(every, filters, sort or "-created")
    named = [*filters, *([sort.removeprefix("-")] if sort else [])]
    if formats:
        print(_written(table(runs, named), formats[-1]), end="")
    elif runs:
        from nsf.results.overview.tables import runs_table  # rich takes 0.1 s

        page = screen()
        page.print(runs_table(runs, named, page.width))
    _say(f"broken: {entry.run.path}: {entry.fault}" for entry in runs if entry.fault)
    more = "" if arguments else ", of which `nsf runs --help` says more"
    _say([f"{len(runs)} runs{more}" if runs else why_none(filters, every)])
    return 0


def _written(frame: "pd.DataFrame", form: str) -> str:
    """A table of runs as JSON or CSV."""
    from nsf.results.formats import spreadsheet  # templates take 0.1 s

    frame = frame.convert_dtypes()  # whole numbers stay whole where some runs have none
    if form == "--csv":
        return frame.map(spreadsheet).to_csv(index=False)
    rows = frame.astype(object).where(frame.notna(), None).to_dict("records")
    return json.dumps(rows, indent=1, ensure_ascii=False, default=str) + "\n"


def _matching(every: Sequence[Entry], filters: dict[str, str], sort: str = "-created") -> list[Entry]:
    """Those that pass all filters; a key that was removed is refused by naming its replacement."""
    try:
        return chosen(every, filters, sort)
    except ConfigError:
        from nsf.config.removed import refuse_overrides  # with all of Hydra, for a mistake alone

        refuse_overrides([*filters, sort.removeprefix("-")])
        raise


def _named(command: str, ids: Sequence[str], count: int) -> list[Run]:
    if len(ids) != count:
        wanted = "two runs" if count == 2 else "one run"
        raise ConfigError(f"nsf runs {command} takes {wanted}, not {len(ids)}; `nsf runs` lists them")
    return list(map(Run.named, ids))


def _show(ids: Sequence[str]) -> int:
    from nsf.results.overview.tables import run_table

    (run,) = _named("show", ids, 1)
    screen().print(run_table(run, Run.find()))
    return 0


def _diff(ids: Sequence[str]) -> int:
    from nsf.results.overview.tables import difference_table

    screen().print(difference_table(*_named("diff", ids, 2)))
    return 0


def _verify(arguments: Sequence[str]) -> int:
    runs = _matching(listed(), words.pairs("runs verify", arguments))
    faults = [fault for entry in runs for fault in entry.run.verify()]
    _say(faults)
    _say([f"{len(runs)} runs, {len(faults)} faults"])
    return 2 if faults else 0


def _remove(arguments: Sequence[str]) -> int:
    ids = [word for word in arguments if "=" not in word]
    options = words.values("runs rm", [word for word in arguments if "=" in word], {"yes": words.flag})
    if not ids:
        raise ConfigError("nsf runs rm takes the runs that are to go; `nsf runs` lists them")
    going = list(dict.fromkeys(map(Run.named, ids)))
    of = dependents(Run.find())
    for run in going:
        if needed := sorted(one.id for one in of.get(run, set()).difference(going)):
            more = f" and {len(needed) - 1} more" if len(needed) > 1 else ""
            _say([f"{needed[0]}{more} was made from {run.id}, and cannot be made again without it"])
    return _delete(going, options.get("yes", False))


def _prune(arguments: Sequence[str]) -> int:
    filters = words.pairs("runs prune", arguments)
    sure, results = (words.flag(key, filters.pop(key, "false")) for key in ("yes", "results"))
    age = filters.pop("older", None)
    runs = _matching(listed(), filters)
    if age is not None:
        runs = older(runs, age)
    return _delete(prunable(runs, Run.find(), results), sure)


def _delete(going: Sequence[Run], sure: bool) -> int:
    """Delete runs, once that is agreed to; 2 if one of them could not be."""
    if not going:
        _say(["nothing to delete"])
        return 0
    sizes = {run: size_of(run.path) for run in going}
    for run, size in sizes.items():
        print(f"{run.id}  {run.status}  {bytes_text(size)}")
    total = f"{len(going)} run{'s' * (len(going) > 1)}, {bytes_text(sum(sizes.values()))}"
    if not sure:
        if not sys.stdin.isatty():
            raise ConfigError(f"{total}: say yes=true to delete them")
        if input(f"delete {total}? [y/N] ").strip().lower() not in ("y", "yes"):
            _say(["nothing deleted"])
            return 0
    faults = []
    for run in going:
        try:
            remove(run)
        except StorageError as error:
            faults.append(str(error))
    _say(faults)
    _say([f"deleted {total}" if not faults else f"{len(faults)} of {total} stay"])
    return 2 if faults else 0


def _say(lines) -> None:
    for line in lines:
        print(text(line), file=sys.stderr)
