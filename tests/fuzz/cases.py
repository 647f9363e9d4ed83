"""The kinds of case: each draws one malformed input and says how the package meets it."""

import asyncio
import contextlib
import gzip
import hashlib
import io
import json
import logging
import os
import pickle
import random
import shutil
import socket
import struct
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import h5py
import inputs
import numpy as np
import torch
import yaml
from omegaconf import OmegaConf

import nsf.config
import nsf.paths
from nsf.bodies import camera
from nsf.errors import ConfigError
from nsf.results import style
from nsf.results.charts import CHARTS
from nsf.results.question import Question
from nsf.results.report import build_report
from nsf.runs import Run
from nsf.terminal import visible

CONF = nsf.paths.CONF
#: Keys of the tiny chain that make a run of it shorter still.
_SHORT = ("scene.steps=2", "evaluation.trials=0")
#: Those of a training that is interrupted: two blocks a phase.
_BRIEF = ("trainer.steps=60",)


@dataclass(frozen=True)
class Case:
    """One malformed input.

    Attributes:
        what: it is, for a reader.
        run: hands it over.
        altered: it is data that were changed after they were recorded, or that cannot be meant.
    """

    what: str
    run: Callable[[], object]
    altered: bool = False


def draw_coarsely(setattr=setattr) -> None:
    """Draw charts and bodies with few pixels, as nobody looks at them; a test passes its own `setattr`."""
    setattr(style, "PIXELS", style.PIXELS // 4)
    setattr(camera, "_OVERSAMPLE", 1)


class Workshop:
    """A tiny chain on disk, of which cases spoil copies.

    Args:
        folder: everything lies here; cases may write nowhere else.
        root: runs of the tiny chain, up to `evaluate`.
        tiny: its overrides.
    """

    def __init__(self, folder: Path, root: Path, tiny: tuple[str, ...]):
        self.folder, self.root, self.tiny = folder, root, tiny
        self.runs, self.conf = folder / "runs", folder / "conf"
        shutil.copytree(CONF, self.conf)
        os.environ["NSF_RUNS"], os.environ["NSF_REPORTS"] = str(self.runs), str(folder / "reports")

    def fresh(self) -> Path:
        """The chain's runs anew, in hard links: whoever changes a file takes a copy first."""
        shutil.rmtree(self.runs, ignore_errors=True)
        shutil.copytree(self.root, self.runs, copy_function=os.link)
        return self.runs

    def only(self, stage: str) -> Run:
        """A run of a stage, in a fresh chain."""
        self.fresh()
        return Run.find(stage, root=self.runs)[0]

    def rewrite(self, path: Path, data: bytes) -> None:
        """Other content for a file of a fresh chain."""
        path.unlink()
        path.write_bytes(data)

    def recorded(self, path: Path) -> None:
        """Make the manifest beside a file say what the file now is, as a stranger would."""
        manifest = path.parent / "manifest.json"
        content = json.loads(manifest.read_text())
        for output in content["outputs"]:
            if output["path"] == path.name:
                data = path.read_bytes()
                output |= {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
        self.rewrite(manifest, json.dumps(content).encode())

    def command(self, *words: str) -> Callable[[], object]:
        """The command line in this process, with nothing shown."""

        def run() -> None:
            from nsf.cli import main

            shown = io.StringIO()
            try:
                with contextlib.redirect_stdout(shown), contextlib.redirect_stderr(shown):
                    main(list(words))
            finally:
                assert shown.getvalue() == visible(shown.getvalue()), "a terminal would obey this"

        return run

    def with_keys(self, *more: str) -> list[str]:
        """The overrides of the tiny chain, other values in the place of its own."""
        keys = {word.split("=")[0].lstrip("+~") for word in more}
        return [word for word in (*self.tiny, *_SHORT) if word.split("=")[0] not in keys] + list(more)

    @cached_property
    def keys(self) -> list[str]:
        """Every dotted key of the configuration that holds a value."""
        config = OmegaConf.to_container(nsf.config.load(self.tiny), resolve=False)

        def leaves(node, prefix=""):
            for name, child in node.items():
                yield f"{prefix}{name}"
                if isinstance(child, dict):
                    yield from leaves(child, f"{prefix}{name}.")

        return [key for key in leaves(config) if not key.startswith("scene.paper")]

    @cached_property
    def interrupted(self) -> tuple[Path, dict]:
        """Runs with a short training that was interrupted in its last phase, and the weights it ends with."""
        from tiny import tiny_pipeline

        from nsf.kinematics.training.lightning import BlockCheckpoint

        root = self.folder / "interrupted"
        shutil.copytree(self.root / "simulate", root / "simulate", copy_function=os.link)
        true_end, ends = BlockCheckpoint.on_train_epoch_end, []

        def interrupted(callback, trainer, module) -> None:
            true_end(callback, trainer, module)
            ends.append(callback)
            if len(ends) == 3:  # of four blocks in two phases
                raise KeyboardInterrupt

        interrupting = mock.patch.object(BlockCheckpoint, "on_train_epoch_end", interrupted)
        with interrupting, contextlib.suppress(KeyboardInterrupt):
            tiny_pipeline(root, *_BRIEF).run("train")
        whole = self.folder / "whole"
        shutil.copytree(root, whole)
        manifold = tiny_pipeline(whole, *_BRIEF).run("train").path / "manifold.pt"
        return root, torch.load(manifold, weights_only=True)["state"]

    @cached_property
    def model(self):
        """As much of the tiny chain's model as observations are held to."""
        from nsf.kinematics.manifold import Manifold

        manifold = Manifold.load(self.only("train").path / "manifold.pt")
        return SimpleNamespace(manifold=manifold, t=np.linspace(0.0, 0.12, 25), spacing=0.01)

    @cached_property
    def server(self) -> int:
        """The port of a stream that serves the tiny chain's deployment, as long as this process lives."""
        from nsf.live.feeds import LatentFeed
        from nsf.live.model import LiveModel
        from nsf.live.player import Player
        from nsf.live.server import Stream

        player = Player(LiveModel(self.only("deploy"), 200, "cpu"))
        ports, started = [], threading.Event()

        async def serve() -> None:
            stream = Stream(player, LatentFeed(player.model), "127.0.0.1", token="a-token-of-the-fuzzer")
            async with await stream.listen(0) as server:
                ports.append(server.sockets[0].getsockname()[1])
                started.set()
                await asyncio.Event().wait()

        threading.Thread(target=lambda: asyncio.run(serve()), daemon=True).start()
        assert started.wait(60)
        return ports[0]


def overrides(shop: Workshop, draw: random.Random) -> Case:
    """A key of the command line with a malformed value."""
    key = draw.choice(shop.keys)
    words = [f"{draw.choice(('', '', '', '+', '++', '~'))}{key}={draw.choice(inputs.VALUES)}"]
    if draw.random() < 0.2:
        words.append(f"{draw.choice(shop.keys)}={draw.choice(inputs.VALUES)}")
    return Case(" ".join(words), shop.command("simulate", *shop.with_keys(*words)))


def targets(shop: Workshop, draw: random.Random) -> Case:
    """A `_target_` that names what no configuration may call, on the command line or in a run handed over."""
    config = OmegaConf.to_container(nsf.config.load(shop.tiny), resolve=False)
    nodes = []

    def walk(node, path):
        if isinstance(node, dict):
            nodes.append((path, node))
            for name, child in node.items():
                walk(child, [*path, name])

    walk(config, [])
    path, node = draw.choice([n for n in nodes if n[0] and ("_target_" in n[1] or draw.random() < 0.3)])
    target, victim = draw.choice(inputs.TARGETS), shop.folder / "victim.json"
    victim.write_text("untouched")
    node["_target_"] = target
    node |= draw.choice(
        (
            {},
            {"path": str(victim), "value": {"a": 1}},
            {"arguments": ["bench", f"folder={victim}"]},
            {"_args_": [str(victim), "w"]},
            {"_partial_": True},
            {"module": "nsf_fuzz_canary", "extra": "x"},
            {"call": None, "environment": {"A": "b"}},
            {"_recursive_": False},
            {"_convert_": "none"},
            {"_mode_": "x", "_nsf_": 1},
        )
    )
    if draw.random() < 0.4:
        for key in [k for k in node if not k.startswith("_")][: draw.randrange(4)]:
            del node[key]
    handed_over = shop.only("deploy")

    def run() -> None:
        from nsf.pipeline import Pipeline

        place = handed_over.path / "configuration.yaml"
        shop.rewrite(place, OmegaConf.to_yaml(OmegaConf.create(config)).encode())
        shop.recorded(place)
        try:
            pipeline = Pipeline.of_run(handed_over, "cpu", lambda line: None)
            pipeline.scene.particles()
        finally:
            assert victim.read_text() == "untouched", "the victim was written"

    return Case(f"{'.'.join(map(str, path))}: {node}", run, altered=True)


def scenes(shop: Workshop, draw: random.Random) -> Case:
    """The yaml of a scene or of another group, changed."""
    files = sorted(shop.conf.glob("*/*.yaml"))
    scene = [f for f in files if f.parent.name == "scene" and f.stem != "fuzz"]
    path = draw.choice(scene if draw.random() < 0.7 else [f for f in files if f.parent.name != "hydra"])
    text = inputs.mutated_text((CONF / path.relative_to(shop.conf)).read_text(encoding="utf-8"), draw)
    data = text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text

    def run() -> None:
        from nsf.pipeline import Pipeline

        path.write_bytes(data)
        try:
            with _configurations_of(shop.conf):
                words = ["scale=small", "device=cpu", f"{path.parent.name}={path.stem}"]
                Pipeline(nsf.config.load(words), lambda line: None, shop.folder / "none").scene.particles()
        finally:
            shutil.copy(CONF / path.relative_to(shop.conf), path)

    return Case(f"{path.parent.name}/{path.name}: {data[:3000]!r}", run)


@contextlib.contextmanager
def _configurations_of(folder: Path):
    """Compose from another folder, as from a user's checkout."""
    modules = [m for m in vars(nsf).values() if getattr(m, "CONF", None) == CONF]
    for module in modules:
        module.CONF = folder
    try:
        yield
    finally:
        for module in modules:
            module.CONF = CONF


def experiments(shop: Workshop, draw: random.Random) -> Case:
    """The yaml of an experiment, changed."""
    path = draw.choice(sorted(nsf.paths.EXPERIMENTS.glob("*.yaml")))
    text = path.read_text(encoding="utf-8")
    if draw.random() < 0.5:
        tree = inputs.mutated_json(yaml.safe_load(text), draw)
        try:
            data = yaml.safe_dump(tree, allow_unicode=True).encode("utf-8", "surrogatepass")
        except yaml.YAMLError:
            data = b"jobs: [5]"
    else:
        data = inputs.mutated_text(text, draw)
        data = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data

    def run() -> None:
        from nsf.pipeline.sweeps.experiment import Experiment

        folder = shop.folder / "experiments"
        folder.mkdir(exist_ok=True)
        (folder / "fuzz.yaml").write_bytes(data)
        for job in Experiment.load("fuzz", folder=folder).jobs[:1]:
            nsf.config.load([*job.overrides, "device=cpu"])

    return Case(f"{path.name}: {data[:2000]!r}", run)


#: Files of a run, and the stage that reads them.
_READERS = {"simulate": "train", "train": "deploy", "deploy": "evaluate"}


def damaged(shop: Workshop, draw: random.Random) -> Case:
    """A recorded file with other bytes than those that were recorded."""
    stage = draw.choice(list(_READERS))
    shop.fresh()
    runs = [run for run in Run.find(stage, root=shop.runs)]
    run = draw.choice(runs)
    path = run.path / draw.choice(sorted(output["path"] for output in run.manifest["outputs"]))
    data = inputs.mutated(path.read_bytes(), draw)
    if draw.random() < 0.6:  # of the recorded size, which alone would give it away
        size = path.stat().st_size
        data = (data + bytes(size))[:size]
        if data == path.read_bytes():
            data = bytes([data[0] ^ 1]) + data[1:]

    def hand_over() -> None:
        shop.rewrite(path, data)
        run.require().file(path.name)

    return Case(f"{run.id}/{path.name} altered", hand_over, altered=True)


def hdf5(shop: Workshop, draw: random.Random) -> Case:
    """A trajectory or a rollout that is whole by its hash and cannot be meant."""
    stage, name = draw.choice((("simulate", "trajectory.h5"), ("deploy", "rollout_0.h5")))
    run = shop.only(stage)
    path = run.path / name
    data = path.read_bytes()
    path.unlink()
    path.write_bytes(data)
    what = inputs.spoiled_hdf5(path, draw)
    shop.recorded(path)

    def hand_over() -> None:
        from nsf.data import Trajectory
        from nsf.deployment import Rollout

        if name == "rollout_0.h5":
            Rollout.open(path)
            return
        with Trajectory.open(path) as trajectory:
            for field in ("x", "v", "C", "tau"):
                trajectory.read(field)

    return Case(f"{name}: {what}", hand_over, altered=True)


class _Code:
    def __reduce__(self):
        return os.system, ("touch nsfcanary",)


def checkpoints(shop: Workshop, draw: random.Random) -> Case:
    """A manifold that is whole by its hash and cannot be meant, or carries code."""
    run = shop.only("train")
    path = run.path / "manifold.pt"
    content = torch.load(path, weights_only=True)
    tensors = [key for key, value in content["state"].items() if value.is_floating_point() and value.numel()]
    key, kind = draw.choice(tensors), draw.randrange(8)
    what = f"{key} "
    if kind in (0, 1):
        value = content["state"][key].clone()
        value.view(-1)[draw.randrange(value.numel())] = draw.choice((float("nan"), float("inf")))
        content["state"][key], what = value, what + "is not finite"
    elif kind == 2:
        content["state"][key], what = torch.zeros(2, 2, 2, 2), what + "has another shape"
    elif kind == 3:
        del content["state"][key]
        what += "is gone"
    elif kind == 4:
        key = draw.choice(sorted(set(content) - {"state", "datasets", "split"}))
        content[key] = inputs.value_like(content[key], draw)
        what = f"{key} is {content[key]!r:.80}"
    elif kind == 5:
        content["state"][key], what = content["state"][key].to(torch.complex64), what + "is complex"
    elif kind == 6:
        content["datasets"], what = _Code(), "datasets carry code"
    else:
        path.unlink()
        path.write_bytes(pickle.dumps(_Code()))
        what = "the file is a pickle with code"
    if kind != 7:
        path.unlink()
        torch.save(content, path)
    shop.recorded(path)

    def hand_over() -> None:
        from nsf.kinematics.manifold import Manifold

        Manifold.load(path).restrict(torch.arange(5)).position(torch.zeros(4, dtype=torch.float64))

    return Case(what, hand_over, altered=True)


def intermediates(shop: Workshop, draw: random.Random) -> Case:
    """A file that an interrupted training left, damaged, or forged with a sum that fits."""
    from nsf.data import archives

    before, weights = shop.interrupted
    shutil.rmtree(shop.runs, ignore_errors=True)
    shutil.copytree(before, shop.runs)
    path = draw.choice(sorted([*shop.runs.rglob("*.pt"), *shop.runs.rglob("*.ckpt")]))
    forged = draw.random() < 0.4
    if forged:
        content = inputs.mutated_tensors(torch.load(path, weights_only=True), draw)
    else:
        data = inputs.mutated(path.read_bytes(), draw)

    def hand_over() -> None:
        from tiny import tiny_pipeline

        if forged:
            archives.keep(path, content)
        else:
            path.write_bytes(data)
        lines: list[str] = []
        trained = tiny_pipeline(shop.runs, *_BRIEF, say=lines.append).run("train").path / "manifold.pt"
        if not forged:
            assert any(str(path) in line for line in lines), lines
            found = torch.load(trained, weights_only=True)["state"]
            assert all(torch.equal(found[name], value) for name, value in weights.items())

    return Case(f"{path.name} {'forged' if forged else 'damaged'}", hand_over)


def evaluations(shop: Workshop, draw: random.Random) -> Case:
    """A file of an evaluate run that is whole by its hash and cannot be meant, in a report or the index."""
    run = shop.only("evaluate")
    name = draw.choice(("results.csv", "series.csv", "summary.json", "cost.json", "frames.npz"))
    path, what = run.path / name, ""
    data = path.read_bytes()
    if name.endswith("npz") and draw.random() < 0.8:
        shop.rewrite(path, data)
        what = inputs.spoiled_npz(path, draw)
    else:
        if draw.random() < 0.15:
            changed = draw.choice((b"", b"[]", b"null", b"[" * 100_000, b'{"a": NaN}', b"\xff\xfe", b"{}"))
        elif name.endswith("json"):
            tree = inputs.mutated_json(json.loads(data), draw)
            changed = json.dumps(tree).encode("utf-8", "surrogatepass")
        elif name.endswith("csv"):
            changed = inputs.mutated_csv(data.decode(), draw).encode("utf-8", "surrogatepass")
        else:
            changed = inputs.mutated(data, draw)
        shop.rewrite(path, changed)
        what = repr(changed[:1500])
    shop.recorded(path)
    index, charts = draw.random() < 0.2, draw.sample(sorted(CHARTS), draw.choice((0, 0, 0, 1, 2)))

    def hand_over() -> None:
        if index:
            shutil.rmtree(shop.folder / "index", ignore_errors=True)
            shop.command("index", f"folder={shop.folder / 'index'}")()
            return
        question = Question("fuzz", "Fuzz", plots=charts)
        with contextlib.ExitStack() as stack:
            if draw.random() < (0.3 if name.endswith("npz") else 0.9):  # bodies take seconds to draw
                stack.enter_context(mock.patch("nsf.results.pictures.sections", return_value=[]))
            build_report([run], shop.folder / "reports" / "fuzz", question, films=False)

    return Case(f"{'index' if index else 'report'} with {name}: {what}", hand_over)


def observations(shop: Workshop, draw: random.Random) -> Case:
    """A file of observations, malformed."""
    kind = draw.choice(("csv", "csv", "csv.gz", "h5", "npz", "json"))
    lines = ["t,X,Y,Z,x,deviation"] + [f"{0.01 * i},0.5,0.5,0.{i + 1},0.5,0.001" for i in range(6)]
    path = shop.folder / f"observed.{kind}"
    path.unlink(missing_ok=True)
    if kind == "h5":
        columns = np.array([row.split(",") for row in lines[1:]], float).T
        with h5py.File(path, "w") as file:
            for name, values in zip(lines[0].split(","), columns, strict=True):
                file[name] = values
        what = inputs.spoiled_hdf5(path, draw)
        data = path.read_bytes()
        if draw.random() < 0.4:
            data, what = inputs.mutated(data, draw), f"{what}, bytes changed"
    else:
        data = inputs.mutated_csv("\n".join(lines), draw).encode("utf-8", "surrogatepass")
        if kind == "csv.gz":
            data = gzip.compress(data if draw.random() < 0.8 else b"t,x,deviation\n" + b"1,1,1\n" * 2**24)
        if draw.random() < 0.4:
            data = inputs.mutated(data, draw)
        what = repr(data[:600])

    model = shop.model

    def hand_over() -> None:
        from nsf.inverse.observations import Observations

        path.write_bytes(data)
        Observations.read(path, model)

    return Case(f"{kind}: {what}", hand_over)


def manifests(shop: Workshop, draw: random.Random) -> Case:
    """The manifest or the configuration of one run, changed; the others are listed all the same."""
    run = draw.choice(
        [r for stage in ("simulate", "train", "deploy", "evaluate") for r in [shop.only(stage)]]
    )
    shop.fresh()
    if draw.random() < 0.6:
        path = run.path / "manifest.json"
        data = json.dumps(inputs.mutated_json(json.loads(path.read_text()), draw)).encode(
            "utf-8", "surrogatepass"
        )
        if draw.random() < 0.2:
            data = inputs.mutated(data, draw)
    else:
        path = run.path / "config.yaml"
        data = inputs.mutated_text(path.read_text(), draw)
        data = data.encode("utf-8", "surrogatepass") if isinstance(data, str) else data
    words = draw.choice(
        (
            ["runs"],
            ["runs", "stage=deploy"],
            ["runs", "latent_dim=4"],
            ["runs", "sort=delta", "scene=sand"],
            ["runs", "verify"],
            ["index", f"folder={shop.folder / 'index'}"],
            ["runs", "diff", run.hash, run.hash],
            ["runs", "sort=-created", "material.friction_angle=26"],
        )
    )

    def hand_over() -> None:
        shop.rewrite(path, data)
        shop.command(*words)()

    return Case(f"{' '.join(words)} with {run.stage}/{path.name}: {data[:1500]!r}", hand_over)


_PATHS = (
    "/",
    "/field",
    "/stream",
    "/..",
    "//",
    "/%",
    "/%zz",
    "/\u00e9",
    "*",
    "http://a/",
    "http://[::1",
    "/?token=%ff",
)
_HOSTS = (
    "127.0.0.1",
    "localhost",
    "[::1",
    "[::1]",
    "a b",
    "",
    "evil.example",
    "127.0.0.1:99999",
    ":",
    "[",
    "\x01",
    "é",
)


def requests(shop: Workshop, draw: random.Random) -> Case:
    """A malformed request to the server of `nsf serve`: it answers 4xx or closes, and says no traceback."""
    port = shop.server
    method = draw.choice(("GET", "GET", "GET", "POST", "get", "", "CONNECT", "\x00", "G" * 9000))
    query = draw.choice(("", "", "?token=", "?token=a&token=b", "?" + "a=b&" * 500, "?token=\u00e9", "?%00"))
    lines = [
        f"{method} {draw.choice(_PATHS)}{query} HTTP/{draw.choice(('1.1', '1.1', '1.0', '2', '9.9', ''))}"
    ]
    lines += [f"Host: {draw.choice(_HOSTS)}"] * draw.choice((0, 1, 1, 1, 2))
    for _ in range(draw.randrange(3)):
        lines.append(
            draw.choice(
                (
                    "Origin: null",
                    "Origin: http://evil.example",
                    "Upgrade: websocket",
                    "Connection: Upgrade",
                    "Sec-WebSocket-Key: x",
                    "Sec-WebSocket-Version: 99",
                    "X: " + "y" * 9000,
                    "no colon",
                    ": x",
                    "Content-Length: -1",
                    "Transfer-Encoding: chunked",
                    "\x00: \x00",
                    "Host : a",
                )
            )
        )
    data = "\r\n".join([*lines, "", ""]).encode("utf-8", "surrogatepass")
    if draw.random() < 0.3:
        data = inputs.mutated(data, draw)

    def hand_over() -> None:
        heard = io.StringIO()
        handler = logging.StreamHandler(heard)
        root = logging.getLogger()
        root.addHandler(handler)
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=10) as client:
                client.settimeout(1.0)
                answer = b""
                with contextlib.suppress(OSError):
                    client.sendall(data)
                    client.shutdown(socket.SHUT_WR)
                    while part := client.recv(65536):
                        answer += part
        finally:
            root.removeHandler(handler)
        status = answer[9:12]
        assert not answer or status[:1] == b"4", f"answered {answer[:60]!r}"
        assert "Traceback" not in heard.getvalue(), heard.getvalue()
        raise ConfigError(f"answered {answer[:60]!r}")

    return Case(repr(data[:300]), hand_over)


def messages(shop: Workshop, draw: random.Random) -> Case:
    """What a client of the stream may send, malformed."""
    value = draw.choice((1, [1.5], ["nan"], None, [1, 2], {"a": 1}, [True], [2**2000], [-1e308], True))
    text = json.dumps({draw.choice(("values", "values", "playing", "step", "tilt", "color")): value})
    message = draw.choice(
        (text, text[:-1], f"[{text}]", "[" * 100_000, "NaN", '{"values": [NaN]}', '{"values": [1e999]}')
    )
    message = inputs.mutated(message.encode(), draw) if draw.random() < 0.5 else message
    if isinstance(message, bytes) and draw.random() < 0.7:
        message = message.decode("utf-8", "replace")

    def hand_over() -> None:
        from nsf.live.feeds import PointFeed, obey

        ignored = {name: lambda *values: None for name in ("steer", "seek", "tilt")}
        feed = PointFeed.__new__(PointFeed)
        feed._coloring, feed._most = SimpleNamespace(quantities={}), 20.0
        obey(feed, SimpleNamespace(playing=True, **ignored), message)

    return Case(repr(message[:200]), hand_over)


def meshes(shop: Workshop, draw: random.Random) -> Case:
    """A triangle mesh, malformed."""
    corners = [(i >> 2 & 1, i >> 1 & 1, i & 1) for i in range(8)]
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    stretch = [draw.choice((1, 1, 1, 1e-5, 1e5, 0, -1)) for _ in range(3)]
    corners = [tuple(s * c for s, c in zip(stretch, corner, strict=True)) for corner in corners]
    ending = draw.choice(("obj", "ply", "stl"))
    if ending == "obj":
        lines = ["v " + " ".join(map(str, c)) for c in corners] + [
            "f " + " ".join(str(i + 1) for i in f) for f in faces
        ]
        text = draw.choice(
            ("", "mtllib ../../secret.mtl\n", "f 1 2 99999999\n", "v nan inf 1\n", "call x.obj\n")
        )
        data = (text + "\n".join(lines)).encode()
    elif ending == "ply":
        count = draw.choice(("8", "8", "8", "99999999999", "-1"))
        head = f"ply\nformat ascii 1.0\nelement vertex {count}\n" + "".join(
            f"property float {a}\n" for a in "xyz"
        )
        head += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
        rows = [" ".join(map(str, c)) for c in corners] + ["3 " + " ".join(map(str, f)) for f in faces]
        data = (head + "\n".join(rows) + "\n").encode()
    else:
        count = draw.choice((len(faces), len(faces), 2**32 - 1, 0))
        triangles = [[x for i in f for x in corners[i]] for f in faces]
        data = bytes(80) + struct.pack("<I", count)
        data += b"".join(struct.pack("<12fH", 0, 0, 0, *t, 0) for t in triangles)
    if draw.random() < 0.7:
        data = inputs.mutated(data, draw)
    path = shop.folder / f"fuzz.{ending}"

    def hand_over() -> None:
        from nsf.scenes import Mesh

        path.write_bytes(data)
        Mesh(str(path), height=0.2, base=[0.5, 0.5, 0.2]).sample(50)

    return Case(f"{ending}, {len(data)} bytes: {data[:300]!r}", hand_over)


_TOOLS = (
    "view",
    "serve",
    "export",
    "runs",
    "index",
    "reports",
    "bench",
    "search",
    "point",
    "doctor",
    "superresolve",
)


def words(shop: Workshop, draw: random.Random) -> Case:
    """A command line of malformed words."""
    tool = draw.choice((*_TOOLS, *_TOOLS, "run", "simulat", "", "-x", "--version", "help", "report"))
    given = [
        draw.choice(
            (
                "--help",
                "--port=99999",
                "--port=x",
                "--host",
                "--token=",
                "--token= ",
                "--points=0",
                "--points=-5",
                "--rate=nan",
                "nosuchrun",
                "../../x",
                "stage=",
                "=x",
                "sort=",
                "sort=-",
                "folder=",
                "folder=/dev/null",
                "check=maybe",
                "particles=-1",
                "particles=10zz",
                "precision=fp7",
                "scenes=",
                "benches=all",
                "device=tpu",
                "-m",
                "+experiment=nosuch",
                "+experiment=../x",
                "+experiment=",
                "diff",
                "verify",
                "scene=",
                "scene=../sand",
                "hydra/launcher=joblib",
                "latent_dim=4..8",
                "latent_dim=8..4",
                "path=",
                "material=",
                "path=[1]",
                f"{draw.choice(shop.keys)}={draw.choice(inputs.VALUES)}",
                "--bench=0",
                "--bench=x",
                "--html",
                "--frames=x",
            )
        )
        for _ in range(draw.randrange(1, 4))
    ]
    if tool == "bench":  # it measures for minutes where every word is good
        given.append("trials=nonsense")
    if tool in ("view", "serve"):  # it serves until it is interrupted where every word is good
        given.append("nosuchrun")
    if tool in ("run", "superresolve", "report", "search"):
        given.append(f"nosuch.key={draw.choice(inputs.VALUES)}")
    if tool == "doctor":
        given.append("x")
    return Case(f"nsf {tool} {' '.join(given)}", shop.command(tool, *given))


KINDS: dict[str, Callable[[Workshop, random.Random], Case]] = {
    kind.__name__: kind
    for kind in (
        overrides,
        targets,
        scenes,
        experiments,
        damaged,
        hdf5,
        checkpoints,
        intermediates,
        evaluations,
        observations,
        manifests,
        requests,
        messages,
        meshes,
        words,
    )
}
