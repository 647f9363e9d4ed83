"""Code blocks of README.md and of docs/, taken apart and tried."""

import re
from pathlib import Path

import pytest
from expand import variants

from nsf import config
from nsf.bench import BENCHES
from nsf.cli import TOOLS, main
from nsf.paths import EXPERIMENTS, groups
from nsf.pipeline import Pipeline
from nsf.pipeline.sweeps.experiment import Experiment
from nsf.pipeline.sweeps.search import Range
from nsf.validation.command import PROBLEMS

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(r'^```(\w+)(?: title="([^"]+)")?\n(.*?)^```$', re.MULTILINE | re.DOTALL)
#: Benches that a page has asked for: many pages ask for the same.
_MEASURED: set[tuple[str, ...]] = set()


def blocks(text: str) -> list[tuple[str, str, str]]:
    """(language, title or "", content) of every fenced block of a page, in order."""
    return _BLOCK.findall(text)


def try_command(command: str, folder: Path, monkeypatch, capsys, experiments: Path = EXPERIMENTS) -> None:
    """Call what is quick, in an empty `folder` of runs; compose and build what a stage would run.

    `make` and `pytest` are only asked whether the target or the file is there.
    """
    program, *words = command.split("#")[0].split()
    if program == "make":
        assert re.search(rf"^{words[0]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
        return
    if program == "pytest":
        assert (ROOT / words[0]).is_file()
        return
    assert program == "nsf"
    name, *words = words
    if name == "search":
        ranges = [Range.parse(word) for word in words]
        assert any(ranges)
        Pipeline(config.load([word for word, found in zip(words, ranges, strict=True) if not found])).check()
    elif name == "validate":
        _check_validated(words)
    elif name in TOOLS:
        if name == "bench":
            words = _quick(words)
            if tuple(words) in _MEASURED:
                return
            _MEASURED.add(tuple(words))
        monkeypatch.setenv("NSF_RUNS", str(folder / "runs"))
        # Without reports: `make check-reports` draws the committed ones.
        monkeypatch.setenv("NSF_REPORTS", str(folder / "reports"))
        (folder / "reports").mkdir(exist_ok=True)
        monkeypatch.setattr("webbrowser.open", lambda address: True)
        with pytest.MonkeyPatch.context() as patch:
            # The others are built in test_experiments.py.
            every = Experiment.jobs.fget
            patch.setattr(Experiment, "jobs", property(lambda experiment: every(experiment)[:1]))
            with pytest.raises(SystemExit) as ended:
                main([name, *words])
        assert not ended.value.code or "no complete deploy run" in capsys.readouterr().err
    else:
        _build(command, experiments)


def _check_validated(words: list[str]) -> None:
    """Whether there are the problems and scenes that `nsf validate` runs; tests/validation runs them."""
    words_of = {key: values.split(",") for key, values in (word.split("=", 1) for word in words)}
    choices = {"problems": PROBLEMS, "scenes": groups()["scene"]}
    assert all(set(values) <= set(choices[key]) for key, values in words_of.items())


def _quick(words: list[str]) -> list[str]:
    """What `nsf bench` is asked for, with one that takes a second; the others have tests of their own."""
    asked = dict(word.split("=", 1) for word in words)
    assert set(asked.get("benches", BENCHES[0]).split(",")) <= set(BENCHES)
    quick = {"benches": "full_order", "particles": "200", "trials": "1", "device": "cpu"}
    return [f"{key}={value}" for key, value in (asked | quick).items()]


def _build(command: str, experiments: Path) -> None:
    stage, runs = variants(command)
    for overrides in runs:
        named = [o.removeprefix("+experiment=") for o in overrides if o.startswith("+experiment=")]
        own = [o for o in overrides if not o.startswith("+experiment=")]
        if stage == "point":
            config.build(config.load(own, "point").material, "material")
        elif named:
            # The others are built in test_experiments.py; a key of the command line is in all of them.
            first = Experiment.load(named[-1], own, experiments).jobs[0]
            config.load([*first.overrides, "device=cpu"])
        else:
            Pipeline(config.load([*own, "device=cpu"])).check()
