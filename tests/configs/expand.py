"""Commands of README.md and of experiments, taken apart."""

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser

from nsf.config import launching, of_launcher


def variants(command: str) -> tuple[str, list[list[str]]]:
    """`nsf stage [-m] a=1 b=2,3` → the stage, and the overrides of each of its runs, without Hydra's own."""
    program, stage, *words = command.split()
    assert program == "nsf"
    launching([word for word in words if of_launcher(word)])
    overrides = [word for word in words if word != "-m" and not of_launcher(word)]
    if "-m" not in words:
        return stage, [overrides]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return stage, [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
