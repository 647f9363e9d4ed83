"""Where the reduced step takes τ and C from: fields, ∂g/∂X (paper section 6.1), or particles."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import torch
import warp as wp

from nsf.data import TAU_MATRIX
from nsf.dynamics.interop import as_matrices, as_scalars, on_torch_stream
from nsf.errors import ConfigError
from nsf.mpm import Precision
from nsf.mpm.materials import Material, make_elastic_stress

STRESS = ("field", "deformation", "particles")
AFFINE = ("field", "none", "particles")


@dataclass(frozen=True)
class Sources:
    """Where a reduced step takes τ and C from.

    With `particles` both follow the grid at every particle, as at full order, and x and v are the manifold's.
    Each particle keeps F_e, the law's history variables and C: under forcing that no training run had, the
    stress of a plastic body depends on the way to a state, which no field of x̂ can tell. Such a step moves
    every particle, so it costs as much as a full-order step. The fields h and l decode latent vectors, and
    start a run in its midst. Not in the paper; internal variables at the points of integration, with reduced
    kinematics, are those of Ryckelynck 2009 (Hyper-reduction of mechanical models involving internal
    variables).

    Attributes:
        stress: of τ: the stress field h (`field`), ∂g/∂X through the elastic law (`deformation`), or
            `particles`.
        affine: of C: the affine field l (`field`), C = 0 (`none`), or `particles`.

    Raises:
        ConfigError: another value, or particles carry τ alone or C alone.

    Source: paper sections 4.3 and 4.4; deformation and none are Chen et al. 2023a.
    """

    stress: str = "field"
    affine: str = "field"

    def __post_init__(self):
        for name, options in (("stress", STRESS), ("affine", AFFINE)):
            if (value := getattr(self, name)) not in options:
                raise ConfigError(f"{name}={value} is unknown; choose one of {', '.join(options)}")
        if (self.stress == "particles") != (self.affine == "particles"):
            raise ConfigError(
                f"stress={self.stress} does not go with affine={self.affine}: particles carry both; set "
                "stress=particles affine=particles, or neither"
            )

    @property
    def carried(self) -> bool:
        """Whether particles carry τ and C."""
        return self.stress == "particles"

    @property
    def neural_stress(self) -> bool:
        """Whether τ of a latent vector comes from the stress field."""
        return self.stress != "deformation"

    @property
    def neural_affine(self) -> bool:
        """Whether C of a latent vector comes from the affine field."""
        return self.affine != "none"

    def stress_of(
        self,
        at,
        parameters: torch.Tensor,
        material: Material,
        mu: torch.Tensor,
        lam: torch.Tensor,
        precision: Precision,
        device,
    ) -> Callable[[torch.Tensor], torch.Tensor]:
        """The source of τ: x̂ [r] → [n, 3, 3] [Pa].

        Args:
            at: fields restricted to n points.
            parameters: [n_parameters] problem parameters μ.
            material: the law; mu, lam: [n] Lamé parameters [Pa] of the points.
            precision, device: of the law's kernel.
        """
        if self.neural_stress:
            return StressNeural(at, parameters)
        return StressFromDeformation(at, material, mu, lam, precision, device)

    def affine_of(
        self, at, parameters: torch.Tensor
    ) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor | None]:
        """The source of C at restricted fields: x̂ [r], dx̂/dt [r] → [n, 3, 3] [1/s], or None for C = 0."""
        if self.neural_affine:
            return lambda xhat, rate: at.affine(xhat, parameters, rate)
        return lambda xhat, rate: None


class StressNeural:
    """τ = h(X, x̂, μ) (paper section 4.3), also of x̂ [F, r]."""

    of_batches: ClassVar[bool] = True

    def __init__(self, at, parameters: torch.Tensor):
        self.at, self.parameters = at, parameters
        self._expand = torch.tensor(TAU_MATRIX, device=parameters.device).flatten()

    def __call__(self, xhat: torch.Tensor) -> torch.Tensor:
        """[..., n, 3, 3] Kirchhoff stress [Pa]."""
        tau = self.at.stress(xhat, self.parameters)
        return tau.index_select(-1, self._expand).unflatten(-1, (3, 3))


class StressFromDeformation:
    """τ = τ(∂g/∂X) through the elastic law; plastic flow is not seen (Chen et al. 2023a).

    Without flow there is no history to follow: its variables keep their values at rest.

    Args:
        at: restricted fields; material: the law; mu, lam: [n] Lamé parameters [Pa].
    """

    def __init__(
        self, at, material: Material, mu: torch.Tensor, lam: torch.Tensor, precision: Precision, device
    ):
        self.at, self.precision, self.device = at, precision, device
        self.mu, self.lam = mu, lam
        self.tau = torch.zeros(len(mu), 3, 3, dtype=mu.dtype, device=mu.device)
        vecH = wp.types.vector(length=material.history_size, dtype=precision.real)
        self._history = wp.array(material.initial_history(len(mu)), dtype=vecH, device=device)
        self._kernel = make_elastic_stress(material.functions(precision), precision, material.history_size)

    def __call__(self, xhat: torch.Tensor) -> torch.Tensor:
        """[n, 3, 3] Kirchhoff stress [Pa]."""
        F = self.at.deformation_gradient(xhat).contiguous()
        moduli = [as_scalars(self.mu), as_scalars(self.lam)]
        tau = as_matrices(self.tau, self.precision)
        with on_torch_stream(self.device):
            wp.launch(
                self._kernel,
                dim=len(F),
                inputs=[as_matrices(F, self.precision), self._history, *moduli, tau],
                device=self.device,
            )
        return self.tau
