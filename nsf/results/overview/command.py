"""`nsf runs`: runs listed, shown, compared, verified and deleted."""

import sys
from collections.abc import Callable, Sequence

from nsf.errors import ConfigError, StorageError
from nsf.runs import Run
from nsf.runs.listing import FIELDS, Entry, entries, text
from nsf.runs.pruning import bytes_text, dependents, older, prunable, remove, size_of

USAGE = f"""\
usage: nsf runs [key=value[,value…] …] [sort=[-]key]
       nsf runs show ID
       nsf runs diff ID ID
       nsf runs verify [key=value …]
       nsf runs rm ID … [yes=true]
       nsf runs prune [key=value …] [older=AGE] [results=true] [yes=true]

Every run there is, newest first, with a column for each key in which the runs shown differ.

keys:
  a field      {", ".join(FIELDS[:-1])}
  a metric     delta, deformation_loss, training_seconds … as `nsf runs show ID` lists them
  a key of the configuration, of the run or those that it was made from, by its dotted name:
               latent_dim, seed, sampler.size, deploy …; field=, sampler= and model= take an option
Several values are parted by commas, * stands for anything, and a key that is filtered has a column.

An ID is stage/scene/hash, or as much of the beginning of it, of scene/hash or of the hash as is unique.
show     all that is known of one run: its keys, results, files, what it was made from, what needs it
diff     in which keys two runs differ, and by how much their results do
verify   holds every file to its recorded sha256; exits with 2 if one was changed
rm       deletes runs; says what was made from them
prune    deletes what nothing complete was made from, of those that match: runs that failed, and trajectories,
         manifolds and deployments that no result needs. older= takes 36h, 7d or 2w. Results (evaluate,
         superresolve) stay, unless results=true. It says how much that frees, and asks, unless yes=true

examples:
  nsf runs stage=evaluate scene=sand sort=delta        the smallest error first
  nsf runs stage=train latent_dim=4,6 'seed=*'         seeds beside the latent dimensions
  nsf runs 'status=failed,interrupted,killed'
  nsf runs diff 1a2b 3c4d
  nsf runs prune scene=cake older=2w"""


def main(words: Sequence[str], print_table: Callable[[object], object]) -> int:
    """`nsf runs`; gives the exit code.

    Args:
        words: of the command line.
        print_table: shows a rich table.

    Raises:
        NSFError: a word, key or id is refused.
    """
    words = list(words)
    if {"-h", "--help"} & set(words):
        print(USAGE)
        return 0
    from nsf.results.overview.tables import difference_table, run_table, runs_table  # rich takes 0.1 s

    if words[:1] == ["show"]:
        for run in _named("show", words[1:], 1):
            print_table(run_table(run, Run.find()))
        return 0
    if words[:1] == ["diff"]:
        print_table(difference_table(*_named("diff", words[1:], 2)))
        return 0
    if words[:1] == ["verify"]:
        return _verify(words[1:])
    if words[:1] == ["rm"]:
        return _remove(words[1:])
    if words[:1] == ["prune"]:
        return _prune(words[1:])
    filters = _filters(words)
    sort = filters.pop("sort", "-created")
    runs = _matching(filters, sort)
    sorted_by = [sort.removeprefix("-")] if len(words) > len(filters) else []
    print_table(runs_table(runs, [*filters, *sorted_by]))
    _say(f"broken: {entry.run.path}: {entry.fault}" for entry in runs if entry.fault)
    _say([f"{len(runs)} runs" + (", of which `nsf runs --help` says more" if not words else "")])
    return 0


def _filters(words: Sequence[str]) -> dict[str, str]:
    unknown = [word for word in words if word.startswith("-") or "=" not in word]
    if unknown:
        raise ConfigError(f"{unknown[0]!r} is not key=value; see `nsf runs --help`")
    return dict(word.split("=", 1) for word in words)


def _matching(filters: dict[str, str], sort: str = "-created") -> list[Entry]:
    """The runs that pass all filters; a key that was removed is refused by naming its replacement."""
    try:
        return entries(filters, sort)
    except ConfigError:
        from nsf.config.removed import refuse_overrides  # with all of Hydra, for a mistake alone

        refuse_overrides([*filters, sort.removeprefix("-")])
        raise


def _named(command: str, words: Sequence[str], count: int) -> list[Run]:
    if len(words) != count:
        wanted = "two runs" if count == 2 else "one run"
        raise ConfigError(f"nsf runs {command} takes {wanted}, not {len(words)}; `nsf runs` lists them")
    return list(map(Run.named, words))


def _verify(words: Sequence[str]) -> int:
    filters = _filters(words)
    runs = _matching(filters, filters.pop("sort", "-created"))
    faults = [fault for entry in runs for fault in entry.run.verify()]
    _say(faults)
    _say([f"{len(runs)} runs, {len(faults)} faults"])
    return 2 if faults else 0


def _remove(words: Sequence[str]) -> int:
    ids = [word for word in words if "=" not in word]
    sure = _is_sure(_filters([word for word in words if "=" in word]), "rm")
    if not ids:
        raise ConfigError("nsf runs rm takes the runs that are to go; `nsf runs` lists them")
    going = list(dict.fromkeys(map(Run.named, ids)))
    of = dependents(Run.find())
    for run in going:
        if needed := sorted(one.id for one in of.get(run, set()).difference(going)):
            more = f" and {len(needed) - 1} more" if len(needed) > 1 else ""
            _say([f"{needed[0]}{more} was made from {run.id}, and cannot be made again without it"])
    return _delete(going, sure)


def _prune(words: Sequence[str]) -> int:
    filters = _filters(words)
    sure = _is_sure(filters, "prune", ("results",))
    results = filters.pop("results", "false") == "true"
    age = filters.pop("older", None)
    filters.pop("yes", None)
    runs = _matching(filters)
    if age is not None:
        runs = older(runs, age)
    return _delete(prunable(runs, Run.find(), results), sure)


def _is_sure(filters: dict[str, str], command: str, more: Sequence[str] = ()) -> bool:
    for key in ("yes", *more):
        if filters.get(key, "true") not in ("true", "false"):
            raise ConfigError(f"{key}={filters[key]} must be true or false")
    if command == "rm" and (unknown := [key for key in filters if key != "yes"]):
        raise ConfigError(f"nsf runs rm has no key {unknown[0]!r}; it takes yes=")
    return filters.get("yes") == "true"


def _delete(going: Sequence[Run], sure: bool) -> int:
    """Delete runs, once that is agreed to; 2 if one of them could not be."""
    if not going:
        _say(["nothing to delete"])
        return 0
    sizes = {run: size_of(run) for run in going}
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
