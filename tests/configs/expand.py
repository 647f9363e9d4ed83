"""Commands of README.md and of experiments, taken apart."""

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser


def variants(command: str) -> tuple[str, list[list[str]]]:
    """`nsf stage [-m] a=1 b=2,3` → the stage, and the overrides of each of its runs."""
    program, stage, *words = command.split()
    assert program == "nsf"
    overrides = [word for word in words if word != "-m"]
    if "-m" not in words:
        return stage, [overrides]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return stage, [job for batch in BasicSweeper.split_arguments(parsed, None) for job in batch]
