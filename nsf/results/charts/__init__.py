"""The charts of a report: each is one function of its table.

A chart takes a `View` and gives figures by the name of their file, or none where the table holds nothing of
its kind. A new one is one function below `@chart(caption)` in a module of this package; pages, `nsf reports`
and `plots` of an experiment's yaml know it by its name from then on.
"""

from importlib import import_module

from nsf.results.charts.view import CHARTS, Chart, Figures, View, best, chart

__all__ = ["CHARTS", "Chart", "Figures", "View", "best", "chart"]

# In the order in which a page shows their charts.
for _module in ("errors", "costs", "frames", "cases", "bounds"):
    import_module(f"{__name__}.{_module}")
