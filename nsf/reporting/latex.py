"""Tables for a paper: LaTeX with booktabs, to be read with `\\input`."""

import re

import pandas as pd

from nsf.reporting.tables import cells, is_numeric

_TEX = {
    "\\": r"\textbackslash{}", "{": r"\{", "}": r"\}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}",
    "|": r"\textbar{}", "<": r"\textless{}", ">": r"\textgreater{}", "–": "--", "°": r"$^\circ$",
    "×": r"$\times$", "·": r"$\cdot$", "∞": r"$\infty$", "‖": r"$\|$", "²": "$^2$", "³": "$^3$",
    "α": r"$\alpha$", "β": r"$\beta$", "γ": r"$\gamma$", "δ": r"$\delta$", "η": r"$\eta$", "θ": r"$\theta$",
    "μ": r"$\mu$", "ν": r"$\nu$", "ξ": r"$\xi$", "τ": r"$\tau$", "φ": r"$\phi$", "Δ": r"$\Delta$",
} | {sign: f"\\{sign}" for sign in "#$%&_"}  # fmt: skip
_SPECIAL = re.compile("|".join(map(re.escape, _TEX)))


def latex_table(frame: pd.DataFrame, title: str, note: str) -> str:
    """A `tabular` with units in its headings; title and note stand above it as comments."""
    headings, body = cells(frame)
    columns = "".join("r" if right else "l" for right in is_numeric(frame))
    lines = [" & ".join(map(escaped, row)) + r" \\" for row in (headings, *body)]
    return "\n".join(
        [
            f"% {title}. Generated with the report; needs \\usepackage{{booktabs}}.",
            *([f"% {note}"] if note else []),
            f"\\begin{{tabular}}{{{columns}}}",
            r"\toprule",
            lines[0],
            r"\midrule",
            *lines[1:],
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


def escaped(text: str) -> str:
    """Text as LaTeX prints it."""
    return _SPECIAL.sub(lambda found: _TEX[found.group()], text)
