"""The rigs that come with the program: what they state is what follows from size, oil and drive."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.config.rigfile import SecondOrder, ServoHydraulic
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.rig import identify

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
    found = identify.identify(rig, identify.SweepPlan.up_to(10.0))
    slow = len(found.tones)
    assert found.alpha == pytest.approx(said.alpha, rel=0.01)
    assert found.delay_s == pytest.approx(said.delay_s, rel=0.01)
    assert np.allclose([t.gain for t in found.tones], said.amplitude[:slow], rtol=0.01)
    assert np.allclose(
        [t.delay_s for t in found.tones], said.delay_at_frequency_s[:slow], rtol=0.01
    )
    assert found.k_e_n_per_m == pytest.approx(rig.rig.elastic_stiffness_n_per_m, rel=0.01)
    assert max(said.frequency_hz) >= 40.0


@pytest.mark.parametrize("name", NEW)
def test_a_hybrid_test_runs_on_each_of_them(name: str) -> None:
    rig = shipped(name)
    peak_g = 0.3 if name == "hydraulic-250kn" else 0.1
    test = config.parse_test(
        'schema = "rthyb-test/1"\n[test]\nname = "t"\nfree_vibration_s = 1\n'
        f"[ground_motion]\npga_g = {peak_g}\nduration_s = 10\n"
        '[numerical]\nperiod_s = 0.6\ndamping_ratio = 0.05\n[controller]\ntype = "alpha-beta"\n'
    )
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
    # What is written out of it has all figures, and says nothing any more.
    again = config.parse_rig(config.dump(rig))
    assert not any(
        " of its actuator, so the values of " in note
        for note in config.derive(config.load_test(config.builtin_test_path()), again).notes
    )


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.stem)
def test_no_shipped_test_is_sure_to_reach_its_own_limits(path: Path) -> None:
    warnings = rt.check(rt.Test(path)).warnings
    assert not [said for said in warnings if "the test will reach it" in said]
