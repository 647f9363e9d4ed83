"""`nsf <stage> key=value …`: the command line."""

import os
import signal
import sys
from collections.abc import Sequence

from nsf.errors import NSFError

STAGES = {
    "run": "the whole chain: simulate, train, deploy, evaluate, report; unchanged stages are reused",
    "simulate": "full-order trajectories of every parameter value",
    "train": "the manifold: encoder and deformation, stress and affine fields",
    "deploy": "reduced runs at the held-out parameter values",
    "evaluate": "errors and costs of the reduced runs beside the full-order ones",
    "report": "tables, charts and pictures of every evaluated variant of the scene",
    "superresolve": "deployed fields at many more points, beside a full-order run of as many particles",
    "point": "one material point along a deformation path",
}
#: Commands that take a run and options of their own, each a module of `nsf.live`.
LIVE = {
    "view": "a deployment in the browser: steer the reduced run, see it beside the full-order one",
    "serve": "a deployment's latent vectors as a stream that many browsers decode",
}
_EXAMPLES = """\
examples:
  nsf run scene=sand scale=small                       the paper's method in a minute or two, on a CPU
  nsf run scene=sand method=deformation_only           the baseline beside it, in the same report
  nsf run scene=sand scene.parameters.test=[23,30.5]   other held-out values
  nsf run -m scene=sand latent_dim=4,6 sampler.size=50,150   every combination
  nsf run +experiment=table1 scale=small               every job of experiments/table1.yaml, and its report
  nsf point material=drucker_prager path=oedometer     plot a law before trusting it
  nsf view                                             the newest deployment in the browser

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
    if stage in LIVE:
        from nsf.live.command import main as live

        return live(stage, LIVE[stage], overrides)
    if stage not in STAGES:
        import difflib

        near = difflib.get_close_matches(stage, [*STAGES, *LIVE], n=1)
        hint = f"did you mean {near[0]}?" if near else f"choose one of {', '.join([*STAGES, *LIVE])}"
        print(f"error: unknown stage {stage!r}; {hint}", file=sys.stderr)
        return 2
    if {"-h", "--help"} & set(overrides):
        print(_stage_help(stage))
        return 0
    multirun = bool({"-m", "--multirun"} & set(overrides))
    overrides = [o for o in overrides if o not in ("-m", "--multirun")]
    unknown = [o for o in overrides if o.startswith("-") or ("=" not in o and not o.startswith("~"))]
    if unknown:
        print(f"error: {unknown[0]!r} is not key=value; see `nsf {stage} --help`", file=sys.stderr)
        return 2
    experiments = [o.removeprefix("+experiment=") for o in overrides if o.startswith("+experiment=")]
    if experiments:
        return _experiment(experiments[-1], stage, [o for o in overrides if not o.startswith("+experiment=")])
    if multirun:
        return _multirun(stage, [overrides], _stages(stage))
    from nsf import config

    _work(config.load(overrides, _primary(stage)), _stages(stage))
    return 0


def _primary(stage: str) -> str:
    """Name of the stage's primary configuration file."""
    return "point" if stage == "point" else "config"


def _stages(stage: str) -> tuple[str, ...]:
    """The stages that a command does for each configuration."""
    from nsf.pipeline import STAGES as CHAIN

    return CHAIN if stage == "run" else (stage,)


def _work(config, stages: Sequence[str]) -> None:
    if "point" in stages:
        from nsf.reporting.point import plot_point

        plot_point(config)
        return
    from nsf.pipeline import Pipeline

    pipeline = Pipeline(config)
    if len(stages) > 1:
        pipeline.check_held_out()  # before hours of simulation and training, not after
    for name in stages:
        result = pipeline.run(name)
    if "report" in stages:
        _show(result)


def _experiment(name: str, stage: str, overrides: list[str]) -> int:
    """A stage, or the whole chain, of an experiment's jobs, and its report; 2 if something is missing."""
    from nsf.pipeline.experiment import Experiment

    if stage == "point":
        print("error: experiments have no material points; leave +experiment out", file=sys.stderr)
        return 2
    experiment = Experiment.load(name, overrides)
    code = 0
    if stage != "report":
        stages = tuple(s for s in _stages(stage) if s != "report")
        code = _multirun(stage, experiment.sweeps, stages)
    if stage in ("run", "report"):
        page, missing = experiment.report()
        _show(page)
        for told in missing:
            print(f"missing: {told}", file=sys.stderr)
        code = 2 if missing else code
    return code


def _show(page) -> None:
    """The result table of a report, on the terminal."""
    import pandas as pd
    from rich.console import Console

    from nsf.reporting import console_table

    console = Console(width=None if sys.stdout.isatty() else 160)
    console.print(console_table(pd.read_csv(page.parent / "results.csv")))
    print(f"open {page.resolve()}")


def _multirun(stage: str, sweeps: Sequence[list[str]], stages: Sequence[str]) -> int:
    """Every combination of each sweep's comma-separated values, by Hydra's launchers; 2 if a job failed."""
    import hydra

    from nsf import config as configuration

    check = None
    if stage != "point":
        from nsf.pipeline import Pipeline as check  # checks all that can be checked before any work
    for overrides in sweeps:
        configuration.check_sweep(overrides, _primary(stage), check)
    failed = []

    def job(config) -> None:
        print(f"--- {' '.join(hydra.core.hydra_config.HydraConfig.get().overrides.task)}")
        try:
            _work(configuration.checked(config), stages)
        except NSFError as error:
            # Recorded in the failed run's manifest; the other jobs go on.
            failed.append(error)
            print(f"error: {error}", file=sys.stderr)

    for overrides in sweeps:
        sys.argv = ["nsf", "--multirun", *overrides]
        hydra.main(config_path=str(configuration.CONF), config_name=_primary(stage), version_base="1.3")(
            job
        )()
    return 2 if failed else 0


def _help() -> str:
    width = max(map(len, [*STAGES, *LIVE]))
    stages, live = (
        "\n".join(f"  {name:<{width}}  {text}" for name, text in table.items()) for table in (STAGES, LIVE)
    )
    usage = "usage: nsf STAGE [+experiment=NAME] [key=value …] [-m]\n       nsf view|serve [RUN] [--help]"
    return f"{usage}\n\nstages:\n{stages}\n\nlive:\n{live}\n\n{_EXAMPLES}\n\n{_groups()}"


def _groups() -> str:
    from nsf.paths import EXPERIMENTS, groups

    lines = [f"  {group:<12} {' '.join(options)}" for group, options in groups().items()]
    experiments = " ".join(sorted(path.stem for path in EXPERIMENTS.glob("*.yaml")))
    lines += ["", "experiments (+experiment=NAME):", f"  {experiments}"]
    return "\n".join(["configuration groups (group=option):", *lines])


def _stage_help(stage: str) -> str:
    from nsf.paths import CONF

    primary = _primary(stage)
    experiment = "" if stage == "point" else " [+experiment=NAME]"
    keys = (CONF / f"{primary}.yaml").read_text(encoding="utf-8")
    return (
        f"usage: nsf {stage}{experiment} [key=value …] [-m]\n\n{STAGES[stage]}\n\n{_groups()}\n\n"
        f"keys and defaults (conf/{primary}.yaml):\n{keys}"
    )


if __name__ == "__main__":
    main()
