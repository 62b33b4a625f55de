"""The live view's server: one process, one port on the loopback."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import socket
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import uvicorn
from h11 import Request
from uvicorn.protocols.http.h11_impl import H11Protocol

from rthyb_rt.errors import RthybError
from rthyb_rt.live.app import MESSAGE_BYTES, make_app
from rthyb_rt.live.guard import Tokens

if TYPE_CHECKING:
    from rthyb_rt.live.sources import PageSource

LOOPBACK: Final = "127.0.0.1"
_CONNECTIONS: Final = 64
_WAITING: Final = 32
"""Largest number of connections without a request; beyond it, the oldest is closed."""
_REQUEST_S: Final = 5.0
"""Time limit for a complete request, from the connection or the previous response."""


class _Impatient(H11Protocol):
    """Closes connections without a complete request.

    The token is part of the request, so anybody on this PC can connect.
    """

    _deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._await_request()
        waiting = [c for c in self.connections if isinstance(c, _Impatient) and c._deadline]
        if len(waiting) > _WAITING:
            min(waiting, key=lambda c: c._deadline.when() if c._deadline else 0.0)._hang_up()

    def _await_request(self) -> None:
        self._has_request()
        self._deadline = self.loop.call_later(_REQUEST_S, self._hang_up)

    def _has_request(self) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        self._deadline = None

    def _hang_up(self) -> None:
        self._has_request()
        self.transport.close()

    def handle_events(self) -> None:
        super().handle_events()
        cycle = self.cycle
        if cycle is not None and not cycle.more_body and not cycle.response_complete:
            self._has_request()

    def handle_websocket_upgrade(self, event: Request) -> None:
        self._has_request()
        super().handle_websocket_upgrade(event)

    def on_response_complete(self) -> None:
        # Before any data that follow it are processed.
        self._await_request()
        super().on_response_complete()

    def connection_lost(self, exc: Exception | None) -> None:
        self._has_request()
        super().connection_lost(exc)


class _Server(uvicorn.Server):
    """Leaves signal handling to the command line."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


class LiveServer:
    """Serves the page of a source until it is stopped.

    Args:
        source: the source, which remains the caller's.
        tokens: accepted tokens.
        port: port on the loopback; 0 selects a free one.
        ready: called once the page can be opened.

    Attributes:
        port: port in use.

    Raises:
        RthybError: the port is in use, or not permitted for this user.
    """

    def __init__(
        self,
        source: PageSource,
        tokens: Tokens,
        port: int = 0,
        ready: Callable[[], None] = lambda: None,
    ) -> None:
        self._tokens = tokens
        self._listener = _listen(port)
        self.port = int(self._listener.getsockname()[1])
        self._error: BaseException | None = None
        self._server = _Server(
            uvicorn.Config(
                make_app(source, tokens, ready, self._fail),
                loop="asyncio",
                http=_Impatient,
                ws="websockets-sansio",
                ws_max_size=MESSAGE_BYTES,
                # On the loopback, sending bytes is cheaper than compressing them.
                ws_per_message_deflate=False,
                # A log of requests would contain the token.
                log_config=None,
                access_log=False,
                log_level="error",
                server_header=False,
                limit_concurrency=_CONNECTIONS,
                timeout_graceful_shutdown=1,
            )
        )

    @property
    def url(self) -> str:
        """Address of the page for everybody."""
        return f"http://{LOOPBACK}:{self.port}/{self._tokens.look}/"

    @property
    def operator_url(self) -> str | None:
        """Address of the operator's page, or None."""
        token = self._tokens.operate
        return None if token is None else f"http://{LOOPBACK}:{self.port}/{token}/"

    def run(self) -> None:
        """Serve until `stop` is called.

        Raises:
            BaseException: the exception that ended the reading of the source.
        """
        try:
            self._server.run(sockets=[self._listener])
        finally:
            self._listener.close()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Make `run` return; may be called from any thread, and from a signal handler."""
        self._server.should_exit = True

    def _fail(self, error: BaseException) -> None:
        self._error = error
        self.stop()


def _listen(port: int) -> socket.socket:
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        hint = "choose another one with --port, or --port 0 for any free port"
        why = "is taken" if error.errno == errno.EADDRINUSE else f"is not available ({error})"
        raise RthybError(f"port {port} of {LOOPBACK} {why}; {hint}") from error
