"""A chain as one tracked run: in TensorBoard, in MLflow where it is there, and as any tool sees it."""

import sys

import pandas as pd
import pytest

from nsf.config import load
from nsf.errors import MissingExtraError, NSFError
from nsf.pipeline import tracking
from nsf.pipeline.sweeps import jobs as sweep
from nsf.pipeline.tracking import EXTRAS, Tool, as_text, figures
from nsf.runs.listing import flat


@pytest.fixture
def tracked(pipeline_at, copied):
    """(kind) → the tiny chain, which is there, with its tracked run."""

    def build(kind):
        root = copied("simulate", "train", "deploy", "evaluate")
        pipeline = pipeline_at(root, f"tracking={kind}")
        with pipeline.tracked:
            assert pipeline.evaluation.complete
        return pipeline

    return build


class Fake:
    """A tool that writes down what it is asked."""

    def __init__(self):
        self.calls = []

    def __call__(self, run, folder, group):
        self.calls.append(("begin", run.id, group))
        return Tool(self, self.conclude, self.put, self.end)

    def log_hyperparams(self, keys):
        self.calls.append(("keys", keys))

    def log_metrics(self, metrics, step):
        self.calls.append(("metrics", step))

    def conclude(self, keys, values):
        self.calls.append(("figures", values))

    def put(self, path):
        self.calls.append(("put", path.name))

    def end(self, status):
        self.calls.append(("end", status))


def test_keys_figures_and_files(tracked, monkeypatch):
    fake = Fake()
    monkeypatch.setattr(tracking, "_tensorboard", fake)
    pipeline = tracked("tensorboard")
    names, values = zip(*(call[:2] for call in fake.calls), strict=True)
    assert names == ("begin", "keys", "figures", "put", "put", "end")
    assert values[0] == pipeline.evaluation.id
    assert values[1]["scene.bodies.column.particles"] == 500
    assert values[1]["model.name"] == "projected"
    assert values[2] == figures(pipeline)
    named = {f"results/{name}" for name in ("delta", "displacement_error", "stress_error", "memory_mib")}
    assert {*named, "seconds/train"} <= {*values[2]}
    assert values[3:] == ("results.csv", "manifold.pt", "success")


def test_a_failed_chain_ends_as_failed(pipeline_at, tmp_path, monkeypatch):
    fake = Fake()
    monkeypatch.setattr(tracking, "_tensorboard", fake)
    pipeline = pipeline_at(tmp_path, "tracking=tensorboard")
    pipeline.tracked.loggers(tmp_path)  # as a training begins
    with pytest.raises(NSFError), pipeline.tracked:
        pipeline.evaluate()
    assert fake.calls[-1] == ("end", "failed")


@pytest.mark.parametrize("method", ["__call__", "log_hyperparams", "log_metrics", "conclude", "put", "end"])
def test_an_error_of_a_tool_is_one_warning(pipeline_at, copied, tmp_path, monkeypatch, method):
    def unreachable(*_, **__):
        raise ConnectionError("no server")

    fake, said = Fake(), []
    monkeypatch.setattr(tracking, "_tensorboard", unreachable if method == "__call__" else fake)
    setattr(fake, method, unreachable)
    pipeline = pipeline_at(copied("simulate", "train", "deploy", "evaluate"), "tracking=tensorboard")
    monkeypatch.setattr(pipeline, "say", said.append)
    with pipeline.tracked:
        for logger in pipeline.tracked.loggers(tmp_path)[1:]:
            logger.log_metrics({"loss": 1.0}, step=1)
    assert said == ["tracking: warning: tensorboard failed and gets no more (no server)"]
    assert method in ("__call__", "end") or fake.calls[-1] == ("end", "success")


def test_jobs_of_a_sweep_have_a_parent(chain, tiny, monkeypatch):
    groups = []
    monkeypatch.setenv("NSF_RUNS", str(chain.root))
    monkeypatch.setattr(sweep, "work", lambda config, stages, say, group: groups.append(group))
    words = [word for word in tiny if not word.startswith("latent_dim")]
    assert not sweep.sweep([[*words, "latent_dim=3,4"]], ["train"])
    assert not sweep.sweep([[*words, "latent_dim=3"]], ["train"])
    assert groups[0] == groups[1]
    assert groups[0].startswith("sweep-")
    assert groups[2] == ""


def test_losses_of_a_training(chain):
    losses = pd.read_csv(chain.pipeline.training.path / "stress" / "csv" / "0" / "metrics.csv")
    assert {"stress/loss", "stress/learning_rate", "step"} <= {*losses}
    assert load(["scene=sand"]).tracking == "csv"


def test_tensorboard(tracked):
    pytest.importorskip("tensorboard")
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    pipeline = tracked("tensorboard")
    run = pipeline.evaluation
    events = EventAccumulator(str(run.root / "tensorboard" / run.scene / run.hash)).Reload()
    (delta,) = events.Scalars("results/delta")
    assert delta.value == pytest.approx(figures(pipeline)["results/delta"])
    assert "_hparams_/session_start_info" in events.summary_metadata
    assert {"results.csv/text_summary", "manifold.pt/text_summary"} <= {*events.Tags()["tensors"]}


def test_mlflow(tracked, monkeypatch):
    mlflow = pytest.importorskip("mlflow", reason="mlflow is not installed; pip install 'nsf[mlflow]'")
    monkeypatch.delenv("MLFLOW_TRACKING_URI", raising=False)
    pipeline = tracked("mlflow")
    pipeline.group = "sweep-1"
    with pipeline.tracked:  # goes on with the run that is there
        pass
    root = pipeline.evaluation.root
    client = mlflow.MlflowClient(f"sqlite:///{root}/mlflow.db")
    experiment = client.get_experiment_by_name("sand")
    runs = {run.data.tags["nsf"]: run for run in client.search_runs([experiment.experiment_id])}
    assert {*runs} == {pipeline.evaluation.id, "sweep-1"}
    run = runs[pipeline.evaluation.id]
    assert {each.info.status for each in runs.values()} == {"FINISHED"}
    assert run.data.params["latent_dim"] == "4"
    assert run.data.metrics["results/delta"] == pytest.approx(figures(pipeline)["results/delta"])
    assert {file.path for file in client.list_artifacts(run.info.run_id)} == {"results.csv", "manifold.pt"}


@pytest.mark.parametrize("kind", EXTRAS)
def test_tracking_that_is_not_installed(pipeline_at, tmp_path, monkeypatch, kind):
    monkeypatch.setitem(sys.modules, kind, None)
    with pytest.raises(MissingExtraError, match=rf"pip install 'nsf\[{EXTRAS[kind]}\]'"):
        pipeline_at(tmp_path, f"tracking={kind}")


def test_keys_are_flat():
    assert as_text(flat({"a": {"b": 1, "c": [1, 2]}, "d": None})) == {"a.b": 1, "a.c": "[1, 2]", "d": "None"}
