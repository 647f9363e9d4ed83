"""Films: an MP4, or a GIF of bounded size."""

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

from nsf.extras import optional

GIF_BYTES = 2**20  # of a GIF at most: a page of several stays small
_COLORS = 96
_SHRINK = 0.8  # of a GIF that is too large, per trial
_LAST = 1600  # [ms] for which a GIF's last frame stands


def film(images: Iterable[Image.Image], path: Path, fps: float = 12.5, most: int = GIF_BYTES) -> None:
    """Write images as a film.

    Args:
        images: of one size.
        path: `.mp4` (H.264; needs the extra `export`), or `.gif`, which is endless.
        fps: frames a second.
        most: bytes of a GIF, which is drawn smaller until it has no more.

    Raises:
        MissingExtraError: imageio-ffmpeg is not installed.
    """
    if path.suffix == ".gif":
        path.write_bytes(_gif(list(images), fps, most))
        return
    ffmpeg, writer = optional("imageio_ffmpeg", "export"), None
    for image in images:
        # H.264 halves its colours, so that both sides must be even.
        picture = np.ascontiguousarray(np.asarray(image)[: image.height // 2 * 2, : image.width // 2 * 2])
        if writer is None:
            size = picture.shape[1::-1]
            writer = ffmpeg.write_frames(str(path), size, fps=fps, quality=8, macro_block_size=1)
            writer.send(None)
        writer.send(picture)
    if writer is not None:
        writer.close()


def _gif(images: list[Image.Image], fps: float, most: int) -> bytes:
    """An endless GIF of at most so many bytes."""
    data = _encoded(images, fps)
    while len(data) > most and images[0].width > 64:
        width, height = (round(_SHRINK * side) for side in images[0].size)
        images = [image.resize((width, height), Image.Resampling.LANCZOS) for image in images]
        data = _encoded(images, fps)
    return data


def _encoded(images: list[Image.Image], fps: float) -> bytes:
    """One palette for all frames and no dithering: what stays the same compresses away."""
    sample = images[:: max(1, len(images) // 6)]
    montage = Image.fromarray(np.concatenate([np.asarray(image) for image in sample]))
    palette = montage.quantize(_COLORS, method=Image.Quantize.MEDIANCUT)
    table = np.array(palette.getpalette()).reshape(-1, 3)
    table[table.sum(axis=1).argmax()] = 255  # the background, which a mean of colours is not
    palette.putpalette(table.ravel().tolist())
    drawn = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    durations = [round(1000 / fps)] * (len(drawn) - 1) + [_LAST]
    stream = io.BytesIO()
    drawn[0].save(
        stream, "GIF", save_all=True, append_images=drawn[1:], duration=durations, loop=0, optimize=True,
        disposal=1,
    )  # fmt: skip
    return stream.getvalue()
