"""Who is answered by a server of this package: tokens, names of this machine, origins, malformed requests."""

import hmac
import logging
import re
from http import HTTPStatus
from urllib.parse import parse_qs

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from nsf.errors import ConfigError
from nsf.live import LOOPBACK

log = logging.getLogger(__name__)

#: Least length of a token: 16 letters drawn at random take longer to guess than any deployment is served.
LEAST_TOKEN = 16
#: A host with or without its port; in group 1 the name, in 2 the address of IPv6.
_HOST = re.compile(r"(?:([\w.-]+)|\[([0-9A-Fa-f:.]+)\])(?::\d{1,5})?", re.ASCII)
_TARGET = re.compile(r"/(?!/)(?:[!-$&-~]|%[0-9A-Fa-f]{2})*")  # a path and a query, in visible ASCII
_ANSWER = b"HTTP/1.1 400 Bad Request\r\nContent-Length: 16\r\nConnection: close\r\n\r\nthis is no HTTP\n"
_LONGEST_TOLD = 120  # letters of a request in the log


def check_token(host: str, token: str | None) -> None:
    """Refuse a token that can be guessed, and none where more than this machine can ask.

    Raises:
        ConfigError: says how to draw one.
    """
    if token is None and host in LOOPBACK:
        return
    if len(token or "") < LEAST_TOKEN:
        fault = "is empty" if not token else f"has {len(token)} letters"
        raise ConfigError(
            f"the token {fault}; give at least {LEAST_TOKEN} random ones, or leave --token out: one is drawn"
        )


def refusal(request: Request, host: str, token: str | None = None) -> tuple[HTTPStatus, str] | None:
    """Why a request is not answered, if it is not.

    Args:
        request: as it was parsed; its path and headers may hold anything.
        host: where it is served.
        token: that the query has to give; None asks for none.
    """
    if (request.method, request.protocol) != ("GET", "HTTP/1.1"):
        return (
            HTTPStatus.BAD_REQUEST,
            f"{_told(request.method)} of {_told(request.protocol)} is not GET of HTTP/1.1",
        )
    if not _TARGET.fullmatch(request.path):
        return HTTPStatus.BAD_REQUEST, f"{_told(request.path)} is no path of this server"
    named, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
    match = _HOST.fullmatch(named[0]) if len(named) == 1 else None
    if match is None:
        return HTTPStatus.BAD_REQUEST, f"host {_told(', '.join(named))} is not one name with its port"
    if host in LOOPBACK and (match[1] or match[2]) not in LOOPBACK:
        # Another name for this machine is how a foreign page would get past the check of its origin.
        return HTTPStatus.FORBIDDEN, f"host {_told(named[0])} is not this machine's own name"
    # Only browsers send an origin, and they always do so for a WebSocket.
    if any(origin not in (f"http://{named[0]}", f"https://{named[0]}") for origin in origins):
        return HTTPStatus.FORBIDDEN, f"origin {_told(', '.join(origins))} is another site"
    offered = parse_qs(request.path.partition("?")[2]).get("token", [""])[-1]
    if token is not None and not hmac.compare_digest(offered.encode(), token.encode()):
        return HTTPStatus.FORBIDDEN, "token is missing or wrong"
    return None


def refused(connection: ServerConnection, request: Request, host: str, token: str | None) -> Response | None:
    """The answer to a request that is refused, which the log tells in a line; None to any other."""
    answer = refusal(request, host, token)
    if answer is None:
        return None
    status, why = answer
    log.warning("%s refused: %s", name_of(connection), why)
    return connection.respond(status, f"{why}\n")


def name_of(connection: ServerConnection) -> str:
    """Address and port of a client."""
    address = connection.remote_address
    return f"{address[0]}:{address[1]}" if address else "a client that is gone"


class Connection(ServerConnection):
    """Answers 400 to what is no request, which websockets would drop without a word, and logs it."""

    _over = False

    def send_data(self) -> None:
        """Send what is due; log why no WebSocket is opened, and answer what is no request."""
        fault = self.protocol.handshake_exc
        if fault is not None and not self._over:
            self._over = True
            if self.request is None:
                self.transport.write(_ANSWER)
            fault = fault.__cause__ or fault
            if not isinstance(fault, EOFError):  # it went away, as connections do that a browser holds ready
                log.warning("%s refused: %s", name_of(self), _told(fault))
        super().send_data()


def _told(text: object) -> str:
    """A message from outside, in one line of a log."""
    return repr(str(text)[:_LONGEST_TOLD])
