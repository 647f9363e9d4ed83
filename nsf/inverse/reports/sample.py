"""What drawn parameters bring about: quantiles over time, sensitivities, and a posterior."""

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
from nsf.inverse.reports.page import Results, write
from nsf.inverse.sampling import LEVELS, Asked, Prior, runs, sensitivities
from nsf.inverse.space import Space
from nsf.reporting.text.columns import axis, number
from nsf.results.formats import Rows
from nsf.results.page import Picture, Section, Table
from nsf.results.style import save
from nsf.runs import Run

_LEAD = "What runs by operators make of parameters that are drawn from stated distributions."
_TERMS = (
    ("distrusted", "runs that are not to be believed; no quantile counts them (docs/method.md, Trust)."),
    ("first order, total", "share of the variance that a parameter makes alone, and with all others."),
    ("posterior", "the parameters given the observations, the reduced model's own error included."),
)
_DRAWS = 4000


def report(
    model: Model,
    prior: Prior,
    asked: Asked,
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
        model, prior, asked: of the runs.
        folder: of the page.
        count: runs.
        indices: base of the design of sensitivities, a power of two; 0 for none.
        full_order: base of a design of full-order runs beside it; 0 for none.
        view: of observations, for a posterior.
        program: number of the program that all runs follow, where the scene has programs.
        seed: of everything that is drawn.
        say: told what is done.
    """
    ids, warnings = [model.run.id], []
    forcing = None if program is None else model.forcing(program=program)
    if view is None:
        drawn = prior.draw(count, seed)
    else:
        found = fit(view, model, Space.of(model), forcing=forcing)
        given = posterior(prior, view, found, _DRAWS, forcing, seed)
        warnings += warnings_of(found, view.observations) + ([given.warning] if given.warning else [])
        say(f"sample: posterior given {len(view.observations)} observations: {given.told}")
        drawn = given.values[np.random.default_rng(seed).integers(0, len(given.values), count)]
    made = runs(model, drawn, asked, forcing)
    lost = int((~made.trusted).sum())
    say(f"sample: {count:,} runs in {made.seconds:.2f} s, {lost:,} of them distrusted")
    bands = made.quantiles()
    rows = pd.DataFrame(drawn, columns=list(model.names))
    for k, name in enumerate(asked.names):
        rows[name] = made.values[:, k, -1]
    rows["distrust"] = made.distrust
    rows = rows.map(lambda value: float(f"{value:.6g}"))
    files = {"quantiles.csv": _quantiles(asked, bands), "runs.csv.gz": rows}
    tables = [Table("At the end", _ends(bands), f"{count:,} runs, {lost:,} of them distrusted and left out.")]
    sections = {
        "Quantiles over time": (
            "quantiles",
            "Quantiles of trusted runs over time.",
            lambda: bands_chart(asked.t, bands, LEVELS, "m"),
        )
    }
    beside: list[Run] = []
    if indices:
        table, own = _indices(model, prior, asked, indices, full_order, program, seed, say)
        files["sensitivities.csv"], beside = table, own
        tables.insert(
            0, Table("Sensitivities at the end", _index_rows(table), _designs(indices, full_order, prior))
        )
        told = (
            "Shares of the variance at the end that each parameter makes over its stated distribution, "
            "whatever was observed, distrusted runs among them, with 95 % intervals."
        )
        sections = {"Sensitivities": ("sensitivities", told, lambda: indices_chart(table))} | sections
    if view is not None:
        files["posterior.csv"] = pd.DataFrame(given.values, columns=list(model.names))
        tables.append(Table("Posterior", _moments(model, given.values), f"{given.told}."))
        sections["Posterior"] = (
            "posterior",
            "Draws of the posterior.",
            lambda: posterior_chart(given.values, model.names, model.units),
        )

    def draw(fresh: Path) -> list[Section]:
        return [
            Section(heading, [Picture(save(chart(), fresh, stem), told, ids)])
            for heading, (stem, told, chart) in sections.items()
        ]

    title = model.scene.config.scene.get("title") or model.scene.name
    results = Results(
        title=f"{title}: sampling",
        lead=_LEAD,
        tables=tables,
        files=files,
        runs=[model.run, *model.run.parent_runs],
        beside=beside,
        draw=draw,
        facts=[("Runs", f"{count:,} in {made.seconds:.2f} s"), ("Distrusted", f"{lost:,}")],
        definitions=_TERMS,
        warnings=warnings,
        asked={"count": count, "of": asked.names, "seed": seed, "sensitivities": indices}
        | ({} if program is None else {"program": program}),
    )
    for warning in warnings:
        say(f"sample: warning: {warning}")
    return write(results, folder)


def _indices(model, prior, asked, count, full_order, program, seed, say) -> tuple[pd.DataFrame, list[Run]]:
    """Indices at the last time by operators, and by full-order runs of a smaller design of the same kind."""

    forcing = None if program is None else model.forcing(program=program)
    own = {} if program is None else {PROGRAM: program}

    def by_operators(values: np.ndarray) -> np.ndarray:
        return runs(model, values, asked, forcing).values[..., -1]

    table = sensitivities(prior, count, by_operators, asked.names, seed)
    if not full_order:
        return table, []
    made: list[Run] = []

    def by_full_order(values: np.ndarray) -> np.ndarray:
        named = [dict(zip(model.names, row, strict=True)) for row in values.tolist()]
        cases = [model.scene.case(values | own) for values in named]
        made.extend(model.pipeline.full_order(cases))
        found = []
        for run in made:
            with Trajectory.open(run.file(TRAJECTORY)) as truth:
                found.append(asked.of_truth(truth))
        return np.array(found)

    beside = sensitivities(prior, full_order, by_full_order, asked.names, seed)
    same = sensitivities(prior, full_order, by_operators, asked.names, seed)
    say(f"sample: sensitivities beside {len(made)} full-order runs")
    return table.assign(
        first_same_design=same["first"],
        first_full_order=beside["first"],
        total_same_design=same["total"],
        total_full_order=beside["total"],
    ), made


def _designs(count: int, full_order: int, prior: Prior) -> str:
    of = max(2, len(prior.each)) + 2
    told = f"Saltelli's design of {count * of:,} runs"
    if full_order:
        told += f"; beside it {full_order * of:,} full-order runs, and runs by operators of the same design"
    return f"{told}."


def _index_rows(table: pd.DataFrame) -> Rows:
    heads = [name.replace("_", " ") for name in table]
    body = [
        [str(value) if isinstance(value, str) else f"{value:.3f}" for value in row]
        for row in table.to_numpy().tolist()
    ]
    return Rows(heads, body, [name not in ("quantity", "parameter") for name in table])


def _quantiles(asked: Asked, bands) -> pd.DataFrame:
    parts = []
    for name, values in bands.items():
        columns = {f"q{100 * level:g}": row for level, row in zip(LEVELS, values, strict=True)}
        parts.append(pd.DataFrame({"quantity": name, "t": asked.t, **columns}))
    return pd.concat(parts, ignore_index=True)


def _ends(bands) -> Rows:
    heads = ["quantity", *(f"{100 * level:g} % [mm]" for level in LEVELS)]
    body = [[name, *(number(1e3 * row[-1]) for row in values)] for name, values in bands.items()]
    return Rows(heads, body, [False] + [True] * len(LEVELS))


def _moments(model: Model, draws: np.ndarray) -> Rows:
    heads = ["parameter", "mean", "deviation", "5 %", "95 %"]
    body = []
    for name, unit, own in zip(model.names, model.units, draws.T, strict=True):
        low, high = np.quantile(own, [0.05, 0.95])
        told = [f"{own.mean():.5g}", number(float(own.std())), f"{low:.5g}", f"{high:.5g}"]
        body.append([axis(name.replace("_", " "), unit), *told])
    return Rows(heads, body, [False, True, True, True, True])
