"""`nsf <stage> key=value …`: the command line."""

import os
import signal
import sys
from collections.abc import Sequence
from pathlib import Path

from nsf import paths, usage, words
from nsf.errors import ConfigError, NSFError, first_line, out_of_memory
from nsf.extras import COMMAND, STARTED
from nsf.paths import reports_folder
from nsf.terminal import guard, screen
from nsf.usage import STAGES, TOOLS


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `nsf`; exits with 0, 2 (a fault the user can mend), 130 (interrupted) or 1."""
    if arguments is None:
        COMMAND[:] = [STARTED]
        arguments = sys.argv[1:]
    arguments = list(arguments)
    guard()
    # Threads that spin for long while they wait made training ten times slower on cores that others
    # use too; those that spin for some microseconds lose next to nothing on free ones.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    # A terminated process leaves as after Ctrl-C: nothing half-written, the manifest says so.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        code = _dispatch(arguments)
        sys.stdout.flush()
        sys.exit(code)
    except BrokenPipeError:  # who reads the output, such as `head`, has enough of it
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except NSFError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except Exception as error:
        if not out_of_memory(error):
            raise
        remedy = "free some, raise `ulimit -v` or take a smaller scene"
        print(f"error: memory ran out ({first_line(error)}); {remedy}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last whole file", file=sys.stderr)
        sys.exit(130)


def _without_folders(arguments: Sequence[str]) -> list[str]:
    """The arguments without `--config-dir DIR`, of which each is put before ours."""
    rest, folders, left = [], [], iter(arguments)
    for word in left:
        flag, _, folder = word.partition("=")
        if flag.lstrip("+~") == "hydra.searchpath":
            raise ConfigError(f"hydra.searchpath is refused; {paths.REMEDY}")
        if flag != "--config-dir":
            rest.append(word)
        elif folder := folder or next(left, ""):
            folders.append(folder)
        else:
            raise ConfigError("--config-dir needs a folder, as --config-dir my/conf")
    for folder in reversed(folders):
        paths.add_folder(folder)
    paths.user_folders()
    return rest


def _dispatch(arguments: list[str]) -> int:
    arguments = _without_folders(arguments)
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(usage.whole())
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("nsf"))
        return 0
    stage, *overrides = arguments
    if stage in TOOLS:
        return _tool(stage, overrides)
    if stage not in STAGES:
        import difflib

        names = (*STAGES, *TOOLS)
        near = difflib.get_close_matches(stage, names, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(names)}"
        raise ConfigError(f"unknown command {stage!r}; {hint}")
    if {"-h", "--help"} & set(overrides):
        print(usage.of_stage(stage))
        return 0
    if stage == "run" and "--dry-run" in overrides:
        return _tool("plan", [o for o in overrides if o != "--dry-run"])
    multirun = bool({"-m", "--multirun"} & set(overrides))
    overrides = [o for o in overrides if o not in ("-m", "--multirun")]
    words.check(stage, [o for o in overrides if not o.startswith("~")])
    from nsf import config

    launcher = [o for o in overrides if config.of_launcher(o)]
    experiments = [o.removeprefix("+experiment=") for o in overrides if o.startswith("+experiment=")]
    keys = [o for o in overrides if o not in launcher and not o.startswith("+experiment=")]
    if stage != "point" and not experiments:
        _check_scene(stage, keys)
    if experiments:
        return _experiment(experiments[-1], stage, keys, launcher)
    if multirun:
        return _multirun(stage, keys, launcher)
    if launcher:
        raise ConfigError(f"{launcher[0]} is about the jobs of a sweep; add -m")
    loaded = config.load(overrides, usage.primary(stage))  # refused before the import of what would use it
    from nsf.pipeline.sweeps.jobs import work

    result = work(loaded, _stages(stage))
    if stage in ("run", "report"):
        _show(result)
    return 0


def _check_scene(command: str, overrides: Sequence[str]) -> None:
    from nsf import config
    from nsf.paths import groups

    if not any(map(config.names_scene, overrides)):
        scenes = ", ".join(groups()["scene"])
        raise ConfigError(f"nsf {command} needs a scene, as scene=sand; choose one of {scenes}")


def _tool(name: str, arguments: list[str]) -> int:
    text, takes = TOOLS[name]
    if takes is not None and {"-h", "--help"} & set(arguments):
        print(usage.of_tool(name))
        return 0
    if name in ("view", "serve"):
        from nsf.live.command import main as live

        return live(name, text, arguments)
    if name in ("calibrate", "design", "sample"):
        from nsf.inverse.reports import command

        return _open(getattr(command, name)(arguments))
    tools = {
        "bench": _bench, "demo": _demo, "doctor": _doctor, "export": _export, "index": _index, "init": _init,
        "plan": _plan,
        "reports": _reports, "runs": _runs, "search": _search, "validate": _validate,
    }  # fmt: skip
    return tools[name](arguments)


def _open(page: Path) -> int:
    """Say where a page is."""
    print(f"open {page.resolve()}")
    return 0


def _bench(arguments: list[str]) -> int:
    """Benchmarks, and the report of all there are."""
    keys = ("benches", "particles", "precision", "device", "trials", "scenes", "limit", "folder")
    settings = [key for key in words.pairs("bench", arguments) if "." in key]
    options = words.values("bench", arguments, dict.fromkeys((*keys, *settings), words.text))
    from nsf.bench import bench, table

    folder = options.pop("folder", reports_folder("speed"))
    page = bench(folder, options, lambda text: print(text, file=sys.stderr))
    screen().print(table(page.with_name("bench.csv")))
    return _open(page)


def _validate(arguments: list[str]) -> int:
    """Full-order runs beside published answers."""
    readers = dict.fromkeys(("problems", "scenes", "scale", "device", "folder"), words.text)
    options = words.values("validate", arguments, readers)
    if "problems" in options and "scenes" in options:
        raise ConfigError("problems= and scenes= are of two reports; give one of them")
    from nsf.validation import command, convergence

    kind, make, terminal = "validation", command.validate, command.terminal
    if "scenes" in options:
        kind, make, terminal = "convergence", convergence.converge, convergence.terminal
    folder = options.pop("folder", reports_folder(kind))
    page = make(folder, options, lambda text: print(text, file=sys.stderr))
    screen().print(terminal(page))
    return _open(page)


def _doctor(arguments: list[str]) -> int:
    """Versions, devices and extras of this installation."""
    if arguments:
        raise ConfigError(f"nsf doctor takes nothing, not {arguments[0]!r}")
    from nsf.doctor import report

    print(report())
    return 0


def _export(arguments: list[str]) -> int:
    """A deployed run in other programs' formats."""
    from nsf.export.command import main as export

    return export(arguments)


def _demo(arguments: list[str]) -> int:
    """A page of a model that comes with the package."""
    readers = {"model": words.text, "folder": words.text, "open": words.flag}
    options = words.values("demo", arguments, readers)
    from nsf.live.demo import show

    folder = Path(options.get("folder", reports_folder("demo")))
    return _open(show(options.get("model"), folder, options.get("open", True)))


def _index(arguments: list[str]) -> int:
    """The page of all runs."""
    options = words.values("index", arguments, {"folder": words.text})
    from nsf.results.overview.index import write_index

    return _open(write_index(Path(options.get("folder", reports_folder("runs")))))


def _init(arguments: list[str]) -> int:
    """A project of the user."""
    if not arguments or arguments[0].startswith("-") or "=" in arguments[0]:
        raise ConfigError("nsf init needs one folder, as nsf init my_project")
    folder = Path(arguments[0])
    options = words.values("init", arguments[1:], dict.fromkeys(("mesh", "unit", "up"), words.text))
    if options and "mesh" not in options:
        raise ConfigError("unit= and up= are of a mesh; give it as mesh=FILE")
    from nsf.init import write_project
    from nsf.scenes import Mesh

    mesh = Mesh(options["mesh"], unit=options.get("unit", ""), up=options.get("up", "z")) if options else None
    write_project(folder, mesh)
    print(f"wrote {folder}; go on with {folder / 'README.md'}")
    return 0


def _plan(arguments: list[str]) -> int:
    """The stages of a run and their states, before any work."""
    from nsf import config
    from nsf.pipeline import preview

    flags = {"-m", "--multirun", "--cfg"}
    overrides = [word for word in arguments if word not in flags]
    words.check("plan", [word for word in overrides if not word.startswith("~")])
    keys = [o for o in overrides if not o.startswith("+experiment=") and not config.of_launcher(o)]
    if names := [o.removeprefix("+experiment=") for o in overrides if o.startswith("+experiment=")]:
        from nsf.pipeline.sweeps.experiment import Experiment

        jobs = [job.overrides for job in Experiment.load(names[-1], keys).jobs]
    else:
        _check_scene("plan", keys)
        jobs = config.jobs([keys]) if {"-m", "--multirun"} & set(arguments) else [tuple(keys)]
    plans = preview.plans(jobs)
    if "--cfg" in arguments:
        print("\n---\n".join(map(preview.composed, plans)), end="")
        return 0
    page = screen()
    for plan in preview.scenes(plans):
        page.print(preview.scene_table(plan), "")
    page.print(preview.stages_table(plans))
    return 0


def _reports(arguments: list[str]) -> int:
    """The page of all reports and their charts, or what is wrong with them; 2 if something is."""
    readers = {"folder": words.text, "check": words.flag, "html": words.flag}
    options = words.values("reports", arguments, readers)
    from nsf.pipeline.sweeps.experiment import questions
    from nsf.results.committed import faults, write_list

    folder = Path(options.get("folder", reports_folder()))
    if not folder.is_dir():
        raise ConfigError(f"folder={folder} is no folder; name one that holds reports, or make one")
    if not options.get("check"):
        return _open(write_list(folder, options.get("html", False), questions()))
    differing = faults(folder, questions())
    lines = differing or [f"every report in {folder} is as it was generated"]
    print(*lines, sep="\n", file=sys.stderr if differing else sys.stdout)
    return 2 if differing else 0


def _search(arguments: list[str]) -> int:
    """Trials until there are enough, and the best of them."""
    words.check("search", arguments)
    from nsf.pipeline.sweeps.search import search

    chart, best, command = search(arguments)
    screen().print(best)
    print(command)
    return _open(chart)


def _runs(arguments: list[str]) -> int:
    """Runs listed, shown, compared, verified or deleted."""
    from nsf.results.overview.command import main as runs

    return runs(arguments)


def _stages(stage: str) -> tuple[str, ...]:
    """The stages that a command does for each configuration."""
    from nsf.pipeline import STAGES as CHAIN

    return CHAIN if stage == "run" else (stage,)


def _experiment(name: str, stage: str, overrides: list[str], launcher: list[str]) -> int:
    """A stage, or the whole chain, of an experiment's jobs, and its report; 2 if something is missing."""
    from nsf.pipeline.sweeps.experiment import Experiment
    from nsf.progress import timed

    if stage == "point":
        raise ConfigError("experiments have no material points; leave +experiment out")
    experiment = Experiment.load(name, overrides)
    code = 0
    if stage == "run":
        experiment.check_report_folder()
    if stage != "report":
        code = _sweep(stage, experiment.sweeps, launcher, experiment.stages if stage == "run" else ())
    if stage in ("run", "report"):
        with timed("report"):
            page, missing = experiment.report()
        _show(page, table=stage == "report" or len(experiment.jobs) == 1)
        for job in missing:
            print(f"missing: {job}", file=sys.stderr)
        code = 2 if missing else code
    return code


def _multirun(stage: str, overrides: list[str], launcher: list[str]) -> int:
    """Every combination of comma-separated values, and the report of each scene; 2 if a job failed."""
    from nsf.pipeline.sweeps.jobs import check_report_folders, reports

    if stage == "run":
        check_report_folders(overrides)
    code = 0 if stage == "report" else _sweep(stage, [overrides], launcher)
    if stage in ("run", "report"):
        for page in reports(overrides):
            _show(page, table=stage == "report")
    return code


def _sweep(stage: str, sweeps: Sequence[list[str]], launcher: list[str], more: Sequence[str] = ()) -> int:
    """The stage of every job, or the chain up to the report, which is made once all are done, and `more`."""
    from nsf.pipeline.sweeps.jobs import sweep

    stages = (*(s for s in _stages(stage) if s != "report"), *more)
    failed = sweep(sweeps, stages, launcher, usage.primary(stage))
    if "evaluate" in stages:
        from nsf.pipeline.sweeps.outcome import outcome
        from nsf.results.formats import TerminalTable

        if ended := outcome(sweeps, {" ".join(failure.job): failure.error for failure in failed}):
            screen().print(TerminalTable(ended[0]))
            print(ended[1])
    for failure in failed:
        print(f"failed: {failure}", file=sys.stderr)
    return 2 if failed else 0


def _show(page, table: bool = True) -> None:
    """The answers of a report, or its table, on the terminal; how long it took, and where its page is."""
    if table:
        from nsf.results.verdict import on_terminal

        screen().print(on_terminal(page.parent / "results.csv"))
    from nsf.progress import slowest_stage

    print(slowest_stage())
    print(f"open {page.resolve()}")


if __name__ == "__main__":
    main()
