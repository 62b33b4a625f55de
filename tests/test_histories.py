"""Prescribed histories: what is asked for, what leaves, and what the loops show."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_bench import bench, left

import rthyb_rt as rt
from rthyb_rt import cli, config, core
from rthyb_rt.analysis import hysteresis, summary
from rthyb_rt.checking.examined import examine
from rthyb_rt.config.prescribed_history import CyclesHistory, with_file
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, histories, realtime, virtual_time
from rthyb_rt.record import mat_csv, recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening

FS = core.FS_HZ
HEAD = 'schema = "rthyb-test/1"\ntest = { name = "h" }\n'
FEMA = 'history = { kind = "fema-461", target_m = "30 mm", velocity_m_per_s = "50 mm/s" }'
CYCLES = 'history = { kind = "cycles", amplitudes_m = [0.004, 0.008], frequency_hz = 1 }'


def history(text: str) -> Any:
    return config.parse_test(HEAD + text).history


def planned(text: str, most: float = 0.2, scale: float = 1.0) -> histories.HistoryPlan:
    return histories.plan(history(text), FS, most, scale)


def rig_of(specimen: str, actuator: str = 'kind = "pure-delay"\ndelay_samples = 7') -> Any:
    return config.parse_rig(
        'schema = "rthyb-rig/1"\n[rig]\nname = "r"\nelastic_stiffness_n_per_m = 1e6\n'
        f'load_cell = "specimen"\n[actuator]\n{actuator}\n{specimen}'
    )


SPRING = '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 1e6\n'


def recorded(text: str, rig: Any) -> RecordedTest:
    return virtual_time.run(experiment.prepare(config.parse_test(HEAD + text), rig))


# ---- what is asked for --------------------------------------------------------------------------


def test_fema_461_grows_by_14_per_10_to_its_target_and_by_three_tenths_of_it_beyond() -> None:
    text = FEMA.replace(" }", ", further_steps = 2 }")
    sizes = [step.amplitude_m for step in history(text).steps]
    assert len(sizes) == 12
    assert sizes[9] == pytest.approx(0.03)
    assert np.allclose(np.divide(sizes[1:10], sizes[:9]), 1.4)
    # The standard's table: the first of ten amplitudes is .048 of the last.
    assert sizes[0] / sizes[9] == pytest.approx(0.048, abs=5e-4)
    assert sizes[10:] == pytest.approx([0.039, 0.048])
    assert {step.cycles for step in history(text).steps} == {2}


def test_aisc_341_goes_by_drift_angles_of_the_storey() -> None:
    steps = history(
        'history = { kind = "aisc-341", height_m = "2 m", to_drift = 0.06, frequency_hz = 0.1 }'
    ).steps
    assert [(round(step.amplitude_m / 2.0, 6), step.cycles) for step in steps] == [
        (0.00375, 6), (0.005, 6), (0.0075, 6), (0.01, 4), (0.015, 2), (0.02, 2), (0.03, 2),
        (0.04, 2), (0.05, 2), (0.06, 2),
    ]  # fmt: skip


def test_no_way_between_turning_points_is_faster_than_it_says() -> None:
    plan = planned(FEMA, most=0.2)
    assert plan.peak_m == pytest.approx(0.03, rel=1e-12)
    # Closed forms: v = pi L / 2T, a = pi^2 L / 2T^2; the largest way is long enough for both.
    assert 0.99 * 0.05 < plan.peak_m_per_s <= 0.05
    assert 0.97 * 0.2 < plan.peak_m_per_s2 <= 0.2 * (1 + 1e-9)
    assert plan.path_m[0] == plan.path_m[-1] == 0.0


def test_each_cycle_begins_where_the_displacement_rises_through_zero_and_meets_its_amplitude() -> (
    None
):
    plan = planned(FEMA)
    assert len(plan.cycles) == 20
    assert [c.stop for c in plan.cycles[:-1]] == [c.start for c in plan.cycles[1:]]
    for cycle in plan.cycles:
        part = plan.path_m[cycle.start : cycle.stop]
        assert part.max() == pytest.approx(cycle.amplitude_m, rel=1e-12)
        assert part.min() == pytest.approx(-cycle.amplitude_m, rel=1e-12)
        assert abs(part[0]) < plan.peak_m_per_s / FS


def test_cycles_of_one_amplitude_by_frequency_are_a_cosine_between_the_turning_points() -> None:
    plan = planned(
        'history = { kind = "cycles", amplitudes_m = [0.01], cycles = 3, frequency_hz = 2 }'
    )
    t = np.arange(256, 256 + 5 * 256) / FS
    expected = 0.01 * np.cos(2 * np.pi * 2.0 * (t - 0.25))
    assert np.allclose(plan.path_m[256 : 256 + 5 * 256], expected, atol=1e-15)
    assert plan.peak_m_per_s2 <= (2 * np.pi * 2.0) ** 2 * 0.01


def test_sine_has_its_full_size_between_its_tapers() -> None:
    plan = planned('history = { kind = "sine", amplitude_m = 0.01, frequency_hz = 4, cycles = 6 }')
    t = np.arange(plan.path_m.size) / FS
    whole = slice(plan.cycles[0].start, plan.cycles[-1].stop)
    assert np.allclose(plan.path_m[whole], 0.01 * np.sin(2 * np.pi * 4 * t[whole]), atol=1e-15)
    assert len(plan.cycles) == 6
    assert plan.peak_m_per_s <= 0.01 * 2 * np.pi * 4
    # Two cycles of taper add a thirty-second to the acceleration at most.
    assert plan.peak_m_per_s2 <= 0.01 * (2 * np.pi * 4) ** 2 * (1 + 1 / 32)


def test_sweep_reaches_its_frequencies_below_its_velocity() -> None:
    plan = planned(
        'history = { kind = "sweep", amplitude_m = 0.002, from_hz = 1, to_hz = 32, '
        "duration_s = 40, velocity_m_per_s = 0.05 }"
    )
    assert plan.peak_m_per_s < 0.05
    phase = np.unwrap(np.angle(_analytic(plan.path_m)))
    f = np.gradient(phase) * FS / (2 * np.pi)
    for t in (10.0, 20.0, 30.0):
        at = round(t * FS)
        assert f[at - 200 : at + 200].mean() == pytest.approx(32.0 ** (t / 40.0), rel=0.02)


def _analytic(x: np.ndarray[Any, Any]) -> Any:
    from scipy.signal import hilbert

    return hilbert(x)


def test_noise_has_its_band_and_its_seed() -> None:
    text = (
        'history = { kind = "random", from_hz = 1, to_hz = 5, rms_m = 0.002, duration_s = 40, '
        "seed = 3 }"
    )
    plan = planned(text)
    x = plan.path_m[: 40 * 1024]
    power = np.abs(np.fft.rfft(x)) ** 2
    f = np.fft.rfftfreq(x.size, 1 / FS)
    assert power[(f < 0.9) | (f > 5.1)].sum() < 1e-3 * power.sum()
    assert math.sqrt(np.mean(x**2)) == pytest.approx(0.002)
    assert np.array_equal(planned(text).path_m, plan.path_m)
    assert not np.allclose(planned(text.replace("seed = 3", "seed = 4")).path_m, plan.path_m)


def test_time_scale_makes_a_history_so_much_slower() -> None:
    text = 'history = { kind = "sine", amplitude_m = 0.01, frequency_hz = 4, cycles = 2 }'
    fast, slow = planned(text), planned(text, scale=8.0)
    own = (fast.path_m.size - 1025, slow.path_m.size - 1025)
    assert own[1] == 8 * own[0]
    assert np.allclose(slow.path_m[: own[1] : 8], fast.path_m[: own[0]], atol=1e-15)
    assert slow.peak_m_per_s == pytest.approx(fast.peak_m_per_s / 8, rel=1e-3)


def test_velocity_and_acceleration_of_a_slow_history_are_the_laboratorys_by_default() -> None:
    fast, slow = planned(FEMA, 0.2), planned(FEMA, 0.2, 10.0)
    assert slow.peak_m_per_s <= 0.005 * (1 + 1e-9)
    # The ways that the acceleration has made long are no longer so in slow motion.
    assert slow.peak_m_per_s2 <= 0.2
    assert slow.path_m.size < 10 * fast.path_m.size


# ---- files --------------------------------------------------------------------------------------


def test_amplitudes_and_cycles_come_from_a_csv_file_and_stay_in_the_test(tmp_path: Path) -> None:
    (tmp_path / "steps.csv").write_text("# mine\namplitude_mm, cycles\n2, 3\n4.5, 1\n\n")
    path = tmp_path / "t.toml"
    path.write_text(HEAD + 'history = { kind = "cycles", file = "steps.csv", frequency_hz = 1 }')
    test = config.load_test(path)
    assert [(s.amplitude_m, s.cycles) for s in test.history.steps] == [(0.002, 3), (0.0045, 1)]  # type: ignore[union-attr]
    assert config.parse_test(config.dump(test)) == test
    assert "steps.csv" not in config.dump(test)


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("amplitude_mm,cycles\n2,3\nx,1\n", 3, 'found "x"; the amplitude must be a number'),
        ("amplitude_mm,cycles\n2,1.5\n", 2, 'found "1.5"; cycles must be a whole number'),
        ("amplitude_mm,cycles\n2,0\n", 2, "from 1 to 10000"),
        ("amplitude_mm,cycles\n-2,1\n", 2, "from 1e-6 to 10 m"),
        ("amplitude_mm,cycles\nnan,1\n", 2, "must be a number"),
        ("amplitude_kg,cycles\n2,1\n", 1, "must be a length"),
        ("size,cycles\n2,1\n", 1, "found the columns size, cycles"),
        ("amplitude_mm\n", 0, "and one line for each step"),
    ],
)
def test_a_csv_file_with_a_fault_is_told_by_its_line(
    tmp_path: Path, text: str, line: int, says: str
) -> None:
    (tmp_path / "s.csv").write_text(text)
    given = history('history = { kind = "cycles", file = "s.csv", frequency_hz = 1 }')
    assert isinstance(given, CyclesHistory)
    with pytest.raises(InputError) as error:
        with_file(given, tmp_path)
    assert says in str(error.value)
    assert line == 0 or f"s.csv:{line}" in str(error.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (f"{FEMA}\nnumerical = {{ period_s = 1, damping_ratio = 0 }}", "numerical: found a table"),
        (f"{FEMA}\nground_motion = {{ pga_g = 0.1 }}", "ground_motion: found a table"),
        ('history = { kind = "fema", target_m = 1 }', "did you mean"),
        ('history = { kind = "sine", amplitude_m = 0.01 }', "history.frequency_hz: missing"),
        (FEMA.replace("velocity_m_per_s", "frequency_hz = 1, velocity_m_per_s"), "both given"),
        ('history = { kind = "cycles", amplitudes_m = [1, 2], cycles = [1], frequency_hz = 1 }',
         "found 1 numbers; amplitudes_m has 2"),
        ('history = { kind = "sweep", amplitude_m = 0.01, from_hz = 1, to_hz = 2, duration_s = 1 }',
         "at most 0.5 s"),
        ('history = { kind = "random", from_hz = 2, to_hz = 1, peak_m = 0.01, duration_s = 9 }',
         "must be above from_hz"),
    ],
)  # fmt: skip
def test_what_a_history_cannot_be_is_told_with_its_key(text: str, says: str) -> None:
    with pytest.raises(InputError) as error:
        config.parse_test(HEAD + text)
    assert says in str(error.value)


def test_a_length_beside_a_history_is_refused() -> None:
    with pytest.raises(InputError, match="the length of a history follows from its own keys"):
        config.parse_test(
            f'schema = "rthyb-test/1"\ntest = {{ name = "h", duration_s = 3 }}\n{FEMA}'
        )


def test_too_fast_and_too_long_histories_are_refused() -> None:
    with pytest.raises(InputError, match="at most 128 Hz is allowed"):
        planned('history = { kind = "sine", amplitude_m = 0.01, frequency_hz = 200, cycles = 3 }')
    with pytest.raises(InputError, match="at most 14745600 are allowed"):
        planned(
            'history = { kind = "sine", amplitude_m = 0.01, frequency_hz = 0.001, cycles = 30 }'
        )
    with pytest.raises(InputError, match="has no spectral line"):
        planned(
            'history = { kind = "random", from_hz = 1.01, to_hz = 1.02, peak_m = 0.01, '
            "duration_s = 9 }"
        )


def test_a_history_has_no_control_law_unless_one_is_named() -> None:
    assert config.parse_test(HEAD + FEMA).controller.type == "none"
    assert (
        config.parse_test(f"{HEAD}{FEMA}\n[controller.rfc]\nenabled = true").controller.type
        == "none"
    )
    assert (
        config.parse_test(f'{HEAD}{FEMA}\n[controller]\ntype = "robust"').controller.type
        == "robust"
    )


# ---- under all limits ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        (
            "command_position_m = 0.007",
            "found a peak of 0.008 m; limits.command_position_m = 0.007",
        ),
        ("command_velocity_m_per_s = 0.03", "limits.command_velocity_m_per_s = 0.03 m/s"),
        ("command_acceleration_m_per_s2 = 0.2", "limits.command_acceleration_m_per_s2 = 0.2"),
        ('command_increment_m = { value = 1e-5, action = "trip" }', "command_increment_m"),
    ],
)
def test_a_history_beyond_a_limit_is_refused_before_anything_moves(limit: str, says: str) -> None:
    test = config.parse_test(f"{HEAD}{CYCLES}\n[limits]\n{limit}")
    with pytest.raises(InputError) as error:
        experiment.prepare(test, rig_of(SPRING))
    assert says in str(error.value)


def test_a_history_within_its_limits_leaves_as_it_is_written() -> None:
    limits = "[limits]\ncommand_velocity_m_per_s = 0.051\ncommand_acceleration_m_per_s2 = 0.4"
    setup = experiment.prepare(config.parse_test(f"{HEAD}{CYCLES}\n{limits}"), rig_of(SPRING))
    rec = virtual_time.run(setup)
    run = rec.samples[rec.running()]
    assert rec.meta["end_reason"] == "completed"
    assert not np.any(run["flags"] & core.FLAGS["limited"])
    assert np.allclose(run["x_cmd_m"][1:], setup.ag_mps2[:-1], rtol=0, atol=1e-12)


def test_a_force_limit_that_the_model_would_reach_is_a_warning_and_not_a_refusal() -> None:
    """The motion is known before the test; the force is that of a model of the specimen."""
    test = rt.Test("fema-461").with_({"limits.force_n": 500})
    (warning,) = (text for text in rt.check(test).warnings if "limits.force_n" in text)
    assert "0.5 kN is below the peak of" in warning
    assert rt.run(test).ending.startswith("force 0.5")
    with pytest.raises(rt.InputError, match=r"found a peak of 0\.04 m; limits.command_pos"):
        rt.check(test.with_({"limits.command_position_m": 0.001}))


def test_a_force_limit_ends_a_history() -> None:
    rec = recorded(f"{CYCLES}\n[limits]\nforce_n = 6000", rig_of(SPRING))
    assert rec.meta["end_reason"] != "completed"
    found = summary.summarize(rec)
    assert [one.amplitude_m for one in found.loops] == [0.004]


def test_check_shows_the_peaks_beside_the_limits() -> None:
    test = config.parse_test(f"{HEAD}{CYCLES}\n[limits]\ncommand_velocity_m_per_s = 0.1")
    found = examine(test, rig_of(SPRING))
    rows = {row[0]: row for row in found.tables()[0]}
    assert rows["Peak velocity"][1:] == ("50.3 mm/s", "limit 100 mm/s")
    assert rows["Step 2"][1] == "8.00 mm, 2 cycles"
    assert found.loop is None
    assert found.document()["figures"]["reference_peak_n"] == pytest.approx(8000, rel=1e-3)


# ---- what the loops show ------------------------------------------------------------------------


def test_loops_of_a_spring_and_a_damper_are_those_of_the_closed_form() -> None:
    c, k, f = 2e4, 1e6, 1.0
    rig = rig_of(f'{SPRING}[[specimen]]\nelement = "viscous"\nc_n_s_per_m = {c}\n')
    text = 'history = { kind = "cycles", amplitudes_m = [0.01], cycles = 4, frequency_hz = 1 }'
    (found,) = summary.summarize(recorded(text, rig)).loops
    middle = found.loops[1]
    w, x = 2 * math.pi * f, 0.01
    assert middle.secant_n_per_m == pytest.approx(k, rel=2e-3)
    assert middle.energy_j == pytest.approx(math.pi * c * w * x**2, rel=2e-3)
    assert middle.damping_ratio == pytest.approx(c * w / (2 * k), rel=4e-3)


def test_loops_of_dry_friction_take_four_times_force_times_amplitude() -> None:
    rig = rig_of(f'{SPRING}[[specimen]]\nelement = "coulomb"\nfc_n = 500\n')
    for one in summary.summarize(recorded(CYCLES, rig)).loops:
        assert one.last.energy_j == pytest.approx(4 * 500 * one.amplitude_m, rel=1e-2)
        assert one.first.upper[0] == pytest.approx(one.amplitude_m, rel=2e-3)


def test_backbone_of_a_yielding_specimen_is_its_own_curve() -> None:
    rig = config.load_rig(config.shipped_rig("delay-10-bouc-wen"))
    text = 'history = { kind = "aisc-341", height_m = 1, frequency_hz = 0.5 }'
    rec = recorded(text, rig)
    found = hysteresis.amplitudes(rec)
    (element,) = experiment.specimen_elements(rig)
    plan = hysteresis.plan_of(rec)
    assert plan is not None
    h = 1 / FS
    own = core.CoreElement(element).run(
        plan.path_m, np.gradient(plan.path_m, h), np.zeros_like(plan.path_m), h
    )
    for one in found:
        cycle = next(c for c in plan.cycles if c.amplitude_m == one.amplitude_m)
        part = slice(cycle.start, cycle.stop)
        x, f = plan.path_m[part], np.asarray(own)[part]
        assert one.first.upper[1] == pytest.approx(f[np.argmax(x)], rel=5e-3)
        assert one.first.energy_j == pytest.approx(
            np.sum(0.5 * (f[1:] + f[:-1]) * np.diff(x)), rel=0.02
        )
    assert found[-1].last.secant_n_per_m < 0.5 * found[0].last.secant_n_per_m


def test_a_hybrid_test_has_no_loops_by_amplitude(built_in_recording: RecordedTest) -> None:
    assert summary.summarize(built_in_recording).loops == ()


@pytest.fixture(scope="module")
def built_in_recording() -> RecordedTest:
    test = config.load_test(config.builtin_test_path(), {"ground_motion.duration_s": "2"})
    return virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))


# ---- all the ways a test goes -------------------------------------------------------------------


@pytest.mark.long
def test_a_history_goes_through_run_replay_report_and_export(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "h.toml"
    path.write_text(f'rig = "shaking-table-portal-frame"\n{HEAD}{CYCLES}')
    assert cli.main(["run", str(path), "--out", str(tmp_path / "run")]) == 0
    out = capsys.readouterr().out
    assert "cycles, 2 amplitudes from 4 to 8 mm" in out
    assert "Loops at 8.00 mm" in out
    assert "Response" not in out
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Prescribed history" in page
    assert "Loops by amplitude" in page
    assert "Backbone" in page
    assert "ground acceleration" not in page  # of which a history has none, to zoom into or to see
    assert cli.main(["replay", str(tmp_path / "run")]) == 0
    assert "bit-identical" in capsys.readouterr().out
    # What was kept of it runs again as it stands.
    assert cli.main(["check", str(tmp_path / "run" / "test.toml")]) == 0


def test_a_history_in_real_time_sends_the_same_commands() -> None:
    test = config.parse_test(HEAD + CYCLES)
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    setup = experiment.prepare(test, rig, real_time=True)
    ours, theirs = opening.socket_pair()
    with ours, theirs, virtual_rig.in_step(rig, theirs) as drive:
        rec = realtime.run(setup, ours, clock="stepped", before_tick=drive.tick)
    assert rec.meta["end_reason"] == "completed"
    run = rec.samples[rec.running()]
    assert np.allclose(run["x_num_m"][1:], setup.ag_mps2[: run.size - 1], atol=1e-12)
    assert len(summary.summarize(rec).loops) == 2
    assert realtime.replay(rec).identical


def test_the_service_takes_a_history_as_it_takes_a_test(tmp_path: Path) -> None:
    test = config.parse_test(HEAD + CYCLES)
    with bench(tmp_path) as lab:
        loaded = lab.engine.prepare(test, experiment.load_motion(test))
        lab.engine.load(loaded)
        lab.reach("RUNNING")
        lab.finish()
    (rec,) = left(tmp_path)
    assert np.count_nonzero(rec.samples["state"] == core.STATES.index("RUNNING")) >= 5 * 1024
    assert [len(one.loops) for one in summary.summarize(rec).loops] == [2, 2]


def test_a_held_history_goes_on_where_it_was_left() -> None:
    setup = experiment.prepare(config.parse_test(HEAD + CYCLES), rig_of(SPRING))
    rig = virtual_time.Bench(setup)
    rig.advance(1)
    rig.command("zero")
    while rig.state != "ZEROED":
        rig.advance(64)
    rig.command("arm")
    rig.command("start")
    while rig.state != "RUNNING":
        rig.advance(256)
    rig.advance(1300)
    rig.command("hold")
    rig.advance(2048)
    rig.command("resume")
    while rig.state in ("HOLD", "RUNNING", "RAMP_OUT"):
        rig.advance(4096)
    rec = rig.recording()
    run = rec.samples[rec.samples["state"] == core.STATES.index("RUNNING")]
    assert rec.meta["end_reason"] == "completed"
    assert rec.meta["interrupted"]
    assert np.abs(run["x_num_m"]).max() == pytest.approx(0.008, rel=1e-6)
    # In HOLD the command may run on by its brake, and comes back: no step anywhere.
    x = rec.samples["x_num_m"]
    assert np.abs(np.diff(x)).max() * FS < 1.05 * 0.0503


def test_a_recorded_history_reads_back(tmp_path: Path) -> None:
    rec = recorded(CYCLES, rig_of(SPRING))
    recording.write(tmp_path / "r.h5", rec)
    again = recording.read(tmp_path / "r.h5")
    assert again.ground_motion["source"] == "history of the test file"
    assert again.reference is None
    assert len(hysteresis.amplitudes(again)) == 2


def test_a_mat_file_calls_a_history_what_it_is(tmp_path: Path) -> None:
    from scipy.io import loadmat

    rec = recorded(CYCLES, rig_of(SPRING))
    mat_csv.to_mat(rec, tmp_path / "r.mat")
    motion = loadmat(tmp_path / "r.mat", simplify_cells=True)["ground_motion"]
    assert "ag_mps2" not in motion
    assert np.abs(motion["history_m"]).max() == pytest.approx(0.008)
