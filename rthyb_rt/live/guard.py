"""Access control: the right token, a host name of this PC only, and the live view's own page.

The token excludes other users of this PC. The Host header must name the loopback, because another
name server could resolve any name to 127.0.0.1; the Origin must be the page's own, because any
page that the operator has open could otherwise use the socket.
"""

from __future__ import annotations

import hmac
import re
import secrets
from dataclasses import dataclass, field
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from starlette.types import ASGIApp, Message, Receive, Scope, Send

_HOST: Final = re.compile(r"(?:127\.0\.0\.1|localhost|\[::1\])(?::\d{1,5})?")
POLICY_VIOLATION: Final = 1008

HEADERS: Final[tuple[tuple[bytes, bytes], ...]] = (
    (
        b"content-security-policy",
        b"default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        b"img-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
    # The address of the page is a secret.
    (b"referrer-policy", b"no-referrer"),
    (b"cache-control", b"no-store"),
    (b"x-content-type-options", b"nosniff"),
    (b"x-frame-options", b"DENY"),
    (b"cross-origin-opener-policy", b"same-origin"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"permissions-policy", b"camera=(), geolocation=(), microphone=(), usb=(), serial=()"),
)


class Pass(IntEnum):
    """What a token permits."""

    LOOK = 1
    """View, hold and stop."""
    OPERATE = 2
    """Also zero, arm, start, resume and reset."""


@dataclass(frozen=True)
class Tokens:
    """The secrets in the addresses of the page; random, and new at every start.

    Attributes:
        look: of the page for everybody.
        operate: of the operator's page, or None if there is none.
    """

    look: str = field(default_factory=lambda: secrets.token_urlsafe(24))
    operate: str | None = None

    def opens(self, given: str) -> Pass | None:
        """Return what a token permits; None: nothing."""
        # Both are always compared, so that timing reveals nothing.
        found = given.encode()
        operates = hmac.compare_digest(found, (self.operate or "").encode())
        looks = hmac.compare_digest(found, self.look.encode())
        if self.operate and operates:
            return Pass.OPERATE
        return Pass.LOOK if looks else None


class Guard:
    """ASGI middleware that rejects unauthorised requests and adds headers.

    The first part of the path is the token; the application receives what it permits as
    ``scope["rthyb.pass"]``, and the rest of the path.
    """

    def __init__(self, app: ASGIApp, tokens: Tokens) -> None:
        self._app, self._tokens = app, tokens

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Accept or reject a request."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        why = self._why_not(scope)
        token, _, rest = scope["path"].lstrip("/").partition("/")
        opened = self._tokens.opens(token) if why is None else None
        if opened is None:
            await _turn_away(scope, receive, send, why or "This is not the address of the page.")
            return
        inner = {**scope, "path": f"/{rest}", "raw_path": None, "rthyb.pass": opened}
        await self._app(inner, receive, _with_headers(send))

    @staticmethod
    def _why_not(scope: Scope) -> str | None:
        """Return why a request is rejected whatever its token, or None."""
        found: dict[bytes, list[str]] = {}
        for name, value in scope["headers"]:
            found.setdefault(name.lower(), []).append(value.decode("latin-1"))
        hosts, origins = found.get(b"host", []), found.get(b"origin", [])
        if len(hosts) != 1 or not _HOST.fullmatch(hosts[0]):
            return "The live view answers only at 127.0.0.1 and localhost."
        own = f"http://{hosts[0]}"
        if any(origin != own for origin in origins):
            return "Only the page of the live view itself may send requests."
        # All browsers send the origin of a socket.
        if scope["type"] == "websocket" and len(origins) != 1:
            return "A socket must state the page to which it belongs."
        return None


async def _turn_away(scope: Scope, receive: Receive, send: Send, why: str) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": POLICY_VIOLATION, "reason": why})
        return
    body = f"rthyb live: {why} Use the address printed by rthyb live.\n".encode()
    # A rejected connection is closed at once.
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"connection", b"close"),
        *HEADERS,
    ]
    start: dict[str, Any] = {"type": "http.response.start", "status": 403, "headers": headers}
    await send(start)
    await send({"type": "http.response.body", "body": body})


def _with_headers(send: Send) -> Send:
    async def sending(message: Message) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message["headers"], *HEADERS]
        await send(message)

    return sending
