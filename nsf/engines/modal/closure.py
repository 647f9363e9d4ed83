"""Weights of the closure of a deformation, as the projection's kernel reads them (`native/closure.h`)."""

from collections.abc import Sequence

import torch

from nsf.mpm.native.access import WARP

#: Threads that share a sum over a layer's inputs; each has two outputs, to read its inputs once for both.
PARTS = 8


def projection_block(widths: tuple[int, ...]) -> int:
    """Threads of a block: enough to take the widest layer in one turn, if there may be."""
    widest = max((*widths[1:], 1))
    return min(1024, WARP * -(-(-(-widest // 2) * PARTS) // WARP))


def packed_weights(layers: Sequence[tuple[torch.Tensor, torch.Tensor]], is_cuda: bool) -> torch.Tensor:
    """Weights [out, in] and biases [out] of a network, layer by layer, in the order in which they are read.

    A thread has two outputs, half of all apart, and every `PARTS`-th input (on a CPU every one): what a warp
    reads at once lies side by side.
    """
    parts, tile = (PARTS, WARP) if is_cuda else (1, 1)
    packed = []
    for W, b in layers:
        (out, inputs), across = W.shape, tile // parts
        half, steps = -(-out // 2), -(-inputs // parts)
        tiles = -(-half // across)
        padded = W.new_zeros(2, tiles * across, steps * parts)
        padded[0, :half, :inputs], padded[1, : out - half, :inputs] = W[:half], W[half:]
        shaped = padded.unflatten(2, (steps, parts)).unflatten(1, (tiles, across))
        packed += [shaped.permute(1, 3, 2, 4, 0).flatten(), torch.nn.functional.pad(b, (0, out % 2))]
    return torch.cat(packed)


def inputs_of_widest(widths: tuple[int, ...], latents: int) -> int:
    """Inputs of the widest layer, filled up to whole turns of the threads that share them."""
    return -(-max((*widths[:-1], latents)) // PARTS) * PARTS
