"""The live view's server: one process, one port of the loopback."""

from __future__ import annotations

import contextlib
import errno
import socket
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

import uvicorn

from rthyb_rt.errors import RthybError
from rthyb_rt.live.app import MESSAGE_BYTES, make_app
from rthyb_rt.live.guard import Tokens

if TYPE_CHECKING:
    from rthyb_rt.live.sources import Source

LOOPBACK: Final = "127.0.0.1"
_CONNECTIONS: Final = 64


class _Server(uvicorn.Server):
    """Leaves the signals to the command line."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


class LiveServer:
    """Serves the page of a source until it is told to end.

    Args:
        source: what is looked at; stays the caller's.
        tokens: let in.
        port: of the loopback; 0 takes a free one.
        ready: called once the page can be opened.

    Attributes:
        port: that is listened at.

    Raises:
        RthybError: the port is taken, or not for this user.
    """

    def __init__(
        self,
        source: Source,
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
                http="h11",
                ws="websockets-sansio",
                ws_max_size=MESSAGE_BYTES,
                # On the loopback, bytes cost less than squeezing them.
                ws_per_message_deflate=False,
                # A log of requests would have the token in it.
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
        """Address of the operator's page, if there is one."""
        token = self._tokens.operate
        return None if token is None else f"http://{LOOPBACK}:{self.port}/{token}/"

    def run(self) -> None:
        """Serve until `stop`.

        Raises:
            BaseException: what ended the reading of the source.
        """
        try:
            self._server.run(sockets=[self._listener])
        finally:
            self._listener.close()
        if self._error is not None:
            raise self._error

    def stop(self) -> None:
        """Have `run` return; from any thread, and from a signal."""
        self._server.should_exit = True

    def _fail(self, error: BaseException) -> None:
        self._error = error
        self.stop()


def _listen(port: int) -> socket.socket:
    try:
        return socket.create_server((LOOPBACK, port))
    except OSError as error:
        hint = "take another one with --port, or --port 0 for any"
        why = "is taken" if error.errno == errno.EADDRINUSE else f"is not to be had ({error})"
        raise RthybError(f"port {port} of {LOOPBACK} {why}; {hint}") from error
