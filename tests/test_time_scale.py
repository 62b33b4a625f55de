"""A slow time scale: the same motion of the structure, slower, and what slowness leaves out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rthyb_rt import config, core
from rthyb_rt.analysis import summary
from rthyb_rt.config import timescale
from rthyb_rt.config.deriving import structure_of_test
from rthyb_rt.config.numerical_structure import structure_of
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.report import render

ROOT = Path(__file__).parents[1]
SPRING = '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 666400\n'
DAMPER = '[[specimen]]\nelement = "viscous"\nc_n_s_per_m = 900\n'
STOP = '[[specimen]]\nelement = "stopper"\nks_n_per_m = 1e6\nxs_m = 0.5\n'
ONE = 'period_s = 0.5\ndamping_ratio = 0.02\nintegrator = "{}"\n'
CR = "m_kg = [4000, 3000]\nk_n_per_m = [[9e5, -4e5], [-4e5, 4e5]]\ndamping_ratios = [0.02, 0.03]\n"
STOREYS = """[numerical]
[numerical.storeys]
count = 3
mass_kg = 4000
stiffness_n_per_m = 666400
height_m = 3
specimen = 1
[numerical.damping]
ratio = 0.02
modes = [1, 2]
[[numerical.nonlinear]]
storeys = [2]
beside = true
law = { element = "viscous", c_n_s_per_m = 3000 }
"""


def rig_of(specimen: str = SPRING, samples: int = 0) -> Any:
    return config.parse_rig(
        'schema = "rthyb-rig/1"\n[rig]\nname = "r"\nelastic_stiffness_n_per_m = 666400\n'
        'load_cell = "specimen"\n[actuator]\nkind = "pure-delay"\n'
        f"delay_samples = {samples}\n{specimen}"
    )


def slow_test(numerical: str, scale: float = 1.0, rate_hz: float = 1024.0) -> Any:
    numerical = numerical if numerical.startswith("[") else f"[numerical]\n{numerical}"
    return config.parse_test(
        'schema = "rthyb-test/1"\n'
        f'[test]\nname = "t"\ntime_scale = {scale}\nsample_rate_hz = {rate_hz}\n'
        "free_vibration_s = 1\n[ground_motion]\npga_g = 0.05\nduration_s = 5\n"
        f'[controller]\ntype = "none"\n{numerical}'
    )


STRUCTURES = [
    ONE.format("central-difference"),
    ONE.format("cr"),
    ONE.format("kr-alpha"),
    ONE.format("forward-euler"),
    f'[numerical.matrices]\n{CR}integrator = "cr"\n',
    f'[numerical.matrices]\n{CR}integrator = "rk4"\n',
    STOREYS,
]


@pytest.mark.parametrize("numerical", STRUCTURES)
@pytest.mark.parametrize("specimen", [SPRING, SPRING + DAMPER])
def test_four_times_slower_at_1024_hz_is_the_structure_at_4096_hz(
    numerical: str, specimen: str
) -> None:
    # The same steps of the same equation: only what time is called differs.
    slow = experiment.prepare(slow_test(numerical, 4.0), rig_of(specimen))
    fast = experiment.prepare(slow_test(numerical, 1.0, 4096.0), rig_of(specimen))
    assert slow.ticks == fast.ticks
    assert np.allclose(slow.ag_mps2 * 16.0, fast.ag_mps2, rtol=0, atol=1e-12)
    x, f = fast.reference["x_ref_m"], fast.reference["f_ref_n"]
    assert np.abs(slow.reference["x_ref_m"] - x).max() < 1e-9 * np.abs(x).max()
    assert np.abs(slow.reference["f_ref_n"] - f).max() < 1e-7 * np.abs(f).max()
    assert np.allclose(slow.reference["v_ref_mps"] * 4.0, fast.reference["v_ref_mps"], atol=1e-9)


@pytest.mark.parametrize("numerical", STRUCTURES)
def test_a_slow_hybrid_test_of_a_spring_is_the_fast_one(numerical: str) -> None:
    slow = virtual_time.run(experiment.prepare(slow_test(numerical, 4.0), rig_of()))
    fast = virtual_time.run(experiment.prepare(slow_test(numerical, 1.0, 4096.0), rig_of()))
    x, y = (rec.samples["x_num_m"][rec.running()] for rec in (slow, fast))
    assert np.abs(x - y).max() < 1e-9 * np.abs(y).max()


def test_of_a_delay_a_slow_test_feels_so_much_less() -> None:
    # Two samples of delay are half a sample of the structure's at a quarter of its pace.
    worst = []
    for scale in (1.0, 4.0, 16.0):
        setup = experiment.prepare(slow_test(ONE.format("cr"), scale), rig_of(samples=2))
        rec = virtual_time.run(setup)
        x = rec.samples["x_meas_m"][rec.running()]
        expected = setup.reference["x_ref_m"]
        worst.append(np.abs(x - expected).max() / np.abs(expected).max())
    assert worst[0] > 3 * worst[1] > 9 * worst[2]


def test_a_damper_in_a_slow_test_has_its_force_over_the_time_scale() -> None:
    # What the laboratory then does is the structure with c / 8 of its damper: the closed form.
    rig, scale = rig_of(SPRING + DAMPER), 8.0
    rec = virtual_time.run(experiment.prepare(slow_test(ONE.format("cr"), scale), rig))
    x = rec.samples["x_meas_m"][rec.running()]
    weaker = SPRING + DAMPER.replace("900", str(900 / scale))
    like = experiment.prepare(slow_test(ONE.format("cr"), scale), rig_of(weaker)).reference[
        "x_ref_m"
    ]
    whole = experiment.prepare(slow_test(ONE.format("cr"), scale), rig).reference["x_ref_m"]
    reach = np.abs(whole).max()
    assert np.abs(x - like).max() < 0.01 * reach
    assert np.abs(x - whole).max() > 0.05 * reach


def test_what_is_known_of_the_specimens_mass_and_damping_is_computed_in_a_slow_test() -> None:
    text = (
        f'[numerical.matrices]\n{CR}integrator = "cr"\nspecimen = {{ mass_kg = 500, '
        "damping_n_s_per_m = 900 }\n"
    )
    given = slow_test(text).numerical.matrices
    plain = structure_of(given, 666400.0, 1 / 1024)
    slow = plain.slowed(5.0)
    for own, scaled, factor in zip(plain.joined(), slow.joined(), (25.0, 5.0, 1.0), strict=True):
        assert np.allclose(scaled, factor * own)
    # The laboratory's own share is what it really has.
    assert slow.part.specimen_mass_kg == 500
    assert np.array(slow.part.mass_kg)[0, 0] == pytest.approx(25 * 4000 - 500)
    back = slow.with_lack(5.0, -1.0)
    assert np.allclose(back.part.mass_kg, 25 * np.array(plain.part.mass_kg))


def test_modes_of_a_slow_structure_keep_damping_and_shapes() -> None:
    test = config.load_test(ROOT / "examples" / "ten-storeys.toml")
    slow = config.load_test(ROOT / "examples" / "ten-storeys.toml", {"test.time_scale": "20"})
    own, slower = (structure_of_test(one, 4737410.0, 1 / 1024).modes() for one in (test, slow))
    for mode, other in zip(own, slower, strict=True):
        assert other.frequency_hz == pytest.approx(mode.frequency_hz / 20)
        assert other.damping_ratio == pytest.approx(mode.damping_ratio)
        assert np.allclose(other.shape, mode.shape, atol=1e-6)


# ---- elements -----------------------------------------------------------------------------------

VALUES = {
    "k_n_per_m": 1e6, "post_yield_ratio": 0.1, "a": 1.0, "b": 60.0, "c": 40.0, "eta": 1.5,
    "fc_n": 80.0, "fs_n": 120.0, "vs_m_per_s": 0.01, "width_m_per_s": 0.002, "c_n_s_per_m": 900.0,
    "c2_n_s2_per_m2": 4000.0, "m_kg": 40.0, "tau_s": 0.2, "km_n_per_m": 4e5, "m2_kg": 20.0,
    "f2_hz": 6.0, "zeta2": 0.03, "sigma0_n_per_m": 1e6, "sigma1_n_s_per_m": 300.0,
    "sigma2_n_s_per_m": 200.0, "at_m_per_s": 0.1, "exponent": 0.5, "force_n": 100.0,
    "mu_slow": 0.03, "mu_fast": 0.08, "mu_rate_s_per_m": 40.0, "weight_n": 1e4, "radius_m": 1.0,
    "xy_m": 0.004, "r0": 15.0, "cr1": 0.9, "cr2": 0.15, "ultimate_m": 0.05, "pivot": 3.0,
    "slip_width": 0.5, "work_j": 2e3, "amplitude_m": 0.05, "start_m": 1e-3,
    "sharpness": 5.0, "energy_j": 1e3, "strength_down_over_up": 0.7,
    "corner_on_line": 0.4,
}  # fmt: skip


@pytest.mark.parametrize("kind", list(core.ELEMENT_PARAMS))
def test_every_element_has_the_same_force_on_the_same_motion_in_slow_motion(kind: str) -> None:
    values = {name: VALUES.get(name, 0.01) for name in core.ELEMENT_PARAMS[kind]}
    if kind == "peak_oriented":
        values["exponent"] = 1.5  # it does not reload above a straight line
    element = core.element(kind, **values)
    slow, h = 8.0, 1 / 1024
    t = np.arange(2048) * h
    w = 2 * np.pi * 2.0
    x, v, a = 0.02 * np.sin(w * t), 0.02 * w * np.cos(w * t), -0.02 * w**2 * np.sin(w * t)
    fast = np.asarray(core.CoreElement(element).run(x, v, a, h))
    slowly = core.CoreElement(timescale.slowed(element, slow)).run(
        x, v / slow, a / slow**2, h * slow
    )
    assert np.abs(fast).max() > 0.0
    assert np.allclose(slowly, fast, rtol=1e-9, atol=1e-9 * np.abs(fast).max())
    # And those without a rate in them need nothing.
    unscaled = np.asarray(core.CoreElement(element).run(x, v / slow, a / slow**2, h * slow))
    same = np.allclose(unscaled, fast, rtol=1e-9, atol=1e-9 * np.abs(fast).max())
    assert same is not timescale.rate_dependent(element)


# ---- what the user is told ----------------------------------------------------------------------


def test_a_slow_test_says_what_it_leaves_out() -> None:
    notes = experiment.prepare(slow_test(ONE.format("cr"), 10.0), rig_of(SPRING + DAMPER)).notes
    (note,) = [text for text in notes if "time_scale" in text]
    assert "viscous" in note
    assert "1/10 of the structure's" in note
    notes = experiment.prepare(slow_test(ONE.format("cr"), 10.0), rig_of()).notes
    assert any("do not depend on rate" in text for text in notes)
    notes = experiment.prepare(slow_test(ONE.format("cr"), 10.0), rig_of(SPRING + STOP)).notes
    assert any("do not depend on rate" in text for text in notes)
    lossy = rig_of(f"{SPRING}{STOP}loss_s_per_m = 2\n")
    (note,) = [
        t
        for t in experiment.prepare(slow_test(ONE.format("cr"), 10.0), lossy).notes
        if "time_scale" in t
    ]
    assert "stopper" in note
    notes = experiment.prepare(slow_test(ONE.format("cr")), rig_of(SPRING + DAMPER)).notes
    assert not any("time_scale" in text for text in notes)


def test_a_test_of_too_many_hours_is_refused_with_what_would_fit() -> None:
    with pytest.raises(InputError, match="a time scale of up to") as error:
        experiment.prepare(slow_test(ONE.format("cr"), 1000.0, 4096.0), rig_of())
    assert "test.time_scale" in str(error.value)


@pytest.mark.long
def test_the_report_of_a_slow_test_has_the_structures_own_period_and_ground_motion() -> None:
    setup = experiment.prepare(slow_test(ONE.format("cr"), 10.0), rig_of())
    rec = virtual_time.run(setup)
    found = summary.summarize(rec)
    assert found.setup.period_s == pytest.approx(5.0)
    assert {"T = 0.500 s", "time scale 10"} <= set(summary.key_figures(found))
    assert found.response_nrmse is not None
    assert found.response_nrmse < 0.01
    page = render(rec)
    assert "Hybrid test, time scale 10" in page


def test_energies_of_a_slow_test_are_those_of_the_fast_one() -> None:
    slow = summary.summarize(
        virtual_time.run(experiment.prepare(slow_test(ONE.format("cr"), 4.0), rig_of()))
    )
    fast = summary.summarize(
        virtual_time.run(experiment.prepare(slow_test(ONE.format("cr"), 1.0, 4096.0), rig_of()))
    )
    assert slow.input_energy_j == pytest.approx(fast.input_energy_j, rel=1e-6)
