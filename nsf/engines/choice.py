"""Which engine takes the steps of some runs, and why."""

from collections.abc import Sequence

from nsf.dynamics.setup import Setup
from nsf.engines.base import Engine
from nsf.engines.modal import Modal
from nsf.engines.reference import Reference
from nsf.errors import ConfigError

#: From the fastest to the one that steps whatever can be stepped.
ENGINES: tuple[Engine, ...] = (Modal(), Reference())
NAMES = ("auto", *(engine.name for engine in ENGINES))


def choose(name: str | Engine, setups: Sequence[Setup]) -> tuple[Engine, str]:
    """The engine for runs that take their steps together.

    Args:
        name: one of `NAMES`, of which `auto` is the fastest that can; or an engine of the user.
        setups: of the runs.

    Returns:
        The engine, and why it is not a faster one; empty where none is faster.

    Raises:
        ConfigError: an unknown name, or the engine cannot take the steps: says why.
    """
    by_name = {engine.name: engine for engine in ENGINES}
    if isinstance(name, Engine):
        candidates = [name]
    elif name == "auto":
        candidates = list(ENGINES)
    elif name in by_name:
        candidates = [by_name[name]]
    else:
        raise ConfigError(
            f"engine={name} is unknown; choose one of {', '.join(NAMES)}, or give "
            "nsf.recurrence.RecurrenceEngine.load(FILE) of a teach run"
        )
    refusals = []
    for engine in candidates:
        refusal = engine.refusal(setups)
        if not refusal:
            slower = candidates[0] is not ENGINES[0]
            return engine, "; ".join(refusals) or ("it was asked for" if slower else "")
        refusals.append(refusal)
    detail = "; ".join(
        f"engine {engine.name}: {why}" for engine, why in zip(candidates, refusals, strict=True)
    )
    raise ConfigError(f"no engine can take these steps: {detail}")
