"""`--frames`: a picture of each frame and a film of all, drawn by PyVista without a display."""

import contextlib
import tempfile
from pathlib import Path

import numpy as np

from nsf.export.playback import QUANTITIES, Playback
from nsf.extras import optional
from nsf.progress import Progress
from nsf.results.style import STRESS_COLORS
from nsf.storage import require_space, writing

NEEDS = ("pyvista", "imageio.v2", "imageio_ffmpeg")
SIZE = (1280, 720)  # [pixel]
TOWARD = np.array([0.45, -0.84, 0.32])  # from the points to the viewer
GREY, INK = "#ededf0", "#222222"


def write(playback: Playback, folder: Path) -> Path:
    """Write `frame_0000.png` and on, and the film beside their folder, as MP4 (H.264) at the playback's fps.

    Points are spheres in the colours of the playback's quantity. A block holds some points in all frames, and
    a picture needs all points in one frame. So the positions go to a temporary file first, and only one frame
    at a time is in memory.

    Raises:
        MissingExtraError: pyvista or imageio-ffmpeg is not installed.
        StorageError: the disk cannot hold the temporary file.
    """
    pyvista, imageio, _ = (optional(name, "export") for name in NEEDS)
    pictures, film = folder / f"{playback.name}_frames", folder / f"{playback.name}.mp4"
    shape = (len(playback.t), len(playback.X), 4)
    with writing(film) as partial, tempfile.TemporaryDirectory(dir=partial.parent) as scratch:
        stored = Path(scratch) / "points"
        require_space(stored, 4 * int(np.prod(shape)))
        frames = np.memmap(stored, np.float32, "w+", shape=shape)
        for block in playback.blocks("frames"):
            frames[:, block.rows, :3] = block.x.numpy()
            frames[:, block.rows, 3] = block.magnitude(playback.color).numpy()
        with (
            pyvista.vtk_verbosity("off"),  # VTK looks for a display first, and says that there is none
            contextlib.closing(pyvista.Plotter(off_screen=True, window_size=SIZE)) as plotter,
            imageio.get_writer(partial, fps=playback.fps, macro_block_size=1, quality=8) as movie,
            Progress("export: draw", len(frames), "frames") as progress,
        ):
            points = _furnish(plotter, pyvista, playback, frames[0])
            for k, frame in enumerate(frames):
                points.points = np.ascontiguousarray(frame[:, :3])
                points[playback.color] = np.ascontiguousarray(frame[:, 3])
                told = f"{playback.title}\nt = {playback.t[k]:.3f} s"
                plotter.add_text(told, name="told", font_size=11, color=INK, render=False)
                plotter.render()
                picture = plotter.screenshot(return_img=True)
                movie.append_data(picture)
                with writing(pictures / f"frame_{k:04d}.png") as png:
                    imageio.imwrite(png, picture)
                progress.advance()
    return film


def _furnish(plotter, pyvista, playback: Playback, first: np.ndarray):
    """Set camera, floor and legend, add the points of the first frame [N, 4], and return them."""
    quantity, top = QUANTITIES[playback.color], playback.tops[playback.color]
    lower, upper = playback.bounds
    centre, size = 0.5 * (lower + upper), float(np.linalg.norm(upper - lower))
    away = 1.5 * size
    plotter.set_background("white")
    if playback.floor is not None:
        place = (centre[0], centre[1], playback.floor)
        floor = pyvista.Disc(center=place, inner=0.0, outer=1.2 * size, normal=(0, 0, 1), c_res=64)
        plotter.add_mesh(floor, color=GREY, lighting=False)
    points = pyvista.PolyData(np.ascontiguousarray(first[:, :3]))
    points[playback.color] = np.ascontiguousarray(first[:, 3])
    pixels = SIZE[1] / (2.0 * away * np.tan(np.deg2rad(0.5 * plotter.camera.view_angle)))  # in a metre
    plotter.add_points(
        points,
        scalars=playback.color,
        clim=(0.0, top),
        cmap=STRESS_COLORS,
        render_points_as_spheres=True,
        point_size=max(1.5, 2.0 * playback.radius * pixels),
        ambient=0.4,
        diffuse=0.7,
        scalar_bar_args={
            "title": f"{quantity.title} [{quantity.unit}]\n",
            "color": INK,
            "fmt": "%.3g",
            "n_labels": 3,
            "title_font_size": 17,
            "label_font_size": 15,
            "width": 0.4,
            "height": 0.1,
            "position_x": 0.57,
            "position_y": 0.03,
        },
    )
    plotter.camera.up = (0.0, 0.0, 1.0)
    plotter.camera.focal_point = centre
    plotter.camera.position = centre + away * TOWARD
    plotter.camera.clipping_range = (0.05 * size, 20 * size)
    return points
