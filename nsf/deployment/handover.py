"""A reduced run that is no longer believed goes on at full order."""

from pathlib import Path

import numpy as np
import torch

from nsf.data import TrajectoryWriter
from nsf.deployment.rollout import Rollout
from nsf.dynamics import ReducedMPM
from nsf.errors import InstabilityError
from nsf.mpm import FP32, FullOrderMPM, Precision
from nsf.mpm.recording import blocks


def hand_over(solver: ReducedMPM, rollout: Rollout) -> FullOrderMPM:
    """The full-order solver at the time and in the state in which the rollout handed over.

    x, C and τ are the fields' at every particle, as the run takes them, and v is the backward difference
    of x, as in a reduced step. τ determines F_e up to a rotation, which the laws do not see, and history
    variables as far as the law can tell (`FullOrderMPM.resume`). At t = 0 the state is the scene's own.

    Args:
        solver: the reduced solver of the rollout; only its fields are used.
        rollout: a run with `handed_over` ≥ 0.

    Raises:
        InstabilityError: the decoded state is none of the full-order solver's; see `FullOrderMPM.resume`.
    """
    scene, setup, n = solver.scene, solver.setup, rollout.handed_over
    full = scene.full_order(precision=setup.precision.name, device=str(solver.device))
    if n == 0:
        return full
    decoder = solver.decoder()
    before, now = torch.as_tensor(rollout.xhat[n - 1 : n + 1], dtype=setup.dtype, device=setup.torch_device)
    with torch.no_grad():
        x = decoder.position(now)
        v = (x - decoder.position(before)) / solver.dt
        rate = (now - before) / solver.dt
        C, tau = decoder.affine(now[None], rate[None])[0], decoder.stress(now[None])[0]
    state = (a.double().cpu().numpy() for a in (x, v, C, 0.5 * (tau + tau.mT)))
    full.resume(round(rollout.t[n] / full.dt), *state)
    return full


def go_on(solver: ReducedMPM, rollout: Rollout, path: Path, stored: Precision = FP32) -> int:
    """Run the full-order solver from the hand-over to the end of the scene.

    Args:
        solver: the reduced solver of the rollout.
        rollout: a run with `handed_over` ≥ 0.
        path: of the trajectory, whose first frame is the state handed over.
        stored: precision of its frames.

    Returns:
        Number of particles whose decoded stress was beyond the law and was scaled down to what it carries.

    Raises:
        InstabilityError: the full-order solver loses stability; names the hand-over.
    """
    scene = solver.scene
    try:
        full = hand_over(solver, rollout)
        begin, constants = full.steps_taken, full.constants
        writer = TrajectoryWriter(
            path,
            X=constants.X,
            mass=constants.mass,
            volume0=constants.volume0,
            parameters=rollout.case.parameters,
            dt=full.dt,
            dx=scene.dx,
            frames=scene.steps - begin + 1,
            dtype=np.dtype(stored.numpy).name,
        )
        # The last check falls inside, before the file gets its name: only a run that went well leaves one.
        with writer:
            n = begin
            for block in blocks(full, scene.steps - begin, stored):
                for frame in block:
                    writer.append(n * full.dt, **frame)
                    n += 1
                block.done()
        return full.beyond_law
    except InstabilityError as error:
        raise InstabilityError(
            f"the reduced run at {rollout.case.named} was handed over to the full-order solver at "
            f"t = {rollout.t[rollout.handed_over]:.4g} s, which lost stability: {error}; "
            "deploy with fallback=none, or simulate this case"
        ) from error
