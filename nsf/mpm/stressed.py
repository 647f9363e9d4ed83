"""F_e and history variables of particles from their stress, for a run that begins in its midst."""

import numpy as np

from nsf.mpm.materials.base import Material

_OFF_THE_EDGE = 1e-2  # of a stress, by which it is scaled down in a turn
_TURNS = 1000  # to a share of 4e-5


def stressed(
    material: Material, tau: np.ndarray, mu: np.ndarray, lam: np.ndarray
) -> tuple[dict[str, np.ndarray], int]:
    """τ, F_e and history variables of particles from their stress.

    A stress beyond yield is kept; the first return map brings it back.

    Args:
        material: the law.
        tau: [P, 3, 3] symmetric Kirchhoff stress [Pa].
        mu, lam: [P] Lamé parameters [Pa].

    Returns:
        tau, scaled down where it was beyond the law, F_e [P, 3, 3] that carries it, and history [P, H]; and
        the number of particles whose stress was beyond the law.

    Raises:
        InstabilityError: a stress, scaled down to nearly nothing, is still beyond the law.
    """
    share = material.carried_share(tau, mu, lam)
    beyond = share < 1.0
    tau = share[:, None, None] * tau
    # At the edge of what the law carries round-off decides.
    for _ in range(_TURNS):
        if not (lost := _uncarried(material, tau, mu, lam)).any():
            break
        tau = np.where(lost, 1.0 - _OFF_THE_EDGE, 1.0)[:, None, None] * tau
        beyond |= lost
    carried = {"tau": tau, "F_e": material.stretch_of(tau, mu, lam), "history": material.history_of(tau)}
    return carried, int(beyond.sum())


def _uncarried(material: Material, tau: np.ndarray, mu: np.ndarray, lam: np.ndarray) -> np.ndarray:
    """[P] whether no deformation carries a stress, by the principal stresses that `stretch_of` takes."""
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        return ~np.isfinite(material.stretches_of(np.linalg.eigh(tau)[0], mu, lam)).all(1)
