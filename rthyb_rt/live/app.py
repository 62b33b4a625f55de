"""The live view as an ASGI application: the page, its files, and a socket with frames."""

from __future__ import annotations

import asyncio
import contextlib
import json
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from starlette.applications import Starlette
from starlette.responses import FileResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from rthyb_rt import __version__
from rthyb_rt.core import STATES
from rthyb_rt.documents import finite
from rthyb_rt.errors import RthybError
from rthyb_rt.live.frames import Framer
from rthyb_rt.live.guard import Guard, Pass, Tokens
from rthyb_rt.live.shown_rows import CHANNELS, Tally
from rthyb_rt.service.control import Client

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.types import ASGIApp

    from rthyb_rt.live.sources import PageSource

FRAMES_PER_S: Final = 30.0
STATUS_S: Final = 0.25
_IDLE_S: Final = 1.0
MESSAGE_BYTES: Final = 4096
PAGES: Final = 16
"""Largest number of simultaneous sockets."""
_TRY_AGAIN: Final = 1013
_UNSUPPORTED: Final = 1003
_COMMAND_S: Final = 5.0

_STATIC: Final = Path(__file__).parent / "static"
FILES: Final[dict[str, tuple[str, str]]] = {
    "/": ("index.html", "text/html; charset=utf-8"),
    **{
        f"/{name}": (name, kind)
        for name, kind in (
            ("live.css", "text/css; charset=utf-8"),
            ("uPlot.min.css", "text/css; charset=utf-8"),
            ("icon.svg", "image/svg+xml"),
            ("uPlot.iife.min.js", "text/javascript; charset=utf-8"),
            ("charts.js", "text/javascript; charset=utf-8"),
            ("stream.js", "text/javascript; charset=utf-8"),
            ("live.js", "text/javascript; charset=utf-8"),
        )
    },
}

NEEDS: Final[dict[str, Pass]] = {
    "hold": Pass.LOOK,
    "stop": Pass.LOOK,
    "zero": Pass.OPERATE,
    "arm": Pass.OPERATE,
    "start": Pass.OPERATE,
    "resume": Pass.OPERATE,
    "reset": Pass.OPERATE,
}
"""The commands of the page, and the permission that each requires."""


class Feed:
    """Reads the source for all pages together: rows 30 times per second, the rest four times.

    Without pages: once per second, so that the ring does not overtake the reader.

    Args:
        source: the source.

    Attributes:
        pages: number of open pages.
        status: status message, as sent to pages.
        updates: number of updates of the status.
    """

    def __init__(self, source: PageSource) -> None:
        self.source = source
        self.pages = 0
        self.status = b""
        self.updates = 0
        self._beat, self._opened = asyncio.Event(), asyncio.Event()
        self._looking: asyncio.Task[None] | None = None

    async def beat(self) -> None:
        """Wait for the next rows."""
        await self._beat.wait()

    def open(self) -> None:
        """Count one more page, and request its first message at once."""
        self.pages += 1
        self._opened.set()

    async def run(self) -> None:
        """Run until cancelled."""
        due = looked = time.monotonic()
        state = self.source.state
        self._say()
        while True:
            self.source.poll()
            now = time.monotonic()
            # The state has changed: query its cause at once.
            wanted = now - looked >= STATUS_S or self.source.state != state
            wanted = wanted or self._opened.is_set()
            if wanted and (self._looking is None or self._looking.done()):
                self._opened.clear()
                looked, state = now, self.source.state
                if self._looking is not None:
                    self._looking.result()
                self._looking = asyncio.create_task(self._look())
            beat, self._beat = self._beat, asyncio.Event()
            beat.set()
            # Without pages, and after a delay of the machine, missed updates are not repeated.
            if self.pages:
                due = max(due + 1.0 / FRAMES_PER_S, now)
                await asyncio.sleep(due - time.monotonic())
                continue
            due = now
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(_IDLE_S):
                    await self._opened.wait()

    async def _look(self) -> None:
        await asyncio.to_thread(self.source.look)
        self._say()

    def _say(self) -> None:
        message = {"kind": "status", "zero": self.source.zero, **self.source.status()}
        self.status = json.dumps(finite(message), separators=(",", ":")).encode()
        self.updates += 1


class Commander:
    """Passes commands on to the service, with the permissions of this process.

    Args:
        socket: the service's control socket, or None.
    """

    def __init__(self, socket: Path | None) -> None:
        self._socket = socket
        self._token = ""

    async def give(self, name: str, opened: Pass, digest: str = "") -> str:
        """Give a command; return the result in words.

        Args:
            name: a command in `NEEDS`.
            opened: permission of the page's token.
            digest: digest of the test that the page shows: only this test is armed.

        Raises:
            RthybError: it is refused, here or by the service.
        """
        needs = NEEDS.get(name)
        if needs is None:
            raise RthybError(f"there is no command {name[:20]!r}")
        if opened < needs:
            raise RthybError(
                f"{name} needs the operator's address of this page: rthyb live --operator"
            )
        if self._socket is None:
            raise RthybError(
                "there is no service behind this page: only rthyb serve accepts commands"
            )
        return await asyncio.to_thread(self._give, self._socket, name, digest)

    def _give(self, socket: Path, name: str, digest: str) -> str:
        with Client(socket, _COMMAND_S) as client:
            if name == "arm":
                found = client.call("Arm", digest=digest)
                self._token = found["token"]
                return f"Armed for {found['timeout_s']:g} s"
            if name == "start":
                client.call("Start", token=self._token)
                self._token = ""
            else:
                client.call(name.capitalize())
        return _DONE[name]


_DONE: Final = {
    "hold": "Held",
    "stop": "Stop sent",
    "zero": "Zeroing",
    "start": "Started",
    "resume": "Resumed",
    "reset": "Reset",
}


class Page:
    """One open page: its requests, and the frames that it receives."""

    def __init__(self, socket: WebSocket, feed: Feed, commander: Commander) -> None:
        self._socket, self._feed, self._commander = socket, feed, commander
        self._framer = Framer(feed.source.history, feed.source.fs_hz)
        self._opened: Pass = socket.scope["rthyb.pass"]
        # The status may be a second old: the state, and so the buttons, may have changed.
        self._reported = feed.updates

    async def run(self) -> None:
        """Serve the page until it disconnects."""
        await self._socket.send_text(json.dumps(self._hello()))
        sending = asyncio.create_task(self._send())
        try:
            while True:
                await self._receive(await self._socket.receive_text())
        except (WebSocketDisconnect, KeyError):
            # A binary message has no text.
            pass
        except ValueError as error:
            await self._socket.close(_UNSUPPORTED, str(error)[:100])
        finally:
            sending.cancel()
            with contextlib.suppress(asyncio.CancelledError, WebSocketDisconnect, RuntimeError):
                await sending

    def _hello(self) -> dict[str, Any]:
        source = self._feed.source
        return {
            "kind": "hello",
            "version": __version__,
            "channels": [channel.name for channel in CHANNELS],
            "states": list(STATES),
            "fs_hz": source.fs_hz,
            "past": source.past,
            "first": source.history.first,
            "last": source.history.last,
            "operator": self._opened >= Pass.OPERATE,
            "commands": [] if source.socket is None else [n for n in NEEDS if self._may(n)],
            "edges_us": Tally.EDGES_US.tolist(),
        }

    def _may(self, name: str) -> bool:
        return self._opened >= NEEDS[name]

    async def _receive(self, text: str) -> None:
        """Process a message from the page.

        Raises:
            ValueError: it is not a valid message.
        """
        try:
            message = json.loads(text)
        except RecursionError as error:
            raise ValueError("not a message that the page may send") from error
        if not isinstance(message, dict):
            raise ValueError("a message must be an object")
        if "view" in message:
            self._framer.show(message["view"])
            # Not only at the next beat, so that resizing a window is smooth.
            await self._send_frames()
        elif isinstance(message.get("command"), str):
            await self._command(message["command"], str(message.get("digest", "")))
        else:
            raise ValueError("neither a view nor a command")

    async def _command(self, name: str, digest: str) -> None:
        try:
            text, good = await self._commander.give(name, self._opened, digest), True
        except RthybError as error:
            text, good = str(error), False
        answer = {"kind": "answer", "command": name[:20], "ok": good, "text": text}
        await self._socket.send_text(json.dumps(answer))

    async def _send(self) -> None:
        """Send new data. A slow page gets fewer and larger frames, and does not delay others."""
        while True:
            if self._reported != self._feed.updates:
                # Even if unchanged: a page that receives nothing shows a warning.
                self._reported = self._feed.updates
                await self._socket.send_text(self._feed.status.decode())
            await self._meet_rate()
            await self._send_frames()
            await self._feed.beat()

    async def _meet_rate(self) -> None:
        """Restart if the rate of the source has changed: a page may open before anything runs."""
        if self._framer.fs_hz == self._feed.source.fs_hz:
            return
        self._framer = Framer(self._feed.source.history, self._feed.source.fs_hz)
        # The page replies with the view that it wants.
        await self._socket.send_text(json.dumps(self._hello()))

    async def _send_frames(self) -> None:
        for frame in self._framer.next(self._feed.source.zero):
            await self._socket.send_bytes(frame)


def make_app(
    source: PageSource,
    tokens: Tokens,
    ready: Callable[[], None] = lambda: None,
    failed: Callable[[BaseException], None] = lambda _: None,
) -> ASGIApp:
    """Return the application.

    Args:
        source: the source, which remains the caller's.
        tokens: accepted tokens.
        ready: called once it works.
        failed: called with the exception if reading the source ends unexpectedly.
    """
    feed, commander = Feed(source), Commander(source.socket)

    async def file(request: Request) -> Response:
        name, kind = FILES[request.scope["path"]]
        return FileResponse(_STATIC / name, media_type=kind)

    async def socket(websocket: WebSocket) -> None:
        if feed.pages >= PAGES:
            await websocket.close(_TRY_AGAIN, "too many pages are open")
            return
        await websocket.accept()
        feed.open()
        try:
            with contextlib.suppress(WebSocketDisconnect):
                await Page(websocket, feed, commander).run()
        finally:
            feed.pages -= 1

    def ended(task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if error is not None:
            failed(error)

    @contextlib.asynccontextmanager
    async def lifespan(_: Starlette) -> AsyncIterator[None]:
        working = asyncio.create_task(feed.run())
        working.add_done_callback(ended)
        ready()
        try:
            yield
        finally:
            working.cancel()
            await asyncio.wait([working])

    routes = [*(Route(path, file) for path in FILES), WebSocketRoute("/socket", socket)]
    return Guard(Starlette(routes=routes, lifespan=lifespan), tokens)
