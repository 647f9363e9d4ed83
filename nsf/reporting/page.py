"""The report's page, once as HTML that opens from a disk and once as markdown for GitHub."""

import html
from dataclasses import dataclass, field

import pandas as pd

from nsf.reporting.pictures import Section
from nsf.reporting.tables import html_rows, html_table, markdown_rows, markdown_table

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
        "(C = 0), neural_affine_only the affine momentum alone (τ from ∂g/∂X), deformation_only neither.",
    ),
    ("speedup", "full-order over reduced wall time, of one step and of the whole simulation."),
)

CSS = """
:root { color-scheme: light dark;
  --ink: #1d1d1f; --muted: #5f6368; --line: #d9dce0; --page: #fff; --band: #f5f6f8; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e8e8ea; --muted: #a3a8ae; --line: #3a3d42; --page: #17181a; --band: #212327; }
}
body { margin: 0; background: var(--page); color: var(--ink);
  font: 16px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
main { max-width: 1200px; margin: 0 auto; padding: 2.5rem 1.5rem 4rem; }
h1 { font-size: 1.9rem; line-height: 1.2; margin: 0 0 .6rem; }
h2 { font-size: 1.3rem; margin: 2.6rem 0 .7rem; padding-top: .9rem; border-top: 1px solid var(--line); }
p { max-width: 46rem; margin: .5rem 0; }
p.note, figcaption, dd { color: var(--muted); font-size: .92rem; }
dl { display: grid; grid-template-columns: max-content 1fr; gap: .25rem 1.2rem; margin: 1rem 0; }
dt { font-weight: 600; } dd { margin: 0; } dl.facts dd { color: var(--ink); font-size: 1rem; }
.table { overflow-x: auto; margin: .8rem 0; }
table { border-collapse: collapse; font-size: .84rem; font-variant-numeric: tabular-nums; }
th, td { padding: .36rem .55rem; border-bottom: 1px solid var(--line); vertical-align: bottom; }
th { text-align: left; line-height: 1.25; background: var(--band); font-weight: 600; }
td { white-space: nowrap; } td.text:last-child { white-space: normal; } .number { text-align: right; }
tbody tr:hover { background: var(--band); }
figure { margin: 1.6rem 0 2.2rem; }
figure img { display: block; max-width: 100%; height: auto; box-sizing: border-box; background: #fff;
  border: 1px solid var(--line); border-radius: 6px; padding: .5rem; }
figcaption { margin-top: .5rem; max-width: 46rem; }
a { color: inherit; }
@media (max-width: 600px) { dl { grid-template-columns: 1fr; } dd { margin-bottom: .4rem; } }
"""


@dataclass(frozen=True)
class Rows:
    """A table that is already text."""

    headings: list[str]
    body: list[list[str]]


@dataclass(frozen=True)
class Table:
    """A table under a heading: a frame with the columns of results, or ready text; and a note on it."""

    heading: str
    content: pd.DataFrame | Rows
    note: str
    renamed: dict[str, str] = field(default_factory=dict)  # headings of columns this page calls otherwise


@dataclass(frozen=True)
class Page:
    """Everything a report says, in the order it is said."""

    title: str
    lead: str
    facts: list[tuple[str, str]]
    tables: list[Table]
    sections: list[Section]
    provenance: Table


def html_page(page: Page) -> str:
    """The page with its style inside and its pictures beside it."""
    parts = [f"<h1>{_esc(page.title)}</h1>", f"<p>{_esc(page.lead)}</p>", _html_terms(page.facts, "facts")]
    parts += [_html_section(table) for table in page.tables]
    parts.append(_html_terms(DEFINITIONS, "definitions"))
    for section in page.sections:
        parts.append(f"<h2>{_esc(section.heading)}</h2>")
        parts += [
            f'<figure><img src="{_esc(picture.files[0])}" alt="{_esc(picture.caption)}" loading="lazy">'
            f"<figcaption>{_esc(picture.caption)}</figcaption></figure>"
            for picture in section.pictures
        ]
    parts.append(_html_section(page.provenance))
    body = "\n".join(parts)
    return (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_esc(page.title)}</title>\n<style>{CSS}</style>\n</head>\n<body>\n<main>\n{body}\n</main>\n"
        "</body>\n</html>\n"
    )


def markdown_page(page: Page) -> str:
    """The same page for GitHub."""
    parts = [f"# {page.title}", page.lead, _markdown_terms(page.facts)]
    parts += [_markdown_section(table) for table in page.tables]
    parts.append(_markdown_terms(DEFINITIONS))
    for section in page.sections:
        parts.append(f"## {section.heading}")
        parts += [
            f"![{picture.caption}]({picture.files[-1]})\n\n{picture.caption}" for picture in section.pictures
        ]
    parts.append(_markdown_section(page.provenance))
    return "\n\n".join(parts) + "\n"


def _html_section(table: Table) -> str:
    content = table.content
    if isinstance(content, Rows):
        drawn = html_rows(content.headings, content.body, [False] * len(content.headings))
    else:
        drawn = html_table(content, table.renamed)
    return f'<h2>{_esc(table.heading)}</h2>\n{drawn}\n<p class="note">{_esc(table.note)}</p>'


def _markdown_section(table: Table) -> str:
    content = table.content
    if isinstance(content, Rows):
        drawn = markdown_rows(content.headings, content.body, [False] * len(content.headings))
    else:
        drawn = markdown_table(content, table.renamed)
    return f"## {table.heading}\n\n{drawn}\n\n{table.note}"


def _html_terms(terms, kind: str) -> str:
    inner = "".join(f"<dt>{_esc(term)}</dt><dd>{_esc(text)}</dd>" for term, text in terms)
    return f'<dl class="{kind}">{inner}</dl>'


def _markdown_terms(terms) -> str:
    return "\n".join(f"- **{term}**: {text}" for term, text in terms)


_esc = html.escape
