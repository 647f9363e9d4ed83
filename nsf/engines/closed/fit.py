"""The fit of a closure: windows of runs that are off, by the linearised projected step and the closure.

With e and δ how far x̂_n and d_n are off a full-order run,

    δ ← δ + X_n e + V_n δ + c(x̂_n + e, d_n + δ, μ, g_n) − D_n,    e ← e + δ,

X, V and D as `Linearised` has them. A closure that equals D along the runs is not enough: what it answers
beside them decides whether a run that is off comes back, and only windows of many steps show that.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from nsf.engines.closed.closing import Closing
from nsf.engines.closed.linear import Known, Linearised
from nsf.engines.operators.descent import graphed, one_thread, softly
from nsf.engines.operators.model import StepOperators
from nsf.engines.operators.teacher import Teacher

_SINGLE = 1024  # single steps beside the windows of a step of the descent
_FAR_X, _FAR_D = 4.0, 3.0  # deviations, to which e and δ are held, so that a lost window stays bounded
_BESIDE_X, _BESIDE_D = 0.01, 0.1  # noise on single steps, in deviations
_STEEPEST = 0.1  # length of gradient beyond which it is cut


class Fit:
    """Steps of Adam on a closure that is changed in place.

    Args:
        model: fp32, on the device of the descent.
        teacher: of the training cases; linearised: its step along their runs.
        closing: how.
        generator: of windows and noise, on the host.
    """

    def __init__(
        self,
        model: StepOperators,
        teacher: Teacher,
        linearised: Linearised,
        closing: Closing,
        generator: torch.Generator,
    ):
        self._model, self._closing, self._generator = model, closing, generator
        self._device = model.x_mean.device

        def here(values: Tensor) -> Tensor:
            return values.to(self._device, torch.float32)

        own = linearised
        self._x, self._d, self._defect = here(own.runs), here(own.changes), here(own.defect)
        self._of_x, self._of_d, self._stride = here(own.of_x), here(own.of_d), own.stride
        self._known = Known.of(own.runs).to(self._device, torch.float32)
        self._mu, self._g = here(teacher.parameters), here(teacher.gravity)
        self._c = model.collider_state(here(teacher.features))
        self._lag = model.lags_along(self._d[1:])

    def run(self, told: Callable[[int], object] = lambda steps: None) -> None:
        """All steps; `told` of each number of them that was taken."""
        for unroll, steps in self._closing.courses:
            self._descend(min(unroll, len(self._d)), steps, told)

    def _descend(self, unroll: int, steps: int, told: Callable[[int], object]) -> None:
        optimiser = torch.optim.Adam(self._model.parameters(), lr=self._closing.rate)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

        def gradient(drawn: list[Tensor]) -> None:
            loss = self._off(unroll, *drawn[:3]) + self._closing.single * self._single(*drawn[3:])
            self._model.zero_grad(set_to_none=False)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(self._model.parameters(), _STEEPEST)

        with one_thread():
            graphs = self._device.type == "cuda"
            descend = graphed(gradient, self._drawn(unroll), self._device) if graphs else gradient
            for _ in range(steps):
                descend(self._drawn(unroll))
                optimiser.step()
                schedule.step()
                told(1)

    def _drawn(self, unroll: int) -> list[Tensor]:
        """Runs, first steps and noise of windows; runs, steps and noise of single steps."""
        (N, R, r), size, generator = self._d.shape, self._closing.batch, self._generator
        k, n = (torch.randint(most, (size,), generator=generator) for most in (R, N - unroll + 1))
        single = [torch.randint(most, (_SINGLE,), generator=generator) for most in (R, N)]
        start, *beside = (torch.randn(rows, r, generator=generator) for rows in (size, _SINGLE, _SINGLE))
        return [k, n, start, *single, *beside]

    def _off(self, unroll: int, k: Tensor, n: Tensor, start: Tensor) -> Tensor:
        model, loss = self._model, 0.0
        e, delta = self._closing.noise * model.x_scale * start, torch.zeros_like(start)
        behind = torch.zeros_like(self._lag[n, k])  # how far the lags are off
        for j in range(unroll):
            m = n + j
            there = self._known.within(self._x[m, k] + e, self._d[m, k] + delta)
            given = self._mu[k], self._g[m, k], self._c[m, k], self._lag[m, k] + behind
            answer = model.acceleration(*there, *given) - self._defect[m, k]
            answer = answer + self._times(self._of_x, m, k, e) + self._times(self._of_d, m, k, delta)
            delta = softly(delta + answer, _FAR_D * model.d_scale)
            e = softly(e + delta, _FAR_X * model.x_scale)
            behind = model.next_lag(behind, delta)
            loss = loss + torch.log1p(100.0 * (e / model.x_scale).square().mean(1)).mean()
        return loss / (100.0 * unroll)

    def _times(self, slopes: Tensor, m: Tensor, k: Tensor, values: Tensor) -> Tensor:
        """Slopes at steps m of runs k, between those that are known, times values [b, r]."""
        at = (m / self._stride).clamp_max(len(slopes) - 1)
        below = at.long()
        share = (at - below)[:, None, None]
        above = (below + 1).clamp_max(len(slopes) - 1)
        found = (1.0 - share) * slopes[below, k] + share * slopes[above, k]
        return (found @ values[..., None])[..., 0]

    def _single(self, k: Tensor, n: Tensor, of_x: Tensor, of_d: Tensor) -> Tensor:
        model = self._model
        x = self._x[n, k] + _BESIDE_X * model.x_scale * of_x
        d = self._d[n, k] + _BESIDE_D * model.d_scale * of_d
        found = model.acceleration(x, d, self._mu[k], self._g[n, k], self._c[n, k], self._lag[n, k])
        return ((found - self._defect[n, k]) / model.a_scale).square().mean()
