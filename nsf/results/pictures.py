"""Pictures of the bodies of a report, by `nsf.bodies`: strips, final shapes, particle sets and films.

Shown is the best variant of each body and model, at its worst and its best held-out case, in rows of the
full-order run, the model and the baseline.
"""

import math
import re
import shutil
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from nsf import bodies
from nsf.bodies import Body, Categories, ColorScale
from nsf.bodies.colors import DIFFERENCE_COLORS, METRES, PASCALS, ROLES, STRESS_COLORS
from nsf.bodies.film import GIF_BYTES
from nsf.results.charts import best
from nsf.results.columns import BASELINE, model_name, number
from nsf.results.page import Picture, Section
from nsf.results.sources import Motion, Source
from nsf.results.style import legend, line_style, panels, save, styled
from nsf.results.table import natural
from nsf.vectors import spaced

if TYPE_CHECKING:
    from nsf.evaluation import SuperResolution
    from nsf.results.question import Question

_ROWS, _ENDS = 6, 2  # cases of final shapes, and of strips and films
_FILMS = 6 * 2**20  # [bytes] of all on a page
_FRAMES, _WIDTH = 31, 380  # of a film at most; of one picture of two [pixel]
_MANY = 16  # bodies and models beyond which each has only its strip
_TOP = 99.0  # [%] percentile at which a colour scale ends
_FINE = "superresolution.png"
_STRESS = "von Mises equivalent of the Kirchhoff stress"
_SETS = dict(zip(("in neither", "integration particles N", "sample particles S"), ROLES, strict=True))
#: Opacity of particles in N alone and in S: S stands out, and both are seen through the body.
_THROUGH = {1: 0.5, 2: 1.0}


@dataclass(frozen=True)
class Shown:
    """A case in pictures.

    Attributes:
        motion: of the full-order run and of the model.
        model: the model's name.
        place: "worst" or "best" of several cases, a setting, or nothing.
        error: of displacement, a fraction.
        baseline: the same case by the baseline, where it is shown beside.
    """

    motion: Motion
    model: str
    place: str = ""
    error: float = math.nan
    baseline: Motion | None = None

    @property
    def name(self) -> str:
        """The case, its place and its error."""
        error = f"displacement error {number(self.error, 100)} %" if math.isfinite(self.error) else ""
        return ", ".join(filter(None, (self.motion.case.replace("_", " "), self.place, error)))

    def rows(self, scale: ColorScale) -> Iterator[tuple[str, Body]]:
        """Each model's name and body."""
        m, b = self.motion, self.baseline

        case = m.case.replace("_", " ")

        def body(model: str, name: str, x, stress, stopped: float | None = None) -> tuple[str, Body]:
            return model, Body(x, stress, scale, m.surroundings, f"{model}, {name}", _warning(stopped))

        yield body("full order", case, m.x_full, m.stress_full)
        yield body(self.model, self.name, m.x_reduced, m.stress_reduced, m.stopped)
        if b is not None:
            yield body(BASELINE, case, b.x_reduced, b.stress_reduced, b.stopped)


def sections(
    frame: pd.DataFrame,
    sources: Sequence[Source],
    folder: Path,
    question: "Question",
    films: bool,
    advance: Callable[[], object] = lambda: None,
) -> list[Section]:
    """Draw the bodies of a report into a folder.

    Args:
        frame: its rows, as `nsf.results.table.labelled` gives them.
        sources: its runs.
        folder: of the report.
        question: what it is about; its superresolve runs are shown, too.
        films: whether bodies are drawn in motion.
        advance: called after the pictures of each variant.
    """
    opened = {source.id: source for source in sources}
    chosen = list(best(frame))
    films = films and len(chosen) <= _MANY
    parts = []
    for stem, body, variant in chosen:
        rows = frame[(frame["body"] == body) & (frame["variant"] == variant)]
        heading = body if body == variant or len(chosen) == 1 else f"{body} · {variant}"
        bytes_of_one = min(GIF_BYTES, _FILMS // len(chosen)) if films else 0
        baseline = frame[(frame["body"] == body) & (frame["model_name"] == BASELINE)]
        pictures = _of_variant(rows, baseline, opened, folder, stem, bytes_of_one, len(chosen) <= _MANY)
        parts.append(Section(heading, pictures))
        advance()
    parts += [Section("At each setting", shown)] if (shown := _settings(frame, opened, folder)) else []
    fine = [_fine(of, run, frame, folder) for of, run in question.fine.items() if of in opened]
    return [*parts, *([Section("At many more points", fine)] if fine else [])]


def _of_variant(
    rows: pd.DataFrame,
    baseline: pd.DataFrame,
    sources: Mapping[str, Source],
    folder: Path,
    stem: str,
    film_bytes: int,
    whole: bool,
) -> list[Picture]:
    """A strip; and where `whole`, final shapes, particle sets and a film of at most so many bytes."""
    of_model = rows[rows["run"] == rows["run"].iloc[0]]
    of_baseline = baseline[baseline["run"] == baseline["run"].iloc[0]] if len(baseline) else baseline
    ends = cases(of_model, of_baseline, sources, _ENDS)
    if not ends:
        return []
    runs = sorted({of_model["run"].iloc[0], *of_baseline["run"]})
    over = "cut open" if hides_stress(ends[0].motion) else "whole"
    caption = f"Bodies over time, {over}: full order, {ends[0].model}"
    caption += f", {BASELINE}" if ends[0].baseline is not None else ""
    caption += f". Colour: {_STRESS}. Displacement error of {ends[0].model}: {_errors(ends)}."
    drawn = save(strip(ends), folder, f"{stem}strip", ("png",), [STRESS_COLORS])
    pictures = [Picture(drawn, caption, runs, leads=True)]
    if not whole:
        return pictures
    every = sorted(cases(of_model, of_baseline, sources, _ROWS), key=lambda case: natural(case.motion.case))
    if changing := [case.motion for case in every if changes(case.motion)]:
        drawn = save(gravity(changing), folder, f"{stem}gravity")
        pictures.append(Picture(drawn, "Gravity in the course of each held-out run.", runs, leads=True))
    ramps = [STRESS_COLORS, DIFFERENCE_COLORS]
    final = save(final_shapes(every), folder, f"{stem}final-shapes", ("png",), ramps)
    caption = "The last frame of each case, and how far each particle lies from the full-order run's. "
    caption += f"Displacement error: {_errors(every)}."
    pictures.append(Picture(final, caption, runs))
    if ends[-1].motion.role is not None:
        sets = save(particle_sets(ends[-1]), folder, f"{stem}particle-sets", ("png",))
        caption = "Sample particles S, and integration particles N that a projected step needs for them."
        pictures.append(Picture(sets, caption, runs))
    if film_bytes:
        animation(ends, folder / f"{stem}animation.gif", max_bytes=film_bytes)
        caption = f"Full order beside {ends[0].model}."
        pictures.append(Picture([f"{stem}animation.gif"], caption, runs))
    return pictures


def _errors(cases: Sequence[Shown]) -> str:
    """The displacement errors of cases, or the smallest and the largest."""
    errors = sorted(case.error for case in cases)
    ends = [number(errors[0], 100), number(errors[-1], 100)]
    return f"{' to '.join(dict.fromkeys(ends))} %"


def _settings(frame: pd.DataFrame, sources: Mapping[str, Source], folder: Path) -> list[Picture]:
    """The last frame of one case of each body at the settings of its model, at most six of them."""
    pictures = []
    for body, rows in frame[frame["model_name"] != BASELINE].groupby("body", sort=False):
        settings = [part for _, part in rows.groupby("variant", sort=False)]
        if len(settings) < 2 or rows["model_name"].nunique() > 1:
            continue
        worst = settings[0].loc[settings[0]["displacement_error"].fillna(math.inf).idxmax(), "case"]
        chosen = [settings[i] for i in spaced(len(settings), _ROWS)]
        shown = []
        for part in (part[part["case"] == worst].head(1) for part in chosen):
            place = part["variant"].iloc[0] if len(part) else ""
            motions = _motions(part, [worst], sources) if len(part) else {}
            shown += [
                Shown(m, model_name(part.iloc[0]), place, part["displacement_error"].iloc[0])
                for m in motions.values()
            ]
        if len(shown) > 1:
            stem = f"{re.sub(r'[^0-9A-Za-z_-]+', '-', str(body))}-settings"
            drawn = save(final_shapes(shown), folder, stem, ("png",), [STRESS_COLORS, DIFFERENCE_COLORS])
            caption = "The last frame of one held-out case at several settings."
            pictures.append(Picture(drawn, caption, sorted(set(rows["run"]))))
    return pictures


def cases(
    rows: pd.DataFrame, baseline: pd.DataFrame, sources: Mapping[str, Source], limit: int
) -> list[Shown]:
    """At most `limit` cases of a run, from the worst in displacement to the best, both among them."""
    ranked = rows.assign(rank=-rows["displacement_error"].fillna(math.inf)).sort_values("rank", kind="stable")
    chosen = ranked.iloc[spaced(len(ranked), limit)]
    of_baseline = _motions(baseline, chosen["case"], sources)
    shown = []
    for case, motion in _motions(chosen, chosen["case"], sources).items():
        row = chosen[chosen["case"] == case].iloc[0]
        place = "worst" if case == ranked["case"].iloc[0] else ""
        place = "best" if case == ranked["case"].iloc[-1] else place
        other = of_baseline.get(case)
        if other is not None and (len(other.t) != len(motion.t) or row["model_name"] == BASELINE):
            other = None
        place = place if len(ranked) > 1 else ""
        shown.append(Shown(motion, model_name(row), place, row["displacement_error"], other))
    return shown


def _motions(rows: pd.DataFrame, wanted: Sequence[str], sources: Mapping[str, Source]) -> dict[str, Motion]:
    """Motions of some cases of one run, by case."""
    if not len(rows):
        return {}
    return {motion.case: motion for motion in sources[rows["run"].iloc[0]].motions(list(wanted))}


def _fine(of: str, run, frame: pd.DataFrame, folder: Path) -> Picture:
    """The picture that a superresolve run drew."""
    row = frame[frame["run"] == of].iloc[0]
    name = f"{row['scene']}-{row['field']}-{_FINE}"
    shutil.copyfile(run.file(_FINE), folder / name)
    caption = "The last frame at the particles, at many more points, and of a full-order run of as many."
    return Picture([name], caption, [run.id])


def final_shapes(cases: Sequence[Shown]) -> Figure:
    """Last frame of each case: full order, the model, and the distance between the two.

    The front half is cut away (`is_cut_open`): a free surface carries little stress, the inside does.

    Args:
        cases: one a row; positions in metres.
    """
    motions, ends = [case.motion for case in cases], [0, -1]
    stress = _stress_scale([m.stress_full[-1] for m in motions])
    apart = [np.linalg.norm(m.x_reduced - m.x_full, axis=-1)[ends] for m in motions]
    finite = np.concatenate([d[-1][np.isfinite(d[-1])] for d in apart])
    top = np.percentile(finite, _TOP) if len(finite) else 0.0
    distance = ColorScale.up_to(top, DIFFERENCE_COLORS, METRES, title="distance ‖x_rom − x_fom‖")
    rows = []
    for case, m, d in zip(cases, motions, apart, strict=True):
        title = f"{case.name}, t = {m.t[-1]:.3g} s"
        around, warning = _at(m.surroundings, ends), _warning(m.stopped)
        rows.append(
            [
                Body(x[ends], values, scale, around, title, warning)
                for x, values, scale in (
                    (m.x_full, m.stress_full[ends], stress),
                    (m.x_reduced, m.stress_reduced[ends], stress),
                    (m.x_reduced, d, distance),
                )
            ]
        )
    return bodies.grid(rows, ("full order", cases[0].model, "distance apart"), cut=True)


def fine_shapes(fine: list["SuperResolution"], around: Sequence[Mapping]) -> Figure:
    """Last frame of the reduced run at its particles and at many more points, and the fine full-order run.

    Whole bodies, coloured by ‖x − X‖: a picture of many points shows the surface, which carries no stress.

    Args:
        fine: one a row.
        around: the surroundings of each at its last frame alone.
    """
    distances = np.linalg.norm(fine[0].x_full - fine[0].X, axis=1)
    moved = ColorScale.up_to(
        np.percentile(distances[np.isfinite(distances)], _TOP), STRESS_COLORS, METRES,
        title="displacement ‖x − X‖",
    )  # fmt: skip
    rows = []
    for f, by in zip(fine, around, strict=True):
        title, twice = str(f.row["case"]).replace("_", " "), _at(by, [-1, -1])
        shown = ((f.x_reduced, f.particles), (f.x_reduced, ...), (f.x_full, ...))
        rows.append(
            [
                Body(
                    np.stack([f.X[which], x[which]]),
                    np.linalg.norm(np.stack([np.zeros_like(x), x - f.X])[:, which], axis=-1),
                    moved, twice, title,
                )
                for x, which in shown
            ]
        )  # fmt: skip
    count, more = len(fine[0].particles), len(fine[0].X)
    titles = f"{count:,} particles", f"the same at {more:,} points", f"full order, {more:,} particles"
    return bodies.grid(rows, titles)


def particle_sets(case: Shown, count: int = 4) -> Figure:
    """S and N in `count` frames of a reduced run, as seen through the body.

    Args:
        case: whose motion has `role`; positions in metres.
        count: of frames; all where there are fewer.
    """
    m = case.motion
    scale, warning = Categories(_SETS), _warning(m.stopped)
    body = Body(m.x_reduced, m.role, scale, m.surroundings, case.name, warning, _THROUGH)
    return bodies.strip([body], m.t, count)


def strip(cases: Sequence[Shown], count: int = 5) -> Figure:
    """The motion of each case in `count` pictures, a row a model.

    Whole bodies, but cut open where the surface carries little of the stress.

    Args:
        cases: positions in metres.
        count: of pictures a row.
    """
    stress = _stress_scale([case.motion.stress_full for case in cases])
    rows = [body for case in cases for _, body in case.rows(stress)]
    return bodies.strip(rows, cases[0].motion.t, count, hides_stress(cases[0].motion))


def animation(cases: Sequence[Shown], path: Path, max_bytes: int = GIF_BYTES) -> None:
    """Write a film: the models side by side, cut open, coloured by stress, with the time.

    Args:
        cases: one or two, a row each.
        path: of the film.
        max_bytes: of a GIF at most.
    """
    stress = _stress_scale([case.motion.stress_full for case in cases])
    models = [list(case.rows(stress)) for case in cases]
    titles = [model for model, _ in max(models, key=len)]
    rows = [[body for _, body in row] for row in models]
    images = bodies.frames(rows, cases[0].motion.t, titles, _FRAMES, 2 * _WIDTH, cut=True)
    bodies.film(images, path, most=max_bytes)


def changes(motion: Motion) -> bool:
    """Whether gravity changes in the course of a run."""
    acting = motion.surroundings.get("gravity", np.zeros((1, 3)))
    return bool(np.ptp(acting, axis=0).max() > 1e-6 * np.abs(acting).max())


def gravity(motions: Sequence[Motion]) -> Figure:
    """Gravity over time along each axis, a panel a run."""
    with styled():
        fig, drawn = panels(len(motions), 2.4, 3, sharey=True)
        for panel, motion in zip(drawn, motions, strict=True):
            for k, name in enumerate("xyz"):
                panel.plot(motion.t, motion.surroundings["gravity"][:, k], label=name, **line_style(k))
            panel.set(title="\n".join(textwrap.wrap(motion.case, 40)), xlabel="time t [s]")
            panel.grid()
        drawn[0].set_ylabel("gravity [m/s²]")
        legend(fig)
    return fig


def hides_stress(motion: Motion) -> bool:
    """Whether the stress lies within the body: its surface carries little of it."""
    return bodies.hides_inside(motion.x_full[0], motion.x_full[-1], motion.stress_full[-1])


def _warning(stopped: float | None) -> str:
    """Over a run that diverged, that its last good state stands there."""
    return "" if stopped is None else f"diverged; shown as at t = {stopped:.3g} s"


def _at(around: Mapping[str, np.ndarray], frames: list[int]) -> dict[str, np.ndarray]:
    """Surroundings in some of their frames."""
    still = ("solid_shape", "solid_extents")
    return {name: values if name in still else values[frames] for name, values in around.items()}


def _stress_scale(values: Sequence[np.ndarray]) -> ColorScale:
    top = np.percentile(np.concatenate([one.ravel() for one in values]), _TOP)
    return ColorScale.up_to(top, STRESS_COLORS, PASCALS, title=_STRESS, power=0.5)
