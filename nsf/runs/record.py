"""The manifest of a run while its stage works: what the stage tells of itself, and how it ended."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from nsf.canonical import plain
from nsf.errors import ConfigError, SchemaError, StorageError
from nsf.manifest import MANIFEST, digest, read_manifest
from nsf.storage import AGAIN, write_json


class Record:
    """The record of a running stage: its `metrics`, and the files it made.

    Args:
        path: folder of the run.
        manifest: what is known of the run before it begins; by the time of its creation the folder is known.
    """

    def __init__(self, path: Path, manifest: dict[str, Any]) -> None:
        self.path, self._manifest, self._started = path, manifest, time.perf_counter()
        self.metrics: dict[str, Any] = {}
        self.outputs: dict[str, dict[str, Any]] = {}

    def require_folder(self) -> None:
        """Refuse to go on where the folder is no longer the one that the run began with.

        Raises:
            StorageError: it was deleted or moved.
        """
        with suppress(SchemaError):
            if read_manifest(self.path).get("created") == self._manifest["created"]:
                return
        raise StorageError(f"{self.path} was deleted or moved while its files were being made; {AGAIN}")

    def output(self, path: str | Path) -> Path:
        """Enter a finished file, or every file of a folder, into the manifest.

        Args:
            path: within the run's folder, absolute or relative to it.

        Raises:
            ConfigError: the path leaves the run's folder or does not exist.
            StorageError: the folder was deleted or moved.
        """
        self.require_folder()
        path = self.path / path
        files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
        if not files or not path.resolve().is_relative_to(self.path.resolve()):
            raise ConfigError(f"output {path} is no file inside {self.path}; write it there first")
        for file in files:
            name = file.resolve().relative_to(self.path.resolve()).as_posix()
            self.outputs[name] = {"path": name, "bytes": file.stat().st_size, "sha256": digest(file)}
        return path

    def warn(self, lines: Sequence[str]) -> None:
        """Add lines for whoever uses the run's results to `warnings` of the manifest."""
        if lines:
            self._manifest["warnings"] = [*self._manifest.get("warnings", ()), *lines]

    def plain_metrics(self) -> dict[str, Any]:
        """The metrics as JSON holds them; a value that is not finite becomes null.

        Raises:
            ConfigError: a metric is of a kind that JSON cannot hold.
        """
        return plain(self.metrics, finite=False, key="metrics")

    @contextmanager
    def kept(self) -> Iterator["Record"]:
        """Keep the manifest while the block works; see `Run.record`."""
        write_json(self.path / MANIFEST, {**self._manifest, "status": "running"})
        try:
            yield self
            self.require_folder()
            self._close("complete", self.plain_metrics())
        except BaseException as error:
            if isinstance(error, Exception):
                self.require_folder()
            status = "failed" if isinstance(error, Exception) else "interrupted"
            metrics: dict[str, Any] = {}
            # A full disk, or a metric that no manifest can hold, must not hide the first error.
            with suppress(ConfigError):
                metrics = self.plain_metrics()
            with suppress(StorageError):
                self.require_folder()
                self._close(status, metrics, error=f"{type(error).__name__}: {error}")
            raise

    def _close(self, status: str, metrics: dict[str, Any], **more: Any) -> None:
        ending = {
            "status": status,
            **more,
            "seconds": time.perf_counter() - self._started,
            "metrics": metrics,
            "outputs": list(self.outputs.values()),
        }
        write_json(self.path / MANIFEST, self._manifest | ending)
