"""Two elastic discs collide and part: energy and momentum."""

from collections.abc import Iterator

import numpy as np

from nsf.mpm import FullOrderMPM
from nsf.scenes import Scene
from nsf.validation.problem import Answer, kinetic_energy

TITLE = "Collision of two elastic discs"
LIMITS = "APIC, which loses energy in the collision."
_SOURCE = "Sulsky et al. 1994, Comput. Methods Appl. Mech. Eng. 118, 179–196: by conservation"
_LOOKS = 70  # at the energy, in a run


def answers(scene: Scene, finer: Scene | None, device: str) -> Iterator[Answer]:
    """Energy before, largest momentum and rise of energy, and whether the discs part."""
    solver = scene.full_order(device=device)
    thickness = scene.bodies["lower"].shape.height
    before = kinetic_energy(solver) / thickness
    yield Answer.of(solver, "kinetic energy before", "J/m", (2.513,), _SOURCE, before)
    mass, lower = solver.constants.mass, scene.bodies["lower"].particles
    first = mass[:lower] @ solver.state.v.numpy()[:lower]
    energies, momenta = [], []
    for _ in range(_LOOKS):
        # Velocities lie half a step before positions: the kinetic energy of their time is a mean of two.
        elastic, kinetic = elastic_energy(solver), kinetic_energy(solver)
        solver.step()
        energies.append(elastic + 0.5 * (kinetic + kinetic_energy(solver)))
        solver.step(scene.steps // _LOOKS - 1)
        momenta.append(np.linalg.norm((mass @ solver.state.v.numpy())[:2]))
    last = mass[:lower] @ solver.state.v.numpy()[:lower]
    rise = max(energies - np.minimum.accumulate(energies))
    momentum = 100.0 * max(momenta) / np.linalg.norm(first)
    yield Answer.of(solver, "momentum over a disc's", "%", (0.0,), _SOURCE, momentum)
    yield Answer.of(solver, "rise of total energy", "%", (0.0,), _SOURCE, 100.0 * rise / energies[0])
    restitution = float(-(last @ first) / (first @ first))
    yield Answer.of(solver, "speed after over before", "-", (), _SOURCE, restitution)


def elastic_energy(solver: FullOrderMPM) -> float:
    """Σ V⁰ (μ̂ tr ε² + λ/2 (tr ε)²) of Hencky's law [J]."""
    constants, stretches = solver.constants, np.linalg.svd(solver.state.F_e.numpy(), compute_uv=False)
    strain = np.log(stretches)
    density = constants.mu * (strain**2).sum(1) + 0.5 * constants.lam * strain.sum(1) ** 2
    return float(constants.volume0 @ density)
