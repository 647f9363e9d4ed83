"""Material-point driver: walk a law along a path of deformation gradients."""

from collections.abc import Callable

import numpy as np
import warp as wp

from nsf.errors import ConfigError, InstabilityError, ShapeError
from nsf.mpm.device import warp_device
from nsf.mpm.materials.base import Material, make_stress_update
from nsf.mpm.precision import Precision, precision_of
from nsf.scalars import one_of


def drive(
    material: Material,
    F_path: np.ndarray,
    dt: float,
    precision: str | Precision = "fp64",
    device: str = "cpu",
) -> np.ndarray:
    """Kirchhoff stress of one material point along a deformation path.

    The point starts undeformed. At each row the elastic predictor is
    F_trial = F_k F_{k−1}⁻¹ F_e (F_{−1} = I). The law's return map and history update
    follow, as for a particle of the full-order solver.

    Args:
        material: the law.
        F_path: [n, 3, 3] total deformation gradients, det F > 0.
        dt: time between rows [s]; matters to rate-dependent laws only.
        precision: `fp64` or `fp32`.
        device: `cpu` or `cuda`.

    Returns:
        [n, 3, 3] Kirchhoff stress [Pa] after each row.

    Raises:
        ShapeError: F_path is not [n, 3, 3].
        ConfigError: dt is not positive, or F_path has non-finite values or det F ≤ 0.
        InstabilityError: the law returned a non-finite stress.
    """
    precision = precision_of(precision)
    device = warp_device(device)
    F_path = np.asarray(F_path, np.float64)
    if F_path.ndim != 3 or F_path.shape[1:] != (3, 3) or not len(F_path):
        raise ShapeError(f"F_path has shape {F_path.shape}; give [n, 3, 3] with n > 0")
    if not dt > 0:
        raise ConfigError(f"dt={dt} s must be positive")
    bad = ~(np.isfinite(F_path).all((1, 2)) & (np.linalg.det(F_path) > 0))
    if bad.any():
        raise ConfigError(f"F_path[{int(bad.argmax())}] is not finite with a positive determinant")

    previous = np.concatenate([np.eye(3)[None], F_path[:-1]])
    increments = (F_path @ np.linalg.inv(previous)).astype(precision.numpy)
    n = len(F_path)
    update = make_stress_update(material.functions(precision), precision, material.history_size)
    vecH = wp.types.vector(length=material.history_size, dtype=precision.real)
    steps = wp.array(increments, dtype=precision.mat33, device=device)
    tau = wp.zeros(n, dtype=precision.mat33, device=device)
    F_e = wp.array(np.eye(3)[None], dtype=precision.mat33, device=device)
    history = wp.array(material.initial_history(1), dtype=vecH, device=device)
    mu = wp.full(1, precision.real(material.mu), dtype=precision.real, device=device)
    lam = wp.full(1, precision.real(material.lam), dtype=precision.real, device=device)
    params = material.params(precision)
    for k in range(n):
        inputs = [steps[k : k + 1], mu, lam, params, precision.real(dt), F_e, history, tau[k : k + 1]]
        wp.launch(update, dim=1, inputs=inputs, device=device)
    result = tau.numpy().astype(np.float64)
    if not np.isfinite(result).all():
        row = int((~np.isfinite(result).all((1, 2))).argmax())
        raise InstabilityError(
            f"{type(material).__name__} gave a non-finite stress at F_path[{row}]; take smaller strains"
        )
    return result


def _identity_but(row: int, column: int, values: np.ndarray) -> np.ndarray:
    """The identity [n, 3, 3] with other values [n] in one place."""
    F = np.tile(np.eye(3), (len(values), 1, 1))
    F[:, row, column] = values
    return F


#: Deformation paths by name: amplitude s [n] (dimensionless, growing from 0) → F [n, 3, 3].
PATHS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "simple_shear": lambda s: _identity_but(0, 1, s),
    "uniaxial_strain": lambda s: _identity_but(0, 0, 1.0 + s),
    "oedometer": lambda s: _identity_but(2, 2, 1.0 - s),
    "isotropic_compression": lambda s: (1.0 - s)[:, None, None] * np.eye(3),
    "cyclic_shear": lambda s: _identity_but(0, 1, s.max() * np.sin(2.0 * np.pi * s / s.max())),
}


def deformation_path(name: str, amplitude: float, points: int) -> tuple[np.ndarray, np.ndarray]:
    """Amplitudes s [n] and total deformation gradients F [n, 3, 3] of a named path.

    Raises:
        ConfigError: unknown name, amplitude ≤ 0 (or ≥ 1 for compressions), points < 2.
    """
    one_of("path", name, PATHS)
    if not amplitude > 0 or (name in ("oedometer", "isotropic_compression") and not amplitude < 1):
        raise ConfigError(f"point.amplitude={amplitude} must be positive, and below 1 for compression")
    if points < 2:
        raise ConfigError(f"point.points={points} must be at least 2")
    s = np.linspace(0.0, amplitude, points)
    return s, PATHS[name](s)
