"""How a step grows with the number of particles."""

from collections.abc import Callable

from nsf.bench.full_order import measured
from nsf.bench.rows import Result, Settings

SIZES = {
    "cuda": (10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000, 4_000_000),
    "cpu": (10_000, 20_000, 40_000),
}


def run(settings: Settings, say: Callable[[str], None]) -> Result:
    """Full-order steps: from 10 000 to 4 million particles on a GPU, to 40 000 on a CPU."""
    kind = "cuda" if settings.device.startswith("cuda") else "cpu"
    return measured("scaling", settings.particles or SIZES[kind], settings, say)
