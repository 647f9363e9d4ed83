"""The texts of `nsf --help` and of `nsf COMMAND --help`: commands, examples, groups and keys."""

import re
import textwrap

WIDTH = 79  # characters of a line
_HANGING = 32  # characters before a description, at most; a longer command has its description below it

STAGES = {
    "run": "the whole chain: simulate, train, deploy, evaluate, report; unchanged stages are reused",
    "simulate": "full-order trajectories of every case",
    "train": "the manifold: encoder and deformation, stress and affine fields",
    "teach": "what model=recurrence, dmdc or gru learns from full-order runs; deploy asks for it by itself",
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
        "[model=block] [folder=PATH] [open=true]; block, tray or metal; reports/demo by default",
    ),
    "export": (
        "a deployed run for other programs: HTML page, the model itself in a page, USD, VTK, ONNX, film",
        None,
    ),
    "search": (
        "values of numeric keys that make δ, or δ and the step's time, small at the validation values",
        "key=low..high[:log] … [key=value …] [search.objectives=[delta,step_ms]] [search.trials=20]",
    ),
    "calibrate": (
        "parameters from observations by runs of model=recurrence, how sure they are, a full-order run there",
        "observations=FILE [run=RUN] [NAME=LOW..HIGH|VALUE …] [program=N] [full_order=true] [starts=64] "
        "[device=auto] [folder=PATH]; or trials=N [run=RUN,RUN | +experiment=NAME] [seed=0] "
        "[folder=PATH]: full-order runs at known parameters, observed with noise",
    ),
    "sample": (
        "parameters drawn from distributions, runs in batches: quantiles, sensitivities, a posterior",
        "[run=RUN] [NAME=norm(30,2)|LOW..HIGH …] [of=height,run_out,opening,z@X:Y:Z] [runs=10000] "
        "[sensitivities=1024] [full_order=0] [observations=FILE] [program=N] [seed=0] [folder=PATH]",
    ),
    "design": (
        "a program of forcing that brings a target about, by least squares, and the full-order run along it",
        "target=FILE|height=0.1|x@X:Y:Z=0.5 tilt=ANGLE|move=SOLID,SOLID [run=RUN] [NAME=VALUE …] [knots=6] "
        "[full_order=true] [seed=0] [device=auto] [folder=PATH]",
    ),
    "plan": (
        "what nsf run would do: stages and their states, size, time and room; --cfg: the configuration",
        "[-m] [+experiment=NAME] [key=value …] [--cfg]; nsf run … --dry-run is the same",
    ),
    "init": (
        "a project of yours in a new or empty folder, its scene scaled to your mesh",
        "FOLDER [mesh=FILE unit=m|cm|mm [up=z]]",
    ),
    "runs": ("every run there is: listed, shown, compared, verified, deleted", None),
    "index": (
        "a page of every run, with a thumbnail each, that sorts and filters in the browser",
        "[folder=PATH]; reports/runs by default",
    ),
    "reports": (
        "table, page and charts of all reports; html=true: a page each; check=true: whether they changed",
        "[folder=PATH] [html=true] [check=true]; reports by default",
    ),
    "bench": (
        "time and memory of a step, kernel by kernel; writes reports/speed",
        "[benches=whole,full_order] [particles=10k,200k,1m] [scenes=cake,metal] [precision=fp32,fp64] "
        "[device=auto] [trials=10] [folder=PATH]; benches are whole, full_order, scaling, reduced, batch, "
        "recurrence, training and peers; all, and sizes that suit the device, by default",
    ),
    "validate": (
        "problems with published answers at full order, and both in a table; writes reports/validation; or "
        "the paper's scenes on finer grids, in reports/convergence",
        "[problems=taylor_bar,cantilever,discs,settling,collapse,incline | scenes=bread,cake,sand,metal,"
        "toothpaste,jelly_cube,squishy_ball] [scale=small|paper] [device=cpu] [folder=PATH]; all problems by "
        "default, in some minutes on a CPU",
    ),
    "doctor": ("versions, devices, folders and extras of this installation", ""),
}
#: Of `nsf --help`; `nsf COMMAND --help` has the details.
_OVERVIEW = """\
usage: nsf COMMAND [key=value …]      nsf COMMAND --help says more

a project of yours:
  nsf init FOLDER mesh=FILE unit=mm       around your mesh
  cd FOLDER; pip install -e .             README.md there says what to change
  nsf run --config-dir conf scene=FOLDER  from simulation to report

around a run:
  plan          what it does, and how long it takes
  simulate train teach deploy evaluate report    its stages
  superresolve  the deployed fields at many more points
  point         a material along a deformation path
  search        keys that make errors small

a model in use:
  demo          in the browser, at once, with nothing to train
  view          steered in the browser
  serve         as a stream that browsers decode
  export        as a page, USD, VTK, ONNX or film
  calibrate     parameters from observations
  sample        thousands of runs: quantiles, sensitivities
  design        forcing that brings a target about

records:
  runs          list, compare, verify, delete runs
  index         a page of all runs
  reports       a page of all reports
  validate      full-order runs beside published answers
  bench         time and memory of a step
  doctor        versions, devices, folders"""
_EXAMPLES = """\
examples:
  nsf run scene=sand scale=small
      the paper's method in a minute or two, on a CPU
  nsf run scene=sand stress=deformation affine=none
      the baseline beside it, in the same report
  nsf run -m scene=sand latent_dim=4,6 sampler.size=50,150
      every combination
  nsf run -m +experiment=timestep hydra/launcher=joblib
      the jobs of an experiment side by side, and their report

Results lie in ./runs (NSF_RUNS) and ./reports (NSF_REPORTS). Every command
takes --config-dir DIR, or NSF_CONFIG=DIR: a folder with groups of yours, as
DIR/scene/mine.yaml, and experiments, as DIR/experiments/mine.yaml."""


def primary(stage: str) -> str:
    """Name of the stage's primary configuration file."""
    return "point" if stage == "point" else "config"


def whole() -> str:
    """Of `nsf --help`: every command, the three of a new project first."""
    return _OVERVIEW


def of_tool(name: str) -> str:
    """Of `nsf TOOL --help`, where it has no options of its own."""
    text, takes = TOOLS[name]
    return fitted(f"usage: nsf {name} {takes}\n\n{text}")


def fitted(text: str) -> str:
    """Text in lines of at most `WIDTH` characters; what stands behind a gap is broken within its column.

    A comment of a yaml that is too long stands above its key.
    """
    return "\n".join(part for line in text.splitlines() for part in _fitted(line))


def _fitted(line: str) -> list[str]:
    indent = " " * (len(line) - len(line.lstrip()))
    if len(line) <= WIDTH:
        return [line]
    if "  # " in line:
        code, _, comment = line.partition("  # ")
        return [*_wrapped(f"{indent}# {comment}", f"{indent}# "), code]
    if line.startswith("# "):
        return _wrapped(line, "# ")
    gap = re.match(r" *\S.*?  +(?=\S)", line)
    if gap and gap.end() > _HANGING:
        return [gap[0].rstrip(), *_wrapped(f"      {line[gap.end() :]}", "      ")]
    return _wrapped(line, " " * (gap.end() if gap else 7 if line.startswith("usage: ") else len(indent)))


def _wrapped(line: str, hanging: str) -> list[str]:
    options = {"break_long_words": False, "break_on_hyphens": False}
    return textwrap.wrap(line, WIDTH, subsequent_indent=hanging, **options)


def groups_text() -> str:
    """The options of every group, and the experiments."""
    from nsf.paths import experiments, groups

    width = max(map(len, groups()))
    lines = [f"  {group:<{width}} {' '.join(options)}" for group, options in groups().items()]
    lines += ["", "experiments (+experiment=NAME, or +experiment=NAME/PART):", f"  {' '.join(experiments())}"]
    return "\n".join(["configuration groups (group=option):", *lines])


def of_stage(stage: str) -> str:
    """Of `nsf STAGE --help`."""
    from nsf.paths import CONF

    name = primary(stage)
    experiment = "" if stage == "point" else " [+experiment=NAME]"
    keys = (CONF / f"{name}.yaml").read_text(encoding="utf-8")
    parts = [STAGES[stage], *([_EXAMPLES] if stage == "run" else []), groups_text()]
    middle = "\n\n".join(parts)
    return fitted(
        f"usage: nsf {stage} [-m]{experiment} [key=value …]\n\n{middle}\n\n"
        f"keys and defaults (conf/{name}.yaml):\n{keys}"
    )
