"""Recurrences of random weights, and what runs of them are given."""

import torch

from nsf.recurrence import Form, Sizes


def form(stress=3, states=2, gravity=True, members=2, stride=1, width=16, latents=4):
    """A recurrence in fp64 whose runs stay of order one."""
    sizes = Sizes(latents, stress, 2, 9 * bool(states), states, gravity, width, members)
    made, generator = Form(sizes, 0.01, stride).double(), torch.Generator().manual_seed(0)
    for name, values in made.named_buffers():
        scaled = 0.5 + torch.rand(values.shape, generator=generator).double()
        values.copy_(0.01 * scaled if name in ("d_scale", "a_scale", "t_scale") else scaled)
    for network in made.networks.values():
        for weight in network.weights:
            weight.data.normal_(std=0.4 * weight.shape[1] ** -0.5, generator=generator)
        network.biases[2].data.normal_(std=0.1, generator=generator)
    return made.requires_grad_(False)


def inputs(made, runs=3, strides=12):
    """x̂_0 and d [B, r], μ [B, n], gravity [N k, B, 3] and states of the colliders [N k, B, f]."""
    generator, sizes = torch.Generator().manual_seed(1), made.sizes
    steps = strides * made.stride
    shapes = (runs, sizes.latents), (runs, sizes.latents), (runs, sizes.parameters)
    shapes += (steps, runs, 3), (steps, runs, sizes.features)
    x, d, mu, g, solids = (torch.randn(shape, generator=generator).double() for shape in shapes)
    return x, 0.01 * d, mu, g, 0.5 * solids
