"""Chains of the tiny scenes, whose networks hold the values of `inputs/`, and what the goldens compare.

Training and teaching end in other bits on another machine. So a chain trains for a step, and its networks are
then given numbers that are kept here, of half the precision where there are many: from there on all is
arithmetic in double precision.
"""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from configurations import BUILT, EVERY, EXPERIMENTS, MODELS, NETWORKS, PAPER, SCENES, TAUGHT

from nsf import config
from nsf.data import Trajectory
from nsf.deployment import Rollout, rollout_file
from nsf.export.playback import Playback
from nsf.kinematics.manifold import Manifold
from nsf.live import publish
from nsf.live.model import LiveModel
from nsf.pipeline import Pipeline
from nsf.recurrence import taught
from nsf.runs import Record, Run

HERE = Path(__file__).parent
WHOLE = HERE.parent / "unit" / "web" / "whole.mjs"
#: Buffers of a manifold that follow from the trajectories alone.
_OF_DATA = ("X", "training_parameters", "training_times")
_MANY = 100  # entries of a tensor, above which half precision is kept
#: Columns of the results that are compared, by the name that a golden has for them.
COLUMNS = {
    "case": "parameter",
    "delta": "delta",
    "displacement error": "displacement_error",
    "stress error": "stress_error",
    "at rest": "displacement_static",
    "nearest run": "displacement_nearest",
    "interpolated": "displacement_interpolated",
    "coarse": "displacement_coarse",
    "height error": "height_error",
    "run-out error": "run_out_error",
    "sample": "sample",
    "gamma": "gamma",
    "handed over": "fallback_share",
    "true error": "distance_max",
}


class Chains:
    """The chains of one folder of runs, each stage made once.

    Args:
        root: of the runs.
        trained, taught: further keys of chains whose networks keep what training leaves; None: they get the
            values of `inputs/`.
    """

    def __init__(self, root: Path, trained: tuple[str, ...] | None = None, taught: tuple[str, ...] = ()):
        self.root, self._trained, self._taught = root, trained, taught
        self._given: set[str] = set()

    def __call__(self, scene: str, model: str, *further: str) -> Pipeline:
        """The chain of a scene and a model, up to what its runs read."""
        keys = [f"scene={scene}", *EVERY, *SCENES[scene], *MODELS[model], *further]
        if self._trained is not None:
            keys += [*self._trained, *(self._taught if "recurrence" in model else ())]
        pipeline = Pipeline(config.load(keys), say=lambda line: None, root=self.root)
        pipeline.run("simulate")
        pipeline.run("train")
        self._give(pipeline.training, "manifold.pt", input_of(scene, model, "train"))
        if pipeline.is_taught:
            pipeline.run("teach")
            self._give(pipeline.taught, "recurrence.pt", input_of(scene, model, "teach"))
        return pipeline

    def deployed(self, scene: str, model: str, *further: str) -> Pipeline:
        """The same with its reduced runs."""
        pipeline = self(scene, model, *further)
        pipeline.run("deploy")
        return pipeline

    def _give(self, run: Run, name: str, source: Path) -> None:
        """Give the networks of a run the values of a file, once."""
        if self._trained is not None or run.id in self._given:
            return
        self._given.add(run.id)
        if name == "manifold.pt":
            manifold = Manifold.load(run.path / name)
            _fill(manifold, source)
            manifold.save(run.path / name)
        else:
            form, by = taught.load(run.path / name)
            _fill(form, source)
            taught.save(form, by, run.path / name)
        record = Record(run.path, run.manifest)
        for output in run.manifest["outputs"]:
            record.output(output["path"])
        manifest = run.manifest | {"outputs": list(record.outputs.values())}
        (run.path / "manifest.json").write_text(json.dumps(manifest))


def input_of(scene: str, model: str, stage: str) -> Path:
    """The file of values of what a stage leaves."""
    kind = "recurrence" if stage == "teach" else "networks" if model == "networks" else "modes"
    return HERE / "inputs" / f"{scene}_{kind}.npz"


def write_inputs(chains: Chains) -> None:
    """Write the values of networks that `inputs/` has none of."""
    trained = [(scene, "history") for scene in SCENES] + [(scene, "networks") for scene in NETWORKS]
    for scene, model in trained:
        if not (path := input_of(scene, model, "train")).exists():
            _write(Manifold.load(chains(scene, model).training.path / "manifold.pt"), path)
    for scene, model in TAUGHT:
        if not (path := input_of(scene, model, "teach")).exists():
            form, _ = taught.load(chains(scene, model).taught.path / "recurrence.pt")
            _write(form, path)


def _write(module: torch.nn.Module, path: Path) -> None:
    state = {name: values.numpy() for name, values in module.state_dict().items() if name not in _OF_DATA}
    path.parent.mkdir(exist_ok=True)
    short = {name: a.astype(np.float16 if a.size > _MANY else a.dtype) for name, a in state.items()}
    np.savez_compressed(path, **short)


def _fill(module: torch.nn.Module, source: Path) -> None:
    """Put the values of a file into a module, each under its name there."""
    with np.load(source) as kept:
        state = {name: torch.from_numpy(kept[name]) for name in kept.files}
    own = module.state_dict()
    state = {name: values.to(own[name].dtype) for name, values in state.items()}
    module.load_state_dict({name: own[name] for name in _OF_DATA if name in own} | state)


# -- what is compared ---------------------------------------------------------------------------------------


def latents(chains: Chains, scene: str) -> dict:
    """x̂ of a held-out case [step, r] by each model, and where the full order takes some particles [m]."""
    models = [model for model in MODELS if (scene, model) in TAUGHT or _everywhere(scene, model)]
    found = {}
    for model in models:
        if model in BUILT:
            pipeline = chains(scene, model)
            solver = pipeline.solver_at(pipeline.manifold(), pipeline.held_out[0], engine=BUILT[model])
            solver.together.step(solver.together.total_steps)
            found[model] = solver.trajectory().xhat
        else:
            pipeline = chains.deployed(scene, model)
            found[model] = Rollout.open(pipeline.deployment.path / rollout_file(0)).xhat
    truth = pipeline.simulation(pipeline.held_out[0])
    with Trajectory.open(truth.path / "trajectory.h5") as trajectory:
        x = trajectory.read("x", frames=[trajectory.frames - 1])[0]
    return {"full order": x[:: len(x) // 10]} | found


def _everywhere(scene: str, model: str) -> bool:
    if model == "networks":
        return scene in NETWORKS
    return "recurrence" not in model


def results(chains: Chains, experiment: str) -> list[dict]:
    """The rows of an experiment: what each run is, errors and rivals, no times."""
    rows = []
    for scene, model, further in EXPERIMENTS[experiment]:
        pipeline = chains.deployed(scene, model, *further)
        pipeline.run("evaluate")
        table = pd.read_csv(pipeline.evaluation.path / "results.csv")
        cases = table["value"].astype(object).where(table["value"].notna(), table["case"])
        table = table.assign(parameter=cases, gamma=3.0 * table["particles"] / table["r"])
        for _, row in table.iterrows():
            values = {name: row[column] for name, column in COLUMNS.items()}
            rows.append({"scene": scene, "model": model, "keys": " ".join(further)} | values)
    return rows


def frames(chains: Chains, points: int | None) -> np.ndarray:
    """x [frame, point, 3] of some points that an export of sand decodes [m]."""
    pipeline = chains.deployed("sand", "projected, compiled")
    played = Playback(pipeline.deployment, points=points, every=5, device="cpu")
    x = torch.cat([block.x for block in played.blocks()], 1).numpy()
    return x[:, :: x.shape[1] // 8]


def page(chains: Chains, scene: str, folder: Path) -> dict:
    """The numbers that a page of a scene is given, and with node what its script makes of them."""
    model = next(model for own, model in TAUGHT if own == scene)
    run = chains.deployed(scene, model).deployment
    path = publish.write(run, folder, device="cpu")
    header, arrays = data_of(LiveModel(run, 60, "cpu", surface=True))
    for name in ("corners", "faces"):  # numbers of points, whose norm says nothing
        arrays.pop(name, None)
    given = {
        "dt": header["dt"], "steps": header["steps"], "start": header["start"]["xhat"],
        "change": header["start"]["change"],
        "norms": {name: float(np.linalg.norm(a.astype(float))) for name, a in sorted(arrays.items())},
    }  # fmt: skip
    return {"given": given} | ({"steps": stepped(path)} if shutil.which("node") else {})


def data_of(model: LiveModel) -> tuple[dict, dict[str, np.ndarray]]:
    """Header and arrays of a page."""
    from packing import unpacked

    return unpacked(publish.model_data(model)[1])


def stepped(path: Path) -> list[dict]:
    """x̂ and positions at the end of every held-out case, as a page's script takes them."""
    done = subprocess.run(["node", WHOLE, path], capture_output=True, text=True, timeout=120, check=True)
    return [{"xhat": own["xhat"], "x": own["x"][:30]} for own in json.loads(done.stdout)["found"]]


def trained(chains: Chains, scene: str) -> dict:
    """What training alone leaves of some particles at the end of the last training run."""
    pipeline = chains(scene, "history")
    manifold = Manifold.load(pipeline.training.path / "manifold.pt")
    at = manifold.restrict(torch.arange(0, len(manifold.X), len(manifold.X) // 3))
    xhat, mu = manifold.training_latents[-1], manifold.training_parameters[-1]
    rate = torch.zeros_like(xhat)
    fields = {"x": at.position(xhat), "tau": at.stress(xhat, mu), "C": at.affine(xhat, mu, rate).flatten(1)}
    return {name: [[float(f"{v:.7g}") for v in row] for row in a.tolist()] for name, a in fields.items()}


# -- files --------------------------------------------------------------------------------------------------


def read(name: str) -> dict:
    """The values of a golden."""
    return json.loads((HERE / "values" / f"{name}.json").read_text())


def write(name: str, values: dict) -> None:
    """Write a golden, a row of numbers a line."""
    text = json.dumps(values, indent=1, default=_plain)
    text = re.sub(r"\[\s+([^\[\]{}]+?)\s+\]", lambda row: "[" + re.sub(r"\s+", " ", row[1]) + "]", text)
    path = HERE / "values" / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(text + "\n")


def _plain(value):
    return value.tolist() if isinstance(value, np.ndarray | np.generic) else str(value)


def close(found, wanted, tolerance: float, where: str = "") -> None:
    """Compare nested values: numbers to a tolerance relative to the largest of an array, all else exactly."""
    if isinstance(wanted, dict):
        assert sorted(found) == sorted(wanted), where
        for name, value in wanted.items():
            close(found[name], value, tolerance, f"{where} {name}")
    elif isinstance(wanted, list) and wanted and isinstance(wanted[0], dict):
        assert len(found) == len(wanted), where
        for index, (one, other) in enumerate(zip(found, wanted, strict=True)):
            close(one, other, tolerance, f"{where} {index}")
    elif isinstance(wanted, str) or wanted is None:
        assert str(found) == str(wanted), where
    else:
        wanted = np.asarray(wanted, dtype=float)
        assert np.shape(found) == wanted.shape, where
        finite = wanted[np.isfinite(wanted)]
        scale = np.abs(finite).max() if finite.size else 0.0
        np.testing.assert_allclose(
            np.asarray(found, dtype=float), wanted, rtol=0, atol=tolerance * scale, err_msg=where
        )


assert set(PAPER) <= set(SCENES)
