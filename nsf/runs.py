"""Run folders: one folder a configuration, named by a hash of everything that determines its content."""

import hashlib
import json
import os
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nsf.canonical import content_hash, plain
from nsf.errors import ConfigError, MissingRunError, StorageError
from nsf.provenance import provenance
from nsf.storage import AGAIN, clear_partial, in_use, locked, write_json, writing

FORMAT = 1  # of the folder's layout; a new value gives every run a new hash
_NAME = re.compile(r"[A-Za-z0-9][\w.+-]*", re.ASCII)
_LOCK = ".lock"
_LISTED = 8  # runs that an error names


@dataclass(frozen=True)
class Run:
    """One stage of one scene under one configuration: `root/stage/scene/hash`.

    Two runs are equal when they are the same folder. Make one with `open`
    (from a configuration), `load` (from an id), `named` (from what a user types), `newest` or `find` (every
    one there is).
    """

    stage: str
    scene: str
    hash: str
    root: Path
    _config: dict[str, Any] | None = field(default=None, repr=False, compare=False)
    _parents: tuple[str, ...] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def open(
        cls,
        stage: str,
        scene: str,
        config: Mapping[str, Any],
        parents: Sequence["Run"] = (),
        root: str | Path | None = None,
    ) -> "Run":
        """Name the run of a configuration; nothing is read or written.

        Args:
            stage: such as "simulate"; a folder name.
            scene: such as "sand"; a folder name.
            config: resolved configuration of the stage (plain or OmegaConf).
            parents: runs whose files the stage reads, in the order it reads them.
            root: folder of all runs; NSF_RUNS, else ./runs.

        Raises:
            ConfigError: a name is no folder name, or `config` holds a missing,
                non-finite or non-JSON value.
        """
        for key, name in (("stage", stage), ("scene", scene)):
            if not _NAME.fullmatch(name):
                raise ConfigError(f"{key}={name!r} is no folder name; use letters, digits and _ . + -")
        settings = plain(config)
        content = {
            "format": FORMAT,
            "stage": stage,
            "scene": scene,
            "config": settings,
            "parents": [parent.hash for parent in parents],
        }
        return cls(
            stage, scene, content_hash(content), _root(root), settings, tuple(parent.id for parent in parents)
        )

    @classmethod
    def load(cls, run_id: str, root: str | Path | None = None) -> "Run":
        """The recorded run called `stage/scene/hash`.

        Raises:
            MissingRunError: no such run was ever started.
        """
        path = _root(root) / run_id
        if run_id.count("/") != 2 or not (path / "manifest.json").is_file():
            raise MissingRunError(
                f"no run {run_id!r} under {_root(root)}; run its stage first, or set NSF_RUNS"
            )
        stage, scene, digest = run_id.split("/")
        return cls(stage, scene, digest, _root(root))

    @classmethod
    def find(
        cls, stage: str | None = None, scene: str | None = None, root: str | Path | None = None
    ) -> list["Run"]:
        """Every run, of a stage or a scene where one is named, that was ever started, newest first."""
        manifests = _root(root).glob(f"{stage or '*'}/{scene or '*'}/*/manifest.json")
        runs = [cls(*path.parts[-4:-1], _root(root)) for path in manifests]
        return sorted(runs, key=lambda run: (run.manifest.get("created", ""), run.hash), reverse=True)

    @classmethod
    def newest(cls, stage: str, root: str | Path | None = None) -> "Run":
        """The newest complete run of a stage.

        Raises:
            MissingRunError: there is none.
        """
        if run := next((run for run in cls.find(stage, root=root) if run.complete), None):
            return run
        raise MissingRunError(
            f"no complete {stage} run under {_root(root)}; run `nsf {stage}` first, or set NSF_RUNS"
        )

    @classmethod
    def named(cls, name: str, stage: str | None = None, root: str | Path | None = None) -> "Run":
        """The recorded run that a user means, complete or not.

        Args:
            name: the run's folder, or as much of the beginning of its id, of `scene/hash` or of its hash as
                no other run shares.
            stage: such as "deploy"; None for any.
            root: folder of all runs, for a name that is no folder; NSF_RUNS, else ./runs.

        Raises:
            MissingRunError: no run or several fit, which it lists; or the folder is of another stage.
        """
        if (Path(name) / "manifest.json").is_file():
            path = Path(name).resolve()
            if stage not in (None, path.parts[-3]):
                raise MissingRunError(f"{path} is a {path.parts[-3]} run; name a {stage} run")
            return cls(*path.parts[-3:], path.parents[2])
        there, beginning = cls.find(stage, root=root), name.strip("/")
        fit = [
            run
            for run in there
            if any(n.startswith(beginning) for n in (run.id, f"{run.scene}/{run.hash}", run.hash))
        ]
        if len(fit) != 1:
            kind = f"{stage} run" if stage else "run"
            what = f"{len(fit)} {kind}s begin with" if fit else f"no {kind} is, or begins with,"
            raise MissingRunError(f"{what} {name!r} under {_root(root)}; {_listed(fit or there, stage)}")
        return fit[0]

    @property
    def id(self) -> str:
        """`stage/scene/hash`."""
        return f"{self.stage}/{self.scene}/{self.hash}"

    @property
    def path(self) -> Path:
        """The run's folder; it exists once the run was recorded."""
        return self.root / self.stage / self.scene / self.hash

    @property
    def config(self) -> dict[str, Any]:
        """The resolved configuration, from memory or from config.yaml."""
        if self._config is not None:
            return self._config
        from omegaconf import OmegaConf  # 0.2 s that `nsf --help` need not pay

        return OmegaConf.to_container(OmegaConf.load(self.path / "config.yaml"))  # type: ignore[return-value]

    @property
    def parents(self) -> tuple[str, ...]:
        """Ids of the runs whose files this one reads."""
        return tuple(self.manifest.get("parents", ())) if self._parents is None else self._parents

    @property
    def parent_runs(self) -> list["Run"]:
        """The runs whose files this one reads, whether or not they are there."""
        return [Run(*parent.split("/"), self.root) for parent in self.parents]

    @property
    def manifest(self) -> dict[str, Any]:
        """The manifest on disk; empty when there is none or it cannot be read."""
        try:
            manifest = json.loads((self.path / "manifest.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return manifest if isinstance(manifest, dict) else {}

    @property
    def status(self) -> str:
        """The manifest's status.

        Instead "killed" where it says "running" and no process holds the run's lock, and "incomplete" where
        it says "complete" and files of the run are gone or cut short: data.keep=held_out deletes some.
        """
        manifest = self.manifest
        status = manifest.get("status", "missing")
        if status == "complete" and self._lost(manifest):
            return "incomplete"
        if status != "running":
            return status
        with suppress(StorageError):  # of someone else's folder
            return status if in_use(self.path / _LOCK) else "killed"
        return status

    @property
    def complete(self) -> bool:
        """Whether the run succeeded and its outputs are there in their recorded size."""
        manifest = self.manifest
        if manifest.get("status") != "complete" or manifest.get("hash") != self.hash:
            return False
        return not self._lost(manifest)

    def _lost(self, manifest: dict[str, Any]) -> list[str]:
        """Outputs of the manifest that are missing or of another size."""

        def whole(output) -> bool:
            try:
                return (self.path / output["path"]).stat().st_size == output["bytes"]
            except (OSError, KeyError, TypeError):
                return False

        outputs = manifest.get("outputs")
        if not isinstance(outputs, list):
            return ["manifest.json"]
        return [str(o["path"]) if isinstance(o, dict) else "manifest.json" for o in outputs if not whole(o)]

    def require(self) -> "Run":
        """This run, if it is complete.

        Raises:
            MissingRunError: it is not; says how far it came.
        """
        if self.complete:
            return self
        manifest = self.manifest
        status = self.status if manifest else "not there"
        lost = ", ".join(self._lost(manifest))
        state = f"not whole ({lost} missing or cut short)" if status == "incomplete" else status
        if status == "complete":
            state = "not whole (its manifest is of another run)"
        why = f" ({manifest['error']})" if manifest.get("error") else ""
        raise MissingRunError(
            f"{self.path} is {state}{why}; run `nsf {self.stage} scene={self.scene}` with the same keys"
        )

    @contextmanager
    def claimed(self, say: Callable[[str], object] | None = None) -> Iterator[bool]:
        """Keep other processes from making this run while the block works.

        Look whether the run is complete inside the block: another process may have made it meanwhile.

        Args:
            say: told that another process makes the run, which is then waited for; None does not wait.

        Yields:
            Whether the run is claimed; False only where another process makes it and nothing is waited for.

        Raises:
            StorageError: the folder cannot be written.
        """
        told = f"{self.stage}: waiting for another process, which is making {self.id}"
        with locked(self.path / _LOCK, None if say is None else lambda: say(told)) as claimed:
            yield claimed

    @contextmanager
    def record(
        self,
        device: str = "cpu",
        seed: int | None = None,
        precision: str | None = None,
        warnings: Sequence[str] = (),
    ) -> Iterator["Record"]:
        """Keep the manifest while the block works.

        The status is "running" from the start; "complete" after the block,
        "failed" after an exception, "interrupted" after an interrupt. Every
        exception goes on to the caller. A killed process leaves "running".
        Only one process records a run at a time; see `claimed`.

        Args:
            device: such as "cpu" or "cuda:0".
            seed: of every generator in the block.
            precision: such as "fp64".
            warnings: lines for whoever uses the run's results; a manifest without any has no such key.

        Raises:
            StorageError: the folder cannot be written, or was deleted or moved meanwhile.
        """
        manifest: dict[str, Any] = {
            "format": FORMAT,
            "stage": self.stage,
            "scene": self.scene,
            "hash": self.hash,
            "parents": list(self.parents),
            **provenance(),
            "device": str(device),
            "seed": seed,
            "precision": precision,
            "created": datetime.now(UTC).isoformat(timespec="microseconds"),
            **({"warnings": list(warnings)} if warnings else {}),
        }
        record = Record(self, manifest["created"])
        start = time.perf_counter()

        def close(status: str, metrics: dict[str, Any], **more: Any) -> None:
            ending = {
                "status": status,
                **more,
                "seconds": time.perf_counter() - start,
                "metrics": metrics,
                "outputs": list(record.outputs.values()),
            }
            write_json(self.path / "manifest.json", manifest | ending)

        with self.claimed(lambda told: None):
            clear_partial(self.path)
            self._write_config()
            write_json(self.path / "manifest.json", {**manifest, "status": "running"})
            try:
                yield record
                record.require_folder()
                close("complete", record.plain_metrics())
            except BaseException as error:
                if isinstance(error, Exception):
                    record.require_folder()
                status = "failed" if isinstance(error, Exception) else "interrupted"
                metrics: dict[str, Any] = {}
                # A full disk, or a metric that no manifest can hold, must not hide the first error.
                with suppress(ConfigError):
                    metrics = record.plain_metrics()
                with suppress(StorageError):
                    record.require_folder()
                    close(status, metrics, error=f"{type(error).__name__}: {error}")
                raise

    def _write_config(self) -> None:
        from omegaconf import OmegaConf

        # OmegaConf quotes strings that look like numbers; yaml.safe_dump leaves "1e-5" bare.
        text = OmegaConf.to_yaml(OmegaConf.create(self.config))
        with writing(self.path / "config.yaml") as partial:
            partial.write_text(text, encoding="utf-8")


class Record:
    """What a running stage says about itself: `metrics`, and the files it made."""

    def __init__(self, run: Run, created: str) -> None:
        self.path = run.path
        self._run, self._created = run, created
        self.metrics: dict[str, Any] = {}
        self.outputs: dict[str, dict[str, Any]] = {}

    def require_folder(self) -> None:
        """Refuse to go on where the folder is no longer the one that the run began with.

        Raises:
            StorageError: it was deleted or moved.
        """
        if self._run.manifest.get("created") != self._created:
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
            with file.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            self.outputs[name] = {"path": name, "bytes": file.stat().st_size, "sha256": digest}
        return path

    def plain_metrics(self) -> dict[str, Any]:
        """The metrics as JSON holds them; a value that is not finite becomes null.

        Raises:
            ConfigError: a metric is of a kind that JSON cannot hold.
        """
        return plain(self.metrics, finite=False, key="metrics")


def _listed(runs: Sequence[Run], stage: str | None) -> str:
    """The remedy for a name that fits none or several: the runs to choose from, newest first."""
    if not runs:
        return f"run `nsf {stage or 'run'}` first"
    lines = [f"{run.id}  ({run.status})" for run in runs[:_LISTED]]
    if len(runs) > _LISTED:
        lines.append(f"and {len(runs) - _LISTED} more, which `nsf runs` lists")
    return "choose one of" + "".join(f"\n  {line}" for line in lines)


def _root(root: str | Path | None) -> Path:
    return Path(root or os.environ.get("NSF_RUNS") or "runs").expanduser()
