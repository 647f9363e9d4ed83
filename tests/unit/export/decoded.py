"""All points of a playback at once."""

import torch


def whole(played) -> tuple[torch.Tensor, torch.Tensor]:
    """x [F, N, 3] and τ [F, N, 6] of all blocks, which cover the points in order."""
    blocks = list(played.blocks())
    covered = [row for block in blocks for row in range(*block.rows.indices(len(played.X)))]
    assert covered == list(range(len(played.X)))
    return torch.cat([block.x for block in blocks], 1), torch.cat([block.tau for block in blocks], 1)
