"""The encoder is the paper's."""

import pytest
import torch

from nsf.kinematics.fields.encoder import Encoder, convolved_lengths


# By hand: floor((L - 6) / 4) + 1 until L <= 12.
@pytest.mark.parametrize(
    ("particles", "lengths"),
    [(12, [12]), (13, [13, 2]), (150, [150, 37, 8]), (71363, [71363, 17840, 4459, 1114, 278, 69, 16, 3])],
)
def test_lengths(particles, lengths):
    assert convolved_lengths(particles) == lengths
    encoder = Encoder(particles, 5)
    assert [(c.in_channels, c.out_channels, c.kernel_size, c.stride) for c in encoder.convolutions] == [
        (3, 3, (6,), (4,))
    ] * (len(lengths) - 1)
    assert [(layer.in_features, layer.out_features) for layer in encoder.linear] == [
        (3 * lengths[-1], 32),
        (32, 5),
    ]
    assert encoder(torch.zeros(2, particles, 3)).shape == (2, 5)
