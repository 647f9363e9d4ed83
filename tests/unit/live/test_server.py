"""The stream: its numbers, and clients that are slow, drop, send rubbish, or come from elsewhere."""

import asyncio
import json
import logging
import math
import re
import socket
import struct
import threading
import urllib.error
import urllib.request
from contextlib import asynccontextmanager
from types import SimpleNamespace

import browsers
import numpy as np
import pytest
from angles import angle
from test_player import wait_until

pytest.importorskip("websockets", reason="websockets is not installed")

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus

from nsf.deployment import Trust
from nsf.errors import ConfigError
from nsf.live.feeds import LatentFeed, PointFeed, obey
from nsf.live.player import Player
from nsf.live.server import Stream
from nsf.live.wire import field_message


@asynccontextmanager
async def streaming(model, host="127.0.0.1", feed=LatentFeed, **options):
    """A stream under way: (stream, player, port)."""
    with Player(model) as player:
        stream = Stream(player, feed(model), host, **{"rate": 200.0, **options})
        async with await stream.listen(0) as server:
            playing = asyncio.create_task(stream.play())
            yield stream, player, server.sockets[0].getsockname()[1]
            playing.cancel()


def connected(port):
    """A client; one that has stopped reading would wait ten seconds for its close to be answered."""
    return connect(f"ws://127.0.0.1:{port}/stream", close_timeout=0.2)


async def frames(connection, count):
    found = []
    while len(found) < count:
        message = await asyncio.wait_for(connection.recv(), 20)
        if isinstance(message, bytes):
            found.append(np.frombuffer(message, "<f4"))
    return np.array(found)


async def until(true):
    for _ in range(2000):
        if true():
            return
        await asyncio.sleep(0.01)
    raise AssertionError("nothing happened within 20 s")


def test_a_frame_is_time_errors_and_latent(model):
    async def run():
        async with streaming(model) as (_, player, port), connected(port) as client:
            assert json.loads(await client.recv()) == {
                "values": [26.0],
                "light": {
                    "flag": "unknown",
                    "reason": Trust.unknown,
                },
                "playing": True,
            }
            found = await frames(client, 60)
            made = player.tick().run
        assert found.shape == (60, 3 + 4)
        for t, error, bound, *xhat in found:
            step = round(t / made.dt)
            np.testing.assert_array_equal(xhat, made.xhat(step))
            assert np.isnan([error, bound]).all()

    asyncio.run(run())


def test_all_clients_see_what_one_asks_for(model):
    async def run():
        async with streaming(model) as (stream, _, port):
            async with connected(port) as one, connected(port) as other:
                await until(lambda: stream.clients == 2)
                await one.send('{"values": [34]}')
                for client in (one, other):
                    async with asyncio.timeout(20):
                        while isinstance(message := await client.recv(), bytes) or json.loads(message)[
                            "values"
                        ] != [34]:
                            pass
            await until(lambda: stream.clients == 0)

    asyncio.run(run())


RUBBISH = [
    "", "x", "{}", "[]", "34", '{"values": ["34"]}', '{"values": [null]}', '{"values": [true]}',
    '{"values": 34}', '{"values": [NaN]}', '{"values": [Infinity]}', '{"values": [1e999]}',
    '{"values": [47]}',
    '{"values": []}', '{"values": [34, 1]}', '{"values": [34], "more": 1}', '{"value": [34]}',
    '{"playing": 1}', '{"playing": null}', '{"playing": true, "values": [34]}',
    '{"values": [1' + "0" * 320 + "]}", "[" * 250, b"\0\1\2\3",
]  # fmt: skip


#: `nsf view` obeys more, and refuses these.
RUBBISH_OF_VIEW = [
    *RUBBISH, '{"step": 1.5}', '{"step": true}', '{"step": "1"}', '{"tilt": [1]}', '{"tilt": [1, 1]}',
    '{"tilt": [NaN, 0]}', '{"color": "red"}', '{"color": 1}', '{"step": 1, "color": "pressure"}',
]  # fmt: skip


@pytest.mark.parametrize("feed", [LatentFeed, PointFeed])
def test_rubbish_is_refused(feed, player):
    own = feed(player.model)
    for message in RUBBISH if feed is LatentFeed else RUBBISH_OF_VIEW:
        with pytest.raises(ConfigError):
            obey(own, player, message)
    assert player.case == angle(26.0)
    assert player.playing


def test_what_cannot_be_drawn_ends_one_client(model, monkeypatch):
    async def run():
        drawn = PointFeed.frame
        fails = lambda feed: feed.color == "pressure"  # noqa: E731
        monkeypatch.setattr(PointFeed, "frame", lambda feed, m: 1 / 0 if fails(feed) else drawn(feed, m))
        joined = streaming(model, feed=PointFeed)
        async with joined as (stream, player, port), connected(port) as one, connected(port) as other:
            await until(lambda: stream.clients == 2)
            await one.send('{"color": "pressure"}')
            await until(lambda: stream.clients == 1)
            with pytest.raises(ConnectionClosed) as closed:
                await frames(one, 10**6)
            assert closed.value.rcvd.code == 1011
            await other.send('{"values": [34]}')
            await until(lambda: player.tick().run.case == angle(34.0))
            assert stream.clients == 1

    asyncio.run(run())


def test_without_programs_of_gravity_nothing_is_tilted(player):
    with pytest.raises(ConfigError, match="must lie in"):
        obey(PointFeed(player.model), player, '{"tilt": [0, 0]}')


def test_who_serves_takes_no_wishes_of_view(player):
    for message in ('{"step": 3}', '{"tilt": null}', '{"color": "pressure"}'):
        with pytest.raises(ConfigError, match="a client may only send"):
            obey(LatentFeed(player.model), player, message)


@pytest.mark.parametrize(
    ("message", "code", "why"),
    [
        ("rubbish", 1008, "sent rubbish: a client may only send"),
        ('{"values": [1e9]}', 1008, "sent rubbish: friction_angle=1e+09 must lie in [14, 46]"),
        (b"\0", 1008, "sent rubbish"),
        ("x" * 2000, 1009, "closed with 1009"),
    ],
)
def test_a_client_that_sends_rubbish_is_closed_and_no_other(model, message, code, why, caplog):
    async def run():
        joined = streaming(model)
        async with joined as (stream, _, port), connected(port) as good, connected(port) as bad:
            await until(lambda: stream.clients == 2)
            await bad.send(message)
            with pytest.raises(ConnectionClosed) as closed:
                await frames(bad, 10**6)
            assert closed.value.rcvd.code == code
            await until(lambda: stream.clients == 1)
            await frames(good, 20)

    with caplog.at_level(logging.INFO, "nsf"):
        asyncio.run(run())
    assert f"left, 1 now: {why}" in caplog.text


def test_bytes_that_are_no_websocket_disturb_nobody(model):
    async def run():
        async with streaming(model) as (stream, _, port), connected(port) as good:
            for told in (
                b"\x00\xff" * 500,
                b"GET /stream HTTP/1.1\r\n\r\n",
                b"POST / HTTP/1.1\r\n\r\n",
                b"",
            ):
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(told)
                writer.write_eof()
                await asyncio.wait_for(reader.read(), 20)
                writer.close()
            await frames(good, 20)
            assert stream.clients == 1

    asyncio.run(run())


def handshake(port) -> socket.socket:
    """A client by hand, which then does what no library would."""
    raw = socket.create_connection(("127.0.0.1", port))
    raw.sendall(
        b"GET /stream HTTP/1.1\r\nHost: 127.0.0.1:%d\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n" % port
    )
    return raw


def test_a_client_that_does_not_read_is_closed_and_no_other(model, caplog):
    async def run():
        async with streaming(model, patience=0.4) as (stream, _, port), connected(port) as good:
            slow = handshake(port)
            await until(lambda: stream.clients == 2)
            reading = asyncio.create_task(frames(good, 10**6))
            await until(lambda: stream.clients == 1)
            assert not reading.done()
            reading.cancel()
            slow.close()

    with caplog.at_level(logging.INFO, "nsf"):
        asyncio.run(run())
    assert "left, 1 now: too slow" in caplog.text


def test_a_client_that_drops_is_noticed_and_disturbs_nobody(model, caplog):
    async def run():
        async with streaming(model) as (stream, _, port), connected(port) as good:
            gone = handshake(port)
            await until(lambda: stream.clients == 2)
            gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            gone.close()  # reset, not closed
            await until(lambda: stream.clients == 1)
            await frames(good, 20)

    with caplog.at_level(logging.INFO, "nsf"):
        asyncio.run(run())
    assert "left, 1 now: dropped" in caplog.text


def refused(model, path="/stream", headers=None, host="127.0.0.1", **options):
    """The status that a client gets."""

    async def run():
        async with streaming(model, host, **options) as (_, _, port):
            own = {k: v.replace("PORT", str(port)) for k, v in (headers or {}).items()}
            origin = own.pop("Origin", None)
            try:
                async with connect(f"ws://127.0.0.1:{port}{path}", origin=origin, additional_headers=own):
                    return 101
            except InvalidStatus as error:
                return error.response.status_code

    return asyncio.run(run())


@pytest.mark.parametrize(
    ("origin", "status"),
    [
        (None, 101),  # no browser
        ("http://127.0.0.1:PORT", 101),
        ("http://evil.example", 403),
        ("http://127.0.0.1:1", 403),
        ("http://127.0.0.1.evil.example:PORT", 403),
        ("null", 403),
    ],
)
def test_a_page_of_another_site_is_refused(model, origin, status):
    assert refused(model, headers={"Origin": origin} if origin else {}) == status


def answer(port, path="/", **headers):
    request = urllib.request.Request(f"http://127.0.0.1:{port}{path}", headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=20) as response:
            return response.status, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_another_name_for_this_machine_is_refused(model, caplog):
    """A foreign page whose name was made to lead here has the right origin, but not the right host."""

    async def run():
        async with streaming(model) as (_, _, port):
            evil = {"Host": f"evil.example:{port}", "Origin": f"http://evil.example:{port}"}
            assert (await asyncio.to_thread(answer, port, **evil))[0] == 403
            for host in ("localhost", "127.0.0.1", "[::1]"):
                assert (await asyncio.to_thread(answer, port, Host=f"{host}:{port}"))[0] == 200

    asyncio.run(run())
    assert "refused: host 'evil.example" in caplog.text


def test_a_token_is_asked_of_every_request(model):
    token = {"token": "s e/c?ret & more than that"}
    for path, status in (
        ("/stream", 403),
        ("/stream?token=", 403),
        ("/stream?token=s%20e", 403),
        ("/stream?token=%E2%98%83", 403),
        ("/stream?token=s%20e%2Fc%3Fret%20%26%20more%20than%20that", 101),
    ):
        assert refused(model, path, host="0.0.0.0", **token) == status

    async def run():
        async with streaming(model, **token) as (_, _, port):
            for path in ("/", "/field", "/other", "/?token=wrong"):
                assert (await asyncio.to_thread(answer, port, path))[0] == 403
            assert (
                await asyncio.to_thread(answer, port, "/?token=s%20e%2Fc%3Fret%20%26%20more%20than%20that")
            )[0] == 200

    asyncio.run(run())


@pytest.mark.parametrize(
    ("host", "token"), [("0.0.0.0", ""), ("127.0.0.1", " "), ("localhost", "secret"), ("", "15 letters long")]
)
def test_a_token_that_can_be_guessed_is_refused(player, host, token):
    with pytest.raises(ConfigError, match=r"the token (is empty|has \d+ letters); give at least 16"):
        Stream(player, LatentFeed(player.model), host, token)


def test_beyond_this_machine_no_token_is_refused(player):
    for host in ("0.0.0.0", "192.0.2.1", "", "::"):
        with pytest.raises(ConfigError, match="the token is empty"):
            Stream(player, LatentFeed(player.model), host, None)
    assert Stream(player, LatentFeed(player.model), "::1", None)


H = b"Host: 127.0.0.1\r\n"
#: Requests as they come, and the status that answers them.
MALFORMED = {
    "nothing of HTTP": (b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\r\n\r\n", 400),
    "HTTP/1.0": (b"GET / HTTP/1.0\r\n" + H + b"\r\n", 400),
    "another method": (b"POST / HTTP/1.1\r\n" + H + b"\r\n", 400),
    "connect": (b"CONNECT evil.example:443 HTTP/1.1\r\n" + H + b"\r\n", 400),
    "a body": (b"GET / HTTP/1.1\r\n" + H + b"Content-Length: 3\r\n\r\nabc", 400),
    "absolute form": (b"GET http://127.0.0.1/ HTTP/1.1\r\n" + H + b"\r\n", 400),
    "absolute form of another": (b"GET http://evil.example/stream HTTP/1.1\r\n" + H + b"\r\n", 400),
    "two slashes": (b"GET //evil.example/ HTTP/1.1\r\n" + H + b"\r\n", 400),
    "bad percent-encoding": (b"GET /?token=%zz HTTP/1.1\r\n" + H + b"\r\n", 400),
    "a token that is not ASCII": (b"GET /?token=\xff\xfe HTTP/1.1\r\n" + H + b"\r\n", 400),
    "NUL in the path": (b"GET /\x00 HTTP/1.1\r\n" + H + b"\r\n", 400),
    "a long header": (b"GET / HTTP/1.1\r\n" + H + b"X: " + b"a" * 100_000 + b"\r\n\r\n", 400),
    "a header without a colon": (b"GET / HTTP/1.1\r\n" + H + b"nonsense\r\n\r\n", 400),
    "a header with NUL": (b"GET / HTTP/1.1\r\n" + H + b"X: a\x00b\r\n\r\n", 400),
    "a header that goes on": (b"GET / HTTP/1.1\r\n" + H + b"X: a\r\n b\r\n\r\n", 400),
    "no host": (b"GET / HTTP/1.1\r\n\r\n", 400),
    "two hosts": (b"GET / HTTP/1.1\r\n" + H + H + b"\r\n", 400),
    "an empty host": (b"GET / HTTP/1.1\r\nHost:\r\n\r\n", 400),
    "half a host": (b"GET / HTTP/1.1\r\nHost: [::1\r\n\r\n", 400),
    "a host with more": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1:80:80\r\n\r\n", 400),
    "a host with a user": (b"GET / HTTP/1.1\r\nHost: a@127.0.0.1\r\n\r\n", 400),
    "a host with a path": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1/a\r\n\r\n", 400),
    "two hosts in one": (b"GET / HTTP/1.1\r\nHost: 127.0.0.1, evil.example\r\n\r\n", 400),
    "a host that is not ASCII": (b"GET / HTTP/1.1\r\nHost: \xff\r\n\r\n", 400),
    "a host of digits": ("GET / HTTP/1.1\r\nHost: 127.0.0.\u0661\r\n\r\n".encode(), 400),
    "another host": (b"GET / HTTP/1.1\r\nHost: evil.example\r\n\r\n", 403),
    "another address": (b"GET / HTTP/1.1\r\nHost: [::2]:80\r\n\r\n", 403),
    "an origin that is none": (b"GET / HTTP/1.1\r\n" + H + b"Origin: \xff[\r\n\r\n", 403),
    "two origins": (b"GET / HTTP/1.1\r\n" + H + b"Origin: http://127.0.0.1\r\nOrigin: http://a\r\n\r\n", 403),
    "another path": (b"GET /%00%ff HTTP/1.1\r\n" + H + b"\r\n", 404),
    "a climbing path": (b"GET /../../etc/passwd HTTP/1.1\r\n" + H + b"\r\n", 404),
    "no WebSocket": (b"GET /stream HTTP/1.1\r\n" + H + b"\r\n", 426),
    "a WebSocket without a key": (
        b"GET /stream HTTP/1.1\r\n" + H + b"Upgrade: websocket\r\nConnection: Upgrade\r\n\r\n", 400
    ),
    "a WebSocket of yesterday": (
        b"GET /stream HTTP/1.1\r\n" + H + b"Upgrade: websocket\r\nConnection: Upgrade\r\n"
        b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 1\r\n\r\n", 400
    ),
    "half a request": (b"GET / HTTP/1.1\r\nHost: 127", 400),
}  # fmt: skip


def test_malformed_requests_are_answered_and_logged_in_a_line(model, caplog):
    """Each gets its status, none a traceback, and nobody else is disturbed."""
    found, lines = {}, {}

    async def run():
        async with streaming(model) as (_, _, port), connected(port) as good:
            for name, (request, _) in MALFORMED.items():
                before = len(caplog.records)
                reader, writer = await asyncio.open_connection("127.0.0.1", port)
                writer.write(request)
                if name == "half a request":
                    writer.write_eof()
                answer = await asyncio.wait_for(reader.read(), 20)
                writer.close()
                found[name] = int(answer.split()[1]) if answer.startswith(b"HTTP/1.1 ") else answer
                lines[name] = caplog.records[before:]
            await frames(good, 5)

    with caplog.at_level(logging.INFO):
        asyncio.run(run())
    assert found == {name: status for name, (_, status) in MALFORMED.items()}
    for name, records in lines.items():
        for record in records:
            assert record.exc_info is None, name
            assert record.getMessage().isprintable(), name
            assert len(record.getMessage()) < 300, name
        told = [record for record in records if "refused" in record.getMessage()]
        assert len(told) == (name not in ("another path", "a climbing path", "half a request")), name


def test_what_is_served(model):
    async def run():
        async with streaming(model) as (_, _, port):
            assert b"<title>" in (await asyncio.to_thread(answer, port))[1]
            assert (await asyncio.to_thread(answer, port, "/field"))[1] == field_message(model)
            assert (await asyncio.to_thread(answer, port, "/../../etc/passwd"))[0] == 404

    asyncio.run(run())


def test_a_port_that_is_taken_says_so(model):
    async def run():
        async with streaming(model) as (stream, _, port):
            told = f"cannot serve at 127.0.0.1:{port} .*give another --port or --host"
            with pytest.raises(ConfigError, match=told):
                await stream.listen(port)

    asyncio.run(run())


def test_the_field_is_smaller_than_its_numbers_and_a_frame_than_particles(model):
    field = model.at.fields["deformation"]
    assert len(field_message(model)) < field.modes.numel() * 2 + 2 * field.mean.nbytes + 20_000
    frame = LatentFeed(model).frame(Player(model).tick())
    assert len(frame) == 4 * (3 + model.manifold.latent_dim)


def test_a_field_that_is_no_modes_is_refused(model):
    other = SimpleNamespace(run=model.run, manifold=SimpleNamespace(field="mlp"))
    with pytest.raises(ConfigError, match=r"has field=mlp.*serve a deployment of field=basis"):
        field_message(other)


# -- the page -----------------------------------------------------------------------------------------------


def threaded(model, **options):
    """A stream on a thread of its own, since a browser blocks: yields its address, and its player."""
    ready, loop, found = threading.Event(), asyncio.new_event_loop(), {}

    async def run():
        async with streaming(model, **{"rate": 30.0, **options}) as (_, player, port):
            found.update(port=port, player=player, end=asyncio.Event())
            ready.set()
            await found["end"].wait()

    thread = threading.Thread(target=loop.run_until_complete, args=(run(),))
    thread.start()
    assert ready.wait(20)
    yield f"http://127.0.0.1:{found['port']}/", found["player"]
    loop.call_soon_threadsafe(found["end"].set)
    thread.join()
    loop.close()


@pytest.fixture
def address(model):
    yield from threaded(model)


@pytest.fixture
def launched(chromium):
    """A browser of one test, since others of this module call `asyncio.run`."""
    with browsers.launched(chromium) as browser:
        yield browser


def test_a_browser_decodes_what_the_server_does(browser, address, model):
    url, player = address
    size = {"width": 640, "height": 400}
    windows, asked, faults = [browser.new_page(viewport=size) for _ in range(2)], [], []
    for window in windows:
        window.on("request", lambda request: asked.append(request.url))
        window.on("pageerror", lambda error: faults.append(str(error)))
        window.goto(url)
        wait_until(
            lambda window=window: window.evaluate(
                "window.nsf && nsf.player.received.frames > 5 && nsf.state.drawn > 5"
            )
        )
    one, other = windows
    assert all(u.startswith(url) or u.startswith("data:") for u in asked)
    assert not faults
    before = other.screenshot()

    one.get_by_label("friction angle").fill("34")
    wait_until(lambda: player.case == angle(34.0))
    for window in windows:
        window.get_by_text("friction angle = 34.00°").wait_for()
    wait_until(lambda: other.evaluate("nsf.player.state.values[0] === 34 && nsf.player.t > 0.1"))
    assert other.screenshot() != before

    one.get_by_role("button", name="Pause").click()
    other.get_by_role("button", name="Play").wait_for()
    assert not player.playing
    assert re.fullmatch(r"t = 0\.\d{3} s", other.text_content("#time"))

    shown = other.evaluate("({t: nsf.player.t, x: Array.from(nsf.player.x)})")
    run = player.tick().run
    x = np.reshape(shown["x"], (-1, 3))
    expected = run.positions(round(shown["t"] / run.dt))
    moved = np.abs(expected - model.X).max()
    # The film may have begun anew since; early frames move so little that float32's own steps show.
    assert np.abs(x - expected).max() < 1e-4 * moved + 1e-6
    assert math.isfinite(moved)


def test_a_browser_says_when_the_stream_ends(browser, address):
    url, _ = address
    window = browser.new_page()
    window.goto(url)
    wait_until(lambda: window.evaluate("window.nsf && nsf.state.drawn > 2"))
    window.evaluate("nsf.player.socket.send('rubbish')")
    window.get_by_text("closed (1008) a client may only send").wait_for()
