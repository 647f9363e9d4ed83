"""`nsf view`: its options, and what it says."""

import argparse
import logging
import threading
from collections.abc import Sequence

from nsf.runs import Run

#: Hosts that only this machine reaches.
LOOPBACK = ("127.0.0.1", "localhost", "::1")


def main(command: str, text: str, arguments: Sequence[str]) -> int:
    """Parse the options of a command and do it until it is interrupted.

    Args:
        command: `view`.
        text: what it does, for its help.
        arguments: after the command.

    Raises:
        NSFError: a fault the user can mend.
    """
    options = _parser(command, text).parse_args(arguments)
    run = Run.named("deploy", options.run)
    if not options.run:
        print(f"{command}: no run given; the newest deployment")
    print(f"{command}: {run.id}", flush=True)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("nsf").setLevel(logging.INFO)
    import torch

    # A step's matrices are small; threads that wait for one another cost more than they give, and the
    # page needs the other core.
    torch.set_num_threads(1)
    with_model = _view
    try:
        with_model(run, options)
    except KeyboardInterrupt:
        print(f"{command}: ended")
    return 0


def _view(run: Run, options: argparse.Namespace) -> None:
    from nsf.live.model import LiveModel
    from nsf.live.page import Page  # first: without viser there is no use in building a model
    from nsf.live.player import Player

    player = Player(LiveModel(run, options.points, options.device))
    page = Page(player, options.host, options.port)
    if options.host not in LOOPBACK:
        print(f"view: warning: whoever reaches {options.host} can look and steer")
    print(f"view: open {page.url} (Ctrl-C ends)", flush=True)
    try:
        with player:
            page.run(threading.Event())
    finally:
        page.close()


def _parser(command: str, text: str) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog=f"nsf {command}", description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add(
        "run", nargs="?", default="", metavar="RUN", help="deploy run, or the beginning of its id; the newest"
    )
    add("--host", default="127.0.0.1", help="address to serve at")
    add("--port", type=int, default=8080, help="to serve at")
    add("--points", type=int, default=6000, help="most particles that are shown")
    add("--device", default="auto", help="of the reduced run: cpu, cuda, cuda:N or auto")
    return parser
