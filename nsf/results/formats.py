"""How text is written in each format: HTML, Markdown, LaTeX, spreadsheets, terminals, addresses, file names.

Titles, names, units, paths and errors come from files that anyone may have written. Templates escape every
value for their own format; no other module writes a format by hand.
"""

import re
from dataclasses import dataclass
from urllib.parse import quote

import rich.box
import rich.markup
import rich.table
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from nsf.terminal import INVISIBLE

_INVISIBLE = re.compile(f"[{INVISIBLE}]+")
_MARKDOWN = re.compile(
    r"(?P<code>`[^`]+`)"
    r"|(?P<unit>(?!\A)\[(?:[^\W_]|[ %×°/–.-])+\](?![(\[:]))"  # followed by these it would be a link
    r"|(?P<entity>[<>]|&(?=#?\w+;))"
    r"|(?P<sign>[\\`*~$|\[\]]|(?<![^\W_])_|_(?![^\W_])|\A(?:#|=|[-+](?=[\s-]|\Z)))"
    r"|(?P<number>\A\d+(?=[.)](?:\s|\Z)))"
)
_TEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "|": r"\textbar{}", "<": r"\textless{}", ">": r"\textgreater{}", "–": "--", "°": r"$^\circ$",
    "×": r"$\times$", "·": r"$\cdot$", "∞": r"$\infty$", "‖": r"$\|$", "²": "$^2$", "³": "$^3$",
    "α": r"$\alpha$", "β": r"$\beta$", "γ": r"$\gamma$", "δ": r"$\delta$", "η": r"$\eta$", "θ": r"$\theta$",
    "μ": r"$\mu$", "ν": r"$\nu$", "ξ": r"$\xi$", "τ": r"$\tau$", "φ": r"$\phi$", "Δ": r"$\Delta$",
} | {sign: f"\\{sign}" for sign in "#$%&_"}  # fmt: skip
_SPECIAL = re.compile(r"\A\s*[\[*]|" + "|".join(map(re.escape, _TEX)))
_FORMULA = re.compile(r"[=+\-@\t\r]")


_EDGES = 2  # characters about a column of a terminal


@dataclass(frozen=True)
class Rows:
    """A table as text: a heading a column, and whether the column is of numbers, which align to the right."""

    headings: list[str]
    body: list[list[str]]
    numeric: list[bool]


def plain(text) -> str:
    """Text on one line, without what a reader cannot see."""
    return _INVISIBLE.sub(" ", str(text))


def markdown(text) -> str:
    """Text as Markdown shows it; what stands between backticks is shown as code."""

    def written(part: re.Match) -> str:
        match part.lastgroup:
            case "code":
                return part[0].replace("|", r"\|")
            case "entity":
                return str(escape(part[0]))
            case "sign":
                return f"\\{part[0]}"
            case "number":
                return f"{part[0]}\\"
        return part[0]

    return _MARKDOWN.sub(written, plain(text))


def latex(text) -> str:
    """Text as LaTeX prints it, in a cell or a comment."""
    # A row that begins with one of these would be read as the argument of the line end before it.
    return _SPECIAL.sub(lambda sign: _TEX.get(sign[0], f"{{{sign[0]}}}"), plain(text))


def terminal(text) -> str:
    """Text as rich prints it."""
    return rich.markup.escape(plain(text))


def spreadsheet(value):
    """A cell of a csv; text that a spreadsheet would compute begins with an apostrophe."""
    if not isinstance(value, str) or not _FORMULA.match(value):
        return value
    try:
        float(value)
    except ValueError:
        return f"'{value}"
    return value


def file_name(text) -> str:
    """Text as a part of a file's name: letters, digits, `_` and `-`."""
    return re.sub(r"[^\w-]+", "-", plain(text), flags=re.ASCII)


def address(path) -> Markup:
    """A relative path as an address of HTML and Markdown."""
    return Markup(quote(str(path), errors="replace"))


def _environment(write, **signs) -> Environment:
    """Templates of a format, whose values `write` escapes."""
    environment = Environment(
        loader=PackageLoader("nsf.results"), undefined=StrictUndefined, autoescape=True,
        finalize=lambda value: value if hasattr(value, "__html__") else Markup(write(value)),
        trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True, **signs,
    )  # fmt: skip
    environment.filters["url"] = address
    return environment


HTML = _environment(lambda text: escape(plain(text)))
MARKDOWN = _environment(markdown)
LATEX = _environment(
    latex, variable_start_string="<<", variable_end_string=">>",
    block_start_string="<%", block_end_string="%>", comment_start_string="<#", comment_end_string="#>",
)  # fmt: skip


def markdown_document(template: str, **values) -> str:
    """A whole file from a template."""
    return MARKDOWN.get_template(template).render(values).rstrip("\n") + "\n"


def latex_table(rows: Rows, title: str, note: str) -> str:
    """A `tabular` with units in its headings; title and note stand above it as comments."""
    return LATEX.get_template("table.tex").render(rows=rows, title=title, note=note)


@dataclass(frozen=True)
class TerminalTable:
    """A table for rich to print, with the columns that a terminal has room for; the others are named below.

    Headings and words are broken into lines, numbers never are.
    """

    rows: Rows
    caption: str = ""

    def __rich_console__(self, console, options):
        """The table, in `options.max_width` characters."""
        widths = _widths(self.rows, options.max_width - _EDGES)
        table = rich.table.Table(box=rich.box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for at, width in widths.items():
            place = {"justify": "right" if self.rows.numeric[at] else "left", "overflow": "fold"}
            table.add_column(terminal(self.rows.headings[at]), width=width, **place)
        for texts in self.rows.body:
            table.add_row(*(terminal(texts[at]) for at in widths))
        yield table
        hidden = [heading for at, heading in enumerate(self.rows.headings) if at not in widths]
        lines = [self.caption, f"Hidden for want of width: {', '.join(hidden)}" if hidden else ""]
        yield from map(terminal, filter(None, lines))


def _widths(rows: Rows, room: int) -> dict[int, int]:
    """Characters of the columns that fit into a room, by index: at least of their longest word or number."""
    cells = [[row[at] for row in rows.body] for at in range(len(rows.headings))]
    longest = [max(map(len, of), default=1) for of in cells]
    words = [
        max(map(len, [*heading.split(), *(of if right else " ".join(of).split())]))
        for heading, of, right in zip(rows.headings, cells, rows.numeric, strict=True)
    ]
    widths: dict[int, int] = {}
    for at, width in enumerate(words):
        if width + _EDGES <= room or not widths:
            widths[at] = width
            room -= width + _EDGES
    for at in sorted(widths, key=lambda at: not rows.numeric[at]):
        more = min(max(longest[at] - widths[at], 0), max(room, 0))
        widths[at] += more
        room -= more
    return widths
