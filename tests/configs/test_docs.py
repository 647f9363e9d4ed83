"""Every code block of README.md and docs/ does what it says: files build, commands compose, Python runs."""

import importlib
import re
import shutil
import sys
from functools import partial
from pathlib import Path

import pytest
import yaml
from pages import ROOT, blocks, try_command

import nsf
from nsf import config, find, paths
from nsf.pipeline import Pipeline
from nsf.pipeline.sweeps.experiment import Experiment

DOCS = ROOT / "docs"
#: What is written for readers of the code has signatures, not programs.
PAGES = ["../README.md"]
PAGES += sorted(p.relative_to(DOCS).as_posix() for p in DOCS.glob("**/*.md") if p.name != "design.md")


#: Packages to which a page may add a module.
EXTENDED = ("nsf.mpm.materials", "nsf.kinematics.fields", "nsf.dynamics", "nsf.sampling", "nsf.models")


@pytest.fixture
def project(page, tmp_path, monkeypatch):
    """A checkout to which a page adds its files: `conf`, `experiments` and what extends the package."""
    shutil.copytree(ROOT / "experiments", tmp_path / "experiments")
    if 'title="conf/' in (DOCS / page).read_text(encoding="utf-8"):  # others share what Hydra composed
        shutil.copytree(ROOT / "conf", tmp_path / "conf")
        monkeypatch.setattr(paths, "CONF", tmp_path / "conf")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("NSF_RUNS", str(tmp_path / "runs"))
    monkeypatch.setenv("NSF_REPORTS", str(tmp_path / "reports"))
    before = set(sys.modules)
    for package in EXTENDED:
        folder = tmp_path / package.replace(".", "/")
        folder.mkdir(parents=True)
        path = importlib.import_module(package).__path__
        monkeypatch.setattr(sys.modules[package], "__path__", [*path, str(folder)])
    yield tmp_path
    for name in set(sys.modules) - before:
        if str(tmp_path) in (getattr(sys.modules[name], "__file__", None) or ""):
            del sys.modules[name]


def add(file: str, content: str, project: Path) -> None:
    """Write a file of a page where it belongs, and build what it defines."""
    path = project / file
    path.write_text(content, encoding="utf-8")
    group, name = Path(file).parent.as_posix(), path.stem
    if path.suffix == ".py":
        importlib.invalidate_caches()
        importlib.import_module(file.removesuffix(".py").replace("/", "."))
    elif group == "experiments":
        for job in Experiment.load(name, folder=project / "experiments").jobs:
            Pipeline(config.load([*job.overrides, "device=cpu"])).check()
    elif group == "conf/hydra/launcher":
        launcher = config.launching([f"hydra/launcher={name}"])[0].hydra.launcher
        assert set(yaml.safe_load(content)) - {"defaults"} <= set(launcher)
    elif group == "conf/material":
        config.build(config.load([f"material={name}"], "point").material, "material")
    else:
        assert group in ("conf/scene", "conf/field", "conf/projector", "conf/sampler", "conf/model"), file
        option = f"{group.removeprefix('conf/')}={name}"
        Pipeline(config.load([option, "scale=small", "device=cpu"])).check()


#: A chain as a page tells it, with its particles but few steps, values and iterations.
SHORT = {
    "sand": ["scene.steps=8", "scene.design.train=[21.0,30.0,38.5]", "trainer.steps=20"],
    "sway": ["scene.steps=110", "scene.design.train=4", "trainer.steps=20"],
}


def train(scene: str) -> None:
    """A manifold of a scene, for pages whose commands made one."""
    pipeline = Pipeline(config.load([f"scene={scene}", "scale=small", "device=cpu", *SHORT[scene]]))
    pipeline.simulate(("train",))
    pipeline.train()


#: The same for runs by a recurrence, for which a short descent will do.
TAUGHT = [
    "model=recurrence", "scene.design.validation=[24,36]", "scene.design.test=[27]",
    *("model.runs=4", "model.descents=60", "model.width=16"),
]  # fmt: skip


def deploy(scene: str) -> None:
    """A deployed run by a recurrence, likewise."""
    keys = [f"scene={scene}", "scale=small", "device=cpu", *SHORT[scene], *TAUGHT]
    pipeline = Pipeline(config.load(keys))
    for stage in ("simulate", "train", "deploy"):
        pipeline.run(stage)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_page(page, project, monkeypatch, capsys):
    text = (DOCS / page).read_text(encoding="utf-8")
    if "trimesh" in text:
        pytest.importorskip("trimesh")
    for extra in ("SALib", "emcee"):
        if f"import {extra}" in text or f"from {extra}" in text:
            pytest.importorskip(extra, reason=f"{extra} is not installed; pip install 'nsf[inverse]'")
    found, names = blocks(text), {"__name__": "page"}
    assert len(found) == text.count("\n```") / 2, "a block that is not read: indented, or without a language"
    for language, title, content in found:
        try:
            if title:
                add(title, content, project)
            elif language == "python":
                for scene in re.findall(r'nsf\.find\(scene="(\w+)"', content):
                    train(scene)
                    monkeypatch.setattr(nsf, "find", partial(find, *SHORT[scene], "device=cpu"))
                for scene in re.findall(r'Model\.load\(("\w+")?\)', content):
                    deploy(scene.strip('"') or "sand")
                exec(compile(content, page, "exec"), names)
            else:
                assert language == "sh", f"a {language} block without a title"
                for command in content.splitlines():
                    try_command(command, project, monkeypatch, capsys, project / "experiments")
        except BaseException as error:
            error.add_note(f"in docs/{page}:\n{content}")
            raise


#: Text right after a row of a table; an item or a row right after text that is no item.
_JOINED = re.compile(r"^\|.*\n(?!\||<!--)\S.*|^(?!\d+\. )[^\s#|<>*-].*\n(?:[-*] |\d+\. |\|).*", re.MULTILINE)


def test_tables_and_lists_stand_apart():
    """Without a blank line above it, the site shows a list as part of the table or the paragraph above."""
    for page in (*DOCS.glob("**/*.md"), *ROOT.glob("*.md"), *ROOT.glob("reports/**/*.md")):
        prose = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
        joined = _JOINED.findall(prose)
        assert not joined, f"{page}: a blank line is missing in {joined}"


def test_named_paths_are_there():
    """A path of the repository that a page names, unless the page adds it or a command makes it."""
    for page in (*PAGES, "design.md"):
        text = (DOCS / page).read_text(encoding="utf-8")
        own = {title for _, title, _ in blocks(text)}
        for path in set(re.findall(r"`((?:nsf|conf|docs|experiments|tests|reports)/[\w/.]+)`", text)) - own:
            assert (ROOT / path).exists() or path.startswith("reports/"), f"{page}: {path}"


def test_the_reference_names_what_is_there():
    pages = sorted((DOCS / "reference").glob("*.md"))
    named = [name for page in pages for name in re.findall(r"^::: ([\w.]+)$", page.read_text(), re.MULTILINE)]
    assert named
    for name in named:
        path = ROOT / name.replace(".", "/")
        package = path.parent / "__init__.py"
        assert path.is_dir() or path.with_suffix(".py").is_file() or path.name in package.read_text(), name
