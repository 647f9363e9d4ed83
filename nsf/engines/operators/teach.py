"""Teaching: the projected step is asked from many states, and the operators learn what it answers.

Labels are single steps of the teacher; the operators' own runs say from where, round by round, as in DAgger
(Ross et al. 2011). Held-out values have no part in it.
"""

import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from nsf.data import archives
from nsf.engines.operators.descent import Descent
from nsf.engines.operators.lessons import Labels, Yardstick
from nsf.engines.operators.model import Sizes, StepOperators
from nsf.engines.operators.states import principal
from nsf.engines.operators.teacher import Teacher
from nsf.engines.operators.teaching import Teaching
from nsf.errors import InstabilityError

_FAR = 4.0  # deviations from the mean of training latents, beyond which a run of one's own is cut off
#: Of their own deviation, by which the last change of a state of the tube differs from that of its run.
_OTHER_CHANGE = 0.1
#: Moments of each sweep along a run, at least: with dozens of training cases the teacher's own runs use up
#: all its steps.
_LEAST_ASKED = 40
_ASKED = 12  # moments at which it is found how far the teacher's step is from affine


class Course:
    """One teaching: what is asked of the teacher, and what is learned, round by round.

    Args:
        teachers: at the training values, and at values between them.
        truth: [N + 1, R, r] training latents, of the first teacher's values; None where the teacher's step is
            not theirs.
        yardstick: decides which round is kept.
        teaching: how.
        seed: of network, states and batches.
        device: where the network descends.
        folder: where finished rounds are kept, for a teaching that is broken off; None for nowhere.
        say: told of each round.
        warn: called with a line for each file of a round that was damaged, which is done again.

    Attributes:
        errors: of each round by the yardstick; best: the round that is kept.
        seconds: of all rounds [s].
    """

    def __init__(
        self,
        teachers: Sequence[Teacher],
        truth: Tensor | None,
        yardstick: Yardstick,
        teaching: Teaching,
        seed: int,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
        say: Callable[[str], object] = lambda line: None,
        warn: Callable[[str], object] = print,
    ):
        self.teachers, self.yardstick, self.teaching, self.seed = teachers, yardstick, teaching, seed
        self._truth, self._device, self._folder, self._say, self._warn = truth, device, folder, say, warn
        self.seconds, self.best = 0.0, 0
        self.errors: list[float] = []

    @property
    def steps(self) -> int:
        """Steps of the teacher so far."""
        return sum(teacher.steps for teacher in (*self.teachers, self.yardstick.teacher))

    def broken_affinity(self) -> float | None:
        """How far the teacher's step is from affine in the last change d, along its runs at training values.

        Half the second difference of d', for changes of d by a tenth of its deviation either way, in
        deviations of d' − d; RMS. It is 0 where no contact opens or slips within such a change, and None of a
        teacher that cannot be asked.
        """
        if not self.teachers[0].asked:
            return None
        generator, teacher, own = torch.Generator().manual_seed(self.seed), self.teachers[0], self._runs[0]
        asked = self._moments(0, min(_ASKED, teacher.total_steps - 1))
        xhat, before = own[asked], own[asked - 1]
        other = torch.randn(xhat.shape, generator=generator, dtype=torch.float64)
        other = _OTHER_CHANGE * self.model.d_scale * other
        less, same, more = (
            self._asked(teacher, asked, xhat, before - way * other).acceleration for way in (-1.0, 0.0, 1.0)
        )
        return float(((less + more - 2.0 * same) / (2.0 * self.model.a_scale)).square().mean().sqrt())

    def follow(self) -> StepOperators:
        """All rounds; gives the operators of the best.

        Raises:
            InstabilityError: no round gave a run that stays finite.
        """
        best, least = None, math.inf
        rounds = self.teaching.rounds if self.teachers[0].asked else 0
        for number in range(rounds + 1):
            started = time.perf_counter()
            kept = self._kept(number)
            if kept is None:
                self._learn(number)
                kept = self._keep(number, time.perf_counter() - started)
            else:
                with archives.taken_up(self._folder, "teach"):
                    self._take_up(kept)
            if kept["error"] < least:
                best, least, self.best = kept["model"], kept["error"], number
            self._say(f"round {number}: {100 * kept['error']:.3g} % off")
        if best is None:
            raise InstabilityError(
                "no round of teaching gave operators whose runs stay finite; raise model.teaching.steps or "
                "model.teaching.descent, or deploy with model=projected"
            )
        self.model.load_state_dict(best)
        return self.model.double().requires_grad_(False).eval()

    # -- rounds -----------------------------------------------------------------------------------------

    def _learn(self, number: int) -> None:
        generator = torch.Generator().manual_seed(1000 * self.seed + number)
        if number == 0:
            self._begin(generator)
        else:
            self.labels = Labels.joined([self.labels, *self._along_own_runs(number)])
        self._descend(number, generator)
        finite = all(bool(torch.isfinite(weights).all()) for weights in self.model.parameters())
        runs = self.own_runs(self.yardstick.teacher)
        self.errors.append(self.yardstick.error(runs) if finite else math.inf)

    def _begin(self, generator: torch.Generator) -> None:
        """Runs of the teacher, states of the truth and of the tube, and the scales of the operators."""
        self._runs = [teacher.run() for teacher in self.teachers]
        first, runs = self.teachers[0], self._runs[0]
        changes = torch.diff(runs, dim=0)
        truth = runs if self._truth is None else self._truth
        self.model = self._model(truth, changes)
        parts = [self._of_runs(teacher, own) for teacher, own in zip(self.teachers, self._runs, strict=True)]
        if self._truth is not None:
            asked = self._moments(0, self._share)
            parts.append(self._asked(first, asked, self._truth[asked], self._truth[asked - 1]))
        for teacher, own in zip(self.teachers, self._runs, strict=True):
            if not teacher.asked:
                continue
            asked = self._moments(1, self._share)
            xhat, change = own[asked], own[asked] - own[asked - 1]

            def noise(like: Tensor) -> Tensor:
                return torch.randn(like.shape, generator=generator, dtype=torch.float64)

            change = change * (1.0 + _OTHER_CHANGE * noise(change[..., :1]))
            change = change + _OTHER_CHANGE * self.model.d_scale * noise(change)
            xhat = xhat + self.teaching.tube * self.model.x_scale * noise(xhat)
            gravity = teacher.gravity[asked] + self.reach * _ball(xhat.shape[:-1], generator)
            parts.append(self._asked(teacher, asked, xhat, xhat - change, gravity))
        self.labels = Labels.joined(parts)

    def _along_own_runs(self, number: int) -> list[Labels]:
        parts = []
        for teacher in self.teachers:
            own = self.own_runs(teacher)
            asked = self._moments(number, self._share)
            parts.append(self._asked(teacher, asked, own[asked], own[asked - 1]))
        return parts

    @property
    def _share(self) -> int:
        """Moments of each sweep, so that all steps of the teacher come to about as many as are asked for."""
        N, runs = self.teachers[0].total_steps, sum(map(len, self.teachers))
        sweeps = runs * (1 + self.teaching.rounds) + (0 if self._truth is None else len(self.teachers[0]))
        left = self.teaching.steps - N * (runs + len(self.yardstick.teacher))
        return min(N - 1, max(_LEAST_ASKED, left // sweeps))

    def _moments(self, offset: int, count: int) -> Tensor:
        """Steps n ≥ 1 that a sweep asks for, ascending and evenly spread; another offset gives others."""
        N = self.teachers[0].total_steps
        kinds = self.teaching.rounds + 1
        return 1 + (torch.arange(count) * (N - 1) + (offset % kinds * (N - 1)) // kinds) // count

    def _of_runs(self, teacher: Teacher, runs: Tensor) -> Labels:
        """Labels that runs of the teacher itself are; runs [N + 1, R, r]."""
        first = teacher.first_change()[None]
        changes = torch.cat([first, torch.diff(runs, dim=0)])
        moments, accelerations = torch.arange(len(runs) - 1), torch.diff(changes, dim=0)
        lag = self.model.lags_along(changes[1:-1])
        return self._labelled(teacher, moments, runs[:-1], changes[:-1], accelerations, lag=lag)

    def _asked(
        self, teacher: Teacher, moments: Tensor, xhat: Tensor, before: Tensor, gravity: Tensor | None = None
    ) -> Labels:
        """What the teacher answers at moments [m] from states [m, R, r]."""
        change = xhat - before
        answers = torch.stack(
            [
                teacher.step_from(int(n), xhat[i], change[i], None if gravity is None else gravity[i])
                for i, n in enumerate(moments)
            ]
        )
        return self._labelled(teacher, moments, xhat, change, answers - xhat - change, gravity)

    @staticmethod
    def _labelled(
        teacher: Teacher, moments, xhat: Tensor, change: Tensor, acceleration: Tensor, gravity=None, lag=None
    ) -> Labels:
        like = xhat.shape[:-1]
        gravity = teacher.gravity[moments] if gravity is None else gravity
        lag = xhat[..., :0] if lag is None else lag
        given = teacher.parameters, gravity, teacher.features[moments], lag
        rows = [xhat, change, acceleration, *(values.expand(*like, -1) for values in given)]
        return Labels(*(values.flatten(0, 1).clone() for values in rows))

    # -- the network ------------------------------------------------------------------------------------

    @property
    def reach(self) -> float:
        """How far gravity is varied [m/s²]; 0 where there is none, or no step of varied gravity is asked."""
        if not self.teachers[0].asked:
            return 0.0
        largest = max(float(teacher.gravity.norm(dim=-1).max()) for teacher in self.teachers)
        return self.teaching.gravity * largest

    @property
    def gravity(self) -> tuple[list[float], float]:
        """The middle [3] of all gravity that was taught, and how far from it any was [m/s²]."""
        known = torch.cat([teacher.gravity.flatten(0, 1) for teacher in self.teachers])
        middle = self.teachers[0].gravity.flatten(0, 1).mean(0)
        return middle.tolist(), float((known - middle).norm(dim=1).max()) + self.reach

    def _model(self, truth: Tensor, changes: Tensor) -> StepOperators:
        weightless = self.reach == 0.0 and not any(bool(t.gravity.any()) for t in self.teachers)
        accelerations, width = torch.diff(changes, dim=0), self.teaching.width
        how = {"width": width, "gravity": not weightless, "seed": self.seed, "memory": self.teaching.memory}
        return standardised(self.teachers[0], truth, changes, accelerations, **how)

    def own_runs(self, teacher: Teacher) -> Tensor:
        """[N + 1, R, r] runs of the operators at the teacher's values; what strays far is held."""
        model, limit = self.model, _FAR
        c = model.collider_state(teacher.features)
        x, d = teacher.start, teacher.first_change()
        lag, found = x.new_zeros(len(x), model.sizes.lags), [x]
        with torch.no_grad():
            for state, g in zip(c, teacher.gravity, strict=True):
                there, change = model.step(x, d, teacher.parameters, g, state, lag)
                near = (((there - model.x_mean) / model.x_scale).abs() < limit).all(-1, keepdim=True)
                d = torch.where(near, change, 0.0)
                x, lag = torch.where(near, there, x), model.next_lag(lag, d)
                found.append(x)
        return torch.stack(found)

    def _descend(self, number: int, generator: torch.Generator) -> None:
        rate = self.teaching.rate / (1 if number == 0 else 2)
        moves = self.yardstick.moves(self.model.x_mean, self.model.x_scale)
        model = self.model.to(self._device, torch.float32)
        Descent(model, self.labels, self.teachers, self._runs, moves, self.teaching, rate, generator).run()
        self.model = model.to("cpu", torch.float64)

    # -- rounds on disk ---------------------------------------------------------------------------------

    def _keep(self, number: int, seconds: float) -> dict:
        """Write what a round leaves; all that the next one needs."""
        self.seconds += seconds
        kept = {
            "model": {name: value.clone() for name, value in self.model.state_dict().items()},
            "sizes": vars(self.model.sizes), "labels": vars(self.labels), "runs": self._runs,
            "error": self.errors[-1], "seconds": self.seconds,
            "steps": [teacher.steps for teacher in (*self.teachers, self.yardstick.teacher)],
        }  # fmt: skip
        if self._folder is not None:
            archives.keep(self._file(number), kept)
        return kept

    def _file(self, number: int) -> Path:
        return self._folder / f"round_{number}.pt"

    def _kept(self, number: int) -> dict | None:
        """What a round left that was finished before."""
        return None if self._folder is None else archives.kept(self._file(number), self._warn)

    def _take_up(self, kept: dict) -> None:
        """Go on from the end of a round."""
        self.model = StepOperators(Sizes(**kept["sizes"]), self.teachers[0].dt).double()
        self.model.load_state_dict(kept["model"])
        self.labels, self._runs = Labels(**kept["labels"]), kept["runs"]
        self.errors.append(kept["error"])
        self.seconds = kept["seconds"]
        for teacher, steps in zip((*self.teachers, self.yardstick.teacher), kept["steps"], strict=True):
            teacher.steps = steps


def standardised(
    teacher: Teacher,
    truth: Tensor,
    changes: Tensor,
    accelerations: Tensor,
    width: int,
    gravity: bool,
    seed: int,
    memory: Sequence[float] = (),
) -> StepOperators:
    """A network that gives nothing yet, with the scales of what it will be given and give.

    Args:
        teacher: in training cases.
        truth, changes, accelerations: [N, R, r] latents, their changes, and what is to be learned.
        width: of hidden layers; gravity: whether there is any; seed: of the weights.
        memory: times of lags [s].
    """
    c_mean, c_matrix = principal(list(teacher.features.transpose(0, 1).numpy()), teacher.programs)
    sizes = Sizes(
        latents=truth.shape[-1], parameters=teacher.parameters.shape[1], features=len(c_mean),
        states=c_matrix.shape[1], gravity=gravity, width=width, memory=len(memory),
    )  # fmt: skip
    state = torch.random.get_rng_state()
    torch.manual_seed(seed)
    model = StepOperators(sizes, teacher.dt).double()
    torch.random.set_rng_state(state)

    def deviation(values: Tensor) -> Tensor:
        found = values.flatten(0, -2).std(0)
        return found.clamp_min(1e-9 * float(found.max().clamp_min(1e-30)))

    scales = {
        "x_mean": truth.flatten(0, -2).mean(0), "x_scale": deviation(truth),
        "mu_mean": teacher.parameters.mean(0), "mu_scale": _spread(teacher.parameters),
        "c_mean": torch.as_tensor(c_mean), "c_matrix": torch.as_tensor(c_matrix),
        "d_scale": deviation(changes), "a_scale": deviation(accelerations),
        "g_mean": teacher.gravity.flatten(0, 1).mean(0),
        "g_scale": teacher.gravity.norm(dim=-1).max().clamp_min(1e-30),
    }  # fmt: skip
    for name, value in scales.items():
        getattr(model, name).copy_(value)
    if memory:
        model.lag_decay.copy_(torch.exp(-teacher.dt / torch.tensor(memory, dtype=torch.float64)))
        model.lag_scale.copy_(deviation(model.lags_along(torch.diff(truth, dim=0))))
    return model


def _ball(shape: torch.Size, generator: torch.Generator) -> Tensor:
    """[*shape, 3] points drawn evenly from the unit ball."""
    way = torch.randn((*shape, 3), generator=generator, dtype=torch.float64)
    radius = torch.rand((*shape, 1), generator=generator, dtype=torch.float64) ** (1 / 3)
    return radius * way / way.norm(dim=-1, keepdim=True)


def _spread(values: Tensor) -> Tensor:
    """Deviation [n] of rows, 1 where there is none."""
    found = values.std(0, correction=0)
    return torch.where(found > 0, found, 1.0)
