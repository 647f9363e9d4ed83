"""Pages in one file that load nothing: the modules of `nsf/live/web`, a style, and numbers in one piece.

A page's policy names the hashes of its one script and its one style: nothing else runs in it, whatever a
title or a unit holds.
"""

import base64
import hashlib
import json
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from nsf.bodies.colors import STRESS_COLORS, ColorScale
from nsf.results.formats import HTML

if TYPE_CHECKING:
    from nsf.mpm import Collider

#: Arrays begin at multiples of so many bytes, so that a browser views them in place.
_WORD = 8
ENTRY = "page"  # the module that the page begins with
_TYPES = ("f4", "f8", "i1", "i2", "u1", "u2")
_IMPORT = re.compile(r'^import \{ [^}]+ \} from "\./(\w+)\.mjs";\n', re.MULTILINE)


def packed(header: Mapping, arrays: Mapping[str, np.ndarray]) -> bytes:
    """A header and arrays in one piece, as `unpacked` in `data.mjs` reads them.

    Returns:
        Length of the header as uint32, the header (JSON with `arrays`: shape and type of each, padded with
        spaces), then the arrays, all little-endian, each padded to whole words.

    Raises:
        ValueError: an array is of a type that no browser views.
    """
    arrays = {name: np.ascontiguousarray(a, a.dtype.newbyteorder("<")) for name, a in arrays.items()}
    types = {name: {"shape": a.shape, "type": f"{a.dtype.kind}{a.itemsize}"} for name, a in arrays.items()}
    if unknown := [f"{name}: {one['type']}" for name, one in types.items() if one["type"] not in _TYPES]:
        raise ValueError(f"{', '.join(unknown)}: arrays must be of {', '.join(_TYPES)}")
    text = json.dumps({**header, "arrays": types}).encode()
    text += b" " * (-(4 + len(text)) % _WORD)
    body = b"".join(a.tobytes() + b"\0" * (-a.nbytes % _WORD) for a in arrays.values())
    return struct.pack("<I", len(text)) + text + body


@cache
def script() -> str:
    """The modules that the page needs as one, each once and after those that it imports.

    No two modules have a name in common.
    """
    texts: dict[str, str] = {}

    def add(module: str) -> None:
        if module in texts:
            return
        texts[module] = ""  # a circle of imports ends here; functions are called after all are there
        text = _text(f"{module}.mjs")
        for other in _IMPORT.findall(text):
            add(other)
        del texts[module]
        texts[module] = re.sub(r"^export ", "", _IMPORT.sub("", text), flags=re.MULTILINE)

    add(ENTRY)
    return "\n" + "\n".join(texts.values())


def policy(connects: bool = False) -> str:
    """The rights of the page: to run its one script, be styled, and where it connects, reach its server."""
    hashes = (_hashed(text) for text in (script(), _style()))
    allowed = "script-src 'sha256-{}'; style-src 'sha256-{}'; img-src data: blob:".format(*hashes)
    connecting = "; connect-src 'self' ws: wss:" if connects else ""
    return f"default-src 'none'; {allowed}{connecting}; base-uri 'none'; form-action 'none'"


def html(title: str, data: bytes = b"", connects: bool = False) -> str:
    """The page of a run.

    Args:
        title: until the script gives another.
        data: what it holds, of `packed`; none where it follows its server.
        connects: whether it reaches its own server.
    """
    deflated = base64.b64encode(zlib.compress(data, 9)).decode() if data else ""
    return HTML.from_string(_text("page.html")).render(
        title=title,
        policy=policy(connects),
        style=Markup(_style()),
        script=Markup(script()),
        data=Markup(deflated),
    )


def colors(cmap: str = STRESS_COLORS) -> list[int]:
    """[256 × 3] the colours of a scale, of 8 bits; `cmap` is of matplotlib."""
    return ColorScale(1.0, cmap, 1.0, "").pixels(np.linspace(0, 1, 256)).ravel().tolist()


def solid(name: str, collider: "Collider") -> dict:
    """A solid as `solids.mjs` has it."""
    entry = {
        "name": name,
        "shape": collider.name,
        "position": collider.position.tolist(),
        "extents": collider.extents.tolist(),
        "orientation": collider.orientation.ravel().tolist(),
        "since": collider.since,
        "until": collider.until if np.isfinite(collider.until) else None,
        "motion": None,
    }
    if collider.motion is not None:
        times, translations, angles = collider.motion.keyframes()
        axis, pivot = collider.motion.hinge()
        held = {"times": times, "translations": translations, "angles": angles, "axis": axis, "pivot": pivot}
        entry["motion"] = {key: values.tolist() for key, values in held.items()}
    return entry


def recording(x: np.ndarray, stress: np.ndarray, t: Sequence[float]) -> tuple[dict, dict[str, np.ndarray]]:
    """A recorded run as `Recording` in `data.mjs` reads it: what is told of it, and its arrays.

    Each plane of values is its difference from the plane before. The bytes are sorted by their significance,
    because nearly all high bytes are alike.

    Args:
        x: [F + 1, n, 3] positions at rest and in each frame [m]; kept in 16 bits over their box.
        stress: [F, n] over the end of its colour scale; kept in 8 bits.
        t: [F] times [s].
    """
    lower, upper = x.min((0, 1)), x.max((0, 1))
    header = {
        "t": [float(value) for value in t], "points": x.shape[1],
        "lower": lower.tolist(), "upper": upper.tolist(),
    }  # fmt: skip
    planes = quantised(x, lower, upper, np.uint16), quantised(stress, 0.0, 1.0, np.uint8)
    return header, dict(zip(("x", "stress"), map(_differences, planes), strict=True))


def quantised(values: np.ndarray, lower, upper, kind: type) -> np.ndarray:
    """Values, clipped to [`lower`, `upper`], as whole numbers from 0 to the largest of `kind`."""
    largest = np.iinfo(kind).max
    span = np.maximum(np.subtract(upper, lower), np.finfo(np.float32).tiny)
    return np.rint(np.clip((values - lower) / span, 0.0, 1.0) * largest).astype(kind)


def _differences(planes: np.ndarray) -> np.ndarray:
    """Each plane less the one before it, modulo the type; [bytes of a number, F, …]."""
    differences = np.diff(planes, axis=0, prepend=np.zeros_like(planes[:1]))
    count = np.ascontiguousarray(differences).view(np.uint8).reshape(-1, planes.itemsize)
    return np.moveaxis(count, 1, 0).reshape(planes.itemsize, *planes.shape)


def _hashed(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@cache
def _style() -> str:
    return "\n" + _text("page.css")


@cache
def _text(name: str) -> str:
    return files("nsf").joinpath("live", "web", name).read_text(encoding="utf-8")
