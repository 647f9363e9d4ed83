"""Text on a terminal that cannot show all of it."""

import sys


def replace_what_cannot_be_shown() -> None:
    """Let standard output and error show `?` for a character that their encoding lacks."""
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="replace")
