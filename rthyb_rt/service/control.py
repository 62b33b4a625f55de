"""The control socket: Varlink's framing, NUL-ended JSON, on a Unix socket.

The permissions of a client follow from the user that the kernel reports for the connection.
Requests and connections are limited in size, rate and time; anything else is answered with an error
or by closing the connection.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import json
import logging
import os
import socket
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any, Final

from rthyb_rt import __version__
from rthyb_rt.documents import finite
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.service.peers import GROUP_OF, Peer, Rights, Role, peer_of
from rthyb_rt.service.rig_engine import StateError

INTERFACE: Final = "org.rthyb.Control"
SERVICE: Final = "org.varlink.service"
SOCKET: Final = Path("/run/rthyb/control.sock")

REQUEST_BYTES: Final = 64 << 10
LOAD_BYTES: Final = 8 << 20
REPLY_BYTES: Final = 1 << 20
_USERS: Final = 256
"""Number of users whose credit is remembered."""

_SERVICE_TEXT: Final = """# Every Varlink service describes itself.
interface org.varlink.service

method GetInfo() -> (
  vendor: string,
  product: string,
  version: string,
  url: string,
  interfaces: []string
)

method GetInterfaceDescription(interface: string) -> (description: string)

error InterfaceNotFound (interface: string)

error MethodNotFound (method: string)

error MethodNotImplemented (method: string)

error InvalidParameter (parameter: string)

error PermissionDenied ()

error ExpectedMore ()
"""

log = logging.getLogger("rthyb.control")

Handler = Callable[[Peer, dict[str, Any]], Awaitable[dict[str, Any]]]


def description() -> str:
    """Return the text of the interface."""
    file = resources.files("rthyb_rt.service") / f"{INTERFACE}.varlink"
    return file.read_text(encoding="utf-8")


@dataclass(frozen=True)
class Method:
    """A method of the interface.

    Attributes:
        role: role that is required to call it.
        handle: carries it out; an exception becomes an error reply.
        parameters: type of each parameter, with None for an optional one.
        large: a request may be as long as `LOAD_BYTES`.
        may_begin: called before a long request is read completely.
    """

    role: Role
    handle: Handler
    parameters: Mapping[str, tuple[type | None, ...]] = field(default_factory=dict)
    large: bool = False
    may_begin: Callable[[], None] = lambda: None


@dataclass(frozen=True)
class ClientLimits:
    """Limits for clients.

    Attributes:
        connections: maximum of simultaneous connections of all users; each user may have half of
            them, and administrators are always admitted.
        strangers: how many of these may belong to users without rights.
        per_s, burst: rate and burst of requests of one user, over all connections.
        idle_s: maximum time without a request.
        message_s: maximum time from the first byte of a request to its last.
        large_s: the same for a large request.
        answer_s: maximum time for an answer to be received.
    """

    connections: int = 128
    strangers: int = 8
    per_s: float = 50.0
    burst: float = 100.0
    idle_s: float = 300.0
    message_s: float = 5.0
    large_s: float = 20.0
    answer_s: float = 5.0


class ReplyError(Exception):
    """An error reply: its name, and its parameters."""

    def __init__(self, name: str, **parameters: Any) -> None:
        super().__init__(name)
        self.name, self.parameters = name, parameters


def limited(reason: str) -> ReplyError:
    """Return the error reply to a client that exceeds a limit."""
    return ReplyError(f"{INTERFACE}.Limited", reason=reason)


# ---- one request --------------------------------------------------------------------------------


@dataclass(frozen=True)
class Call:
    """A well-formed request."""

    method: str
    parameters: dict[str, Any]
    oneway: bool


def parse(message: bytes) -> Call:
    """Return the call of a message without its NUL.

    Raises:
        ReplyError: it is not a call; the connection cannot be used any further.
    """
    try:
        document = json.loads(message, parse_constant=_no_constant)
    except (ValueError, RecursionError) as error:
        raise ReplyError(f"{SERVICE}.InvalidParameter", parameter="message") from error
    if not isinstance(document, dict) or not document.keys() <= {
        "method",
        "parameters",
        "oneway",
        "more",
        "upgrade",
    }:
        raise ReplyError(f"{SERVICE}.InvalidParameter", parameter="message")
    method, parameters = document.get("method"), document.get("parameters")
    if not isinstance(method, str):
        raise ReplyError(f"{SERVICE}.InvalidParameter", parameter="method")
    if parameters is not None and not isinstance(parameters, dict):
        raise ReplyError(f"{SERVICE}.InvalidParameter", parameter="parameters")
    for flag in ("oneway", "more", "upgrade"):
        if document.get(flag) not in (None, False, True):
            raise ReplyError(f"{SERVICE}.InvalidParameter", parameter=flag)
    if document.get("upgrade"):
        raise ReplyError(f"{SERVICE}.InvalidParameter", parameter="upgrade")
    return Call(method, parameters or {}, document.get("oneway") is True)


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not a number")


class Dispatcher:
    """Calls methods for clients with the required rights.

    Args:
        methods: methods of the interface, by name.
        rights: rights of the users.
    """

    def __init__(self, methods: Mapping[str, Method], rights: Rights) -> None:
        self.methods, self.rights = dict(methods), rights

    async def answer(self, message: bytes, peer: Peer) -> dict[str, Any] | None:
        """Return the reply to a message without its NUL; None: no reply is requested."""
        oneway = False
        try:
            call = parse(message)
            oneway = call.oneway
            reply: dict[str, Any] = {"parameters": await self._call(call, peer, len(message))}
        except ReplyError as error:
            reply = {"error": error.name, "parameters": error.parameters}
        return None if oneway else reply

    async def _call(self, call: Call, peer: Peer, size: int) -> dict[str, Any]:
        interface, _, name = call.method.rpartition(".")
        if interface == SERVICE:
            return self._introspect(name, call)
        if interface != INTERFACE:
            raise ReplyError(f"{SERVICE}.InterfaceNotFound", interface=interface[:200])
        method = self.methods.get(name)
        if method is None:
            raise ReplyError(f"{SERVICE}.MethodNotFound", method=call.method[:200])
        self.require(peer, method.role, name)
        if size > REQUEST_BYTES and not method.large:
            raise limited(f"{name} may be at most {REQUEST_BYTES} bytes long, found {size}")
        _check_parameters(call.parameters, method.parameters)
        return await _guarded(name, method.handle(peer, call.parameters))

    def _introspect(self, name: str, call: Call) -> dict[str, Any]:
        # Anyone may ask what the service is: a refusal reveals as much.
        if name == "GetInfo":
            _check_parameters(call.parameters, {})
            return {
                "vendor": "rthyb_rt",
                "product": "rthyb",
                "version": __version__,
                "url": "",
                "interfaces": [SERVICE, INTERFACE],
            }
        if name == "GetInterfaceDescription":
            _check_parameters(call.parameters, {"interface": (str,)})
            texts = {SERVICE: lambda: _SERVICE_TEXT, INTERFACE: description}
            wanted = call.parameters["interface"]
            if wanted not in texts:
                raise ReplyError(f"{SERVICE}.InterfaceNotFound", interface=wanted[:200])
            return {"description": texts[wanted]()}
        raise ReplyError(f"{SERVICE}.MethodNotFound", method=call.method[:200])

    def require(self, peer: Peer, role: Role, name: str) -> None:
        """Refuse a peer without the right to call a method.

        Raises:
            ReplyError: the peer does not have the right.
        """
        found = self.rights.role(peer)
        if found >= role:
            return
        group = GROUP_OF[role]
        has = (
            f"is in group {GROUP_OF[found]}, which may watch, hold and stop"
            if found
            else "is not in any group with rights here"
        )
        reason = f"{name} requires membership of group {group}; {peer.user} {has}"
        raise ReplyError(f"{INTERFACE}.NotPermitted", reason=reason, group=group)


def _refused(error: StateError) -> ReplyError:
    return ReplyError(
        f"{INTERFACE}.Refused",
        reason=str(error),
        state=error.state,
        allowed=list(error.allowed),
    )


async def _guarded(name: str, work: Awaitable[dict[str, Any]]) -> dict[str, Any]:
    """Convert an exception of a handler into a reply."""
    try:
        return await work
    except StateError as error:
        raise _refused(error) from error
    except RefusedError as error:
        raise ReplyError(f"{INTERFACE}.Refused", reason=str(error), state="", allowed=[]) from error
    except InputError as error:
        problems = [{"where": p.where, "message": p.message} for p in error.problems]
        raise ReplyError(f"{INTERFACE}.BadInput", problems=problems) from error
    except RthybError as error:
        raise ReplyError(f"{INTERFACE}.Failed", reason=str(error)) from error
    except (ReplyError, asyncio.CancelledError):
        raise
    except Exception as error:
        log.exception("%s failed", name)
        reason = f"internal error: {type(error).__name__}; details are in the journal"
        raise ReplyError(f"{INTERFACE}.Failed", reason=reason) from error


def _check_parameters(given: dict[str, Any], wanted: Mapping[str, tuple[type | None, ...]]) -> None:
    for name in given:
        if name not in wanted:
            raise ReplyError(f"{SERVICE}.InvalidParameter", parameter=name[:200])
    for name, types in wanted.items():
        value = given.get(name)
        fits = value is None if None in types else False
        if not fits and type(value) not in types:
            raise ReplyError(f"{SERVICE}.InvalidParameter", parameter=name)


# ---- the server ---------------------------------------------------------------------------------


class _Credits:
    """Remaining requests of each user; a user who asks too fast waits until one is available.

    Args:
        limits: limits for clients.
    """

    def __init__(self, limits: ClientLimits) -> None:
        self._limits = limits
        # The user with the most recent request comes last.
        self._left: dict[int, tuple[float, float]] = {}

    def take(self, uid: int) -> float:
        """Deduct a request from a user's credit; return how long it must wait, s."""
        limits, now = self._limits, time.monotonic()
        left, then = self._left.pop(uid, (limits.burst, now))
        left = min(left + (now - then) * limits.per_s, limits.burst) - 1.0
        # Capped at what the user's connections can have pending, or a flood would delay a stop.
        left = max(left, -float(limits.connections // 2))
        self._left[uid] = left, now
        if len(self._left) > _USERS:
            del self._left[next(iter(self._left))]
        return max(-left, 0.0) / limits.per_s

    def give_back(self, uid: int) -> None:
        """Undo a `take` for a request that did not arrive."""
        if uid in self._left:
            left, then = self._left[uid]
            self._left[uid] = left + 1.0, then


class ControlServer:
    """Listens on a Unix socket and answers, many connections at a time.

    Args:
        path: of the socket.
        dispatcher: answers the requests.
        limits: limits for clients.

    Attributes:
        refused_connections, requests: numbers so far.
    """

    def __init__(
        self, path: Path, dispatcher: Dispatcher, limits: ClientLimits = ClientLimits()
    ) -> None:
        self.path, self._dispatcher, self._limits = path, dispatcher, limits
        self.refused_connections = self.requests = 0
        self._by_user: Counter[int] = Counter()
        self._strangers = 0
        self._credits = _Credits(limits)
        self._large = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()
        self._accepting: asyncio.Task[None] | None = None
        self._listener: socket.socket | None = None

    @property
    def connections(self) -> int:
        """Current number of connections."""
        return self._by_user.total()

    async def start(self) -> None:
        """Start listening; a socket on which no process listens any more is replaced.

        Raises:
            RthybError: another service listens there, or the path cannot be used.
        """
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            _remove_abandoned(self.path)
            # Anyone may connect: the kernel identifies the user, and a refusal states its reason.
            before = os.umask(0o111)
            try:
                listener.bind(str(self.path))
            finally:
                os.umask(before)
            listener.listen(self._limits.connections)
            listener.setblocking(False)
        except RthybError:
            listener.close()
            raise
        except OSError as error:
            listener.close()
            raise RthybError(
                f"{self.path}: the control socket cannot be created ({error.strerror or error}); "
                "check the folder, or choose another path with --socket"
            ) from error
        self._listener = listener
        self._accepting = asyncio.create_task(self._accept(listener))

    async def stop(self) -> None:
        """Close all connections and remove the socket."""
        tasks = [*self._tasks, *([self._accepting] if self._accepting else [])]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._listener is not None:
            self._listener.close()
            with contextlib.suppress(OSError):
                self.path.unlink()
            self._listener = None

    async def _accept(self, listener: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(listener)
            except OSError as error:
                # For example no descriptors left: existing connections take priority.
                log.warning("a connection could not be accepted: %s", error)
                await asyncio.sleep(0.5)
                continue
            connection.setblocking(False)
            task = asyncio.create_task(self._serve(connection))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        with contextlib.closing(connection):
            try:
                peer = peer_of(connection)
            except OSError:
                return
            role = self._dispatcher.rights.role(peer)
            room = self._room(peer, role)
            if room is not None:
                self.refused_connections += 1
                with contextlib.suppress(OSError, TimeoutError):
                    await self._send(connection, _error(limited(room)))
                return
            self._by_user[peer.uid] += 1
            self._strangers += role == Role.NONE
            try:
                await _Conversation(self, connection, peer, role).run()
            except (OSError, TimeoutError):
                pass
            finally:
                self._by_user[peer.uid] -= 1
                self._strangers -= role == Role.NONE

    def _room(self, peer: Peer, role: Role) -> str | None:
        """Return why another connection cannot be accepted, or None."""
        limits = self._limits
        if role == Role.NONE and self._strangers >= limits.strangers:
            return "too many connections from users without rights here"
        if peer.uid == 0:
            # An administrator is always admitted.
            return None
        if self._by_user[peer.uid] >= limits.connections // 2:
            return f"{peer.user} already has {self._by_user[peer.uid]} connections"
        if self.connections >= limits.connections:
            return f"the service already has {self.connections} connections"
        return None

    async def _send(self, connection: socket.socket, reply: dict[str, Any]) -> None:
        data = encode(reply)
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(self._limits.answer_s):
            await loop.sock_sendall(connection, data)


class _Conversation:
    """One connection, from its first byte to its last."""

    def __init__(
        self, server: ControlServer, connection: socket.socket, peer: Peer, role: Role
    ) -> None:
        self._server, self._connection, self._peer, self._role = server, connection, peer, role
        self._limits, self._dispatcher = server._limits, server._dispatcher
        self._buffer = bytearray()

    async def run(self) -> None:
        asked = False
        while True:
            await self._wait_for_turn()
            try:
                message = await self._message()
            except ReplyError as error:
                await self._server._send(self._connection, _error(error))
                return
            if message is None:
                # Connecting without a request costs as much as a request.
                if asked:
                    self._server._credits.give_back(self._peer.uid)
                return
            asked = True
            self._server.requests += 1
            reply = await self._dispatcher.answer(message, self._peer)
            if reply is not None:
                await self._server._send(self._connection, reply)
            if self._role == Role.NONE or (reply is not None and _ends(reply)):
                return

    async def _wait_for_turn(self) -> None:
        """Let a client that asks too fast wait; its requests stay in the kernel meanwhile."""
        wait_s = self._server._credits.take(self._peer.uid)
        if wait_s > 0.0:
            await asyncio.sleep(wait_s)

    async def _message(self) -> bytes | None:
        """Return the next message without its NUL; None: there will be no more."""
        if not self._buffer and not await self._receive(self._limits.idle_s):
            return None
        end = time.monotonic() + self._limits.message_s
        while b"\0" not in self._buffer:
            if len(self._buffer) > REQUEST_BYTES:
                return await self._large_message()
            if not await self._receive(end - time.monotonic()):
                return None
        return self._cut()

    async def _large_message(self) -> bytes | None:
        """Read a long request only if the client and the state permit a load, one at a time."""
        self._check_large()
        if self._server._large.locked():
            raise limited("another test is being loaded; try again")
        async with self._server._large:
            end = time.monotonic() + self._limits.large_s
            # The bytes already received have been searched.
            seen = len(self._buffer)
            while self._buffer.find(b"\0", seen) < 0:
                seen = len(self._buffer)
                if seen > LOAD_BYTES:
                    raise limited(f"a request may be at most {LOAD_BYTES} bytes long")
                if not await self._receive(end - time.monotonic()):
                    return None
            # Parsing it blocks this thread, which sends the heartbeat, for a while: refuse it if a
            # motion has begun. None can begin meanwhile, because START is handled by this thread.
            self._check_large()
            return self._cut()

    def _check_large(self) -> None:
        """Refuse a long request if the client, or the state, does not permit loading a test.

        Raises:
            ReplyError: it is refused.
        """
        for name, method in self._dispatcher.methods.items():
            if method.large:
                self._dispatcher.require(
                    self._peer, method.role, f"a request as long as this one ({name})"
                )
                try:
                    method.may_begin()
                except StateError as error:
                    raise _refused(error) from error

    def _cut(self) -> bytes:
        at = self._buffer.index(b"\0")
        message = bytes(self._buffer[:at])
        del self._buffer[: at + 1]
        return message

    async def _receive(self, seconds: float) -> bool:
        loop = asyncio.get_running_loop()
        try:
            # Not wait_for: before Python 3.12 it loses a cancellation that coincides with the data.
            async with asyncio.timeout(max(seconds, 0.001)):
                data = await loop.sock_recv(self._connection, REQUEST_BYTES)
        except TimeoutError:
            raise limited("the request was not completed in time") from None
        self._buffer += data
        return bool(data)


def _error(error: ReplyError) -> dict[str, Any]:
    return {"error": error.name, "parameters": error.parameters}


def _ends(reply: dict[str, Any]) -> bool:
    """Whether the input was not a message at all, so that the following bytes are undefined."""
    return (
        reply.get("error") == f"{SERVICE}.InvalidParameter"
        and reply["parameters"].get("parameter") == "message"
    )


def encode(document: dict[str, Any]) -> bytes:
    """Return a message with its NUL; numbers that JSON cannot represent become null."""
    text = json.dumps(finite(document), ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.encode() + b"\0"


def _remove_abandoned(path: Path) -> None:
    if path.is_symlink():
        raise RthybError(
            f"{path} is a symbolic link; remove it, or choose another path with --socket"
        )
    if not path.is_socket():
        return
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        if probe.connect_ex(str(path)) != errno.ECONNREFUSED:
            raise RthybError(
                f"{path}: another service is already listening here; stop it, or choose another "
                "path with --socket"
            )
    path.unlink()


# ---- the client ---------------------------------------------------------------------------------


class UnreachableError(RthybError):
    """The service cannot be reached."""

    exit_code = 4


_EXIT_CODES: Final = {"Refused": 5, "NotPermitted": 5, "Limited": 5, "BadInput": 3}


class Refusal(RefusedError):
    """The service's error reply.

    Attributes:
        name: name of the error, with its interface.
        parameters: parameters of the error.
    """

    def __init__(self, name: str, parameters: dict[str, Any]) -> None:
        self.name, self.parameters = name, parameters
        self.exit_code = _EXIT_CODES.get(name.removeprefix(f"{INTERFACE}."), 1)
        super().__init__(_in_words(name, parameters))


def _in_words(name: str, parameters: dict[str, Any]) -> str:
    if name == f"{INTERFACE}.BadInput":
        problems = parameters.get("problems") or []
        return "\n".join(
            f"{p['where']}: {p['message']}" if p["where"] else str(p["message"]) for p in problems
        )
    reason = parameters.get("reason")
    if isinstance(reason, str):
        return reason
    listed = ", ".join(f"{key} {value}" for key, value in parameters.items())
    return f"{name.rpartition('.')[2]}: {listed}" if listed else name


class Client:
    """A connection to the service; a context manager.

    Args:
        path: of the socket.
        timeout_s: for an answer.

    Raises:
        UnreachableError: there is no service.
    """

    def __init__(self, path: Path = SOCKET, timeout_s: float = 60.0) -> None:
        self._path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        self._buffer = bytearray()
        try:
            self._socket.connect(str(path))
        except OSError as error:
            self._socket.close()
            raise self._unreachable(error) from error

    def _unreachable(self, error: OSError | str) -> UnreachableError:
        words = error if isinstance(error, str) else error.strerror or str(error)
        return UnreachableError(
            f"{self._path}: the service cannot be reached ({words}); is it running? See "
            "systemctl status rthyb, or give the path of its socket with --socket"
        )

    def __enter__(self) -> Client:
        """Return the client itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the connection."""
        self.close()

    def close(self) -> None:
        """Close the connection; a second call has no effect."""
        self._socket.close()

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        """Call a method of `INTERFACE`, or one given with its interface; return its result.

        Raises:
            Refusal: the service's error reply.
            UnreachableError: the service has ended, or does not answer.
        """
        name = method if "." in method else f"{INTERFACE}.{method}"
        request = {"method": name, "parameters": parameters}
        try:
            # A request that is too long is answered before it has been read completely.
            with contextlib.suppress(BrokenPipeError, ConnectionResetError):
                self._socket.sendall(encode(request))
            reply = self._reply()
        except TimeoutError:
            raise self._unreachable("it did not answer") from None
        except OSError as error:
            raise self._unreachable(error) from error
        if "error" in reply:
            raise Refusal(str(reply["error"]), dict(reply.get("parameters") or {}))
        return dict(reply.get("parameters") or {})

    def _reply(self) -> dict[str, Any]:
        while b"\0" not in self._buffer:
            data = self._socket.recv(REQUEST_BYTES)
            if not data or len(self._buffer) > REPLY_BYTES:
                raise self._unreachable("it closed the connection")
            self._buffer += data
        message, _, rest = bytes(self._buffer).partition(b"\0")
        self._buffer = bytearray(rest)
        try:
            reply = json.loads(message)
        except ValueError:
            raise self._unreachable("its answer is not valid JSON") from None
        if not isinstance(reply, dict):
            raise self._unreachable("its answer is not a valid reply")
        return reply
