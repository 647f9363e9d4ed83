"""Launches that write τ and C at N: the networks of the heads, then modes times their coefficients."""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from nsf.data import TAU_MATRIX
from nsf.dynamics.interop import as_matrices
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.span import GridSpan
from nsf.engines.modal.arena import Arena
from nsf.engines.modal.gathering import THREADS, make_contraction, tiling
from nsf.engines.modal.networks import make_at_rate, make_layer, make_product, product_blocks
from nsf.mpm.materials import Material, make_elastic_stress
from nsf.mpm.native.access import WARP


def field_launches(
    arena: Arena,
    span: GridSpan,
    a: torch.Tensor,
    rate: torch.Tensor,
    in_N: torch.Tensor,
    tiles: tuple[int, int],
) -> tuple[list, list]:
    """The launches of the networks, and those that then write τ and C at N, from the run's sources.

    Args:
        arena: holds what they need.
        span: whose rows of τ and C are found.
        a, rate: [B, K] coefficients of the displacement and their rate [1/s].
        in_N: [tiles, n] which particles a step needs, as bits; tiles: their number and the runs of one.
    """
    setups, shared, n = span.batch.setups, span.batch.shared, span.size
    options = {"particles": span.order, "dtype": arena.real, "device": shared.torch_device}
    heads = []
    for name, neural, values in (
        ("stress", shared.sources.neural_stress, span.tau),
        ("affine", shared.sources.neural_affine, span.C),
    ):
        if neural:
            factors = shared.manifold.factors(name, **options)
            if factors.table.shape[2]:
                heads.append((factors, values))
            else:  # the same in every snapshot, or none
                values.unflatten(0, (-1, n)).copy_(_as_matrices(factors.mean))
    stored = [arena.placed(factors.table, factors.rows) for factors, _ in heads]
    parameters = torch.stack([setup.parameters for setup in setups])
    networks, outputs = _networks(arena, [f.layers for f, _ in heads], span.record, parameters)
    coefficients = []
    for (factors, _), output in zip(heads, outputs, strict=True):
        coefficients.append(output)
        if factors.rates:
            coefficients[-1] = arena.zeros(len(output), factors.table.shape[2], dtype=arena.real)
            sigma = arena.hold(shared.manifold.fields["deformation"].leading, torch.float64)
            arguments = {"outputs": output, "rate": rate, "sigma": sigma, "a": coefficients[-1]}
            networks.append(
                arena.pack(make_at_rate(arena.precision), tuple(coefficients[-1].shape), **arguments)
            )
    fields = [
        (factors, placed, a, values)
        for (factors, values), placed, a in zip(heads, stored, coefficients, strict=True)
    ]
    launches = [_contraction(arena, fields, in_N, tiles)] if fields else []
    if not shared.sources.neural_stress:
        F = arena.zeros(len(span.x), 3, 3, dtype=arena.real)
        factors = shared.manifold.factors("gradient", **options)
        placed = arena.placed(factors.table, factors.rows, half=False)
        launches.append(_contraction(arena, [(factors, placed, a, F)], in_N, tiles))
        launches.append(_elastic(arena, span, [setup.scene.material for setup in setups], F))
    return networks, launches


def _as_matrices(mean: torch.Tensor) -> torch.Tensor:
    """[n, 6], symmetric, or [n, 9] → [n, 3, 3]."""
    return (mean[:, np.ravel(TAU_MATRIX)] if mean.shape[1] == 6 else mean).unflatten(1, (3, 3))


def _networks(arena: Arena, networks: list, record: LatentRecord, parameters) -> tuple[list, list]:
    """The launches of the heads, layer by layer and both at once, and where they leave their coefficients.

    A GPU takes the first two layers of one run in one launch; for many, what each output finds anew
    would cost more than a launch, and a layer is a product of matrices.
    """
    B, r = len(parameters), record.now.shape[-1]
    launches, inputs, before = [], [record.now.view(B, r)] * len(networks), []
    for layers in zip(*networks, strict=True):
        weights = []
        for W, b in layers:
            biases = [b] * B
            if not (launches or before):  # x̂ is followed by the parameters, which do not change in a run
                biases = [b + W[:, r:] @ values.to(W)[: W.shape[1] - r] for values in parameters]
                W = W[:, :r]
            weights.append([arena.hold(W, arena.real), arena.hold(torch.stack(biases), arena.real)])
        last = layers[0] is networks[0][-1]
        if arena.device.is_cuda and B == 1 and not (launches or before or last):
            before = weights
            continue
        outputs = [arena.zeros(*b.shape, dtype=arena.real) for _, b in weights]
        together = arena.device.is_cuda and B > 1
        launches.append((_product if together else _layer)(arena, before, weights, inputs, not last, outputs))
        inputs, before = outputs, []
    return launches, inputs


def _layer(arena: Arena, before: list, weights: list, inputs: list, active: bool, outputs: list) -> wp.Launch:
    """The launch of a layer of one or two networks, after the one `before` it, if it is given."""
    (tiles, tile), lanes = tiling(len(outputs[0])), arena.lanes(WARP)
    sides = _sides(weights, inputs, outputs)
    for side, (W, b) in zip(sides, before, strict=bool(before)):
        side |= {"W_0": W, "b_0": b}
    count = sum(y.shape[1] for y in outputs)
    kernel = make_layer(arena.precision, tile, tiles > 1, inputs[0].shape[1] if before else 0)
    return arena.pack(
        kernel, tiles * count * lanes, one=sides[0], two=sides[-1], active=active, lanes=lanes, outputs=count
    )


def _product(
    arena: Arena, before: list, weights: list, inputs: list, active: bool, outputs: list
) -> wp.Launch:
    """As `_layer`, for many runs on a GPU; nothing is before it."""
    sides = _sides(weights, inputs, outputs)
    members = [(side["y"].shape[1], side["x"].shape[1] // side["W"].shape[1]) for side in sides]
    first, blocks = product_blocks(members, len(outputs[0]))
    return arena.pack(
        make_product(arena.precision), blocks * THREADS, THREADS,
        one=sides[0], two=sides[-1], active=active, first=first, blocks=blocks,
    )  # fmt: skip


def _sides(weights: list, inputs: list, outputs: list) -> list[dict]:
    """Arguments of a layer for each network; of one network alone both sides are the same one."""
    layers = zip(weights, inputs, outputs, strict=True)
    return [{"W": W, "b": b, "x": x, "y": y} for (W, b), x, y in layers]


def _contraction(arena: Arena, fields: Sequence[tuple], in_N: torch.Tensor, tiles: tuple[int, int]):
    """The launch of one or two fields at N.

    A field is its factors, modes as of `Arena.placed`, coefficients a [B, K], and the output array.
    """
    number, tile = tiles
    sides = []
    for factors, placed, a, values in fields:
        sides.append({"mean": arena.hold(factors.mean, arena.real), **placed, "a": a, "values": values})
    threads = [arena.whole_blocks(f.table.shape[1] // 3 * len(f.rows), THREADS) for f, *_ in fields]
    four = [-(-a.shape[1] // 4) for _, _, a, _ in fields]
    coefficients, stored = (wp.dtype_from_torch(sides[0][name].dtype) for name in ("a", "modes"))
    kernel = make_contraction(arena.precision, (four[0], four[-1]), coefficients, tile, number > 1, stored)
    # One field alone stands on both sides; the second gets no thread.
    return arena.pack(
        kernel, number * sum(threads), THREADS, in_N=in_N, one=sides[0], two=sides[-1],
        threads=threads[0], tiles=number, lanes=arena.lanes(THREADS),
    )  # fmt: skip


def _elastic(arena: Arena, span: GridSpan, materials: Sequence[Material], F: torch.Tensor):
    """The launch of τ = τ(F) at N; without flow the history keeps its values at rest."""
    precision, n, material = arena.precision, len(F), materials[0]
    history = np.concatenate([law.initial_history(span.size) for law in materials])
    history = arena.hold(history, arena.real)
    vecH = wp.types.vector(length=material.history_size, dtype=precision.real)
    kernel = make_elastic_stress(material.functions(precision), precision, material.history_size)
    F, tau = (as_matrices(a, precision) for a in (F, span.tau))
    history = wp.from_torch(history, dtype=vecH)
    return arena.pack(kernel, n, F=F, history=history, mu=span.mu, lam=span.lam, tau=tau)
