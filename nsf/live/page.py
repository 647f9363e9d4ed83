"""The page of `nsf view`: the reduced run beside the full-order one, and a slider for each parameter."""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial

import matplotlib
import numpy as np
import viser
import websockets.asyncio.server as websockets
from matplotlib.colors import to_hex

from nsf.bodies.colors import ROLES, ColorScale
from nsf.live.coloring import DISTANCE, SAMPLE, Coloring, Picture
from nsf.live.guard import Connection, refused
from nsf.live.player import Moment, Player, every
from nsf.reporting.text.columns import axis

log = logging.getLogger(__name__)

FRAMES_PER_SECOND = 30
#: Gap between the two bodies, over the width of the box that the motion fills.
_GAP = 0.25
#: Reach of the tilt, over the largest that was trained.
_BEYOND = 1.5
_OTHER = "…"  # of the cases with a full-order run
_GREY = (187, 187, 187)
_GREEN, _AMBER, _RED = "#2B8A3E", "#E69F00", "#C92A2A"


class _Server(viser.ViserServer):
    """viser's server, without the tunnel to the internet that any of its clients could ask for."""

    def request_share_url(self, verbose: bool = True) -> None:
        """No address."""


@contextmanager
def _own_pages_only(host: str) -> Iterator[None]:
    """A server that viser starts in the block refuses pages of other sites, which viser itself lets in."""
    serve = websockets.serve

    def guarded(handler, at, port, *, process_request, **options):
        def answer(connection, request):
            return refused(connection, request, host, None) or process_request(connection, request)

        return serve(handler, at, port, process_request=answer, create_connection=Connection, **options)

    websockets.serve = guarded
    try:
        yield
    finally:
        websockets.serve = serve


class Page:
    """A viser server that shows a player.

    Every browser sees the same moment and may steer it.

    Args:
        player: chooses the run and the step to show.
        host, port: address of the page; if the port is taken, the page uses another.

    Attributes:
        drawn: pictures drawn since the start.
    """

    def __init__(self, player: Player, host: str = "127.0.0.1", port: int = 8080):
        self._player, self._model = player, player.model
        self._coloring = Coloring(player.model)
        self._truth_case, self._truth = None, None
        self._last: tuple | None = None
        self.drawn = 0
        with _own_pages_only(host):
            # viser's own banner would name viser's address only.
            self._server = _Server(host=host, port=port, verbose=False, label="nsf view")
        self._server.gui.configure_theme(show_share_button=False)
        self._place()
        self._build_controls()

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()

    def run(self, closing: threading.Event) -> None:
        """Draw until `closing` is set."""
        every(1.0 / FRAMES_PER_SECOND, closing, self.draw)

    # -- scene ----------------------------------------------------------------------------------------------

    def _place(self) -> None:
        """Place both bodies and the camera by the motion in the training data."""
        x, _ = self._model.training_frames()
        low, high = x.min((0, 1)), x.max((0, 1))
        self._centre = 0.5 * (low + high)
        extent = high - low
        self._beside = np.array([(1.0 + _GAP) * extent[0], 0.0, 0.0])
        X = self._model.X
        size = 1.1 * self._model.spacing
        # Particles between the camera and the middle hide the inside, where the stress is.
        self._behind = X[:, 1] >= X[:, 1].mean()
        self._thick = bool(extent[:2].min() > 0.5 * extent[:2].max())
        scene = self._server.scene
        scene.set_up_direction("+z")
        ground = np.array([*(0.5 * self._beside[:2]), low[2] - self._centre[2]])
        width, depth = 2.0 * (1.0 + _GAP) * extent[0] + extent[1], 2.0 * extent[1]
        cell = 10.0 ** np.floor(np.log10(extent.max()))
        scene.add_grid(
            "/floor",
            width,
            depth,
            position=ground,
            cell_size=cell / 10,
            section_size=cell / 2,
            cell_color=(235, 235, 235),
            section_color=(205, 205, 205),
            shadow_opacity=0.0,
        )
        add = partial(
            scene.add_point_cloud,
            points=self._model.X - self._centre,
            point_shape="circle",
            precision="float16",
        )
        self._reduced = add("/reduced", colors=_GREY, point_size=size)
        self._full = add("/full", colors=_GREY, point_size=size, position=self._beside)
        self._sample = add("/sample", colors=SAMPLE, point_size=1.6 * size, visible=False)
        above = high[2] - self._centre[2] + 0.12 * extent.max()
        scene.add_label("/reduced name", "reduced", position=(0.0, 0.0, above))
        self._full_name = scene.add_label(
            "/full name", "full-order", position=self._beside + np.array([0.0, 0.0, above])
        )
        across = (2.0 + _GAP) * extent[0]
        camera = self._server.initial_camera
        # The camera looks to the right of the middle, because the controls stand there.
        middle = 0.65 * self._beside
        camera.position = middle + across * np.array([0.1, -0.7, 0.3])
        camera.look_at = middle
        camera.up = (0.0, 0.0, 1.0)

    # -- controls -------------------------------------------------------------------------------------------

    def _build_controls(self) -> None:
        gui, player = self._server.gui, self._player
        gui.add_markdown(f"**{self._model.title}**, `{self._model.run.id}`")
        self._sliders = [
            gui.add_slider(
                axis(parameter.name.replace("_", " "), parameter.unit),
                min=parameter.lower,
                max=parameter.upper,
                step=parameter.step,
                initial_value=player.case[parameter.name],
                marks=tuple((value, f"{value:g}") for value in parameter.trained),
                hint="marks: smallest and largest training value",
            )
            for parameter in self._model.parameters
        ]
        for slider in self._sliders:
            slider.on_update(self._by_hand(self._steer))
        self._tilts = []
        if self._model.tilt is not None:
            most = round(_BEYOND * float(np.degrees(self._model.tilt)), 1)
            hint = f"of gravity, from the shown moment on; trained up to {np.degrees(self._model.tilt):.3g}°"
            self._tilts = [
                gui.add_slider(
                    f"tilt along {way} [°]", min=-most, max=most, step=0.1, initial_value=0.0, hint=hint
                )
                for way in "xy"
            ]
            for slider in self._tilts:
                slider.on_update(self._by_hand(self._tilt))
        self._known = None
        if self._model.known:
            self._known = gui.add_dropdown(
                "with full-order run", [_OTHER, *map(str, self._model.known)], initial_value=_OTHER
            )
            self._known.on_update(self._by_hand(self._go_to))
        self._light = gui.add_html("")
        self._play = gui.add_button("pause")
        self._play.on_click(lambda _: self._toggle())
        self._time = gui.add_slider("step", min=0, max=player.steps, step=1, initial_value=0)
        self._time.on_update(self._by_hand(self._scrub))
        self._by = gui.add_dropdown("colour", list(self._coloring.scales))
        self._legend = gui.add_html("")
        self._cut = gui.add_checkbox("cut open", initial_value=self._thick)
        self._show_sample = gui.add_checkbox("sample particles", initial_value=False)
        self._told = gui.add_html("")

    @staticmethod
    def _by_hand(act: Callable[[], None]) -> Callable[[viser.GuiEvent], None]:
        """Call `act` when a user moves a control, and not when the page itself does."""

        def on_update(event: viser.GuiEvent) -> None:
            if event.client is not None:
                act()

        return on_update

    def _go_to(self) -> None:
        for case in self._model.known:
            if str(case) == self._known.value:
                for slider, value in zip(self._sliders, case.parameters.values(), strict=True):
                    slider.value = value
                self._steer()

    def _steer(self) -> None:
        self._player.steer([slider.value for slider in self._sliders])
        for slider in self._tilts:
            slider.value = 0.0

    def _tilt(self) -> None:
        tilt = np.radians([slider.value for slider in self._tilts])
        self._player.tilt(tilt.tolist() if tilt.any() else None)

    def _toggle(self) -> None:
        self._player.playing = not self._player.playing
        self._play.label = "pause" if self._player.playing else "play"

    def _scrub(self) -> None:
        if self._player.playing:
            self._toggle()
        self._player.seek(self._time.value)

    # -- drawing --------------------------------------------------------------------------------------------

    def draw(self) -> None:
        """Go on by a frame, and show it if it differs from the last one."""
        moment = self._player.tick()
        controls = (self._by.value, self._cut.value, self._show_sample.value)
        asked = (slider.value for slider in self._sliders)
        told = (moment.run, moment.step, moment.run.finished, *controls, *asked)
        if told == self._last:
            return
        self._last = told
        # A hand that tilts gravity makes another problem, of which there is no full-order run.
        case = None if moment.run.by_hand else moment.run.case
        if case != self._truth_case:
            self._truth_case, self._truth = case, case and self._model.truth(case)
        picture = self._coloring.picture(moment, self._truth, self._by.value)
        with self._server.atomic():
            self._show(picture, moment)
        self.drawn += 1

    def _show(self, picture: Picture, moment: Moment) -> None:
        kept = self._behind if self._cut.value else np.full(len(self._behind), True)
        x = picture.x_reduced - self._centre
        self._reduced.points, self._reduced.colors = x[kept], picture.colors_reduced[kept]
        self._full.visible = self._full_name.visible = picture.x_full is not None
        if picture.x_full is not None:
            self._full.points = picture.x_full[kept] - self._centre
            self._full.colors = picture.colors_full[kept]
        self._sample.visible = self._show_sample.value
        if self._show_sample.value:
            self._sample.points = x[kept & (self._model.roles(moment.step) == 2)]
        if self._time.value != moment.step:
            self._time.value = moment.step
        self._name(moment)
        self._light.content = light(moment)
        by = self._by.value
        unknown = by == DISTANCE and self._truth is None
        self._legend.content = _small("grey: unknown") if unknown else legend(self._coloring.scales[by], by)
        self._told.content = self._what_it_took(moment, int(kept.sum()))

    def _name(self, moment: Moment) -> None:
        """Let the controls name the case that is shown, once no other is on its way."""
        case = moment.run.case
        if case != self._player.case:
            return
        for slider, value in zip(self._sliders, case.parameters.values(), strict=True):
            if slider.value != value:  # the case of a full-order run is taken where a slider is near it
                slider.value = value
        named = str(case) if self._truth else _OTHER
        if self._known is not None and self._known.value != named:
            self._known.value = named

    def _what_it_took(self, moment: Moment, drawn: int) -> str:
        run = moment.run
        tilted = ", gravity tilted by hand" if run.by_hand else ""
        shown = f"{run.case.named.replace('_', ' ')}{tilted}, t = {moment.t:.3g} s"
        rate = f"; {run.reached / run.seconds:.0f} latent steps a second" if run.seconds else ""
        known = "" if self._truth else f"<br>no full-order run of this {'program' if run.by_hand else 'case'}"
        return _small(f"{shown}<br>{drawn:,} of {self._model.particles:,} particles{rate}{known}")


def light(moment: Moment) -> str:
    """A light as HTML: green to believe the run, amber away from the training cases, red to distrust it."""
    if moment.run.diverged and moment.step >= moment.run.reached:
        color, text = _RED, f"diverged at t = {moment.t:.3g} s"
    elif moment.trust > 1.0:
        color, text = _RED, f"distrusted: ratio {moment.trust:.2g}, above 1"
    elif moment.run.away > 1.0:
        color, text = _AMBER, f"away from the training cases: ratio {moment.run.away:.3g}, above 1"
    else:
        color, text = _GREEN, f"distrust ratio {moment.trust:.2f}, below 1"
    dot = f"<span style='color:{color};font-size:1.6em;vertical-align:middle'>●</span>"
    return f"<div style='padding:0 0.8em'>{dot} {text}</div>"


def legend(scale: ColorScale | None, name: str) -> str:
    """A colour scale, as HTML."""
    if scale is None:
        names = ("neither", "integration only", "sample")
        dots = (f"<span style='color:{c}'>●</span> {n}" for c, n in zip(ROLES, names, strict=True))
        return _small(" &nbsp; ".join(dots))
    colors = matplotlib.colormaps[scale.mappable.get_cmap().name](np.linspace(0, 1, 9))
    bar = f"height:0.7em;background:linear-gradient(90deg,{','.join(map(to_hex, colors))})"
    low, high = scale.mappable.get_clim()
    ends = f"<span>{low:.3g}</span><span>{name} [{scale.unit}]</span><span>{high:.3g}</span>"
    return _small(
        f"<div style='{bar}'></div><div style='display:flex;justify-content:space-between'>{ends}</div>"
    )


def _small(text: str) -> str:
    return f"<div style='padding:0 0.8em;font-size:0.85em'>{text}</div>"
