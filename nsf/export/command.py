"""`nsf export`: its options, and the work."""

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from nsf.errors import ConfigError
from nsf.export import FORMATS
from nsf.live.command import Parser
from nsf.paths import reports_folder
from nsf.storage import bytes_text, size_of
from nsf.words import positive, text, whole

if TYPE_CHECKING:
    from nsf.export.playback import Playback
    from nsf.runs import Run

_DESCRIPTION = "Writes a reduced run for other programs: any number of formats at once."
_EXAMPLES = """\
examples:
  nsf export --html
      the newest deploy run, in a browser
  nsf export sand --live
      the model itself in a page, to steer without a server
  nsf export deploy/sand/1a2b --vtk --points 1000000
      many more points than were trained on
  nsf export runs/deploy/sand/1a2b --frames --color displacement --parameter 33
  nsf export 1a2b --usd --onnx --every 5 --output /tmp/sand

--usd, --onnx and --frames need pip install 'nsf[export]'."""


LIVE = "live"  # the format that holds the model in place of a run
_MOST = 10**9 - 1  # points, or steps
_OF_PLAYBACKS = ("parameter", "color", "every", "fps")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="nsf export",
        description=_DESCRIPTION,
        epilog=_EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument(
        "run", nargs="?", metavar="RUN",
        help="deploy run: its id, the beginning of it or of its hash, or its folder; the newest by default",
    )  # fmt: skip
    for name, tells in FORMATS.items():
        parser.add_argument(f"--{name}", action="store_true", help=tells)
    arguments = (
        ("parameter", text, None, "held-out case, as 26 or E=1500,friction=0.3; the first by default"),
        (
            "points",
            whole(most=_MOST),
            None,
            "how many; more than the particles are points in between (super-resolution)",
        ),
        ("color", text, None, "von_mises, the default, or displacement"),
        ("every", whole(most=_MOST), None, "takes each EVERY-th step; all by default"),
        ("fps", positive, None, "frames shown a second (30)"),
        ("device", text, "auto", "where the fields are decoded: cpu, cuda, cuda:N or auto"),
        ("output", text, None, "folder; export/<scene>-<hash> in ./reports (NSF_REPORTS) by default"),
    )
    for name, reader, default, tells in arguments:
        shown = tells if default is None else f"{tells} ({default})"
        parser.add_argument(f"--{name}", type=partial(reader, f"--{name}"), default=default, help=shown)
    return parser


def main(arguments: Sequence[str]) -> int:
    """Write what the arguments ask for and say where it lies.

    Args:
        arguments: of the command line.

    Raises:
        NSFError: an argument is refused, a run or an extra is missing, or a file cannot be written.
    """
    options = _parser().parse_args(arguments)
    formats = [name for name in FORMATS if getattr(options, name)]
    _check(options, formats)
    import importlib

    from nsf.extras import optional
    from nsf.runs import Run

    if options.run is None:
        run = Run.newest("deploy")
        print(f"export: the newest deploy run, {run.id}")
    else:
        run = Run.named(options.run, "deploy").require()
    writers = {name: importlib.import_module(f"nsf.export.{name}") for name in formats if name != LIVE}
    for needed in (module for writer in writers.values() for module in writer.NEEDS):
        optional(needed, "export")  # before any work
    folder = Path(options.output or reports_folder("export", f"{run.scene}-{run.hash}"))
    if writers:
        playback = _playback(run, options)
    for name, writer in writers.items():
        _say(name, writer.write(playback, folder))
    if LIVE in formats:
        from nsf.live.publish import write

        _say(LIVE, write(run, folder, options.points, options.device))
    return 0


def _check(options: argparse.Namespace, formats: Sequence[str]) -> None:
    """Refuse no format, and options that no format takes."""
    if not formats:
        raise ConfigError(f"no format; give one or more of {', '.join(f'--{name}' for name in FORMATS)}")
    unused = [f"--{name}" for name in _OF_PLAYBACKS if getattr(options, name) is not None]
    if formats == [LIVE] and unused:
        raise ConfigError(
            f"--{LIVE} holds every held-out case, which the page shows as its reader asks; "
            f"leave out {', '.join(unused)}"
        )


def _playback(run: "Run", options: argparse.Namespace) -> "Playback":
    from nsf.export.playback import Playback

    chosen = {name: value for name in _OF_PLAYBACKS if (value := getattr(options, name)) is not None}
    playback = Playback(run, points=options.points, device=options.device, **chosen)
    print(f"export: {playback.title}, {len(playback.t)} frames, {len(playback.X):,} points")
    if playback.stopped is not None:
        print(f"export: warning: the run diverged at t = {playback.stopped:.4g} s; it is shown up to there")
    return playback


def _say(name: str, path: Path) -> None:
    print(f"export: {name} → {path} ({bytes_text(size_of(path))})")
