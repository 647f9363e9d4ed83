"""Animations as gif files of bounded size, with one palette for all frames."""

import io

import matplotlib
import numpy as np
from PIL import Image

from nsf.results.style import STRESS_COLORS


def gif(images: list[Image.Image], max_bytes: int) -> bytes:
    """An endless gif; gives up colours, size and frames, in that order, while it is larger than max_bytes."""
    steps = ((128, 1, 1), (64, 1, 1), (32, 1, 1), (48, 0.75, 1), (48, 0.75, 2), (32, 0.5, 2))
    for colors, scale, step in steps:
        width, height = images[0].size
        size = (round(width * scale), round(height * scale))
        kept = [*images[:-1:step], images[-1]]
        data = _encode([image if scale == 1 else image.resize(size) for image in kept], colors)
        if len(data) <= max_bytes:
            break
    return data


def _encode(images: list[Image.Image], colors: int) -> bytes:
    """One palette for all frames, no dithering: unchanged pixels stay unchanged and compress away.

    The palette holds white, greys and the colour scale as they are, and `colors` more that suit the frames.
    """
    sample = images[:: max(1, len(images) // 6)]
    width, height = images[0].size
    montage = Image.new("RGB", (width, height * len(sample)))
    for k, image in enumerate(sample):
        montage.paste(image, (0, k * height))
    quantized = montage.quantize(colors, method=Image.Quantize.MEDIANCUT)
    adapted = np.array(quantized.getpalette(), dtype=int).reshape(-1, 3)
    adapted = adapted[np.ptp(adapted, axis=1) > 12]  # a grey of its own would tint the white
    greys = np.repeat([*range(0, 160, 20), *range(160, 255, 6), 241, 255], 3)
    ramp = 255 * matplotlib.colormaps[STRESS_COLORS](np.linspace(0, 1, 64))[:, :3]
    palette = Image.new("P", (1, 1))
    palette.putpalette(
        [*greys.tolist(), *ramp.round().astype(int).ravel().tolist(), *adapted.ravel().tolist()]
    )
    frames = [_indexed(image, palette, white=greys.size // 3 - 1) for image in images]
    durations = [80] * (len(frames) - 1) + [1600]
    stream = io.BytesIO()
    more = {"append_images": frames[1:], "duration": durations, "loop": 0, "optimize": True, "disposal": 1}
    frames[0].save(stream, "GIF", save_all=True, **more)
    return stream.getvalue()


def _indexed(image: Image.Image, palette: Image.Image, white: int) -> Image.Image:
    """An image in the palette's colours; Pillow's nearest colour is coarse, so white is put right."""
    indices = np.array(image.quantize(palette=palette, dither=Image.Dither.NONE))
    indices[(np.asarray(image) == 255).all(axis=2)] = white
    indexed = Image.fromarray(indices)
    indexed.putpalette(palette.getpalette() or [])
    return indexed
