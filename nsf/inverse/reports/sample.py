"""Runs at drawn parameters: quantiles over time, sensitivities, and a posterior."""

from collections.abc import Callable

import numpy as np
import pandas as pd

from nsf.data import Trajectory
from nsf.inverse.fit import fit
from nsf.inverse.observations import View
from nsf.inverse.reports.calibration import warnings_of
from nsf.inverse.reports.charts import bands_chart, indices_chart, posterior_chart
from nsf.inverse.reports.page import Chart, Problem, Results, frame_table, named, title_of
from nsf.inverse.sampling import LEVELS, Posterior, Prior, Runs, Scalars, posterior, runs, sensitivities
from nsf.inverse.space import Space
from nsf.runs import Run

_LEAD = "Runs by recurrence at parameters that are drawn from stated distributions."
_TERMS = (
    (
        "distrusted",
        "runs whose error bound passes trust.limit; no quantile counts them (docs/method.md, Trust).",
    ),
    ("first order, total", "share of the variance that a parameter makes alone, and with all others."),
    ("posterior", "the parameters given the observations, the reduced model's own error included."),
)
_INDICES = (
    "Shares of the variance at the end that each parameter makes over its stated distribution, "
    "whatever was observed, distrusted runs among them, with 95 % intervals."
)
_DRAWS = 4000


def sampling(
    problem: Problem,
    prior: Prior,
    scalars: Scalars,
    count: int = 10_000,
    indices: int = 0,
    full_order: int = 0,
    view: View | None = None,
    seed: int = 0,
    say: Callable[[str], object] = print,
) -> Results:
    """Draw and run.

    Args:
        problem: the model, and the program that all runs follow.
        prior, scalars: of the runs.
        count: runs.
        indices: base of the design of sensitivities, a power of two; 0 for none.
        full_order: base of a design of full-order runs; 0 for none.
        view: of observations, for a posterior.
        seed: of everything that is drawn.
        say: called with a line of what is done.

    Returns:
        A page with `quantiles.csv`, `runs.csv.gz`, `sensitivities.csv` and `posterior.csv`.
    """
    model, warnings, files, tables, charts, simulated = problem.model, [], {}, [], [], []
    chain = None
    if view is None:
        drawn = prior.draw(count, seed)
    else:
        best = fit(view, model, Space.of(model), forcing=problem.forcing)
        chain = posterior(prior, view, best, _DRAWS, problem.forcing, seed)
        warnings = [*warnings_of(best, view.observations), *chain.warnings]
        say(f"sample: posterior given {len(view.observations)} observations: {chain.text}")
        drawn = chain.values[np.random.default_rng(seed).integers(0, len(chain.values), count)]
    made = runs(model, drawn, scalars, problem.forcing)
    bands = made.quantiles()
    say(f"sample: {count:,} runs in {made.seconds:.2f} s, {made.doubts}")
    if np.isnan(made.error_bound).any():
        warnings = [*warnings, f"runs {made.doubts}"]
    if indices:
        table, simulated = _indices(problem, prior, scalars, indices, full_order, seed, say)
        files["sensitivities.csv"] = table
        shown = table.rename(columns=lambda name: name.replace("_", " "))
        shown[shown.columns[2:]] = shown[shown.columns[2:]].map("{:.3f}".format)
        note = _designs(indices, full_order, prior)
        tables.append(frame_table("Sensitivities at the end", shown, note, text=2))
        charts.append(Chart("Sensitivities", "sensitivities", _INDICES, indices_chart(table)))
    files |= {"quantiles.csv": _quantiles(scalars, bands), "runs.csv.gz": _each(problem, made)}
    note = f"{count:,} runs, {made.doubts}."
    tables.append(frame_table("At the end", _ends(bands), note))
    caption = "Quantiles of trusted runs over time."
    charts.append(Chart("Quantiles over time", "quantiles", caption, bands_chart(scalars.t, bands, LEVELS)))
    if chain is not None:
        names = [named(model, name) for name in model.names]
        files["posterior.csv"] = pd.DataFrame(chain.values, columns=list(model.names))
        tables.append(frame_table("Posterior", _moments(chain, names), f"{chain.text}."))
        drawing = posterior_chart(chain.values, names)
        charts.append(Chart("Posterior", "posterior", "Draws of the posterior.", drawing))
    return Results(
        title=f"{title_of(model)}: sampling",
        lead=_LEAD,
        models=[model],
        runs=simulated,
        tables=tables,
        files=files,
        charts=charts,
        facts=[("Runs", f"{count:,} in {made.seconds:.2f} s"), ("Error bounds", made.doubts)],
        definitions=_TERMS,
        warnings=warnings,
        settings={"count": count, "of": scalars.names, "seed": seed, "sensitivities": indices}
        | ({} if problem.program is None else {"program": problem.program}),
    )


def _indices(
    problem: Problem, prior: Prior, scalars: Scalars, count: int, full_order: int, seed: int, say
) -> tuple[pd.DataFrame, list[Run]]:
    """Indices at the last time by recurrence, and by full-order runs of a smaller design of the same kind."""
    simulated: list[Run] = []

    def by_recurrence(values: np.ndarray) -> np.ndarray:
        return runs(problem.model, values, scalars, problem.forcing).values[..., -1]

    def by_full_order(values: np.ndarray) -> np.ndarray:
        rows = [dict(zip(problem.model.names, row, strict=True)) for row in values.tolist()]
        simulated.extend(problem.full_order(rows))
        seen = []
        for run in simulated:
            with Trajectory.of(run) as truth:
                seen.append(scalars.of_truth(truth))
        return np.array(seen)

    table = sensitivities(prior, count, by_recurrence, scalars.names, seed)
    if full_order:
        of = {"same_design": by_recurrence, "full_order": by_full_order}
        smaller = {kind: sensitivities(prior, full_order, by, scalars.names, seed) for kind, by in of.items()}
        for order in ("first", "total"):
            for kind, indices in smaller.items():
                table[f"{order}_{kind}"] = indices[order]
        say(f"sample: sensitivities beside {len(simulated)} full-order runs")
    return table, simulated


def _designs(count: int, full_order: int, prior: Prior) -> str:
    of = max(2, len(prior.each)) + 2
    beside = f"; beside it {full_order * of:,} full-order runs, and runs by recurrence of the same design"
    return f"Saltelli's design of {count * of:,} runs{beside if full_order else ''}."


def _each(problem: Problem, made: Runs) -> pd.DataFrame:
    """A row a run: its parameters, values at the end and error bound, with six digits."""
    rows = pd.DataFrame(made.parameters, columns=list(problem.model.names))
    for k, name in enumerate(made.names):
        rows[name] = made.values[:, k, -1]
    return rows.assign(error_bound=made.error_bound).map(lambda value: float(f"{value:.6g}"))


def _quantiles(scalars: Scalars, bands: dict[str, np.ndarray]) -> pd.DataFrame:
    """A row a quantity and time."""
    columns = [f"q{100 * level:g}" for level in LEVELS]
    parts = {name: pd.DataFrame(values.T, scalars.t, columns) for name, values in bands.items()}
    return pd.concat(parts, names=["quantity", "t"]).reset_index()


def _ends(bands: dict[str, np.ndarray]) -> pd.DataFrame:
    """A row a quantity."""
    heads = [f"{100 * level:g} % [mm]" for level in LEVELS]
    rows = [[name, *(1e3 * values[:, -1])] for name, values in bands.items()]
    return pd.DataFrame(rows, columns=["quantity", *heads])


def _moments(posterior: Posterior, names: list[str]) -> pd.DataFrame:
    """A row a parameter."""
    low, high = np.quantile(posterior.values, [0.05, 0.95], axis=0)
    mean, deviation = posterior.values.mean(0), posterior.values.std(0)
    columns = {"mean": mean, "deviation": deviation, "5 %": low, "95 %": high}
    texts = {
        name: value if name == "deviation" else list(map("{:.5g}".format, value))
        for name, value in columns.items()
    }
    return pd.DataFrame({"parameter": names} | texts)
