"""`nsf view` and `nsf serve`: their options, and what they say."""

import argparse
import asyncio
import logging
import secrets
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING
from urllib.parse import quote

from nsf.errors import ConfigError
from nsf.extras import optional
from nsf.live import LOOPBACK
from nsf.runs import Run
from nsf.words import flag, positive, whole

if TYPE_CHECKING:
    from nsf.live.player import Player

PORTS = {"view": 8080, "serve": 8765}


class Parser(argparse.ArgumentParser):
    """Of options with dashes or, as all other commands take them, `key=value`."""

    def parse_args(self, arguments: Sequence[str]) -> argparse.Namespace:
        """The options; a `key=value` is that of the option `--key`, and `run=` the run."""
        words: list[str] = []
        for before, word in zip(("", *arguments), arguments, strict=False):
            words += [word] if self._takes_value(before) else self._dashed(word)
        return super().parse_args(words)

    def _takes_value(self, word: str) -> bool:
        """Whether a word is an option, or the beginning of one, after which its value stands."""
        options = self._option_string_actions.items()
        return len(word) > 2 and any(name.startswith(word) and one.nargs != 0 for name, one in options)

    def _dashed(self, word: str) -> list[str]:
        key, equals, value = word.partition("=")
        if not equals or not key.isidentifier():
            return [word]
        if key == "run":
            return [value]
        if (option := self._option_string_actions.get(f"--{key}")) is None:
            keys = [name[2:] for name in self._option_string_actions if name.startswith("--")]
            self.error(f"no key {key!r}; it takes run, {', '.join(keys[1:])}")  # the first one is help
        return [f"--{word}"] if option.nargs != 0 else [f"--{key}"] * flag(key, value)

    def error(self, message: str):
        """Refuse the options."""
        raise ConfigError(f"{message}; see `{self.prog} --help`")


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
    optional("websockets", "view")  # without it there is no use in building a model
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
    try:
        _run(command, run, options)
    except KeyboardInterrupt:
        print(f"{command}: ended")
    return 0


def _run(command: str, run: Run, options: argparse.Namespace) -> None:
    from nsf.live.feeds import LatentFeed, PointFeed
    from nsf.live.guard import check_token
    from nsf.live.model import LiveModel
    from nsf.live.player import Player

    token = options.token
    if token is None and options.host not in LOOPBACK:
        token = secrets.token_urlsafe(16)
    check_token(options.host, token)  # before the model is built
    player = Player(LiveModel(run, options.points, options.device))
    if options.bench:
        _bench(command, player, options)
        return
    feed = {"view": PointFeed, "serve": LatentFeed}[command](player.model)
    with player:
        asyncio.run(_serve(command, player, feed, token, options))


async def _serve(command: str, player: "Player", feed, token: str | None, options) -> None:
    from nsf.live.server import Stream

    stream = Stream(player, feed, options.host, token, options.rate, options.patience)
    async with await stream.listen(options.port) as server:
        port = server.sockets[0].getsockname()[1]
        host = f"[{options.host}]" if ":" in options.host else options.host
        query = f"?token={quote(token)}" if token else ""
        print(f"{command}: open http://{host}:{port}/{query} (Ctrl-C ends)", flush=True)
        await stream.play()


def _bench(command: str, player: "Player", options: argparse.Namespace) -> None:
    from nsf.live.bench import bench, follow, sizes

    if command == "view":
        print(follow(player).to_string(index=False))
        return
    bytes_of = sizes(player)
    print(f"serve: a frame is {bytes_of['frame']} bytes a user, of which x̂ is {bytes_of['latent']}")
    text = f"{bytes_of['positions']:,} bytes, with their stress {bytes_of['positions and stress']:,}"
    print(f"serve: the positions of all particles would be {text}")
    print(f"serve: the field, once a user, is {bytes_of['field']:,} bytes")
    with player:
        print(bench(player, options.bench, options.rate).to_string(index=False))


def _parser(command: str, text: str) -> argparse.ArgumentParser:
    parser = Parser(
        prog=f"nsf {command}", description=text, formatter_class=argparse.ArgumentDefaultsHelpFormatter
    )
    add = parser.add_argument
    add(
        "run", nargs="?", default="", metavar="RUN", help="deploy run, or the beginning of its id; the newest"
    )
    add("--host", default="127.0.0.1", help="address to serve at")
    add(
        "--port",
        type=partial(whole(0, 65535), "--port"),
        default=PORTS[command],
        help="to serve at; 0 takes a free one",
    )
    add("--points", type=partial(whole(), "--points"), default=6000, help="most particles that are shown")
    add("--device", default="auto", help="of the reduced run: cpu, cuda, cuda:N or auto")
    add(
        "--token",
        help="that whoever joins must give, 16 letters at least; drawn unless only this machine can join",
    )
    add("--rate", type=partial(positive, "--rate"), default=30.0, help="frames a second")
    add("--patience", type=partial(positive, "--patience"), default=5.0, help="seconds that a client may lag")
    if command == "view":
        add("--bench", action="store_true", help="measure how fast the slider is followed, and end")
    else:
        add("--bench", type=_counts, metavar="N,…", help="measure with so many clients on loopback, and end")
    return parser


def _counts(text: str) -> list[int]:
    return [whole()("--bench", part) for part in text.split(",")]
