"""The rigs that come with the program: what they state is what follows from size, oil and drive."""

from __future__ import annotations

import math
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.analysis import loop_roots, summary
from rthyb_rt.config.rigfile import SecondOrder, ServoHydraulic
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.rig import identification

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
BULK_MODULUS_PA = 1e9
PRESSURE_PA = 21e6
DEAD_VOLUME = 1.2
HYDRAULIC = {
    # stroke m, rated flow of the valve m^3/s at 7 MPa
    "hydraulic-25kn": (0.150, 38e-3 / 60),
    "hydraulic-250kn": (0.250, 250e-3 / 60),
}
NEW = [*HYDRAULIC, "electric-cylinder-20kn"]
ONE_AXIS = sorted(set(config.shipped("rig")) - {"two-axis-frame"})


def text_of_test(
    peak_g: float, law: str, duration_s: float = 10.0, free_vibration_s: float = 1.0
) -> str:
    return (
        f'schema = "rthyb-test/1"\n[test]\nname = "t"\nfree_vibration_s = {free_vibration_s}\n'
        f"[ground_motion]\npga_g = {peak_g}\nduration_s = {duration_s}\n"
        f'[numerical]\nperiod_s = 0.6\ndamping_ratio = 0.05\n[controller]\ntype = "{law}"\n'
    )


def shipped(name: str) -> Any:
    return config.load_rig(config.shipped_rig(name))


@pytest.mark.parametrize("name", HYDRAULIC)
def test_a_hydraulic_rig_follows_from_its_piston_and_valve(name: str) -> None:
    rig = shipped(name)
    table, (stroke_m, flow) = rig.actuator, HYDRAULIC[name]
    assert isinstance(table, ServoHydraulic)
    area = table.stall_force_n / PRESSURE_PA
    assert rig.sensors.displacement.range_m == stroke_m / 2
    column = 4 * BULK_MODULUS_PA * area / (stroke_m * DEAD_VOLUME)
    assert table.oil_stiffness_n_per_m == pytest.approx(column, rel=0.02)
    # The rated flow is at 7 MPa over the valve; without load it has three times that pressure.
    assert table.flow_limit_m_per_s == pytest.approx(flow * math.sqrt(3) / area, rel=0.02)
    omega = math.sqrt(table.oil_stiffness_n_per_m / table.moving_mass_kg)
    zeta = table.oil_damping_n_s_per_m / (2 * table.moving_mass_kg * omega)
    assert table.kp_per_s < 0.2 * 2 * zeta * omega
    assert rig.limits.force_n.value <= 0.8 * table.stall_force_n


def test_the_electric_cylinder_is_two_loops_in_series() -> None:
    drive = shipped("electric-cylinder-20kn").actuator
    assert isinstance(drive, SecondOrder)
    omega, inner = 2 * math.pi * drive.natural_frequency_hz, 2 * math.pi * 80.0
    assert omega**2 == pytest.approx(60.0 * inner, rel=1e-3)
    assert drive.damping_ratio == pytest.approx(inner / (2 * omega), rel=1e-3)


@pytest.mark.parametrize("name", NEW)
def test_what_a_shipped_rig_says_of_itself_is_what_an_identification_finds(name: str) -> None:
    rig = shipped(name)
    said = rig.identified
    found = identification.identify(rig, identification.SweepPlan.up_to(10.0))
    assert found.alpha == pytest.approx(said.alpha, rel=0.01)
    assert found.delay_s == pytest.approx(said.delay_s, rel=0.01)
    assert found.k_e_n_per_m == pytest.approx(rig.rig.elastic_stiffness_n_per_m, rel=0.01)


@pytest.mark.parametrize("name", ONE_AXIS)
def test_the_sweep_of_every_shipped_rig_is_what_an_identification_finds(name: str) -> None:
    rig = shipped(name)
    said = rig.identified
    top_hz = max(said.frequency_hz)
    assert top_hz >= 40.0
    assert f'identify {name} --max-frequency "{top_hz:g} Hz"`' in config.shipped_rig(
        name
    ).read_text(encoding="utf-8")
    tones = identification.identify(rig, identification.SweepPlan.up_to(top_hz)).tones
    assert [t.frequency_hz for t in tones] == said.frequency_hz
    assert np.allclose([t.amplitude_m for t in tones], said.command_amplitude_m, rtol=0.01)
    assert np.allclose([t.gain for t in tones], said.amplitude, rtol=0.01)
    assert np.allclose([t.delay_s for t in tones], said.delay_at_frequency_s, rtol=0.01)
    stiff = rig.rig.elastic_stiffness_n_per_m
    for name_of_part in ("force_in_phase_n_per_m", "force_in_quadrature_n_per_m"):
        measured = [getattr(t, name_of_part) for t in tones]
        assert np.allclose(measured, getattr(said, name_of_part), rtol=0.01, atol=0.01 * stiff)


@pytest.mark.parametrize("name", ["delay-10-elastic", "delay-10-bouc-wen"])
def test_the_sweep_of_a_pure_delay_is_its_delay(name: str) -> None:
    said = shipped(name).identified
    assert set(said.amplitude) == {1.0}
    assert np.allclose(said.delay_at_frequency_s, 10 / 1024, rtol=1e-4)


def test_the_sweep_of_a_first_order_lag_is_its_transfer_function() -> None:
    """1/(1 + s/w) of a command held for a sample: (1 - a) / (z - a) with a = exp(-w h)."""
    said = shipped("first-order-5hz").identified
    omega = 2 * np.pi * np.array(said.frequency_hz)
    a = math.exp(-2 * math.pi * 5.0 / 1024)
    g = (1 - a) / (np.exp(1j * omega / 1024) - a)
    # Four digits are written.
    assert np.allclose(said.amplitude, np.abs(g), rtol=5e-4)
    assert np.allclose(said.delay_at_frequency_s, -np.angle(g) / omega, atol=5e-6)


@pytest.mark.long
@pytest.mark.parametrize("name", [*ONE_AXIS, "two-axis-frame"])
def test_check_judges_the_loop_of_every_shipped_rig(name: str) -> None:
    if name == "two-axis-frame":
        table = rt.check(rt.Test("two-actuator-frame")).table
    else:
        table = rt.check(rt.Test("section5-T0.5", rig=name, limits={"force_n": None})).table
    (row,) = [row for row in table if row[0] == "Largest root"]
    assert re.match(r"[01]\.\d{5} at ", row[1])
    if name in HYDRAULIC:
        # Their friction stops them in faster sines, which are small.
        assert "rig known up to 40 Hz" in row[2]


@pytest.mark.parametrize(
    ("law", "name", "unstable"),
    [
        ("none", "delay-10-elastic", True),
        ("none", "first-order-5hz", True),
        ("none", "shaking-table-can", True),
        ("alpha-beta", "delay-10-elastic", False),
        ("alpha-beta", "first-order-5hz", False),
        ("alpha-beta", "shaking-table-can", False),
    ],
)
def test_the_verdict_on_the_loop_is_what_a_run_shows(law: str, name: str, unstable: bool) -> None:
    """In free vibration, the motion of an elastic specimen grows or fades."""
    text = text_of_test(0.05, law, duration_s=3, free_vibration_s=6)
    text = text.replace("damping_ratio = 0.05", "damping_ratio = 0.02")
    setup = experiment.prepare(config.parse_test(text), shipped(name))
    verdict = loop_roots.judge(setup)
    assert verdict is not None
    assert verdict.unstable == unstable
    rec = virtual_time.run(setup)
    x_m = np.abs(rec.samples["x_num_m"][rec.running()][-6 * 1024 :])
    early, late = x_m[:1024].max(), x_m[-1024:].max()
    assert (late > 1.5 * early) == unstable
    assert (late < early / 1.5) == (not unstable)


@pytest.mark.parametrize("name", NEW)
def test_a_hybrid_test_runs_on_each_of_them(name: str) -> None:
    rig = shipped(name)
    test = config.parse_test(text_of_test(0.3 if name == "hydraulic-250kn" else 0.1, "alpha-beta"))
    rec = virtual_time.run(experiment.prepare(test, rig))
    assert rec.meta["end_reason"] == "completed"
    assert summary.summarize(rec).response_nrmse < 0.15  # type: ignore[operator]


def test_no_shipped_rig_leaves_figures_of_its_actuator_to_another() -> None:
    for name, path in config.shipped("rig").items():
        raw = tomllib.loads(path.read_text(encoding="utf-8"))
        for axis in raw.get("axis", [raw]):
            actuator = axis["actuator"]
            if actuator["kind"] == "servo-hydraulic":
                assert set(ServoHydraulic.model_fields) == set(actuator), name


def test_figures_that_a_rig_leaves_out_are_printed_with_whose_they_are() -> None:
    text = config.shipped_rig("hydraulic-25kn").read_text()
    lines = [line for line in text.splitlines() if not line.startswith(("kp_per_s", "friction_n"))]
    rig = config.parse_rig("\n".join(lines))
    derived = config.derive(config.load_test(config.builtin_test_path()), rig)
    (note,) = [note for note in derived.notes if " of its actuator, so the values of " in note]
    assert "kp_per_s = 63.5, friction_n = 80" in note
    assert "shaking-table-portal-frame" in note
    whole = config.derive(config.load_test(config.builtin_test_path()), shipped("hydraulic-25kn"))
    assert not any(" of its actuator, so the values of " in note for note in whole.notes)
    # What is written out of it has all figures, and goes on saying which are not its own.
    again = config.derive(
        config.load_test(config.builtin_test_path()), config.parse_rig(config.dump(rig))
    )
    assert [one for one in again.notes if " of its actuator, so the values of " in one] == [note]


@pytest.mark.long
@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_no_shipped_test_is_sure_to_reach_its_own_limits(path: Path) -> None:
    warnings = rt.check(rt.Test(path)).warnings
    assert not [said for said in warnings if "the test will reach it" in said]
