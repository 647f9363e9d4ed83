"""Fits a recurrence to runs: descent on windows of them, from 16 strides to half a run."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from nsf.errors import InstabilityError
from nsf.gpu import without_collection
from nsf.recurrence.fitting import Fitting, check_stride
from nsf.recurrence.form import Form, State

_RATE, _LAST_RATE = 2e-3, 1e-5  # of Adam, along a cosine
_BETAS = (0.9, 0.98)
_STEEPEST = 1.0  # length at which a member's gradient is cut
#: Deviations to which a window holds how far x̂, d and ŝ are off, so that a lost one stays bounded.
_FAR = 8.0
#: In a window's loss: share of each coordinate beside how far particles move, of ŝ, and of single strides.
_EACH, _STRESS, _SINGLE = 0.02, 0.1, 0.3
_GROWTH = 1000.0  # of an error in the loss log(1 + growth · e/(1 + j)) of stride j
#: Strides of the windows and share of the descent that each takes; the last is half a run where that is more.
_WINDOWS = ((16, 0.35), (64, 0.45), (64, 0.2))
_WARM_UP = 3  # steps before a graph is captured, as CUDA asks for


@dataclass(frozen=True)
class Runs:
    """Runs in strides, with what determines them; in fp64 on the host.

    Attributes:
        xhat: [N + 1, R, r]; stress: [N + 1, R, n_s] ŝ; first: [R, r] what stands for d at t = 0.
        parameters: [R, n]; gravity: [N, R, 3] [m/s²] and features: [N, R, f] of colliders, in strides.
    """

    xhat: Tensor
    stress: Tensor
    first: Tensor
    parameters: Tensor
    gravity: Tensor
    features: Tensor

    @classmethod
    def in_strides(cls, stride: int, xhat, stress, first, parameters, gravity, features) -> "Runs":
        """Runs in strides, from their values at every step: x̂ [N k + 1, R, r] and so on.

        Raises:
            ConfigError: the stride does not divide the steps.
        """
        check_stride(stride, len(xhat) - 1)
        g, f = (of_strides(values, stride) for values in (gravity, features))
        return cls(xhat[::stride], stress[::stride], stride * first, parameters, g, f)

    @classmethod
    def of(cls, lessons, stride: int, stress: int) -> "Runs":
        """Encoded runs in strides, with the first coordinates of their stress.

        Args:
            lessons: a `nsf.models.inputs.Lessons`; stride: k; stress: n_s.
        """
        of = lessons.inputs
        along = (lessons.xhat, lessons.stress[..., :stress], of.first, of.parameters, of.gravity, of.solids)
        xhat, shat, first, parameters, gravity, solids = (torch.as_tensor(v).double() for v in along)
        xhat, shat, gravity, solids = (v.transpose(0, 1) for v in (xhat, shat, gravity, solids))
        return cls.in_strides(stride, xhat, shat, first, parameters, gravity, solids)

    @property
    def changes(self) -> Tensor:
        """d [N + 1, R, r]."""
        return torch.cat([self.first[None], torch.diff(self.xhat, dim=0)])


def of_strides(values: Tensor, stride: int) -> Tensor:
    """Means over strides [N, ...] of values at each step [N k, ...]."""
    return values.unflatten(0, (-1, stride)).mean(1)


@dataclass(frozen=True)
class Yardstick:
    """Validation runs, which choose the weights.

    Attributes:
        runs: in strides.
        positions: x̂ [F, r] → [F, s, 3] [m] of particles all over the body.
        truth: [F, R, s, 3] [m] where these are, at every `every`-th stride.
        every: strides; stride: k steps.
    """

    runs: Runs
    positions: Callable[[Tensor], Tensor]
    truth: Tensor
    every: int = 1
    stride: int = 1

    def errors(self, form: Form) -> Tensor:
        """[R] displacement error of the members' mean, a fraction; not finite of a run that is lost."""
        runs = self.runs
        start = form.begin(runs.xhat[0], runs.first, runs.stress[0])
        with torch.no_grad():
            xhat, _ = form.run(start, runs.parameters, runs.gravity, form.collider_state(runs.features))
        return self.off(xhat.mean(1))

    def off(self, xhat: Tensor) -> Tensor:
        """[R] displacement error of x̂ [N + 1, R, r] at strides, likewise."""
        errors = []
        for run, truth in zip(xhat[:: self.every].unbind(1), self.truth.unbind(1), strict=True):
            off = (self.positions(run) - truth).square().sum()
            errors.append((off / (truth - truth[:1]).square().sum()).sqrt())
        return torch.stack(errors)

    def moves(self, xhat: Tensor, scale: Tensor) -> Tensor:
        """[r] how far particles move with each coordinate, RMS [m] a unit of it; at x̂ [r], by ± scale [r]."""
        either = [self.positions(xhat + way * torch.diag(scale)) for way in (1.0, -1.0)]
        moved = (either[0] - either[1]).square().sum(-1).mean(1).sqrt() / (2.0 * scale)
        return moved.clamp_min(max(1e-3 * float(moved.max()), torch.finfo(moved.dtype).tiny))


def fit(
    form: Form,
    runs: Runs,
    yardstick: Yardstick,
    sigma: Tensor,
    fitting: Fitting,
    seed: int,
    device: torch.device | str = "cpu",
    after: Callable[[int], object] = lambda descents: None,
) -> list[float]:
    """Descend; the recurrence, in place, is then the best at the validation runs.

    Args:
        form: of `standardised`.
        runs: that teach. yardstick: validation runs, looked at after each kind of window.
        sigma: [r] how far particles move with each coordinate, in any common unit.
        fitting: how long and how wide; seed: of windows and noise; device: of the descent.
        after: called with each number of steps taken.

    Returns:
        Mean displacement error at validation runs after each kind of window; ∞ where one is lost.

    Raises:
        InstabilityError: every one is lost.
    """
    descent = Descent(form, runs, sigma, fitting, seed, device)
    errors, best = [], None
    with one_thread():
        for window, steps in windows(len(runs.xhat) - 1, fitting):
            descent.run(window, steps, after)
            descent.copy_to(form)
            error = float(yardstick.errors(form).mean())
            errors.append(error if np.isfinite(error) else np.inf)
            if np.isfinite(error) and error == min(errors):
                best = {name: value.clone() for name, value in form.state_dict().items()}
    if best is None:
        raise InstabilityError(
            "every recurrence that was fitted loses a validation run; raise model.descents or model.runs, or "
            "deploy with model=projected"
        )
    form.load_state_dict(best)
    _check_members(form, yardstick.runs)
    return errors


def _check_members(form: Form, runs: Runs) -> None:
    """Refuse members that say different things of the first stride of the runs.

    Raises:
        InstabilityError: their changes differ by more than these vary in all runs.
    """
    c, start = form.collider_state(runs.features[0]), form.begin(runs.xhat[0], runs.first, runs.stress[0])
    with torch.no_grad():
        change = form.step(start, runs.parameters, runs.gravity[0], c).change
    apart = float(((change - change.mean(0)) / form.d_scale).square().mean().sqrt())
    if not apart <= 1.0:
        raise InstabilityError(
            f"the {form.sizes.members} members disagree from the first step, by {apart:.3g} deviations of a "
            "change; raise model.descents or model.runs"
        )


def windows(strides: int, fitting: Fitting) -> list[tuple[int, int]]:
    """Strides of each kind of window, and how many steps of the descent take it."""
    longest = max(1, strides - 2)
    last = fitting.window or max(_WINDOWS[-1][0], strides // 2)
    lengths = [min(length, last, longest) for length in (*(length for length, _ in _WINDOWS[:-1]), last)]
    steps = [max(1, round(share * fitting.descents)) for _, share in _WINDOWS]
    return list(zip(lengths, steps, strict=True))


def ends(states: int, window: int) -> Tensor:
    """Weights [states] of a run in windows of some strides: the fewer of them reach a state, the more.

    The last state of a run is in one of all windows, and bodies of a family have its shape at no other time.
    The mean over windows is 1; the start of a run, which no window has to reach, has 0.
    """
    n = torch.arange(1, states)
    windows = torch.minimum(torch.minimum(n, states - n), torch.tensor(min(window, states - window))).double()
    return torch.cat([windows.new_zeros(1), windows.sum() / (len(n) * windows)])


class Descent:
    """Steps of Adam on all members together, none of which sees the others.

    On a GPU a step is captured once for each kind of window: its thousands of kernels are so small that to
    launch them one by one takes longer than the step on a CPU.

    Args:
        form: where it begins; it stays as it is.
        runs, sigma, fitting, seed, device: as for `fit`.
    """

    def __init__(self, form: Form, runs: Runs, sigma: Tensor, fitting: Fitting, seed: int, device):
        def here(values: Tensor) -> Tensor:
            return values.detach().to(device, torch.float32)

        self._form = Form(form.sizes, form.dt, form.stride).to(device)
        self._form.load_state_dict(form.state_dict())
        self._states = here(form.standard(State(runs.xhat, runs.changes, runs.stress)))
        inputs = form.standard_inputs(runs.parameters, runs.gravity, form.collider_state(runs.features))
        self._seen, self._terms = map(here, inputs)
        self._fitting, self._generator = fitting, torch.Generator().manual_seed(seed)
        self._device, self._taken = torch.device(device), 0
        self._weight, self._single = (here(weights) for weights in _weights(form, sigma))
        self._ends: dict[int, Tensor] = {}  # weights of the states of runs, by windows
        captured = self._device.type == "cuda"
        rate = torch.tensor(_RATE, device=device) if captured else _RATE
        self._adam = torch.optim.Adam(self._form.parameters(), lr=rate, betas=_BETAS, capturable=captured)

    def run(self, window: int, steps: int, after: Callable[[int], object]) -> None:
        """Take steps on windows of some strides."""
        descend = self._captured(window) if self._device.type == "cuda" else self._descend
        for _ in range(steps):
            self._set_rate()
            descend(window, *self._drawn(window))
            self._taken += 1
            after(1)

    def copy_to(self, form: Form) -> None:
        """Give the weights to a recurrence."""
        form.load_state_dict(self._form.state_dict())

    def _set_rate(self) -> None:
        turn = min(1.0, self._taken / self._fitting.descents)
        rate = _LAST_RATE + 0.5 * _RATE * (1.0 + np.cos(np.pi * turn))
        group = self._adam.param_groups[0]
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(rate)
        else:
            group["lr"] = rate

    def _drawn(self, window: int) -> list[Tensor]:
        """Runs and first strides [M, b] of windows, and noise on x̂ and ŝ [M, b, ·], for each member."""
        sizes, generator = self._form.sizes, self._generator
        (strides, runs, _), shape = self._states.shape, (sizes.members, self._fitting.batch)
        drawn = [
            torch.randint(runs, shape, generator=generator),
            torch.randint(strides - window, shape, generator=generator),
            torch.randn(*shape, sizes.latents, generator=generator),
            torch.randn(*shape, sizes.stress, generator=generator),
        ]
        return [values.to(self._device) for values in drawn]

    def _descend(self, window: int, *drawn: Tensor) -> None:
        form = self._form
        form.zero_grad(set_to_none=False)
        self._loss(window, *drawn).backward()
        gradients = [weights.grad for weights in form.parameters()]
        for gradient in gradients:  # a slope that overflows in a long window tells no way
            gradient.nan_to_num_(0.0, 0.0, 0.0)
        length = torch.stack([g.flatten(1).square().sum(1) for g in gradients]).sum(0).sqrt()
        share = (_STEEPEST / (length + 1e-6)).clamp_max(1.0)
        for gradient in gradients:
            gradient.mul_(share.view(-1, *[1] * (gradient.ndim - 1)))
        self._adam.step()

    def _loss(self, window: int, k: Tensor, n: Tensor, of_x: Tensor, of_s: Tensor) -> Tensor:
        """Sum over members of the mean loss of their windows."""
        form, ratios = self._form, self._form.ratios
        steps = n + torch.arange(window + 1, device=n.device)[:, None, None]
        truth, seen, terms = self._states[steps, k], self._seen[steps[:-1], k], self._terms[steps[:-1], k]
        noise = torch.cat([of_x, torch.zeros_like(of_x), of_s], -1)
        state, offs = truth[0] + self._fitting.noise * noise, []
        for target, *inputs in zip(truth[1:], seen, terms, strict=True):
            off = _held(form.advance(state, *inputs, ratios) - target)
            state = target + off
            offs.append(off)
        errors = (self._weight * torch.stack(offs).square()).sum(-1)
        growth = _GROWTH / torch.arange(1.0, window + 1, device=n.device)
        each = torch.log1p(growth[:, None, None] * errors)
        loss = (self._weights_of(window)[steps[1:]] * each).mean((0, 2))
        apart = form.advance(truth[0], seen[0], terms[0], ratios) - truth[1]
        single = (self._single * apart.square()).sum(-1).mean(1)
        return (loss + _SINGLE * single).sum()

    def _weights_of(self, window: int) -> Tensor:
        """[N + 1] of the states of a run in windows; those of a GPU are made before a graph is captured."""
        if window not in self._ends:
            states = len(self._states)
            weights = ends(states, window) if self._fitting.ends else torch.ones(states)
            self._ends[window] = weights.to(self._states)
        return self._ends[window]

    def _captured(self, window: int) -> Callable[..., None]:
        """A step of the descent as a CUDA graph."""
        state = self._generator.get_state()
        held = self._drawn(window)
        self._generator.set_state(state)
        weights = [w.detach().clone() for w in self._form.parameters()]
        moments = {i: {k: v.clone() for k, v in s.items()} for i, s in enumerate(self._adam.state.values())}
        aside = torch.cuda.Stream(self._device)
        aside.wait_stream(torch.cuda.current_stream(self._device))
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                self._descend(window, *held)
        torch.cuda.current_stream(self._device).wait_stream(aside)
        graph = torch.cuda.CUDAGraph()
        with without_collection(), torch.cuda.graph(graph):
            self._descend(window, *held)
        self._restore(weights, moments)

        def take(window: int, *drawn: Tensor) -> None:
            for there, values in zip(held, drawn, strict=True):
                there.copy_(values)
            graph.replay()

        return take

    @torch.no_grad()
    def _restore(self, weights: Sequence[Tensor], moments: dict) -> None:
        """Undo the steps that warmed up, in place, as the graph reads where they lie."""
        for now, before in zip(self._form.parameters(), weights, strict=True):
            now.copy_(before)
        for i, state in enumerate(self._adam.state.values()):
            for name, value in state.items():
                value.copy_(moments[i][name]) if i in moments else value.zero_()


def _held(off: Tensor) -> Tensor:
    """Values in deviations held within ± `_FAR`, small ones nearly as they are."""
    return _FAR * torch.tanh(off / _FAR)


def _weights(form: Form, sigma: Tensor) -> tuple[Tensor, Tensor]:
    """[2 r + n_s] of squared errors of a standardised state [x̂; d; ŝ], in a window and in single strides.

    Args:
        form: with the scales.
        sigma: [r] how far particles move with each coordinate.
    """
    moves = (sigma.to(form.x_scale) * form.x_scale).square()
    place = moves / moves.sum() + _EACH / len(moves)
    stress = form.s_scale.new_full((form.sizes.stress,), 1.0 / max(1, form.sizes.stress))
    single = (form.d_scale / form.a_scale).square() / len(moves)
    in_window = [place, torch.zeros_like(place), _STRESS * stress]
    in_single = [torch.zeros_like(place), single, stress * (form.s_scale / form.t_scale).square()]
    return torch.cat(in_window), torch.cat(in_single)


@contextmanager
def one_thread() -> Iterator[None]:
    """So small a network gains little by more threads, and its bits would depend on how many there are."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
