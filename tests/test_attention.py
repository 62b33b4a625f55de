"""A test that went wrong is told so, one that went well is not, and each end has its figures."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from recording_data import recording

from rthyb_rt import config, core
from rthyb_rt.analysis import margins, measures, summary
from rthyb_rt.analysis.attention import Finding, Judge, Subject
from rthyb_rt.lab import experiment, trips, virtual_time
from rthyb_rt.live.sources import LiveSource, PastSource
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "examples"
RECORDS = ROOT.parent / "shared" / "records"

LAB_RIG = """schema = "rthyb-rig/1"
[rig]
name = "lab"
elastic_stiffness_n_per_m = "219.3 kN/m"
load_cell = "specimen"
[actuator]
kind = "servo-hydraulic"
kp_per_s = 42
[[specimen]]
element = "stiffness"
k_n_per_m = "219.3 kN/m"
[sensors]
displacement = { noise_std_m = "5 um", lsb_m = "0.5 um", range_m = "75 mm" }
force = { noise_std_n = "30 N", lsb_n = "1 N", range_n = "25 kN" }
[identified]
alpha = 25.2
delay_s = "24.4 ms"
rest_noise_displacement_m = "5 um"
rest_noise_force_n = "30 N"
"""

LAB_TEST = """schema = "rthyb-test/1"
[test]
name = "lab"
[ground_motion]
record = "{record}"
pga_g = "{pga}"
[numerical]
mass_kg = "500 kg"
damping_n_s_per_m = "400 N s/m"
[controller]
type = "{controller}"
"""


def lab(controller: str, record: str = "elcentro-1940-ns", pga: str = "0.1 g") -> RecordedTest:
    """A structure of 0.3 s on an actuator of 25 samples, the load cell with 30 N of noise."""
    text = LAB_TEST.format(record=record, pga=pga, controller=controller)
    if Path(record).is_absolute():
        text = text.replace("pga_g", 'units = "g"\npga_g')
    test, rig = config.parse_test(text, "test"), config.parse_rig(LAB_RIG, "rig")
    return virtual_time.run(experiment.prepare(test, rig))


@cache
def example(name: str, *overrides: str) -> RecordedTest:
    given = dict(item.split("=", 1) for item in overrides)
    ours = {key: value for key, value in given.items() if not key.startswith("rig.")}
    test = config.load_test(EXAMPLES / f"{name}.toml", ours)
    rig = config.load_rig(config.find_rig(test.rig), {})
    return virtual_time.run(experiment.prepare(test, rig))


def found(rec: RecordedTest) -> dict[str, Finding]:
    return {one.kind: one for one in summary.summarize(rec).attention}


def alarms(rec: RecordedTest) -> list[str]:
    told = summary.notices(summary.summarize(rec))
    return [notice.text for notice in told if notice.level == "alarm"]


# --- the example of a lab -------------------------------------------------------------------------


def test_alpha_that_learns_from_noise_is_told_with_the_key_to_change() -> None:
    rec = lab("paper")
    one = found(rec)["delay"]
    assert rec.samples["alpha"][0] == pytest.approx(25.2, abs=0.01)
    assert one.value < 14.0
    assert one.allowed == pytest.approx(1.87, abs=0.01)
    (text,) = (text for text in alarms(rec) if text.startswith("Alpha departed"))
    assert "identified delay of 25.2 samples" in text
    assert "it reached 13." in text
    assert "controller.delay_estimator.gain_per_mm2_per_sample" in text
    assert 'controller.type = "robust"' in text


def test_response_that_is_lost_in_the_quiet_part_is_told() -> None:
    rec = lab("paper")
    one = found(rec)["response"]
    assert one.value > 0.4
    assert one.from_s > 20.0
    assert summary.summarize(rec).response_peak_error < 0.1, "of the peak it is small"
    assert alarms(rec)[0].startswith("The response departed from the reference simulation: from")


def test_alpha_that_learns_from_motion_alone_stays_with_the_delay() -> None:
    assert "delay" not in found(lab("robust"))


def test_takatori_in_a_lab_of_much_noise_is_not_green() -> None:
    record = RECORDS / "kobe1995_TAK090_100Hz_g.txt"
    if not record.is_file():
        pytest.skip("this machine has no copy of the record of Takatori")
    wrong = found(lab("paper", str(record), "0.3 g"))
    assert set(wrong) == {"response", "delay", "damping"}
    # 12.6 to 13.7 over six seeds of the noise; 25.2 is right.
    assert 12.0 < wrong["delay"].value < 14.0
    assert wrong["response"].value > 0.3
    assert alarms(lab("robust", str(record), "0.3 g")) == []


# --- tests that are good --------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name", ["section4.2", "section5-T0.5", "section5-T1.0", "section5-alpha-beta"]
)
def test_a_shipped_test_that_is_good_has_no_attention(name: str) -> None:
    assert alarms(example(name)) == []


def test_other_noise_makes_no_attention_of_the_first_test() -> None:
    test = config.load_test(EXAMPLES / "section5-T0.5.toml", {})
    for seed in range(2, 6):
        rig = config.load_rig(config.find_rig(test.rig), {"rig.seed": str(seed)})
        rec = virtual_time.run(experiment.prepare(test, rig))
        assert found(rec) == {}, f"seed {seed}"


def test_alpha_that_begins_elsewhere_may_take_its_time() -> None:
    assert "delay" not in found(example("section5-T0.5", "controller.alpha0=8"))


# --- one thing wrong after another ----------------------------------------------------------------


def test_alpha_that_stands_off_for_the_whole_test_is_told() -> None:
    rec = example(
        "section5-T0.5", "controller.alpha0=12", "controller.delay_estimator.enabled=false"
    )
    one = found(rec)["delay"]
    assert (one.value, one.from_s) == (12.0, 0.0)
    assert "set controller.alpha0 to that delay" in "\n".join(alarms(rec))


def test_alpha_that_starts_too_far_off_is_told_with_the_key_that_says_so() -> None:
    weak = "controller.delay_estimator.gain_per_mm2_per_sample=0.001"
    rec = example("section5-T0.5", "controller.alpha0=30", weak)
    (text,) = (text for text in alarms(rec) if text.startswith("Alpha departed"))
    assert "alpha started at 30 samples (29.3 ms), the value of controller.alpha0: omit" in text
    assert "gain_per_mm2_per_sample" not in text


def test_delay_that_nothing_takes_out_is_told_as_negative_damping() -> None:
    rec = example(
        "section5-T0.5",
        "controller.alpha0=12",
        "controller.delay_estimator.enabled=false",
        "controller.rfc.enabled=false",
    )
    one = found(rec)["damping"]
    assert (one.from_s, one.to_s) == (0.0, 40.0)
    # Five samples are left over, and 3.26 are what the damping bears.
    assert one.value == pytest.approx(5.0 / 3.26, rel=0.05)


def test_motion_too_small_for_the_tangent_stiffness_is_told() -> None:
    rec = example("section5-T0.5", "ground_motion.pga_g=0.01")
    assert found(rec)["stiffness"].value > 0.4
    (text,) = (text for text in alarms(rec) if text.startswith("No force compensation"))
    assert 'controller.rfc.tangent = "least-squares"' in text
    notes = [n.text for n in summary.notices(summary.summarize(rec)) if n.level == "note"]
    assert not any(text.startswith("No force compensation") for text in notes), "once is enough"


def test_rows_that_come_in_pieces_are_judged_as_in_one() -> None:
    rec = lab("paper")
    given = summary.setup(rec)
    whole, pieces = (Judge(summary.subject(given, rec.fs_hz)) for _ in range(2))
    assert rec.reference is not None
    reference = rec.reference["x_ref_m"]
    whole.add(rec.samples, reference)
    for first in range(0, rec.samples.size, 777):
        part = slice(first, first + 777)
        pieces.add(rec.samples[part], reference[part])
    for one, other in zip(whole.findings(), pieces.findings(), strict=True):
        assert one.kind == other.kind
        assert_allclose(
            dataclasses.astuple(one)[1:], dataclasses.astuple(other)[1:], rtol=1e-9, atol=1e-12
        )


def test_a_running_test_is_judged_without_a_reference() -> None:
    rec = lab("paper")
    judge = Judge(dataclasses.replace(summary.subject(summary.setup(rec), rec.fs_hz), peak_m=None))
    judge.add(rec.samples)
    assert {one.kind for one in judge.findings(over=False)} >= {"delay"}


def test_an_estimate_on_its_way_is_given_time_while_the_test_runs() -> None:
    rec = example("section4.2")
    judge = Judge(summary.subject(summary.setup(rec), rec.fs_hz))
    judge.add(rec.samples[:1500])
    assert judge.findings(over=False) == [], "two seconds are not over"


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200, -1e300])
@pytest.mark.parametrize("name", ["x_num_m", "x_meas_m", "f_meas_n", "k_t_n_per_m", "alpha"])
def test_a_value_beyond_any_sense_leaves_figures(name: str, bad: float) -> None:
    rec = recording(4.0)
    rec.samples[name][1000:1010] = bad
    for one in summary.summarize(rec).attention:
        assert np.isfinite([one.value, one.allowed, one.from_s, one.to_s]).all()


def test_a_test_of_a_tenth_of_a_second_has_no_attention() -> None:
    rec = recording(4.0)
    rec.samples = rec.samples[:100]
    assert summary.summarize(rec).attention == ()
    assert Judge(Subject(1024.0)).findings() == []


# --- energy ---------------------------------------------------------------------------------------


def test_a_lagging_spring_feeds_what_its_negative_damping_says() -> None:
    """Delay d of a spring k acts as the damping -k d: over a cycle k pi A^2 sin(w d)."""
    fs, w, a, k, d = 1024.0, 2.0 * np.pi, 0.01, 2e5, 0.003
    t = np.arange(int(4 * fs) + 1) / fs
    x_c, x_m = a * np.sin(w * t), a * np.sin(w * (t - d))
    fed = measures.fed_energy(k * x_m, x_c, x_m, np.zeros_like(t), k)
    assert fed[-1] == pytest.approx(4.0 * k * np.pi * a**2 * np.sin(w * d), rel=1e-4)
    assert_allclose(fed, measures.energy_error(k * x_m, x_c, x_m), atol=1e-9)
    damped = measures.damping_energy(x_c, k * d, fs)
    assert fed[-1] == pytest.approx(damped[-1], rel=1e-3), "with c = k d they are in balance"


def test_force_compensation_with_the_right_stiffness_lets_nothing_be_fed() -> None:
    fs, w, a, k = 1024.0, 2.0 * np.pi, 0.01, 2e5
    t = np.arange(int(1.37 * fs)) / fs
    x_c, x_m = a * np.sin(w * t), a * np.sin(w * (t - 0.02))
    fed = measures.fed_energy(k * x_m, x_c, x_m, np.full_like(t, k), k)
    assert_allclose(fed, 0.0, atol=1e-9 * k * a**2)
    assert measures.energy_error(k * x_m, x_c, x_m)[-1] > 1.0


def test_margin_of_the_delay_is_what_the_damping_bears() -> None:
    motion = core.MotionConfig(
        "central-difference", mass_kg=500.0, damping_n_s_per_m=400.0, k_e_n_per_m=219300.0
    )
    margin = margins.delay_margin(margins.critical_delay(margins.OneDegree(motion)))
    assert margin == pytest.approx(400.0 / 219300.0 * core.FS_HZ, rel=0.01)
    undamped = dataclasses.replace(motion, damping_n_s_per_m=0.0)
    assert margins.delay_margin(margins.critical_delay(margins.OneDegree(undamped))) == 1.0


# --- ends -----------------------------------------------------------------------------------------


def ending(rec: RecordedTest) -> str:
    return summary.summarize(rec).ending


def test_a_trip_names_limit_value_and_what_was_known_of_it() -> None:
    text = ending(example("section5-no-compensation"))
    assert text == (
        "force 15.0 kN (limit 15 kN) at 3.1 s; without compensation this structure remains stable "
        "up to a delay of 3.3 samples (3.2 ms); the rig has 17 samples (16.6 ms)"
    )


def test_the_notice_of_a_trip_has_its_figures() -> None:
    first = alarms(example("section5-no-compensation"))[0]
    assert first.startswith("The test did not complete: tripped: force limit, force 15.0 kN (limit")


def test_a_limit_that_the_reference_exceeds_is_told_as_that() -> None:
    text = ending(example("section5-T0.5", "limits.force_n=3000"))
    assert text.startswith("force 3.0")
    assert "(limit 3 kN) at " in text
    assert text.endswith("; even the reference simulation reaches 4.98 kN")


def test_a_trip_with_compensation_names_alpha() -> None:
    rec = example("section5-T0.5", "limits.tracking_error_m=0.00005")
    assert ending(rec).startswith("tracking error 0.050")
    assert (
        "tolerates an error of 3.3 samples (3.2 ms) in alpha; the rig's delay is 17 samples "
        "(16.6 ms), alpha was at 17" in ending(rec)
    )


def test_an_end_without_figures_is_left_to_its_cause() -> None:
    given = summary.setup(recording())
    assert trips.sentence(trips.Met("link_lost", 0.0, 0.0), given) == ""
    assert trips.sentence(trips.Met("sensor_stuck", 50.0, 50.0, 3.0), given) == (
        "the displacement was frozen for 50 samples (limit 50 samples) at 3.0 s"
    )


def test_every_limit_of_a_file_has_its_words() -> None:
    for key, cause in experiment.WATCHES.items():
        assert "(limit " in trips.figures(cause, 2.0, 1.0), key


def test_skipped_ticks_are_told_in_a_row_or_as_a_share() -> None:
    assert trips.figures("skips", 12.0, 10.0) == "skipped 12 ticks (limit 10 ticks)"
    assert (
        trips.figures("skips", 0.06, 0.05) == "skipped 6.00 % of the ticks (limit 5 % of the ticks)"
    )


def test_a_good_end_and_an_operators_have_no_figures() -> None:
    rec = recording()
    for cause in ("none", "completed", "operator", "signal"):
        rec.meta["station"] = {"cause": cause, "cause_value": 1.0, "cause_limit": 1.0}
        assert trips.found(rec, summary.setup(rec)) is None


def test_what_the_station_met_counts_before_the_rows() -> None:
    rec = recording()
    rec.meta["station"] = {"cause": "force", "cause_value": -16200.0, "cause_limit": 16000.0}
    met = trips.found(rec, summary.setup(rec))
    assert met is not None
    assert trips.figures(met.cause, met.value, met.limit) == "force 16.2 kN (limit 16 kN)"


# --- where it is told -----------------------------------------------------------------------------


def told_live(rec: RecordedTest, seconds: float, folder: Path) -> list[str]:
    """What the live view says when so much of the test proper has come."""
    rows = rec.samples[: int(np.argmax(rec.running())) + round(seconds * rec.fs_hz)].copy()
    made = Ring.create(folder, rec)
    made.push(rows)
    source = LiveSource(made.path, None)
    source.poll()
    told: list[str] = source.status()["attention"]
    source.close()
    made.remove()
    return told


def test_the_live_view_says_of_a_running_test_what_goes_wrong(tmp_path: Path) -> None:
    rec = lab("paper")
    assert told_live(rec, 5.0, tmp_path) == []
    alpha = [text for text in told_live(rec, 20.0, tmp_path) if text.startswith("Alpha departed")]
    assert len(alpha) == 1
    whole = told_live(rec, 40.0, tmp_path)
    assert whole[0].startswith("The response departed from the reference simulation")
    assert "controller.delay_estimator.gain_per_mm2_per_sample" in whole[1]


def test_the_live_view_of_a_good_test_says_nothing(tmp_path: Path) -> None:
    for seconds in (1.0, 3.0, 10.0, 30.0, 40.0):
        assert told_live(example("section5-T0.5"), seconds, tmp_path) == [], seconds


def test_a_recording_that_is_looked_at_has_all_that_its_report_has() -> None:
    rec = example("section5-no-compensation")
    status = PastSource(rec).status()
    assert status["attention"] == alarms(rec)
    assert status["cause"] == ending(rec)


@pytest.mark.long
def test_the_report_begins_with_what_must_not_be_missed() -> None:
    pytest.importorskip("matplotlib")
    from rthyb_rt.report import render

    page = render(lab("paper"))
    assert page.index("Alpha departed from the identified delay") < page.index('class="sentence"')
    assert '<span class="state bad">completed, see Attention</span>' in page
    good = render(example("section5-T0.5"))
    assert '<span class="state good">completed</span>' in good
    assert "Attention" not in good.split("<section", 1)[0]


def test_attention_is_in_the_document_of_a_run() -> None:
    told = summary.summarize(lab("paper")).as_json()["attention"]
    assert {one["kind"] for one in told} >= {"response", "delay"}
    assert set(told[0]) == {"kind", "value", "allowed", "from_s", "to_s"}
