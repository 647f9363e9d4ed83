"""Messages of `nsf serve` and `nsf view`, and what their clients may ask for."""

import json
from collections.abc import Sequence

import numpy as np

from nsf.data import Case
from nsf.errors import ConfigError
from nsf.live import page
from nsf.live.coloring import STRESS, Coloring
from nsf.live.model import LiveModel, Truth
from nsf.live.player import Moment, Player
from nsf.live.wire import field_message, shown

#: Reach of a tilt, over the largest that was trained.
BEYOND = 1.5


class LatentFeed:
    """Messages of `nsf serve`: the field once, then x̂ a frame, which each browser decodes.

    Args:
        model: whose field consists of linear modes.

    Raises:
        ConfigError: the field is another.
    """

    title = "nsf serve"

    def __init__(self, model: LiveModel):
        self.field = field_message(model)

    def frame(self, moment: Moment) -> bytes:
        """t [s], the expected error and its bound as shares of the displacement, and x̂: [3 + r] float32."""
        errors = moment.verdict.error_share, moment.verdict.bound_share
        return np.concatenate([[moment.t, *errors], moment.xhat]).astype("<f4").tobytes()

    def state(self, moment: Moment, player: Player) -> dict:
        """The values of the parameters, whether to believe the run and why not, and whether it plays."""
        values, verdict = list(moment.run.case.parameters.values()), moment.verdict
        light = {"flag": verdict.flag, "reason": verdict.reason}
        return {"values": values, "light": light, "playing": player.playing}

    def begin_again(self) -> None:
        """Forget what clients asked for of the picture."""

    def obey(self, player: Player, wish: object) -> str | None:
        """Do what a client asks for, or give back what it may ask for.

        Args:
            player: of the server.
            wish: `{"values": [31.5]}` steers to values in the parameters' order, `{"playing": false}` pauses.

        Raises:
            ConfigError: a value is out of reach.
        """
        match wish:
            case {"playing": bool(playing), **more} if not more:
                player.playing = playing
            case {"values": list(values), **more} if not more and _are_numbers(values):
                player.steer(_floats(values))
            case _:
                return '{"values": [number, …]} or {"playing": true or false}'
        return None


class PointFeed(LatentFeed):
    """Messages of `nsf view`: the particles of the reduced run and of the full-order one a frame, any field.

    Args:
        model: that is shown.

    Attributes:
        color: a key of the coloring's quantities, by which all clients see the particles.
    """

    title = "nsf view"

    def __init__(self, model: LiveModel):
        self._model, self._coloring = model, Coloring(model)
        self._truth: tuple[Case | None, Truth | None] = (None, None)
        self._drawn: tuple[tuple, bytes] = ((), b"")
        self.color = STRESS
        self._most = BEYOND * float(np.degrees(model.tilt or 0.0))  # [°]
        header = shown(model) | {
            "quantities": self._coloring.quantities,
            "color": self.color,
            "steps": model.start(model.initial).steps,
            "tilt": None if model.tilt is None else {"trained": self._most / BEYOND, "most": self._most},
            "known": [
                {"label": str(case).replace("_", " "), "values": list(case.parameters.values())}
                for case in model.simulated
            ],
        }
        self.field = page.packed(header, {"rest": model.X})

    def frame(self, moment: Moment) -> bytes:
        """Positions [n, 3] [m] and shades [n] of both runs, the sets of particles, of the moment t [s], the
        expected error and its bound as shares of the displacement, the step, and latent steps a second; as
        `nsf.live.page.packed` has them.
        """
        run, step = moment.run, moment.step
        key = (run, step, run.finished, self.color)
        if key == self._drawn[0]:
            return self._drawn[1]
        truth = self.truth(moment)
        shade, full = self._coloring.shades(moment, truth, self.color)
        rate = run.reached / run.seconds if run.seconds else 0.0
        errors = moment.verdict.error_share, moment.verdict.bound_share
        arrays = {
            "moment": np.array([moment.t, *errors, step, rate], np.float32),
            "x": run.positions(step), "shade": shade,
            "roles": self._model.roles(step).astype(np.uint8),
        }  # fmt: skip
        if truth is not None:
            arrays |= {"full.x": truth.positions(moment.t), "full.shade": full}
        self._drawn = key, page.packed({}, arrays)
        return self._drawn[1]

    def truth(self, moment: Moment) -> Truth | None:
        """The full-order run of what is shown; none where a hand tilts gravity, which is another problem."""
        case = None if moment.run.by_hand else moment.run.case
        if case != self._truth[0]:
            self._truth = case, case and self._model.truth(case)
        return self._truth[1]

    def state(self, moment: Moment, player: Player) -> dict:
        """As of `nsf serve`, with the colour, whether gravity is tilted, and which known case is shown."""
        run, simulated = moment.run, self._model.simulated
        index = simulated.index(run.case) if run.case in simulated and not run.by_hand else None
        more = {"color": self.color, "tilted": run.by_hand, "known": index}
        return super().state(moment, player) | more

    def begin_again(self) -> None:
        """Show the first colour again."""
        self.color = STRESS

    def obey(self, player: Player, wish: object) -> str | None:
        """As of `nsf serve`, and `{"step": 12}`, `{"tilt": [x, y]}` [°] or null, `{"color": "pressure"}`."""
        match wish:
            case {"step": int(step), **more} if not more and type(step) is int:
                player.playing = False
                player.seek(step)
            case {"tilt": None, **more} if not more:
                player.tilt(None)
            case {"tilt": [x, y], **more} if not more and _are_numbers([x, y]):
                player.tilt(self._within(_floats([x, y])))
            case {"color": str(color), **more} if not more and color in self._coloring.quantities:
                self.color = color
            case _:
                return (reply := super().obey(player, wish)) and (
                    f'{reply}, {{"step": n}}, {{"tilt": [°, °] or null}}, {{"color": name}}'
                )
        return None

    def _within(self, tilt: Sequence[float]) -> list[float]:
        """A tilt [2] [rad] of degrees.

        Raises:
            ConfigError: the model has no programs of gravity, or the tilt is out of reach.
        """
        if not self._most or not all(abs(degrees) <= self._most for degrees in tilt):
            raise ConfigError(f"tilt={list(tilt)} must lie in [-{self._most:.3g}, {self._most:.3g}] °")
        return np.radians(tilt).tolist()


def obey(feed: LatentFeed, player: Player, message: str | bytes) -> None:
    """Do what a client asks for.

    Args:
        feed: says what may be asked for; player: of the server.
        message: JSON.

    Raises:
        ConfigError: the message is anything else, or a value is out of reach.
    """
    try:
        wish = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        wish = None
    if (may := feed.obey(player, wish)) is not None:
        raise ConfigError(f"a client may only send {may}")


def _are_numbers(values: Sequence) -> bool:
    return all(type(value) in (int, float) for value in values)


def _floats(values: Sequence[float]) -> list[float]:
    try:
        return list(map(float, values))
    except OverflowError as error:
        raise ConfigError("the value is too large") from error
