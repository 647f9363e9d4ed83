"""The server of `nsf serve` and `nsf view`: one reduced run, which many browsers show and steer."""

import asyncio
import http
import json
import logging

from websockets.asyncio.server import Server, ServerConnection, broadcast, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from nsf.errors import ConfigError, first_line
from nsf.live import page
from nsf.live.feeds import LatentFeed, obey
from nsf.live.guard import Connection, check_token, name_of, refused
from nsf.live.player import Moment, Player

log = logging.getLogger(__name__)

#: Longest message of a client [bytes]; each parameter takes twenty.
_LONGEST = 1024
_LONGEST_REASON = 60  # letters of a close, which may take 123 bytes
#: Pause after a client's message [s]: who sends more often waits, and nobody else does.
_PACE = 0.01
#: The page loads nothing from elsewhere, and its address, which may hold the token, is told to no one.
_HEADERS = {
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Content-Security-Policy": f"{page.policy(connects=True)}; frame-ancestors 'none'",
}


class Stream:
    """Serves a page, its data, and each frame.

    `/` is the page, `/field` its data, `/stream` a WebSocket: a binary message a frame, and a text message
    where another case is shown, or it is paused. A client may send what the feed obeys. One that sends
    anything else, or for what cannot be drawn, or that does not keep up for `patience`, is closed.

    Args:
        player: what is shown; all clients see the same.
        feed: makes the messages.
        host: where it is served.
        token: who does not give it as `?token=…` is refused; None asks for none, which only loopback may.
        rate: frames a second.
        patience: seconds that a client may lag.

    Raises:
        ConfigError: the token is short or missing.
    """

    def __init__(
        self, player: Player, feed: LatentFeed, host: str, token: str | None = None, rate: float = 30.0,
        patience: float = 5.0,
    ):  # fmt: skip
        check_token(host, token)
        self._player, self._host, self._token = player, host, token
        self._rate, self._patience = rate, patience
        self._feed = feed
        self._page = page.html(feed.title, connects=True).encode()
        self._clients: set[ServerConnection] = set()
        self._asked: ServerConnection | None = None  # who asked last for something
        moment = player.tick()
        self._state, self._frame = self._messages(moment)

    @property
    def clients(self) -> int:
        """How many are connected."""
        return len(self._clients)

    async def listen(self, port: int) -> Server:
        """Begin to accept clients; use the server as an async context.

        Raises:
            ConfigError: the address cannot be taken.
        """
        try:
            return await serve(
                self._attend,
                self._host,
                port,
                process_request=self._answer,
                create_connection=Connection,
                max_size=_LONGEST,
                compression=None,  # floating-point numbers do not get smaller
                ping_interval=self._patience / 2,
                ping_timeout=self._patience / 2,
                close_timeout=self._patience / 2,
                logger=_quiet(),
            )
        except OSError as error:
            raise ConfigError(
                f"cannot serve at {self._host}:{port} ({error}); give another --port or --host"
            ) from error

    async def play(self) -> None:
        """Send frames until cancelled."""
        clock = asyncio.get_running_loop()
        due = clock.time()
        while True:
            try:
                # Decoding takes milliseconds, in which clients are heard.
                self._send(*await asyncio.to_thread(self._messages, self._player.tick()))
            except Exception as error:  # of whatever a client asked for: the others see the run go on
                await self._refuse(f"cannot be drawn: {type(error).__name__}: {first_line(error)}")
            due = max(due + 1.0 / self._rate, clock.time())
            await asyncio.sleep(due - clock.time())

    async def _refuse(self, why: str) -> None:
        """Begin again, without the client that asked last for something."""
        log.error("what is shown %s; it begins again", why)
        self._player.begin_again()
        self._feed.begin_again()
        if (client := self._asked) is not None:
            self._asked = None
            await client.close(1011, why[:_LONGEST_REASON])

    def _messages(self, moment: Moment) -> tuple[str, bytes]:
        return json.dumps(self._feed.state(moment, self._player)), self._feed.frame(moment)

    def _send(self, state: str, frame: bytes) -> None:
        # Written without waiting: a client that does not read holds nobody up, and its pongs fail to come.
        if state != self._state:
            broadcast(self._clients, state)
        if (state, frame) != (self._state, self._frame):  # a run that stands still costs no bytes
            broadcast(self._clients, frame)
        self._state, self._frame = state, frame

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse, serve a file, or let a WebSocket be opened."""
        if answer := refused(connection, request, self._host, self._token):
            return answer
        path = request.path.partition("?")[0]
        if path == "/stream":
            return None
        if path == "/":
            return _file(self._page, "text/html; charset=utf-8")
        if path == "/field":
            return _file(self._feed.field, "application/octet-stream")
        return connection.respond(http.HTTPStatus.NOT_FOUND, "there are /, /field and /stream\n")

    async def _attend(self, connection: ServerConnection) -> None:
        """Follow one client until it goes."""
        name = name_of(connection)
        broadcast([connection], self._state)
        broadcast([connection], self._frame)
        self._clients.add(connection)
        log.info("%s joined, %d now", name, self.clients)
        why = "closed by itself"
        try:
            async for message in connection:
                self._asked = connection
                obey(self._feed, self._player, message)
                await asyncio.sleep(_PACE)
        except ConfigError as error:
            why = f"sent rubbish: {error}"
            await connection.close(1008, str(error)[:_LONGEST_REASON])
        except ConnectionClosed as error:
            why = _reason(error)
        finally:
            self._clients.discard(connection)
            log.info("%s left, %d now: %s", name, self.clients, why)


def _file(body: bytes, kind: str) -> Response:
    headers = Headers({"Content-Type": kind, "Content-Length": str(len(body)), **_HEADERS})
    return Response(http.HTTPStatus.OK, "OK", headers, body)


def _reason(error: ConnectionClosed) -> str:
    """Why a connection ended that its client did not close."""
    if error.sent is None:
        return "dropped"
    if error.sent.code == 1011:
        return "too slow"  # what the library says when a ping was not answered in time
    return f"closed with {error.sent.code}, {error.sent.reason}"


def _quiet() -> logging.Logger:
    """Where websockets tells of failed handshakes, with a traceback: what matters of them is logged above."""
    logger = logging.getLogger("nsf.live.websockets")
    logger.setLevel(logging.CRITICAL)
    return logger
