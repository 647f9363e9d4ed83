"""Runs at drawn parameters: quantiles over time, sensitivities, and a posterior."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from nsf.data import PROGRAM, Trajectory
from nsf.data.schema import TRAJECTORY
from nsf.inverse.fit import fit
from nsf.inverse.model import Model
from nsf.inverse.observations import View
from nsf.inverse.posterior import posterior
from nsf.inverse.reports.calibration import warnings_of
from nsf.inverse.reports.charts import bands_chart, indices_chart, posterior_chart
from nsf.inverse.reports.page import Chart, Results, frame_table, named, title_of, write
from nsf.inverse.sampling import LEVELS, Prior, Scalars, runs, sensitivities
from nsf.inverse.space import Space
from nsf.runs import Run

_LEAD = "Runs by recurrence at parameters that are drawn from stated distributions."
_TERMS = (
    ("distrusted", "runs that are not to be believed; no quantile counts them (docs/method.md, Trust)."),
    ("first order, total", "share of the variance that a parameter makes alone, and with all others."),
    ("posterior", "the parameters given the observations, the reduced model's own error included."),
)
_INDICES = (
    "Shares of the variance at the end that each parameter makes over its stated distribution, "
    "whatever was observed, distrusted runs among them, with 95 % intervals."
)
_DRAWS = 4000


def report(
    model: Model,
    prior: Prior,
    scalars: Scalars,
    folder: Path,
    *,
    count: int = 10_000,
    indices: int = 0,
    full_order: int = 0,
    view: View | None = None,
    program: int | None = None,
    seed: int = 0,
    say: Callable[[str], object] = print,
) -> Path:
    """Draw, run, and write `quantiles.csv`, `runs.csv.gz`, and what else is asked for.

    Args:
        model, prior, scalars: of the runs.
        folder: of the page.
        count: runs.
        indices: base of the design of sensitivities, a power of two; 0 for none.
        full_order: base of a design of full-order runs beside it; 0 for none.
        view: of observations, for a posterior.
        program: number of the program that all runs follow, where the scene has programs.
        seed: of everything that is drawn.
        say: told what is done.
    """
    forcing = None if program is None else model.forcing(program=program)
    files, tables, charts, warnings, hidden = {}, [], [], [], []
    if view is None:
        drawn = prior.draw(count, seed)
    else:
        best = fit(view, model, Space.of(model), forcing=forcing)
        given = posterior(prior, view, best, _DRAWS, forcing, seed)
        warnings = warnings_of(best, view.observations) + ([given.warning] if given.warning else [])
        say(f"sample: posterior given {len(view.observations)} observations: {given.told}")
        drawn = given.values[np.random.default_rng(seed).integers(0, len(given.values), count)]
        names = [named(model, name) for name in model.names]
        files["posterior.csv"] = pd.DataFrame(given.values, columns=list(model.names))
        tables.append(frame_table("Posterior", _moments(files["posterior.csv"], names), f"{given.told}."))
        draw = posterior_chart, given.values, names
        charts.append(Chart("Posterior", "posterior", "Draws of the posterior.", lambda: draw[0](*draw[1:])))
    made = runs(model, drawn, scalars, forcing)
    lost = int((~made.trusted).sum())
    say(f"sample: {count:,} runs in {made.seconds:.2f} s, {lost:,} of them distrusted")
    bands = made.quantiles()
    files = {"quantiles.csv": _quantiles(scalars, bands), "runs.csv.gz": _each(model, made)} | files
    note = f"{count:,} runs, {lost:,} of them distrusted and left out."
    tables.insert(0, frame_table("At the end", _ends(bands), note))
    heading, caption = "Quantiles over time", "Quantiles of trusted runs over time."
    charts.insert(0, Chart(heading, "quantiles", caption, lambda: bands_chart(scalars.t, bands, LEVELS)))
    if indices:
        table, hidden = _indices(model, prior, scalars, indices, full_order, program, seed, say)
        files["sensitivities.csv"] = table
        shown = table.rename(columns=lambda name: name.replace("_", " "))
        shown[shown.columns[2:]] = shown[shown.columns[2:]].map("{:.3f}".format)
        note = _designs(indices, full_order, prior)
        tables.insert(0, frame_table("Sensitivities at the end", shown, note, text=2))
        charts.insert(0, Chart("Sensitivities", "sensitivities", _INDICES, lambda: indices_chart(table)))
    for warning in warnings:
        say(f"sample: warning: {warning}")
    results = Results(
        title=f"{title_of(model)}: sampling",
        lead=_LEAD,
        models=[model],
        hidden=hidden,
        tables=tables,
        files=files,
        charts=charts,
        facts=[("Runs", f"{count:,} in {made.seconds:.2f} s"), ("Distrusted", f"{lost:,}")],
        definitions=_TERMS,
        warnings=warnings,
        asked={"count": count, "of": scalars.names, "seed": seed, "sensitivities": indices}
        | ({} if program is None else {"program": program}),
    )
    return write(results, folder)


def _indices(
    model: Model,
    prior: Prior,
    scalars: Scalars,
    count: int,
    full_order: int,
    program: int | None,
    seed: int,
    say,
) -> tuple[pd.DataFrame, list[Run]]:
    """Indices at the last time by recurrence, and by full-order runs of a smaller design of the same kind."""
    forcing = None if program is None else model.forcing(program=program)
    more = {} if program is None else {PROGRAM: program}
    made: list[Run] = []

    def by_recurrence(values: np.ndarray) -> np.ndarray:
        return runs(model, values, scalars, forcing).values[..., -1]

    def by_full_order(values: np.ndarray) -> np.ndarray:
        rows = [dict(zip(model.names, row, strict=True)) for row in values.tolist()]
        made.extend(model.pipeline.full_order([model.scene.case(row | more) for row in rows]))
        seen = []
        for run in made:
            with Trajectory.open(run.file(TRAJECTORY)) as truth:
                seen.append(scalars.of_truth(truth))
        return np.array(seen)

    table = sensitivities(prior, count, by_recurrence, scalars.names, seed)
    if not full_order:
        return table, []
    for kind, evaluate in (("same_design", by_recurrence), ("full_order", by_full_order)):
        smaller = sensitivities(prior, full_order, evaluate, scalars.names, seed)
        table = table.assign(**{f"{order}_{kind}": smaller[order] for order in ("first", "total")})
    say(f"sample: sensitivities beside {len(made)} full-order runs")
    orders = [f"{order}_{kind}" for order in ("first", "total") for kind in ("same_design", "full_order")]
    return table[[*table.columns[:6], *orders]], made


def _designs(count: int, full_order: int, prior: Prior) -> str:
    of = max(2, len(prior.each)) + 2
    beside = f"; beside it {full_order * of:,} full-order runs, and runs by recurrence of the same design"
    return f"Saltelli's design of {count * of:,} runs{beside if full_order else ''}."


def _each(model: Model, made) -> pd.DataFrame:
    """A row a run: its parameters, values at the end and distrust, with six digits."""
    rows = pd.DataFrame(made.parameters, columns=list(model.names))
    for k, name in enumerate(made.names):
        rows[name] = made.values[:, k, -1]
    return rows.assign(distrust=made.distrust).map(lambda value: float(f"{value:.6g}"))


def _quantiles(scalars: Scalars, bands: dict[str, np.ndarray]) -> pd.DataFrame:
    columns = [f"q{100 * level:g}" for level in LEVELS]
    parts = {name: pd.DataFrame(values.T, columns=columns) for name, values in bands.items()}
    for name, part in parts.items():
        part.insert(0, "quantity", name)
        part.insert(1, "t", scalars.t)
    return pd.concat(parts.values(), ignore_index=True)


def _ends(bands: dict[str, np.ndarray]) -> pd.DataFrame:
    heads = [f"{100 * level:g} % [mm]" for level in LEVELS]
    rows = [[name, *(1e3 * values[:, -1])] for name, values in bands.items()]
    return pd.DataFrame(rows, columns=["quantity", *heads])


def _moments(draws: pd.DataFrame, names: list[str]) -> pd.DataFrame:
    ends = draws.quantile([0.05, 0.95]).map("{:.5g}".format)
    return pd.DataFrame(
        {
            "parameter": names,
            "mean": draws.mean().map("{:.5g}".format).to_numpy(),
            "deviation": draws.std(ddof=0).to_numpy(),
            "5 %": ends.iloc[0].to_numpy(),
            "95 %": ends.iloc[1].to_numpy(),
        }
    )
