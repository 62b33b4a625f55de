"""The control socket: who gets in, what is too much, and whatever else may come."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import random
import re
import shutil
import socket
import subprocess
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from realtime_bench import until
from service_bench import (
    LOOKER,
    LOOKERS,
    OPERATOR,
    OPERATORS,
    RIGHTS,
    ROOT,
    STRANGER,
    listening,
    rig_file,
    served,
    short_test,
)

from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import experiment
from rthyb_rt.service import control, daemon, peers, rig_engine
from rthyb_rt.service.control import (
    INTERFACE,
    LOAD_BYTES,
    REQUEST_BYTES,
    SERVICE,
    Client,
    Dispatcher,
    Method,
    Refusal,
    UnreachableError,
)
from rthyb_rt.service.peers import Peer, Rights, Role

LOOP = asyncio.new_event_loop()

FUZZ = int(os.environ.get("RTHYB_FUZZ", "800"))
"""How many malformed requests; the long run asks for 100,000."""


@pytest.fixture(scope="module", autouse=True)
def _loop() -> Iterator[None]:
    yield
    LOOP.close()


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder with a short name that every user may enter."""
    with TemporaryDirectory(prefix="rthyb-") as folder:
        Path(folder).chmod(0o755)
        yield Path(folder)


def ask(dispatcher: Dispatcher, message: bytes | dict[str, Any], peer: Peer = ROOT) -> Any:
    """Return the reply, as the client would get it."""
    raw = message if isinstance(message, bytes) else json.dumps(message).encode()
    return LOOP.run_until_complete(dispatcher.answer(raw, peer))


def call(name: str, **parameters: Any) -> dict[str, Any]:
    return {"method": f"{INTERFACE}.{name}", "parameters": parameters}


@pytest.fixture(scope="module")
def real(tmp_path_factory: pytest.TempPathFactory) -> Iterator[daemon.Daemon]:
    """A daemon whose methods are called, though nothing listens."""
    from pathlib import Path as P

    from rthyb_rt.rig import virtual_rig
    from rthyb_rt.rig.links import opening

    folder = tmp_path_factory.mktemp("daemon")
    rig = rig_file()
    options = daemon.Options(
        socket=P("/nowhere"),
        rings=folder,
        runs=folder,
        recorder="none",
        require_realtime=False,
        rights=RIGHTS,
    )
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(rig, theirs) as drive:
        made = daemon.Daemon(rig, ours, "stepped", options, before_tick=drive.tick)
        made.engine.wait(0.2)
        try:
            yield made
        finally:
            made.engine.close()


# ---- the interface ------------------------------------------------------------------------------


def test_interface_file_lists_the_methods_and_their_parameters(real: daemon.Daemon) -> None:
    text = re.sub(r"#.*", "", control.description())
    assert re.search(rf"^interface {re.escape(INTERFACE)}$", text, re.MULTILINE)
    written = {
        name: set(re.findall(r"(\w+):", parameters))
        for name, parameters in re.findall(r"^method (\w+)\((.*?)\) ->", text, re.MULTILINE)
    }
    assert written == {name: set(m.parameters) for name, m in real.dispatcher.methods.items()}
    optional = set(re.findall(r"(\w+): \?", text))
    for method in real.dispatcher.methods.values():
        for name, types in method.parameters.items():
            assert (None in types) == (name in optional)


def test_service_introspects_itself(real: daemon.Daemon) -> None:
    info = ask(real.dispatcher, {"method": f"{SERVICE}.GetInfo"}, LOOKER)["parameters"]
    assert info["interfaces"] == [SERVICE, INTERFACE]
    for interface in info["interfaces"]:
        found = ask(
            real.dispatcher,
            {
                "method": f"{SERVICE}.GetInterfaceDescription",
                "parameters": {"interface": interface},
            },
        )
        assert f"\ninterface {interface}\n" in found["parameters"]["description"]
    unknown = ask(
        real.dispatcher,
        {"method": f"{SERVICE}.GetInterfaceDescription", "parameters": {"interface": "a.b"}},
    )
    assert unknown["error"] == f"{SERVICE}.InterfaceNotFound"


@pytest.mark.parametrize(
    ("message", "error", "parameters"),
    [
        (b"", "InvalidParameter", {"parameter": "message"}),
        (b"{", "InvalidParameter", {"parameter": "message"}),
        (b"\xff\xfe", "InvalidParameter", {"parameter": "message"}),
        (b"[" * 60000, "InvalidParameter", {"parameter": "message"}),
        (b'{"method": 1}', "InvalidParameter", {"parameter": "method"}),
        (b'{"method": "a", "extra": 1}', "InvalidParameter", {"parameter": "message"}),
        (b'{"method": "a.b", "parameters": []}', "InvalidParameter", {"parameter": "parameters"}),
        (b'{"method": "a.b", "oneway": 7}', "InvalidParameter", {"parameter": "oneway"}),
        (b'{"method": "a.b", "upgrade": true}', "InvalidParameter", {"parameter": "upgrade"}),
        (b'{"method": "Hold"}', "InterfaceNotFound", {"interface": ""}),
        (b'{"method": "a.b.Hold"}', "InterfaceNotFound", {"interface": "a.b"}),
        (
            b'{"method": "org.rthyb.Control.Jump"}',
            "MethodNotFound",
            {"method": "org.rthyb.Control.Jump"},
        ),
        (
            b'{"method": "org.rthyb.Control.Start"}',
            "InvalidParameter",
            {"parameter": "token"},
        ),
        (
            b'{"method": "org.rthyb.Control.Stop", "parameters": {"now": 1}}',
            "InvalidParameter",
            {"parameter": "now"},
        ),
        (
            b'{"method": "org.rthyb.Control.Hold", "parameters": {"x": 1}}',
            "InvalidParameter",
            {"parameter": "x"},
        ),
    ],
)
def test_what_is_no_call_is_named(
    real: daemon.Daemon, message: bytes, error: str, parameters: dict[str, Any]
) -> None:
    assert ask(real.dispatcher, message) == {
        "error": f"{SERVICE}.{error}",
        "parameters": parameters,
    }


def test_oneway_call_has_no_reply(real: daemon.Daemon) -> None:
    assert ask(real.dispatcher, call("GetStatus") | {"oneway": True}) is None
    assert ask(real.dispatcher, call("Jump") | {"oneway": True}) is None


def test_refusal_says_why_and_where_it_is_allowed(real: daemon.Daemon) -> None:
    found = ask(real.dispatcher, call("Hold"))
    assert found["error"] == f"{INTERFACE}.Refused"
    assert found["parameters"] == {
        "reason": (
            "hold: not possible in this state; the state is IDLE; hold is allowed in "
            "RUNNING or HOLD"
        ),
        "state": "IDLE",
        "allowed": ["RUNNING", "HOLD"],
    }


def test_fault_of_the_program_is_said_and_is_no_end() -> None:
    async def broken(_: Peer, __: dict[str, Any]) -> dict[str, Any]:
        raise ZeroDivisionError

    found = ask(Dispatcher({"Hold": Method(Role.LOOK, broken)}, RIGHTS), call("Hold"))
    assert found["error"] == f"{INTERFACE}.Failed"
    assert "ZeroDivisionError" in found["parameters"]["reason"]


# ---- who may what -------------------------------------------------------------------------------

LOOK = ("GetStatus", "GetRig", "GetMetrics", "Hold", "Stop")
OPERATE = ("Load", "Zero", "Arm", "Start", "Resume", "Reset", "Reload")


def test_every_method_has_its_group(real: daemon.Daemon) -> None:
    roles = {name: method.role for name, method in real.dispatcher.methods.items()}
    assert roles == dict.fromkeys(LOOK, Role.LOOK) | dict.fromkeys(OPERATE, Role.OPERATE)


@pytest.mark.parametrize("name", [*LOOK, *OPERATE])
def test_nobody_is_let_in_who_has_no_business_there(real: daemon.Daemon, name: str) -> None:
    found = ask(real.dispatcher, call(name), STRANGER)
    assert found["error"] == f"{INTERFACE}.NotPermitted"
    assert found["parameters"]["group"] == ("rthyb" if name in LOOK else "rthyb-operator")
    assert "uid 1003 is not in any group with rights here" in found["parameters"]["reason"]
    looked = ask(real.dispatcher, call(name), LOOKER)
    refused = looked.get("error") == f"{INTERFACE}.NotPermitted"
    assert refused == (name in OPERATE)
    operated = ask(real.dispatcher, call(name), OPERATOR)
    assert operated.get("error") != f"{INTERFACE}.NotPermitted"
    assert real.engine.state == "IDLE"


def test_users_of_this_pc_are_called_by_their_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    passwd = tmp_path / "passwd"
    passwd.write_text(
        "root:x:0:0::/root:/bin/sh\n\nbroken\n+::::::\n"
        "bad\x07:x:1004:1::/:/bin/sh\nolga:x:1002:1002:1003:/home/olga:/bin/sh\n",
        encoding="utf-8",
    )
    monkeypatch.setattr(peers, "PASSWD", passwd)
    names = {uid: Peer(7, uid, frozenset()).name for uid in (0, 1002, 1003, 1004)}
    assert names == {
        0: "root (uid 0), process 7",
        1002: "olga (uid 1002), process 7",
        1003: "uid 1003, process 7",
        1004: "uid 1004, process 7",
    }
    monkeypatch.setattr(peers, "PASSWD", tmp_path / "nowhere")
    assert Peer(7, 0, frozenset()).user == "uid 0"


def test_root_and_the_owner_may_and_a_missing_group_lets_nobody_in() -> None:
    rights = Rights(None, None, 60000)
    assert rights.role(ROOT) == Role.OPERATE
    assert rights.role(Peer(9, 60000, frozenset())) == Role.OPERATE
    for peer in (LOOKER, OPERATOR, STRANGER):
        assert rights.role(peer) == Role.NONE


_ASK = """
import json, socket, sys
s = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
s.connect(sys.argv[1])
s.sendall(json.dumps({"method": sys.argv[2]}).encode() + b"\\0")
print(s.recv(1 << 16).rstrip(b"\\0").decode())
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_kernel_says_who_asks(place: Path) -> None:
    """Primary and supplementary groups of real processes count; what they say does not."""

    python = shutil.which("python3", path="/usr/bin:/usr/local/bin")
    if python is None:
        pytest.skip("no Python that every user may start")

    async def yes(_: Peer, __: dict[str, Any]) -> dict[str, Any]:
        return {}

    dispatcher = Dispatcher(
        {"Hold": Method(Role.LOOK, yes), "Start": Method(Role.OPERATE, yes)}, RIGHTS
    )

    def may(name: str, group: int, extra: list[int]) -> bool:
        ran = subprocess.run(
            [python, "-I", "-c", _ASK, str(place / "s"), f"{INTERFACE}.{name}"],
            user=4711,
            group=group,
            extra_groups=extra,
            capture_output=True,
            text=True,
            check=True,
            cwd="/",
        )
        return "error" not in json.loads(ran.stdout)

    with listening(place / "s", dispatcher):
        assert may("Hold", LOOKERS, [])
        assert may("Hold", 4711, [100, LOOKERS])
        assert not may("Start", LOOKERS, [100])
        assert may("Start", 4711, [7, 8, OPERATORS])
        assert not may("Hold", 4711, [])


# ---- too much -----------------------------------------------------------------------------------


async def _echo(_: Peer, given: dict[str, Any]) -> dict[str, Any]:
    return {"size": len(json.dumps(given))}


def echoing(may_begin: Any = lambda: None) -> Dispatcher:
    return Dispatcher(
        {
            "Hold": Method(Role.LOOK, _echo, {"text": (str, None)}),
            "Load": Method(Role.OPERATE, _echo, {"text": (str,)}, large=True, may_begin=may_begin),
        },
        Rights.of_system(),
    )


@pytest.mark.parametrize("turns", range(5))
def test_service_ends_whatever_comes_at_that_moment(place: Path, turns: int) -> None:
    """A request that arrives as its connection is ended must not have it wait for another one."""

    async def end_with_a_request_on_its_way() -> None:
        server = control.ControlServer(place / "s", echoing(), control.ClientLimits(message_s=60.0))
        await server.start()
        with socket.socket(socket.AF_UNIX) as client:
            client.connect(str(place / "s"))
            await asyncio.sleep(0.05)
            client.send(b"{")
            for _ in range(turns):
                await asyncio.sleep(0)
            async with asyncio.timeout(10.0):
                await server.stop()

    asyncio.run(end_with_a_request_on_its_way())


def test_long_request_is_not_taken_apart_where_a_test_has_begun_meanwhile(place: Path) -> None:
    """8 MB keep the thread that gives the sign of life for a while: at rest that does no harm."""
    asked: list[bool] = []

    def may_begin() -> None:
        asked.append(True)
        if len(asked) > 1:
            raise rig_engine.StateError("load", "a test can be loaded only in IDLE", "RUNNING")

    with (
        listening(place / "s", echoing(may_begin)),
        Client(place / "s") as client,
        pytest.raises(Refusal, match="a test can be loaded only in IDLE"),
    ):
        client.call("Load", text="x" * (LOAD_BYTES - 1000))
    assert len(asked) == 2


def raw(path: Path, data: bytes, seconds: float = 10.0) -> bytes:
    """Send bytes; return all that comes until the other end hangs up."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(seconds)
        client.connect(str(path))
        try:
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
        except OSError:
            pass
        parts = []
        try:
            while part := client.recv(65536):
                parts.append(part)
        except OSError:
            pass
        return b"".join(parts)


def test_requests_of_one_connection_are_answered_in_order(place: Path) -> None:
    with listening(place / "s", echoing()):
        messages = [control.encode(call("Hold", text="x" * n)) for n in range(5)]
        replies = raw(place / "s", b"".join(messages)).split(b"\0")
        assert [json.loads(r)["parameters"]["size"] for r in replies[:-1]] == [
            12 + n for n in range(5)
        ]
        with Client(place / "s") as client:
            assert client.call("Hold", text="abc") == {"size": 15}
            assert client.call("Hold") == {"size": 2}


def test_request_of_64_kib_passes_and_a_longer_one_does_not(place: Path) -> None:
    with listening(place / "s", echoing()) as server:
        around = len(control.encode(call("Hold", text=""))) - 1
        for size, passes in ((REQUEST_BYTES, True), (REQUEST_BYTES + 1, False)):
            message = control.encode(call("Hold", text="x" * (size - around)))
            assert len(message) == size + 1
            with Client(place / "s") as client:
                if passes:
                    assert client.call("Hold", text="x" * (size - around))
                    continue
                with pytest.raises(Refusal, match="may be at most 65536 bytes long"):
                    client.call("Hold", text="x" * (size - around))
        assert server.requests == 2


def test_test_of_8_mib_is_taken_and_a_longer_one_ends_the_connection(place: Path) -> None:
    with listening(place / "s", echoing()):
        with Client(place / "s") as client:
            assert client.call("Load", text="x" * (LOAD_BYTES - 1000))["size"] > LOAD_BYTES - 1000
        with Client(place / "s") as client, pytest.raises((Refusal, UnreachableError)):
            client.call("Load", text="x" * (LOAD_BYTES + 70000))
        with Client(place / "s") as client:
            assert client.call("Hold")


def test_long_request_is_refused_before_it_is_read_where_no_test_may_be_loaded(
    place: Path,
) -> None:
    def refuse() -> None:
        raise rig_engine.StateError("load", "a test can be loaded only in IDLE", "RUNNING")

    with listening(place / "s", echoing(refuse)):
        reply = raw(place / "s", b"x" * (2 * REQUEST_BYTES))
    assert b"load is allowed in IDLE" in reply


def test_who_may_not_load_cannot_send_long_requests(place: Path) -> None:
    dispatcher = echoing()
    dispatcher.rights = Rights(os.getegid(), None, -1)
    if os.geteuid() == 0:
        dispatcher.rights = _NoRoot(None, None, -1)
    with listening(place / "s", dispatcher):
        reply = raw(place / "s", b"x" * (2 * REQUEST_BYTES))
    assert b"NotPermitted" in reply
    assert b"rthyb-operator" in reply


class _NoRoot(Rights):
    def role(self, peer: Peer) -> Role:
        return Role.LOOK


def test_slow_writer_and_idle_client_are_hung_up_on(place: Path) -> None:
    with listening(place / "s", echoing(), message_s=0.2, idle_s=0.3):
        for begin in (b"", b'{"method": '):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
                client.settimeout(20.0)
                client.connect(str(place / "s"))
                client.sendall(begin)
                reply = client.recv(4096)
                assert b"the request was not completed in time" in reply
                assert client.recv(4096) == b""
        with Client(place / "s") as client:
            assert client.call("Hold")


def test_reader_that_never_reads_is_hung_up_on_and_hurts_nobody(place: Path) -> None:
    with listening(place / "s", echoing(), answer_s=0.2, per_s=1e9, burst=1e9) as server:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as deaf:
            deaf.settimeout(5.0)
            deaf.connect(str(place / "s"))
            message = control.encode(call("Hold")) * 500
            with pytest.raises(OSError):  # noqa: PT011, a broken pipe or a time-out
                deaf.sendall(message * 200)
            with Client(place / "s") as client:
                assert client.call("Hold")
        end = time.monotonic() + 20.0
        while server.connections and time.monotonic() < end:
            time.sleep(0.01)
        assert server.connections == 0


def by_turns(monkeypatch: pytest.MonkeyPatch, *uids: int) -> None:
    """Have the connections that come next be of these users, in turn."""
    chosen = itertools.cycle(uids)
    monkeypatch.setattr(control, "peer_of", lambda _: Peer(1, next(chosen), frozenset()))
    monkeypatch.setattr(Rights, "role", lambda *_: Role.OPERATE)


def test_who_asks_too_fast_waits_and_others_do_not(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_turns(monkeypatch, 1001, 1002)
    with (
        listening(place / "s", echoing(), per_s=0.1, burst=5.0) as server,
        socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as eager,
    ):
        eager.connect(str(place / "s"))
        eager.sendall(control.encode(call("Hold")) * 300)
        with Client(place / "s") as client:
            assert client.call("Hold")
        # What it may have had by then, and the other's one.
        assert server.requests <= 6 + 1


def test_who_comes_again_and_again_has_no_more_than_who_stays(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    by_turns(monkeypatch, 1001)
    with listening(place / "s", echoing(), per_s=50.0, burst=5.0):
        begun = time.monotonic()
        for _ in range(30):
            with Client(place / "s") as client:
                assert client.call("Hold")
        assert time.monotonic() - begun >= (30 - 5) / 50.0 * 0.95
    with listening(place / "s", echoing(), per_s=0.01, burst=40.0):
        begun = time.monotonic()
        for _ in range(30):
            with Client(place / "s") as client:
                assert client.call("Hold")
        # And no less: one that hangs up has asked for no more.
        assert time.monotonic() - begun < 50.0


def test_credit_of_a_user_is_bounded_and_so_are_the_users() -> None:
    credits = control._Credits(control.ClientLimits(per_s=50.0, burst=10.0))
    for _ in range(10_000):
        waits_s = credits.take(7)
    assert waits_s <= 64 / 50.0
    for uid in range(10_000):
        assert credits.take(100_000 + uid) == 0.0
    assert len(credits._left) <= 256


def test_sixty_clients_are_served_at_once(place: Path) -> None:
    with listening(place / "s", echoing()) as server:
        clients = [Client(place / "s") for _ in range(60)]
        try:
            for client in clients:
                assert client.call("Hold") == {"size": 2}
            assert server.connections == 60
        finally:
            for client in clients:
                client.close()


def test_strangers_cannot_take_the_places_of_others(place: Path) -> None:
    dispatcher = echoing()
    dispatcher.rights = _Changing(None, None, -1)
    dispatcher.rights.now = Role.NONE
    with listening(place / "s", dispatcher, strangers=3) as server:
        strangers = []
        for _ in range(6):
            stranger = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            stranger.connect(str(place / "s"))
            strangers.append(stranger)
        end = time.monotonic() + 20.0
        while server.refused_connections < 3 and time.monotonic() < end:
            time.sleep(0.01)
        assert (server.connections, server.refused_connections) == (3, 3)
        _Changing.now = Role.OPERATE
        with Client(place / "s") as client:
            assert client.call("Hold")
        for stranger in strangers:
            stranger.close()


class _Changing(Rights):
    now = Role.NONE

    def role(self, peer: Peer) -> Role:
        return _Changing.now

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(type(self), name, value) if name == "now" else object.__setattr__(self, name, value)


def test_second_service_on_one_socket_is_refused_and_a_dead_one_replaced(place: Path) -> None:
    path = place / "s"
    left_over = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left_over.bind(str(path))
    left_over.close()
    with listening(path, echoing()):
        second = listening(path, echoing())
        with pytest.raises(RthybError, match="another service is already listening here"):
            second.__enter__()
        with Client(path) as client:
            assert client.call("Hold")
    assert not path.exists()


def test_socket_path_that_leads_elsewhere_is_refused_and_nothing_there_removed(
    place: Path,
) -> None:
    left_over = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    left_over.bind(str(place / "other"))
    left_over.close()
    (place / "s").symlink_to(place / "other")
    with pytest.raises(RthybError, match="is a symbolic link; remove it"):
        listening(place / "s", echoing()).__enter__()
    assert (place / "other").is_socket()


def test_no_service_is_exit_4_and_a_refusal_5(place: Path) -> None:
    with pytest.raises(UnreachableError, match="cannot be reached") as caught:
        Client(place / "s")
    assert caught.value.exit_code == 4
    assert Refusal(f"{INTERFACE}.Refused", {"reason": "no"}).exit_code == 5
    assert Refusal(f"{INTERFACE}.BadInput", {"problems": []}).exit_code == 3


# ---- whatever may come --------------------------------------------------------------------------

json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4)
    ),
    max_leaves=12,
)
METHODS = [f"{INTERFACE}.{name}" for name in (*LOOK, *OPERATE)] + [
    f"{SERVICE}.GetInfo",
    f"{SERVICE}.GetInterfaceDescription",
    INTERFACE,
    "",
]
RECORD = ["name", "source", "dt_s", "acceleration_mps2", "details"]
PARAMETERS = ["digest", "token", "now", "test_toml", "record", "interface"]
calls = st.fixed_dictionaries(
    {"method": st.sampled_from(METHODS) | json_values},
    optional={
        "parameters": st.dictionaries(st.sampled_from(PARAMETERS), json_values, max_size=4)
        | json_values,
        "oneway": json_values,
        "more": json_values,
        "upgrade": json_values,
    },
)


@st.composite
def damaged(draw: st.DrawFn) -> bytes:
    """A call with some bytes changed, lost or doubled."""
    data = bytearray(json.dumps(draw(calls)).encode())
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, max(len(data) - 1, 0)))
        data[at : at + draw(st.integers(0, 3))] = draw(st.binary(max_size=3))
    return bytes(data)


messages = st.binary(max_size=200) | damaged() | calls.map(lambda c: json.dumps(c).encode())


@pytest.mark.long
@settings(max_examples=FUZZ, deadline=None, suppress_health_check=list(HealthCheck), database=None)
@given(message=messages, peer=st.sampled_from([STRANGER, LOOKER, OPERATOR]))
def test_whatever_comes_is_answered_and_moves_nothing(
    real: daemon.Daemon, message: bytes, peer: Peer
) -> None:
    reply = ask(real.dispatcher, message, peer)
    if reply is not None:
        assert reply.keys() in ({"parameters"}, {"error", "parameters"})
        control.encode(reply)
        fault = reply["parameters"].get("reason", "") if "error" in reply else ""
        assert "internal error" not in fault
        if peer == STRANGER and "error" not in reply:
            assert reply["parameters"].keys() & {"vendor", "description"}
    assert real.engine.state in ("IDLE", "TRIPPED")
    if peer != OPERATOR:
        assert real.engine.loaded is None
    if real.engine.state == "TRIPPED":
        real.engine.command("reset")


@settings(
    max_examples=max(FUZZ // 10, 1),
    deadline=None,
    suppress_health_check=list(HealthCheck),
    database=None,
)
@given(record=st.dictionaries(st.sampled_from(RECORD), json_values))
def test_record_of_any_shape_is_taken_or_named(record: dict[str, Any]) -> None:
    try:
        motion = daemon._record(json.loads(json.dumps(record)))
    except (InputError, control.ReplyError):
        return
    assert motion.acceleration_mps2.size


@pytest.mark.parametrize(
    ("change", "wanted"),
    [
        ({"dt_s": 10.0, "acceleration_mps2": [0.1] * 361}, "at most .* 3600 s are accepted"),
        ({"acceleration_mps2": [0.0] * 2_000_001}, "at most 2000000 points"),
        ({"name": "a\nb"}, r"record\.name.*U\+000A"),
        ({"name": "a\x1b[31m"}, r"record\.name.*U\+001B"),
        ({"source": "\u202e"}, r"record\.source.*U\+202E"),
        ({"details": {"format": "a\0"}}, r"record\.details.*U\+0000"),
        ({"details": {"\ud800": "x"}}, r"record\.details.*U\+D800"),
        ({"details": {str(n): "" for n in range(101)}}, "at most 100 entries are accepted"),
        ({"details": {"notes": "x" * 100_000}}, "100000 characters in total"),
    ],
)
def test_record_that_no_file_has_is_refused_as_it_comes(
    change: dict[str, Any], wanted: str
) -> None:
    """Not in the tick thread's neighbourhood, nor as a fault of the program when it is zeroed."""
    good = {"name": "a", "source": "b", "dt_s": 0.001, "acceleration_mps2": [0.1], "details": {}}
    daemon._record(good | {"details": {"warnings": "one\ntwo\t½ 加速度\u3000"}})
    with pytest.raises(InputError, match=wanted):
        daemon._record(good | change)


def test_record_comes_back_as_it_was_to_the_last_bit() -> None:
    motion = experiment.load_motion(short_test())
    back = daemon._record(json.loads(control.encode(daemon.record_of(motion))[:-1]))
    assert back.acceleration_mps2.tobytes() == motion.acceleration_mps2.tobytes()
    assert (back.name, back.source, back.dt_s) == (motion.name, motion.source, motion.dt_s)
    assert dict(back.details) == dict(motion.details)


WRONG: list[bytes] = [
    b"",
    b"null",
    b"[" * 40_000,
    b'{"a":' * 9_000,
    b'{"method": "org.rthyb.Control.Stop", "parameters": {"now": "yes"}}',
    b'{"method": "org.rthyb.Control.Start", "parameters": {"token": "' + b"0" * 32 + b'"}}',
    b'{"method": "org.rthyb.Control.Arm", "parameters": {"digest": 1e999}}',
    b'{"method": "org.rthyb.Control.Load", "parameters": {"test_toml": "", "record": {}}}',
    b'{"method": "org.rthyb.Control.Load", "parameters": {"test_toml": "a = [", "record": []}}',
    b'{"method": "org.rthyb.Control.Zero", "parameters": null, "upgrade": true}',
    b'{"method": "org.rthyb.Control.Jump", "parameters": {}, "more": 1}',
    b'{"method": "\\ud800", "parameters": {"\\u0000": -0.0}}',
]


def made_wrong(chance: random.Random) -> tuple[bytes, bool]:
    """Return what is no request that anybody may be granted, and whether it is too long."""
    kind = chance.randrange(6)
    if kind == 0:
        # Not one that is empty by chance: a NUL ends a request.
        return bytes(
            chance.randrange(1, 256) for _ in range(chance.randrange(1, 300))
        ) + b"\0", False
    if kind == 1:
        return chance.choice(WRONG) + b"\0", False
    if kind == 2 and chance.randrange(4) == 0:
        begin = b'{"method":"org.rthyb.Control.Stop","parameters":{"now":"'
        ends = b"\0" if chance.randrange(2) else b""
        return begin + b"x" * chance.randrange(REQUEST_BYTES, 3 * REQUEST_BYTES) + ends, True
    name = chance.choice((*LOOK, *OPERATE))
    data = bytearray(control.encode(call(name, token="t" * 32, digest="d" * 64, now=None)))
    for _ in range(chance.randrange(1, 5)):
        at = chance.randrange(len(data))
        data[at : at + chance.randrange(4)] = chance.randbytes(chance.randrange(4))
    return bytes(data) + b"\0", False


def told_wrong(path: Path, data: bytes, torn: bool) -> list[bytes]:
    """Send it on a connection of its own; return the answers. Torn: hang up without a look."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(30.0)
        client.connect(str(path))
        said = b""
        with contextlib.suppress(ConnectionError):
            client.sendall(data)
            if torn:
                return []
            client.shutdown(socket.SHUT_WR)
        with contextlib.suppress(ConnectionError):
            while part := client.recv(1 << 16):
                said += part
    return said.split(b"\0")[:-1]


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def test_service_lives_through_any_number_of_malformed_and_oversized_requests(place: Path) -> None:
    """Of somebody who may do everything, at the socket itself: nothing comes of any."""
    chance = random.Random(17)
    limits = control.ClientLimits(per_s=1e9, burst=1e9)
    refused: Counter[str] = Counter()
    long = torn = 0
    begun_mb, descriptors = 0.0, 0
    with served(place, limits=limits) as made:
        path = made.options.socket
        for number in range(FUZZ):
            if number == FUZZ // 4:
                begun_mb, descriptors = resident_mb(), len(os.listdir("/proc/self/fd"))
            data, too_long = made_wrong(chance)
            hangs_up = chance.randrange(8) == 0
            long, torn = long + too_long, torn + hangs_up
            for answer in told_wrong(path, data, hangs_up):
                reply = json.loads(answer)
                if "error" not in reply:
                    # Damage that leaves a question as it was gets its answer.
                    assert reply["parameters"].keys() <= {"status", "name", "rig_toml", "text"}
                    refused["answered"] += 1
                    continue
                assert "internal error" not in str(reply["parameters"].get("reason", ""))
                refused[reply["error"].rpartition(".")[2]] += 1
        with Client(path) as client:
            found = client.call("GetStatus")["status"]
        assert (found["state"], found["test"], found["run_id"]) == ("IDLE", None, "")
        until(lambda: made._server is not None and made._server.connections == 0, "nobody")
        assert len(os.listdir("/proc/self/fd")) <= descriptors + 2
        grown_mb = resident_mb() - begun_mb
        assert grown_mb < 8.0
    told = ", ".join(f"{name} {count}" for name, count in sorted(refused.items()))
    print(f"{FUZZ} requests, {long} oversized, {torn} torn: {told}; {grown_mb:+.1f} MB")


def test_socket_lives_through_a_thousand_scraps(place: Path) -> None:
    """Bytes cut anywhere, connections dropped in the middle."""
    rng = random.Random(3)
    whole = control.encode(call("Hold", text="y" * 50))
    with listening(place / "s", echoing(), per_s=1e9, burst=1e9) as server:
        for n in range(300):
            data = bytearray(whole * rng.randint(1, 4))
            for _ in range(rng.randint(0, 6)):
                data[rng.randrange(len(data))] = rng.randrange(256)
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
                client.connect(str(place / "s"))
                client.sendall(data[: rng.randint(1, len(data))])
                if n % 3 == 0:
                    client.shutdown(socket.SHUT_WR)
                    client.settimeout(10.0)
                    while client.recv(65536):
                        pass
        with Client(place / "s") as client:
            assert client.call("Hold")
        end = time.monotonic() + 20.0
        while server.connections and time.monotonic() < end:
            time.sleep(0.01)
        assert server.connections == 0
        assert len(server._tasks) == 0
