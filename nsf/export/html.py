"""`--html`: one page that plays in a browser, opened from disk, without a network."""

from pathlib import Path

import numpy as np

from nsf.errors import ConfigError
from nsf.export.playback import QUANTITIES, Playback
from nsf.live import page
from nsf.live.surface import surface
from nsf.storage import write_text
from nsf.vectors import spaced

NEEDS = ()
POINTS = 20_000  # by default: a page of some MiB that a telephone plays
_CLOSED = 0.72  # radius at which points look closed, over the edge of the cube that each of them fills
_LOOKS = 16  # frames by which it is told whether a body is drawn as a surface
LARGEST = 1 << 29  # bytes of positions and colours that a browser unpacks


def write(playback: Playback, folder: Path) -> Path:
    """Write the page.

    Positions take 16 bits over their bounding box, von Mises stress 8 bits over its colour scale. Its address
    may name a frame, at which it begins paused, and a quantity: `page.html#frame=50&color=displacement`.

    Raises:
        ConfigError: a browser cannot hold so many points in so many frames.
    """
    if not playback.points_given:
        playback = playback.thinned(POINTS)
    N, F = len(playback.X), len(playback.t)
    if (size := 7 * N * (F + 1)) > LARGEST:
        raise ConfigError(
            f"{N} points in {F} frames are {size / 2**20:.0f} MiB in a browser, at most {LARGEST >> 20}; "
            "give fewer --points or a larger --every"
        )
    x = np.empty((F + 1, N, 3), np.float32)  # the first plane is at rest
    stress = np.empty((F, N), np.float32)
    for block in playback.blocks("html"):
        x[0, block.rows], x[1:, block.rows] = block.X.numpy(), block.x.numpy()
        stress[:, block.rows] = block.von_mises.numpy() / playback.tops["von_mises"]
    recorded, arrays = page.recording(x, stress, playback.t)
    header = {
        "title": playback.title,
        "run": playback.run.id,
        "points": N,
        "particles": len(playback.manifold.X),
        "fps": playback.fps,
        "stopped": playback.stopped,
        "floor": playback.floor,
        "radius": playback.radius,
        "color": playback.color,
        "quantities": {
            name: {"title": quantity.title, "unit": quantity.unit, "top": playback.tops[name]}
            for name, quantity in QUANTITIES.items()
        },
        "colors": page.colors(),
        "solids": playback.solids,
        "recordings": {"run": recorded},
    }
    shown = x[1:][spaced(F, _LOOKS)]
    arrays = {f"run.{name}": array for name, array in arrays.items()}
    data = page.packed(header, arrays | surface(x[0], playback.radius / _CLOSED, shown))
    return write_text(folder / f"{playback.name}.html", page.html(playback.title, data))
