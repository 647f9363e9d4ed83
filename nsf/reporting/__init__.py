"""Reports: pages, tables, charts and pictures made from evaluate runs.

Reads manifests and the files of `evaluate` runs and nothing else; every number on a page comes from
one of them.
"""

from nsf.reporting.build import build_report
from nsf.reporting.tables import COLUMNS, console_table, merge_results

__all__ = ["COLUMNS", "build_report", "console_table", "merge_results"]
