"""Docstrings as Markdown: in `x [P, 3] [m]` shape and unit are no link."""

import re

import griffe

ADJACENT = re.compile(r"\]\s+\[")


class Brackets(griffe.Extension):
    """Puts a word joiner between brackets that follow one another, so that Markdown takes them for text."""

    def on_object(self, *, obj, **kwargs) -> None:
        """A module, class, function or attribute was read."""
        if obj.docstring:
            obj.docstring.value = ADJACENT.sub("]\u2060 [", obj.docstring.value)
