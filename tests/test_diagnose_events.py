"""What happens in the middle of a test: a load cell that jumps, an amplifier that is switched, a
pump that falls off. The recordings are made by `event_cases`, without the package, and scored on
seeds other than those that the search was developed on (1 to 3)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import diagnose_cases as cases
import numpy as np
import pytest
from event_cases import Rig, late, moved, on_ground, recorded, rig
from test_diagnose_steady import along, fitted

from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion, actuator
from rthyb_rt.diagnose import effects, engine, evidence, onset, outcome, reading, result, why
from rthyb_rt.diagnose.case import Model
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.fitter import SetFitter
from rthyb_rt.diagnose.problem import Member
from rthyb_rt.diagnose.refinement import refine

SEEDS = (101, 102)
"""Two rigs, of which every scenario has one."""
TOLD_S = 0.1
"""By which a beginning may be told wrong: a hundredth of the test, a tenth of a cycle."""
Paths = tuple[Path, Path]
Scenario = Callable[[Rig, Path], Paths]


def since(bench: Rig) -> np.ndarray:
    return (bench.t >= bench.t0).astype(float)


def usual(bench: Rig) -> tuple[float, float]:
    """Usual force and velocity of the test."""
    x, v, _ = moved(bench, bench.lag, bench.lag)
    return float(np.std(bench.k * x)), float(np.std(v))


def either(bench: Rig, low: float, high: float) -> float:
    return float(bench.random.choice([-1.0, 1.0]) * bench.random.uniform(low, high))


def diagnosed(paths: Paths) -> result.DiagnosisResult:
    return engine.diagnose(reading.read_case(paths[0], reading.read_model(paths[1])))


def in_turn(scenarios: Iterable[Scenario], *quick: Scenario) -> list[Any]:
    """Every scenario on one of the rigs; all but a few of them take long."""
    return [
        pytest.param(
            one, SEEDS[i % 2], id=one.__name__, marks=() if one in quick else pytest.mark.long
        )
        for i, one in enumerate(scenarios)
    ]


def begun(d: result.DiagnosisResult) -> dict[str, float]:
    """Effects named that begin in mid-record, and when."""
    return {c.name: c.from_s for c in d.candidates if c.name in d.effects and c.from_s is not None}


# ---- the load cell ------------------------------------------------------------------------------


def cell_jumps(bench: Rig, folder: Path) -> Paths:
    jump = either(bench, 0.04, 0.12) * usual(bench)[0]
    return recorded(bench, folder, cell=lambda f, fy: f + jump * since(bench))


def amplifier_range_switched(bench: Rig, folder: Path) -> Paths:
    gain = either(bench, 0.05, 0.12)
    return recorded(bench, folder, cell=lambda f, fy: f * (1.0 + gain * since(bench)))


def side_clamp_loosens(bench: Rig, folder: Path) -> Paths:
    ratio = either(bench, 0.08, 0.2)
    return recorded(bench, folder, cell=lambda f, fy: f + ratio * fy * since(bench))


def logger_loses_a_block(bench: Rig, folder: Path) -> Paths:
    skew_s = either(bench, 0.002, 0.006)

    def cell(f: np.ndarray, fy: np.ndarray) -> np.ndarray:
        return np.where(since(bench) > 0.0, late(f, skew_s, bench.fs_hz), f)

    return recorded(bench, folder, cell=cell)


def cell_begins_to_wander(bench: Rig, folder: Path) -> Paths:
    end = either(bench, 0.15, 0.4) * usual(bench)[0]
    way = np.maximum(bench.t - bench.t0, 0.0) / (bench.t[-1] - bench.t0)
    return recorded(bench, folder, cell=lambda f, fy: f + end * way)


def pump_starts_to_hum(bench: Rig, folder: Path) -> Paths:
    hum = bench.random.uniform(0.04, 0.1) * usual(bench)[0] * np.sin(100 * np.pi * bench.t + 1.0)
    return recorded(bench, folder, cell=lambda f, fy: f + hum * since(bench))


# ---- the actuator -------------------------------------------------------------------------------


def servo_gain_turned(bench: Rig, folder: Path) -> Paths:
    return recorded(bench, folder, after={"gain": 1.0 + either(bench, 0.03, 0.1)})


def network_slower(bench: Rig, folder: Path) -> Paths:
    more = bench.random.uniform(0.002, 0.008)
    return recorded(bench, folder, after={"delay_s": bench.delay_s + more})


def air_in_the_oil(bench: Rig, folder: Path) -> Paths:
    u = bench.random.uniform
    softer = {"f_hz": bench.f_hz * u(0.4, 0.7), "zeta": bench.zeta * u(0.5, 1.0)}
    return recorded(bench, folder, after=softer)


# ---- one throughout, one from a moment on -------------------------------------------------------


def dashpot_unknown_and_cell_jumps(bench: Rig, folder: Path) -> Paths:
    force, speed = usual(bench)
    c, jump = bench.random.uniform(0.06, 0.15) * force / speed, either(bench, 0.05, 0.12) * force
    return recorded(bench, folder, lambda t, x, v, a: c * v, lambda f, fy: f + jump * since(bench))


def friction_and_side_clamp(bench: Rig, folder: Path) -> Paths:
    force, speed = usual(bench)
    dry, ratio = bench.random.uniform(0.06, 0.12) * force, either(bench, 0.1, 0.2)
    return recorded(
        bench, folder, lambda t, x, v, a: dry * np.tanh(v / (0.01 * speed)),
        lambda f, fy: f + ratio * fy * since(bench),
    )  # fmt: skip


def delay_wrong_and_gain_turned(bench: Rig, folder: Path) -> Paths:
    before = {"delay_s": bench.delay_s + bench.random.uniform(0.002, 0.006)}
    return recorded(bench, folder, before=before, after={"gain": 1.0 + either(bench, 0.04, 0.1)})


def friction_and_network_slower(bench: Rig, folder: Path) -> Paths:
    force, speed = usual(bench)
    dry = bench.random.uniform(0.05, 0.12) * force
    later = {"delay_s": bench.delay_s + bench.random.uniform(0.002, 0.008)}
    return recorded(
        bench, folder, lambda t, x, v, a: dry * np.tanh(v / (0.01 * speed)), after=later
    )


EVENTS: dict[Scenario, tuple[set[str], str]] = {
    cell_jumps: ({"bias"}, "bias"),
    amplifier_range_switched: ({"stiffness"}, "stiffness"),
    side_clamp_loosens: ({"crosstalk"}, "crosstalk"),
    logger_loses_a_block: ({"time_skew"}, "time_skew"),
    cell_begins_to_wander: ({"drift"}, "drift"),
    pump_starts_to_hum: ({"hum"}, "hum"),
    servo_gain_turned: ({"act_gain"}, "act_gain"),
    network_slower: ({"delay"}, "delay"),
    air_in_the_oil: ({"oil_column"}, "oil_column"),
    dashpot_unknown_and_cell_jumps: ({"viscous", "bias"}, "bias"),
    friction_and_side_clamp: ({"coulomb", "crosstalk"}, "crosstalk"),
    delay_wrong_and_gain_turned: ({"delay", "act_gain"}, "act_gain"),
    friction_and_network_slower: ({"coulomb", "delay"}, "delay"),
}
"""What is wrong, and which of it only from t0 on."""


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "seed"), in_turn(EVENTS, network_slower))
def test_what_happens_in_mid_test_is_named_with_when(
    scenario: Scenario, seed: int, tmp_path: Path
) -> None:
    names, later = EVENTS[scenario]
    bench = rig(seed)
    d = diagnosed(scenario(bench, tmp_path))
    assert (d.verdict, set(d.effects)) == ("explained", names)
    told = begun(d)
    assert set(told) == {later}
    assert told[later] == pytest.approx(bench.t0, abs=TOLD_S)
    assert any(later in note and f"{told[later]:.4g} s" in note for note in d.notes)
    if len(names) == 1:
        assert d.windows[0][0] >= told[later] - 1.0 / bench.fs_hz
    said = result.to_json(d)
    assert [c["from_s"] for c in said["candidates"] if c["name"] == later] == [told[later]]


# ---- nothing of the kind ------------------------------------------------------------------------


def nothing(bench: Rig, folder: Path) -> Paths:
    return recorded(bench, folder)


def dashpot_unknown(bench: Rig, folder: Path) -> Paths:
    force, speed = usual(bench)
    c = bench.random.uniform(0.06, 0.15) * force / speed
    return recorded(bench, folder, lambda t, x, v, a: c * v)


def cell_late(bench: Rig, folder: Path) -> Paths:
    skew_s = either(bench, 0.002, 0.006)
    return recorded(bench, folder, cell=lambda f, fy: late(f, skew_s, bench.fs_hz))


def delay_wrong(bench: Rig, folder: Path) -> Paths:
    more = bench.random.uniform(0.002, 0.008)
    return recorded(bench, folder, before={"delay_s": bench.delay_s + more})


THROUGHOUT: dict[Scenario, set[str]] = {
    nothing: set(), dashpot_unknown: {"viscous"}, cell_late: {"time_skew"}, delay_wrong: {"delay"},
}  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize(("scenario", "seed"), in_turn(THROUGHOUT, nothing))
def test_what_is_there_throughout_begins_nowhere(
    scenario: Scenario, seed: int, tmp_path: Path
) -> None:
    d = diagnosed(scenario(rig(seed), tmp_path))
    assert set(d.effects) == THROUGHOUT[scenario]
    assert begun(d) == {}


@pytest.mark.long
def test_crosstalk_of_a_noisy_orthogonal_cell_has_its_true_ratio(tmp_path: Path) -> None:
    """A reading with a quarter of noise: least squares on it finds a ratio 6 % too small."""
    # Noise of that size in fewer rows would be more of it where the signal is.
    bench = rig(SEEDS[0], 1024.0)
    ratio = either(bench, 0.15, 0.3)
    d = diagnosed(recorded(bench, tmp_path, cell=lambda f, fy: f + ratio * fy, fy_std=0.25))
    assert (d.verdict, d.effects) == ("explained", ["crosstalk"])
    assert d.candidates[0].params["ratio"] == pytest.approx(ratio, rel=0.01)


# ---- channels that say the same twice -----------------------------------------------------------


@pytest.mark.long
def test_a_late_cell_on_a_shaking_table_is_no_dashpot(tmp_path: Path) -> None:
    """Around resonance both turn the force alike; the body's own acceleration tells them apart."""
    d = diagnosed(on_ground(SEEDS[0], tmp_path, cell=lambda f, fs: late(f, 0.004, fs)))
    assert (d.verdict, d.effects) == ("explained", ["time_skew"])
    assert d.candidates[0].params["skew_s"] == pytest.approx(0.004, abs=4e-4)
    facts = dict(why.facts(d))
    assert "the load cell itself" in facts["load cell compared with m a_meas"]


@pytest.mark.long
def test_a_dashpot_on_a_shaking_table_is_no_late_cell(tmp_path: Path) -> None:
    d = diagnosed(on_ground(SEEDS[1], tmp_path, dashpot=1.0))
    assert (d.verdict, d.effects) == ("explained", ["viscous"])


def test_an_accelerometer_at_fault_is_said_and_no_witness_against_the_cell(tmp_path: Path) -> None:
    """Its charge amplifier delays it by 3 ms and shows it 6 % too large; the cell is right."""
    paths = on_ground(SEEDS[1], tmp_path, felt=lambda a, fs: 1.06 * late(a, 0.003, fs))
    d = diagnosed(paths)
    (note,) = [n for n in d.notes if n.startswith("a_meas ")]
    told = re.fullmatch(r"a_meas is \+(.*) % larger and is \+(.*) ms later than .*", note)
    assert told is not None
    assert float(told[1]) == pytest.approx(6.0, abs=0.5)
    assert float(told[2]) == pytest.approx(3.0, abs=0.15)
    assert "time_skew" not in d.effects


# ---- what follows from it -----------------------------------------------------------------------


@pytest.mark.long
def test_another_recording_is_foretold_with_what_began_in_the_first(tmp_path: Path) -> None:
    """A cell that has jumped is off by as much from the first row of the next test."""
    bench = rig(101)
    jump = 0.1 * usual(bench)[0]
    d = diagnosed(recorded(bench, tmp_path, cell=lambda f, fy: f + jump * since(bench)))
    again = rig(101)
    again.command = 0.8 * again.command[::-1].copy()
    other = recorded(again, tmp_path / "next", cell=lambda f, fy: f + jump)
    held = reading.read_case(other[0], reading.read_model(other[1]))
    found = outcome.finish(d, held, None)
    assert d.verdict == "explained"
    assert found.heldout["heldout_nrmse_after"] < 0.2 * found.heldout["heldout_nrmse_before"]


def test_an_actuator_that_changes_goes_on_from_where_it_is() -> None:
    """Held against the independent stepping of `event_cases`, the moment between two rows."""
    bench = rig(103)
    bench.t0 = float(bench.t[1500]) + 0.375 / bench.fs_hz
    after = {"gain": 1.05, "f_hz": 0.6 * bench.f_hz, "delay_s": bench.delay_s + 0.003}
    x, v, _ = moved(bench, bench.lag, bench.lag | after)
    first = ActuatorModel(bench.delay_s, bench.f_hz, bench.zeta)
    then = ActuatorModel(after["delay_s"], after["f_hz"], bench.zeta, after["gain"])
    made = actuator(then, bench.command, bench.fs_hz, (bench.t0 * bench.fs_hz, first))
    plain = actuator(first, bench.command, bench.fs_hz)
    assert np.array_equal(made.x[:1501], plain.x[:1501])
    # What the fine steps of the other simulation differ by where nothing changes.
    alike = np.max(np.abs(plain.x[:1501] - x[:1501])), np.max(np.abs(plain.v[:1501] - v[:1501]))
    assert np.max(np.abs(made.x - x)) < 3.0 * alike[0]
    assert np.max(np.abs(made.v - v)) < 3.0 * alike[1]


def test_an_offset_found_beside_a_drift_is_tried_alone_from_the_same_instant() -> None:
    """The drift may have been needed for slow noise only, before its colour was known."""
    problem, _ = fitted(lambda t, x, v: 60.0 * (t > 4.3), "drift")
    laws = effects.catalogue()
    begun = Member(onset.Late(laws["bias"]), Trial((4.3,)))
    fitter = SetFitter(problem)
    both = refine(problem, [Member(laws["drift"], Trial()), begun])
    assert both is not None
    fitter.keep(both)
    onset.settle(fitter, 3)
    alone = fitter.by_names["bias",]
    assert alone.members[0].trial.theta[-1] == pytest.approx(4.3, abs=0.02)
    assert alone.chi2 < both.chi2 + 9.0


@pytest.mark.parametrize(
    ("gain", "k_off", "absent"),
    [((0.0, 0.03), 0.02, True), ((0.0, 0.03), -0.02, True), ((0.021, 0.03), -0.02, False)],
    ids=["a stiffer spring", "a softer spring", "a gain from the start"],
)
def test_amplifier_that_fails_in_mid_test_is_told_from_a_stiffness_within_its_tolerance(
    gain: tuple[float, float], k_off: float, absent: bool
) -> None:
    """A gain also scales damping and inertia, which are most of this specimen's force."""
    k, c, m = 5e4, 1.5e4, 300.0
    x, v, a = cases.moved(cases.command())
    t = np.arange(x.size) / cases.FS
    factor = 1.0 + np.where(t > 4.0, gain[1], gain[0])
    force_n = factor * (k * (1.0 + k_off) * x + c * v + m * a)
    force_n = force_n + cases.F_STD * np.random.default_rng(1).standard_normal(x.size)
    model = Model(
        "drive", cases.FS, k=k, c=c, moving_mass=m, k_tol=0.01, c_tol=0.15, f_std=cases.F_STD
    )
    problem = along(model, t, ComputedMotion(x, v, a), force_n)
    law = effects.catalogue()["stiffness"]
    fit = refine(problem, [Member(onset.Late(law), Trial((4.0,), "gain"))])
    assert fit is not None
    assert onset.absent_before(problem, fit) is absent


def test_a_stop_that_is_touched_once_for_a_tenth_of_a_second_is_named(tmp_path: Path) -> None:
    """Held out in blocks of a quarter of a second, no other block would have confirmed it."""
    rng = np.random.default_rng(5)
    t = np.arange(2048) / cases.FS
    u = cases.command() * (1.0 + 0.5 * np.exp(-(((t - 3.1) / 0.2) ** 2)))
    x, v, a = cases.moved(u)
    peaks = np.sort(x[1:-1][(x[1:-1] > x[:-2]) & (x[1:-1] > x[2:])])
    stop_m = 0.5 * float(peaks[-1] + peaks[-2])
    force_n = cases.K * x + cases.C * v + cases.M * a + 4e6 * np.maximum(x - stop_m, 0.0)
    touched = x > stop_m
    assert 10 < touched.sum() < 40
    assert np.abs(np.diff(touched.astype(int))).sum() == 2
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + cases.X_STD * rng.standard_normal(t.size),
        "f_meas": force_n + cases.F_STD * rng.standard_normal(t.size),
    }
    d = diagnosed(cases.write(tmp_path, columns))
    assert (d.verdict, d.effects) == ("explained", ["stopper"])
    assert d.candidates[0].params["xs_m"] == pytest.approx(stop_m, rel=0.02)


def test_a_strong_damper_that_locks_in_at_speed_leaves_only_noise() -> None:
    """With a smooth start, what it leaves there moves the stated values out of their tolerances."""
    c2, begins_s = 2e7, 4.3021
    problem, _ = fitted(lambda t, x, v: c2 * v * np.abs(v) * (t > begins_s), "quad_damping")
    law = effects.catalogue()["quad_damping"]
    smooth = refine(problem, [Member(onset.Late(law), Trial((4.3,)))])
    fit = onset._begun(SetFitter(problem), [Member(onset.Late(law), Trial((4.25,)))])
    assert smooth is not None
    assert fit is not None
    assert smooth.chi2 > 20.0 * problem.y.size
    assert fit.chi2 == pytest.approx(problem.y.size, rel=0.15)
    assert fit.members[0].trial.theta[-1] == pytest.approx(begins_s, abs=1.0 / cases.FS)
    assert fit.betas[0][0] == pytest.approx(c2, rel=0.01)


@pytest.mark.parametrize(("count", "cycles"), [(0.75, 1.0), (1.0, 1.0), (2.0, 2.0), (3.5, 3.5)])
def test_cycles_of_a_motion_are_counted_by_its_sides(count: float, cycles: float) -> None:
    phase = np.linspace(0.0, 2.0 * np.pi * count, 4000)
    for x in (np.sin(phase), 5.0 + 1e-3 * np.sin(phase), np.sin(phase) + 0.02 * np.sin(31 * phase)):
        assert evidence.cycles(x) == cycles
