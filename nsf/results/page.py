"""The report's page, once as HTML that opens from a disk and once as Markdown for GitHub."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from nsf.results.formats import HTML, Rows, markdown_document

DEFINITIONS = (
    (
        "δ",
        "‖x_rom − x_fom‖ / ‖x_fom‖ over frames and particles: the paper's error; it depends on the origin.",
    ),
    (
        "displacement error",
        "‖x_rom − x_fom‖ / ‖x_fom − X‖: the same distance beside how far the particles moved.",
    ),
    ("stress error", "‖τ_rom − τ_fom‖ / ‖τ_fom‖ of the Kirchhoff stress."),
    ("r, |S|, |N|, γ", "latent dimension, sample and integration particles, and γ = 3·particles / r."),
    (
        "method",
        "nsf takes stress and affine momentum from their fields, neural_stress_only the stress alone "
        "(C = 0), neural_affine_only the affine momentum alone (τ from ∂g/∂X), deformation_only neither; "
        "history: particles carry both, as at full order.",
    ),
    (
        "engine",
        "what takes the steps. reference takes projected steps with any field and is not compiled. modal "
        "takes them with fields of modes and is compiled. "
        "operators step the latent vector alone, by a learned recurrence.",
    ),
    (
        "speedup",
        "full-order over reduced mean wall time, of one step, of the whole simulation, and of the simulation "
        "with the positions of all particles decoded at every frame, as a full-order run has them. Times of "
        "operators do not hold the checks that tell the estimate; `nsf bench benches=operators` times "
        "checked steps.",
    ),
    (
        "rivals",
        "without a reduced step: nothing moves; the training run of the nearest parameters, its latent "
        "vectors decoded by the same fields; latent vectors interpolated over the parameters between "
        "training runs, of one parameter linearly, and constant outside. Coarse full order is "
        "the full-order solver on a coarser grid.",
    ),
    (
        "runs until it pays",
        "reduced runs, without decoding and without checks, that save as much time as training and teaching "
        "took; training runs are not counted.",
    ),
    ("handed on", "share of steps that operators left to projected ones, or these to the full-order solver."),
)


@dataclass(frozen=True)
class Picture:
    """One picture: its files (html shows the first, markdown the last), caption, and the runs it shows."""

    files: list[str]
    caption: str
    runs: list[str]


@dataclass(frozen=True)
class Section:
    """Pictures under one heading; `key` says what they are made of, empty where they are always drawn."""

    heading: str
    pictures: list[Picture] = field(default_factory=list)
    key: str = ""


@dataclass(frozen=True)
class Table:
    """A table under a heading, and a note on it."""

    heading: str
    content: Rows
    note: str


@dataclass(frozen=True)
class Page:
    """Everything a report says, in the order it is said."""

    title: str
    lead: str
    facts: Sequence[tuple[str, str]]
    warnings: Sequence[str]
    tables: Sequence[Table]
    sections: Sequence[Section]
    provenance: Table
    definitions: Sequence[tuple[str, str]] = DEFINITIONS


def html_page(page: Page) -> str:
    """The page with its style inside and its pictures beside it."""
    return HTML.get_template("report.html").render(vars(page))


def markdown_page(page: Page) -> str:
    """The same page for GitHub."""
    return markdown_document("report.md", **vars(page))
