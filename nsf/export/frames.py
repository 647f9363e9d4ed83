"""`--frames`: a picture of each frame and a film of all."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

from nsf import bodies
from nsf.bodies.colors import METRES, PASCALS, STRESS_COLORS
from nsf.export.playback import QUANTITIES, Playback
from nsf.extras import optional
from nsf.progress import Progress
from nsf.storage import require_space, writing

NEEDS = ("imageio_ffmpeg",)
WIDTH = 1280  # [pixel]


def write(playback: Playback, folder: Path) -> Path:
    """Write `frame_0000.png` and on, and the film beside their folder, as MP4 (H.264) at the playback's fps.

    A block holds some points in all frames, and a picture needs all points in one frame. So the positions go
    to a temporary file first, and only one frame at a time is in memory.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
        StorageError: the disk cannot hold the temporary file.
    """
    optional(*NEEDS, "export")  # before any work
    pictures, path = folder / f"{playback.name}_frames", folder / f"{playback.name}.mp4"
    with writing(path) as partial, tempfile.TemporaryDirectory(dir=partial.parent) as scratch:
        body = _body(playback, Path(scratch) / "points")
        drawn = bodies.frames([[body]], playback.t, (playback.title,), most=None, size=WIDTH)
        bodies.film(_kept(drawn, len(playback.t), pictures), partial, playback.fps)
    return path


def _body(playback: Playback, stored: Path) -> bodies.Body:
    """All points in all frames, on disk."""
    shape = (len(playback.t), len(playback.X), 4)
    require_space(stored, 4 * int(np.prod(shape)))
    points = np.memmap(stored, np.float32, "w+", shape=shape)
    for block in playback.blocks("frames"):
        points[:, block.rows, :3] = block.x.numpy()
        points[:, block.rows, 3] = block.magnitude(playback.color).numpy()
    title, units = QUANTITIES[playback.color].title, {"Pa": PASCALS, "m": METRES}
    scale = bodies.ColorScale.up_to(
        playback.tops[playback.color], STRESS_COLORS, units[QUANTITIES[playback.color].unit], title=title
    )
    return bodies.Body(points[..., :3], points[..., 3], scale, playback.around)


def _kept(images: Iterator[Image.Image], count: int, folder: Path) -> Iterator[Image.Image]:
    """The images, each of which is written too."""
    with Progress("export: draw", count, "frames") as progress:
        for k, image in enumerate(images):
            with writing(folder / f"frame_{k:04d}.png") as png:
                image.save(png, "PNG")
            yield image
            progress.advance()
