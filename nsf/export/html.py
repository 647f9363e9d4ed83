"""`--html`: one page that plays in a browser, opened from disk, without a network."""

import base64
import zlib
from importlib.resources import files
from pathlib import Path

import numpy as np
from markupsafe import Markup

from nsf.errors import ConfigError
from nsf.export.playback import QUANTITIES, Playback
from nsf.reporting.drawing.style import STRESS_COLORS, ColorScale
from nsf.reporting.text.formats import HTML
from nsf.storage import writing

NEEDS = ()
POINTS = 20_000  # by default: a page of some MiB that a telephone plays
LARGEST = 1 << 29  # bytes of positions and colours that a browser unpacks


def write(playback: Playback, folder: Path) -> Path:
    """Write the page.

    Positions take 16 bits over their bounding box, von Mises stress 8 bits over its colour scale. The page
    stores each plane of values as its difference from the plane before, deflated. Its address may name a
    frame, at which it begins paused, and a quantity: `page.html#frame=50&color=displacement`.

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
    stress = np.empty((F, N), np.uint8)
    for block in playback.blocks("html"):
        x[0, block.rows], x[1:, block.rows] = block.X.numpy(), block.x.numpy()
        stress[:, block.rows] = _quantised(block.von_mises.numpy(), 0.0, playback.tops["von_mises"], np.uint8)
    lower, upper = x.min((0, 1)), x.max((0, 1))
    told = {
        "title": playback.title,
        "run": playback.run.id,
        "points": N,
        "particles": len(playback.manifold.X),
        "t": playback.t.tolist(),
        "fps": playback.fps,
        "stopped": playback.stopped,
        "lower": lower.tolist(),
        "upper": upper.tolist(),
        "floor": playback.floor,
        "radius": playback.radius,
        "color": playback.color,
        "quantities": {
            name: {"title": quantity.title, "unit": quantity.unit, "top": playback.tops[name]}
            for name, quantity in QUANTITIES.items()
        },
        "colors": ColorScale(1.0, STRESS_COLORS, 1.0, "").pixels(np.linspace(0, 1, 256)).ravel().tolist(),
    }
    planes = _differences(_quantised(x, lower, upper, np.uint16)), _differences(stress)
    data = base64.b64encode(zlib.compress(b"".join(plane.tobytes() for plane in planes), 6)).decode()
    page = HTML.from_string(files("nsf.export").joinpath("player.html").read_text(encoding="utf-8"))
    path = folder / f"{playback.name}.html"
    with writing(path) as partial:
        page.stream(title=playback.title, told=told, data=Markup(data)).dump(str(partial), encoding="utf-8")
    return path


def _quantised(values: np.ndarray, lower, upper, kind: type) -> np.ndarray:
    """Values, clipped to [`lower`, `upper`], as whole numbers from 0 to the largest of `kind`."""
    largest = np.iinfo(kind).max
    span = np.maximum(np.subtract(upper, lower), np.finfo(np.float32).tiny)
    return np.rint(np.clip((values - lower) / span, 0.0, 1.0) * largest).astype(kind)


def _differences(planes: np.ndarray) -> np.ndarray:
    """Each plane less the one before it, modulo the type.

    The bytes are sorted by their significance, because nearly all high bytes are alike.
    """
    differences = np.diff(planes, axis=0, prepend=np.zeros_like(planes[:1]))
    return np.moveaxis(np.ascontiguousarray(differences).view(np.uint8).reshape(-1, planes.itemsize), 1, 0)
