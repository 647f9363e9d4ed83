"""`nsf view` and `nsf serve`: their options, and what they say."""

import argparse
import logging
import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING
from urllib.parse import quote

from nsf.errors import ConfigError
from nsf.extras import optional
from nsf.live import LOOPBACK
from nsf.runs import Run

if TYPE_CHECKING:
    from nsf.live.player import Player


class _Parser(argparse.ArgumentParser):
    def error(self, message: str):
        raise ConfigError(f"{message}; see `{self.prog} --help`")


_NEEDS = {"view": "viser", "serve": "websockets"}


def main(command: str, text: str, arguments: Sequence[str]) -> int:
    """Parse the options of a command and do it until it is interrupted.

    Args:
        command: `view` or `serve`.
        text: what it does, for its help.
        arguments: after the command.

    Raises:
        NSFError: a fault the user can mend.
    """
    options = _parser(command, text).parse_args(arguments)
    optional(_NEEDS[command], "view")  # without it there is no use in building a model
    if options.run:
        run = Run.named(options.run, "deploy").require()
    else:
        run = Run.newest("deploy")
        print(f"{command}: no run given; the newest deployment")
    print(f"{command}: {run.id}", flush=True)
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    logging.getLogger("nsf").setLevel(logging.INFO)
    import torch

    # A step's matrices are small; threads that wait for one another cost more than they give, and the
    # page needs the other core.
    torch.set_num_threads(1)
    with_model = {"view": _view, "serve": _serve}[command]
    try:
        with_model(run, options)
    except KeyboardInterrupt:
        print(f"{command}: ended")
    return 0


def _view(run: Run, options: argparse.Namespace) -> None:
    from nsf.live.page import Page

    player = _player(run, options)
    if options.bench:
        from nsf.live.bench import follow

        print(follow(player).to_string(index=False))
        return
    page = Page(player, options.host, options.port)
    if options.host not in LOOPBACK:
        print(f"view: warning: whoever reaches {options.host} can look and steer; nsf serve asks for a token")
    closing = threading.Event()
    try:
        # Drawing has a thread of its own, and this one only waits: Python drops an interrupt that it raises
        # where an object is deleted, and one raised inside a lock may leave the lock held.
        with player, ThreadPoolExecutor(1) as pool:
            drawing = pool.submit(page.run, closing)
            print(f"view: open {page.url} (Ctrl-C ends)", flush=True)
            try:
                while not drawing.done():
                    time.sleep(0.1)
                drawing.result()
            finally:
                closing.set()
    finally:
        page.close()


def _serve(run: Run, options: argparse.Namespace) -> None:
    import asyncio
    import secrets

    from nsf.live.guard import check_token
    from nsf.live.server import Stream

    token = options.token
    if token is None and options.host not in LOOPBACK:
        token = secrets.token_urlsafe(16)
    check_token(options.host, token)  # before the model is built
    player = _player(run, options)
    if options.bench:
        _bench(player, options)
        return
    stream = Stream(player, options.host, token, options.rate, options.patience)

    async def play() -> None:
        async with await stream.listen(options.port) as server:
            port = server.sockets[0].getsockname()[1]
            query = f"?token={quote(token)}" if token else ""
            print(f"serve: open http://{_bracketed(options.host)}:{port}/{query} (Ctrl-C ends)", flush=True)
            await stream.play()

    with player:
        asyncio.run(play())


def _bench(player: "Player", options: argparse.Namespace) -> None:
    from nsf.live.bench import bench, sizes

    found = sizes(player)
    print(f"serve: a frame is {found['frame']} bytes a user, of which x̂ is {found['latent']}")
    told = f"{found['positions']:,} bytes, with their stress {found['positions and stress']:,}"
    print(f"serve: the positions of all particles would be {told}")
    print(f"serve: the field, once a user, is {found['field']:,} bytes")
    with player:
        print(bench(player, options.bench, options.rate).to_string(index=False))


def _player(run: Run, options: argparse.Namespace) -> "Player":
    from nsf.live.model import LiveModel
    from nsf.live.player import Player

    return Player(LiveModel(run, options.points, options.device))


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host


def _parser(command: str, text: str) -> argparse.ArgumentParser:
    parser = _Parser(
        prog=f"nsf {command}", description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add(
        "run", nargs="?", default="", metavar="RUN", help="deploy run, or the beginning of its id; the newest"
    )
    add("--host", default="127.0.0.1", help="address to serve at")
    add("--port", type=_port, default={"view": 8080, "serve": 8765}[command], help="to serve at")
    add("--points", type=_count, default=6000, help="most particles that are shown")
    add("--device", default="auto", help="of the reduced run: cpu, cuda, cuda:N or auto")
    if command == "view":
        add("--bench", action="store_true", help="measure how fast the slider is followed, and end")
    else:
        add(
            "--token",
            help="that whoever joins must give, 16 letters at least; drawn unless only this machine can join",
        )
        add("--rate", type=_positive, default=30.0, help="frames a second")
        add("--patience", type=_positive, default=5.0, help="seconds that a client may lag")
        add("--bench", type=_counts, metavar="N,…", help="measure with so many clients on loopback, and end")
    return parser


def _number(kind: type, text: str):
    try:
        return kind(text)
    except ValueError:
        told = {int: "a whole number", float: "a number"}[kind]
        raise argparse.ArgumentTypeError(f"{text!r} must be {told}") from None


def _positive(text: str) -> float:
    value = _number(float, text)
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"{text} must be positive and finite")
    return value


def _count(text: str) -> int:
    value = _number(int, text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text} must be at least 1")
    return value


def _counts(text: str) -> list[int]:
    return [_count(part) for part in text.split(",")]


def _port(text: str) -> int:
    value = _number(int, text)
    if not 0 <= value < 65536:
        raise argparse.ArgumentTypeError(f"{text} must lie in [0, 65535]; 0 takes a free one")
    return value
