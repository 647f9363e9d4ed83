"""Launches that give τ and C where a `ModalPhase` needs them: the heads, then modes times what these find."""

from collections.abc import Sequence

import numpy as np
import torch
import warp as wp

from nsf.data import TAU_MATRIX
from nsf.dynamics.arena import Arena
from nsf.dynamics.interop import as_matrices
from nsf.dynamics.latent import LatentRecord
from nsf.dynamics.methods import Method
from nsf.dynamics.modal_kernels import THREADS, make_contraction, tiling
from nsf.dynamics.network_kernel import make_layer, make_product, product_blocks
from nsf.dynamics.span import Span
from nsf.mpm.access import WARP
from nsf.mpm.materials import Material, make_elastic_stress


def field_launches(
    arena, phase: Span, manifold, method: Method, order, parameters, materials
) -> tuple[list, list]:
    """The launches of the networks, and those that then give τ and C at N, as the method takes them."""
    options = {"dtype": arena.real, "device": phase.batch.shared.torch_device}
    heads = []
    for name, neural, found in (
        ("stress", method.neural_stress, phase.tau),
        ("affine", method.neural_affine, phase.C),
    ):
        if neural:
            factors = manifold.factors(name, order, **options)
            if factors.table.shape[2]:
                heads.append((factors, found))
            else:  # the same in every snapshot
                found.unflatten(0, (-1, phase.size)).copy_(_as_matrices(factors.mean))
    stored = [arena.halved(factors.table, factors.rows) for factors, _ in heads]
    networks, coefficients = _networks(arena, [f.layers for f, _ in heads], phase.record, parameters)
    fields = [
        (factors, *modes, a, found)
        for (factors, found), modes, a in zip(heads, stored, coefficients, strict=True)
    ]
    launches = [_contraction(arena, phase, fields)] if fields else []
    if not method.neural_stress:
        F = arena.zeros(len(phase.x), 3, 3, dtype=arena.real)
        factors = manifold.factors("gradient", order, **options)
        whole = arena.modes(factors.table, factors.rows), arena.zeros(1, dtype=arena.real)  # over no lengths
        launches.append(_contraction(arena, phase, [(factors, *whole, phase.coefficients.a, F)]))
        launches.append(_elastic(arena, phase, materials, F))
    return networks, launches


def _as_matrices(mean: torch.Tensor) -> torch.Tensor:
    """[n, 6], symmetric, or [n, 9] → [n, 3, 3]."""
    return (mean[:, np.ravel(TAU_MATRIX)] if mean.shape[1] == 6 else mean).unflatten(1, (3, 3))


def _networks(arena: Arena, networks: list, record: LatentRecord, parameters) -> tuple[list, list]:
    """The launches of the heads, layer by layer and both at once, and where they leave their coefficients.

    A GPU takes the first two layers of one simulation in one launch; for many, what each output finds anew
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
    sides = [[*first, *own, x] for first, own, x in zip(before or weights, weights, inputs, strict=True)]
    count = sum(y.shape[1] for y in outputs)
    # One network alone stands on both sides; the second gets no thread.
    arguments = [*sides[0], *sides[-1], int(active), lanes, count, outputs[0], outputs[-1]]
    kernel = make_layer(arena.precision, tile, tiles > 1, inputs[0].shape[1] if before else 0)
    return arena.pack(kernel, tiles * count * lanes, arguments)


def _product(
    arena: Arena, before: list, weights: list, inputs: list, active: bool, outputs: list
) -> wp.Launch:
    """As `_layer`, for many simulations of a GPU; nothing is before it."""
    sides = [[*own, x] for own, x in zip(weights, inputs, strict=True)]
    members = [(y.shape[1], x.shape[1] // W.shape[1]) for (W, _, x), y in zip(sides, outputs, strict=True)]
    first, blocks = product_blocks(members, len(outputs[0]))
    arguments = [*sides[0], *sides[-1], int(active), first, blocks, outputs[0], outputs[-1]]
    return arena.pack(make_product(arena.precision), blocks * THREADS, arguments, THREADS)


def _contraction(arena: Arena, phase: Span, fields: Sequence[tuple]):
    """The launch of one or two fields at the needed particles.

    A field is its factors, the arena's modes, their lengths, coefficients a [B, K], and where it goes.
    """
    a, lanes = fields[0][3], arena.lanes(THREADS)
    four = [-(-factors.table.shape[2] // 4) for factors, *_ in fields]
    tiles, tile = phase.tiling
    threads, inputs = [], [phase.needed]
    for factors, *rest in fields:
        threads.append(arena.whole_blocks(factors.table.shape[1] // 3 * len(factors.rows), THREADS))
        inputs += [arena.hold(factors.mean, arena.real), *rest]
    # One field alone stands on both sides; the second gets no thread.
    inputs += inputs[-5:] * (2 - len(fields)) + [threads[0], tiles, lanes]
    coefficients, stored = (wp.dtype_from_torch(values.dtype) for values in (a, fields[0][1]))
    kernel = make_contraction(arena.precision, (four[0], four[-1]), coefficients, tile, tiles > 1, stored)
    return arena.pack(kernel, tiles * sum(threads), inputs, THREADS)


def _elastic(arena: Arena, phase: Span, materials: Sequence[Material], F: torch.Tensor):
    """The launch of τ = τ(F) at N; without flow the history keeps its values at rest."""
    precision, n, material = arena.precision, len(F), materials[0]
    history = np.concatenate([one.initial_history(phase.size) for one in materials])
    history = arena.hold(history, arena.real)
    vecH = wp.types.vector(length=material.history_size, dtype=precision.real)
    kernel = make_elastic_stress(material.functions(precision), precision, material.history_size)
    matrices = [as_matrices(a, precision) for a in (F, phase.tau)]
    inputs = [matrices[0], wp.from_torch(history, dtype=vecH), phase.mu, phase.lam, matrices[1]]
    return arena.pack(kernel, n, inputs)
