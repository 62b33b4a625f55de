"""Roots and margins of the whole loop: closed forms, the controller's own runs, what is refused."""

from __future__ import annotations

import dataclasses
import math
import re
import tracemalloc
from typing import Any

import numpy as np
import pytest
import scipy.linalg
import scipy.signal
from kernels import H

from rthyb_rt import config, core
from rthyb_rt.analysis import linear_parts, loop_roots, loop_stability, margins
from rthyb_rt.analysis.loop_roots import Block, LoopVerdict, judge
from rthyb_rt.benchmark import plants as rths_benchmark
from rthyb_rt.checking import check_tables, examined
from rthyb_rt.config import Rate, RigFile, response
from rthyb_rt.config.rigfile import Identified
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.lab.experiment import Setup

# One storey at the benchmark's interface; the modes of its three storeys are in the frame below.
FRAME = """schema = "rthyb-test/1"
test = {{ name = "frame", sample_rate_hz = {rate}, free_vibration_s = 0 }}
ground_motion = {{ factor = {factor}, duration_s = 20 }}
limits = {{ ramp_in_s = 0.1, tare_s = 0.5 }}
controller = {{ {law} }}
[numerical.matrices]
integrator = "rk4"
m_kg = [1000, 1000, 1000]
k_n_per_m = [
    ["26.054884 MN/m", "-23.133939 MN/m", "5.937035 MN/m"],
    ["-23.133939 MN/m", "32.560774 MN/m", "-14.419971 MN/m"],
    ["5.937035 MN/m", "-14.419971 MN/m", "9.267276 MN/m"],
]
damping_ratios = ["5 %"]
force_delay_samples = {late}
specimen = {{ mass_kg = 29.13, damping_n_s_per_m = 114.22 }}
"""


def framed(law: str, rate: int = 1024, rig: RigFile | None = None, factor: float = 0.1) -> Setup:
    text = FRAME.format(rate=rate, law=law, late=int(rate == 4096), factor=factor)
    return experiment.prepare(config.parse_test(text), rig or rths_benchmark.nominal())


def table(law: str, rig: str = "shaking-table-portal-frame", **more: str) -> Setup:
    changes = {"controller.type": law} | {key.replace("__", "."): v for key, v in more.items()}
    test = config.load_test(config.builtin_test_path(), changes)
    return experiment.prepare(test, config.load_rig(config.shipped_rig(rig)))


def judged(setup: Setup) -> LoopVerdict:
    found = judge(setup)
    assert found is not None
    return found


# ---- blocks -------------------------------------------------------------------------------------


def test_blocks_in_a_row_beside_and_summed_are_products_and_sums() -> None:
    rng = np.random.default_rng(1)
    z = np.exp(1j * rng.uniform(0.01, 3.0, size=40))
    one = loop_roots.rational(np.array([0.4, 0.1, 0.3]), np.array([1.0, -1.2, 0.5]))
    two = loop_roots.rational(np.array([0.7]), np.array([1.0, -0.6]))
    first = np.polyval([0.4, 0.1, 0.3], z) / np.polyval([1.0, -1.2, 0.5], z)
    second = 0.7 / (z - 0.6)
    np.testing.assert_allclose(one.response(z)[:, 0], first)
    np.testing.assert_allclose(one.then(two).response(z)[:, 0], first * second)
    both = one.beside(two).weighted((2.0, -3.0), (0.0, 1.0))
    np.testing.assert_allclose(both.response(z)[:, 0], 2 * first - 3 * second)
    np.testing.assert_allclose(both.response(z)[:, 1], second)
    np.testing.assert_allclose(loop_roots.gain(0.3).then(two).response(z)[:, 0], 0.3 * second)


@pytest.mark.parametrize("kind", ["drifting", "vibrating", "chain of delays"])
def test_a_block_of_many_states_answers_as_solved_directly(kind: str) -> None:
    """The roots of the chain all coincide, so that no sum of partial fractions exists."""
    n, rng = 150, np.random.default_rng(3)
    turned, _ = np.linalg.qr(rng.standard_normal((n, n)))
    if kind == "drifting":
        a = turned @ np.diag(np.linspace(-0.9, 0.999, n)) @ turned.T
    elif kind == "vibrating":
        roots = 0.99 * np.exp(1j * np.linspace(0.01, 3.0, n // 2))
        pairs = [np.array([[r.real, r.imag], [-r.imag, r.real]]) for r in roots]
        a = turned @ scipy.linalg.block_diag(*pairs) @ turned.T
    else:
        a = np.eye(n, k=-1) + 0.5 * np.eye(n)
    b, c = rng.standard_normal(n), rng.standard_normal((2, n))
    z = np.exp(1j * np.geomspace(1e-4, np.pi, 700))
    block = Block(a, b, c, np.array([0.25, -1.0]))
    expected = linear_parts.solved_response(a, b[:, None], c, z)[:, :, 0] + block.d
    scale = np.abs(expected).max(axis=1, keepdims=True)
    assert np.abs(block.response(z) - expected).max() < 1e-9 * scale.max()
    assert (np.abs(block.response(z) - expected) < 1e-7 * scale).all()


def test_low_pass_is_scipys() -> None:
    z = np.exp(1j * np.linspace(0.01, 3.0, 30))
    top, bottom = scipy.signal.butter(2, 60.0, fs=1024.0)
    expected = np.polyval(top, z) / np.polyval(bottom, z)
    np.testing.assert_allclose(loop_roots.low_pass(60.0, H).response(z)[:, 0], expected)


@pytest.mark.parametrize("rate", [1024.0, 4096.0])
@pytest.mark.parametrize("delay_s", [0.0, 0.0031, 0.01])
def test_rig_is_scipys_zero_order_hold_of_its_polynomial_behind_a_delay(
    rate: float, delay_s: float
) -> None:
    """At a delay of whole samples; half a sample more turns slow motions by as much."""
    p = np.array([1.01, 0.025, 1.07e-4, 3.9e-7, 5.8e-10, 1.38e-12])
    h = 1.0 / rate
    whole = round(delay_s / h)
    model = response.IdentifiedPlant(p, whole * h, 1.2e6, 110.0, 29.0, 80.0, 0.0)
    block = loop_roots.rig(model, h, "zoh")
    z = np.exp(2j * np.pi * np.array([0.5, 4.0, 20.0, 66.0, 80.0]) / rate)
    system = scipy.signal.cont2discrete(([1.0], p[::-1]), h, "zoh")
    expected = np.polyval(system[0][0], z) / np.polyval(system[1], z) * z**-whole
    got = block.response(z)
    np.testing.assert_allclose(got[:, 0], expected, rtol=1e-6)
    s = 2j * np.pi * np.array([0.5, 4.0, 20.0])
    force = 1.2e6 + 110.0 * s + 29.0 * s**2
    np.testing.assert_allclose(got[:3, 1] / got[:3, 0], force, rtol=0.01)
    half = dataclasses.replace(model, delay_s=(whole + 0.5) * h)
    slow = np.exp(2j * np.pi * np.array([2.0, 10.0]) / rate)
    shift = loop_roots.rig(half, h, "zoh").response(slow)[:, 0] / block.response(slow)[:, 0]
    np.testing.assert_allclose(shift, slow**-0.5, rtol=1e-5)


@pytest.mark.parametrize("law", ["inverse", "gain-alpha-beta", "alpha-beta", "robust", "zhao"])
@pytest.mark.parametrize("rate", [1024, 4096])
def test_block_of_a_law_answers_as_the_law_does(law: str, rate: int) -> None:
    """The core's own response to one sample, at frequencies from slow to fast."""
    setup = framed(f'type = "{law}"', rate)
    model = response.plant(setup.rig)
    assert model is not None
    block = loop_roots.laws(setup.controller.law, model, 1.0 / rate, "zoh")[0]
    pulse = np.zeros(4 * rate)
    pulse[0] = 1e-3
    heard = core.Law(setup.controller.law, period_s=1.0 / rate).run(pulse) / 1e-3
    z = np.exp(2j * np.pi * np.array([1.0, 7.0, 40.0, 0.4 * rate]) / rate)
    expected = np.array([np.sum(heard * one ** -np.arange(heard.size)) for one in z])
    np.testing.assert_allclose(block.response(z)[:, 0], expected, rtol=1e-5)


# ---- the model of a rig -------------------------------------------------------------------------


def test_model_of_the_benchmark_has_its_poles_and_its_specimen() -> None:
    model = response.plant(rths_benchmark.nominal())
    assert model is not None
    poles = np.roots(model.p[::-1])
    slow = np.sort(np.abs(poles)) / (2 * np.pi)
    np.testing.assert_allclose(slow, [7.67, 46.9, 46.9, 67.1, 67.1], rtol=0.02)
    assert (model.stiffness_n_per_m, model.mass_kg) == pytest.approx((1.19e6, 29.13), rel=0.01)
    # A lower bound, because a verdict on stability depends on it.
    assert 0.6 * 114.2 < model.damping_n_s_per_m < 114.2


def test_pure_delay_is_one_of_order_zero() -> None:
    f = np.array([0.5, 1.0, 2.0, 5.0, 10.0])
    found = Identified(
        alpha=10.0, delay_s=10 * H, frequency_hz=list(f), amplitude=[1.0] * 5,
        delay_at_frequency_s=[10 * H] * 5,
    )  # fmt: skip
    rig = config.load_rig(config.shipped_rig("delay-10-elastic"))
    model = response.plant(rig.model_copy(update={"identified": found}))
    assert model is not None
    assert (model.p.size, model.delay_s) == (1, pytest.approx(10 * H))
    assert model.stiffness_n_per_m == rig.rig.elastic_stiffness_n_per_m


def test_a_response_that_nothing_explains_is_not_judged() -> None:
    rng = np.random.default_rng(2)
    rig = rths_benchmark.nominal()
    assert rig.identified is not None
    changed = {"delay_at_frequency_s": list(rng.uniform(0.0, 0.05, size=15))}
    found = rig.identified.model_copy(update=changed)
    rig = rig.model_copy(update={"identified": found})
    assert response.plant(rig) is None
    assert judge(framed('type = "alpha-beta"', rig=rig)) is None


# ---- what the sweep says of the force -----------------------------------------------------------


def swept(c: float, friction_n: float, hysteresis: float, noise_n: float, seed: int) -> Identified:
    """A sweep like that of `rthyb identify` on a lag of 5 Hz, with these forces in quadrature."""
    f = np.array([0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 40.0])
    w = 2.0 * np.pi * f
    sent = np.minimum(2e-3, 0.05 / w)
    gain = 1.0 / np.hypot(1.0, f / 5.0)
    q = c * w + 4.0 / np.pi * friction_n / (sent * gain) + hysteresis
    error = np.random.default_rng(seed).standard_normal(f.size) * np.sqrt(2.0 / 2048)
    q += noise_n * error / (sent * gain)
    return Identified(
        alpha=30.0, delay_s=30 * H, frequency_hz=list(f), amplitude=list(gain),
        delay_at_frequency_s=list(np.arctan(f / 5.0) / w), rest_noise_force_n=noise_n,
        force_in_phase_n_per_m=[1e6] * f.size, force_in_quadrature_n_per_m=list(q),
        command_amplitude_m=list(sent),
    )  # fmt: skip


def damping_of(found: Identified) -> float:
    rig = config.load_rig(config.shipped_rig("first-order-5hz"))
    model = response.plant(rig.model_copy(update={"identified": found}))
    assert model is not None
    return model.damping_n_s_per_m


@pytest.mark.parametrize("friction_n", [0.0, 80.0, 800.0])
@pytest.mark.parametrize("hysteresis", [0.0, 2e4])
@pytest.mark.parametrize("c", [0.0, 600.0, 5000.0])
def test_friction_and_hysteresis_do_not_count_as_viscous_damping(
    c: float, friction_n: float, hysteresis: float
) -> None:
    assert damping_of(swept(c, friction_n, hysteresis, 0.0, 0)) == pytest.approx(c, abs=1.0)
    noisy = [damping_of(swept(c, friction_n, hysteresis, 5.0, seed)) for seed in range(20)]
    # Two standard errors: one in fifty may be above.
    assert sum(found > c + 1.0 for found in noisy) <= 2
    if friction_n == 0.0 and c > 0.0:
        assert np.median(noisy) > 0.5 * c


def test_without_the_amplitudes_of_a_sweep_no_damping_is_counted() -> None:
    found = swept(600.0, 0.0, 0.0, 0.0, 0)
    assert damping_of(found.model_copy(update={"command_amplitude_m": []})) == 0.0


@pytest.mark.parametrize("moves", [False, True])
def test_fast_sines_that_nothing_explains_are_left_out_if_the_rig_stands_still(
    moves: bool,
) -> None:
    """As an actuator that friction stops; one that moves more than the model is not judged."""
    found = swept(600.0, 0.0, 0.0, 0.0, 0)
    by = np.where(np.asarray(found.frequency_hz) < 25.0, 1.0, 30.0 if moves else 1.0 / 30.0)
    found = found.model_copy(update={"amplitude": list(by * np.asarray(found.amplitude))})
    rig = config.load_rig(config.shipped_rig("first-order-5hz"))
    model = response.plant(rig.model_copy(update={"identified": found}))
    if moves:
        assert model is None
    else:
        assert model is not None
        assert model.swept_hz == 20.0


# ---- the whole loop -----------------------------------------------------------------------------


@pytest.mark.parametrize("law", ["none", "paper"])
@pytest.mark.parametrize("delay", [2, 3, 4, 17, 25, 40])
def test_delay_margin_is_what_the_critical_delay_leaves(law: str, delay: int) -> None:
    """A pure delay, no force compensation: the closed form that `rthyb check` prints as well."""
    rig = config.load_rig(config.shipped_rig("delay-10-elastic"))
    f = [0.5, 1.0, 2.0, 5.0, 10.0]
    found = Identified(
        alpha=float(delay), delay_s=delay * H, frequency_hz=f, amplitude=[1.0] * 5,
        delay_at_frequency_s=[delay * H] * 5,
    )  # fmt: skip
    rig = rig.model_copy(update={"identified": found})
    changes = {
        "controller.type": law,
        "controller.rfc.enabled": "false",
        "controller.alpha0": "10",
        "controller.delay_estimator.enabled": "false",
        "numerical.period_s": "0.5",
    }
    test = config.load_test(config.builtin_test_path(), changes)
    setup = experiment.prepare(test, rig)
    lead = margins.lead_of(setup.controller.law) if law == "paper" else None
    structure = margins.OneDegree(setup.controller.motion)
    critical = margins.critical_delay(structure, lead)
    verdict = judged(setup)
    assert verdict.unstable == (not structure.is_stable(delay, lead))
    if not verdict.unstable:
        assert verdict.delay_margin_samples == pytest.approx(critical - delay, abs=1e-6)
    else:
        assert verdict.delay_margin_samples == verdict.gain_margin == 0.0


@pytest.mark.parametrize(
    ("rate", "law", "radius", "frequency_hz"),
    [
        # Measured on independent code before this was written: largest root of case 1.
        (4096, 'type = "alpha-beta", w1 = 3, w2 = 2, rfc = { cutoff_hz = 0 }', 1.00031, 68.0),
        (1024, 'type = "alpha-beta", w1 = 3, w2 = 2, rfc = { cutoff_hz = 0 }', 1.00300, 67.0),
        (1024, 'type = "alpha-beta", w1 = 3, w2 = 2, rfc = { enabled = false }', 1.00081, 67.0),
    ],
)
def test_weights_of_the_paper_are_unstable_on_the_benchmarks_actuator(
    rate: int, law: str, radius: float, frequency_hz: float
) -> None:
    setup = framed(law, rate)
    verdict = judged(setup)
    assert verdict.unstable
    assert verdict.radius - 1.0 == pytest.approx(radius - 1.0, rel=0.2)
    assert verdict.frequency_hz == pytest.approx(frequency_hz, abs=1.0)
    (text,) = loop_stability.remarks(setup, verdict)
    assert "unstable" in text
    assert "remove controller.w1 and w2" in text


@pytest.mark.parametrize(
    ("law", "advice"),
    [
        ('"ats"', "use the control law inverse"),
        ('"third-order"', "use the control law inverse"),
        ('"amb", rfc = { cutoff_hz = 200 }', "set controller.rfc.cutoff_hz below the resonance"),
        (
            '"gain-alpha-beta", gain_alpha_beta = { roll_off_hz = 400 }',
            "lower controller.gain_alpha_beta.roll_off_hz or use the control law inverse",
        ),
    ],
)
def test_advice_against_an_unstable_resonance_has_only_keys_of_the_law_that_help(
    law: str, advice: str
) -> None:
    setup = framed(f"type = {law}")
    verdict = judged(setup)
    assert verdict.unstable
    assert verdict.frequency_hz == pytest.approx(67.0, abs=3.0)
    (text,) = loop_stability.remarks(setup, verdict)
    assert f"the lead drives a resonance of actuator and specimen: {advice}" in text
    known = {p.key for p in setup.controller.law.law.parameters} | {"rfc.cutoff_hz"}
    assert set(re.findall(r"controller\.([a-z0-9_.]*[a-z0-9_])", text)) <= known
    assert not judged(framed('type = "inverse"')).unstable


@pytest.mark.long
@pytest.mark.parametrize("rate", [1024, 4096])
@pytest.mark.parametrize("law", ["alpha-beta", "robust", "gain-alpha-beta", "inverse"])
def test_defaults_are_stable_on_the_benchmarks_actuator_with_room_to_spare(
    law: str, rate: int
) -> None:
    setup = framed(f'type = "{law}"', rate)
    verdict = judged(setup)
    assert not verdict.unstable
    assert not verdict.thin
    assert verdict.gain_margin > 2.0
    assert loop_stability.remarks(setup, verdict) == []


def silent(rig: RigFile) -> RigFile:
    """Sensors and converters without noise or steps."""
    none = {"noise_std_m": 0.0, "lsb_m": 0.0}
    sensors = rig.sensors.model_copy(
        update={
            "displacement": rig.sensors.displacement.model_copy(update=none),
            "force": rig.sensors.force.model_copy(update={"noise_std_n": 0.0}),
        }
    )
    actuator = rig.actuator.model_copy(update={"command_lsb_m": 0.0})
    return rig.model_copy(update={"sensors": sensors, "actuator": actuator})


def exact(rig: RigFile) -> response.IdentifiedPlant:
    """The benchmark's transfer functions as they are, and not as a sweep has found them."""
    a, m = rig.actuator, 29.13
    assert a.kind == "servo-valve"
    k, c = 1.19e6, 114.22087
    flow = np.polyadd(
        np.polymul([1.0, a.leakage_per_s], [m, c, k]), [a.velocity_feedback_n_s_per_m2, 0.0]
    )
    valve = [1.0, a.valve_b1_per_s, a.valve_b2_per_s2]
    whole = np.polyadd(np.polymul(valve, flow), [a.valve_n_per_m_s3])
    p = whole[::-1] / (a.valve_n_per_m_s3 * a.gain)
    return response.IdentifiedPlant(p, 0.0, k, c, m, 80.0, 0.0)


@pytest.mark.parametrize("rate", [1024, 4096])
@pytest.mark.parametrize("beta", [60.0, 140.0])
def test_what_is_judged_is_what_the_controller_does(rate: int, beta: float) -> None:
    """The swing near 67 Hz in the product's own loop: alpha, beta and k_t held, no noise."""
    law = (
        f'type = "alpha-beta", w1 = 3, w2 = 2, alpha0 = 25, beta0 = {beta}, '
        "rfc = { cutoff_hz = 0 }, delay_estimator = { enabled = false }"
    )
    setup = framed(law, rate, silent(rths_benchmark.nominal()), factor=1e-6)
    held = dataclasses.replace(setup.controller.rfc, end_tick=0)
    setup = dataclasses.replace(setup, controller=dataclasses.replace(setup.controller, rfc=held))
    model = exact(setup.rig)
    law_block = loop_roots.laws(setup.controller.law, model, 1.0 / rate, "zoh")[0]
    loop = loop_roots.loop_of(setup.controller, model, law_block, "zoh")
    grows = float(np.abs(loop.roots()).max()) - 1.0
    assert (grows > 0.0) == (beta > 60.0)
    # What the sweep has left open of the resonance's damping is 0.3 % of critical.
    found = judged(setup).radius - 1.0
    assert found == pytest.approx(grows, abs=0.003 * 422.0 / rate)
    rows = virtual_time.run(setup).samples
    x = rows["x_cmd_m"][rows["state"] == core.RUNNING]
    sections = scipy.signal.butter(4, [55.0, 80.0], "bandpass", fs=rate, output="sos")
    swing = np.abs(scipy.signal.hilbert(scipy.signal.sosfiltfilt(sections, x)))
    # The last time that it grows a hundredfold, well below what limits make of it.
    if grows < 0.0:
        assert swing[-2 * rate : -rate].max() < swing[rate : 4 * rate].max()
        return
    last = int(np.flatnonzero(swing > 1e-4)[0]) if swing.max() > 1e-4 else x.size - rate
    first = max(last - round(math.log(100.0) / grows), 2 * rate)
    slope = np.polyfit(np.arange(first, last), np.log(swing[first:last]), 1)[0]
    assert slope == pytest.approx(grows, rel=0.05)


def test_a_rig_that_would_push_more_than_the_margin_is_unstable() -> None:
    setup = framed('type = "alpha-beta", rfc = { enabled = false }')
    verdict = judged(setup)
    model = response.plant(setup.rig)
    assert model is not None
    for by, unstable in ((0.98, False), (1.02, True)):
        more = dataclasses.replace(model, p=model.p / (by * verdict.gain_margin))
        law = loop_roots.laws(setup.controller.law, model, H, "zoh")
        loops = [loop_roots.loop_of(setup.controller, more, one, "zoh") for one in law]
        assert any(not loop.stable() for loop in loops) == unstable


@pytest.mark.long
def test_uncompensated_shaking_table_grows_at_the_structures_own_frequency() -> None:
    setup = table("none")
    verdict = judged(setup)
    assert verdict.unstable
    assert verdict.frequency_hz == pytest.approx(2.0, abs=0.1)
    (text,) = loop_stability.remarks(setup, verdict)
    assert "compensate the delay" in text
    for law in ("paper", "robust", "alpha-beta", "inverse"):
        assert not judged(table(law)).unstable


@pytest.mark.parametrize(("alpha", "unstable"), [(16, False), (11, True)])
def test_friction_of_the_table_does_not_make_an_unstable_loop_stable(
    alpha: int, unstable: bool
) -> None:
    """80 N dissipate at 2 mm, in the sweep, as much as the damping of the whole structure."""
    setup = table(
        "alpha-beta",
        controller__alpha0=f"{alpha}",
        controller__beta0="0",
        controller__delay_estimator__enabled="false",
        controller__rfc__enabled="false",
        test__free_vibration_s="6",
        ground_motion__duration_s="5",
        ground_motion__pga_g="0.1",
        limits__force_n="1e6",
    )
    assert judged(setup).unstable == unstable
    rec = virtual_time.run(setup)
    if unstable:
        assert rec.meta["end_reason"].startswith("tripped")
    else:
        x_m = np.abs(rec.samples["x_num_m"][rec.running()][-6 * 1024 :])
        assert x_m[-1024:].max() < 0.1 * x_m[:1024].max()


def test_little_to_spare_is_said_in_figures() -> None:
    verdict = LoopVerdict(0.9999, 67.0, 1.1, 0.6, 80.0)
    assert verdict.thin
    text = loop_roots.remark(verdict, "")
    assert text is not None
    assert "1.1 times the rig's gain (1.25 are advised)" in text
    assert (
        "an additional delay of 0.6 samples (0.586 ms); at least 1 sample (0.977 ms) is advised"
        in text
    )
    assert not LoopVerdict(0.9999, 3.6, 2.0, math.inf, 80.0).thin
    assert loop_roots.remark(LoopVerdict(0.9999, 3.6, 2.0, math.inf, 80.0), "") is None


def swept_up_to(rig: RigFile, top_hz: float) -> RigFile:
    """A rig as it is known from a shorter sweep."""
    assert rig.identified is not None
    count = sum(f <= top_hz for f in rig.identified.frequency_hz)
    kept = {
        name: list(value)[:count]
        for name, value in rig.identified
        if isinstance(value, list | tuple) and len(value) == len(rig.identified.frequency_hz)
    }
    found = rig.identified.model_copy(update=kept | {"roll_off_hz": None})
    return rig.model_copy(update={"identified": found})


@pytest.mark.parametrize("law", ["ats", "third-order", "alpha-beta", "amb"])
def test_a_sweep_that_ends_below_the_resonance_proves_no_stability(law: str) -> None:
    whole, short = rths_benchmark.nominal(), swept_up_to(rths_benchmark.nominal(), 10.0)
    setup = framed(f'type = "{law}"', rig=short, factor=1.0)
    found = judged(setup)
    assert not found.unstable
    assert found.unproven
    (text,) = loop_stability.remarks(setup, found)
    assert "known only up to 10 Hz" in text
    assert "--max-frequency" in text
    rows = dict(row[::2] for row in check_tables.loop_rows(found))
    assert rows["Gain margin"].endswith("up to 10 Hz")
    # With the whole sweep, the verdict is one way or the other.
    assert not judged(framed(f'type = "{law}"', rig=whole, factor=1.0)).unproven


@pytest.mark.parametrize("sweep_hz", [10.0, 20.0, 80.0])
def test_the_force_that_a_short_sweep_leaves_open_is_that_of_a_loop_gain_of_one(
    sweep_hz: float,
) -> None:
    off = {"controller__rfc__enabled": "false", "controller__delay_estimator__enabled": "false"}
    setup = table("paper", **off)
    rig = swept_up_to(setup.rig, sweep_hz)
    found = judged(experiment.prepare(setup.test, rig))
    if sweep_hz == 80.0:
        assert math.isinf(found.unseen_force)
        return
    f = np.geomspace(sweep_hz, 80.0, 2000)
    z, w = np.exp(2j * np.pi * f * H), 2 * np.pi * f
    motion, lead = setup.controller.motion, margins.lead_of(setup.controller.law, H)
    top, bottom = lead.polynomials()
    led = np.polyval(top, z) / np.polyval(bottom, z)
    # Above the natural frequency of the structure, its mass alone moves.
    moved = 1.0 / np.abs(motion.mass_kg * w**2)
    plant = response.plant(rig)
    assert plant is not None
    loop_gain = moved * np.abs(led) * plant.stiffness_n_per_m
    assert found.unseen_force == pytest.approx(1.0 / loop_gain.max(), rel=0.05)
    assert found.unseen_hz == pytest.approx(f[np.argmax(loop_gain)], rel=0.05)


def test_without_an_identified_response_nothing_is_judged() -> None:
    test = config.load_test(config.builtin_test_path())
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    assert rig.identified is not None
    slow_test = Identified(alpha=17.0, delay_s=17 * H)
    found = examined.examine(test, rig.model_copy(update={"identified": slow_test}))
    assert found.loop is None
    (row,) = [row for row in found.tables()[0] if row[0] == "Largest root"]
    assert row[1:] == ("not computed", "the rig file has no identified response")
    assert loop_roots.remark(None, "") is None


# ---- before ARM ---------------------------------------------------------------------------------


def linked(setup: Setup, **link: Any) -> Setup:
    real = config.load_rig(config.shipped_rig("shaking-table-can")).link
    assert real is not None
    rig = setup.rig.model_copy(update={"link": real.model_copy(update=link)})
    return dataclasses.replace(setup, rig=rig)


def test_unstable_loop_is_refused_on_a_real_link_and_nowhere_else() -> None:
    setup = table("none")
    with pytest.raises(
        InputError, match=r"unstable, so the motion will grow: its largest root is 1\.000"
    ) as caught:
        loop_stability.demand(linked(setup, virtual=False))
    assert "shaking-table-portal-frame" in str(caught.value)
    for harmless in (setup, linked(setup, virtual=True)):
        (text,) = loop_stability.demand(harmless)
        assert "the motion will grow" in text


def test_stable_loop_is_neither_refused_nor_remarked_on() -> None:
    assert loop_stability.demand(linked(table("alpha-beta"), virtual=False)) == []


def test_blocks_of_no_memory_have_no_roots() -> None:
    assert isinstance(loop_roots.gain(1.0), Block)
    assert loop_roots.gain(2.0).a.shape == (0, 0)


def test_a_delay_is_swept_at_many_frequencies_in_little_memory() -> None:
    late = loop_roots.rational(np.array([1.0]), np.eye(1, 101)[0])
    z = np.exp(1j * np.linspace(0.01, 3.1, 20_000))
    tracemalloc.start()
    try:
        found = late.response(z)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_allclose(found[:, 0], z**-100.0, atol=1e-9)
    # Its matrices are 3.2 GB; a service that loads a test must not take that from the others.
    assert peak < 50e6


@pytest.mark.parametrize(
    ("ratio", "unstable", "at_limit"),
    [(0.001, False, False), (0.0, True, True), (-0.001, True, False)],
)
def test_an_oscillator_without_damping_is_at_the_limit_and_not_stable(
    ratio: float, unstable: bool, at_limit: bool
) -> None:
    """Roots exp(h s) of a mass on a spring, and a rig whose force does not act on it."""
    s = 2.0 * math.pi * 5.0 * complex(-ratio, math.sqrt(1.0 - ratio**2))
    root = np.exp(s * H)
    bottom = np.array([1.0, -2.0 * root.real, abs(root) ** 2])
    none = loop_roots.gain(0.0)
    loop = loop_roots.LinearLoop(loop_roots.rational(np.array([1.0]), bottom), none, none)
    found = loop_roots.verdict(loop, Rate(1024.0), 80.0)
    assert found.radius == pytest.approx(math.exp(s.real * H), rel=1e-12)
    assert (found.unstable, found.at_limit) == (unstable, at_limit)
    assert loop.stable() != unstable
    text = loop_roots.remark(found, "")
    assert (text is None) == (not unstable)
    if text is not None:
        assert ("at the limit of stability" in text) == at_limit
        assert ("the motion will grow" in text) != at_limit
