"""The compiled loop: whole runs of operators in one launch, a block of a GPU or a CPU's thread for each."""

from functools import cache

import numpy as np
import torch
import warp as wp

from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.engines.operators.model import Sizes, StepOperators
from nsf.mpm import Precision
from nsf.mpm.native import native_code
from nsf.mpm.native.access import SHARED, TAKEN, WARP

_REGISTERS = 512  # [byte] of weights that a thread of a GPU holds


@cache
def _make_given(precision: Precision):
    """Warp struct of what the loop reads and writes.

    Weights are [inputs, outputs], flat, with all scales in them; `bias` [B, width] is the first layer's with
    what μ adds; `states` is [B or 1, N C], `gravity` [B or 1, 3 N] as the network takes it, `push` [B, N r]
    what is added to each change. `latent` and `change` [B r] are x̂_n and d in fp64, `lag` [B lags] is the
    memory and `decay` [memory] what is left of it after a step; the rest is the `LatentRecord`'s.
    """
    real = precision.real

    @wp.struct
    class Given:
        first: wp.array(dtype=real)
        bias: wp.array2d(dtype=real)
        middle: wp.array(dtype=real)
        middle_bias: wp.array(dtype=real)
        last: wp.array(dtype=real)
        last_bias: wp.array(dtype=real)
        states: wp.array2d(dtype=real)
        gravity: wp.array2d(dtype=real)
        push: wp.array2d(dtype=wp.float64)
        latent: wp.array(dtype=wp.float64)
        change: wp.array(dtype=wp.float64)
        lag: wp.array(dtype=wp.float64)
        decay: wp.array(dtype=wp.float64)
        xhat: wp.array2d(dtype=real)
        before: wp.array2d(dtype=real)
        xhats: wp.array2d(dtype=real)
        row: wp.array(dtype=wp.int64)

    return Given


def block_of(width: int) -> int:
    """Threads of a GPU's block: one for each unit of a hidden layer, in whole warps."""
    return WARP * -(-min(width, 1024) // WARP)


def places(precision: Precision, sizes: Sizes) -> tuple[bool, bool]:
    """Whether a GPU's block holds the outer layers' weights, and a thread its column of the middle one's."""
    real = np.dtype(precision.numpy).itemsize
    inputs = sizes.latents + sizes.states + sizes.lags
    weights = real * sizes.width * (inputs + sizes.outputs)
    values = real * (inputs + 2 * sizes.width + sizes.outputs) + 16 * sizes.latents + 8 * sizes.lags
    return weights + values + 256 <= SHARED - TAKEN, real * sizes.width <= _REGISTERS


@cache
def make_recurrence(precision: Precision, sizes: Sizes, pushed: bool = False):
    """Kernel of many steps of runs: x̂ ← x̂ + d, d ← d + B d + Δt² (f + G g).

    On a GPU a thread has a unit of each hidden layer. The middle layer's weights are in its registers and the
    others' in shared memory as far as they fit; three products and five barriers are a step.

    Args:
        precision: of the network; x̂ and d are summed in fp64.
        sizes: of the network.
        pushed: whether something is added to each change.
    """
    kept, column = places(precision, sizes)
    constants = {
        "R": sizes.latents, "STATES": sizes.states, "MEMORY": sizes.memory, "WIDTH": sizes.width,
        "OUTPUTS": sizes.outputs, "GRAVITY": sizes.gravity, "PUSHED": pushed, "KEPT": kept, "COLUMN": column,
    }  # fmt: skip
    Given = _make_given(precision)

    @wp.func_native(native_code(__package__, "operators", real=precision.native, **constants))
    def advance(given: Given, steps: int, run: int): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False, launch_bounds=block_of(sizes.width))
    def recurrence(given: Given, steps: int, lanes: int):
        advance(given, steps, wp.tid() / lanes)

    return recurrence


def folded(model: StepOperators, parameters: torch.Tensor) -> dict[str, torch.Tensor]:
    """Weights of the loop, all scales in them, and the bias [B, width] of each run; in fp64.

    Args:
        model: in fp64.
        parameters: μ [B, n] of the runs.
    """
    (W, b), (middle, middle_bias), (last, last_bias) = model.scaled_layers()
    r, n = model.sizes.latents, model.sizes.parameters
    return {
        "first": torch.cat([W[:, :r], W[:, r + n :]], 1).T.flatten(),
        "bias": b + parameters @ W[:, r : r + n].T,
        "middle": middle.T.flatten(),
        "middle_bias": middle_bias,
        "last": last.T.flatten(),
        "last_bias": last_bias,
    }


class Recurrence:
    """Runs of operators on one device.

    Args:
        model: the operators, in fp64.
        parameters: μ [B, n].
        gravity: [B or 1, N, 3] [m/s²], and features: [B or 1, N, f] of the colliders, at each step.
        record: `LatentRecord` of the runs.
        precision, device: of the loop.
        push: [B, N, r] added to each change; None for nothing.

    Attributes:
        latent, change, lag: [B r] x̂_n and d and [B lags] the memory, in fp64.
    """

    def __init__(
        self,
        model: StepOperators,
        parameters: torch.Tensor,
        gravity: torch.Tensor,
        features: torch.Tensor,
        record,
        precision: Precision,
        device,
        push: torch.Tensor | None = None,
    ):
        where, dtype, r = torch_device(device), torch_dtype(precision), model.sizes.latents
        count = len(parameters)
        with torch.no_grad():
            held = folded(model, parameters) | {
                "states": model.collider_state(features).flatten(1),
                "gravity": ((gravity - model.g_mean) / model.g_scale).flatten(1),
            }
        held = {name: values.detach().to(where, dtype).contiguous() for name, values in held.items()}
        none = torch.zeros(0, 0, dtype=torch.float64, device=where)
        held["push"] = none if push is None else push.to(where).flatten(1)
        self.latent, self.change, self.lag = (
            none.new_zeros(count * size) for size in (r, r, model.sizes.lags)
        )
        held |= {"latent": self.latent, "change": self.change, "lag": self.lag, "row": record.row}
        held["decay"] = model.lag_decay.to(where, torch.float64) if model.sizes.memory else none.flatten()
        recorded = {"xhat": record.now, "before": record.before, "xhats": record.xhat}
        held |= {name: values.view(count, -1) for name, values in recorded.items()}
        self._held = held
        self._given = _make_given(precision)()
        for name, values in held.items():
            setattr(self._given, name, wp.from_torch(values))
        self._kernel = make_recurrence(precision, model.sizes, push is not None)
        self._lanes = block_of(model.sizes.width) if device.is_cuda else 1
        self._count, self._device = count, device

    def begin(self, xhat: torch.Tensor, change: torch.Tensor, lag: torch.Tensor | None = None) -> None:
        """Go on from x̂_n and d [B, r], and with a memory from its lags [B, lags]; None at t = 0."""
        self.latent.view(self._count, -1).copy_(xhat)
        self.change.view(self._count, -1).copy_(change)
        if lag is None:
            self.lag.zero_()
        else:
            self.lag.copy_(lag.flatten())

    def advance(self, steps: int) -> None:
        """Take steps of every run, in one launch."""
        wp.launch(
            self._kernel, dim=self._count * self._lanes, inputs=[self._given, steps, self._lanes],
            device=self._device, block_dim=self._lanes,
        )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Bytes beside the record."""
        shared = ("xhat", "before", "xhats", "row")
        return sum(values.nbytes for name, values in self._held.items() if name not in shared)
