"""The live view of several axes: curves of each by its name, causes with their axis, the past."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from service_bench import Bench, await_state, bench, served, status
from test_axes_realtime import AXES, EITHER, LIMITED, faulty
from test_axes_realtime import rig as pair_of
from test_live import Screen, opened, rows, socket_of
from test_service_axes import short_file

from rthyb_rt import config, core
from rthyb_rt.core import loop
from rthyb_rt.lab import experiment
from rthyb_rt.live.frames import Framer, view_of
from rthyb_rt.live.shown_rows import CHANNELS, History, channels
from rthyb_rt.live.sources import LiveSource, PastSource
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring
from rthyb_rt.service.control import Client
from rthyb_rt.service.daemon import record_of

pytestmark = pytest.mark.alone

N = len(CHANNELS)
NAMES = [channel.name for channel in CHANNELS]
MATRIX = np.array([[1.0, 0.0], [1.0, 1.0]])
"""Of the rig's kinematics: axes from directions."""


@pytest.fixture(scope="module")
def tripped() -> RecordedTest:
    """A test that the right axis ends, by its load cell."""
    return faulty(["right.force@1:0.2=2e5"])


@pytest.fixture
def memory() -> Iterator[Path]:
    place = Path("/dev/shm")
    with TemporaryDirectory(dir=place if place.is_dir() else None) as folder:
        yield Path(folder)


def of_axis(values: np.ndarray, axis: int, name: str) -> np.ndarray:
    return np.asarray(values[axis * N + NAMES.index(name)])


# ---- channels and frames -------------------------------------------------------------------------


def test_each_axis_has_its_own_readings_and_where_the_numerical_part_wants_it(
    tripped: RecordedTest,
) -> None:
    made = tripped.samples[tripped.running()]
    found = channels(made, pair_of().core_kinematics())
    assert found.shape == (2 * N, made.size)
    asked = np.column_stack([made["x_num_m"], made["x_num_m_1"]])
    for k, name in enumerate(AXES):
        own = tripped.axis(name)[tripped.running()]
        wanted = asked @ MATRIX[k]
        with np.errstate(invalid="ignore"):
            for channel, value in (
                ("x_num_mm", 1e3 * wanted),
                ("x_cmd_mm", 1e3 * own["x_cmd_m"]),
                ("x_meas_mm", 1e3 * own["x_meas_m"]),
                ("tracking_mm", 1e3 * (own["x_meas_m"] - wanted)),
                ("force_kn", 1e-3 * own["f_meas_n"]),
                ("alpha", made["alpha_1" if k else "alpha"]),
            ):
                np.testing.assert_allclose(of_axis(found, k, channel), value, rtol=1e-5, atol=1e-6)
        # The estimate is one of directions, of which that of the same number is shown.
        stiffness = made["k_t_n_per_m_1" if k else "k_t_n_per_m"]
        np.testing.assert_allclose(of_axis(found, k, "k_t_kn_per_mm"), 1e-6 * stiffness, rtol=1e-6)
        assert np.isfinite(stiffness).all()


def test_without_kinematics_and_where_nothing_was_asked_for_no_wish_is_invented(
    tripped: RecordedTest,
) -> None:
    made = tripped.samples[:8].copy()
    assert np.isnan(of_axis(channels(made), 1, "x_num_mm")).all()
    for odd in (np.nan, np.inf):
        made["x_num_m_1"][3] = odd
        found = channels(made, pair_of().core_kinematics())
        assert np.isnan(of_axis(found, 1, "x_num_mm")[3])
        assert np.isfinite(of_axis(found, 1, "x_num_mm")[2])


def test_a_page_gets_the_frames_of_the_axis_that_it_shows(tripped: RecordedTest) -> None:
    made = tripped.samples
    values = channels(made, pair_of().core_kinematics())
    history = History(made.size)
    history.append(np.arange(made.size), values, made["state"])
    assert history.axes == 2
    framer = Framer(history, core.FS_HZ)
    for k in range(2):
        screen = Screen()
        framer.show({"first": 0, "last": made.size, "columns": 100, "outline": True, "axis": k})
        frames = framer.next(0)
        assert len(frames) == 2
        for frame in frames:
            newest = screen.take(frame)[-1]
            np.testing.assert_array_equal(newest, values[k * N : (k + 1) * N, -1])
        highest = max(column[NAMES.index("force_kn")][1] for column in screen.columns.values())
        assert highest == np.nanmax(of_axis(values, k, "force_kn"))


def test_rig_of_one_axis_after_one_of_two_shows_its_own_and_nothing_of_the_other() -> None:
    history = History(1000)
    one, two = rows(0, 600), np.zeros(300, core.row_dtype((), 2))
    two["x_meas_m.1"] = 3e-3
    history.append(np.arange(600), channels(one), one["state"])
    assert history.axes == 1
    history.append(np.arange(600, 900), channels(two), two["state"])
    history.append(np.arange(900, 1000), channels(one[:100]), one["state"][:100])
    assert history.axes == 2
    _, values, _ = history.rows(0, 1000)
    right = of_axis(values, 1, "x_meas_mm")
    assert np.isnan(right[:600]).all()
    np.testing.assert_allclose(right[600:900], 3.0)
    assert np.isnan(right[900:]).all()
    np.testing.assert_allclose(of_axis(values, 0, "x_meas_mm")[:600], 1e3 * one["x_meas_m"])
    # What goes out of memory is the oldest, of all axes alike.
    for first in range(1000, 4000, 500):
        history.append(
            np.arange(first, first + 500),
            channels(np.repeat(two[:1], 500)),
            np.zeros(500, np.uint8),
        )
    at, values, _ = history.rows(0, 4000)
    assert at[-1] == 3999
    np.testing.assert_allclose(of_axis(values, 1, "x_meas_mm")[-1000:], 3.0)


@pytest.mark.parametrize("axis", [-1, 99, "right", None, True, float("nan")])
def test_a_view_of_no_axis_is_refused(axis: object) -> None:
    with pytest.raises(ValueError, match="axis: found"):
        view_of({"follow": True, "seconds": 4.0, "columns": 100, "axis": axis}, core.FS_HZ)


# ---- sources -------------------------------------------------------------------------------------


def test_ring_of_two_axes_says_which_axis_tripped_without_a_service(
    memory: Path, tripped: RecordedTest
) -> None:
    ring = Ring.create(memory, tripped)
    ring.push(tripped.samples)
    source = LiveSource(ring.path, None)
    source.poll()
    source.look()
    found = source.status()
    assert found["state"] == "TRIPPED"
    assert found["cause"].startswith("axis right: force")
    assert found["cause"].endswith("(limit 90 kN)")
    assert found["axes"] == list(AXES)
    assert len(found["now"]) == 2 * N
    assert found["attention"] == []
    at, values, _ = source.history.rows(0, 10**6)
    for k, name in enumerate(AXES):
        shown = of_axis(values, k, "x_meas_mm")
        wanted = 1e3 * tripped.axis(name)["x_meas_m"][at]
        np.testing.assert_allclose(shown, wanted, rtol=1e-5, atol=1e-6)
    source.close()
    ring.remove()


def test_past_test_of_two_axes_is_shown_over_the_socket(tripped: RecordedTest) -> None:
    with (
        opened(PastSource(tripped)) as client,
        socket_of(client) as socket,
    ):
        assert socket.receive_json()["kind"] == "hello"
        told = socket.receive_json()
        assert told["axes"] == list(AXES)
        assert told["end_reason"].endswith("of axis right")
        view = {"first": 0, "last": tripped.samples.size, "columns": 64, "axis": 1}
        socket.send_text(json.dumps({"view": view}))
        screen = Screen()
        newest = screen.take(socket.receive_bytes())[-1]
        assert newest[NAMES.index("x_meas_mm")] == pytest.approx(
            1e3 * tripped.axis("right")["x_meas_m"][-1], rel=1e-5
        )


def test_service_of_two_axes_is_shown_held_and_stopped(memory: Path) -> None:
    with served(memory, rig=pair_of(LIMITED)):
        with Client(memory / "control.sock") as client:
            source = LiveSource(memory, memory / "control.sock")
            at_rest = source.status()
            assert at_rest["axes"] == list(AXES)
            assert len(at_rest["now"]) == 2 * N
            test = short_file({"test.duration_s": "60"})
            record = record_of(experiment.load_motion(test))
            digest = client.call("Load", test_toml=config.dump(test), record=record)["digest"]
            client.call("Zero")
            await_state(memory, "ZEROED")
            source.look()
            told = source.status()["tare"]
            assert told.startswith("left tare ")
            assert "; right tare " in told
            client.call("Start", token=client.call("Arm", digest=digest)["token"])
            await_state(memory, "RUNNING")
            source.look()
            source.poll()
            now = source.status()["now"]
            found = status(memory)["axes"]
            assert all(now[k * N + NAMES.index("x_num_mm")] is not None for k in range(2))
            assert found["right"]["x_num_m"] is not None
            client.call("Hold")
            client.call("Stop")
            await_state(memory, "IDLE")
        source.close()


@EITHER
def test_service_says_whose_cause_it_is(memory: Path, axis: str) -> None:
    def trip(lab: Bench) -> None:
        lab.reach("RUNNING")
        tick = lab.engine.loop.counts.elapsed
        lab.drive.schedule([loop.Fault("silence", tick + 20, 100, 1.0, AXES.index(axis))])
        lab.until("TRIPPED")
        lab.engine.wait(0.3)

    with bench(memory, rig=pair_of(), test_of=short_file) as lab:
        trip(lab)
        source = LiveSource(memory, None)
        source.poll()
        source.look()
        assert source.status()["cause"].startswith(f"axis {axis}: no usable pair for ")
        source.close()
