"""The manifold of deformation, stress and affine fields, and its file (paper section 4)."""

from __future__ import annotations

import dataclasses
import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from nsf import schemas
from nsf.data import Standardizer, archives
from nsf.errors import NSFError, SchemaError, ShapeError, first_line
from nsf.kinematics import checkpoint
from nsf.kinematics.blocks import frames_at_once
from nsf.schemas import Number
from nsf.storage import writing
from nsf.vectors import drawn

_SOME = 500  # particles that stand for the body


class Restriction(ABC):
    """The fields g, h and l at n fixed material points, as a deployed model evaluates them.

    `xhat` is [r] or a batch [F, r]; every result then gains the leading F. `parameters` is [n_parameters] or
    [F, n_parameters] in the order of `Manifold.parameter_names`. No call synchronises with the host, so all
    can be captured in a CUDA graph (after one warm-up call each).
    """

    points: int
    latent_dim: int
    dtype: torch.dtype
    device: torch.device
    #: Whether C depends on dx̂/dt.
    takes_rate: bool = False

    @abstractmethod
    def position(self, xhat: Tensor) -> Tensor:
        """x = g(X, xhat), [n, 3] in metres."""

    def positions(self, xhat: Tensor, tolerance: float = 0.0) -> Iterator[Tensor]:
        """Positions [f, n, 3] [m] of x̂ [F, r], in blocks of as many frames f as memory has room for.

        A block is good until the next one is taken, which may be written over it. Nothing is differentiable.

        Args:
            xhat: latent vectors.
            tolerance: error over the displacements that arithmetic may add; a tenth of the model's is hidden
                in it. A field of modes in fp32 then takes a GPU's tensor cores, where these are near enough.
        """
        for part in xhat.split(frames_at_once(3 * self.points, self.dtype, self.device)):
            with torch.no_grad():
                block = self.position(part.to(self.device))
            yield block

    @abstractmethod
    def position_and_jacobian(self, xhat: Tensor) -> tuple[Tensor, Tensor]:
        """x [n, 3] in metres and ∂g/∂xhat [n, 3, r]."""

    @abstractmethod
    def stress(self, xhat: Tensor, parameters: Tensor) -> Tensor:
        """Kirchhoff stress tau = h(X, xhat, μ), [n, 6] in pascals, order xx xy xz yy yz zz."""

    def stress_of(self, coordinates: Tensor) -> Tensor:
        """τ [..., n, 6] [Pa] of its coordinates [..., n_s] in the leading modes of a field that has modes."""
        raise ShapeError("the stress field has no modes, whose coordinates these would be")

    @abstractmethod
    def affine(self, xhat: Tensor, parameters: Tensor, rate: Tensor | None = None) -> Tensor:
        """Affine velocity matrix C = l(X, xhat, μ), [n, 3, 3] in 1/s.

        `rate` is dx̂/dt [r] in 1/s, or [F, r]; a field with `takes_rate` needs it, others pass over it.
        """

    @abstractmethod
    def deformation_gradient(self, xhat: Tensor) -> Tensor:
        """F = ∂g/∂X, [n, 3, 3], dimensionless."""

    @abstractmethod
    def module(self, phase: str) -> nn.Module:
        """The field of a phase (`PHASES`) in raw units, for exporters; the problem parameters are an input.

        `forward` takes tensors called as they are here: xhat [F, r], parameters [n_parameters] and, where the
        field is a function of X and not of the restriction's points, X [n, 3]; it gives [F, n, …].
        """

    @abstractmethod
    def subset(self, rows: slice) -> Restriction:
        """The same fields at some of the points, sharing memory with this restriction."""

    @property
    def nbytes(self) -> int:
        """Bytes of every tensor it holds; memory that tensors share counts once."""
        storages = {t.untyped_storage().data_ptr(): t.untyped_storage().nbytes() for t in _tensors(self)}
        return sum(storages.values())


def _tensors(node: Any) -> Iterator[Tensor]:
    """Tensors in the attributes of a restriction, in its containers and networks."""
    if isinstance(node, Tensor):
        yield node
    elif isinstance(node, nn.Module):
        yield from itertools.chain(node.parameters(), node.buffers())
    elif isinstance(node, dict | list | tuple):
        for child in node.values() if isinstance(node, dict) else node:
            yield from _tensors(child)
    elif dataclasses.is_dataclass(node) or isinstance(node, Restriction):
        yield from _tensors(vars(node))


class Manifold(nn.Module, ABC):
    """Fields g, h, l over Ω₀ and the encoder e, for the particles and the latent space they were trained on.

    A manifold lives where `.to(device)` puts it (on the host once loaded); `restrict` moves only the rows of
    its points.

    Args:
        latent_dim: r.
        x_sha256: identity of the training particles.
        parameter_names: problem parameters μ, in the order of every parameter tensor.
        hyperparameters: plain containers; enough, with the above, to rebuild the modules. `particles` (P) and
            `frames` (M) size the buffers here; `head_parameters`: h and l see the problem parameters.

    Attributes:
        X: rest positions of the training particles [P, 3] m.
        training_latents: xhat of every training snapshot [M, r].
        training_parameters, training_times: their μ [M, n] and t [M] s.
    """

    #: Of which kind each of them is, as a schema of `nsf.schemas`; a class with more adds its own.
    HYPERPARAMETERS: ClassVar[Mapping] = {
        "particles": Number(1, whole=True),
        "frames": Number(1, whole=True),
        "beta": [Number(1, whole=True)],
        "head_parameters": bool,
    }

    def __init__(
        self, latent_dim: int, x_sha256: str, parameter_names: list[str], hyperparameters: dict[str, Any]
    ):
        super().__init__()
        self.latent_dim = latent_dim
        self.x_sha256 = x_sha256
        self.parameter_names = tuple(parameter_names)
        self.hyperparameters = dict(hyperparameters)
        schemas.check(self.hyperparameters, self.HYPERPARAMETERS, "hyperparameters")
        P, M, n = hyperparameters["particles"], hyperparameters["frames"], len(self.parameter_names)
        for name, shape in {
            "X": (P, 3),
            "training_latents": (M, latent_dim),
            "training_parameters": (M, n),
            "training_times": (M,),
        }.items():
            self.register_buffer(name, torch.zeros(shape, dtype=torch.float64))
        self.standard_parameters = identity(n)

    def describe(self, snapshots) -> None:
        """Copy the particles, parameters and times of the training snapshots into the manifold."""
        self.X.copy_(torch.as_tensor(snapshots.X))
        self.training_parameters.copy_(snapshots.parameters)
        self.training_times.copy_(snapshots.t)
        if self.parameter_names:
            self.standard_parameters = Standardizer.fit([snapshots.parameters])

    def takes_parameters(self, phase: str) -> bool:
        """Whether the phase's network sees the problem parameters."""
        return phase != "deformation" and self.hyperparameters["head_parameters"]

    def standardisation(self, phase: str, mean: Tensor, std: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and deviation of a network's inputs, followed by those of the parameters that it sees."""
        if not self.takes_parameters(phase):
            return mean, std
        mu = self.standard_parameters
        return torch.cat([mean, mu.mean.to(mean)]), torch.cat([std, mu.std.to(std)])

    @property
    def training_trajectories(self) -> Tensor:
        """[M] number of the trajectory that each training snapshot is of.

        Snapshots are by trajectory, then by time: where time does not grow, another trajectory begins.
        """
        begins = torch.diff(self.training_times, prepend=self.training_times[:1]) <= 0
        return begins.long().cumsum(0) - 1

    @property
    def field(self) -> str:
        """Short name of its family, that of the module which defines it: "basis", "mlp"."""
        return type(self).__module__.rpartition(".")[2]

    @abstractmethod
    def encode(self, x: Tensor) -> Tensor:
        """Latents xhat [F, r] (float64) of whole frames x [F, P, 3] m of the training particles."""

    @abstractmethod
    def restrict(
        self,
        particles: Tensor | None = None,
        X: Tensor | None = None,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> Restriction:
        """The fields at training particles (indices [n]; all if neither is given) or at points X [n, 3] m."""

    def at_some(self) -> tuple[np.ndarray, Restriction]:
        """Indices of 500 particles, alike at each call, and the fields at them, which stand for the body."""
        particles = drawn(len(self.X), _SOME)
        return particles, self.restrict(torch.as_tensor(particles), device=self.X.device)

    def check_particles(self, x_sha256: str) -> None:
        """Refuse particles other than those of training.

        Raises:
            SchemaError: the identities differ.
        """
        if x_sha256 != self.x_sha256:
            raise SchemaError(
                f"checkpoint made for other particles: its X has sha256 {self.x_sha256[:12]}, the particles"
                f" given {x_sha256[:12]}; deploy on the scene and resolution of its training, or train again"
            )

    def check_frames(self, x: Tensor) -> None:
        """Refuse frames that are not [F, P, 3]."""
        if x.ndim != 3 or x.shape[1:] != self.X.shape:
            raise ShapeError(
                f"frames have shape {tuple(x.shape)}; this manifold encodes [F, {self.X.shape[0]}, 3]:"
                " pass whole frames of the training particles"
            )

    def points(self, particles: Tensor | None, X: Tensor | None) -> tuple[Tensor | slice | None, Tensor]:
        """Rows of training particles (None: points of X) and their rest positions [n, 3]."""
        if particles is not None and X is not None:
            raise ShapeError("restrict takes particles or X, not both; leave one out")
        if X is not None:
            return None, torch.as_tensor(X, dtype=torch.float64)
        rows = (
            slice(None)
            if particles is None
            else torch.as_tensor(particles, dtype=torch.long).to(self.X.device)
        )
        return rows, self.X[rows]

    def save(self, path: Path | str) -> None:
        """Write the checkpoint to `path`: whole or not at all.

        Raises:
            SchemaError: its class is in no module of `nsf.kinematics.fields`, where `load` would look for it.
        """
        name = f"{type(self).__module__}.{type(self).__qualname__}"
        checkpoint.class_of(name, Manifold)
        content = {
            "format": checkpoint.FORMAT,
            "format_version": checkpoint.FORMAT_VERSION,
            "manifold": name,
            "latent_dim": self.latent_dim,
            "x_sha256": self.x_sha256,
            "parameter_names": list(self.parameter_names),
            "hyperparameters": self.hyperparameters,
            "state": dict(self.state_dict()),
        }
        with writing(Path(path)) as temporary, temporary.open("wb") as file:
            torch.save(content, file)

    @staticmethod
    def load(path: Path | str) -> Manifold:
        """Read a checkpoint of any field onto the host.

        The file is mapped: a restriction to few particles holds few of its pages.

        Raises:
            MissingRunError: there is no such file.
            SchemaError: the file was changed after its run, is truncated, foreign, of a newer format, holds
                more than plain data, or values that no training leaves.
        """
        path = Path(path)
        content = checkpoint.read(path)
        about = ("latent_dim", "x_sha256", "parameter_names", "hyperparameters")
        try:
            kind = checkpoint.class_of(content.get("manifold"), Manifold)
            with torch.device("meta"):
                manifold = kind(*(content[key] for key in about))
            checkpoint.fill(manifold, content["state"])
            checkpoint.check_filled(manifold)
        except SchemaError as error:
            remedy = "" if ";" in str(error) else "; train again with `nsf train`"
            raise SchemaError(f"{path} {error}{remedy}") from error
        except (*archives.FAULTS, NSFError) as error:
            raise SchemaError(
                f"{path} names {content['manifold']} but its contents do not fit it"
                f" ({first_line(error)}); train again with `nsf train`"
            ) from error
        return manifold.requires_grad_(False).eval()


def identity(components: int) -> Standardizer:
    """The standardisation by 0 and 1, a place for buffers of a checkpoint or of data."""
    # On the host even while a checkpoint is rebuilt on the meta device: Standardizer looks at the values.
    return Standardizer(torch.zeros(components, device="cpu"), torch.ones(components, device="cpu"))
