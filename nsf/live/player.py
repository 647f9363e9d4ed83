"""What is shown: one parameter value and one moment, for all who look at the same time."""

import logging
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from nsf.errors import NSFError
from nsf.live.model import LiveModel, LiveRun

log = logging.getLogger(__name__)

#: Steps between looks at what is wanted: short beside the time of a picture.
_CHUNK = 4
#: Runs that are kept once they are finished.
_KEPT = 64
#: Frames in which a run is played, and those for which its end stands still.
_FRAMES, _HOLD = 150, 30
#: Frames that a run is ahead of what is shown when it is first shown: they play while the next is made.
_LEAD = 20


@dataclass(frozen=True)
class Moment:
    """What is to be shown.

    Attributes:
        run: at the parameter value that is shown.
        step: of it.
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

    @property
    def trust(self) -> float:
        """Largest distrust ratio up to now."""
        return self.run.trust(self.step)


class Player:
    """Runs a live model ahead of what is shown, and starts it anew where the parameter is moved to.

    A run at another value is shown once it has come as far as the one that is shown, or a little further
    where that goes on, and only then gives way to a newer value: while a slider is dragged, what is shown
    follows it as fast as runs can be made. Any thread may call; `work` belongs to one, which `with player:`
    provides.

    Args:
        model: what is run.

    Attributes:
        playing: whether each tick goes on by a frame.
        stride: steps a frame.
    """

    def __init__(self, model: LiveModel):
        self.model = model
        self._runs: OrderedDict[float, LiveRun] = OrderedDict()
        self._wanted = model.initial
        self._shown = self._run_at(self._wanted)
        self._coming: LiveRun | None = None
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
        """Of a whole run."""
        return self._shown.steps

    @property
    def value(self) -> float:
        """The parameter value that is asked for; that which is shown follows."""
        return self._wanted

    def steer(self, value: float) -> None:
        """Ask for another parameter value.

        Raises:
            ConfigError: it is not finite, or out of reach.
        """
        with self._wake:
            self._wanted = self.model.parameter.checked(value)
            self._wake.notify()

    def seek(self, step: int) -> None:
        """Show a step; or, until the run has come so far, the last one there is."""
        with self._wake:
            self._step, self._held = min(max(int(step), 0), self.steps), 0

    def tick(self) -> Moment:
        """Go on by a frame, if playing, and say what is to be shown."""
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
        """Bring a run on by some steps; False if there is nothing to do."""
        if self._coming is None and self._wanted != self._shown.value:
            self._coming = self._run_at(self._wanted)
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

    def _run_at(self, value: float) -> LiveRun:
        return self._runs.get(value) or self.model.start(value)

    def _keep(self, run: LiveRun) -> None:
        self._runs[run.value] = run
        self._runs.move_to_end(run.value)
        if len(self._runs) > _KEPT:
            self._runs.popitem(last=False)

    def _keep_working(self) -> None:
        while not self._closing:
            try:
                busy = self.work()
            except NSFError as error:
                # A value that the scene refuses is no reason to stop: the last one goes on.
                log.warning("%s=%g: %s", self.model.parameter.name, self._wanted, error)
                self._wanted, busy = self._shown.value, True
            if not busy:
                with self._wake:
                    self._wake.wait_for(lambda: self._closing or self._wanted != self._shown.value)


def every(seconds: float, closing: threading.Event, act: Callable[[], None]) -> None:
    """Call `act` each so many seconds until `closing` is set; what takes longer is not caught up with."""
    due = time.perf_counter()
    while not closing.wait(max(0.0, due - time.perf_counter())):
        act()
        due = max(due + seconds, time.perf_counter())
