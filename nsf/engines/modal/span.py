"""Steps of fields that are modes times coefficients: a few kernels, in which torch takes no part."""

import numpy as np
import torch
import warp as wp
from typing_extensions import override

from nsf.dynamics.batch import Batch
from nsf.dynamics.integration import ParticleSets
from nsf.dynamics.interop import as_vectors, on_torch_stream
from nsf.dynamics.projection import Taylor
from nsf.dynamics.span import GridSpan, Stages
from nsf.engines.modal.arena import Arena
from nsf.engines.modal.closure import packed_weights, projection_block
from nsf.engines.modal.fields import field_launches
from nsf.engines.modal.gathering import THREADS, make_gathering, tiling
from nsf.engines.modal.placing import make_neighbours, make_sample
from nsf.engines.modal.projection import EVALUATE, PREPARE, SOLVE, make_projection, prepared_size
from nsf.kinematics.fields.modal import ModalFactors
from nsf.mpm.grid.shape import DEGREES, stencil_offset
from nsf.mpm.native.access import WARP
from nsf.mpm.state import cell_order
from nsf.sampling.sampler import SampleSpan

_HEADS, _PREPARING, _CLEARING = range(3)  # what of a step runs beside the rest


class ModalSpan(GridSpan):
    """Fields of `field=basis`, of one run or of several.

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
        coefficients: where the runs are.
        in_N: see `Placing`.
    """

    def __init__(self, batch: Batch, sample: SampleSpan, sets: ParticleSets):
        shared = batch.shared
        manifold, shape = shared.manifold, shared.transfer.shape
        like = {"dtype": shared.dtype, "device": shared.torch_device}
        order = _by_cell(sets, shared.constants.X, shared.geometry.dx, shape)
        super().__init__(batch, sets, order, manifold.restrict(sets.sample, **like))
        self._clears_ahead = self.grid_step.grid.sparse  # else what is cleared depends on where particles are
        self._arena = arena = Arena(shared.precision, shared.device)
        deformation = manifold.factors("deformation", order, **like)
        of_sample = arena.modes(deformation.table, deformation.rows[: self.s])
        self.coefficients = state = Coefficients(
            arena, len(batch), deformation.table.shape[2], manifold.latent_dim
        )
        # What a block shares for a run, at most: coefficients of x and of its rate, or of two fields.
        of_x, *of_heads = (-(-modes // 4) for modes in manifold.hyperparameters["modes"])
        tiles = tiling(len(batch), arena.real.itemsize * 4 * max(2 * of_x, sum(of_heads)))
        # What is handed on is the span of every engine, which is whole by now.
        self._placing = Placing(arena, state, deformation, of_sample, self, tiles)
        self.in_N = self._placing.in_N
        self._networks, self._fields = field_launches(arena, self, state.a, state.rate, self.in_N, tiles)
        self._projection = Projection(arena, state, deformation, of_sample, self, sample.weights)

    @property
    @override
    def stages(self) -> Stages:
        return {"inference": self.infer, "p2g": self.p2g, "g2p": self.update_g2p, "inversion": self.project}

    @override
    def enter(self, first: bool) -> None:
        state = self.coefficients
        with on_torch_stream(self._arena.device):
            for side in (_PREPARING, _CLEARING):  # where a step was left in its midst
                self._arena.meet(side)
            self._evaluate()
            if first:  # of the latents alone: the heads read it, while v is the initial velocity
                state.rate[:, : state.latent.shape[1]] = self._projection.sigma * self.first_rate()
            state.first.fill_(int(first))
            state.step += 1  # what an earlier step stamped is of no account

    def _evaluate(self) -> None:
        """Find the coefficients and their rate of the record's last two latent vectors."""
        for xhat in (self.record.before, self.record.now):
            self.coefficients.latent.copy_(xhat.view_as(self.coefficients.latent))
            self._projection.evaluate.launch()

    @override
    def close(self) -> None:
        super().close()
        self._evaluate()

    def infer(self) -> None:
        """x and v, the particles that S needs, and their τ and C (paper sections 5.1 and 5.4).

        On further streams: where the boundaries will be, and parts of the inversion that need no S.
        """
        if self._clears_ahead:
            with self._arena.concurrently(_CLEARING):
                self.grid_step.clear(self.particles.x)
        with self._arena.concurrently(_PREPARING):  # what nothing needs before S is moved
            self.grid_step.follow()
            self._projection.prepare.launch()
        with self._arena.concurrently(_HEADS):
            for launch in self._networks:
                launch.launch()
        for launch in self._placing.launches:
            launch.launch()
        self._arena.meet(_HEADS)
        if self._clears_ahead:
            self._arena.meet(_CLEARING)
        for launch in self._fields:
            launch.launch()

    def p2g(self) -> None:
        """N → grid (paper section 5.2)."""
        if self._clears_ahead:
            self.grid_step.scatter(*self.particles)
        else:
            self.grid_step.p2g(*self.particles)

    def update_g2p(self) -> None:
        """Grid → x and v of S, once the boundaries are where they will be (paper section 5.2)."""
        self._arena.meet(_PREPARING)
        self.grid_step.update_g2p(self.particles.x, self.particles.v, self.s)

    def project(self) -> None:
        """x̂_{n+1} from the displacement of S (paper section 5.3)."""
        self._projection.gather.launch()
        self._projection.solve.launch()

    @property
    @override
    def mean_sizes(self) -> list[float]:
        counts = self._placing.count.tolist()
        return [particles / steps if steps else float(self.size) for particles, steps in counts]

    @property
    @override
    def nbytes(self) -> int:
        return super().nbytes + self._arena.nbytes

    @property
    @override
    def mode_bytes(self) -> float:
        return self._arena.mode_bytes / self.size


class Coefficients:
    """Latent vectors and modal coefficients of B runs, on the device.

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
    """Launches that write x and v at S, find N in each step, and write x and v there.

    Args:
        arena, state: of the batch.
        deformation: factors of g at N; of_sample: its modes at S.
        span: whose rows of x and v are found.
        tiles: number of tiles, and of runs in a tile; each of these has a bit in `in_N`.

    Attributes:
        in_N: [tiles, n] in which runs of a tile a particle is of N, as bits.
        count: [B, 2] particles of N in all steps taken, and the number of these.
        launches: in order.
    """

    def __init__(
        self,
        arena: Arena,
        state: Coefficients,
        deformation: ModalFactors,
        of_sample: torch.Tensor,
        span: GridSpan,
        tiles: tuple[int, int],
    ):
        shape, grid = span.batch.shared.transfer.shape, span.grid_step.grid
        precision, reach, sets = arena.precision, DEGREES[shape], span.sets
        nodes = np.array(grid.geometry.nodes)
        lower, upper = np.zeros(3, int), nodes - 1
        if grid.sparse:
            stored = np.stack(np.unravel_index(sets.nodes, nodes), 1)
            lower = np.maximum(stored.min(0) - reach, 0)
            upper = np.minimum(stored.max(0) + reach, nodes - 1)
        extent = upper - lower + 1
        B, s, n = len(state), span.s, span.size
        number, tile = tiles
        all_runs = [2 ** min(tile, B - tile * before) - 1 for before in range(number)]
        self.in_N = arena.hold(torch.tensor(all_runs)[:, None].expand(number, n), torch.int32)
        self.count = arena.zeros(B, 2, dtype=torch.int64)
        stamps = arena.zeros(B, int(extent.prod()), dtype=torch.int32)
        mean = as_vectors(arena.hold(deformation.mean, arena.real), precision)
        initial, x, v = (as_vectors(a, precision) for a in (span.initial_velocity, span.x, span.v))
        motion = {
            "mean": mean, "a": state.a, "rate": state.rate, "initial_velocity": initial, "x": x, "v": v,
            "first": state.first, "step": state.step, "stamps": stamps, "count": self.count,
            "inv_dx": precision.real(1.0 / grid.geometry.dx), "lower": wp.vec3i(*lower.tolist()),
            "extent": wp.vec3i(*extent.tolist()), "of_sample": s,
        }  # fmt: skip
        lanes, kernel = arena.lanes(WARP), make_sample(precision, shape, B > 1)
        arguments = {"modes": of_sample, "grid_shape": grid.shape, "lanes": lanes}
        self.launches = [arena.pack(kernel, B * s * lanes, at=motion, **arguments)]
        if n == s:
            return
        placed = arena.placed(deformation.table, deformation.rows[s:])
        four, kind = -(-state.a.shape[1] // 4), wp.dtype_from_torch(placed["modes"].dtype)
        kernel = make_neighbours(precision, shape, four, tile, number > 1, kind)
        threads = number * arena.whole_blocks(n - s, THREADS)
        arguments = {"in_N": self.in_N, "tiles": number, "lanes": arena.lanes(THREADS)}
        self.launches.append(arena.pack(kernel, threads, THREADS, at=motion, **placed, **arguments))


class Projection:
    """The inversion of the deformation field (paper section 5.3).

    Attributes:
        sigma: [r] σ of the latents.
        evaluate: gives a and ȧ at the latent vector of the state, for a run that begins.
        prepare: the part of a step's inversion that needs nothing of S, which may run beside the rest.
        gather, solve: the others, in this order.
    """

    def __init__(self, arena, state, deformation, displacement, span: GridSpan, weights: np.ndarray | None):
        shared, s, (count, K) = span.batch.shared, span.s, state.a.shape
        projector, record, r = shared.projector, span.record, state.latent.shape[1]
        of_sample = deformation.table[deformation.rows[:s]].to(shared.torch_device)
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
            make_gathering(arena.precision, count > 1), count * (K + 1) * lanes, THREADS, lanes=lanes,
            gathered={
                "displacement": displacement, "v": velocity, "rows": span.size, "weights": w,
                "dt": shared.dt, "b": b,
            },
        )  # fmt: skip
        self.sigma = arena.hold(deformation.leading, torch.float64)
        kernel = make_projection(arena.precision, widths, members, r, K, count > 1)
        block = projection_block(widths)
        threads = arena.lanes(block)
        of_each = {
            "latent": state.latent, "a": state.a, "rate": state.rate, "xhat": record.now,
            "xhat_previous": record.before, "xhats": record.xhat, "residuals": record.residuals,
            "updates": record.updates, "row": record.row, "first": state.first, "step": state.step,
            "prepared": arena.zeros(count, prepared_size(r, K)), "b": b,
        }  # fmt: skip
        inversion = {name: values.view(count, -1) for name, values in of_each.items()} | {
            "weights": weights, "scale": deformation.scale, "G": G, "sample": s, "dt": shared.dt,
            "sigma": self.sigma, "iterations": projector.iterations,
            "tolerance": projector.tolerance, "linear": isinstance(projector, Taylor),
        }  # fmt: skip
        self.evaluate, self.prepare, self.solve = (
            arena.pack(kernel, count * threads, block, inversion=inversion, task=task, threads=threads)
            for task in (EVALUATE, PREPARE, SOLVE)
        )


def _closure(deformation: ModalFactors, is_cuda: bool) -> tuple[tuple[int, ...], torch.Tensor]:
    """Widths of a member of the closure, and the packed weights of all, member by member."""
    layers, members = deformation.layers, deformation.members
    if not layers:
        return (), torch.zeros(1)
    *hidden, (W_last, b_last) = layers
    widths = (len(deformation.leading), *(len(b) // members for _, b in hidden), len(b_last))
    packed = []
    for member in range(members):
        layers = [tuple(part.unflatten(0, (members, -1))[member] for part in layer) for layer in hidden]
        # What is in the unit of the coefficients is divided by it, so that fp32 holds it; all share a bias.
        last = W_last.unflatten(1, (members, -1))[:, member], b_last * (member == 0)
        layers.append(tuple(part / deformation.scale for part in last))
        packed.append(packed_weights(layers, is_cuda))
    return widths, torch.cat(packed)


def _by_cell(sets: ParticleSets, X: np.ndarray, dx: float, shape: str) -> np.ndarray:
    """N with S first and the others cell by cell at rest.

    Neighbours are needed together, and P2G adds up those of one cell before they reach the grid.
    """
    neighbours = sets.integration[len(sets.sample) :]
    return np.concatenate([sets.sample, neighbours[cell_order(X[neighbours], dx, stencil_offset(shape))]])
