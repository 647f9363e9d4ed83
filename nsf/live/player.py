"""The player: it chooses one case and one step, which all browsers show."""

import logging
import threading
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nsf.data import Case
from nsf.deployment import Verdict
from nsf.errors import first_line
from nsf.live.model import LiveModel, LiveRun

log = logging.getLogger(__name__)

#: Steps between checks for a newly wanted case: short beside the time of a picture.
_CHUNK = 4
#: Number of finished runs that are kept.
_KEPT = 64
#: Frames in which a run is played, and frames for which its end stands still.
_FRAMES, _HOLD = 150, 30
#: Frames that a run is ahead of the shown step when it is first shown. They play while the next run is made.
_LEAD = 20


@dataclass(frozen=True)
class Moment:
    """A run and one of its steps, to be shown.

    Attributes:
        run: the run of the shown case.
        step: of the run.
    """

    run: LiveRun
    step: int

    @property
    def t(self) -> float:
        """Time [s]."""
        return self.step * self.run.dt

    @property
    def xhat(self) -> np.ndarray:
        """[r] float32 latent vector."""
        return self.run.xhat(self.step)

    @cached_property
    def verdict(self) -> Verdict:
        """The bound of the error up to the step."""
        return self.run.verdict(self.step)


class Player:
    """Runs a live model ahead of the shown step, and starts a new run when a parameter moves.

    A new run is shown once it has reached the shown step (during playback a little more). Until then no newer
    case takes its place. So the picture follows a dragged slider as fast as runs can be made. Any thread may
    call the methods, except `work`, which belongs to the thread that `with player:` starts.

    Args:
        model: the live model.

    Attributes:
        playing: whether each tick goes on by a frame.
        stride: steps a frame.
    """

    def __init__(self, model: LiveModel):
        self.model = model
        self._runs: OrderedDict[Case, LiveRun] = OrderedDict()
        self._wanted = model.initial
        self._shown = self._run_at(self._wanted)
        self._coming: LiveRun | None = None
        self._tilts: list[Sequence[float] | None] = []  # asked for, of which the last counts
        self._step = self._held = 0
        self.playing = True
        self.stride = -(-self._shown.steps // _FRAMES)
        self._wake, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._keep_working, name="reduced model", daemon=True)

    def __enter__(self) -> "Player":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join()

    @property
    def steps(self) -> int:
        """Number of steps of a whole run."""
        return self._shown.steps

    @property
    def case(self) -> Case:
        """The case that was asked for last; the shown one follows it."""
        return self._wanted

    def steer(self, numbers: Sequence[float]) -> None:
        """Ask for other values of the parameters, in their order, under the scene's own gravity.

        Raises:
            ConfigError: a value is missing, not finite, or out of reach.
        """
        with self._wake:
            self._wanted = self.model.checked(numbers)
            if self._tilts or any(run is not None and run.by_hand for run in (self._shown, self._coming)):
                self._tilts.append(None)
            self._wake.notify()

    def tilt(self, tilt: Sequence[float] | None) -> None:
        """Tilt gravity from the shown step on.

        Args:
            tilt: [2] [rad], as for `LiveModel.tilted`; None gives gravity back to the scene.
        """
        with self._wake:
            self._tilts.append(tilt)
            self._wake.notify()

    def begin_again(self) -> None:
        """Show the first case from its beginning, whatever was asked for."""
        with self._wake:
            self._wanted, self._coming = self.model.initial, None
            self._tilts.clear()
            self._shown, self._step, self._held = self._run_at(self._wanted), 0, 0
            self._wake.notify()

    def seek(self, step: int) -> None:
        """Show a step, or the run's last one until the run has come so far."""
        with self._wake:
            self._step, self._held = min(max(int(step), 0), self.steps), 0

    def tick(self) -> Moment:
        """Go on by a frame, if playing, and return the run and the step to show."""
        with self._wake:
            run = self._shown
            if self.playing:
                self._play(run)
            return Moment(run, min(self._step, run.reached))

    def _play(self, run: LiveRun) -> None:
        end = run.reached if run.finished else self.steps
        if self._step < end:
            self._step = min(self._step + self.stride, max(run.reached, self._step), end)
        elif self._held < _HOLD:
            self._held += 1
        else:
            self._step = self._held = 0

    def work(self) -> bool:
        """Advance a run by some steps; False if there is nothing to do."""
        if self._coming is None and self._wanted != self._shown.case:
            self._tilts.clear()  # they were meant for the run that is left
            self._coming = self._run_at(self._wanted)
        elif self._coming is None and self._tilts:
            self._coming = self._tilted()
        run = self._coming or self._shown
        idle = run.finished and self._coming is None
        run.advance(_CHUNK)
        if run.finished:
            self._keep(run)
        with self._wake:
            lead = _LEAD * self.stride if self.playing else 0
            if self._coming is not None and (run.finished or run.reached >= self._step + lead):
                self._shown, self._coming = run, None
        return not idle

    def _tilted(self) -> LiveRun:
        with self._wake:
            tilt, step = self._tilts[-1], min(self._step, self._shown.reached)
            self._tilts.clear()
        if tilt is None:
            return self._run_at(self._shown.case)
        return self.model.tilted(self._shown, step, tilt)

    def _run_at(self, case: Case) -> LiveRun:
        return self._runs.get(case) or self.model.start(case)

    def _keep(self, run: LiveRun) -> None:
        if run.by_hand:
            return
        self._runs[run.case] = run
        self._runs.move_to_end(run.case)
        if len(self._runs) > _KEPT:
            self._runs.popitem(last=False)

    def _keep_working(self) -> None:
        while not self._closing:
            wanted = self._wanted
            try:
                busy = self.work()
            except Exception as error:
                # The scene refuses this case, or a step of it fails: the shown run goes on.
                log.warning("%s: %s", wanted.named, first_line(error))
                with self._wake:
                    if self._coming is None and wanted == self._shown.case and not self._tilts:
                        self._shown.end()
                    if self._wanted == wanted:  # nobody has asked for another meanwhile
                        self._wanted = self._shown.case
                    self._coming, busy = None, True
            if not busy:
                with self._wake:
                    self._wake.wait_for(
                        lambda: self._closing or self._tilts or self._wanted != self._shown.case
                    )
