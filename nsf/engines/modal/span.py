"""Steps of fields that are modes times coefficients: a few kernels, in which torch takes no part."""

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from nsf.dynamics.arena import Arena
from nsf.dynamics.batch import Batch
from nsf.dynamics.closure_kernel import packed_weights, projection_block
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.interop import as_vectors, on_torch_stream
from nsf.dynamics.modal_fields import field_launches
from nsf.dynamics.modal_kernels import THREADS, make_gathering, tiling
from nsf.dynamics.placing_kernels import make_others, make_sample
from nsf.dynamics.projection import Taylor
from nsf.dynamics.projection_kernel import (
    EVALUATE,
    PREPARE,
    SOLVE,
    make_projection,
    prepared_size,
)
from nsf.dynamics.span import Span, Stages
from nsf.kinematics.fields.modal import ModalFactors
from nsf.mpm.access import WARP
from nsf.mpm.grid import Grid
from nsf.mpm.shape import DEGREES, stencil_offset
from nsf.mpm.state import cell_order
from nsf.sampling.sampler import SampleSpan

_HEADS, _PREPARING, _CLEARING = range(3)  # what of a step runs beside the rest


class ModalSpan(Span):
    """Fields of `field=basis` and `joint`, of one run or of several.

    The networks run once a step, on x̂ alone; modes and coefficients are contracted at those particles of N
    that the step needs, which are found at each step among the sets'; and the projection works on
    coefficients. A step is that of the reference, but that a last update moves coefficients along their
    derivative, which misses the manifold by the order of the projector's tolerance. Several runs share modes,
    networks and candidates, and every launch.

    Args:
        batch: the runs.
        sample: S and its weights.
        sets: S, N (the candidates) and I.

    Attributes:
        tiling: number of tiles, and of runs in a tile; each of these has a bit in `needed`.
        needed: see `Placing`.
    """

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        one = batch.shared
        manifold, shape = one.manifold, one.transfer.shape
        like = {"dtype": one.dtype, "device": one.torch_device}
        order = _by_cell(sets, one.constants.X, one.geometry.dx, shape)
        super().__init__(batch, sets, order, manifold.restrict(sets.sample, **like))
        self._clears_ahead = self.grid_step.grid.sparse  # else what is cleared depends on where particles are
        self._arena = arena = Arena(one.precision, one.device)
        deformation = manifold.factors("deformation", order, **like)
        of_sample = arena.modes(deformation.table, deformation.rows[: self.s])
        self.coefficients = state = Coefficients(
            arena, len(batch), deformation.table.shape[2], manifold.latent_dim
        )
        # What a block shares for a run, at most: coefficients of x and of its rate, or of two fields.
        of_x, *of_heads = (-(-modes // 4) for modes in manifold.hyperparameters["modes"])
        self.tiling = tiling(len(batch), arena.real.itemsize * 4 * max(2 * of_x, sum(of_heads)))
        self._placing = Placing(arena, state, deformation, of_sample, self.grid_step.grid, shape, self)
        self.needed = self._placing.needed
        parameters = torch.stack([setup.parameters for setup in batch.setups])
        materials = [setup.scene.material for setup in batch.setups]
        self._networks, self._fields = field_launches(
            arena, self, manifold, one.method, order, parameters, materials
        )
        self._projection = Projection(arena, state, deformation, of_sample, self, sample.weights)

    @property
    @override
    def stages(self) -> Stages:
        return {
            "inference": self.infer,
            "p2g": self.p2g,
            "g2p": self.g2p,
            "inversion": self.project,
        }

    @override
    def enter(self, first: bool) -> None:
        record, state = self.record, self.coefficients
        with on_torch_stream(self._arena.device):
            for side in (_PREPARING, _CLEARING):  # where a step was left in its midst
                self._arena.meet(side)
            for xhat in (record.before, record.now):
                state.latent.copy_(xhat.view_as(state.latent))
                self._projection.evaluate.launch()
            state.first.fill_(int(first))
            state.step += 1  # what an earlier step stamped is of no account

    def infer(self) -> None:
        """x and v, the particles that S needs, and their τ and C (paper sections 5.1 and 5.4).

        Beside them, where the boundaries will be, and what of the inversion is known before the step.
        """
        if self._clears_ahead:
            with self._arena.beside(_CLEARING):
                self.grid_step.clear(self.particles[0])
        with self._arena.beside(_PREPARING):  # what nothing needs before S is moved
            self.grid_step.follow()
            self._projection.prepare.launch()
        with self._arena.beside(_HEADS):
            for launch in self._networks:
                launch.launch()
        for launch in self._placing.launches:
            launch.launch()
        self._arena.meet(_HEADS)
        if self._clears_ahead:
            self._arena.meet(_CLEARING)
        for launch in self._fields:
            launch.launch()

    @override
    def p2g(self) -> None:
        if self._clears_ahead:
            self.grid_step.scatter(*self.particles)
        else:
            super().p2g()

    @override
    def g2p(self) -> None:
        self._arena.meet(_PREPARING)
        self.move_sample()

    def project(self) -> None:
        """x̂_{n+1} from the displacement of S (paper section 5.3)."""
        self._projection.gather.launch()
        self._projection.solve.launch()

    @property
    @override
    def mean_sizes(self) -> list[float]:
        counts = self._placing.count.tolist()
        return [found / steps if steps else float(self.size) for found, steps in counts]

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._arena.nbytes

    @property
    @override
    def mode_bytes(self) -> float:
        return self._arena.mode_bytes / self.size


class Coefficients:
    """Where B runs are, in coefficients, on the device.

    Attributes:
        latent: [B, r] x̂_n in fp64.
        a, rate: [B, K] coefficients of the displacement and their backward difference [1/s].
        first: [B] whether the next step is the first of the run.
        step: [B] a number that no two steps share.
    """

    def __init__(self, arena: Arena, runs: int, modes: int, latents: int):
        self.latent, self.a, self.rate = (arena.zeros(runs, n) for n in (latents, modes, modes))
        self.first, self.step = (arena.zeros(runs, dtype=torch.int32) for _ in range(2))

    def __len__(self) -> int:
        return len(self.step)


class Placing:
    """Finds x and v at S, and at each step which others its step needs, and theirs.

    Attributes:
        needed: [tiles, n] in which runs of a tile a particle is, as bits.
        count: [B, 2] particles needed in all steps taken, and the number of these.
        launches: in order.
    """

    def __init__(
        self, arena, state, deformation, of_sample: torch.Tensor, grid: Grid, shape: str, span: Span
    ):
        precision, reach, sets = arena.precision, DEGREES[shape], span.sets
        nodes = np.array(grid.geometry.nodes)
        lower, upper = np.zeros(3, int), nodes - 1
        if grid.sparse:
            stored = np.stack(np.unravel_index(sets.nodes, nodes), 1)
            lower = np.maximum(stored.min(0) - reach, 0)
            upper = np.minimum(stored.max(0) + reach, nodes - 1)
        extent = upper - lower + 1
        box = wp.vec3i(*lower.tolist()), wp.vec3i(*extent.tolist())
        B, s, n = len(state), span.s, span.size
        tiles, tile = span.tiling
        whole = [2 ** min(tile, B - tile * number) - 1 for number in range(tiles)]
        self.needed = arena.hold(torch.tensor(whole)[:, None].expand(tiles, n), torch.int32)
        self.count = arena.zeros(B, 2, dtype=torch.int64)
        stamps = arena.zeros(B, int(extent.prod()), dtype=torch.int32)
        mean = as_vectors(arena.hold(deformation.mean, arena.real), precision)
        initial, x, v = (as_vectors(a, precision) for a in (span.initial_velocity, span.x, span.v))
        latest = [state.a, state.rate, initial, state.first, state.step, stamps]
        found = [precision.real(1.0 / grid.geometry.dx), *box, self.count, x, v]
        lanes = arena.lanes(WARP)
        inputs = [mean, of_sample, *latest, *found, grid.shape, s, lanes]
        self.launches = [arena.pack(make_sample(precision, shape, B > 1), B * s * lanes, inputs)]
        if n == s:
            return
        modes, lengths = arena.halved(deformation.table, deformation.rows[s:])
        four = -(-state.a.shape[1] // 4)
        lanes = arena.lanes(THREADS)
        kernel = make_others(precision, shape, four, tile, tiles > 1, wp.dtype_from_torch(modes.dtype))
        inputs = [mean, modes, lengths, *latest, *found, self.needed, s, tiles, lanes]
        self.launches.append(arena.pack(kernel, tiles * arena.whole_blocks(n - s, THREADS), inputs, THREADS))


class Projection:
    """The inversion of the deformation field (paper section 5.3).

    Attributes:
        evaluate: gives a and ȧ at the latent vector of the state, for a run that begins.
        prepare: the part of a step's inversion that needs nothing of S, which may run beside the rest.
        gather, solve: the others, in this order.
    """

    def __init__(self, arena, state, deformation, displacement, span: Span, weights: np.ndarray | None):
        one, s, (count, K) = span.batch.shared, span.s, state.a.shape
        projector, record, r = one.projector, span.record, state.latent.shape[1]
        of_sample = deformation.table[deformation.rows[:s]].to(one.torch_device)
        w = torch.ones(s) if weights is None else torch.as_tensor(weights / np.mean(weights))
        w = arena.hold(w, torch.float64)
        B = of_sample.double().flatten(0, 1)
        G = arena.hold(B.T @ (w.repeat_interleave(3)[:, None] * B), torch.float64).flatten()
        b = arena.zeros(count, K + 1)
        widths, weights = _closure(deformation, arena.device.is_cuda)
        weights = arena.hold(weights, torch.float32)
        members = deformation.members if widths else 1
        lanes, velocity = arena.lanes(THREADS), as_vectors(span.v, arena.precision)
        self.gather = arena.pack(
            make_gathering(arena.precision, count > 1),
            count * (K + 1) * lanes,
            [displacement, span.size, -(-K // 4), velocity, w, wp.float64(one.dt), lanes, b],
            THREADS,
        )
        kernel = make_projection(arena.precision, widths, members, r, K, count > 1)
        sigma = arena.hold(deformation.leading, torch.float64)
        block = projection_block(widths)
        threads = members * block if arena.device.is_cuda else 1
        between = [
            arena.zeros(count, prepared_size(r, K)),
            arena.zeros(count, 2 * members * (K - r) * (r + 1)),
            arena.zeros(count, 2, dtype=torch.int32),
        ]
        linear = int(isinstance(projector, Taylor))

        def of_each(values: torch.Tensor) -> torch.Tensor:
            """[count, entries of a run], sharing memory."""
            return values.view(count, -1)

        def launch(mode: int) -> wp.Launch:
            how = [wp.float64(s), mode, projector.iterations, wp.float64(projector.tolerance), linear]
            latents = [state.latent, state.a, state.rate, record.now, record.before]
            kept = [record.xhat, record.residuals, record.updates, record.row]
            own = map(of_each, [*latents, *kept, state.first, state.step])
            sums = [weights, wp.float64(deformation.scale), sigma, G, b]
            inputs = [*sums, *how, wp.float64(one.dt), *own, *between, threads]
            return arena.pack(kernel, count * threads, inputs, block)

        self.evaluate, self.prepare, self.solve = (launch(mode) for mode in (EVALUATE, PREPARE, SOLVE))


def _closure(deformation: ModalFactors, is_cuda: bool) -> tuple[tuple[int, ...], torch.Tensor]:
    """Widths of a member of the closure, and the packed weights of all, member by member."""
    layers, members = deformation.layers, deformation.members
    if not layers:
        return (), torch.zeros(1)
    *hidden, (W_last, b_last) = layers
    widths = (len(deformation.leading), *(len(b) // members for _, b in hidden), len(b_last))
    packed = []
    for member in range(members):
        own = [tuple(part.unflatten(0, (members, -1))[member] for part in layer) for layer in hidden]
        # What is in the unit of the coefficients is divided by it, so that fp32 holds it; all share a bias.
        last = W_last.unflatten(1, (members, -1))[:, member], b_last * (member == 0)
        own.append(tuple(part / deformation.scale for part in last))
        packed.append(packed_weights(own, is_cuda))
    return widths, torch.cat(packed)


def _by_cell(sets: ParticleSets, X: np.ndarray, dx: float, shape: str) -> np.ndarray:
    """N with S first and the others cell by cell at rest.

    Neighbours are needed together, and P2G adds up those of one cell before they reach the grid.
    """
    others = sets.integration[len(sets.sample) :]
    return np.concatenate([sets.sample, others[cell_order(X[others], dx, stencil_offset(shape))]])
