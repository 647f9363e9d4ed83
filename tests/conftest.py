"""What tests of several layers share: one tiny chain, simulated, trained, deployed and evaluated once."""

import gc
import json
import os
import pickle
import shutil
import signal
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

# Before torch: on matrices this small, threads cost more than they give, and tests run beside each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")

import browsers
import torch
from filelock import FileLock
from tiny import TAUGHT, TINY, tiny_pipeline

# A shell that runs the tests in the background has SIGINT ignored, and so would every program they start.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_runtest_setup(item):
    """A test marked `gpu` says what it lacks here."""
    import warp as wp

    if item.get_closest_marker("gpu"):
        found = {"torch": torch.cuda.device_count(), "Warp": wp.get_cuda_device_count()}
        if not min(found.values()):
            told = " and ".join(f"{library} sees {count}" for library, count in found.items())
            pytest.skip(f"needs a GPU; {told}")


def pytest_collection_finish(session):
    """Collections of garbage pass over what stays to the end, a million objects, and are rarer."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)


@pytest.fixture(scope="session", autouse=True)
def one_thread_for_torch():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="session", autouse=True)
def no_width():
    """Workers side by side have a width of 80, which tables would be cut to."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("COLUMNS", raising=False)
        yield


@pytest.fixture(scope="session", autouse=True)
def garbage_stays():
    """Costs are measured after collections of garbage, which only the memory of a GPU needs."""
    from nsf.evaluation import cost

    with pytest.MonkeyPatch.context() as patch:
        if not torch.cuda.is_available():
            patch.setattr(cost, "gc", SimpleNamespace(collect=lambda: 0))
        yield


@pytest.fixture(scope="session", autouse=True)
def unflushed_files():
    """Files of tests need not survive the machine: waiting for the disk takes a fifth of a chain's time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("nsf.storage._flush", lambda path: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def files_parsed_once():
    """Hydra parses its yamls and those of `conf/` anew for each choice of options, a third of that time."""
    from hydra._internal.sources_registry import SourcesRegistry
    from hydra.core.plugins import Plugins

    Plugins.instance()  # which registers the sources
    parsed = {}

    def once(plain):
        def load(source, config_path):
            path = Path(source.path, source._normalize_file_name(config_path))
            stamp = (path.stat().st_mtime_ns, path.stat().st_size) if path.is_file() else None
            key = path, stamp, source.provider
            if key not in parsed:
                parsed[key] = pickle.dumps(plain(source, config_path))
            return pickle.loads(parsed[key])

        return load

    with pytest.MonkeyPatch.context() as patch:
        for scheme in ("file", "pkg"):
            kind = SourcesRegistry.instance().resolve(scheme)
            patch.setattr(kind, "load_config", once(kind.load_config))
        yield


@pytest.fixture(scope="session", autouse=True)
def coarse_pictures():
    """A quarter of the pixels an inch, and one sample a pixel: a picture takes a sixth of the time."""
    from nsf.bodies import camera
    from nsf.bodies import pictures as of_bodies
    from nsf.results import style

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(style, "PIXELS", style.PIXELS // 4)
        patch.setattr(of_bodies, "WIDE", of_bodies.WIDE // 4)
        patch.setattr(camera, "_OVERSAMPLE", 1)
        yield


@dataclass(frozen=True)
class Chain:
    """A chain whose stages up to `evaluate` are on disk.

    Attributes:
        root: of the runs; shared, so a test that spoils a file takes a copy.
        said: what the pipeline told the user.
        pipeline: as it was configured.
    """

    root: Path
    said: list[str]
    pipeline: object

    @property
    def scene(self):
        return self.pipeline.scene

    @property
    def checkpoint(self) -> Path:
        return self.pipeline.training.path / "manifold.pt"

    def trajectory(self, value: float) -> Path:
        return self.pipeline.simulation(self.scene.case(value)).path / "trajectory.h5"


@pytest.fixture(params=["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def device(request) -> str:
    """The name of a device: of the CPU, and in tests marked `gpu` of a GPU."""
    return request.param


@pytest.fixture(scope="session")
def tiny():
    """The overrides of the tiny chain."""
    return TINY


@pytest.fixture(scope="session")
def pipeline_at():
    """(root, *overrides, say) → a `Pipeline` of the tiny chain."""
    return tiny_pipeline


@pytest.fixture(scope="session")
def stored(tmp_path_factory):
    """(name, make) → a folder that `make(folder)` fills once, whichever worker is the first to ask for it."""
    base = tmp_path_factory.getbasetemp()
    base = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base

    def of(name, make) -> Path:
        folder = base / f"stored-{name}"
        with FileLock(f"{folder}.lock"):
            if not (folder / "made").exists():
                folder.mkdir(exist_ok=True)
                make(folder)
                (folder / "made").touch()
        return folder

    return of


@pytest.fixture(scope="session")
def chain(stored) -> Chain:
    """The tiny chain, made once."""

    def make(folder):
        said: list[str] = []
        pipeline = tiny_pipeline(folder / "runs", say=said.append)
        for stage in ("simulate", "train", "deploy", "evaluate"):
            pipeline.run(stage)
        (folder / "said.json").write_text(json.dumps(said))

    folder = stored("chain", make)
    said = json.loads((folder / "said.json").read_text())
    return Chain(folder / "runs", said, tiny_pipeline(folder / "runs"))


@pytest.fixture(scope="session")
def taught_root(chain, stored) -> Path:
    """Runs of the tiny chain up to a recurrence; shared, so a test that adds to them takes a copy."""

    def make(folder):
        for stage in ("simulate", "train"):
            shutil.copytree(chain.root / stage, folder / "runs" / stage)
        tiny_pipeline(folder / "runs", *TAUGHT).run("teach")

    return stored("taught", make) / "runs"


@pytest.fixture(scope="session")
def tiny_trust(chain, tiny_manifold):
    """What bounds the errors of the tiny chain's reduced runs: without validation runs, nothing."""
    from nsf.deployment import Trust

    return Trust.of(tiny_manifold, 0.2)


@pytest.fixture(scope="session")
def tiny_manifold(chain):
    """The tiny chain's manifold, as a user loads it."""
    import nsf

    return nsf.Manifold.load(chain.checkpoint)


@pytest.fixture(scope="session")
def tiny_scene():
    """The scene of the tiny chain, for tests that read nothing that its stages left."""
    import nsf.scenes

    return nsf.load_scene("sand", TINY[1:])


@pytest.fixture(scope="session")
def reference_manifold():
    """The tiny chain's manifold as it is committed: a GPU machine need not simulate and train for it."""
    from gpu_references import manifold

    return manifold()


@pytest.fixture(scope="session")
def seal():
    """(run, *more) → its manifest records its files, and `more`, as they now stand, as if they always had."""
    from nsf.runs import Record

    def rewrite(run, *more):
        record = Record(run.path, run.manifest)
        for name in [*(output["path"] for output in run.manifest["outputs"]), *more]:
            record.output(name)
        manifest = run.manifest | {"outputs": list(record.outputs.values())}
        (run.path / "manifest.json").write_text(json.dumps(manifest))

    return rewrite


@pytest.fixture(scope="session")
def chromium():
    """The path of Chromium, where playwright can drive it."""
    pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None:
        pytest.skip("no Chromium is installed; apt install chromium")
    return path


@pytest.fixture(scope="module")
def launched(chromium):
    """A browser of the tests of a module: it takes a second to start, and another to end."""
    with browsers.launched(chromium) as browser:
        yield browser


@pytest.fixture
def browser(launched):
    """A browser without tabs, and none is left after a test."""
    yield launched
    for context in launched.contexts:
        context.close()
