"""Errors of a reduced run against its full-order truth: pure functions."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor

from nsf.errors import InstabilityError, ShapeError


def _same_shape(a: Tensor, b: Tensor) -> None:
    if a.shape != b.shape:
        raise ShapeError(f"trajectories differ in shape: {tuple(a.shape)} and {tuple(b.shape)}")


def frame_squares(values: Float[Tensor, "frame particle component"]) -> Float[Tensor, " frame"]:
    """Σ over particles and components of the squares, in float64, a frame at a time."""
    return values.double().square().sum((1, 2))


def relative(error: Float[Tensor, " frame"], reference: Float[Tensor, " frame"]) -> float:
    """√(Σ error / Σ reference) of sums of squares by frame."""
    return float((error.sum() / reference.sum()).sqrt())


def require_finite(errors: Mapping[str, float], where: str) -> None:
    """Refuse errors that are none: a run that diverged is named so, and its errors are not asked for.

    Args:
        errors: by name.
        where: they were found, such as "friction_angle=26".

    Raises:
        InstabilityError: one is not finite; names it.
    """
    for name, value in errors.items():
        if not math.isfinite(value):
            raise InstabilityError(
                f"{name}={value} at {where} is no error: the fields give values that are not finite, or the "
                "full-order run neither moves nor bears stress; train again, or evaluate on another scene"
            )


def deformation_error(
    x_rom: Float[Tensor, "frame particle 3"], x_fom: Float[Tensor, "frame particle 3"]
) -> float:
    """Relative deformation error δ = ‖x_rom − x_fom‖ / ‖x_fom‖.

    Dimensionless, over frames 1..N (the caller drops frame 0). Depends on where the
    origin lies; show `displacement_error` beside it.

    Args:
        x_rom: g(X_p, x̂_n) [m].
        x_fom: φ(X_p, t_n) [m], same frames and particle order.

    Raises:
        ShapeError: the trajectories differ in shape.

    Source: Zong et al. 2023, section 6, "error def".
    """
    _same_shape(x_rom, x_fom)
    return relative(frame_squares(x_rom - x_fom), frame_squares(x_fom))


def displacement_error(
    x_rom: Float[Tensor, "frame particle 3"],
    x_fom: Float[Tensor, "frame particle 3"],
    X: Float[Tensor, "particle 3"],
) -> float:
    """Relative displacement error ‖x_rom − x_fom‖ / ‖x_fom − X‖, which no shift of the origin changes.

    Args:
        x_rom, x_fom: as for `deformation_error` [m].
        X: reference positions [m].

    Raises:
        ShapeError: the trajectories differ in shape.
    """
    _same_shape(x_rom, x_fom)
    return relative(frame_squares(x_rom - x_fom), frame_squares(x_fom - X))


def tensor_squares(tau: Float[Tensor, "frame particle 6"]) -> Float[Tensor, " frame"]:
    """Σ over particles of ‖τ‖_F² of symmetric tensors xx, xy, xz, yy, yz, zz (off-diagonals count twice)."""
    twice = torch.tensor([1.0, 2.0, 2.0, 1.0, 2.0, 1.0], dtype=torch.float64, device=tau.device)
    return (tau.double().square() * twice).sum((1, 2))


def von_mises(tau: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Equivalent stress √(3/2) ‖dev τ‖ [Pa] of τ [Pa], entries xx, xy, xz, yy, yz, zz.

    Source: de Souza Neto, Peric and Owen 2008, section 6.4.1.
    """
    xx, xy, xz, yy, yz, zz = tau.unbind(-1)
    mean = (xx + yy + zz) / 3
    shear = xy.square() + xz.square() + yz.square()
    return (1.5 * ((xx - mean) ** 2 + (yy - mean) ** 2 + (zz - mean) ** 2 + 2 * shear)).sqrt()


def pressure(tau: Float[Tensor, "*batch 6"]) -> Float[Tensor, "*batch"]:
    """Pressure −tr τ / 3 [Pa] of the Kirchhoff stress τ [Pa], positive in compression."""
    return -(tau[..., 0] + tau[..., 3] + tau[..., 5]) / 3


def stress_error(
    tau_rom: Float[Tensor, "frame particle 6"], tau_fom: Float[Tensor, "frame particle 6"]
) -> float:
    """Relative error ‖τ_rom − τ_fom‖ / ‖τ_fom‖ of the Kirchhoff stress, Frobenius norms.

    Raises:
        ShapeError: the trajectories differ in shape.
    """
    _same_shape(tau_rom, tau_fom)
    return relative(tensor_squares(tau_rom - tau_fom), tensor_squares(tau_fom))
