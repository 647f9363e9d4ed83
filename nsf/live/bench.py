"""The measurements of `--bench`: how fast the picture follows a slider, and how much a stream costs."""

import asyncio
import json
import logging
import sys
import time
from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd
from websockets.asyncio.client import connect

from nsf.live.feeds import LatentFeed, PointFeed
from nsf.live.player import Player
from nsf.live.server import Stream
from nsf.scenes.designs import evenly

#: A rate that no server reaches, so that it sends as fast as it can.
_UNLIMITED = 1e6
_TRIALS = 9
_MOST = 10_000  # cases that are steered to
_SECONDS, _WARM_UP, _STEER = 5.0, 1.0, 0.5


def follow(player: Player) -> pd.DataFrame:
    """How fast `nsf view` can follow its slider, without the time of the browser.

    Returns:
        One row a shown step. While that step is shown, the parameters move: median and longest time [s] until
        the run of the new case is shown. "of it build [s]" is the share of building the solver. "frames/s"
        counts a step and its picture (with the full-order run's), one after the other.
    """
    model, feed = player.model, PointFeed(player.model)
    rows, values = [], _values([p.trained for p in model.parameters])
    with player:
        player.playing = False
        for step in sorted({player.steps // 4, player.steps // 2, player.steps}):
            player.seek(step)
            waits, builds, steps, pictures = ([] for _ in range(4))
            for _ in range(_TRIALS):
                started = time.perf_counter()
                player.steer(next(values))
                while player.tick().run.case != player.case:
                    time.sleep(0.001)
                waits.append(time.perf_counter() - started)
                moment = player.tick()
                builds.append(waits[-1] - moment.run.seconds)
                steps.append(moment.run.seconds / moment.run.reached)
                started = time.perf_counter()
                feed.frame(moment)
                pictures.append(time.perf_counter() - started)
            rows.append(
                {
                    "shown step": step,
                    "median [s]": round(float(np.median(waits)), 3),
                    "longest [s]": round(max(waits), 3),
                    "of it build [s]": round(float(np.median(builds)), 3),
                    "step [ms]": round(1e3 * float(np.median(steps)), 2),
                    "picture [ms]": round(1e3 * float(np.median(pictures)), 2),
                    "frames/s": round(1.0 / float(np.median(steps) + np.median(pictures)), 1),
                }
            )
    return pd.DataFrame(rows)


def _values(box: Sequence[Sequence[float]]) -> Iterator[list[float]]:
    """Values between the ends of a box [n, 2], none twice: the player keeps the runs it had before."""
    low, high = np.transpose(box)
    return ((low + (high - low) * u).tolist() for u in evenly(_MOST, len(box)))


def bench(player: Player, counts: Sequence[int], rate: float) -> pd.DataFrame:
    """Frames a second at each number of clients, at the rate asked for and as fast as possible.

    The clients are another process of this machine. One of them moves the parameters twice a second, so that
    the server makes reduced runs throughout. The server sends nothing while a run stands still at its end.

    Returns:
        Columns: clients, rate asked for, mean and least frames/s of a client.
    """
    logging.getLogger("nsf").setLevel(logging.WARNING)  # without a line for each client that comes or goes
    rows = []
    for count in counts:
        for wanted in (rate, _UNLIMITED):
            got = asyncio.run(_measured(player, count, wanted))
            rows.append(
                {
                    "clients": count,
                    "asked": f"{wanted:g}" if wanted < _UNLIMITED else "all it can",
                    "frames/s": round(float(np.mean(got)), 1),
                    "slowest client": round(min(got), 1),
                }
            )
    return pd.DataFrame(rows)


def sizes(player: Player) -> dict[str, int]:
    """Bytes of a frame on the wire, of its positions, of these and their stress, and of the field."""
    model, feed = player.model, LatentFeed(player.model)
    frame = len(feed.frame(player.tick()))
    return {
        # A server's WebSocket frame of up to 125 bytes has a header of two.
        "frame": frame + (2 if frame <= 125 else 4),
        "latent": 4 * model.manifold.latent_dim,
        "positions": 12 * model.particles,
        "positions and stress": 36 * model.particles,
        "field": len(feed.field),
    }


async def _measured(player: Player, count: int, rate: float) -> list[float]:
    stream = Stream(player, LatentFeed(player.model), "127.0.0.1", rate=rate)
    async with await stream.listen(0) as server:
        playing = asyncio.create_task(stream.play())
        port = server.sockets[0].getsockname()[1]
        box = [p.trained for p in player.model.parameters]
        arguments = [f"ws://127.0.0.1:{port}/stream", count, json.dumps(box)]
        clients = await asyncio.create_subprocess_exec(
            sys.executable, "-m", __name__, *map(str, arguments), stdout=asyncio.subprocess.PIPE
        )
        said, _ = await clients.communicate()
        playing.cancel()
    return json.loads(said)


async def _clients(url: str, count: int, box: Sequence[Sequence[float]]) -> list[float]:
    async def client(steers: bool) -> float:
        async with connect(url, compression=None) as connection:
            frames, steered, values = 0, 0.0, _values(box)
            started = time.monotonic() + _WARM_UP
            while (now := time.monotonic()) < started + _SECONDS:
                message = await connection.recv()
                frames += isinstance(message, bytes) and now > started
                if steers and now > steered + _STEER:
                    steered = now
                    await connection.send(json.dumps({"values": next(values)}))
            return frames / _SECONDS

    return await asyncio.gather(*(client(index == 0) for index in range(count)))


if __name__ == "__main__":
    url, count, box = sys.argv[1:]
    print(json.dumps(asyncio.run(_clients(url, int(count), json.loads(box)))))
