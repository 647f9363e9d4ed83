"""A model that runs in a page: what a file of it holds, and what cannot be put into one."""

import itertools
import zlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from nsf.data import Case
from nsf.data.trajectory import Trajectory
from nsf.deployment import Rollout, rollout_file
from nsf.errors import ConfigError
from nsf.evaluation.metrics import von_mises
from nsf.live import page
from nsf.live.model import LiveModel
from nsf.live.surface import surface
from nsf.live.wire import check_field, modal_field, shown
from nsf.models import Model, Recurrence
from nsf.pipeline import Pipeline
from nsf.recurrence import Form, RecurrenceEngine, first_change
from nsf.results.formats import file_name
from nsf.runs import Run
from nsf.scenes import Scene
from nsf.scenes.tilts import largest_tilt
from nsf.storage import write_text, writing
from nsf.vectors import spaced

#: Points of a page, by default; a telephone decodes so many in each frame.
POINTS = 20_000
SHIPPED_POINTS = 3500  # of a page of the package
#: Largest page [bytes], which still goes by mail.
LARGEST = 16_000_000
_SAME = 1e-9
_LEAST_TILT = 0.05  # [rad] that the page offers where programs tilt gravity


def write(run: Run, folder: Path, points: int | None = None, device: str = "auto") -> Path:
    """Write the page of a deployment by a recurrence.

    Args:
        run: complete deploy run.
        folder: of the page.
        points: how many are shown at most; `POINTS` by default.
        device: where the model is read on: `cpu`, `cuda`, `cuda:N` or `auto`.

    Raises:
        ConfigError: see `model_data`; the page would be too large to be mailed.
    """
    _check_model(run, Pipeline.of_run(run, device).model)  # a model takes long to build
    title, data = model_data(LiveModel(run, points or POINTS, device, surface=True))
    text = page.html(title, data)
    if (size := len(text.encode())) > LARGEST:
        raise ConfigError(
            f"the page would have {size / 1e6:.1f} MB, at most {LARGEST / 1e6:.0f}; give fewer --points"
        )
    return write_text(folder / f"{run.scene}-live.html", text)


@dataclass(frozen=True)
class Sizes:
    """How much of a model goes into a page.

    Attributes:
        modes: of the deformation at most; None for all.
        stress: bytes of the modes of stress at most; they are for colour.
        runs: full-order runs at most; points, frames: of each.
    """

    modes: int | None = None
    stress: int = 4_000_000
    runs: int = 3
    points: int = 4000
    frames: int = 50


def model_data(model: LiveModel, sizes: Sizes = Sizes()) -> tuple[str, bytes]:
    """Title and data of a page.

    Args:
        model: of the deployment.
        sizes: of what goes into it.

    Raises:
        ConfigError: its steps are taken by no recurrence, its field has no modes, or a parameter changes the
            forcing or the start.
    """
    check_field(model)
    pipeline = model.pipeline
    _check_model(model.run, pipeline.model)
    recurrence = pipeline.recurrence()
    taught, stress = recurrence.taught, recurrence.form.sizes.stress
    header, order = shown(model), {p.name: i for i, p in enumerate(model.parameters)}
    header["parameters"] = [header["parameters"][order[name]] for name in taught.parameters]
    arrays = {"rest": model.X} | surface(model.X, model.spacing, model.training_frames[0])
    header["fields"] = _fields(model, arrays, header, sizes, stress)
    arrays |= recurrence_arrays(recurrence.form)
    batch = pipeline.batch_at(model.manifold, [model.initial], precision="fp64")
    header |= {
        "file": file_name(f"{model.run.scene}-{model.run.hash}"),
        "latents": model.manifold.latent_dim,
        "dt": taught.dt,
        "steps": batch.total_steps,
        "recurrence": recurrence_header(recurrence.form),
        "start": _start(model, recurrence.form.stride),
        "gravity": _tilt(model, recurrence),
        "trust": model.trust.plain,
        "recordings": {},
    }  # fmt: skip
    header["first"] = _surest(model)
    header["cases"] = _cases(model, taught.parameters, arrays, header, sizes)
    return model.title, page.packed(header, arrays)


#: How much goes into a page of the package.
SHIPPED = Sizes(modes=24, stress=200_000, runs=1, points=3000, frames=30)


def ship(run: Run, path: Path) -> None:
    """Write the data of a page alone, as `nsf demo` reads them.

    Args:
        run: complete deploy run by a recurrence.
        path: of the file.
    """
    _, data = model_data(LiveModel(run, SHIPPED_POINTS, "cpu", surface=True), SHIPPED)
    with writing(path) as partial:
        partial.write_bytes(zlib.compress(data, 9))


def _check_model(run: Run, model: Model) -> None:
    if not isinstance(model, Recurrence):
        raise ConfigError(
            f"{run.id} has model={model.name}, whose steps a page does not take; deploy it with "
            "model=recurrence, which is taught first"
        )


def recurrence_header(form: Form) -> dict:
    """The sizes of a recurrence, as `Recurrence` in `recurrence.mjs` reads them."""
    sizes = form.sizes
    return {
        "latents": sizes.latents, "stress": sizes.stress, "gravity": sizes.gravity, "stride": form.stride,
        "members": sizes.members, "layers": 3,
    }  # fmt: skip


def recurrence_arrays(form: Form) -> dict[str, np.ndarray]:
    """Weights [out, in] and biases [out] of each member's networks, which take states of colliders."""
    arrays, at = {}, form.sizes.latents + form.sizes.parameters
    for name, layers in form.in_raw_units().items():
        (W, b), *rest = layers
        before, of_c, after = W.split([at, form.sizes.states, W.shape[1] - at - form.sizes.states], 1)
        of_states = form.c_matrix @ of_c
        first = torch.cat([before, of_states, after], 1), b - form.c_mean @ of_states
        for k, (weight, bias) in enumerate([first, *rest]):
            for member in range(form.sizes.members):
                arrays[f"{name}{member}.weight{k}"] = weight[member].T.contiguous().float().numpy()
                arrays[f"{name}{member}.bias{k}"] = bias[member].contiguous().float().numpy()
    return arrays


def _fields(model: LiveModel, arrays: dict, header: dict, sizes: Sizes, stress: int) -> dict:
    """Put the fields of x and, where τ follows from one or from ŝ, of τ into a page."""
    descriptions = {}
    kinds: dict[str, tuple[type, int | None]] = {"deformation": (np.int16, sizes.modes)}
    if model.pipeline.sources.neural_stress or stress:
        kinds["stress"] = np.int8, max(stress, 1, sizes.stress // (6 * len(model.X)))
        stress_scale = {"title": "von Mises stress", "unit": "Pa", "top": model.tops["von_mises"]}
        header["quantities"] = {"von_mises": stress_scale} | header["quantities"]
    for phase, how in kinds.items():
        field = model.at.fields[phase]
        if phase == "stress" and stress:  # its coordinates are in the state, so that no network gives them
            field = replace(field, network=None)
        description, values = modal_field(field, *how)
        descriptions[phase] = description | {"parameters": model.manifold.takes_parameters(phase)}
        arrays |= {f"{phase}.{name}": a for name, a in values.items()}
    return descriptions


def _corners(model: LiveModel) -> list[Case]:
    """The first case, and those at the corners of the box of training with the same program."""
    first = model.initial
    corners = itertools.islice(itertools.product(*(p.trained for p in model.parameters)), 16)
    names = [p.name for p in model.parameters]
    return [
        first,
        *(
            model.pipeline.scene.case(dict(first) | dict(zip(names, values, strict=True)))
            for values in corners
        ),
    ]


def _start(model: LiveModel, stride: int) -> dict:
    """x̂ and what stands for d at t = 0, which no parameter may change."""
    batch = model.pipeline.batch_at(model.manifold, _corners(model), precision="fp64")
    setups = batch.batch.setups
    changes = np.stack(
        [
            first_change(model.manifold, s.constants.X, s.initial_velocity, stride * s.dt).numpy()
            for s in setups
        ]
    )
    latents = np.stack([setup.xhat.double().cpu().numpy() for setup in setups])
    for name, rows in (("velocity", changes), ("shape", latents)):
        if np.abs(rows - rows[0]).max() > _SAME * max(1.0, np.abs(rows).max()):
            raise ConfigError(f"a parameter changes the initial {name}, which a page keeps; use nsf view")
    return {"xhat": latents[0].tolist(), "change": changes[0].tolist()}


def _tilt(model: LiveModel, recurrence: RecurrenceEngine) -> dict | None:
    """Gravity of the scene, and the largest tilt that was taught [rad]; None where it has no programs.

    Recurrences of other scenes take gravity as well, but no shape that their manifold knows leans to a side.
    """
    scene, taught = model.pipeline.deployed, recurrence.taught
    down = np.array(scene.gravity)
    if not recurrence.form.sizes.gravity or not np.any(down) or not scene.forcing.gravity:
        return None
    angle = largest_tilt(down, np.array(taught.gravity), taught.reach)
    return {"down": down.tolist(), "angle": max(angle, _LEAST_TILT)}


def _cases(model: LiveModel, names, arrays: dict, header: dict, sizes: Sizes) -> list[dict]:
    """The held-out cases: their parameters, forcing, and the full-order runs of some."""
    pipeline, entries, movable, first = model.pipeline, [], _movable(model), header["first"]
    stored = [case for case in (pipeline.held_out[first], *pipeline.held_out) if case in model.simulated]
    stored = list(dict.fromkeys(stored))[: sizes.runs]
    for index, case in enumerate(pipeline.held_out):
        scene = pipeline.deployed.at(case)
        entry = {
            "label": str(case).replace("_", " "),
            "values": [case[name] for name in names],
            "gravity": _gravity(scene),
            "solids": [solid | {"movable": movable.get(solid["name"])} for solid in model.solids(case)],
            "recording": None,
        }  # fmt: skip
        if case in stored:
            entry["recording"] = f"full{index}"
            recording, planes = _recorded(model, case, header["quantities"], sizes, arrays.get("corners"))
            header["recordings"][entry["recording"]] = recording
            arrays |= {f"{entry['recording']}.{name}": a for name, a in planes.items()}
        entries.append(entry)
    _check_forcing(model)
    return entries


def _surest(model: LiveModel) -> int:
    """The number of the held-out case of the least error bound, with which a page begins."""
    files = (model.run.file(rollout_file(index)) for index in range(len(model.pipeline.held_out)))
    verdicts = [Rollout.open(file).verdict for file in files]
    bounds = [np.inf if verdict.beyond else verdict.bound_share for verdict in verdicts]
    return int(np.argmin(np.nan_to_num(bounds, nan=np.inf)))


def _movable(model: LiveModel) -> dict[str, dict]:
    """Direction, reach [m] and speed [m/s] of the solids that programs move, as training runs have them."""
    movable = {}
    scenes = [model.pipeline.scene.at(case) for case in model.pipeline.split.train]
    for name in model.pipeline.scene.forcing.colliders:
        index = list(model.pipeline.scene.colliders).index(name)
        motions = [scene.solids[index].motion.keyframes() for scene in scenes]
        shifts = np.concatenate([shift for _, shift, _ in motions])
        axis = np.linalg.svd(np.concatenate([s - s[:1] for _, s, _ in motions]), full_matrices=False)[2][0]
        axis *= np.sign(axis[np.abs(axis).argmax()])
        speed = max(np.abs(np.diff(s @ axis) / np.diff(t)).max() for t, s, _ in motions)
        places = shifts @ axis
        movable[name] = {
            "axis": axis.tolist(), "low": float(places.min()), "high": float(places.max()),
            "speed": float(speed),
        }  # fmt: skip
    return movable


def _gravity(scene: Scene) -> dict:
    """Keyframes of gravity."""
    acting = scene.acting_gravity
    return {"times": list(acting.times), "values": [list(value) for value in acting.values]}


def _check_forcing(model: LiveModel) -> None:
    """Refuse a parameter that changes what a page takes from the case alone.

    Raises:
        ConfigError: it changes gravity or a solid.
    """
    deployed, first = model.pipeline.deployed, None
    for case in _corners(model):
        forcing = _gravity(deployed.at(case)), model.solids(case)
        first = first or forcing
        if forcing != first:
            raise ConfigError("a parameter changes gravity or a solid, which a page keeps; use nsf view")


def _recorded(
    model: LiveModel, case: Case, quantities: dict, sizes: Sizes, corners: np.ndarray | None
) -> tuple[dict, dict[str, np.ndarray]]:
    """The full-order run of a case at some of the points: at the corners of a surface if they are few."""
    most = min(sizes.points, len(model.shown))
    chosen = np.sort(np.random.default_rng(1).permutation(len(model.shown))[:most])
    chosen = corners if corners is not None and len(corners) <= sizes.points else chosen
    particles = model.shown[chosen]
    with Trajectory.of(model.truth_run(case)) as trajectory:
        frames = spaced(trajectory.frames, sizes.frames + 1)
        x = trajectory.read("x", frames=frames.tolist(), particles=particles)
        tau = trajectory.read("tau", frames=frames.tolist(), particles=particles)
        t = trajectory.t[frames]
    top = quantities.get("von_mises", {"top": 1.0})["top"]
    stress = von_mises(torch.as_tensor(tau)).numpy() / top
    return page.recording(np.concatenate([model.X[None, chosen], x]).astype(np.float32), stress, t)
