"""`nsf doctor`: what this installation consists of, where it keeps things, and what it lacks."""

import importlib
import importlib.metadata
import os
import pkgutil
import platform
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from nsf.errors import first_line
from nsf.installed import entry_points
from nsf.runs.provenance import provenance
from nsf.storage import bytes_text, size_of

_DEVELOPMENT = ("dev", "docs")  # extras that a user does not miss


def report() -> str:
    """Versions, devices, caches and extras, as text; a part that cannot be told says why."""
    parts = {"versions": _versions, "devices": _devices, "folders": _folders, "extras": _extras}
    parts |= {"packages of yours": _packages} if entry_points() else {}
    return "\n\n".join("\n".join((f"{title}:", *_lines(find))) for title, find in parts.items())


def _lines(find: Callable[[], Iterator[str]]) -> list[str]:
    lines = []
    try:
        lines.extend(f"  {line}" for line in find())
    except Exception as error:  # whatever is broken here is what the reader wants to know
        lines.append(f"  {'warning':<10} {type(error).__name__}: {error}")
    return lines


def _versions() -> Iterator[str]:
    made_with = provenance()
    commit = ""
    if made_with["commit"]:
        commit = f" (commit {made_with['commit'][:12]}{', changed' * bool(made_with['dirty'])})"
    for name, version in made_with["versions"].items():
        yield f"{name:<10} {version or 'missing'}{commit * (name == 'nsf')}"
    yield f"{'system':<10} {platform.platform()}"


def _devices() -> Iterator[str]:
    import torch

    from nsf.mpm.device import wp

    wp.init()
    yield f"cpu        {os.cpu_count()} cores, {torch.get_num_threads()} threads of torch"
    for device in wp.get_cuda_devices():
        memory = device.total_memory / 2**30
        yield f"{device.alias:<10} {device.name}, {memory:.0f} GiB, sm_{device.arch}"
    if not wp.is_cuda_available():
        yield "no GPU     Warp finds no driver; it needs 580 or newer. Everything runs on the CPU"
        return
    driver, toolkit = wp.get_cuda_driver_version(), wp.get_cuda_toolkit_version()
    yield f"driver     {_kernel_module()}CUDA {_dotted(driver)}; Warp is built for CUDA {_dotted(toolkit)}"
    if not torch.cuda.is_available():
        yield f"warning    torch {torch.__version__} does not reach the GPU that Warp does"


def _dotted(version: Sequence[int]) -> str:
    return ".".join(map(str, version))


def _kernel_module() -> str:
    """Version of the NVIDIA driver, where Linux tells it."""
    try:
        version = re.search(r"\d+\.\d+\.\d+", Path("/proc/driver/nvidia/version").read_text())
    except OSError:
        return ""
    return f"{version[0]}, " if version else ""


def _folders() -> Iterator[str]:
    import warp as wp

    runs, reports = (Path(os.environ.get(f"NSF_{name.upper()}") or name) for name in ("runs", "reports"))
    count = sum(1 for _ in runs.glob("*/*/*/manifest.json"))
    yield f"runs       {_weighed(runs)}, {count} runs"
    yield f"reports    {_weighed(reports)}"
    yield f"kernels    {_weighed(Path(wp.config.kernel_cache_dir))}, compiled again where deleted"


def _weighed(folder: Path) -> str:
    """A folder with its size."""
    folder = folder.expanduser()
    if not folder.is_dir():
        return f"{folder} (not there)"
    return f"{folder} ({bytes_text(size_of(folder))})"


def _extras() -> Iterator[str]:
    from packaging.requirements import Requirement

    required = [Requirement(text) for text in importlib.metadata.requires("nsf") or ()]
    extras = importlib.metadata.metadata("nsf").get_all("Provides-Extra") or ()
    for extra in extras:
        if extra in _DEVELOPMENT:
            continue
        needed = [r for r in required if r.marker and r.marker.evaluate({"extra": extra})]
        missing = [r.name for r in needed if not _fits(r)]
        state = f"missing {', '.join(missing)}: pip install 'nsf[{extra}]'" if missing else "there"
        yield f"{extra:<10} {state}"


def _packages() -> Iterator[str]:
    """Each entry point of the group `nsf`, and which of its modules cannot be imported."""
    for point in entry_points():
        state = "; ".join(_broken(point.module)) or "there"
        yield f"{point.name:<10} {point.module} of {point.dist.name} {point.dist.version}: {state}"


def _broken(module: str) -> Iterator[str]:
    """Modules that cannot be imported, among one and those inside it, each with its error."""
    try:
        package = importlib.import_module(module)
    except (Exception, SystemExit) as error:
        yield f"{module} cannot be imported, {type(error).__name__}: {first_line(error)}"
        return
    for inner in pkgutil.iter_modules(getattr(package, "__path__", ()), f"{module}."):
        if not inner.name.endswith(".__main__"):  # which runs, where it is imported
            yield from _broken(inner.name)


def _fits(requirement) -> bool:
    try:
        version = importlib.metadata.version(requirement.name)
    except importlib.metadata.PackageNotFoundError:
        return False
    return requirement.specifier.contains(version, prereleases=True)
