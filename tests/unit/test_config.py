"""Configuration: composed, resolved, checked."""

import re
import shutil

import pytest
from omegaconf import OmegaConf

import nsf.paths
from nsf import config
from nsf.config import composing
from nsf.config.resolvers import following, resolved
from nsf.errors import ConfigError
from nsf.paths import CONF, groups
from nsf.scalars import one_of


def test_defaults_compose():
    found = config.load()
    assert (found.scene.name, found.scale, found.latent_dim, found.sampler.size) == ("sand", "small", 6, 150)
    assert found.scene.dx == pytest.approx(1.0 / 64.0)


def test_turned():
    node = OmegaConf.create({"angle": 30, "n": "${turned:[0,0,2],[0,5,0],${angle}}"})
    assert resolved(node)["n"] == pytest.approx([1.0, 0.0, 3.0**0.5])


@pytest.mark.parametrize(
    ("arguments", "quoted"),
    [
        ("[0,0],[0,1,0],30", "vector of ${turned:…}=[0, 0] must be 3 finite numbers"),
        ("[0,0,1],[0,0,0],30", "axis of ${turned:…}=[0, 0, 0] has no direction"),
        ("[0,0,1],[0,1,0],steep", "angle of ${turned:…}=steep must be a finite number"),
    ],
)
def test_turned_out_of_range(arguments, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        config.resolve(OmegaConf.create({"n": f"${{turned:{arguments}}}"}))


def test_everything_resolves():
    def leaves(node):
        if isinstance(node, dict | list):
            for child in node.values() if isinstance(node, dict) else node:
                yield from leaves(child)
        else:
            yield node

    raw = OmegaConf.to_container(config.resolve(config.load(["scale=paper"])), resolve=False)
    assert not [leaf for leaf in leaves(raw) if isinstance(leaf, str) and ("${" in leaf or "???" in leaf)]


def test_scale_chooses_every_size():
    small, paper = config.load(["scale=small"]), config.load(["scale=paper"])
    assert paper.scene.bodies.column.particles == 71363 > small.scene.bodies.column.particles
    assert len(paper.scene.design.train) == 16
    assert paper.report.name == "sand"
    assert small.report.name == "sand_small"


def test_a_key_that_refers_to_another_follows_it():
    found = config.load(["+scene.tilt=30.0", "scene.gravity='${turned:[0,0,2],[0,1,0],${scene.tilt}}'"])
    assert config.resolve(found).scene.gravity == pytest.approx([1.0, 0.0, 3.0**0.5])
    found.scene.tilt = 90.0
    assert config.resolve(found).scene.gravity == pytest.approx([2.0, 0.0, 0.0])


def test_a_reference_to_nothing_is_refused():
    with pytest.raises(ConfigError, match="tilt"):
        config.load(["scene.gravity=['${scene.tilt}', 0.0, 0.0]"])


def test_a_group_option_replaces_the_whole_group():
    found = config.load(["projector=taylor"])
    assert found.projector == {"_target_": "nsf.dynamics.Taylor"}
    assert config.load(["model=interpolate"]).model.name == "interpolate"


@pytest.mark.parametrize(
    "overrides",
    [
        ("scene=block", "scale=paper", "model=recurrence", "model.runs=8"),
        ("seed=1", "+scene.parameters.E={key:material.E,unit:Pa,range:[1,2]}", "seed=2", "material=hencky"),
        ("~scene.bodies.column", "++scene.new=[3]", "scene.dx=0.3", "latent_dim=${seed}"),
    ],
)
def test_values_are_set_as_by_hydra(overrides):
    ours = composing.with_values("config", overrides, composing.check_sizes(nsf.paths.files()))
    theirs = OmegaConf.to_container(composing._with_hydra("config", overrides))
    del theirs["hydra"]
    assert OmegaConf.to_container(ours) == theirs


def test_one_load_leaves_no_trace_in_the_next():
    before = config.load()
    config.load(["scale=paper", "latent_dim=3", "stress=deformation", "affine=none"])
    with pytest.raises(ConfigError):
        config.load(["nonsense=1"])
    assert config.load() == before


def test_every_yaml_is_in_a_group_or_primary():
    assert {p.parent.relative_to(CONF).as_posix() for p in CONF.rglob("*.yaml")} - set(groups()) == {"."}


@pytest.mark.parametrize(
    ("override", "quoted"),
    [
        ("lantent_dim=4", "unknown key 'lantent_dim'; did you mean latent_dim"),
        ("modl=full", "did you mean model"),
        ("model=projecte", "unknown model=projecte; choose one of auto, dmdc"),
        ("scene=snad", "(did you mean sand?)"),
        ("scene.design.test=[1", "'scene.design.test=[1'"),
    ],
)
def test_refused(override, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)) as refusal:
        config.load([override])
    assert len(str(refusal.value).splitlines()) == 1


def test_several_values_without_m_name_the_remedy():
    with pytest.raises(ConfigError, match="-m"):
        config.load(["latent_dim=4,6"])


@pytest.mark.parametrize(
    ("override", "quoted"),
    [
        ("sampler.size=2.5", "sampler.size=2.5"),
        ("sampler.seed=abc", "sampler.seed=abc"),
        ("integration.margin=abc", "integration.margin=abc"),
        ("projector.iterations=maybe", "projector.iterations=maybe"),
        ("material.E=soft", "material.E=soft"),
        ("field.depth=1000000", "depth=1000000"),
        ("projector.iterations=1000000000", "projector.iterations=1000000000"),
    ],
)
def test_values_of_the_wrong_type_or_size_name_key_and_value(override, quoted):
    group = override.split(".")[0]
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        config.build(config.load([override])[group], group)


@pytest.mark.parametrize(
    ("override", "remedy"),
    [
        ("~scene.gravty", "did you mean scene.gravity?"),
        ("+scene.dt=4", "leave out the plus"),
    ],
)
def test_a_key_that_cannot_be_left_out_or_added(override, remedy):
    with pytest.raises(ConfigError, match=re.escape(remedy)):
        config.load(["scene=sand", override])


def test_a_node_cannot_be_replaced_by_other_keys():
    with pytest.raises(ConfigError, match=r"scene.bodies.column.shape' takes no keys beyond its own"):
        config.load(["scene.bodies.column.shape={_target_:nsf.scenes.Ball,centre:[0.5,0.5,0.5]}"])


def test_a_misspelt_key_in_a_node_is_named():
    with pytest.raises(ConfigError, match=r"sampler.sise.; did you mean sampler.size"):
        config.build(config.load(["+sampler.sise=3"]).sampler, "sampler")


def test_a_target_that_does_not_exist(capsys):
    target = "nsf.kinematics.fields.nothing.Here"
    with pytest.raises(ConfigError, match=re.escape(f"field: _target_: {target} does not exist")):
        config.build(config.load([f"field._target_={target}"]).field, "field")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("override", "told"),
    [
        ("field._target_=nsf.1x", "field: _target_: nsf.1x is refused"),
        ("field._target_=nsf.config.number", "field: "),
        ("~field._target_", "field names no class"),
    ],
)
def test_a_target_that_is_no_class(override, told):
    with pytest.raises(ConfigError, match=re.escape(told)):
        config.build(config.load([override]).field, "field")


def test_an_experiment_takes_a_plus():
    with pytest.raises(ConfigError, match=re.escape("+experiment=NAME")):
        config.load(["experiment=table1"])


def test_broken_yaml_names_file_and_line(tmp_path, monkeypatch):
    shutil.copytree(CONF, tmp_path / "conf")
    (tmp_path / "conf/model/broken.yaml").write_text("_target_: nsf.models.Projected\nname: [\n")
    monkeypatch.setattr(nsf.paths, "CONF", tmp_path / "conf")
    with pytest.raises(ConfigError, match=r"broken\.yaml.*line [23].*correct the yaml"):
        config.load(["model=broken"])


def test_a_yaml_that_is_edited_is_read_again(tmp_path, monkeypatch):
    shutil.copytree(CONF, tmp_path / "conf")
    monkeypatch.setattr(nsf.paths, "CONF", tmp_path / "conf")
    before, file = config.load(["scene=sand"]), tmp_path / "conf/scene/sand.yaml"
    assert config.load(["scene=sand"]) == before
    text = file.read_text(encoding="utf-8")
    file.write_text(text.replace("title: Sand column", "title: Other"), encoding="utf-8")
    assert config.load(["scene=sand"]).scene == {**before.scene, "title": "Other"}


def test_jobs_are_every_combination_once():
    sweeps = [["scene=sand,bread", "latent_dim=4"], ["scene=bread", "latent_dim=4", "field=glob(m*)"]]
    assert config.jobs(sweeps) == [
        ("scene=sand", "latent_dim=4"),
        ("scene=bread", "latent_dim=4"),
        ("scene=bread", "latent_dim=4", "field=mlp"),
    ]
    assert config.jobs([["seed=range(0,3)", "seed=1,2"]]) == [("seed=1",), ("seed=2",)]
    mixed = config.jobs([["scene=sand,bread"], ["scene=bread,sand", "latent_dim=4"]])
    assert [job[0] for job in mixed] == ["scene=sand"] * 2 + ["scene=bread"] * 2
    assert config.jobs([sweeps[0], sweeps[0]]) == config.jobs([sweeps[0]])


def test_an_interval_is_for_a_search():
    with pytest.raises(ConfigError, match=r"interval.*nsf search"):
        config.jobs([["latent_dim=interval(2,8)"]])


@pytest.mark.parametrize(
    ("overrides", "quoted"),
    [
        (["hydra/launcher=slurmm"], "did you mean slurm?"),
        (["hydra/launcher=slurm", "hydra.launcher.partitionn=a"], "did you mean hydra.launcher.partition"),
        (["hydra.launcher.n_job=2", "hydra/launcher=joblib"], "did you mean hydra.launcher.n_jobs"),
    ],
)
def test_a_launcher_that_is_not_there(overrides, quoted):
    with pytest.raises(ConfigError, match=re.escape(quoted)):
        config.launching(overrides)


def test_what_follows_an_entry_of_a_list_is_found_however_it_is_named():
    config = OmegaConf.create({"a": [1.0, 2.0], "b": "${a[1]}", "c": "${b}"})
    assert sorted(following(config, "a.1")) == sorted(following(config, "a[1]")) == [("b",), ("c",)]


def test_a_removed_key_names_its_replacement():
    with pytest.raises(ConfigError, match=r"trainer\.devices was removed; .*hydra/launcher=joblib"):
        config.load(["trainer.devices=2"])


def test_a_file_with_a_removed_key_is_refused(tmp_path):
    whole = config.load([])
    OmegaConf.update(whole, "trainer.devices", 1, force_add=True)
    path = tmp_path / "config.yaml"
    path.write_text(OmegaConf.to_yaml(whole))
    with pytest.raises(ConfigError, match=r"config\.yaml: trainer\.devices was removed"):
        config.read(path)


def test_a_choice_of_nothing_is_refused():
    with pytest.raises(ConfigError, match=r"field=basis .* nothing to choose"):
        one_of("field", "basis", [])
