"""`nsf <stage> key=value …`: the command line."""

import os
import signal
import sys
from collections.abc import Sequence

from nsf.errors import ConfigError, NSFError

STAGES = {
    "run": "the whole chain: simulate, train, deploy, evaluate, report; unchanged stages are reused",
    "simulate": "full-order trajectories of every case",
    "train": "the manifold: encoder and deformation, stress and affine fields",
    "teach": "the operators of the reduced step, for engine=operators, which deploy asks for by itself",
    "deploy": "reduced runs of the held-out cases",
    "evaluate": "errors and costs of the reduced runs beside the full-order ones",
    "report": "tables, charts and pictures of every evaluated variant of the scene",
    "superresolve": "deployed fields at many more points, beside a full-order run of as many particles",
    "point": "one material point along a deformation path",
}
#: Commands that are no stage: what they do, and what they take; None for those with options of their own.
TOOLS = {
    "view": ("a deployment in the browser: steer the reduced run, see it beside the full-order one", None),
    "serve": ("a deployment's latent vectors as a stream that many browsers decode", None),
    "demo": (
        "a model that runs in the browser: drag, tilt and steer it, with no server and nothing to train",
        "[model=block] [folder=PATH] [open=true]; block, sand or metal; reports/demo by default",
    ),
    "export": (
        "a deployed run for other programs: HTML page, the model itself in a page, USD, VTK, ONNX, film",
        None,
    ),
    "search": (
        "values of numeric keys that make δ, or δ and the step's time, small at the validation values",
        "key=low..high[:log] … [key=value …] [search.objectives=[delta,step_ms]] [search.trials=20]",
    ),
    "plan": (
        "what nsf run would do: stages and their states, size, time and room; --cfg: the configuration",
        "[-m] [+experiment=NAME] [key=value …] [--cfg]; nsf run … --dry-run is the same",
    ),
    "runs": ("every run there is: listed, shown, compared, verified, deleted", None),
    "index": (
        "a page of every run, with a thumbnail each, that sorts and filters in the browser",
        "[folder=PATH]; reports/runs by default",
    ),
    "reports": (
        "the list of all reports, reports/index.md; check=true: whether one of them was changed since",
        "[folder=PATH] [check=true]; reports by default",
    ),
    "bench": (
        "time and memory of a step, kernel by kernel; writes reports/speed",
        "[benches=full_order,scaling,reduced,batch,training,multi_gpu] [particles=10k,200k,1m]\n"
        "       [scenes=cake,metal] [precision=fp32,fp64] [device=auto] [trials=10] [folder=PATH]; "
        "sizes that suit the device by default",
    ),
    "doctor": ("versions, devices, folders and extras of this installation", ""),
}
_EXAMPLES = """\
examples:
  nsf run scene=sand scale=small                       the paper's method in a minute or two, on a CPU
  nsf run scene=sand method=deformation_only           the baseline beside it, in the same report
  nsf run scene=sand scene.design.test=[23,30.5]       other held-out cases
  nsf run -m scene=sand latent_dim=4,6 sampler.size=50,150   every combination
  nsf plan scene=cake scale=paper                      what that would take, before it begins
  nsf run +experiment=table1 scale=small               every job of experiments/table1.yaml, and its report
  nsf run -m +experiment=sand hydra/launcher=joblib    jobs side by side on this machine
  nsf run -m +experiment=table1 hydra/launcher=slurm   jobs in Slurm's queue (conf/hydra/launcher/slurm.yaml)
  nsf demo                                             a model in the browser, at once
  nsf export --html --frames                           the newest deployed run as a page and a film
  nsf point material=drucker_prager path=oedometer     plot a law before trusting it
  nsf view                                             the newest deployment in the browser
  nsf search scene=sand scene.design.validation=[27,31] latent_dim=4..8   the r of the smallest δ there
  nsf runs stage=evaluate scene=sand latent_dim=4 sort=delta   runs by what made them, the best first
  nsf runs diff 1a2b 3c4d                              what differs between two runs, in keys and in result
  nsf bench particles=10k,40k precision=fp32           what a step costs on this machine, and its floor

Results lie in ./runs (NSF_RUNS) and ./reports (NSF_REPORTS)."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of `nsf`; exits with 0, 2 (a fault the user can mend), 130 (interrupted) or 1."""
    arguments = list(sys.argv[1:] if arguments is None else arguments)
    # Threads that spin for long while they wait made training ten times slower on cores that others
    # use too; those that spin for some microseconds lose next to nothing on free ones.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    os.environ.setdefault("GOMP_SPINCOUNT", "10000")
    # A terminated process leaves as after Ctrl-C: nothing half-written, the manifest says so.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        sys.exit(_dispatch(arguments))
    except NSFError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("interrupted; the same command goes on from the last whole file", file=sys.stderr)
        sys.exit(130)


def _dispatch(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        print(_help())
        return 0
    if arguments[0] == "--version":
        from importlib.metadata import version

        print(version("nsf"))
        return 0
    stage, overrides = arguments[0], arguments[1:]
    if stage in TOOLS:
        return _tool(stage, overrides)
    if stage not in STAGES:
        import difflib

        known = (*STAGES, *TOOLS)
        near = difflib.get_close_matches(stage, known, n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join(known)}"
        raise ConfigError(f"unknown stage {stage!r}; {hint}")
    if {"-h", "--help"} & set(overrides):
        print(_stage_help(stage))
        return 0
    if stage == "run" and "--dry-run" in overrides:
        return _tool("plan", [o for o in overrides if o != "--dry-run"])
    multirun = bool({"-m", "--multirun"} & set(overrides))
    overrides = [o for o in overrides if o not in ("-m", "--multirun")]
    _check_words(stage, [o for o in overrides if not o.startswith("~")])
    from nsf import config

    launcher = [o for o in overrides if config.of_launcher(o)]
    experiments = [o.removeprefix("+experiment=") for o in overrides if o.startswith("+experiment=")]
    own = [o for o in overrides if o not in launcher and not o.startswith("+experiment=")]
    if stage != "point" and not experiments:
        _check_scene(stage, own)
    if experiments:
        return _experiment(experiments[-1], stage, own, launcher)
    if multirun:
        return _multirun(stage, own, launcher)
    if launcher:
        raise ConfigError(f"{launcher[0]} is about the jobs of a sweep; add -m")
    from nsf.pipeline.sweep import work

    result = work(config.load(overrides, _primary(stage)), _stages(stage))
    if stage in ("run", "report"):
        _show(result)
    return 0


def _check_scene(command: str, overrides: Sequence[str]) -> None:
    from nsf import config
    from nsf.paths import groups

    if not any(map(config.names_scene, overrides)):
        known = ", ".join(groups()["scene"])
        raise ConfigError(f"nsf {command} needs a scene, as scene=sand; choose one of {known}")


def _check_words(command: str, words: Sequence[str]) -> None:
    unknown = [word for word in words if word.startswith("-") or "=" not in word]
    if unknown:
        raise ConfigError(f"{unknown[0]!r} is not key=value; see `nsf {command} --help`")


def _asked(command: str, words: Sequence[str], *known: str) -> dict[str, str]:
    """The values of a tool's keys."""
    _check_words(command, words)
    asked = dict(word.split("=", 1) for word in words)
    if unknown := [key for key in asked if key not in known]:
        keys = " and ".join(f"{key}=" for key in known)
        raise ConfigError(f"nsf {command} has no key {unknown[0]!r}; it takes {keys}")
    return asked


def _tool(name: str, words: list[str]) -> int:
    text, usage = TOOLS[name]
    if usage is not None and {"-h", "--help"} & set(words):
        print(f"usage: nsf {name} {usage}\n\n{text}")
        return 0
    if name in ("view", "serve"):
        from nsf.live.command import main as live

        return live(name, text, words)
    tools = {
        "bench": _bench, "demo": _demo, "doctor": _doctor, "export": _export, "index": _index,
        "plan": _plan, "reports": _reports, "runs": _runs, "search": _search,
    }  # fmt: skip
    return tools[name](words)


def _bench(words: list[str]) -> int:
    """Benchmarks, and the report of all there are."""
    asked = _asked(
        "bench", words, "benches", "particles", "precision", "device", "trials", "scenes", "folder"
    )
    from nsf.bench import bench, table

    folder = asked.pop("folder", os.path.join(os.environ.get("NSF_REPORTS", "reports"), "speed"))
    page = bench(folder, asked, lambda text: print(text, file=sys.stderr))
    _console().print(table(page.with_name("results.csv")))
    print(f"open {page.resolve()}")
    return 0


def _doctor(words: list[str]) -> int:
    """What this installation consists of."""
    if words:
        raise ConfigError(f"nsf doctor takes nothing, not {words[0]!r}")
    from nsf.doctor import report

    print(report())
    return 0


def _export(words: list[str]) -> int:
    """A deployed run in other programs' formats."""
    from nsf.export.command import Page
    from nsf.export.command import main as export

    def live(*given):
        from nsf.live.publish import write

        return write(*given)

    told = "the model itself in one page that runs, is steered and mailed; needs engine=operators"
    return export(words, {"live": Page(told, live)})


def _demo(words: list[str]) -> int:
    """A page of a model that comes with the package."""
    asked = _asked("demo", words, "model", "folder", "open")
    from nsf.live.demo import show

    folder = asked.get("folder", os.path.join(os.environ.get("NSF_REPORTS", "reports"), "demo"))
    print(f"open {show(asked.get('model'), folder, asked.get('open', 'true')).resolve()}")
    return 0


def _index(words: list[str]) -> int:
    """The page of all runs."""
    asked = _asked("index", words, "folder")
    folder = asked.get("folder", os.path.join(os.environ.get("NSF_REPORTS", "reports"), "runs"))
    from pathlib import Path

    from nsf.reporting.overview.index import write_index

    print(f"open {write_index(Path(folder)).resolve()}")
    return 0


def _plan(words: list[str]) -> int:
    """What a run would do."""
    from nsf import config
    from nsf.pipeline import preview

    flags = {"-m", "--multirun", "--cfg"}
    asked = [word for word in words if word not in flags]
    _check_words("plan", [word for word in asked if not word.startswith("~")])
    own = [o for o in asked if not o.startswith("+experiment=") and not config.of_launcher(o)]
    if names := [o.removeprefix("+experiment=") for o in asked if o.startswith("+experiment=")]:
        from nsf.pipeline.experiment import Experiment

        jobs = [job.overrides for job in Experiment.load(names[-1], own).jobs]
    else:
        _check_scene("plan", own)
        jobs = config.jobs([own]) if {"-m", "--multirun"} & set(words) else [tuple(own)]
    found = preview.plans(jobs)
    if "--cfg" in words:
        print("\n---\n".join(map(preview.composed, found)), end="")
        return 0
    console = _console()
    for plan in preview.scenes(found):
        console.print(preview.scene_table(plan), "")
    console.print(preview.stages_table(found))
    return 0


def _reports(words: list[str]) -> int:
    """The list of reports, or what is wrong with them; 2 if something is."""
    asked = _asked("reports", words, "folder", "check")
    if asked.get("check", "true") not in ("true", "false"):
        raise ConfigError(f"check={asked['check']} must be true or false")
    from pathlib import Path

    from nsf.reporting.committed import faults, write_list

    folder = Path(asked.get("folder", os.environ.get("NSF_REPORTS", "reports")))
    if not folder.is_dir():
        raise ConfigError(f"folder={folder} is no folder; name one that holds reports, or make one")
    if asked.get("check") != "true":
        print(f"open {write_list(folder).resolve()}")
        return 0
    found = faults(folder)
    for fault in found:
        print(fault, file=sys.stderr)
    return 2 if found else 0


def _search(words: list[str]) -> int:
    """Trials until there are enough, and the best of them."""
    _check_words("search", words)
    from nsf.pipeline.search import search
    from nsf.reporting.drawing.search import best_table

    chart = search(words)
    _console().print(best_table(chart.with_name("trials.csv")))
    print(f"open {chart.resolve()}")
    return 0


def _runs(words: list[str]) -> int:
    """Runs listed, shown, compared, verified or deleted."""
    from nsf.reporting.overview.command import main as runs

    return runs(words, lambda table: _console().print(table))


def _primary(stage: str) -> str:
    """Name of the stage's primary configuration file."""
    return "point" if stage == "point" else "config"


def _stages(stage: str) -> tuple[str, ...]:
    """The stages that a command does for each configuration."""
    from nsf.pipeline import STAGES as CHAIN

    return CHAIN if stage == "run" else (stage,)


def _experiment(name: str, stage: str, overrides: list[str], launcher: list[str]) -> int:
    """A stage, or the whole chain, of an experiment's jobs, and its report; 2 if something is missing."""
    from nsf.pipeline.experiment import Experiment

    if stage == "point":
        raise ConfigError("experiments have no material points; leave +experiment out")
    experiment = Experiment.load(name, overrides)
    code = 0
    if stage == "run":
        experiment.check_report_folder()
    if stage != "report":
        code = _sweep(stage, experiment.sweeps, launcher, experiment.stages if stage == "run" else ())
    if stage in ("run", "report"):
        page, missing = experiment.report()
        _show(page, table=stage == "report" or len(experiment.jobs) == 1)
        for told in missing:
            print(f"missing: {told}", file=sys.stderr)
        code = 2 if missing else code
    return code


def _multirun(stage: str, overrides: list[str], launcher: list[str]) -> int:
    """Every combination of comma-separated values, and the report of each scene; 2 if a job failed."""
    from nsf.pipeline.sweep import check_report_folders, reports

    if stage == "run":
        check_report_folders(overrides)
    code = 0 if stage == "report" else _sweep(stage, [overrides], launcher)
    if stage in ("run", "report"):
        for page in reports(overrides):
            _show(page, table=stage == "report")
    return code


def _sweep(stage: str, sweeps: Sequence[list[str]], launcher: list[str], more: Sequence[str] = ()) -> int:
    """The stage of every job, or the chain up to the report, which is made once all are done, and `more`."""
    from nsf.pipeline.sweep import sweep

    stages = (*(s for s in _stages(stage) if s != "report"), *more)
    failed = sweep(sweeps, stages, launcher, _primary(stage))
    if "evaluate" in stages:
        from nsf.pipeline.outcome import outcome_table

        if table := outcome_table(sweeps, {" ".join(failure.job): failure.error for failure in failed}):
            _console().print(table)
    for failure in failed:
        print(f"failed: {failure}", file=sys.stderr)
    return 2 if failed else 0


def _show(page, table: bool = True) -> None:
    """The result table of a report, on the terminal, and where its page is."""
    if table:
        import pandas as pd

        from nsf.reporting import console_table

        _console().print(console_table(pd.read_csv(page.parent / "results.csv")))
    print(f"open {page.resolve()}")


def _console():
    from rich.console import Console

    return Console(width=None if sys.stdout.isatty() else 160)


def _help() -> str:
    width = max(map(len, STAGES))
    stages = "\n".join(f"  {name:<{width}}  {text}" for name, text in STAGES.items())
    tools = "\n".join(f"  {name:<{width}}  {text}" for name, (text, _) in TOOLS.items())
    usage = "usage: nsf STAGE [-m] [+experiment=NAME] [key=value …]"
    return f"{usage}\n\nstages:\n{stages}\n\nbeside them:\n{tools}\n\n{_EXAMPLES}\n\n{_groups()}"


def _groups() -> str:
    from nsf.paths import EXPERIMENTS, groups

    width = max(map(len, groups()))
    lines = [f"  {group:<{width}} {' '.join(options)}" for group, options in groups().items()]
    experiments = " ".join(sorted(path.stem for path in EXPERIMENTS.glob("*.yaml")))
    lines += ["", "experiments (+experiment=NAME):", f"  {experiments}"]
    return "\n".join(["configuration groups (group=option):", *lines])


def _stage_help(stage: str) -> str:
    from nsf.paths import CONF

    primary = _primary(stage)
    experiment = "" if stage == "point" else " [+experiment=NAME]"
    keys = (CONF / f"{primary}.yaml").read_text(encoding="utf-8")
    return (
        f"usage: nsf {stage} [-m]{experiment} [key=value …]\n\n{STAGES[stage]}\n\n{_groups()}\n\n"
        f"keys and defaults (conf/{primary}.yaml):\n{keys}"
    )


if __name__ == "__main__":
    main()
