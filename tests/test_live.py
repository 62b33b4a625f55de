"""The live view: who is let in, what is drawn, what its buttons may do."""

from __future__ import annotations

import http.client
import json
import re
import socket
import stat
import struct
import threading
import time
from collections import deque
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from live_process import load
from realtime_bench import Bench, process, until
from recording_data import FS_HZ
from service_bench import await_state, served
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect
from websockets.sync.client import connect
from websockets.typing import Origin

from rthyb_rt import config, core
from rthyb_rt.core import FLAGS, RUNNING, STATES
from rthyb_rt.errors import InputError, RthybError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.live import app as live_app
from rthyb_rt.live import guard
from rthyb_rt.live import server as live_server
from rthyb_rt.live.app import make_app
from rthyb_rt.live.frames import ANEW, HEADER, MORE, OUTLINE, Framer, view_of
from rthyb_rt.live.guard import Tokens
from rthyb_rt.live.server import LiveServer
from rthyb_rt.live.shown_rows import CHANNELS, History, Tally, channels, columns, loop_points
from rthyb_rt.live.sources import LiveSource, PastSource, open_source
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import OtherVersionError, Ring
from rthyb_rt.service.control import Client
from rthyb_rt.service.peers import Peer, Role

pytestmark = pytest.mark.alone

TRIPPED = STATES.index("TRIPPED")
TOKENS = Tokens("look-" + "l" * 27, "operate-" + "o" * 24)
HOST = "127.0.0.1:8717"
ORIGIN = {"origin": f"http://{HOST}"}


# ---- what is drawn ------------------------------------------------------------------------------


def plain_columns(
    at: np.ndarray, values: np.ndarray, first: int, count: int, ticks: int
) -> np.ndarray:
    """The same, one column after the other."""
    out = np.full((len(values), count, 2), np.nan, dtype=np.float32)
    for column in range(count):
        begin = (first + column) * ticks
        inside = values[:, (at >= begin) & (at < begin + ticks)]
        for k, row in enumerate(inside):
            good = row[~np.isnan(row)]
            if good.size:
                out[k, column] = good.min(), good.max()
    return out


@pytest.mark.parametrize("ticks", [1, 3, 10, 64])
def test_columns_have_the_extremes_of_their_rows_and_nothing_where_rows_miss(ticks: int) -> None:
    chance = np.random.default_rng(ticks)
    at = np.flatnonzero(chance.random(2000) > 0.3) - 200
    at = at[(at < 400) | (at > 700)]
    values = chance.standard_normal((3, at.size)).astype(np.float32)
    values[chance.random(values.shape) < 0.2] = np.nan
    values[1, 100:400] = np.nan
    first = int(at[0]) // ticks
    count = int(at[-1]) // ticks - first + 1
    found = columns(at, values, first, count, ticks)
    np.testing.assert_array_equal(found, plain_columns(at, values, first, count, ticks))
    assert np.isnan(found).any()


def test_a_peak_of_one_sample_is_seen_at_any_width() -> None:
    values = np.zeros((1, 65536), dtype=np.float32)
    values[0, 40007] = 7.0
    for ticks in (1, 7, 64, 4096):
        count = -(-65536 // ticks)
        found = columns(np.arange(65536), values, 0, count, ticks)
        assert found[0, 40007 // ticks, 1] == 7.0
        assert np.nanmax(np.delete(found[0], 40007 // ticks, axis=0), initial=0.0) == 0.0


def test_loop_keeps_its_shape_and_stays_small() -> None:
    at = np.arange(20000)
    phase = 2.0 * np.pi * at / 512.0
    values = np.zeros((len(CHANNELS), at.size), dtype=np.float32)
    values[2], values[4] = 5.0 * np.sin(phase), 3.0 * np.sin(phase + 0.3)
    values[4, 500] = np.nan
    found = loop_points(at, values, 100, 20000)
    assert 100 < len(found) < 18000
    # Each point that was left out lies within a pixel of the one that was kept before it.
    kept = found[:, 0].astype(int)
    last = kept[np.searchsorted(kept, at, side="right") - 1]
    assert np.abs(np.delete(values[2] - values[2, last], 500)).max() <= 10.0 / 100.0 * 1.01
    assert 500 not in kept
    assert len(loop_points(at, values, 10**6, 300)) <= 300
    assert loop_points(at[:0], values[:, :0], 200, 6000).size == 0


def rows(first: int, count: int, state: int = RUNNING) -> np.ndarray:
    tick = np.arange(first, first + count)
    made = np.zeros(count, core.RECORD_DTYPE)
    made["tick"], made["state"], made["flags"] = tick, state, FLAGS["fresh"]
    made["x_num_m"] = 5e-3 * np.sin(0.02 * tick)
    made["x_meas_m"] = 4e-3 * np.sin(0.02 * tick)
    made["f_meas_n"] = 2e3 * np.cos(0.02 * tick)
    made["wake_late_ns"] = 1000 * (1 + tick % 50)
    return made


def test_channels_have_the_units_of_their_names_and_no_infinity() -> None:
    made = rows(7, 2)
    made["f_meas_n"][1], made["alpha"][1] = 1e300, np.nan
    found = dict(zip([c.name for c in CHANNELS], channels(made), strict=True))
    assert found["x_meas_mm"][0] == pytest.approx(4.0 * np.sin(0.14))
    assert found["tracking_mm"][0] == pytest.approx(-np.sin(0.14))
    assert found["force_kn"][0] == pytest.approx(2.0 * np.cos(0.14))
    assert np.isnan(found["force_kn"][1])
    assert np.isnan(found["alpha"][1])


def test_history_keeps_the_newest_rows_however_they_come() -> None:
    history, made = History(1000), channels(rows(0, 10000))
    states = np.zeros(10000, dtype=np.uint8)
    done, chance = 0, np.random.default_rng(1)
    while done < 10000:
        end = min(10000, done + int(chance.integers(1, 1700)))
        history.append(np.arange(done, end), made[:, done:end], states[done:end])
        done = end
    assert history.last == 9999
    at, values, _ = history.rows(9000, 10000)
    np.testing.assert_array_equal(at, np.arange(9000, 10000))
    np.testing.assert_array_equal(values, made[:, 9000:])
    assert history.size <= 2000
    with pytest.raises(ValueError, match="positions must increase"):
        history.append(np.array([9999]), made[:, :1], states[:1])


class Screen:
    """What a page makes of its frames."""

    def __init__(self) -> None:
        self.kinds: list[int] = []
        self.columns: dict[int, np.ndarray] = {}
        self.loop: dict[float, tuple[float, float]] = {}

    def take(self, frame: bytes) -> tuple[Any, ...]:
        magic, kind, state, count, wide, *rest = HEADER.unpack_from(frame)
        ticks, points, _, first, at, zero, oldest, newest = rest
        assert (magic, count) == (b"RLV1", len(CHANNELS))
        body = np.frombuffer(frame, np.float32, offset=HEADER.size)
        assert body.size == count + 2 * count * wide + 3 * points
        extremes = body[count : count * (1 + 2 * wide)].reshape(count, wide, 2)
        self.kinds.append(kind)
        if kind != MORE:
            self.columns, self.loop = {}, {}
        self.columns |= {int(first) + i: extremes[:, i] for i in range(wide)}
        for position, x, f in body[count * (1 + 2 * wide) :].reshape(points, 3):
            self.loop[first * ticks + position] = (x, f)
        return kind, state, ticks, at, zero, oldest, newest, body[:count]


def test_frames_that_come_bit_by_bit_make_the_picture_of_all_rows() -> None:
    history, screen = History(8192), Screen()
    framer = Framer(history, FS_HZ)
    made, chance = rows(0, 6000), np.random.default_rng(2)
    framer.show({"follow": True, "seconds": 4.0, "columns": 500})
    done = 0
    while done < 6000:
        end = min(6000, done + int(chance.integers(1, 90)))
        part = made[done:end]
        history.append(np.arange(done, end), channels(part), part["state"])
        for frame in framer.next(0):
            found = screen.take(frame)
        done = end
    assert framer.next(0) == []
    assert screen.kinds[0] == ANEW
    assert set(screen.kinds[1:]) == {MORE}
    _, state, ticks, at, _, oldest, newest, values = found
    assert (state, ticks, at, oldest, newest) == (RUNNING, 9, 5999, 0, 5999)
    np.testing.assert_array_equal(values, channels(made[-1:])[:, 0])
    first = (6000 - 4096) // 9 + 1
    count = 5999 // 9 - first + 1
    wanted = plain_columns(np.arange(6000), channels(made), first, count, 9)
    shown = np.stack([screen.columns[first + i] for i in range(count)], axis=1)
    np.testing.assert_array_equal(shown, wanted)
    positions = [p for p in screen.loop if p >= first * 9]
    assert len(positions) > 1500
    for position in positions:
        x, f = screen.loop[position]
        assert (x, f) == tuple(channels(made[int(position) : int(position) + 1])[[2, 4], 0])


def test_page_that_fell_behind_gets_the_whole_picture_anew() -> None:
    history, screen = History(8192), Screen()
    framer = Framer(history, FS_HZ)
    framer.show({"follow": True, "seconds": 1.0, "columns": 64})
    for first in (0, 5000):
        made = rows(first, 100)
        history.append(np.arange(first, first + 100), channels(made), made["state"])
        for frame in framer.next(0):
            screen.take(frame)
    assert screen.kinds == [ANEW, ANEW]
    assert np.isnan(screen.columns[(5000 - 500) // 16]).all()


def test_outline_has_the_whole_test_and_comes_once() -> None:
    history, screen = History(5000), Screen()
    made = rows(0, 5000)
    history.append(np.arange(5000), channels(made), made["state"])
    framer = Framer(history, FS_HZ)
    framer.show({"first": 1000, "last": 1200, "columns": 400, "outline": True})
    part, outline = framer.next(1024)
    assert screen.take(part)[4:7] == (1024, 0, 4999)
    assert sorted(screen.columns) == list(range(1000, 1200))
    assert screen.take(outline)[0] == OUTLINE
    assert max(c[2].max() for c in screen.columns.values()) == channels(made)[2].max()
    assert framer.next(1024) == []


@pytest.mark.parametrize(
    "asked",
    [
        None,
        [],
        {},
        {"follow": True, "seconds": 10, "columns": 1e9},
        {"follow": True, "seconds": 1e9, "columns": 100},
        {"follow": True, "seconds": "10", "columns": 100},
        {"follow": True, "seconds": True, "columns": 100},
        {"first": 0, "last": 0, "columns": 100},
        {"first": 0, "last": 1e12, "columns": 100},
        {"first": float("nan"), "last": 10, "columns": 100},
        {"first": float("-inf"), "last": float("inf"), "columns": 100},
    ],
)
def test_view_that_is_none_is_refused(asked: Any) -> None:
    with pytest.raises(ValueError, match=r"view|must be from"):
        view_of(asked, FS_HZ)


def test_histogram_has_each_waking_and_no_tick_that_nobody_woke_for() -> None:
    made, tally = rows(0, 5000), Tally()
    made["wake_late_ns"] = np.random.default_rng(3).lognormal(9.5, 1.0, 5000)
    made["flags"][100:120] |= FLAGS["blind"]
    made["flags"][7] |= FLAGS["lost"] | FLAGS["predicted"]
    made["wake_late_ns"][110] = 2**31 - 1
    # After a trip nothing is sent, which is no fault.
    made["state"][4000:], made["flags"][4000:] = TRIPPED, FLAGS["not_sent"]
    for part in np.split(made, [1, 100, 3000]):
        tally.add(part)
    late_us = np.delete(made["wake_late_ns"], np.arange(100, 120)) * 1e-3
    wanted, _ = np.histogram(np.clip(late_us, 1.0, 1e5), Tally.EDGES_US)
    np.testing.assert_array_equal(tally.counts, wanted)
    assert (tally.rows, tally.skipped) == (5000, 20)
    assert tally.flags == {"lost": 1, "predicted": 1, "slip": 0, "limited": 0, "not_sent": 0}
    for percent in (50, 99):
        exact = np.percentile(late_us, percent)
        assert exact / 1.02 <= tally.percentile_us(percent) <= exact * 10 ** (1 / 12) * 1.02
    assert Tally().percentile_us(99) == 0.0


# ---- who is let in ------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rec() -> RecordedTest:
    """A short test of the past."""
    test = config.load_test(config.builtin_test_path(), {"test.duration_s": "4"})
    return virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))


@contextmanager
def opened(source: Any) -> Iterator[TestClient]:
    application = make_app(source, TOKENS)
    with TestClient(application, base_url=f"http://{HOST}") as client:
        yield client
    source.close()


@pytest.fixture(scope="module")
def past(rec: RecordedTest) -> Iterator[TestClient]:
    with opened(PastSource(rec)) as client:
        yield client


def test_every_file_of_the_page_comes_with_its_headers(past: TestClient) -> None:
    for path in live_app.FILES:
        for token in (TOKENS.look, TOKENS.operate):
            answer = past.get(f"/{token}{path}")
            assert answer.status_code == 200, path
            for name, value in guard.HEADERS:
                assert answer.headers[name.decode()] == value.decode()
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'self';")
    assert "unsafe" not in policy


def test_page_has_no_inline_script_or_style_and_names_nothing_elsewhere() -> None:
    static = Path(live_app.__file__).parent / "static"
    shipped = {path.name for path in static.iterdir()}
    assert shipped == {name for name, _ in live_app.FILES.values()} | {"uPlot.LICENSE"}
    page = (static / "index.html").read_text()
    assert re.findall(r"<script(?![^>]*\bsrc=)", page) == []
    assert re.findall(r"<style|\sstyle=|\son\w+=", page) == []
    for name in shipped - {"uPlot.LICENSE", "uPlot.iife.min.js"}:
        found = re.findall(r"(?:https?:)?//[\w-]+\.[\w.]+", (static / name).read_text())
        assert [link for link in found if "www.w3.org" not in link] == [], name
    ids = set(re.findall(r'id="([\w-]+)"', page))
    script = (static / "live.js").read_text()
    assert set(re.findall(r'\$\("([\w-]+)"\)', script)) <= ids
    assert "MIT" in (static / "uPlot.LICENSE").read_text()


@pytest.mark.parametrize(
    ("path", "headers"),
    [
        ("/", {}),
        ("/live.js", {}),
        ("/socket", {}),
        (f"/{TOKENS.look[:-1]}/", {}),
        (f"/{TOKENS.look}x/", {}),
        ("//", {}),
        (f"/{TOKENS.look}/", {"host": "rthyb.example:8717"}),
        (f"/{TOKENS.look}/", {"host": "127.0.0.1.example"}),
        (f"/{TOKENS.look}/", {"host": "localhost@example"}),
        (f"/{TOKENS.look}/", {"origin": "http://example"}),
        (f"/{TOKENS.look}/", {"origin": "null"}),
    ],
)
def test_wrong_token_host_or_origin_gets_no_page(
    past: TestClient, path: str, headers: dict[str, str]
) -> None:
    answer = past.get(path, headers=headers)
    assert answer.status_code == 403
    assert TOKENS.look not in answer.text
    assert "content-security-policy" in answer.headers


def test_there_is_no_operators_page_unless_it_was_asked_for() -> None:
    assert Tokens("a" * 32).opens("") is None
    assert Tokens("a" * 32).opens("a" * 32) == guard.Pass.LOOK
    assert Tokens("a" * 32, "b" * 32).opens("b" * 32) == guard.Pass.OPERATE
    assert Tokens().look != Tokens().look
    assert len(Tokens().look) >= 32


@pytest.mark.parametrize(
    ("token", "headers"),
    [
        ("x" * 32, ORIGIN),
        (TOKENS.look, {}),
        (TOKENS.look, {"origin": "http://127.0.0.1:9999"}),
        (TOKENS.look, {"origin": f"https://{HOST}"}),
        (TOKENS.look, {"origin": "null"}),
        (TOKENS.look, {"origin": "http://rebound.example", "host": "rebound.example"}),
    ],
)
def test_socket_is_refused_before_it_is_open(
    past: TestClient, token: str, headers: dict[str, str]
) -> None:
    with (
        pytest.raises(WebSocketDisconnect) as caught,
        past.websocket_connect(f"/{token}/socket", headers={"host": HOST, **headers}),
    ):
        pass
    assert caught.value.code == guard.POLICY_VIOLATION


def socket_of(client: TestClient, token: str = TOKENS.look, host: str = HOST) -> Any:
    headers = {"host": host, "origin": f"http://{host}"}
    return client.websocket_connect(f"/{token}/socket", headers=headers)


def test_forwarded_port_is_let_in(past: TestClient) -> None:
    for host in ("localhost:9000", "127.0.0.1:80", "[::1]:8717", "localhost"):
        with socket_of(past, host=host) as socket:
            assert socket.receive_json()["kind"] == "hello"


@pytest.mark.parametrize(
    "said", ["", "{", "[]", "{}", '{"view": 1}', '{"command": 3}', "[" * 3000, '{"other": 1}']
)
def test_page_that_talks_nonsense_is_cut_off_and_the_others_are_not(
    past: TestClient, said: str
) -> None:
    with socket_of(past) as good:
        with socket_of(past) as socket:
            socket.send_text(said)
            with pytest.raises(WebSocketDisconnect) as caught:
                next_frame(socket)
            assert caught.value.code == 1003
        good.send_json({"view": {"first": 0, "last": 100, "columns": 64}})
        assert next_frame(good)[:4] == b"RLV1"


def next_frame(socket: Any) -> bytes:
    while True:
        message = socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect(message["code"])
        if message.get("bytes") is not None:
            return bytes(message["bytes"])


def told(socket: Any, kind: str) -> dict[str, Any]:
    """Return the next text of a kind."""
    while True:
        message = socket.receive()
        if message.get("text") is not None:
            found: dict[str, Any] = json.loads(message["text"])
            if found["kind"] == kind:
                return found


def test_one_page_too_many_is_told_to_come_again(past: TestClient) -> None:
    from contextlib import ExitStack

    with ExitStack() as stack:
        for _ in range(live_app.PAGES):
            stack.enter_context(socket_of(past))
        with pytest.raises(WebSocketDisconnect) as caught, socket_of(past):
            pass
        assert caught.value.code == 1013


def test_page_that_was_open_before_a_drive_of_another_rate_begins_anew(rec: RecordedTest) -> None:
    """Opened while nothing runs, it cannot know the rate: a second is as many rows as it has."""
    source = PastSource(rec)
    with opened(source) as client, socket_of(client) as socket:
        assert socket.receive_json()["fs_hz"] == 1024.0
        source.fs_hz = 256.0
        assert told(socket, "hello")["fs_hz"] == 256.0
        socket.send_json({"view": {"follow": True, "seconds": 2, "columns": 512}})
        screen = Screen()
        screen.take(next_frame(socket))
        assert len(screen.columns) == 512


# ---- a test of the past -------------------------------------------------------------------------


def test_recording_is_shown_at_its_own_time_with_its_end(
    rec: RecordedTest, past: TestClient
) -> None:
    with socket_of(past) as socket:
        hello = socket.receive_json()
        assert (hello["past"], hello["commands"], hello["operator"]) == (True, [], False)
        assert (hello["first"], hello["last"]) == (0, rec.samples.size - 1)
        status = told(socket, "status")
        assert (status["mode"], status["end_reason"]) == ("past", "completed")
        # Virtual time has no jitter.
        assert sum(status["wake"]["counts"]) == 0
        assert status["counters"][0] == {
            "label": "Ticks",
            "value": str(rec.samples.size),
            "alarm": False,
        }
        socket.send_json({"view": {"first": 500, "last": 1500, "columns": 1000}})
        screen = Screen()
        kind, state, ticks, at, zero, *_ = screen.take(next_frame(socket))
        assert (kind, state, ticks, at) == (ANEW, rec.samples["state"][1499], 1, 1499)
        assert zero == int(np.argmax(rec.running()))
        shown = np.array([screen.columns[i][2, 0] for i in range(500, 1500)])
        np.testing.assert_array_equal(shown, channels(rec.samples)[2, 500:1500])


def test_recording_without_rows_and_recordings_with_odd_ticks(rec: RecordedTest) -> None:
    from dataclasses import replace

    with pytest.raises(InputError, match="no row"):
        PastSource(replace(rec, samples=rec.samples[:0]))
    odd = rec.samples.copy()
    odd["tick"][1000:] = 5
    assert PastSource(replace(rec, samples=odd)).history.last == odd.size - 1
    far = rec.samples.copy()
    far["tick"][-1] = np.uint64(2**63)
    assert PastSource(replace(rec, samples=far)).history.last == far.size - 1


# ---- a ring -------------------------------------------------------------------------------------


@pytest.fixture
def memory() -> Iterator[Path]:
    place = Path("/dev/shm")
    with TemporaryDirectory(dir=place if place.is_dir() else None) as folder:
        yield Path(folder)


def test_view_goes_from_ring_to_ring_and_time_begins_with_each_test(
    memory: Path, rec: RecordedTest
) -> None:
    first = Ring.create(memory, rec, 4096)
    first.push(rows(0, 1000, STATES.index("ZEROED")))
    first.push(rows(1000, 500))
    source = LiveSource(memory, None)
    source.poll()
    assert (source.history.last, source.zero) == (1499, 1000)
    second = Ring.create(memory, rec, 4096)
    second.push(rows(0, 300, STATES.index("ARMED")))
    second.push(rows(300, 200))
    # What was still in the first one comes before it.
    first.push(rows(1500, 10))
    source.look()
    source.poll()
    assert (source.history.last, source.zero) == (1510 + 499, 1510 + 300)
    status = source.status()
    assert (status["state"], status["mode"], status["ended"]) == ("RUNNING", "ring", False)
    assert status["counters"][0]["value"] == "500"
    assert status["role"] == ""
    second.close()
    status = source.status()
    assert (status["ended"], status["end_reason"]) == (True, "the test is over")
    source.close()
    first.remove()
    second.remove()


def test_ring_of_a_test_that_runs_comes_before_a_newer_one_that_was_left_behind(
    memory: Path, rec: RecordedTest
) -> None:
    running = Ring.create(memory, rec, 1024)
    left = Ring.create(memory, rec, 1024)
    left.push(rows(0, 10))
    left.close()
    assert LiveSource(memory, None)._wanted == running.path
    running.close()
    assert LiveSource(memory, None)._wanted == left.path


@pytest.mark.parametrize("place", ["folder", "file"])
def test_next_test_is_shown_though_its_ring_has_the_name_of_the_one_before(
    memory: Path, rec: RecordedTest, place: str
) -> None:
    first = Ring.create(memory, rec, 4096)
    first.push(rows(0, 500))
    source = LiveSource(memory if place == "folder" else first.path, None)
    source.poll()
    first.remove()
    source.look()
    source.poll()
    # Until another one is there, the test that has ended is.
    assert (source.history.last, source.status()["end_reason"]) == (499, "the test is over")
    second = Ring.create(memory, rec, 4096)
    assert second.path == first.path
    second.push(rows(0, 700))
    for _ in range(3):
        source.look()
        source.poll()
    status = source.status()
    assert (source.history.last, source.zero) == (499 + 700, 500)
    assert (status["state"], status["ended"], status["end_reason"]) == ("RUNNING", False, "")
    assert status["counters"][0]["value"] == "700"
    second.push(rows(700, 10))
    source.poll()
    assert source.history.last == 499 + 710
    source.close()
    second.remove()


def test_rows_that_stop_coming_are_told_unless_none_is_due(
    memory: Path, rec: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr("rthyb_rt.live.sources.time.monotonic", lambda: now[0])
    ring = Ring.create(memory, rec, 4096)
    source = LiveSource(ring.path, None)

    def told(after_s: float) -> tuple[bool, float]:
        now[0] += after_s
        source.poll()
        status = source.status()
        return status["flows"], status["still_s"]

    # Its process has not come to a first tick.
    assert told(5.0) == (True, 0.0)
    ring.push(rows(0, 500))
    assert told(5.0) == (True, 0.0)
    assert told(0.5) == (True, 0.5)
    assert told(2.5) == (False, 3.0)
    ring.push(rows(500, 500))
    # A view that stalled itself has not looked yet.
    now[0] += 5.0
    assert source.status()["still_s"] == 3.0
    assert told(0.0) == (True, 0.0)
    ring.push(rows(1000, 1100, TRIPPED))
    assert told(1.0) == (True, 0.0)
    # A ring stands still after a trip.
    assert told(60.0) == (True, 0.0)
    ring.push(rows(2100, 10))
    assert told(0.1) == (True, 0.0)
    assert told(2.0) == (False, 2.0)
    ring.close()
    assert told(60.0) == (True, 0.0)
    source.close()


def test_ring_that_lapped_the_view_leaves_a_gap(memory: Path, rec: RecordedTest) -> None:
    ring = Ring.create(memory, rec, 1024)
    ring.push(rows(0, 100))
    source = LiveSource(ring.path, None)
    source.poll()
    ring.push(rows(100, 3000))
    source.poll()
    at, _, _ = source.history.rows(0, 10**6)
    assert at[99] == 99
    assert at[100] >= 3100 - 1024
    assert source.history.last == 3099
    source.close()
    ring.remove()


def test_ring_of_a_trip_says_its_first_cause_without_a_service(memory: Path) -> None:
    """No row names the limit: a station that runs through the rows finds it again."""
    rec = Bench({"limits.force_n": "600", "test.duration_s": "3"}).run()
    assert rec.meta["end_reason"] == "tripped: force limit"
    ring = Ring.create(memory, rec)
    ring.push(rec.samples)
    source = LiveSource(ring.path, None)
    source.poll()
    assert source.status()["cause"] == ""
    source.look()
    status = source.status()
    assert (status["state"], status["cause"]) == ("TRIPPED", "force 0.604 kN (limit 0.6 kN)")
    ring.remove()
    # The ring of the next test may have its name.
    following = Ring.create(memory, rec)
    assert following.path == ring.path
    following.push(rows(0, 100))
    source.look()
    source.poll()
    status = source.status()
    assert (status["state"], status["cause"]) == ("RUNNING", "")
    source.close()
    following.remove()


def test_what_a_user_means_is_found_or_he_is_told(
    memory: Path, rec: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rthyb_rt.record.ring.default_folder", lambda: memory)
    nowhere = memory / "control.sock"
    with pytest.raises(InputError, match=r"no service answers .* no ring"):
        open_source(None, nowhere)
    with pytest.raises(InputError, match=r"no recording\.h5"):
        open_source(memory, nowhere)
    with pytest.raises(InputError, match="does not exist"):
        open_source(memory / "gone.h5", nowhere)
    recording.write(memory / "recording.h5", rec)
    assert open_source(memory, nowhere).past
    ring = Ring.create(memory, rec, 1024)
    for where in (None, memory, ring.path):
        found = open_source(where, nowhere)
        found.poll()
        assert (found.past, found.socket) == (False, None)
        found.close()
    ring.remove()
    assert open_source(nowhere, nowhere).socket == nowhere


# ---- a service ----------------------------------------------------------------------------------


class Everybody:
    """Rights that are the same for everybody: the kernel cannot be asked to lie in a test."""

    def __init__(self, role: Role) -> None:
        self._role = role

    def role(self, _: Peer) -> Role:
        return self._role


def give(socket: Any, command: str, **also: str) -> tuple[bool, str]:
    socket.send_json({"command": command, **also})
    answer = told(socket, "answer")
    assert answer["command"] == command
    return answer["ok"], answer["text"]


LONG = {"test.duration_s": "600", "limits.armed_timeout_s": "3600"}


def test_operator_conducts_a_test_and_a_looker_may_only_hold_and_stop(memory: Path) -> None:
    with served(memory) as daemon, opened(open_source(memory, memory)) as client:
        load(memory, LONG)
        with socket_of(client, str(TOKENS.operate)) as operator, socket_of(client) as looker:
            assert looker.receive_json()["commands"] == ["hold", "stop"]
            assert "start" in operator.receive_json()["commands"]
            for command in ("zero", "arm", "start", "resume", "reset"):
                good, text = give(looker, command)
                assert (good, text) == (
                    False,
                    f"{command} needs the operator's address of this page: rthyb live --operator",
                )
            good, text = give(operator, "start")
            assert not good
            assert "ARMED" in text
            assert give(operator, "zero") == (True, "Zeroing")
            await_state(memory, "ZEROED")
            # A page that still shows the test of before arms nothing.
            digest = daemon.status()["test"]["digest"]
            for other in ("", "0" * 64):
                good, text = give(operator, "arm", digest=other)
                assert not good
                assert "check which test is loaded" in text
            assert give(operator, "arm", digest=digest) == (True, "Armed for 3600 s")
            assert give(operator, "start") == (True, "Started")
            await_state(memory, "RUNNING")
            assert give(looker, "hold") == (True, "Held")
            await_state(memory, "HOLD")
            assert give(operator, "resume") == (True, "Resumed")
            looker.send_json({"view": {"follow": True, "seconds": 5, "columns": 500}})
            screen = Screen()
            until(lambda: screen.take(next_frame(looker))[1] == RUNNING, "a frame of the test")
            assert give(looker, "stop") == (True, "Stop sent")
            await_state(memory, "IDLE")
            good, text = give(looker, "fire")
            assert (good, text) == (False, "there is no command 'fire'")
        until(lambda: daemon.engine.last is not None, "the end of the test")
        assert daemon.engine.last is not None
        assert daemon.engine.last["end_reason"] == "stopped by the operator"


@pytest.mark.parametrize("role", [Role.NONE, Role.LOOK])
def test_service_decides_and_its_reason_is_passed_on(memory: Path, role: Role) -> None:
    with served(memory) as daemon:
        load(memory, LONG)
        daemon.dispatcher.rights = Everybody(role)  # type: ignore[assignment]
        with (
            opened(open_source(memory, memory)) as client,
            socket_of(client, str(TOKENS.operate)) as socket,
        ):
            status = told(socket, "status")
            good, text = give(socket, "zero")
            assert not good
            assert text.startswith("Zero requires membership of group rthyb-operator; ")
            good, text = give(socket, "stop")
            if role == Role.LOOK:
                assert good
            else:
                assert text.startswith("Stop requires membership of group rthyb; ")
                assert not status["reachable"]
                assert "GetStatus requires membership of group rthyb" in status["trouble"]
        assert state_of(daemon) == "IDLE"


def state_of(daemon: Any) -> str:
    return str(daemon.engine.state)


def test_trip_stays_on_the_screen_until_somebody_resets_it(memory: Path) -> None:
    with served(memory) as daemon:
        source = open_source(memory, memory)
        digest = load(memory, LONG | {"limits.force_n": "600"})
        with Client(memory / "control.sock") as client:
            client.call("Zero")
            await_state(memory, "ZEROED")
            source.look()
            client.call("Start", token=client.call("Arm", digest=digest)["token"])
            until(lambda: daemon.engine.last is not None, "the end of the test")
            source.poll()
            source.look()
            source.poll()
            status, last = source.status(), source.history.last
            assert status["state"] == "TRIPPED"
            assert re.fullmatch(r"force 0\.6\d+ kN \(limit 0\.6 kN\)", status["cause"])
            assert source.history.rows(last, last + 1)[2][0] == TRIPPED
            ticks = daemon.engine.loop.counts.elapsed
            until(lambda: daemon.engine.loop.counts.elapsed > ticks + 2000, "time to pass")
            source.look()
            source.poll()
            assert source.history.last == last
            assert source.status()["now"] is not None
            client.call("Reset")
            await_state(memory, "IDLE")

            def goes_on() -> bool:
                source.look()
                source.poll()
                return source.history.last > last

            until(goes_on, "rows of the rig at rest")
        source.close()


def test_service_that_is_away_is_waited_for(memory: Path) -> None:
    source = open_source(memory / "control.sock", memory)
    status = source.status()
    assert not status["reachable"]
    assert "cannot be reached" in status["trouble"]
    with served(memory):
        source.look()
        source.poll()
        status = source.status()
        assert (status["reachable"], status["state"], status["role"]) == (True, "IDLE", "operate")
    source.look()
    assert not source.status()["reachable"]
    source.close()


def test_service_that_was_started_anew_fills_the_curves_again(memory: Path) -> None:
    """Its ring at rest has the name of the one before."""
    with served(memory) as daemon:
        source = open_source(memory, memory)
        path = daemon.engine.ring_path

        def comes(after: int) -> bool:
            source.look()
            source.poll()
            return source.history.last > after

        until(lambda: comes(100), "rows of the rig at rest")
    comes(0)
    assert not source.status()["reachable"]
    last = source.history.last
    with served(memory) as daemon:
        assert daemon.engine.ring_path == path
        until(lambda: comes(last + 1000), "rows of the service that was started anew")
        status = source.status()
        assert (status["reachable"], status["flows"], status["state"]) == (True, True, "IDLE")
    source.close()


def test_ring_of_a_service_that_cannot_be_opened_is_told(
    memory: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(path: Path) -> None:
        raise OtherVersionError("the ring has other fields", str(path))

    with served(memory), monkeypatch.context() as patch:
        patch.setattr("rthyb_rt.live.sources.ring.RingReader", refuse)
        source = open_source(memory, memory)

        def told() -> dict[str, Any]:
            source.look()
            source.poll()
            return source.status()

        until(lambda: not told()["flows"], "the word that no row comes")
        status = told()
        assert (status["reachable"], status["state"]) == (True, "IDLE")
        assert status["trouble"].endswith("the ring has other fields")
        patch.undo()
        until(lambda: told()["flows"], "rows")
        assert told()["trouble"] == ""
    source.close()


# ---- the command line ---------------------------------------------------------------------------


def test_live_view_of_a_run_starts_writes_its_address_and_ends_in_order(
    tmp_path: Path, rec: RecordedTest, rthyb: Rthyb
) -> None:
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    recording.write(tmp_path / "recording.h5", rec)
    url_file = tmp_path / "url"
    with process(tmp_path, "live", ".", "--port", "0", "--operator", "--url-file", "url") as made:
        until(url_file.exists, "the address")
        assert stat.S_IMODE(url_file.stat().st_mode) == 0o640
        look, operator = url_file.read_text().splitlines()
        assert look.split("/")[3] != operator.split("/")[3]
        origin = look.rsplit("/", 2)[0]
        address = look.replace("http", "ws") + "socket"
        with connect(address, origin=origin) as socket:
            assert json.loads(socket.recv())["kind"] == "hello"
            socket.send(json.dumps({"view": {"first": 0, "last": 9, "columns": 64}}))
            while not isinstance(frame := socket.recv(), bytes):
                pass
            assert struct.unpack_from("<4s", frame)[0] == b"RLV1"
            # A message as long as no page sends it ends this page, and nothing else.
            socket.send("x" * 100_000)
            with pytest.raises(ConnectionClosed, match="1009"):
                deque(socket, maxlen=0)
        with pytest.raises(InvalidStatus, match="403"):
            connect(address, origin="http://elsewhere")
        taken = rthyb("live", tmp_path, "--port", look.split(":")[2].split("/")[0])
        assert taken.code == 1
        assert "is taken; choose another one with --port" in taken.err
        made.signal(15)
        code, out, err = made.end()
        assert (code, out, err) == (0, "", "")


def test_nothing_to_show_is_an_input_fault(
    tmp_path: Path, rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("RTHYB_SOCKET", str(tmp_path / "control.sock"))
    monkeypatch.setattr("rthyb_rt.record.ring.default_folder", lambda: tmp_path)
    answer = rthyb("live")
    assert answer.code == 3
    assert "start rthyb serve or rthyb run --realtime, or give a recording" in answer.err


def test_without_its_packages_the_command_says_what_to_install(
    rthyb: Rthyb, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("rthyb_rt.cli.live._there", lambda name: name != "uvicorn")
    answer = rthyb("live")
    assert answer.code == 1
    assert "the live view needs uvicorn: pip install 'rthyb-rt[live]'" in answer.err


@contextmanager
def serving(rec: RecordedTest) -> Iterator[LiveServer]:
    """A server at a port, in a thread."""
    ready = threading.Event()
    made = LiveServer(PastSource(rec), TOKENS, ready=ready.set)
    thread = threading.Thread(target=made.run)
    thread.start()
    try:
        assert ready.wait(20.0)
        yield made
    finally:
        made.stop()
        thread.join()


def page(made: LiveServer, token: str = TOKENS.look) -> int:
    """Ask for the page as a browser does; return the status."""
    connection = http.client.HTTPConnection("127.0.0.1", made.port, timeout=20.0)
    try:
        connection.request("GET", f"/{token}/")
        return connection.getresponse().status
    finally:
        connection.close()


def hung_up_on(client: socket.socket) -> bool:
    """Whether the other end hangs up; what it says before is passed over."""
    client.settimeout(20.0)
    try:
        while client.recv(65536):
            pass
    except ConnectionError:
        pass
    except TimeoutError:
        return False
    return True


def test_strangers_who_connect_and_say_nothing_do_not_take_the_page_away(rec: RecordedTest) -> None:
    with serving(rec) as made, ExitStack() as owned:
        idle = [
            owned.enter_context(socket.create_connection(("127.0.0.1", made.port)))
            for _ in range(100)
        ]
        assert page(made) == 200
        assert page(made, "x" * 32) == 403
        assert hung_up_on(idle[0])


@pytest.mark.parametrize(
    "begin",
    [
        b"",
        b"GET / HTTP/1.1\r\nHost: 127.",
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 9\r\n\r\n",
        b"GET /" + TOKENS.look.encode() + b"/ HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\nGET /",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
    ],
    ids=["nothing", "half a head", "no body", "half a second", "turned away"],
)
def test_connection_without_a_whole_request_is_ended(
    rec: RecordedTest, monkeypatch: pytest.MonkeyPatch, begin: bytes
) -> None:
    monkeypatch.setattr(live_server, "_REQUEST_S", 0.3)
    with serving(rec) as made, socket.create_connection(("127.0.0.1", made.port)) as client:
        client.sendall(begin)
        done = threading.Event()

        def drip() -> None:
            # A byte now and then is no request.
            while not done.wait(0.05):
                with suppress(OSError):
                    client.send(b"x")

        dripping = threading.Thread(target=drip)
        dripping.start()
        try:
            assert hung_up_on(client)
        finally:
            done.set()
            dripping.join()


def test_page_that_is_open_is_not_hung_up_on(
    rec: RecordedTest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live_server, "_REQUEST_S", 0.2)
    with serving(rec) as made:
        origin = Origin(f"http://127.0.0.1:{made.port}")
        with connect(f"ws{made.url[4:]}socket", origin=origin) as opened_page:
            time.sleep(0.6)
            opened_page.ping().wait(20.0)
            assert page(made) == 200


def test_page_hears_even_if_there_is_nothing_new(rec: RecordedTest) -> None:
    """A page that hears nothing says that what it shows is old."""
    with serving(rec) as made:
        origin = Origin(f"http://127.0.0.1:{made.port}")
        with connect(f"ws{made.url[4:]}socket", origin=origin) as opened_page:
            for kind in ("hello", "status", "status", "status"):
                assert json.loads(opened_page.recv(timeout=20.0))["kind"] == kind


def test_fault_while_reading_ends_the_server_instead_of_a_page_that_stands_still(
    rec: RecordedTest,
) -> None:
    source = PastSource(rec)

    def broken() -> None:
        raise RthybError("the ring is gone")

    source.poll = broken  # type: ignore[method-assign]
    with pytest.raises(RthybError, match="the ring is gone"):
        LiveServer(source, TOKENS).run()
