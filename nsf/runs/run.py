"""Run folders: one folder a configuration, named by a hash of everything that determines its content."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from nsf import schemas
from nsf.canonical import content_hash, plain
from nsf.errors import ConfigError, MissingRunError, SchemaError, StorageError
from nsf.manifest import CONFIG, MANIFEST, NAME, altered, read_config, read_manifest
from nsf.runs.provenance import provenance
from nsf.runs.record import Record
from nsf.storage import clear_partial, in_use, locked, write_text

FORMAT = 3  # of a folder and the keys of its configuration; a new value gives every run a new hash
_LOCK = ".lock"
#: Keys of a run's configuration that its values follow from, or that say where they were read.
_SAID = ("scale", "files")
_LISTED = 8  # runs that an error names


@dataclass(frozen=True)
class Run:
    """One stage of one scene under one configuration: `root/stage/scene/hash`.

    Two runs are equal when they are the same folder. Make one with `open` (from a configuration), `named`
    (from what a user types), `newest` or `find` (every one there is).
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
            if not NAME.fullmatch(name):
                raise ConfigError(f"{key}={name!r} is no folder name; use letters, digits and _ . + -")
        settings = plain(config)
        ids = tuple(parent.id for parent in parents)
        return cls(stage, scene, _hash_of(stage, scene, settings, ids), _root(root), settings, ids)

    @classmethod
    def find(
        cls, stage: str | None = None, scene: str | None = None, root: str | Path | None = None
    ) -> list["Run"]:
        """Every run, of a stage or a scene where one is named, that was ever started, newest first.

        Broken ones are among them, last; folders with names that no run could have are not.
        """
        manifests = _root(root).glob(f"{stage or '*'}/{scene or '*'}/*/{MANIFEST}")
        names = (path.parts[-4:-1] for path in manifests)
        runs = [cls(*parts, _root(root)) for parts in names if _is_run(parts)]
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
                no other run shares, but for one of its stage that it was made from.
            stage: such as "deploy"; None for any.
            root: folder of all runs, for a name that is no folder; NSF_RUNS, else ./runs.

        Raises:
            MissingRunError: no run or several fit, which it lists; or the folder is of another stage.
        """
        path = Path(name).resolve()
        if (path / MANIFEST).is_file() and _is_run(path.parts[-3:]):
            if stage not in (None, path.parts[-3]):
                raise MissingRunError(f"{path} is a {path.parts[-3]} run; name a {stage} run")
            return cls(*path.parts[-3:], path.parents[2])
        recorded, beginning = cls.find(stage, root=root), name.strip("/")
        fit = [
            run
            for run in recorded
            if any(n.startswith(beginning) for n in (run.id, f"{run.scene}/{run.hash}", run.hash))
        ]
        # A deployment's error bound is calibrated by another one, which is not meant.
        calibrating = {parent for run in fit for parent in run.parents if parent.startswith(f"{run.stage}/")}
        fit = [run for run in fit if run.id not in calibrating]
        if len(fit) != 1:
            kind = f"{stage} run" if stage else "run"
            what = f"{len(fit)} {kind}s begin with" if fit else f"no {kind} is, or begins with,"
            raise MissingRunError(f"{what} {name!r} under {_root(root)}; {_listed(fit or recorded, stage)}")
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
        """The resolved configuration, from memory or from config.yaml.

        Raises:
            SchemaError: the file is missing or broken.
        """
        if self._config is not None:
            return self._config
        try:
            return read_config(self.path)
        except SchemaError as error:
            raise SchemaError(f"{self.path} is broken: {error}; run `nsf {self.stage}` again") from error

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
        """The manifest on disk; empty when there is none or it is broken."""
        with suppress(SchemaError):
            return read_manifest(self.path)
        return {}

    @property
    def fault(self) -> str | None:
        """Why what lies in the folder cannot be the run that the folder is named after; None if it can."""
        try:
            manifest = read_manifest(self.path)
            if not manifest:
                return None
            if manifest["format"] != FORMAT:
                return f"{MANIFEST} has format={manifest['format']}, of another nsf; this one reads {FORMAT}"
            if (manifest["stage"], manifest["scene"], manifest["hash"]) != (
                self.stage,
                self.scene,
                self.hash,
            ):
                return f"{MANIFEST} is of another run"
            if _hash_of(self.stage, self.scene, read_config(self.path), manifest["parents"]) != self.hash:
                return f"{CONFIG} was changed after the run"
        except SchemaError as error:
            return str(error)
        except KeyError as error:
            return f"{MANIFEST} lacks {error}"
        return None

    @property
    def status(self) -> str:
        """The manifest's status; "missing" without a manifest.

        Instead "broken" where there is a `fault`, "killed" where it says "running" and no process holds the
        run's lock, and "incomplete" where it says "complete" and files of the run are gone or cut short:
        data.keep=held_out deletes some.
        """
        if self.fault:
            return "broken"
        status = self.manifest.get("status", "missing")
        if status == "complete" and self._lost():
            return "incomplete"
        if status != "running":
            return status
        with suppress(StorageError):  # of someone else's folder
            return status if in_use(self.path / _LOCK) else "killed"
        return status

    @property
    def complete(self) -> bool:
        """Whether the run succeeded and its outputs are there in their recorded size."""
        return self.status == "complete"

    def _lost(self) -> list[str]:
        """Outputs of the manifest that are missing or of another size."""
        outputs = self.manifest.get("outputs", ())
        return [output["path"] for output in outputs if altered(self.path, output, sums=False)]

    def require(self) -> "Run":
        """This run, if it is complete.

        Raises:
            MissingRunError: it is not; says how far it came.
        """
        status = self.status
        if status == "complete":
            return self
        state = {
            "missing": "not there",
            "broken": f"broken ({self.fault})",
            "incomplete": f"not whole ({', '.join(self._lost())} missing or cut short)",
        }.get(status, status)
        why = f" ({error})" if (error := self.manifest.get("error")) else ""
        raise MissingRunError(
            f"{self.path} is {state}{why}; run `nsf {self.stage} scene={self.scene}` with the same keys"
        )

    def file(self, name: str) -> Path:
        """A file of this run for reading: what the run left, by its recorded size and sha256.

        The sha256 is found once a process for as long as the file stays the same.

        Raises:
            SchemaError: the file is not recorded, is gone, or was changed since.
        """
        output = next((o for o in self.manifest.get("outputs", ()) if o["path"] == name), None)
        if fault := "is not recorded in its manifest" if output is None else altered(self.path, output):
            raise SchemaError(
                f"{self.path / name} {fault}; delete the run's folder and run `nsf {self.stage}` again"
            )
        return self.path / name

    def metric(self, *keys: str, kind: Any = float) -> Any:
        """A value of the manifest's metrics.

        Args:
            keys: one in the other.
            kind: of the value, a schema of `nsf.schemas`.

        Raises:
            SchemaError: there is no such value.
        """
        value: Any = self.manifest.get("metrics")
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        try:
            schemas.check(value, kind, ".".join(keys))
        except SchemaError as error:
            raise SchemaError(
                f"{self.path / MANIFEST}: among its metrics {error}; delete the run's folder and run "
                f"`nsf {self.stage}` again"
            ) from error
        return value

    def verify(self) -> list[str]:
        """Faults of the folder, a line each; every recorded file is held to its sha256."""
        if fault := self.fault:
            return [f"{self.path}: {fault}"]
        faults = ((o["path"], altered(self.path, o)) for o in self.manifest.get("outputs", ()))
        return [f"{self.path / name} {fault}" for name, fault in faults if fault]

    @contextmanager
    def claimed(self, say: Callable[[str], object] | None = None) -> Iterator[bool]:
        """Keep other processes from making this run while the block works.

        Look whether the run is complete inside the block: another process may have made it meanwhile.

        Args:
            say: called with a line where another process makes the run, which is then waited for; None does
                not wait.

        Yields:
            Whether the run is claimed; False only where another process makes it and nothing is waited for.

        Raises:
            StorageError: the folder cannot be written.
        """
        line = f"{self.stage}: waiting for another process, which is making {self.id}"
        with locked(self.path / _LOCK, None if say is None else lambda: say(line)) as claimed:
            yield claimed

    @contextmanager
    def record(
        self,
        device: str = "cpu",
        seed: int | None = None,
        precision: str | None = None,
        warnings: Sequence[str] = (),
    ) -> Iterator[Record]:
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
        record = Record(self.path, manifest)
        with self.claimed(lambda line: None):
            clear_partial(self.path)
            self._write_config()
            with record.kept():
                yield record

    def _write_config(self) -> None:
        import yaml

        text = yaml.safe_dump(self.config, sort_keys=False, allow_unicode=True)
        write_text(self.path / CONFIG, text)


def _listed(runs: Sequence[Run], stage: str | None) -> str:
    """The remedy for a name that fits none or several: the runs to choose from, newest first."""
    if not runs:
        return f"run `nsf {stage or 'run'}` first"
    lines = [f"{run.id}  ({run.status})" for run in runs[:_LISTED]]
    if len(runs) > _LISTED:
        lines.append(f"and {len(runs) - _LISTED} more, which `nsf runs` lists")
    return "choose one of" + "".join(f"\n  {line}" for line in lines)


def _hash_of(stage: str, scene: str, config: dict[str, Any], parents: Sequence[str]) -> str:
    """The name of a run: a hash of all that determines its content; parents by their ids."""
    hashes = [parent.split("/")[-1] for parent in parents]
    content = {
        "format": FORMAT,
        "stage": stage,
        "scene": scene,
        "config": identity(config),
        "parents": hashes,
    }
    return content_hash(content)


def identity(config: Mapping[str, Any]) -> dict[str, Any]:
    """A run's configuration as it names the run: a file by its content, whatever its path."""
    files = config.get("files")
    files = files if isinstance(files, dict) else {}

    def by_content(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: by_content(item) for key, item in value.items()}
        if isinstance(value, list):
            return [by_content(item) for item in value]
        return files.get(value, value) if isinstance(value, str) else value

    return {key: by_content(value) for key, value in config.items() if key not in _SAID}


def _is_run(names: Sequence[str]) -> bool:
    """Whether a stage, a scene and a hash could name a folder of a run."""
    return len(names) == 3 and all(map(NAME.fullmatch, names))


def _root(root: str | Path | None) -> Path:
    return Path(root or os.environ.get("NSF_RUNS") or "runs").expanduser()
