"""The service of a rig of several axes, tick by tick: test after test, causes by the axis' name,
limits of one axis reloaded, and `rthyb ctl` beside it."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Rthyb
from realtime_bench import until
from service_bench import Bench, await_state, bench, left, served, status
from test_axes_realtime import AXES, EITHER, LIMITED, SHORT
from test_axes_realtime import rig as pair_of

from rthyb_rt import config
from rthyb_rt.config import AxesRig, TestFile
from rthyb_rt.core import RUNNING, STATES, loop
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, experiment, realtime
from rthyb_rt.lab.realtime import RefusedError
from rthyb_rt.record import recording
from rthyb_rt.service import any_rig
from rthyb_rt.service.control import Client, Refusal
from rthyb_rt.service.rig_engine import StateError
from rthyb_rt.service.ring_recorder import read_index

pytestmark = pytest.mark.alone

FRAME = Path(__file__).parents[1] / "examples" / "two-actuator-frame.toml"
FOLLOWING = loop.PHASES.index("following")
SHORT_FRAME = (
    *("--set", "test.duration_s=2", "--set", "ground_motion.start_s=1.5"),
    *("--set", "limits.ramp_in_s=0.25", "--set", "limits.tare_s=0.125"),
)
Made = Callable[..., AbstractContextManager[Bench]]


def short_file(changes: dict[str, str] | None = None) -> TestFile:
    return config.parse_test(SHORT, "test.toml", changes or {})


@pytest.fixture
def made(tmp_path: Path) -> Made:
    def make(
        faults: tuple[loop.Fault, ...] = (), rig: AxesRig | None = None
    ) -> AbstractContextManager[Bench]:
        given = rig or pair_of()
        return bench(tmp_path / "rings", faults=faults, rig=given, test_of=short_file)

    return make


def lowered(axis: str, **limits: str) -> AxesRig:
    """The rig with other limits of one axis."""
    text = LIMITED
    for key, value in limits.items():
        text = re.sub(rf'(name = "{axis}".*?{key} = )"[^"]*"', rf'\1"{value}"', text, flags=re.S)
    assert text != LIMITED
    return pair_of(text)


# ---- test after test -----------------------------------------------------------------------------


def test_two_tests_run_on_both_drives_which_are_never_let_go(made: Made, tmp_path: Path) -> None:
    with made() as lab:
        for pga in ("0.05", "0.03"):
            lab.loaded({"ground_motion.pga_g": pga})
            lab.reach("RUNNING")
            lab.finish()
            assert lab.engine.last is not None
            assert lab.engine.last["end_reason"] == "completed"
        for drive in lab.drive.drives:
            log = drive.log
            first = int(np.flatnonzero(log["phase"] == FOLLOWING)[0])
            assert (log["phase"][first:] == FOLLOWING).all()
            assert log["silent"][first:].max() == 0
    recordings = left(tmp_path / "rings")
    assert len(recordings) == 2
    peaks = []
    for rec in recordings:
        assert rec.axis_names == AXES
        assert np.count_nonzero(rec.samples["state"] == RUNNING) == 3 * 1024
        assert rec.samples["state"][-1] == STATES.index("IDLE")
        assert realtime.replay(rec).identical
        peaks.append([float(np.abs(rec.axis(name)["x_meas_m"]).max()) for name in AXES])
    assert (np.array(peaks[1]) < 0.8 * np.array(peaks[0])).all()


def test_between_two_tests_every_axis_stands_where_it_is(made: Made) -> None:
    """No axis leaps where one station takes over from another."""
    with made() as lab:
        lab.reach("RUNNING")
        lab.finish()
        lab.reach("ZEROED")
        logs = [drive.log for drive in lab.drive.drives]
    moving = [STATES.index(name) for name in ("RAMP_IN", "RUNNING", "RAMP_OUT")]
    for log in logs:
        still = ~np.isin(log["state"][301:], moving)
        # A new station begins with the reading, whose noise is 10 um here and what a servo lags by.
        assert np.abs(np.diff(log["target_m"][300:]))[still].max() < 2e-4


def test_hold_resume_and_stop_move_both_axes_alike(made: Made, tmp_path: Path) -> None:
    with made() as lab:
        lab.reach("HOLD")
        lab.engine.wait(0.2)
        # At the end of the braking both stand, wherever that is.
        for drive in lab.drive.drives:
            assert np.ptp(drive.log["target_m"][-100:]) == 0.0
        lab.engine.command("resume")
        lab.until("RUNNING")
        lab.engine.wait(0.2)
        lab.engine.command("stop")
        lab.finish()
        assert lab.engine.last is not None
        assert lab.engine.last["end_reason"] == "stopped by the operator"
        assert lab.engine.last["ending"] == ""
    (rec,) = left(tmp_path / "rings")
    assert realtime.replay(rec).identical


# ---- causes --------------------------------------------------------------------------------------


@EITHER
def test_silent_axis_trips_all_is_named_and_after_reset_the_next_test_runs(
    made: Made, axis: str
) -> None:
    with made() as lab:
        lab.reach("RUNNING")
        tick = lab.engine.loop.counts.elapsed
        lab.drive.schedule([loop.Fault("silence", tick + 50, 100, 1.0, AXES.index(axis))])
        lab.until("TRIPPED")
        assert lab.engine.cause_of == f"axis {axis}"
        said = [text for text in lab.said if "-> TRIPPED" in text]
        assert len(said) == 1
        assert f"cause: axis {axis}: " in said[0]
        lab.engine.wait(1.5)
        assert lab.engine.last is not None
        assert lab.engine.last["end_reason"] == f"tripped: link lost of axis {axis}"
        lab.engine.command("reset")
        lab.until("IDLE")
        lab.engine.wait(0.5)
        lab.reach("RUNNING")
        lab.finish()
        assert lab.engine.last["end_reason"] == "completed"


def test_reset_within_the_second_after_a_trip_does_not_forget_whose_it_was(made: Made) -> None:
    with made() as lab:
        lab.reach("RUNNING")
        tick = lab.engine.loop.counts.elapsed
        lab.drive.schedule([loop.Fault("silence", tick + 10, 60, 1.0, 1)])
        lab.until("TRIPPED")
        lab.engine.wait(0.4)
        lab.engine.command("reset")
        lab.engine.wait(2.0)
        assert lab.engine.last is not None
        assert lab.engine.last["end_reason"] == "tripped: link lost of axis right"
        assert lab.engine.last["ending"].startswith("axis right: no usable pair for ")


@EITHER
def test_force_limit_of_one_axis_is_told_with_axis_value_and_limit(made: Made, axis: str) -> None:
    with made() as lab:
        lab.reach("RUNNING")
        tick = lab.engine.loop.counts.elapsed
        lab.drive.schedule([loop.Fault("force", tick + 50, 200, 2e5, AXES.index(axis))])
        lab.until("TRIPPED")
        limit = "60" if axis == "left" else "90"
        assert re.fullmatch(
            rf"axis {axis}: force( before the tare)? \d+ kN \(limit {limit} kN\)",
            lab.engine.cause_in_figures,
        )
        lab.engine.wait(1.5)
        assert lab.engine.last is not None
        assert lab.engine.last["ending"].startswith(f"axis {axis}: force")
        assert re.search(r" at \d\.\d s$", lab.engine.last["ending"])


def test_limit_along_a_rotation_is_told_in_its_own_units(tmp_path: Path) -> None:
    """Its value is in rad, which mm would be wrong by a thousand of."""
    rig = config.load_any_rig(config.find_rig("two-axis-frame"))
    text = FRAME.read_text(encoding="utf-8")
    test = config.load_test(
        FRAME,
        {"ground_motion.start_s": "1.5", "ground_motion.pga_g": "0.4", "test.duration_s": "6",
         "limits.ramp_in_s": "0.25", "limits.tare_s": "0.125"},
    )  # fmt: skip
    assert "position_rad = 0.04" in text
    theta = test.interface[1]
    tight = theta.limits.model_copy(
        update={"position_rad": theta.limits.position_rad.model_copy(update={"value": 2e-4})}  # type: ignore[union-attr]
    )
    test = test.model_copy(
        update={
            "interface": [test.interface[0], theta.model_copy(update={"limits": tight})],
        }
    )
    with bench(tmp_path / "rings", rig=rig, test_of=lambda _: test) as lab:
        lab.reach("RAMP_IN")
        for _ in range(400):
            lab.engine.wait(0.02)
            if lab.engine.state not in ("RAMP_IN", "RUNNING"):
                break
        assert lab.engine.cause_of == "direction theta"
        told = lab.engine.cause_in_figures
    assert re.fullmatch(r"direction theta: command 0\.2\d* mrad \(limit 0\.2 mrad\)", told)


# ---- what is refused -----------------------------------------------------------------------------


def test_zero_names_the_axis_that_says_nothing(made: Made) -> None:
    with made(faults=(loop.Fault("silence", 0, 10**9, 1.0, 1),)) as lab:
        lab.loaded()
        with pytest.raises(StateError, match="axis right: nothing arrived"):
            lab.engine.zero()
        assert lab.engine.state == "IDLE"


def test_a_test_of_one_actuator_is_refused_on_a_rig_of_two_and_the_other_way_round(
    made: Made,
) -> None:
    one = config.load_test(config.builtin_test_path())
    with made() as lab, pytest.raises(InputError, match="a rig with several axes needs storeys"):
        lab.engine.prepare(one, experiment.load_motion(one))
    alone = config.load_rig(config.find_rig(one.rig))
    with pytest.raises(InputError, match="the rig has one actuator, which moves one"):
        any_rig.prepare(short_file(), alone, experiment.load_motion(short_file()))


# ---- limits --------------------------------------------------------------------------------------


@EITHER
def test_limits_of_one_axis_are_reloaded_in_hold_and_act_from_then_on(
    made: Made, tmp_path: Path, axis: str
) -> None:
    with made() as lab:
        lab.reach("HOLD")
        tight = lowered(axis, command_position_m="0.2 mm")
        assert lab.engine.reload(tight) == 1
        assert any(
            f"generation 1: axis {axis}: command_position_m 0.0" in text for text in lab.said
        )
        assert lab.engine.loaded is not None
        assert lab.engine.run.digest == lab.engine.loaded.digest
        lab.engine.wait(0.02)
        if lab.engine.state == "HOLD":
            # It is held within the new limit, and goes beyond it later.
            lab.engine.command("resume")
        for _ in range(400):
            lab.engine.wait(0.02)
            if lab.engine.state not in ("HOLD", "RUNNING"):
                break
        assert lab.engine.cause_of == f"axis {axis}"
        assert "(limit 0.2 mm)" in lab.engine.cause_in_figures
        lab.engine.wait(2.5)
    (rec,) = left(tmp_path / "rings")
    # The set that was published is in the recording, for every axis: else no replay is the same.
    assert [one["generation"] for one in rec.replay.parameters] == [0, 1]
    assert realtime.replay(rec).identical


def test_limits_reloaded_at_rest_go_into_the_next_test(made: Made) -> None:
    with made() as lab:
        before = lab.loaded()
        assert lab.engine.reload(lowered("right", command_position_m="5 mm")) == 0
        assert lab.engine.loaded is not None
        assert lab.engine.loaded.digest != before.digest
        lab.reach("ZEROED")
        axis = lab.engine.run.config.controller.axes[1]
        assert axis.watches is not None
        assert axis.watches["rig_position"].value == pytest.approx(5e-3)


def test_more_than_limits_is_no_reload_and_is_told_with_its_axis(made: Made) -> None:
    other = pair_of(LIMITED.replace("delay_samples = 9", "delay_samples = 8"))
    with made() as lab:
        with pytest.raises(StateError, match=r"axis\.right\.actuator of the rig file also changed"):
            lab.engine.reload(other)
        assert lab.engine.rig == pair_of()


def test_reload_of_looser_limits_of_an_axis_is_refused_with_its_key(tmp_path: Path) -> None:
    def demand(rig: Any) -> dict[str, Any]:
        if rig != pair_of():
            raise RefusedError("not commissioned")
        return {"commissioning": {}}

    files = [lowered("left", force_n="70 kN"), lowered("left", force_n="50 kN")]
    with (
        served(tmp_path, rig=pair_of(), demand=demand, read_rig=files.pop) as daemon,
        Client(tmp_path / "control.sock") as client,
    ):
        assert client.call("Reload")["generation"] == 0
        assert daemon.engine.rig == lowered("left", force_n="50 kN")
        with pytest.raises(Refusal, match=r"axis\.left\.limits\.force_n would"):
            client.call("Reload")
        assert daemon.engine.rig == lowered("left", force_n="50 kN")


# ---- rthyb ctl -----------------------------------------------------------------------------------


def test_the_two_actuator_frame_runs_through_the_service_and_is_recorded(
    rthyb: Rthyb, place: Path
) -> None:
    rig = config.load_any_rig(config.find_rig("two-axis-frame"))
    with served(place, rig=rig, recorder="own") as daemon:
        for words in (("load", FRAME, *SHORT_FRAME), ("zero",), ("arm",), ("start",)):
            answer = rthyb("ctl", *words)
            assert answer.code == 0, answer.err
            if words[0] == "zero":
                assert re.match(r"Zeroed, upper tare \S+ mm, \S+ kN; lower tare ", answer.out)
        await_state(place, "RUNNING")
        found = rthyb("ctl", "status", "--json").json
        shown = rthyb("ctl", "status").out
        line = rthyb("ctl", "metrics").out
        while status(place)["last"] is None:
            pass
        assert status(place)["last"]["end_reason"] == "completed"
        until(lambda: bool(read_index(place / "runs")), "an index")
        (entry,) = read_index(place / "runs")
        daemon.engine.check("load")
    assert list(found["axes"]) == ["upper", "lower"]
    assert found["directions"]["theta"]["unit"] == "rad"
    for own in found["axes"].values():
        assert own["link_down"] == "up"
        assert own["drive_stopped"] is False
        assert own["wire"]["pairs"] > 0
    assert re.search(r"^Axis upper +\S+ mm, \S+ kN +command \S+ mm$", shown, re.M)
    assert re.search(r"^Direction theta +\S+ mrad +command$", shown, re.M)
    assert not re.search("^(Displacement|Force|Delay) ", shown, re.M)
    assert re.search(r'^rthyb_displacement_metres\{axis="lower"\} ', line, re.M)
    assert re.search(r'^rthyb_wire_frames_total\{axis="upper",kind="pairs"\} ', line, re.M)
    rec = recording.open_run(place / "runs" / entry["folder"])
    assert rec.axis_names == ("upper", "lower")
    assert np.count_nonzero(rec.running()) == 2048
    assert realtime.replay(rec).identical
    report = rthyb("report", place / "runs" / entry["folder"], "--out", place / "page.html")
    assert report.code == 0, report.err


def test_watched_status_of_several_axes_is_one_line(place: Path) -> None:
    from rthyb_rt.cli import ctl

    with served(place, rig=pair_of()):
        found = status(place)
        assert re.fullmatch(
            r"IDLE, left \S+ mm, \S+ kN, right \S+ mm, \S+ kN, 0 skipped", ctl.line(found)
        )


def test_at_rest_the_service_has_the_limits_of_every_axis() -> None:
    """Its structure is never asked for anything: forces and positions of the rig alone count."""
    setup = axes_experiment.at_rest(pair_of())
    station = experiment.station_config(setup, real=True)
    left_axis, right_axis = station.controller.axes
    assert left_axis.watches is not None
    assert right_axis.watches is not None
    assert left_axis.watches["rig_force"].value == 60e3
    assert right_axis.watches["rig_force"].value == 90e3
