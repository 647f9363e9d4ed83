"""Reports: pages, tables, charts and pictures made from evaluate runs.

Reads manifests and the files of `evaluate` runs and nothing else; every number on a page comes from
one of them.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.reporting.build import build_report
    from nsf.reporting.tables import console_table, merge_results
    from nsf.reporting.text.columns import COLUMNS

__all__ = ["COLUMNS", "build_report", "console_table", "merge_results"]

# On demand, so that `nsf runs` does not wait for pandas and matplotlib.
__getattr__ = on_first_use(__name__)
