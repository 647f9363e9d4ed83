"""Charts over time: errors and latent coordinates, frame by frame."""

import pandas as pd
from matplotlib.ticker import MaxNLocator

from nsf.results.charts.drawing import finite, line, styles
from nsf.results.charts.view import Figures, View, best_series, chart
from nsf.results.columns import axis, column
from nsf.results.style import error_scale, legend, panels
from nsf.results.table import parameter

_DASHED = (0, (2, 1.6))
_OVER_TIME = ("delta", "displacement_error", "stress_error")


@chart(
    "Errors of held-out cases frame by frame, of the best variant of each model. Dashed: δ of the full-order "
    "frames encoded and decoded, which the fields alone explain. The displacement error divides by the "
    "distance moved, so it starts high."
)
def error_over_time(view: View) -> Figures:
    """δ, displacement and stress errors [%] over time [s], a figure a body and model."""
    figures = {}
    for stem, series in best_series(view):
        shown = [name for name in _OVER_TIME if name in series and series[name].notna().any()]
        fig, drawn = panels(len(shown), 2.9, 3)
        for panel, name in zip(drawn, shown, strict=True):
            _frames(panel, series, name, "reconstruction_delta" if name == "delta" else "", scale=100)
            panel.set(xlabel="time t [s]", ylabel=axis(column(name).title, "%"))
            error_scale(panel, 100 * series[name], hidden=0.02)
            panel.set_xlim(-0.01 * series["t"].max(), 1.01 * series["t"].max())
            panel.xaxis.set_major_locator(MaxNLocator(5))
        legend(fig, axis(*parameter(series["case"].iloc[0])))
        figures[f"{stem}error-over-time"] = fig
    return figures


@chart("The latent path of a run (solid) and of the full-order frames through the encoder (dashed).")
def latent(view: View) -> Figures:
    """Latent coordinates over time, a figure a body and model."""
    figures = {}
    for stem, series in best_series(view):
        r = sum(name.startswith("xhat_") and series[name].notna().any() for name in series)
        if not r:
            continue
        fig, drawn = panels(r, 2.1, 3, sharex=True)
        for k, panel in enumerate(drawn, start=1):
            _frames(panel, series, f"xhat_{k}", f"encoded_{k}", lw=2.4)
            panel.set(ylabel=f"x̂{chr(0x2080 + k) if k < 10 else k} [–]", xlabel="t [s]")
            panel.locator_params(nbins=4)
            panel.grid()
        legend(fig, axis(*parameter(series["case"].iloc[0])))
        figures[f"{stem}latent"] = fig
    return figures


def _frames(panel, series: pd.DataFrame, name: str, dashed: str, scale: float = 1.0, **width) -> None:
    """A column over time, a line a case, and another one dashed, where the series has it."""
    drawn = styles(series, "case")
    for case, part in series.groupby("case", sort=False):
        text = case.partition("=")[2] if case.count("=") == 1 else case
        style = line(drawn[case]) | {"label": text}
        panel.plot(part["t"], finite(scale * part[name]), **style)
        if dashed in part:
            faint = {"color": style["color"], "ls": _DASHED, "alpha": 0.5, **width}
            panel.plot(part["t"], scale * part[dashed], **faint)
