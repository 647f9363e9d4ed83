"""Everything that nsf prints: a terminal shows it, and obeys none of it.

Names, units, keys and messages may come from files of strangers, and a terminal takes some characters for
commands. So standard output and error let visible characters through alone; tables and progress bars, whose
colours and moves are nsf's, are printed by `console`, which holds their texts to the same.
"""

import os
import re
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console

#: For regular expressions: control characters, line ends, changes of direction, and what no UTF-8 file holds.
INVISIBLE = "\x00-\x1f\x7f-\x9f\u2028\u2029\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff"
_UNCUT = 10_000  # characters of a line that no terminal shows
_OBEYED = re.compile(f"(?![\n\t])[{INVISIBLE}]")


def visible(text: str) -> str:
    """Text with `?` for what a terminal might obey; tabs and line ends stay."""
    return _OBEYED.sub("?", text)


class _Visible:
    """A stream that shows visible characters alone, and is in all else the one that it writes to."""

    def __init__(self, stream: TextIO):
        self.stream = stream

    def __getattr__(self, name: str):
        return getattr(self.stream, name)

    def write(self, text: str) -> int:
        self.stream.write(visible(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)


def guard() -> None:
    """Let what this process prints be shown and never obeyed, with `?` for what the encoding lacks."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
        if stream is not None and not isinstance(stream, _Visible):
            setattr(sys, name, _Visible(stream))


def screen() -> "Console":
    """A console on standard output, as wide as the terminal or COLUMNS says; of any width without both."""
    wide = sys.stdout.isatty() or "COLUMNS" in os.environ
    return console(sys.stdout, None if wide else _UNCUT)


def console(stream: TextIO, width: int | None = None) -> "Console":
    """A console for tables and progress bars on a stream, standard output or error.

    Args:
        stream: as it is in `sys`.
        width: [characters]; the terminal's by default.
    """
    from rich.console import Console  # 0.1 s that `nsf --help` need not pay
    from rich.segment import Segment
    from typing_extensions import override

    class OfVisible(Console):
        @override
        def render(self, renderable, options=None):
            for text, style, control in super().render(renderable, options):
                yield Segment(text if control else visible(text), style, control)

    return OfVisible(file=stream.stream if isinstance(stream, _Visible) else stream, width=width)
