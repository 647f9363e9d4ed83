"""The descent of one round: on what the teacher answered and on unrolled windows of its runs."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from nsf.engines.operators.lessons import Labels
from nsf.engines.operators.model import StepOperators
from nsf.engines.operators.teacher import Teacher
from nsf.engines.operators.teaching import Teaching
from nsf.gpu import without_collection
from nsf.kinematics.training.schedules import muon_and_adam

_BATCH = 1024  # labels of one step of the descent
_FAR = 8.0  # deviations, to which long windows hold how far x̂ and d are off, so that a lost one stays bounded
_WARM_UP = 3  # steps before a graph is captured, as CUDA asks for


@dataclass(frozen=True)
class Windows:
    """How unrolled windows are learned from.

    Attributes:
        every: one step of the descent in so many has them, as they cost several times what single steps do.
        count: windows of it.
        weight: theirs, beside that of single steps.
        weigh: (x̂ − its target [w, r], steps before it, model, moves [r]) → a step's share in a window's loss.
        steepest: length of gradient beyond which it is cut.
    """

    every: int
    count: int
    weight: float
    weigh: Callable[[Tensor, int, StepOperators, Tensor], Tensor]
    steepest: float


def _by_changes(off: Tensor, step: int, model: StepOperators, moves: Tensor) -> Tensor:
    return (off / model.d_scale).square().mean()


def _by_accelerations(off: Tensor, step: int, model: StepOperators, moves: Tensor) -> Tensor:
    """In units of what one step's error would grow to; far off, where a window is lost, hardly any more.

    The unit of a coordinate is the geometric mean of its own acceleration and of that which would move
    particles as far as all coordinates do: a strong one counts for more, and a weak one for something.
    """
    common = (moves * model.a_scale).square().mean().sqrt() / moves
    squares = (off / ((step + 1) * (model.a_scale * common).sqrt())).square()
    return (squares / (1.0 + squares / _LOST)).mean()


_LOST = 400.0
#: Beside the steps of an engine from states of one's choice; and of full-order runs.
_BESIDE = Windows(every=3, count=48, weight=0.3, weigh=_by_changes, steepest=10.0)
_ALONE = Windows(every=2, count=128, weight=1.0, weigh=_by_accelerations, steepest=1.0)


class Descent:
    """Steps on a network that is changed in place.

    Muon moves the matrices and Adam the biases: so few steps leave Adam alone far from the least loss.
    On a GPU the gradient of each kind of step is captured once as a graph: its hundreds of kernels are so
    small that launching them one by one takes longer than the whole step on a CPU.

    Args:
        model: fp32, on the device of the descent.
        labels: what the teacher answered.
        teachers: whose runs are unrolled; runs: [N + 1, R, r] of each.
        moves: [r] how far particles move with each coordinate, RMS [m].
        teaching: how many steps, and the windows.
        rate: learning rate at the start; it falls to 0 along a cosine.
        generator: of batches and noise, on the host.
    """

    def __init__(
        self,
        model: StepOperators,
        labels: Labels,
        teachers: Sequence[Teacher],
        runs: Sequence[Tensor],
        moves: Tensor,
        teaching: Teaching,
        rate: float,
        generator: torch.Generator,
    ):
        self._model, self._teaching, self._generator = model, teaching, generator
        self._kind = _BESIDE if teachers[0].asked else _ALONE
        self._device = model.x_mean.device
        self._moves = self._here(moves)
        rows = [self._here(getattr(labels, name)) for name in Labels.__dataclass_fields__]
        self._xhat, self._change, self._acceleration, self._mu, self._g, features, self._lag = rows
        self._c = model.collider_state(features)
        # Far from training runs accelerations are ten to a hundred times as large, and would be all there is.
        self._weight = 1.0 / (1.0 + (self._acceleration / model.a_scale).square().mean(1) / 4.0)
        self._windows = [self._windows_of(*pair) for pair in zip(teachers, runs, strict=True)]
        optimisers = muon_and_adam(model, rate)
        course = torch.optim.lr_scheduler.CosineAnnealingLR
        self._stepping = [(each, course(each, teaching.descent)) for each in optimisers]

    def run(self) -> None:
        """All steps."""
        with one_thread():
            descend = self._captured() if self._device.type == "cuda" else self._descend
            for turn in range(self._teaching.descent):
                window = self._window_of(turn)
                descend(window, self._drawn(window))
                for optimiser, schedule in self._stepping:
                    optimiser.step()
                    schedule.step()

    def _here(self, values: Tensor) -> Tensor:
        return values.to(self._device, torch.float32)

    def _windows_of(self, teacher: Teacher, runs: Tensor) -> tuple[Tensor, ...]:
        changes = torch.cat([teacher.first_change()[None], torch.diff(runs, dim=0)])
        given = runs, changes, teacher.parameters, teacher.gravity, teacher.features
        runs, changes, mu, gravity, features = map(self._here, given)
        lags = self._model.lags_along(changes[1:])
        return runs, changes, mu, gravity, self._model.collider_state(features), lags

    # -- one step ---------------------------------------------------------------------------------------

    def _window_of(self, turn: int) -> int | None:
        """Whose windows a step unrolls; None for single steps alone."""
        if self._teaching.unroll == 1 or turn % self._kind.every:
            return None
        return turn // self._kind.every % len(self._windows)

    def _drawn(self, window: int | None) -> list[Tensor]:
        """Numbers of labels; of windows: their runs, first steps and noise [deviations of x̂]."""
        count, generator = len(self._xhat), self._generator
        drawn = [torch.randint(count, (min(_BATCH, count),), generator=generator)]
        if window is not None:
            steps, runs, r = self._windows[window][0].shape
            drawn.append(torch.randint(runs, (self._kind.count,), generator=generator))
            drawn.append(torch.randint(steps - self._unroll(steps), (self._kind.count,), generator=generator))
            drawn.append(torch.randn(self._kind.count, r, generator=generator))
        return drawn

    def _unroll(self, steps: int) -> int:
        return min(self._teaching.unroll, steps - 1)

    def _descend(self, window: int | None, drawn: list[Tensor]) -> None:
        """The gradient of one step's loss."""
        model, (at, *unrolled) = self._model, drawn
        labels = self._xhat, self._change, self._mu, self._g, self._c, self._lag
        found = model.acceleration(*(values[at] for values in labels))
        off = ((found - self._acceleration[at]) / model.a_scale).square().mean(1)
        loss = (self._weight[at] * off).mean()
        if window is not None:
            loss = loss + self._kind.weight * self._off_unrolled(self._windows[window], *unrolled)
        model.zero_grad(set_to_none=False)
        loss.backward()
        for weights in model.parameters():  # a slope that overflows in a long window tells no way
            weights.grad.nan_to_num_(0.0, 0.0, 0.0)
        torch.nn.utils.clip_grad_norm_(model.parameters(), self._kind.steepest)

    def _off_unrolled(self, window: tuple[Tensor, ...], k: Tensor, n: Tensor, noise: Tensor) -> Tensor:
        (runs, changes, mu, g, c, lags), model = window, self._model
        unroll, loss = self._unroll(len(runs)), 0.0
        x, d, lag = runs[n, k] + self._teaching.noise * model.x_scale * noise, changes[n, k], lags[n, k]
        for j in range(unroll):
            x, d = model.step(x, d, mu[k], g[n + j, k], c[n + j, k], lag)
            if self._kind is _ALONE:
                d = changes[n + j + 1, k] + softly(d - changes[n + j + 1, k], _FAR * model.d_scale)
                x = runs[n + j + 1, k] + softly(x - runs[n + j + 1, k], _FAR * model.x_scale)
            lag = model.next_lag(lag, d)
            loss = loss + self._kind.weigh(x - runs[n + j + 1, k], j, model, self._moves)
        return loss / unroll

    def _captured(self) -> Callable[[int | None, list[Tensor]], None]:
        """The same gradient as graphs, one for each kind."""
        state = self._generator.get_state()
        kinds = {self._window_of(turn) for turn in range(self._teaching.descent)}
        graphs = {
            window: graphed(partial(self._descend, window), self._drawn(window), self._device)
            for window in sorted(kinds, key=str)
        }
        self._generator.set_state(state)
        return lambda window, drawn: graphs[window](drawn)


def softly(values: Tensor, most: Tensor) -> Tensor:
    """Values held within ±most by tanh, small ones nearly as they are."""
    return most * torch.tanh(values / most)


def graphed(
    descend: Callable[[list[Tensor]], object], drawn: list[Tensor], device: torch.device
) -> Callable[[list[Tensor]], None]:
    """What finds a gradient, as one graph that adds to gradients where they lie.

    Args:
        descend: given what was drawn for it, on the device; it sets gradients to zero, not to None.
        drawn: as it will be, on the host.
        device: of the network.
    """
    held = [values.to(device) for values in drawn]
    aside = torch.cuda.Stream(device)
    aside.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(aside):
        for _ in range(_WARM_UP):
            descend(held)
    torch.cuda.current_stream(device).wait_stream(aside)
    graph = torch.cuda.CUDAGraph()
    with without_collection(), torch.cuda.graph(graph):
        descend(held)

    def take(drawn: list[Tensor]) -> None:
        for there, values in zip(held, drawn, strict=True):
            there.copy_(values)
        graph.replay()

    return take


@contextmanager
def one_thread() -> Iterator[None]:
    """So small a network gains nothing by more threads, and its bits would depend on how many there are."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
