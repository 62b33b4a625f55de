"""Hybrid tests on rigs of several axes in virtual time: against the joined structure, over limits
of axes and directions, from the command line to the report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.signal
from command_line import Rthyb
from test_axes_tests import RIG, TEST

from rthyb_rt import config
from rthyb_rt.analysis import several_axes as measured
from rthyb_rt.comparing import courses, of_axis
from rthyb_rt.config import AxesRig
from rthyb_rt.config.axes_reference import joint_model, reference_of
from rthyb_rt.config.deriving_axes import derive_axes
from rthyb_rt.core import RUNNING
from rthyb_rt.errors import InputError
from rthyb_rt.lab import axes_experiment, realtime, virtual_time
from rthyb_rt.live.sources import PastSource
from rthyb_rt.record import recording, ring
from rthyb_rt.record.recording import RecordedTest

ROOT = Path(__file__).parents[1]
SHORT = TEST + "[ground_motion]\npga_g = 0.05\nduration_s = 8\n"
H = 1.0 / 1024.0


def rig(text: str = RIG) -> AxesRig:
    found = config.parse_any_rig(text, "rig.toml")
    assert isinstance(found, AxesRig)
    return found


def conducted(test: str = SHORT, given: str = RIG) -> RecordedTest:
    return virtual_time.run(
        axes_experiment.prepare(config.parse_test(test, "test.toml"), rig(given))
    )


def test_the_reference_is_the_joined_structure_by_scipy() -> None:
    """Mass, Rayleigh damping and stiffness of building and specimen in one state space."""
    test = config.parse_test(SHORT, "test.toml")
    structure = derive_axes(test, rig()).structure
    t = np.arange(4096) * H
    ag = 0.5 * np.sin(2 * np.pi * 1.3 * t) * np.sin(0.5 * t)
    found = reference_of(test, rig(), structure, ag)
    b = structure.part.interface_rows()
    k_e = np.array([[8e6, -1e6], [-1e6, 6e6]])
    third = np.array([0.0, -1.0, 1.0])
    k = b.T @ k_e @ b + 8e6 * np.outer(third, third)
    m = 1e4 * np.eye(3)
    c = structure.part.damping_times(np.eye(3))
    a = np.block([[np.zeros((3, 3)), np.eye(3)], [-np.linalg.solve(m, k), -np.linalg.solve(m, c)]])
    load = np.concatenate([np.zeros(3), -np.ones(3)])[:, None]
    _, state, _ = scipy.signal.lsim((a, load, np.eye(6), np.zeros((6, 1))), ag, t)
    wanted = state[:, :3] @ b.T
    # Of the integrator's second order: a rate four times as high leaves a sixteenth of it.
    assert np.abs(found.x - wanted).max() < 1.5e-3 * np.abs(wanted).max()
    assert np.allclose(found.axis_m, wanted @ np.array([[1, 0], [1, 1]]).T, atol=2e-5)
    assert np.abs(found.force - found.x @ k_e).max() < 1e-9 * np.abs(found.force).max()


def test_a_specimens_element_is_in_the_reference() -> None:
    yielding = RIG.replace(
        "[limits]",
        '[[specimen.element]]\nalong = "ground-floor"\nlaw = { element = "cubic", '
        "k3_n_per_m3 = 3e11 }\n[limits]",
    )
    test = config.parse_test(SHORT, "test.toml")
    given = rig(yielding)
    structure = derive_axes(test, given).structure
    ag = 0.5 * np.sin(2 * np.pi * 1.3 * np.arange(3000) * H)
    found = reference_of(test, given, structure, ag)
    linear = found.x @ np.array(given.specimen.stiffness)
    assert np.abs(found.force[:, 1] - linear[:, 1]).max() < 1e-9 * np.abs(linear).max()
    assert np.allclose(found.force[:, 0] - linear[:, 0], 3e11 * found.x[:, 0] ** 3, atol=1e-6)
    assert len(joint_model(test, given).elements) == 1


def test_two_axes_follow_the_joined_structure() -> None:
    rec = conducted()
    assert rec.meta["end_reason"] == "completed"
    assert rec.axis_names == ("left", "right")
    assert rec.interface_names == ("ground-floor", "first-floor")
    s = measured.summarize(rec)
    assert s.rows == (18 * 1024)
    for one in s.directions:
        assert one.response_nrmse < 0.025
    for axis in s.axes:
        assert axis.tracking_nrmse < 0.02
    # The delay of a pure delay, and what the paper's estimator makes of it.
    assert s.axes[1].delay_samples == pytest.approx(9.0, abs=1.0)


def test_without_compensation_the_same_test_is_far_off() -> None:
    bare = conducted(SHORT.replace('"paper"', '"none"'))
    good = conducted()
    worst = [
        max(one.response_nrmse for one in measured.summarize(r).directions) for r in (bare, good)
    ]
    assert worst[0] > 5 * worst[1]


def test_the_recording_reads_back_with_its_axes(tmp_path: Path) -> None:
    rec = conducted()
    recording.write(tmp_path / "recording.h5", rec)
    again = recording.read(tmp_path / "recording.h5")
    assert again.axis_names == rec.axis_names
    for name in rec.axis_names:
        assert np.array_equal(again.axis(name)["x_meas_m"], rec.axis(name)["x_meas_m"])
    assert measured.summarize(again).as_json() == measured.summarize(rec).as_json()


def test_a_recording_of_two_axes_is_replayed_bit_by_bit() -> None:
    rec = conducted()
    again = realtime.replay(rec)
    assert again.identical
    assert again.rows == rec.samples.size
    # And a bit that was changed on the second axis is found.
    rec.samples["x_cmd_m.1"][rec.samples.size // 2] += 1e-12
    changed = realtime.replay(rec)
    assert (changed.identical, changed.field) == (False, "x_cmd_m.1")


def test_sensors_of_each_axis_are_its_own() -> None:
    rec = conducted()
    running = rec.samples["state"] == RUNNING
    left, right = (rec.axis(name)["x_meas_m"][running] for name in rec.axis_names)
    # The left sensor has noise; a pure delay without any repeats its command to the bit.
    assert np.unique(left).size > 0.99 * left.size
    sent = rec.axis("right")["x_cmd_m"][running]
    assert np.abs(right[9:] - sent[:-9]).max() < 1e-12


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"rig": ('force_n = "60 kN"', "force_n = 3000")}, "force limit of axis left"),
        ({"rig": ('command_position_m = "20 mm"', "command_position_m = 0.003")},
         "position limit of axis right"),
        ({"test": ('name = "first-floor"\nstorey = 2',
                   'name = "first-floor"\nstorey = 2\nlimits = { position_m = 0.002 }')},
         "position limit of direction first-floor"),
        ({"test": ('name = "ground-floor"\nstorey = 1',
                   'name = "ground-floor"\nstorey = 1\nlimits = { force_n = 9000 }')},
         "force limit of direction ground-floor"),
    ],
)  # fmt: skip
def test_any_axis_and_any_direction_ends_the_test_for_all(
    change: dict[str, tuple[str, str]], said: str
) -> None:
    texts = {"test": SHORT, "rig": RIG}
    for name, (old, new) in change.items():
        assert old in texts[name]
        texts[name] = texts[name].replace(old, new)
    rec = conducted(texts["test"], texts["rig"])
    reason = rec.meta["end_reason"]
    assert said in reason.replace(" of the rig", ""), reason
    assert rec.meta["station"]["state"] == "TRIPPED"
    # Both drives brake by themselves: neither goes on.
    for name in rec.axis_names:
        assert np.ptp(rec.axis(name)["x_meas_m"][-20:]) < 1e-4


# ---- recordings whose first rows were overwritten ------------------------------------------------


def recovered(rec: RecordedTest, folder: Path, rows: int) -> RecordedTest:
    """What is recovered from a ring for so many rows that the test was pushed to."""
    made = ring.Ring.create(folder, rec, capacity=rows)
    made.push(rec.samples)
    made.close()
    return ring.recover(made.path).recording


def told(rec: RecordedTest) -> str:
    return " ".join(notice.text for notice in measured.notices(measured.summarize(rec)))


def test_a_recovered_test_with_all_rows_is_measured_as_before(tmp_path: Path) -> None:
    rec = conducted()
    again = recovered(rec, tmp_path, 32768)
    assert measured.summarize(again).as_json() == measured.summarize(rec).as_json()
    assert "lacks" not in told(again)


def test_a_test_whose_first_rows_were_overwritten_is_compared_with_the_rest_of_its_reference(
    tmp_path: Path,
) -> None:
    rec = conducted()
    rest = recovered(rec, tmp_path, 16384)
    whole, s = measured.summarize(rec), measured.summarize(rest)
    lost = whole.rows - s.rows
    assert rest.reference is not None
    assert rec.reference is not None
    assert rest.reference.tobytes() == rec.reference[lost:].tobytes()
    assert lost > 2000
    assert s.signals.first == lost
    assert s.signals.reference is not None
    assert whole.signals.reference is not None
    assert np.array_equal(s.signals.reference.x, whole.signals.reference.x[lost:])
    assert np.array_equal(s.signals.reference.axis_m, whole.signals.reference.axis_m[lost:])
    for j, one in enumerate(s.directions):
        apart = whole.signals.x_meas[lost:, j] - whole.signals.reference.x[lost:, j]
        assert one.response_peak == np.abs(apart).max()
        assert one.response_nrmse is not None
        assert one.response_nrmse < 0.03
    assert s.attention == ()
    assert f"lacks the first {lost / 1024:.4g} s of the test" in told(rest)
    expected, seen = (
        values[lost:, 1] for values in (whole.signals.reference.axis_m, whole.signals.measured_m)
    )
    nrmse = np.sqrt(np.mean((seen - expected) ** 2) / np.mean(expected**2))
    course = of_axis.recorded(rest, None, "right")
    assert course.measures["response_nrmse"] == pytest.approx(nrmse, rel=1e-9)


def test_rows_cut_from_a_recording_by_hand_are_placed_as_well() -> None:
    rec = conducted()
    running = np.flatnonzero(rec.running())
    cut = replace(rec, samples=rec.samples[running[1000] : running[5000]])
    assert cut.reference is not None
    assert measured.summarize(cut).signals.first == 1000


def test_rows_of_which_the_ground_motion_tells_no_place_have_no_reference(tmp_path: Path) -> None:
    """Of the free vibration alone, of every second row, and of a ground that repeats itself."""
    rec = conducted()
    running = np.flatnonzero(rec.running())
    quiet = recovered(rec, tmp_path, 4096)
    assert quiet.running().sum() > 1000
    torn = replace(rec, samples=rec.samples[running[1000:5000:2]], reference=None)
    first = rec.samples[running[:2048]]
    again = replace(rec, samples=first, reference=None, ag_mps2=np.tile(rec.ag_mps2[:2048], 2))
    for one in (quiet, torn, again):
        s = measured.summarize(one)
        assert (s.signals.first, s.signals.reference) == (None, None)
        assert {d["response_nrmse"] for d in s.as_json()["directions"].values()} == {None}
        assert s.attention == ()
        assert "its ground motion does not tell which" in told(one)
        assert of_axis.recorded(one, None, "right").measures["response_nrmse"] is None
        with pytest.raises(InputError, match="has no reference simulation to compare with"):
            courses.beside_reference(one, of_axis.recorded(one, "run", "right"))


def test_without_a_reference_verdict_table_and_live_view_say_so(tmp_path: Path) -> None:
    quiet = recovered(conducted(), tmp_path, 4096)
    quiet.meta["end_reason"] = "completed"
    s = measured.summarize(quiet)
    assert "there is no reference simulation to compare" in measured.verdict(s)
    rows = {row.label: row.value for row in measured.table(s)}
    assert rows["ground-floor: response"] == rows["first-floor: response"]
    assert rows["first-floor: response"] == "no reference simulation"
    assert not any("NRMSE" in label and "response" in label for label in rows)
    attention = PastSource(quiet).status()["attention"]
    assert any("lacks rows of the test" in text for text in attention)


def test_the_report_without_a_reference_draws_what_was_measured(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from rthyb_rt.report import axes_report

    quiet = recovered(conducted(), tmp_path, 4096)
    plates = {plate.key: plate for plate in axes_report.draw_all(quiet, measured.summarize(quiet))}
    assert plates["direction-1"].svg
    assert plates["difference-1"].svg == ""
    for key in ("direction-1", "difference-1"):
        assert axes_report.NO_REFERENCE in plates[key].note
    assert axes_report.NO_REFERENCE in axes_report.render(quiet)


def test_rows_lost_while_the_ground_is_at_rest_leave_the_rest_without_a_reference() -> None:
    """Cut by hand, with its reference: the ground motion is that of an unbroken test."""
    rec = conducted()
    running = np.flatnonzero(rec.running())
    gap = np.delete(rec.samples, running[-3000:-2000])
    assert measured.summarize(replace(rec, samples=gap)).signals.first is None
    before = np.delete(rec.samples, running[2000:2500])
    assert measured.summarize(replace(rec, samples=before)).signals.first is None


def test_a_test_that_ended_before_it_began_lacks_no_rows() -> None:
    rec = conducted()
    begin = int(np.flatnonzero(rec.samples["state"] == RUNNING)[0])
    ended = replace(rec, samples=rec.samples[:begin], meta=rec.meta | {"end_reason": "tripped"})
    s = measured.summarize(ended)
    assert [notice.text for notice in measured.notices(s)] == [
        "The test did not complete: tripped.", measured.NO_ROWS,
    ]  # fmt: skip
    found = s.as_json()
    assert found["rows"] == 0
    for one in (*found["directions"].values(), *found["axes"].values()):
        assert {value for value in one.values() if isinstance(value, float)} == set()
    assert not any(s.flags.values())
    assert {row.value for row in measured.table(s)[1:]} == {"–", "no reference simulation"}


def test_a_comparison_says_which_recording_begins_later(tmp_path: Path) -> None:
    rec = conducted()
    rest = recovered(rec, tmp_path, 16384)
    first = measured.summarize(rest).signals.first
    assert first is not None
    lost_s = first / 1024
    assert of_axis.recorded(rec, "monday", "right").notes == ()
    (note,) = of_axis.recorded(rest, "tuesday", "right").notes
    assert f"tuesday, axis right lacks the first {lost_s:.4g} s of its test" in note
    torn = replace(rec, samples=np.delete(rec.samples, slice(5000, 5100)), reference=None)
    (note,) = of_axis.recorded(torn, "tuesday", "right").notes
    assert note == "tuesday, axis right lacks rows of its test, and it is not known which"


# ---- compensation by matrices --------------------------------------------------------------------


def frame(**overrides: str) -> RecordedTest:
    given = {key.replace("__", "."): value for key, value in overrides.items()}
    test = config.load_test(
        ROOT / "examples" / "two-actuator-frame.toml", {"ground_motion.duration_s": "8", **given}
    )
    found = config.load_any_rig(config.shipped_rig("two-axis-frame"))
    assert isinstance(found, AxesRig)
    return virtual_time.run(axes_experiment.prepare(test, found))


@pytest.mark.long
def test_matrices_undo_what_two_actuators_do_to_one_another() -> None:
    s = {kind: measured.summarize(frame(controller__type=kind)) for kind in ("matrix", "none")}
    assert s["matrix"].end_reason == s["none"].end_reason == "completed"
    tracking = {kind: max(axis.tracking_nrmse for axis in one.axes) for kind, one in s.items()}
    # Of the lower axis half is the noise of the sensors: 12 um of 0.5 mm rms.
    assert tracking["matrix"] < 0.3 * tracking["none"]
    x = s["matrix"].directions[0]
    assert x.name == "x"
    assert x.response_nrmse < 0.03
    assert s["matrix"].axes[0].delay_samples is None


def test_a_lead_of_gain_and_delay_alone_begins_by_the_identified_response() -> None:
    s = measured.summarize(frame(**{"controller.matrix": "{ inverse = false }"}))
    assert s.end_reason == "completed"
    assert max(axis.tracking_nrmse for axis in s.axes) < 0.12


# ---- what is not for several axes ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"test.time_scale": "10"}, "test.time_scale"),
        ({"test.sample_rate_hz": "300"}, ""),
    ],
)
def test_what_several_axes_cannot_do_is_refused(change: dict[str, Any], said: str) -> None:
    test = config.parse_test(SHORT, "test.toml", change)
    if said:
        with pytest.raises(InputError, match=said):
            axes_experiment.prepare(test, rig())
        return
    rec = virtual_time.run(
        axes_experiment.prepare(
            test,
            rig(
                RIG.replace(
                    'kind = "pure-delay", delay_samples = 9',
                    'kind = "second-order", natural_frequency_hz = 25, damping_ratio = 0.7',
                )
            ),
        )
    )
    assert rec.fs_hz == 300.0
    assert max(one.response_nrmse for one in measured.summarize(rec).directions) < 0.15


def test_a_sensor_too_short_for_the_reference_is_noted() -> None:
    short = RIG.replace("noise_std_m = 2e-6", "noise_std_m = 2e-6, range_m = 0.002")
    notes = axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), rig(short)).notes
    assert any("axis left: sensors.displacement.range_m = 2 mm" in note for note in notes)


# ---- the command line ----------------------------------------------------------------------------


@pytest.mark.long
def test_rthyb_run_writes_a_report_that_names_axes_and_directions(
    rthyb: Rthyb, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    out = tmp_path / "run"
    done = rthyb(
        "run", str(ROOT / "examples" / "two-actuator-frame.toml"), "--out", str(out), "--json",
        "--set", "ground_motion.duration_s=4",
    )  # fmt: skip
    assert done.code == 0, done.err
    told = done.json
    assert told["end_reason"] == "completed"
    assert set(told["measures"]["axes"]) == {"upper", "lower"}  # type: ignore[index]
    page = (out / "report.html").read_text(encoding="utf-8")
    for name in ("Direction x", "Direction theta", "Axis upper", "Force on axis lower"):
        assert name in page
    assert "not computed" in page.lower()
    again = rthyb("report", str(out))
    assert again.code == 0, again.err
    # The kept files run as they stand.
    kept = rthyb("run", str(out / "test.toml"), "--out", str(tmp_path / "again"), "--no-report")
    assert kept.code == 0, kept.err
    rows = [recording.read(one / "recording.h5").samples for one in (out, tmp_path / "again")]
    assert np.array_equal(rows[0]["x_cmd_m.1"], rows[1]["x_cmd_m.1"])


def test_two_runs_are_the_same_bit_by_bit() -> None:
    one, other = conducted(), conducted()
    assert one.samples.tobytes() == other.samples.tobytes()
    seeded = rig(RIG.replace('name = "two-storeys"', 'name = "two-storeys"\nseed = 5'))
    third = virtual_time.run(axes_experiment.prepare(config.parse_test(SHORT, "test.toml"), seeded))
    assert third.samples.tobytes() != one.samples.tobytes()
    assert replace(one, samples=one.samples[:3]).axis("right").size == 3


@pytest.mark.long
def test_rthyb_check_shows_axes_and_directions_and_what_it_does_not_compute(rthyb: Rthyb) -> None:
    done = rthyb("check", str(ROOT / "examples" / "two-actuator-frame.toml"), "--json")
    assert done.code == 0, done.err
    told = done.json
    assert set(told["axes"]) == {"upper", "lower"}  # type: ignore[call-overload]
    assert set(told["directions"]) == {"x", "theta"}  # type: ignore[call-overload]
    assert told["modes_hz"][0] == pytest.approx(2.30, abs=0.02)  # type: ignore[index]
    modes: list[dict[str, float]] = told["modes"]  # type: ignore[assignment]
    assert [mode["frequency_hz"] for mode in modes] == told["modes_hz"]
    # The shares of all modes add up to the mass that the ground motion moves.
    assert sum(mode["effective_mass"] for mode in modes) == pytest.approx(1.0, abs=0.02)
    assert "of the mass" in done.err
    assert any("computed only for a rig with one axis" in note for note in told["notes"])  # type: ignore[attr-defined]
    assert "Direction theta" in done.err
