"""The compiled loop: whole runs in one launch, a block of a GPU or a CPU's thread for each run and member."""

from collections.abc import Callable
from functools import cache

import torch
import warp as wp

from nsf.dynamics.interop import torch_device, torch_dtype
from nsf.dynamics.latent import LatentRecord
from nsf.mpm import Precision
from nsf.mpm.native import native_code
from nsf.mpm.native.access import WARP
from nsf.recurrence.form import Form, Sizes, State

_MOST_LANES = 512  # threads of a block; more would leave each too few registers
_WEIGHTS = ("first", "bias", "middle", "middle_bias", "last", "last_bias")


@cache
def _make_given(precision: Precision):
    """Warp struct of what the loop reads and writes.

    Weights [M, inputs, outputs] are flat, with all scales in them; `bias` [M B, width] are the first layers'
    with what μ adds; `states` is [B or 1, N C], `gravity` [B or 1, 3 N]. `latent`, `change` [M B r] and
    `stress` [M B n_s] are where the runs are, in fp64; `xhats` [M B, (N + 1) r] and `stresses` are their way.
    """
    real = precision.real
    kinds = {f"{name}_{part}": wp.array(dtype=real) for name in ("motion", "stress") for part in _WEIGHTS}
    kinds |= dict.fromkeys(("states", "gravity", "xhats", "stresses"), wp.array2d(dtype=real))
    kinds |= dict.fromkeys(("latent", "change", "stress"), wp.array(dtype=wp.float64))
    return wp.struct(type("Given", (), {"__annotations__": kinds, "__module__": __name__}))


def lanes_of(sizes: Sizes) -> int:
    """Threads of a GPU's block: one for each output of the widest layer, in whole warps."""
    widest = max(sizes.width, *(outputs for _, outputs in sizes.layers.values()))
    return WARP * -(-min(widest, _MOST_LANES) // WARP)


@cache
def make_recurrence(precision: Precision, sizes: Sizes):
    """Kernel of many strides of runs.

    Args:
        precision: of the networks; x̂, d and ŝ are summed in fp64.
        sizes: of the networks.
    """
    constants = {
        "R": sizes.latents, "STRESS": sizes.stress, "STATES": sizes.states, "WIDTH": sizes.width,
        "GRAVITY": sizes.gravity,
    }  # fmt: skip
    Given = _make_given(precision)

    @wp.func_native(native_code(__package__, "recurrence", real=precision.native, **constants))
    def advance(given: Given, first: int, strides: int, runs: int, run: int): ...

    @wp.kernel(enable_backward=False, module="unique", grid_stride=False, launch_bounds=lanes_of(sizes))
    def recurrence(given: Given, first: int, strides: int, runs: int, lanes: int):
        advance(given, first, strides, runs, wp.tid() / lanes)

    return recurrence


@cache
def make_frames(precision: Precision):
    """Kernel of the record of runs: means over members at each step, of values at each stride.

    x̂ is on the parabola of `between`, ŝ on the line from one stride to the next. It has a thread for each
    value at the steps from `begin` to `end`; that at `begin` stays as it is.
    """
    real = precision.real

    @wp.func
    def mean(nodes: wp.array4d(dtype=real), run: int, node: int, i: int):
        total = real(0.0)
        for member in range(nodes.shape[0]):
            total += nodes[member, run, node, i]
        return total / real(nodes.shape[0])

    @wp.kernel(enable_backward=False, module="unique")
    def frames(
        xhats: wp.array4d(dtype=real),
        stresses: wp.array4d(dtype=real),
        first: wp.array2d(dtype=real),
        stride: int,
        xhat: wp.array3d(dtype=real),
        stress: wp.array3d(dtype=real),
        before: wp.array2d(dtype=real),
        now: wp.array2d(dtype=real),
        row: wp.array(dtype=wp.int64),
        begin: int,
        end: int,
    ):
        run, step, i = wp.tid()
        n = begin + step
        node, part = n / stride, real(n % stride) / real(stride)
        k = i - first.shape[1]
        if k >= 0:
            if n > begin:
                value = mean(stresses, run, node, k)
                if n % stride:
                    value += part * (mean(stresses, run, node + 1, k) - value)
                stress[run, n, k] = value
            return
        if n > begin:
            value = mean(xhats, run, node, i)
            if n % stride:
                change = first[run, i]
                if node > 0:
                    change = value - mean(xhats, run, node - 1, i)
                next = mean(xhats, run, node + 1, i) - value
                value += real(0.5) * part * ((change + next) + part * (next - change))
            xhat[run, n, i] = value
        if n == end - 1:
            before[run, i] = xhat[run, n, i]
        if n == end:
            now[run, i] = xhat[run, n, i]
            row[run] = wp.int64(end)

    return frames


def folded(form: Form, parameters: torch.Tensor) -> dict[str, torch.Tensor]:
    """Weights of the loop, all scales in them, and the biases [M B, width] of each run; in fp64.

    Args:
        form: in fp64.
        parameters: μ [B, n] of the runs.
    """
    r, n, weights = form.sizes.latents, form.sizes.parameters, {}
    for name, layers in form.in_raw_units().items():
        (W, b), middle, last = layers
        of_mu = b[:, None] + parameters @ W[:, r : r + n]
        values = torch.cat([W[:, :r], W[:, r + n :]], 1), of_mu, *middle, *last
        weights |= {f"{name}_{part}": v for part, v in zip(_WEIGHTS, values, strict=True)}
    return weights


class Loop:
    """Runs of a recurrence on one device.

    Args:
        form: in fp64.
        parameters: μ [B, n].
        gravity: [B or 1, N, 3] [m/s²], and features: [B or 1, N, f] of the colliders, means over each stride.
        precision, device: of the loop.

    Attributes:
        form: the argument.
        xhat: [M, B, N + 1, r] and stress: [M, B, N + 1, n_s] at each stride, as far as the runs have come.
    """

    def __init__(self, form: Form, parameters, gravity, features, precision: Precision, device):
        where, dtype, sizes = torch_device(device), torch_dtype(precision), form.sizes
        self.form, self._sizes, self._count, self._device = form, sizes, len(parameters), device
        each, strides = sizes.members * len(parameters), gravity.shape[1]
        real = {"dtype": dtype, "device": where}
        with torch.no_grad():
            held = folded(form, parameters) | {"states": form.collider_state(features).flatten(1)}
        held["gravity"] = gravity.flatten(1)
        self._held = {name: values.detach().to(**real).contiguous() for name, values in held.items()}
        for name, size in (("xhats", sizes.latents), ("stresses", sizes.stress)):
            self._held[name] = torch.zeros(each, (strides + 1) * size, **real)
        for name, size in (("latent", sizes.latents), ("change", sizes.latents), ("stress", sizes.stress)):
            self._held[name] = torch.zeros(each, size, dtype=torch.float64, device=where)
        shape = sizes.members, len(parameters), strides + 1
        self.xhat = self._held["xhats"].view(*shape, sizes.latents)
        self.stress = self._held["stresses"].view(*shape, sizes.stress)
        kinds = _make_given(precision)
        self._given = kinds()
        for name, variable in kinds.vars.items():
            values = self._held.get(name, torch.zeros(0, **real))  # without ŝ it has no network
            rows = values.flatten() if variable.type.ndim == 1 else values
            setattr(self._given, name, wp.from_torch(rows))
        lanes = lanes_of(sizes) if device.is_cuda else 1
        self._launch = wp.launch(
            make_recurrence(precision, sizes), each * lanes, [self._given, 0, 0, len(parameters), lanes],
            device=device, block_dim=lanes, record_cmd=True,
        )  # fmt: skip
        self._precision = precision

    @property
    def state(self) -> State:
        """Where the runs are [M, B, ·], in fp64; a copy."""
        shape = self._sizes.members, self._count, -1
        names = "latent", "change", "stress"
        return State(*(self._held[name].view(shape).clone() for name in names))

    def begin(self, state: State, stride: int = 0) -> None:
        """Go on from a state [M, B, ·] or [B, ·] after so many strides."""
        for name, values in zip(("latent", "change", "stress"), state, strict=True):
            shape = self._sizes.members, self._count, values.shape[-1]
            self._held[name].view(shape).copy_(values)
        self.xhat[:, :, stride] = state.xhat
        self.stress[:, :, stride] = state.stress

    def force(self, since: int, gravity: torch.Tensor, features: torch.Tensor) -> None:
        """Replace gravity [B, N, 3] [m/s²] and states of the colliders [B, N, f] from a stride on."""
        with torch.no_grad():
            values = {"gravity": gravity, "states": self.form.collider_state(features)}
        for name, rows in values.items():
            if rows.shape[-1]:
                held = self._held[name].view(len(rows), -1, rows.shape[-1])
                held[:, since:] = rows[:, since:].to(held)

    def advance(self, first: int, strides: int) -> None:
        """Take strides of every run from a number of them on, in one launch."""
        for index, value in ((1, first), (2, strides)):
            self._launch.set_param_at_index(index, value)
        self._launch.launch()

    def recorder(self, first: torch.Tensor, record: LatentRecord) -> Callable[[int, int], None]:
        """A call that writes a record after one step up to another, as far as the strides have come.

        Args:
            first: [B, r] the change before the first stride.
            record: of the same runs; with `stress`.
        """
        r, n_s, shown = self._sizes.latents, self._sizes.stress, wp.from_torch
        stresses, stress = (self.stress, record.stress) if n_s else (self.xhat, record.xhat)  # none is empty
        into = record.xhat, stress, record.before, record.now
        values = self.xhat, stresses, first.to(record.xhat).contiguous()
        inputs = [*map(shown, values), self.form.stride, *map(shown, into), shown(record.row), 0, 0]
        begin_at, end_at = len(inputs) - 2, len(inputs) - 1
        launch = wp.launch(
            make_frames(self._precision), (self._count, 1, r + n_s), inputs, device=self._device,
            record_cmd=True,
        )  # fmt: skip

        self._recorded = inputs  # the launch reads where they lie

        def write(begin: int, end: int) -> None:
            launch.set_dim((self._count, end - begin + 1, r + n_s))
            for index, value in ((begin_at, begin), (end_at, end)):
                launch.set_param_at_index(index, value)
            launch.launch()

        return write

    @property
    def nbytes(self) -> int:
        """Bytes on the device."""
        return sum(values.nbytes for values in self._held.values())
