"""Small models that come with the package, each a page at once: `nsf demo`."""

import webbrowser
import zlib
from importlib.resources import files
from pathlib import Path

from nsf.errors import ConfigError
from nsf.live import page
from nsf.storage import write_text

#: Title of each model that is shipped; the first is shown unless another is asked for.
MODELS = {
    "block": "Soft block under gravity that wanders",
    "tray": "Sand in a tray that is tilted and shaken",
    "metal": "Squeezed metal frame",
}


def page_of(model: str) -> str:
    """The page of a shipped model.

    Raises:
        ConfigError: there is no such model.
    """
    if model not in MODELS:
        raise ConfigError(f"model={model} is none that is shipped; choose one of {', '.join(MODELS)}")
    data = files("nsf").joinpath("live", "models", f"{model}.bin").read_bytes()
    return page.html(MODELS[model], zlib.decompress(data))


def show(model: str | None, folder: Path, opened: bool = True) -> Path:
    """Write the page of a shipped model, and open it in the browser.

    Args:
        model: a key of `MODELS`; the first by default.
        folder: of the page.
        opened: whether it is opened.

    Raises:
        ConfigError: there is no such model.
    """
    model = next(iter(MODELS)) if model is None else model
    path = write_text(folder / f"{model}.html", page_of(model))
    if opened:
        webbrowser.open(path.resolve().as_uri())
    return path
