"""The long table of measurements: a row a figure, which carries its unit, precision, device and commit."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import warp as wp

from nsf.errors import SchemaError
from nsf.results.table import parsed
from nsf.runs.provenance import provenance
from nsf.storage import writing

#: What is measured: the benchmark, its case, and sizes P, |S|, |N| and simulations that step together.
SUBJECT = ("bench", "case", "particles", "sample", "integration", "batch", "precision", "device")
#: Pass or stage of a step, empty of the whole; then which figure, its median over the trials and quantiles.
COLUMNS = (*SUBJECT, "part", "what", "median", "p10", "p90", "unit", "commit")
FILE = "bench.csv"
#: 90 % over 10 % of the trials, above which a row is warned of.
WIDE = 1.5


@dataclass(frozen=True)
class Settings:
    """Sizes and devices to measure.

    Attributes:
        particles: numbers of particles; empty for those that suit the benchmark and the device.
        precisions: `fp32`, `fp64` or both, measured turn by turn.
        device: `cpu` or `cuda:N`.
        trials: measurements of each side.
        scenes: of benchmarks of reduced steps and whole runs; empty for all that these have.
        limit: [s] after which whole runs of a scene begin no further turn.
        keys: of the configuration of whole runs, as on the command line.
    """

    particles: tuple[int, ...]
    precisions: tuple[str, ...]
    device: str
    trials: int
    scenes: tuple[str, ...] = ()
    limit: float = 60.0
    keys: tuple[str, ...] = ()

    @property
    def on_gpu(self) -> bool:
        """Whether the device is a GPU."""
        return self.device.startswith("cuda")

    @property
    def scale(self) -> str:
        """Size of the scenes that the device can be asked for: the paper's, or small."""
        return "paper" if self.on_gpu else "small"


@dataclass(frozen=True, kw_only=True)
class Case:
    """One side of a benchmark; None where it has no such size.

    Attributes:
        bench, name: the benchmark, and its case.
        particles, sample, integration: P, |S| and |N|.
        batch: simulations that are stepped together.
        precision: of the solver.
    """

    bench: str
    name: str
    particles: int
    precision: str
    sample: int | None = None
    integration: int | None = None
    batch: int = 1


@dataclass
class Measurements:
    """Where a benchmark puts its figures.

    Attributes:
        settings: of the measurement; say: called with a line on each result; rows: dicts of `COLUMNS`.
        folder: whose table `save` puts the rows into; None to keep them in memory.
    """

    settings: Settings
    say: Callable[[str], object]
    rows: list[dict] = field(default_factory=list)
    folder: Path | None = None

    def add(
        self, case: Case, what: str, values, unit: str = "ms", part: str = "", quantiles: Sequence = ()
    ) -> float:
        """Add a figure, with 10 % and 90 % of its trials where there are several; gives the median."""
        median = float(np.median(values))
        if np.ndim(values):
            quantiles = np.percentile(values, [10, 90]).tolist()
        if quantiles and quantiles[1] > WIDE * quantiles[0]:
            self.say(
                f"warning: {case.name} {case.precision}: {what} spreads from {quantiles[0]:.4g} to "
                f"{quantiles[1]:.4g} {unit} over the trials; measure again where nothing else runs"
            )
        subject = asdict(case) | {"case": case.name, "device": name_of(self.settings.device)}
        row = [*(subject[name] for name in SUBJECT), part, what, median]
        row += [*(quantiles or (None, None)), unit, commit()]
        self.rows.append(dict(zip(COLUMNS, row, strict=True)))
        return median

    def save(self) -> None:
        """Put the rows so far into the table of the folder."""
        if self.folder and self.rows:
            merge(self.folder / FILE, self.frame)

    @property
    def frame(self) -> pd.DataFrame:
        """The table."""
        return pd.DataFrame(self.rows, columns=list(COLUMNS))


def read(path: Path) -> pd.DataFrame:
    """The table of a file, to the last digit; an empty one where there is none."""
    if not path.is_file():
        return pd.DataFrame(columns=list(COLUMNS))
    frame = parsed(path, ("part", "unit"))
    if absent := [name for name in COLUMNS if name not in frame]:
        raise SchemaError(
            f"{path} lacks the columns {', '.join(absent)}; delete it, and run `nsf bench` again"
        )
    return frame.fillna({"part": "", "unit": ""})


def merge(path: Path, fresh: pd.DataFrame) -> None:
    """Put rows in place of those of the same benchmark, case, size, precision and device; keep the others."""
    key = ["bench", "case", "particles", "precision", "device"]
    old = read(path)
    replaced = pd.MultiIndex.from_frame(old[key]).isin(pd.MultiIndex.from_frame(fresh[key]))
    frames = [frame for frame in (old[~replaced], fresh) if len(frame)]
    frame = pd.concat(frames, ignore_index=True) if frames else fresh
    frame = frame.sort_values(["device", "bench", "precision", "particles"], kind="stable")
    with writing(path) as partial:
        frame.astype(dict.fromkeys(("sample", "integration"), "Int64")).to_csv(partial, index=False)


def name_of(device: str) -> str:
    """The name of a figure's device: the product of a GPU, else `cpu`."""
    unit = wp.get_device(device)
    return unit.name if unit.is_cuda else "cpu"


def commit() -> str:
    """The commit that runs, with a plus sign where files differ from it."""
    origin = provenance()
    return str(origin["commit"] or "unknown")[:12] + ("+" if origin["dirty"] else "")


def size_name(particles: int) -> str:
    """`71k`, `200k`, `1m`; the number itself below 1000."""
    if particles >= 1_000_000 and particles % 100_000 == 0:
        return f"{particles / 1e6:g}m"
    return f"{particles / 1e3:.0f}k" if particles >= 1000 else f"{particles}"
