"""Reports: pages, tables, charts and pictures made from evaluate runs.

Reads manifests and the files of `evaluate` runs and nothing else; every number on a page comes from
one of them.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from nsf.reporting.build import build_report
    from nsf.reporting.tables import console_table, merge_results
    from nsf.reporting.text.columns import COLUMNS

__all__ = ["COLUMNS", "build_report", "console_table", "merge_results"]

_HOMES = {
    "COLUMNS": "text.columns",
    "build_report": "build",
    "console_table": "tables",
    "merge_results": "tables",
}


def __getattr__(name: str):
    # On demand, so that `nsf runs` does not wait for pandas and matplotlib.
    if name in _HOMES:
        return getattr(importlib.import_module(f"nsf.reporting.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'nsf.reporting' has no attribute {name!r}")
