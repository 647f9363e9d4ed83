"""`nsf export`: its options, and the work."""

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from nsf.errors import ConfigError
from nsf.export import FORMATS

_DESCRIPTION = "Writes a reduced run for other programs: any number of formats at once."
_EXAMPLES = """\
examples:
  nsf export --html                                 the newest deploy run, in a browser
  nsf export deploy/sand/1a2b --vtk --points 1000000   many more points than were trained on
  nsf export runs/deploy/sand/1a2b3c4d5e6f --frames --color displacement --parameter 33
  nsf export 1a2b --usd --onnx --every 5 --output /tmp/sand

--usd, --onnx and --frames need pip install 'nsf[export]'."""


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        raise ConfigError(f"{message}; see `nsf export --help`")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
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
    options = (
        ("parameter", str, None, "held-out case, as 26 or E=1500,friction=0.3; the first by default"),
        ("points", int, None, "how many; more than the particles are points in between (super-resolution)"),
        ("color", str, "von_mises", "von_mises or displacement"),
        ("every", int, 1, "takes each EVERY-th step"),
        ("fps", float, 30.0, "frames shown a second"),
        ("device", str, "auto", "where the fields are decoded: cpu, cuda, cuda:N or auto"),
        ("output", Path, None, "folder; export/<scene>-<hash> in ./reports (NSF_REPORTS) by default"),
    )
    for name, kind, default, tells in options:
        told = tells if default is None else f"{tells} ({default})"
        parser.add_argument(f"--{name}", type=kind, default=default, help=told)
    return parser


def main(arguments: Sequence[str]) -> int:
    """Write what the arguments ask for and say where it lies.

    Raises:
        NSFError: an argument is refused, a run or an extra is missing, or a file cannot be written.
    """
    asked = _parser().parse_args(arguments)
    formats = [name for name in FORMATS if getattr(asked, name)]
    if not formats:
        raise ConfigError(f"no format; give one or more of {', '.join(f'--{name}' for name in FORMATS)}")
    import importlib

    from nsf.extras import optional
    from nsf.runs import Run

    if asked.run is None:
        run = Run.newest("deploy")
        print(f"export: the newest deploy run, {run.id}")
    else:
        run = Run.named(asked.run, "deploy").require()
    from nsf.export.playback import Playback

    writers = {name: importlib.import_module(f"nsf.export.{name}") for name in formats}
    for needed in (module for writer in writers.values() for module in writer.NEEDS):
        optional(needed, "export")  # before any work
    playback = Playback(run, asked.parameter, asked.points, asked.color, asked.every, asked.fps, asked.device)
    print(f"export: {playback.title}, {len(playback.t)} frames, {len(playback.X):,} points")
    if playback.stopped is not None:
        print(f"export: warning: the run diverged at t = {playback.stopped:.4g} s; it is shown up to there")
    folder = asked.output or _reports() / "export" / f"{run.scene}-{run.hash}"
    for name, writer in writers.items():
        path = writer.write(playback, folder)
        print(f"export: {name} → {path} ({_size(path) / 2**20:.1f} MiB)")
    return 0


def _reports() -> Path:
    return Path(os.environ.get("NSF_REPORTS") or "reports").expanduser()


def _size(path: Path) -> int:
    """Bytes of a file, or of all in a folder."""
    found = [path] if path.is_file() else path.rglob("*")
    return sum(file.stat().st_size for file in found if file.is_file())
