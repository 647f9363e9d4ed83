"""The operators: one reduced step as a map of the latent vector, affine in its last change and in gravity.

    d' = d + B(x̂, μ, c) d + Δt² [f(x̂, μ, c) + G(x̂, μ, c) g],    d = x̂_n − x̂_{n−1},    x̂_{n+1} = x̂_n + d'

μ are the problem parameters and c is the state of what moves. docs/method.md derives it. Not in the paper.
With a memory, B, f and G also see lags e_k, by how much x̂ is ahead of its mean over the last time T_k:

    e_k ← exp(−Δt/T_k) (e_k + d'),    e_k = 0 at t = 0
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from nsf.data import archives
from nsf.engines.operators.taught import Taught
from nsf.errors import ConfigError, SchemaError, first_line
from nsf.sampling.sampler import SampleSpan
from nsf.storage import writing

FORMAT = "nsf-operators"
FORMAT_VERSION = 3


@dataclass(frozen=True)
class Sizes:
    """Sizes of a network of operators.

    Attributes:
        latents: r; parameters: n; features: of collider states; states: C, what varies among these.
        gravity: whether there is any.
        width: of both hidden layers.
        memory: how many lags there are, each of r numbers.
    """

    latents: int
    parameters: int
    features: int
    states: int
    gravity: bool
    width: int
    memory: int = 0

    @property
    def lags(self) -> int:
        """Numbers of all lags."""
        return self.memory * self.latents

    @property
    def inputs(self) -> int:
        """Inputs of the network."""
        return self.latents + self.parameters + self.states + self.lags

    @property
    def outputs(self) -> int:
        """Entries of B [r, r], f [r] and, where there is gravity, G [r, 3]."""
        return self.latents * (self.latents + 1 + 3 * self.gravity)


class StepOperators(nn.Module):
    """A network of two hidden SiLU layers that gives B, f and G.

    Its last layer is zero at the start: no acceleration. Whatever it is given is standardised, and what it
    gives is in units of what training runs show; all scales are buffers.

    Args:
        sizes: of the network.
        dt: step [s].

    Attributes:
        x_mean, x_scale: [r] of x̂; mu_mean, mu_scale: [n] of μ.
        c_mean: [features], c_matrix: [features, C]: of collider states (`states.principal`).
        d_scale, a_scale: [r] deviation of d and of d' − d in training runs.
        g_mean: [3], g_scale: [] [m/s²]; f + G g is found as (f + G ḡ) + G (g − ḡ).
        lag_decay: [memory] exp(−Δt/T) of each lag; lag_scale: [lags] their deviations; only with a memory.
    """

    def __init__(self, sizes: Sizes, dt: float):
        super().__init__()
        self.sizes, self.dt = sizes, dt
        width, r, n = sizes.width, sizes.latents, sizes.parameters
        self.net = nn.Sequential(
            nn.Linear(sizes.inputs, width), nn.SiLU(),
            nn.Linear(width, width), nn.SiLU(),
            nn.Linear(width, sizes.outputs),
        )  # fmt: skip
        nn.init.zeros_(self.net[4].weight)
        nn.init.zeros_(self.net[4].bias)
        buffers = {
            "x_mean": torch.zeros(r), "x_scale": torch.ones(r),
            "mu_mean": torch.zeros(n), "mu_scale": torch.ones(n),
            "c_mean": torch.zeros(sizes.features), "c_matrix": torch.zeros(sizes.features, sizes.states),
            "d_scale": torch.ones(r), "a_scale": torch.ones(r),
            "g_mean": torch.zeros(3), "g_scale": torch.ones(()),
        }  # fmt: skip
        if sizes.memory:
            buffers |= {"lag_decay": torch.zeros(sizes.memory), "lag_scale": torch.ones(sizes.lags)}
        for name, value in buffers.items():
            self.register_buffer(name, value)

    def collider_state(self, features: Tensor) -> Tensor:
        """c [..., C] of collider states [..., features] (`states.collider_states`)."""
        return (features - self.c_mean) @ self.c_matrix

    def next_lag(self, lag: Tensor, change: Tensor) -> Tensor:
        """The lags [..., lags] after a step that changed x̂ by d' [..., r]."""
        if not self.sizes.memory:
            return lag
        moved = lag.unflatten(-1, (self.sizes.memory, -1)) + change.unsqueeze(-2)
        return (self.lag_decay[:, None] * moved).flatten(-2)

    def lags_along(self, changes: Tensor) -> Tensor:
        """The lags [N + 1, ..., lags] of runs from t = 0 on, whose steps change x̂ by d' [N, ..., r]."""
        found = [changes.new_zeros(*changes.shape[1:-1], self.sizes.lags)]
        for change in changes if self.sizes.memory else ():
            found.append(self.next_lag(found[-1], change))
        return torch.stack(found) if self.sizes.memory else found[0].expand(len(changes) + 1, *found[0].shape)

    def lags_after(self, runs: Tensor) -> Tensor:
        """The lags [B, lags] at the end of runs [B, n + 1, r] from t = 0 on."""
        return self.lags_along(torch.diff(runs.detach().to(self.x_mean), dim=1).transpose(0, 1))[-1]

    def acceleration(
        self,
        xhat: Tensor,
        change: Tensor,
        parameters: Tensor,
        gravity: Tensor,
        c: Tensor,
        lag: Tensor | None = None,
    ) -> Tensor:
        """d' − d [..., r]; arguments as for `step`."""
        r, lead = self.sizes.latents, xhat.shape[:-1]
        given = [(xhat - self.x_mean) / self.x_scale, (parameters - self.mu_mean) / self.mu_scale, c]
        if self.sizes.memory:
            given.append(lag / self.lag_scale)
        out = self.net(torch.cat([values.expand(*lead, values.shape[-1]) for values in given], -1))
        B, f = out[..., : r * r].unflatten(-1, (r, r)), out[..., r * r : r * r + r]
        found = (B @ (change / self.d_scale)[..., None])[..., 0] + f
        if self.sizes.gravity:
            G = out[..., r * r + r :].unflatten(-1, (r, 3))
            found = found + (G @ ((gravity - self.g_mean) / self.g_scale)[..., None])[..., 0]
        return self.a_scale * found

    def step(
        self,
        xhat: Tensor,
        change: Tensor,
        parameters: Tensor,
        gravity: Tensor,
        c: Tensor,
        lag: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """x̂_{n+1} and d' [..., r].

        Args:
            xhat, change: [..., r] x̂_n and d = x̂_n − x̂_{n−1}.
            parameters: μ [..., n]; gravity: [..., 3] [m/s²]; c: [..., C]; each may lack leading axes.
            lag: [..., lags] with a memory (`lags_along`, `next_lag`).
        """
        change = change + self.acceleration(xhat, change, parameters, gravity, c, lag)
        return xhat + change, change

    def scaled_layers(self) -> list[tuple[Tensor, Tensor]]:
        """Weights [out, in] and biases [out] of the same network with the scales in them, as the loop has it.

        Its inputs are x̂, μ, c and lags; its outputs the entries of B [r, r], Δt² f [r] and Δt² G [r, 3],
        with d' = d + B d + Δt² (f + G γ), where γ = (g − ḡ)/s is gravity in units of its scale.
        """
        (W, b), middle, (V, v) = ((layer.weight, layer.bias) for layer in (self.net[i] for i in (0, 2, 4)))
        r, n, C = self.sizes.latents, self.sizes.parameters, self.sizes.states
        of_x, of_mu, of_c, of_lag = W.split([r, n, C, self.sizes.lags], 1)
        of_x, of_mu = of_x / self.x_scale, of_mu / self.mu_scale
        if self.sizes.memory:
            of_lag = of_lag / self.lag_scale
        first = torch.cat([of_x, of_mu, of_c, of_lag], 1), b - of_x @ self.x_mean - of_mu @ self.mu_mean
        unit = [(self.a_scale[:, None] / self.d_scale).flatten(), self.a_scale]
        if self.sizes.gravity:
            unit.append(self.a_scale.repeat_interleave(3))
        unit = torch.cat(unit)
        return [first, middle, (unit[:, None] * V, unit * v)]

    def raw_layers(self) -> list[tuple[Tensor, Tensor]]:
        """The same for raw inputs and outputs, as a page has it; without a memory.

        In place of c are the collider states as `states.collider_states` gives them, and G takes g itself.
        """
        (W, b), middle, (V, v) = self.scaled_layers()
        r, n = self.sizes.latents, self.sizes.parameters
        of_states = W[:, r + n :] @ self.c_matrix.T
        first = torch.cat([W[:, : r + n], of_states], 1), b - of_states @ self.c_mean
        B, f, G = torch.cat([V, v[:, None]], 1).tensor_split([r * r, r * r + r])
        if self.sizes.gravity:
            G = G / self.g_scale
            f = f - (G.unflatten(0, (r, 3)) * self.g_mean[:, None]).sum(1)
        last = torch.cat([B, f, G])
        return [first, middle, (last[:, :-1], last[:, -1])]

    def save(self, path: Path | str, taught: Taught, samples: Sequence[SampleSpan]) -> None:
        """Write weights, scales, on what they were taught, and the sample; whole or not at all."""
        content = {
            "format": FORMAT, "format_version": FORMAT_VERSION, "sizes": vars(self.sizes), "dt": self.dt,
            "taught": taught.plain(), "samples": [_plain(sample) for sample in samples],
            "state": dict(self.state_dict()),
        }  # fmt: skip
        with writing(Path(path)) as temporary:
            torch.save(content, temporary)

    @classmethod
    def load(cls, path: Path | str) -> tuple["StepOperators", Taught, list[SampleSpan]]:
        """Read operators, what they were taught on and the sample, onto the host.

        Raises:
            MissingRunError: there is no such file.
            SchemaError: the file is truncated, foreign or of a newer format, or does not fit together.
        """
        path = Path(path)
        content = archives.tensors(path, "operators", "teach", (FORMAT, FORMAT_VERSION))
        try:
            taught, sizes = Taught.read(content["taught"]), Sizes(**content["sizes"])
            samples = [_sample(span) for span in content["samples"]]
            with torch.device("meta"):  # whatever sizes the file claims, nothing of theirs is made
                model = cls(sizes, taught.dt)
            model.load_state_dict(content["state"], assign=True)
            if not all(bool(torch.isfinite(values).all()) for values in model.state_dict().values()):
                raise ValueError("a value is not finite")
        except (RuntimeError, KeyError, TypeError, AttributeError, ValueError, ConfigError) as error:
            raise SchemaError(
                f"{path}: its contents do not fit each other ({first_line(error)}); teach again with "
                "`nsf teach`"
            ) from error
        return model.double().requires_grad_(False).eval(), taught, samples


def _plain(sample: SampleSpan) -> dict:
    weights = sample.weights
    return {
        "start": float(sample.start),
        "particles": torch.as_tensor(np.asarray(sample.particles, np.int64)),
        "weights": None if weights is None else torch.as_tensor(np.asarray(weights, np.float64)),
    }


def _sample(plain: dict) -> SampleSpan:
    weights = plain["weights"]
    return SampleSpan(
        plain["start"], plain["particles"].numpy(), None if weights is None else weights.numpy()
    )
