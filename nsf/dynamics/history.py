"""A reduced step whose particles carry stress and history variables; not in the paper (`Sources`)."""

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.interop import as_scalars
from nsf.dynamics.span import Stages
from nsf.dynamics.step import Step
from nsf.mpm.stressed import stressed
from nsf.mpm.transfer.g2p import make_g2p_stress
from nsf.sampling.sampler import SampleSpan


class HistoryStep(Step):
    """Every particle carries τ, C, F_e and history variables, which a full-order step updates (`Sources`).

    x and v are inferred from x̂ as in any step. Then every particle takes the full-order step; of the x and v
    that it gives, those of S alone are used, to find x̂_{n+1}.
    """

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        super().__init__(batch, sample, sets)
        setup, n = batch.shared, len(sets.integration)
        material, precision = setup.scene.material, setup.precision
        self._law = make_g2p_stress(
            precision, setup.transfer.shape, material.functions(precision), material.history_size
        )
        vecH = wp.types.vector(length=material.history_size, dtype=precision.real)
        self._F_e = wp.zeros(n, dtype=precision.mat33, device=setup.device)
        self._history = wp.zeros(n, dtype=vecH, device=setup.device)
        self._moduli = as_scalars(self.mu), as_scalars(self.lam)
        self._params = material.params(precision)

    @property
    @override
    def stages(self) -> Stages:
        return {
            "inference": self.infer,
            "transfer": self.load,
            "p2g": self.p2g,
            "grid": self.grid_step.update,
            "g2p": self.g2p_stress,
            "inversion": self.project,
        }

    @override
    def infer(self) -> None:
        self.inferred = self.inference.motion(self.record.now)

    @override
    def load(self) -> None:
        for array, values in zip((self.x, self.v), self.inferred, strict=True):
            array.copy_(values)

    def g2p_stress(self) -> None:
        """Grid → particles, F_e ← returnMap(f F_e), τ ← τ(F_e); as `FullOrderMPM.g2p_stress`."""
        rows = self.particles
        inputs = [*self.grid_step.gathering, *self._moduli, self._params]
        inputs += [rows.x, rows.v, rows.C, self._F_e, self._history, rows.tau]
        wp.launch(self._law, dim=len(self.x), inputs=inputs, device=self.batch.shared.device)

    @override
    def enter(self, first: bool) -> None:
        super().enter(first)
        setup, xhat = self.batch.shared, self.record.now
        material, n = setup.scene.material, len(self.x)
        if first:
            self.C.zero_()
            tau, F_e = np.zeros((n, 3, 3)), np.tile(np.eye(3), (n, 1, 1))
            carried = {"tau": tau, "F_e": F_e, "history": material.initial_history(n)}
        else:  # in the midst of a run: from x̂ alone
            rate = (xhat - self.record.before) / setup.dt
            C = self.inference.affine(xhat, rate)
            self.C.copy_(torch.zeros_like(self.C) if C is None else C)
            tau = self.inference.stress(xhat).double().cpu().numpy()
            tau = np.nan_to_num(0.5 * (tau + tau.transpose(0, 2, 1)), nan=0.0, posinf=0.0, neginf=0.0)
            moduli = self.mu.double().cpu().numpy(), self.lam.double().cpu().numpy()
            carried, _ = stressed(material, tau, *moduli)
        self.tau.copy_(torch.as_tensor(carried["tau"]))
        self._F_e.assign(carried["F_e"])
        self._history.assign(carried["history"])

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._F_e.capacity + self._history.capacity
