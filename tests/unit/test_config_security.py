"""A configuration that someone else wrote is data: it runs nothing, imports nothing, reads no environment."""

import re
import shutil
import sys

import pytest
from omegaconf import OmegaConf

import nsf.paths
from nsf import config, load_scene
from nsf.config import targets
from nsf.errors import ConfigError, NSFError
from nsf.paths import CONF, groups
from nsf.pipeline.sweeps.jobs import sweep

#: Callables of this package, which are no class that a key expects, and what they would need.
CALLABLES = [
    "nsf.workers.Worker",
    "nsf.storage.write_json",
    "nsf.extras.optional",
    "nsf.cli.main",
    "nsf.config.load",
    "nsf.runs.Run",
    "nsf.workers.os.system",
    "nsf.storage.shutil.rmtree",
    "nsf.kinematics.fields.mlp.torch.load",
    "nsf.mpm.FullOrderMPM",
    "nsf.scenes.Scene",
    "nsf.scenes.load",
    "nsf.scenes.shapes.mesh._read",
    "nsf.dynamics.ReducedMPM",
    "nsf.sampling.sampler.np.save",
    "nsf.results.report.build_report",
    "nsf.live.bench",
    "nsf.__main__.main",
    "nsf",
    "nsf.",
    "nsf..scenes.Box",
    "",
    "os.system",
    "builtins.exec",
    "subprocess.Popen",
    "hydra.utils.call",
]
PLACES = sorted(key.replace("*", "column" if "bodies" in key else "floor") for key in targets.KINDS)


@pytest.mark.parametrize("place", PLACES)
def test_a_key_takes_only_the_classes_that_it_expects(place):
    for target in CALLABLES:
        told = re.escape(f"{place}: _target_: {target} ") + "(is refused|is no |does not exist)"
        with pytest.raises(ConfigError, match=told):
            config.build({"_target_": target, "folder": "/nowhere"}, place)


@pytest.mark.parametrize(
    ("place", "target"),
    [
        ("field", "nsf.workers.Worker"),
        ("scene.walls", "nsf.storage.write_json"),
        ("scene.bodies.column.shape", "nsf.cli.main"),
    ],
)
def test_it_is_refused_where_a_configuration_is_loaded(place, target):
    with pytest.raises(ConfigError, match=re.escape(f"{place}: _target_: {target} is refused")):
        config.load([f"{place}._target_={target}"])


@pytest.mark.parametrize("target", [None, 5, [1], {"a": 1}, True, "${scale}"])
def test_a_target_that_is_no_text(target):
    with pytest.raises(ConfigError, match=r"_target_: .* is refused"):
        config.build({"_target_": target}, "field")


def test_nothing_outside_the_package_of_a_key_is_imported(monkeypatch):
    for module in ("nsf.doctor", "antigravity"):
        monkeypatch.delitem(sys.modules, module, raising=False)  # and put back afterwards
        with pytest.raises(ConfigError, match="is refused"):
            config.build({"_target_": f"{module}.report"}, "field")
        assert module not in sys.modules


@pytest.mark.parametrize(
    "override",
    [
        "+scene.extra={_target_: nsf.scenes.Box, lower: [0,0,0], upper: [1,1,1]}",
        "+_target_=nsf.scenes.Box",
        "+scene._target_=nsf.scenes.Scene",
        "+data._target_=nsf.storage.write_json",
        "+evaluation.deep=[{a: [{_target_: nsf.workers.Worker}]}]",
        "+scene.bodies.column.shape.radius={_target_: nsf.workers.Worker}",
        "+scene.bodies.column.shape.more={_target_: nsf.scenes.Box}",
        "+sampler.phases=[{_target_: nsf.workers.Worker}]",
        "+scene.parameters._target_=nsf.scenes.Box",
    ],
)
def test_where_nothing_is_built_no_target_may_stand(override):
    with pytest.raises(
        ConfigError, match=r"_target_: nsf\.[\w.]+ is refused; nothing is built from this key|takes no"
    ):
        config.load(
            [override.replace("+sampler.phases", "sampler=region").split("=")[0] + "=region", override]
            if "phases" in override
            else [override]
        )


@pytest.mark.parametrize(
    "key",
    [
        *(f"field.{key}" for key in ("_partial_", "_recursive_", "_convert_", "_args_", "_mode_", "_init_")),
        *(
            f"{place}._args_"
            for place in ("scene.bodies.column", "scene.bodies.column.shape", "scene", "data")
        ),
    ],
)
def test_keys_of_hydras_instantiation_are_refused(key):
    with pytest.raises(ConfigError, match=f"{key.split('.')[-1]} is refused"):
        config.load([f"+{key}=1"])


def test_a_target_that_an_interpolation_puts_together_is_refused():
    with pytest.raises(ConfigError, match=r"nsf\.workers\.Worker is refused"):
        config.load(["+scene.evil=nsf.workers.Worker", "field._target_='${scene.evil}'"])
    with pytest.raises(ConfigError, match=r"nsf\.workers\.Worker is refused"):
        config.load(["+scene.evil=workers.Worker", "field._target_='nsf.${scene.evil}'"])


def test_an_abstract_class_is_told():
    with pytest.raises(ConfigError, match=r"nsf\.scenes\.Shape is abstract"):
        config.build({"_target_": "nsf.scenes.Shape"}, "scene.bodies.a.shape")


def test_a_dot_in_a_name_moves_nothing_to_another_key():
    nodes = {"floor.motion": {"_target_": "nsf.mpm.Motion", "times": [0, 1], "angles": [0, 1]}}
    with pytest.raises(ConfigError, match="leave the dot out"):
        config.build_all(nodes, "scene.colliders")


def test_every_group_of_conf_that_builds_is_named():
    """A group whose options have a `_target_` has its line in `KINDS`."""
    for group, options in groups().items():
        texts = [(CONF / group / f"{option}.yaml").read_text() for option in options]
        builds = any(text.startswith("_target_") or "\n_target_" in text for text in texts)
        assert group.startswith("hydra/") or (group in targets.KINDS) == builds, texts


# -- interpolations -----------------------------------------------------------------------------------------

SECRETS = [
    "${oc.env:SECRET}",
    "${ oc.env:SECRET}",
    "${oc.env :SECRET}",
    "a${oc.env:SECRET,none}b",
    "${oc.env:NSF_REPORTS,reports}",
    "${scaled:{small: '${oc.env:SECRET}', paper: 1}}",
    "${oc.select:nothing,${oc.env:SECRET}}",
    "${oc.decode:'1'}",
    "${oc.create:{a: 1}}",
    "${oc.dict.keys:scene}",
    "${oc.dict.values:scene}",
    "${oc.deprecated:scene.dx}",
    "${hydra:runtime.cwd}",
    "${now:%Y}",
    "${python_version:}",
    "${${scene.name}:SECRET}",
    "${oc.${scene.name}:SECRET}",
    "${unknown:1}",
    "${oc.select:${scene.name}}",
    "${oc.select:'scene.name'}",
    r"\${oc.env:SECRET}",
]


@pytest.mark.parametrize(
    ("key", "text"),
    [
        *(("scene.title", text) for text in SECRETS),
        *((key, SECRETS[0]) for key in ("report.name", "scene.bodies.column.particles", "tracking")),
    ],
)
def test_the_environment_is_not_read(monkeypatch, key, text):
    monkeypatch.setenv("SECRET", "s3cret")
    found = OmegaConf.create({"scene": {"name": "sand", "dx": 0.1}, "scale": "small"})
    OmegaConf.update(found, key, text)
    with pytest.raises(ConfigError, match=rf"{key}: .* is refused|is missing") as refusal:
        config.resolve(found)
    assert "s3cret" not in str(refusal.value)


@pytest.mark.parametrize(
    "text", ["${oc.env:SECRET}", "${oc.env:NSF_RUNS,runs}", "x${oc.env:NSF_REPORTS,reports}"]
)
@pytest.mark.parametrize("key", ["report.folder", "point.folder"])
def test_a_folder_of_reports_knows_one_variable(key, text):
    found = OmegaConf.create()
    OmegaConf.update(found, key, text)
    with pytest.raises(ConfigError, match=rf"{key}: .* is refused"):
        config.resolve(found)
    OmegaConf.update(found, key, "${oc.env:NSF_REPORTS,reports}/point")
    config.resolve(found)


def test_no_interpolation_is_put_together_from_pieces(monkeypatch):
    """What a value resolves to is not resolved again: `$` and `{oc.env:…}` are harmless by themselves."""
    monkeypatch.setenv("SECRET", "s3cret")
    found = config.load()
    found.scene.title = "${oc.select:nothing,'$'}{oc.env:SECRET}"
    with pytest.raises(ConfigError, match="becomes an interpolation itself"):
        config.resolve(found)


def test_a_cycle_of_interpolations_is_one_line():
    with pytest.raises(ConfigError, match=r"^scene\.dx: it refers to itself.*; give one of them a value$"):
        config.load(["scene.dt='${scene.dx}'", "scene.dx='${scene.dt}'"])


@pytest.mark.parametrize("kind", ["list", "text", "select", "relative"])
def test_references_that_multiply_are_refused(kind):
    """Thirty doublings would take hours and all memory."""
    two = {
        "list": "['${{a{0}}}', '${{a{0}}}']",
        "text": "'${{a{0}}}${{a{0}}}'",
        "select": "['${{oc.select:a{0}}}', '${{oc.select:a{0}}}']",
        "relative": "['${{..a{0}}}', '${{..a{0}}}']",
    }[kind]
    text = "a0: [1, 1]\n" + "".join(f"a{n + 1}: {two.format(n)}\n" for n in range(30))
    with pytest.raises(ConfigError, match="more than 20000 values"):
        config.resolve(OmegaConf.create(text))


# -- files --------------------------------------------------------------------------------------------------


@pytest.fixture
def conf(tmp_path, monkeypatch):
    """A copy of conf/ to which files may be added."""
    shutil.copytree(CONF, tmp_path / "conf")
    monkeypatch.setattr(nsf.paths, "CONF", tmp_path / "conf")
    return tmp_path / "conf"


LOGGING = """
hydra:
  job_logging:
    version: 1
    formatters: {evil: {(): os.mkdir, path: MARKER}}
"""


OF_HYDRA = [
    LOGGING,
    "hydra: {callbacks: {evil: {_target_: nsf.storage.write_json, path: MARKER, value: 1}}}",
    "hydra: {job: {env_set: {PYTHONSTARTUP: MARKER}}}",
    "hydra: {job: {chdir: true}}",
    "hydra: {sweep: {dir: MARKER}}",
    "hydra: {launcher: {n_jobs: 99}}",
    "hydra: null",
    "hydra: 5",
]


def test_a_scene_sets_nothing_of_hydra(conf, tmp_path):
    """Hydra makes objects, and runs them, from its own part of a job's configuration."""
    marker = tmp_path / "executed"
    for number, text in enumerate(OF_HYDRA):
        scene = "# @package _global_\ndefaults:\n  - sand\n" + text.replace("MARKER", str(marker))
        (conf / f"scene/evil{number}.yaml").write_text(scene)
    for number, text in enumerate(OF_HYDRA):
        with pytest.raises(NSFError):
            config.load([f"scene=evil{number}"])
        assert not marker.exists(), text
    for number in (0, 1):
        with pytest.raises(NSFError):
            sweep([[f"scene=evil{number},sand"]], ["simulate"])
        assert not marker.exists()


def test_an_experiment_sets_nothing_of_hydra(tmp_path):
    from nsf.pipeline.sweeps.experiment import Experiment

    marker = tmp_path / "executed"
    (tmp_path / "evil.yaml").write_text(
        "{title: a, question: b, paper: c, jobs: [{scene: sand, +hydra.job.env_set.A: b, "
        f"'+hydra.job_logging.formatters.evil': '{{(): os.mkdir, path: {marker}}}'}}]}}"
    )
    with pytest.raises(NSFError):
        sweep(Experiment.load("evil", folder=tmp_path).sweeps, ["simulate"])
    assert not marker.exists()


BROKEN = {
    "NUL": (b"name: a\0b\n", "line 1: control character '\\x00'"),
    "a control character": (b"# fine\nname: \x1b[31m\n", "line 2: control character"),
    "latin-1": ("name: Säule\n".encode("latin-1"), "save it as UTF-8"),
    "utf-16": ("name: sand\n".encode("utf-16"), "save it as UTF-8"),
    "nested": (b"a: " + b"[" * 1000 + b"]" * 1000, "nest"),  # PyYAML may tell of it first, in other words
    "itself": (b"a: &a [*a]\n", "nested too deeply, or holds itself"),
    "aliases": (
        b"a0: &a0 [1, 1]\n" + b"".join(b"a%d: &a%d [*a%d, *a%d]\n" % (n + 1, n + 1, n, n) for n in range(40)),
        "more than 100000 values",
    ),
    "merged": (
        b"a0: &a0 {x: 1, y: 1}\n"
        + b"".join(b"a%d: &a%d {x: *a%d, y: *a%d}\n" % (n + 1, n + 1, n, n) for n in range(40)),
        "more than 100000 values",
    ),
    "long": (b"a: " + b"x" * 2**20, "bytes, more than"),
    "a tag": (b"a: !!python/object/apply:os.mkdir [MARKER]\n", "evil.yaml"),
    "syntax": (b"a: [1\n", "correct the yaml"),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_yaml_that_cannot_be_read_is_told_by_name(conf, tmp_path, name, monkeypatch):
    monkeypatch.chdir(tmp_path)
    content, told = BROKEN[name]
    (conf / "scene/evil.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=re.escape(told)) as refusal:
        config.load(["scene=evil"])
    assert "evil.yaml" in str(refusal.value)
    assert len(str(refusal.value).splitlines()) == 1
    assert not (tmp_path / "MARKER").exists()
    with pytest.raises(ConfigError):
        config.read(conf / "scene/evil.yaml")


def test_a_broken_yaml_is_nothing_to_others(conf):
    for name in ("NUL", "latin-1", "utf-16", "nested", "syntax"):
        (conf / f"scene/{name}.yaml").write_bytes(BROKEN[name][0])
    assert config.load(["scene=sand"])


def test_a_scene_that_runs_code_is_refused(conf, tmp_path, monkeypatch):
    """The file as it was handed over: a shape that starts a process."""
    marker = tmp_path / "executed"
    monkeypatch.setenv("MARKER", str(marker))
    (conf / "scene/evil.yaml").write_text(
        "# @package _global_\ndefaults:\n  - sand\nscene:\n  colliders:\n    floor:\n"
        "      _target_: nsf.workers.Worker\n      call: 0\n"
        f"      environment: {{PYTHONSTARTUP: {marker}}}\n"
    )
    with pytest.raises(
        ConfigError, match=r"scene\.colliders\.floor: _target_: nsf\.workers\.Worker is refused"
    ):
        load_scene("evil")


@pytest.mark.parametrize("override", ["projector=$", "sampler=${oc.decode:'1'}"])
def test_an_override_that_no_grammar_reads_is_one_line(override):
    with pytest.raises(ConfigError) as refused:
        config.load([override])
    assert "\n" not in str(refused.value)
