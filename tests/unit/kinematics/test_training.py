"""Schedules, resumption to the bit, and what training refuses."""

import signal
import time

import pytest
import torch

from nsf.data import archives
from nsf.errors import ConfigError, InstabilityError, SchemaError
from nsf.kinematics.fields.basis import BasisField
from nsf.kinematics.fields.mlp import MlpField
from nsf.kinematics.training import lightning
from nsf.kinematics.training import train as training
from nsf.kinematics.training.phases import PHASES, Fit, per_phase, seeded
from nsf.kinematics.training.schedules import FastTrainer, PaperTrainer

LATENT = 2
FIELDS = ["basis", "mlp"]
SHORT = FastTrainer(steps=[20, 12, 12], frames_per_batch=4, particles_per_batch=16)


@pytest.fixture(scope="module", autouse=True)
def short_blocks():
    """Five steps a block, so that a short training has several."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(lightning, "SHORTEST_BLOCK", 5)
        yield


@pytest.fixture(scope="module")
def train(snapshots, fields):
    def run(field, folder, schedule=SHORT, seed=0, say=print):
        fit = fields[field]
        return training.train(snapshots, fit, schedule, LATENT, seed, folder, "cpu", say=say)

    return run


@pytest.fixture(scope="module")
def whole(train, tmp_path_factory):
    """The manifold and metrics of each field, trained without an interrupt."""
    return {field: train(field, tmp_path_factory.mktemp(field)) for field in FIELDS}


def same(one, other):
    return all(
        torch.equal(a, b) for a, b in zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    )


def interrupt_at(monkeypatch, phase, step):
    """Raise once, before that step; returns what restores the code."""
    true_step = lightning.FieldTraining._step

    def interrupted(self, at):
        if (self.phase.name, at) == (phase, step):
            raise KeyboardInterrupt
        return true_step(self, at)

    monkeypatch.setattr(lightning.FieldTraining, "_step", interrupted)
    return lambda: monkeypatch.setattr(lightning.FieldTraining, "_step", true_step)


@pytest.mark.parametrize(
    ("field", "phase", "step"),
    [("basis", "deformation", 12), ("basis", "affine", 0), ("mlp", "deformation", 12), ("mlp", "stress", 7)],
)
def test_resumed_training_has_the_same_bits(monkeypatch, train, whole, tmp_path, field, phase, step):
    expected, metrics = whole[field]
    restore = interrupt_at(monkeypatch, phase, step)
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        train(field, tmp_path / "parts")
    assert signal.getsignal(signal.SIGINT) is before
    restore()
    taken = []
    true_step = lightning.FieldTraining._step
    monkeypatch.setattr(
        lightning.FieldTraining,
        "_step",
        lambda self, at: taken.append((self.phase.name, at)) or true_step(self, at),
    )
    resumed, resumed_metrics = train(field, tmp_path / "parts")
    assert same(resumed, expected)
    assert taken[0] == (phase, step // 5 * 5)
    assert all(resumed_metrics[f"{p}_loss"] == metrics[f"{p}_loss"] for p in PHASES)
    total = resumed_metrics["training_seconds"]
    taken.clear()
    again, again_metrics = train(field, tmp_path / "parts")
    assert same(again, expected)
    assert not taken
    assert again_metrics["training_seconds"] == total  # what was done before counts, what is read does not


def flipped(data: bytes) -> bytes:
    """One bit of the middle changed."""
    at = len(data) // 2
    return data[:at] + bytes([data[at] ^ 4]) + data[at + 1 :]


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *((name, flipped) for name in ("prepared.pt", "built.pt", "deformation.pt", "stress/last.ckpt")),
        ("stress/last.ckpt", cut),
    ],
)
def test_a_damaged_file_of_an_interrupted_training_is_dropped(
    monkeypatch, train, whole, tmp_path, name, damage
):
    restore = interrupt_at(monkeypatch, "stress", 7)
    with pytest.raises(KeyboardInterrupt):
        train("basis", tmp_path)
    restore()
    path = tmp_path / name
    path.write_bytes(damage(path.read_bytes()))
    lines = []
    resumed, _ = train("basis", tmp_path, say=lines.append)
    assert same(resumed, whole["basis"][0])
    assert len(lines) == 1
    assert str(path) in lines[0]


def test_a_file_of_an_interrupted_training_that_is_forged_is_refused(monkeypatch, train, tmp_path):
    restore = interrupt_at(monkeypatch, "stress", 7)
    with pytest.raises(KeyboardInterrupt):
        train("basis", tmp_path)
    restore()
    archives.keep(tmp_path / "deformation.pt", {"state": {"x": torch.zeros(3)}})
    with pytest.raises(SchemaError, match="delete the folder"):
        train("basis", tmp_path)


def test_seconds_before_an_interrupt_count(monkeypatch, train, tmp_path):
    restore = interrupt_at(monkeypatch, "deformation", 12)
    true_take = lightning.FieldTraining.take
    monkeypatch.setattr(
        lightning.FieldTraining, "take", lambda self, *span: time.sleep(0.2) or true_take(self, *span)
    )
    with pytest.raises(KeyboardInterrupt):
        train("basis", tmp_path)
    restore()
    monkeypatch.setattr(lightning.FieldTraining, "take", true_take)
    _, metrics = train("basis", tmp_path)
    assert metrics["deformation_seconds"] > 0.4  # two whole blocks of five steps came before


@pytest.mark.parametrize("field", FIELDS)
def test_seed_decides(train, whole, tmp_path, field):
    one, _ = whole[field]
    torch.manual_seed(6)  # must not matter
    two, _ = train(field, tmp_path / "2")
    other, _ = train(field, tmp_path / "3", seed=1)
    assert same(one, two)
    assert not same(one, other)


def test_trained_fields_fit(trained, snapshots):
    manifold, metrics = trained
    at, xhat, parameters = manifold.restrict(), manifold.training_latents, manifold.training_parameters
    stress, affine = at.stress(xhat, parameters), at.affine(xhat, parameters).flatten(-2)
    steps = {f"{phase}_steps": 150 for phase in PHASES}
    # A field of one's own may be solved for, in some phases or in all.
    assert {name: metrics[name] for name in steps if name in metrics}.items() <= steps.items()
    for phase, values, name in zip(
        PHASES, (at.position(xhat), stress, affine), ("x", "tau", "C"), strict=True
    ):
        reference = snapshots.slab(name, slice(None)).double()
        variance = (reference - reference.mean((0, 1))).square().mean()
        error = (values - reference).square().mean() / variance
        assert error < (0.5 if manifold.field == "basis" else 0.9), phase


def test_global_state_is_left_alone(train, tmp_path):
    torch.use_deterministic_algorithms(False)
    train("basis", tmp_path)
    assert not torch.are_deterministic_algorithms_enabled()


def test_divergence_is_named(train, tmp_path):
    with pytest.raises(InstabilityError, match=r"deformation field diverged.*learning_rate"):
        train("mlp", tmp_path, FastTrainer(steps=40, learning_rate=1e30, particles_per_batch=16))


def test_paper_schedule():
    paper = PaperTrainer()
    # 100 snapshots are 4 batches of at most 32.
    assert [paper.steps_of(phase, 100) for phase in PHASES] == [5 * 300 * 4, 5 * 600 * 4, 5 * 600 * 4]
    rates = [paper.rate_at(step, 6000) for step in (0, 1199, 1200, 5999)]
    assert rates == [1e-3, 1e-3, 5e-4, 5e-5]
    fit = Fit("stress", torch.nn.Identity(), lambda *_: None, pointwise=True)
    epoch = [paper.batch(step, fit, 100, 9, 0, seeded("cpu", step)) for step in range(4, 8)]
    assert sorted(torch.cat([rows for rows, _ in epoch]).tolist()) == list(range(100))
    assert [len(rows) for rows, _ in epoch] == [32, 32, 32, 4]
    assert all(particles == slice(None) for _, particles in epoch)
    assert not torch.equal(epoch[0][0], paper.batch(0, fit, 100, 9, 0, seeded("cpu", 0))[0])


def test_paper_schedule_trains(train, tmp_path):
    schedule = PaperTrainer([1e-3, 1e-4], 2, 1, 1, frames_per_batch=10)
    _, metrics = train("mlp", tmp_path, schedule)
    assert [metrics[f"{phase}_steps"] for phase in PHASES] == [12, 6, 6]


def test_cosine_decay():
    assert SHORT.rate_at(0, 60) == SHORT.learning_rate
    assert SHORT.rate_at(30, 60) == pytest.approx(SHORT.learning_rate / 2)
    assert SHORT.rate_at(59, 60) < 1e-2 * SHORT.learning_rate


def test_per_phase():
    assert per_phase("beta", 4) == (4, 4, 4)
    assert per_phase("beta", [4, 5]) == (4, 5, 5)
    assert per_phase("beta", (4, 5, 6)) == (4, 5, 6)


def test_widths(snapshots):
    for field in (MlpField(beta=[2, 3]), BasisField(beta=[2, 3], modes=9)):
        prepared = field.prepare(snapshots, LATENT)
        manifold = field.build(snapshots, prepared, LATENT, seeded("cpu", 0))
        networks = (
            manifold.decoders
            if manifold.field == "mlp"
            else {k: f.network for k, f in manifold.fields.items()}
        )
        assert [networks[phase].width for phase in PHASES] == [2 * 3, 3 * 6, 3 * 9]
        hidden = len(networks["stress"].layers) - 1
        assert hidden == (5 if manifold.field == "mlp" else field.depth)


def test_heads_follow_strong_coordinates_and_ignore_those_below_the_floor(snapshots, tmp_path):
    r, moved = 4, []
    schedule = FastTrainer(steps=250, learning_rate=1e-2)
    for floor in (0.0, 0.2):
        field = BasisField(modes=[9, 7, 8], beta=4, depth=2, noise_floor=floor)
        manifold, _ = training.train(snapshots, field, schedule, r, 0, tmp_path / str(floor), "cpu")
        sigma = manifold.fields["deformation"].leading
        torch.testing.assert_close(manifold.spread, (1 + (floor * sigma[0] / sigma) ** 2).sqrt())
        near = manifold.training_latents[5] + torch.eye(r).double()
        restricted, parameters = manifold.restrict(), manifold.training_parameters[5]
        here = restricted.stress(manifold.training_latents[5], parameters)
        moved.append((restricted.stress(near, parameters) - here).flatten(1).norm(dim=1) / here.norm())
    without, with_floor = moved
    assert (with_floor[:2] > 0.2).all()
    assert (without[2:] > 0.2).all()
    assert (with_floor[2:] < 0.05).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MlpField(beta=0), "beta=0"),
        (lambda: MlpField(beta=[1, 2, 3, 4]), "beta="),
        (lambda: BasisField(modes=[9, 0]), "modes="),
        (lambda: BasisField(depth=0), "depth=0"),
        (lambda: BasisField(noise=-0.1), "noise=-0.1"),
        (lambda: BasisField(noise_floor=-0.1), "noise_floor=-0.1"),
        (lambda: BasisField(members=0), "members=0"),
        (lambda: FastTrainer(steps=0), "steps=0"),
        (lambda: FastTrainer(steps=5, learning_rate=0.0), "learning_rate=0.0"),
        (lambda: FastTrainer(steps=5, particles_per_batch=0), "particles_per_batch=0"),
        (lambda: PaperTrainer(learning_rates=[]), "learning_rates="),
        (lambda: PaperTrainer(epochs_stress=0), "epochs_stress=0"),
    ],
)
def test_values_are_checked(make, message):
    with pytest.raises(ConfigError, match=message.replace("[", r"\[")):
        make()
