"""The table of results, and the charts and pages made of it.

`read` gives the table of a file as a data frame, `query` rows of it, `labelled` and `means` what pages show.
"""

from typing import TYPE_CHECKING

from nsf.extras import on_first_use

if TYPE_CHECKING:
    from nsf.results.averages import means
    from nsf.results.columns import COLUMNS
    from nsf.results.table import labelled, query, read

__all__ = ["COLUMNS", "labelled", "means", "query", "read"]

# On demand, so that `nsf runs` does not wait for pandas and matplotlib.
__getattr__ = on_first_use(__name__)
