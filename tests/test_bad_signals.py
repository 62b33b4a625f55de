"""NaN, inf, spikes, denormals, a stuck sensor, a specimen that does not move: every kernel and the
whole controller give a defined result, stay finite, say so, and are the same after recovery."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels import (
    HYDRAULIC,
    K_PLATE,
    Floats,
    H,
    controller,
    doubles,
    rms,
    run_virtual,
    smooth_motion,
    time_s,
)
from rthyb_rt._core import ffi, lib

from rthyb_rt import core

NOT_FINITE, OUT_OF_RANGE = core.STATUS["not_finite"], core.STATUS["out_of_range"]
X_MAX, F_MAX, AG_MAX = 1e3, 1e12, 1e4
PLATE = core.element("stiffness", k_n_per_m=K_PLATE)
FEW = settings(max_examples=40, deadline=None, derandomize=True, database=None)

BAD = [np.nan, np.inf, -np.inf, 1e300, -1e300]
KINDS = ["good", "good", "stuck", "still", "denormal", *BAD]
SEGMENTS = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(1, 60), st.integers(0, 2**31)),
    min_size=1,
    max_size=14,
)
STUCK_SAMPLES = 1024


def signal(segments: list[tuple[Any, int, int]], scale: float) -> Floats:
    """Pieces of good signal, faults, and sensors stuck for a second."""
    pieces: list[Floats] = [np.zeros(1)]
    for kind, length, seed in segments:
        last = float(pieces[-1][-1])
        if kind == "good":
            pieces.append(scale * np.random.default_rng(seed).normal(size=length))
        elif kind == "stuck":
            pieces.append(np.full(STUCK_SAMPLES, last))
        elif kind == "still":
            pieces.append(np.zeros(length))
        elif kind == "denormal":
            pieces.append(np.resize([5e-324, -5e-324, 2e-310, 0.0], length))
        else:
            pieces.append(np.full(length, kind))
    return np.concatenate(pieces)


def together(*signals: Floats) -> list[Floats]:
    """Signals of one length: the shorter ones end at rest."""
    length = max(s.size for s in signals)
    return [np.concatenate([s, np.zeros(length - s.size)]) for s in signals]


def verdict(value: float, limit: float) -> int:
    """The status bits that a value on its own deserves."""
    if not np.isfinite(value):
        return NOT_FINITE
    return OUT_OF_RANGE if abs(value) > limit else 0


def last_good(values: Floats, limit: float) -> Floats:
    """The signal with every bad value replaced by the good one before it."""
    out, last = values.copy(), 0.0
    for n, value in enumerate(values):
        last = value if verdict(value, limit) == 0 else last
        out[n] = last
    return out


def assert_finite(kernel: Any) -> None:
    assert np.all(np.isfinite(doubles(kernel)))


def fine(x: float, f: float) -> bool:
    return bool(np.isfinite(x) and np.isfinite(f))


# --- settings that only a C caller can give ------------------------------------------------------

STRUCTURE = core.MotionConfig("cr", mass_kg=1.0)
RFC = core.RfcConfig(k_e_n_per_m=1.0)


@pytest.mark.parametrize("value", [-1, 99])
@pytest.mark.parametrize(
    ("kernel", "config", "name"),
    [
        ("estimator", core.EstimatorConfig(), "law"),
        ("rfc", RFC, "tangent"),
        ("rfc", RFC, "divisor"),
        ("motion", STRUCTURE, "integrator"),
    ],
)
def test_number_that_no_enumeration_has_is_refused(
    kernel: str, config: Any, name: str, value: int
) -> None:
    struct = core.struct_of(f"rthyb_{kernel}_config", config)
    start = {"rfc": (0.0, 0.0), "estimator": (3.0, 2.0, 0.0)}.get(kernel, (0.0,))
    target, init = ffi.new(f"rthyb_{kernel} *"), getattr(lib, f"rthyb_{kernel}_init")
    assert init(target, struct, *start) == 0
    setattr(struct, name, value)
    assert init(target, struct, *start) != 0


@pytest.mark.parametrize("value", [-1, 99])
def test_actuator_element_and_action_that_no_enumeration_has_are_refused(value: int) -> None:
    rig = core.rig_struct(core.RigConfig(core.ServoConfig("pure-delay"), (PLATE,)))
    target = ffi.new("rthyb_rig *")
    assert lib.rthyb_rig_init(target, rig) == 0
    rig.servo.kind = value
    assert lib.rthyb_rig_init(target, rig) != 0
    assert lib.rthyb_element_param_count(value) == -1
    assert lib.rthyb_element_init(ffi.new("rthyb_element *"), value, [1.0], 1) != 0
    parameters = core.Parameters(watches={"force": core.Watch(1.0, "trip")}).struct()
    assert lib.rthyb_parameters_check(parameters) == 0
    parameters.watch[core.CAUSES.index("force")].reaction = value
    assert lib.rthyb_parameters_check(parameters) != 0


def test_more_elements_than_a_specimen_holds_are_refused() -> None:
    rig = core.rig_struct(core.RigConfig(core.ServoConfig("pure-delay"), (PLATE,)))
    rig.element_count = core.ELEMENTS_MAX + 1
    assert lib.rthyb_rig_init(ffi.new("rthyb_rig *"), rig) != 0
    with pytest.raises(core.CoreError):
        core.Motion(STRUCTURE).reference((PLATE,) * (core.ELEMENTS_MAX + 1), np.zeros(3))


# --- each kernel: a bad sample is as if the last good one had come again, and it is told ----------


@FEW
@given(SEGMENTS, SEGMENTS)
def test_compensator_takes_the_last_good_command_for_a_bad_one(a: Any, b: Any) -> None:
    command, alpha = together(signal(a, 0.01), np.abs(signal(b, 20.0)))
    good = last_good(command, X_MAX)
    clean, dirty = core.Plc(), core.Plc()
    for n in range(command.size):
        held = alpha[n] if verdict(alpha[n], 1e5) == 0 else 17.0
        expected, _ = clean.step(held, 0.0, good[n])
        found, code = dirty.step(held, 0.0, command[n])
        assert code == verdict(command[n], X_MAX)
        assert found == expected
    assert_finite(dirty)


@FEW
@given(SEGMENTS, SEGMENTS, SEGMENTS)
def test_compensator_stays_finite_whatever_alpha_and_beta_are(a: Any, b: Any, c: Any) -> None:
    command, alpha, beta = together(signal(a, 0.01), signal(b, 20.0), signal(c, 200.0))
    plc = core.Plc()
    for values in zip(alpha, beta, command, strict=True):
        out, code = plc.step(*values)
        worst = [verdict(values[0], 1e5), verdict(values[1], 1e10), verdict(values[2], X_MAX)]
        assert code == worst[0] | worst[1] | worst[2]
        assert np.isfinite(out)
    assert_finite(plc)
    recovered = plc.run(np.linspace(0.0, 1e-3, 200), 17.0)
    assert recovered[-1] == pytest.approx(1e-3 * (1 + 17.0 / 199.0), rel=1e-9)


@pytest.mark.parametrize("law", ["fixed", "gradient", "robust", "rls"])
@FEW
@given(a=SEGMENTS, b=SEGMENTS)
def test_estimator_never_learns_from_a_bad_pair_and_stays_finite(law: Any, a: Any, b: Any) -> None:
    x_p, x_m = together(signal(a, 0.01), signal(b, 0.01))
    config = core.EstimatorConfig(law=law, gain=0.5, alpha0=17.0, estimate_beta=True)
    clean, dirty = core.Estimator(config), core.Estimator(config)
    good_p, good_m = last_good(x_p, X_MAX), last_good(x_m, X_MAX)
    for n in range(x_p.size):
        code = dirty.step(x_p[n], x_m[n])
        assert code == verdict(x_p[n], X_MAX) | verdict(x_m[n], X_MAX)
        clean.step(good_p[n], good_m[n], frozen=code != 0)
    assert (dirty.alpha, dirty.beta) == (clean.alpha, clean.beta)
    np.testing.assert_array_equal(doubles(dirty), doubles(clean))
    assert_finite(dirty)


@pytest.mark.parametrize("law", ["gradient", "robust", "rls"])
def test_estimate_recovers_after_a_burst_of_every_fault(law: Any) -> None:
    x_p = smooth_motion(30.0, 1)
    x_m = np.concatenate([np.zeros(12), x_p[:-12]])
    spoilt = x_m.copy()
    spoilt[3000:3005] = BAD
    spoilt[4000:4010] = 5e-324
    spoilt[5000 : 5000 + STUCK_SAMPLES] = spoilt[5000]
    config = core.EstimatorConfig(law=law, gain=0.3 if law == "gradient" else 0.01, alpha0=5.0)
    clean, _ = core.Estimator(config).run(x_p, x_m)
    dirty, _ = core.Estimator(config).run(x_p, spoilt)
    assert np.max(np.abs(dirty[5000:6100] - clean[5000:6100])) > 0.05
    assert np.max(np.abs(dirty[-3072:] - clean[-3072:])) < 0.05


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
@FEW
@given(a=SEGMENTS, b=SEGMENTS, c=SEGMENTS)
def test_force_compensator_is_itself_again_one_window_after_any_fault(
    tangent: Any, a: Any, b: Any, c: Any
) -> None:
    x_c, x_m, f = together(signal(a, 0.01), signal(b, 0.01), signal(c, 5e3))
    kernel = core.Rfc(core.RfcConfig(k_e_n_per_m=1e6, window=10, tangent=tangent))
    good_c, good_m, good_f = (
        last_good(s, limit) for s, limit in ((x_c, X_MAX), (x_m, X_MAX), (f, F_MAX))
    )
    for n in range(x_c.size):
        held = kernel.k_n_per_m
        force, code = kernel.step(x_c[n], x_m[n], f[n])
        assert code == verdict(x_c[n], X_MAX) | verdict(x_m[n], X_MAX) | verdict(f[n], F_MAX)
        assert 0.0 <= kernel.k_n_per_m <= 1e6
        assert code == 0 or kernel.k_n_per_m == held
        assert force == good_f[n] + kernel.k_n_per_m * (good_c[n] - good_m[n])
    assert_finite(kernel)
    x = smooth_motion(0.1, 2)
    _, k = kernel.run(x, x, 4e5 * x)
    other = core.Rfc(core.RfcConfig(k_e_n_per_m=1e6, window=10, tangent=tangent))
    other.run(np.zeros(x_c.size), np.zeros(x_c.size), np.zeros(x_c.size))
    _, expected = other.run(x, x, 4e5 * x)
    np.testing.assert_allclose(k[12:], expected[12:], rtol=1e-9)


@pytest.mark.parametrize("tangent", ["mean-of-ratios", "least-squares"])
def test_one_spike_leaves_no_trace_in_the_tangent_after_its_window(tangent: Any) -> None:
    x = smooth_motion(3.0, 3)
    f = 2e5 * x + 1e7 * x**2
    spoilt_x, spoilt_f = x.copy(), f.copy()
    spoilt_x[1000], spoilt_f[1200] = 999.0, 9e11  # inside what is accepted
    config = core.RfcConfig(k_e_n_per_m=1e6, window=51, tangent=tangent)
    _, clean = core.Rfc(config).run(x, x, f)
    _, dirty = core.Rfc(config).run(x, spoilt_x, spoilt_f)
    assert np.any(dirty != clean)
    np.testing.assert_array_equal(dirty[1260:], clean[1260:])


@pytest.mark.parametrize(
    "integrator", ["central-difference", "forward-euler", "cr", "kr-alpha", "prescribed"]
)
@FEW
@given(a=SEGMENTS, b=SEGMENTS)
def test_integrator_takes_the_last_good_force_and_excitation(
    integrator: Any, a: Any, b: Any
) -> None:
    limit = X_MAX if integrator == "prescribed" else AG_MAX
    scale = 0.01 if integrator == "prescribed" else 2.0
    excitation, force = together(signal(a, scale), signal(b, 1e3))
    config = core.MotionConfig(
        integrator, mass_kg=4220.0, damping_n_s_per_m=2121.0, k_e_n_per_m=K_PLATE
    )
    clean, dirty = core.Motion(config), core.Motion(config)
    good_excitation, good_force = last_good(excitation, limit), last_good(force, F_MAX)
    for n in range(excitation.size):
        expected, _ = clean.step(good_excitation[n], good_force[n])
        found, code = dirty.step(excitation[n], force[n])
        assert found == expected
        assert code == verdict(excitation[n], limit) | verdict(force[n], F_MAX)
    np.testing.assert_array_equal(doubles(dirty), doubles(clean))
    assert_finite(dirty)


ACTUATORS: dict[str, dict[str, Any]] = {
    "pure-delay": {"kind": "pure-delay", "delay_samples": 3},
    "first-order": {"kind": "first-order", "roll_off_hz": 5.0},
    "second-order": {
        "kind": "second-order",
        "natural_frequency_hz": 20.0,
        "damping_ratio": 0.8,
        "delay_samples": 1.5,
    },
    "servo-hydraulic": HYDRAULIC,
}
SPECIMEN = (
    PLATE,
    core.element("coulomb", fc_n=80, width_m_per_s=5e-4),
    core.element("hysteresis", k_n_per_m=1e5, post_yield_ratio=0.1, a=1, b=300, c=200, eta=1.5),
    core.element("maxwell", km_n_per_m=1e5, tau_s=0.02),
    core.element("second_mode", m2_kg=5, f2_hz=15, zeta2=0.02),
)


@pytest.mark.parametrize("actuator", ACTUATORS)
@FEW
@given(segments=SEGMENTS)
def test_rig_takes_the_last_good_command_for_a_bad_one(actuator: str, segments: Any) -> None:
    command = signal(segments, 0.002)
    config = core.RigConfig(core.ServoConfig(**ACTUATORS[actuator]), SPECIMEN)
    clean, dirty = core.VirtualRig(config), core.VirtualRig(config)
    good = last_good(command, 1e5)
    for n in range(command.size):
        expected = clean.step(good[n])
        x, f, code = dirty.step(command[n])
        assert (x, f) == expected[:2]
        assert code == verdict(command[n], 1e5)
        assert fine(x, f)
    assert_finite(dirty)


def test_hydraulic_rig_driven_unstable_ends_finite_and_works_on() -> None:
    # A specimen far too stiff for the substeps: the computation runs off within a few samples.
    rock = core.element("stiffness", k_n_per_m=1e13)
    rig = core.VirtualRig(core.RigConfig(core.ServoConfig(**HYDRAULIC), (rock,)))
    told = 0
    for command in np.concatenate([np.full(50, 0.01), np.zeros(50)]):
        x, f, code = rig.step(command)
        told |= code
        assert fine(x, f)
    assert_finite(rig)
    assert told & (NOT_FINITE | OUT_OF_RANGE)


def test_oil_column_too_stiff_for_its_mass_and_substeps_is_refused() -> None:
    light = HYDRAULIC | {"moving_mass_kg": 1e-3, "oil_stiffness_n_per_m": 1e13, "substeps": 1024}
    with pytest.raises(core.CoreError, match="too stiff"):
        core.VirtualRig(core.RigConfig(core.ServoConfig(**light), (PLATE,)))


# --- the specimen's elements ---------------------------------------------------------------------

HISTORY = {
    "lugre": (80.0, 120.0, 2e-3, 4e5, 500.0, 60.0),
    "hysteresis": (4.7e6, 0.02, 1.0, 300.0, 200.0, 1.5),
    "pinching": (4.7e6, 0.02, 1.0, 300.0, 200.0, 1.5, 0.7, 0.3),
    "degradation": (4.7e6, 0.02, 1.0, 300.0, 200.0, 1.5, 0.4, 0.5, 5e3, 0.1),
    "maxwell": (2e5, 0.05),
    "second_mode": (20.0, 12.0, 0.02),
    "takeda": (4.7e6, 0.02, 2e-3, 8.0, 0.4, 0.6, 0.3, 500.0, 0.8, 0.7),
    "nonlinear_maxwell": (4e5, 900.0, 0.2, 0.35),
}


@pytest.mark.parametrize("kind", HISTORY)
@FEW
@given(a=SEGMENTS, b=SEGMENTS, c=SEGMENTS)
def test_element_with_a_history_stays_finite(kind: str, a: Any, b: Any, c: Any) -> None:
    element = core.CoreElement(core.ElementConfig(kind, HISTORY[kind]))
    signals = together(signal(a, 0.01), signal(b, 0.1), signal(c, 5.0))
    assert np.all(np.isfinite(element.run(*signals)))
    assert np.all(np.isfinite(element.state()))


@pytest.mark.parametrize("kind", HISTORY)
def test_bad_sample_does_not_enter_the_history_of_an_element(kind: str) -> None:
    x = smooth_motion(1.0, 4, peak_m=0.03)
    v = np.gradient(x, H)
    clean = [x, v, np.gradient(v, H)]
    for bad in BAD:
        spoilt, held = [s.copy() for s in clean], [s.copy() for s in clean]
        for values, last in zip(spoilt, held, strict=True):
            values[500], last[500] = bad, last[499]
        found = core.CoreElement(core.ElementConfig(kind, HISTORY[kind])).run(*spoilt)
        expected = core.CoreElement(core.ElementConfig(kind, HISTORY[kind])).run(*held)
        np.testing.assert_array_equal(found[501:], expected[501:], err_msg=str(bad))


# --- the whole controller ------------------------------------------------------------------------

CONTROLLERS: dict[str, dict[str, Any]] = {
    "paper": {
        "estimator": core.EstimatorConfig(law="gradient", gain=0.3, alpha0=17.0),
    },
    "robust": {
        "estimator": core.EstimatorConfig(law="robust", gain=0.05, alpha0=17.0),
        "rfc": {"tangent": "least-squares", "window": 30},
    },
    "alpha-beta": {
        "estimator": core.EstimatorConfig(
            law="rls", estimate_beta=True, alpha0=17.0, beta0=140.0, memory_samples=500.0
        ),
        "rfc": {"tangent": "least-squares", "window": 30},
    },
    "none": {"rfc": {"enabled": False}, "lead_enabled": False},
}


def structure(integrator: Any = "central-difference") -> core.MotionConfig:
    return core.MotionConfig(
        integrator, mass_kg=4220.0, damping_n_s_per_m=2121.0, k_e_n_per_m=K_PLATE
    )


@pytest.mark.long
@pytest.mark.parametrize("name", CONTROLLERS)
@settings(max_examples=15, deadline=None, derandomize=True, database=None)
@given(
    a=SEGMENTS,
    b=SEGMENTS,
    c=SEGMENTS,
    integrator=st.sampled_from(["central-difference", "forward-euler", "cr", "kr-alpha"]),
    lost=st.integers(2, 50),
)
def test_controller_survives_any_sequence_of_faults(
    name: str, a: Any, b: Any, c: Any, integrator: Any, lost: int
) -> None:
    x_m, f, ag = together(signal(a, 0.005), signal(b, 3e3), signal(c, 2.0))
    kernel = controller(structure(integrator), **CONTROLLERS[name])
    for n in range(x_m.size):
        is_lost = n % lost == 0
        sample = kernel.step(x_m[n], f[n], ag[n], is_lost)
        expected = verdict(ag[n], AG_MAX)
        if not is_lost:
            expected |= verdict(x_m[n], X_MAX) | verdict(f[n], F_MAX)
        assert sample.status == expected
        assert np.isfinite(sample.x_cmd_next_m)
        as_it_came = dict.fromkeys(("ag_mps2", "x_read_m", "f_read_n"), 0.0)
        row = sample.record | as_it_came
        assert np.all(np.isfinite(list(row.values())))
        predicted = is_lost or bool(verdict(x_m[n], X_MAX) | verdict(f[n], F_MAX))
        assert bool(row["flags"] & 2) == predicted
    assert_finite(kernel)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_bad_pairs_are_as_good_as_lost_ones(name: str) -> None:
    ag = smooth_motion(6.0, 5, peak_m=0.4)
    rng = np.random.default_rng(6)
    bad = rng.choice(ag.size, 60, replace=False)
    servo = core.ServoConfig("pure-delay", delay_samples=3)
    ignored = ("code", "state", "x_read_m", "f_read_n")  # a refused reading is told, and on record
    runs = []
    for by_loss in (True, False):
        kernel = controller(structure(), **CONTROLLERS[name])
        rig, x_cmd, rows = core.VirtualRig(core.RigConfig(servo, (PLATE,))), 0.0, []
        for n in range(ag.size):
            x, f, _ = rig.step(x_cmd)
            fault = float(BAD[n % len(BAD)])
            if n not in bad:
                sample = kernel.step(x, f, ag[n])
            elif by_loss:
                sample = kernel.step(x, f, ag[n], lost=True)
            else:
                sample = kernel.step(*((fault, f) if n % 2 else (x, fault)), ag[n])
            x_cmd = sample.x_cmd_next_m
            rows.append([sample.record[key] for key in sample.record if key not in ignored])
        runs.append(np.array(rows, dtype=np.float64))
    np.testing.assert_array_equal(runs[0], runs[1])


@pytest.mark.long
@pytest.mark.parametrize("name", CONTROLLERS)
def test_test_with_faults_and_a_stuck_sensor_comes_back_to_the_undisturbed_one(name: str) -> None:
    ag = smooth_motion(30.0, 7, peak_m=0.4) * (time_s(30.0) < 20.0)
    specimen = core.element("stiffness", k_n_per_m=0.6 * K_PLATE)
    numerical = core.MotionConfig(
        "central-difference",
        mass_kg=4220.0,
        damping_n_s_per_m=8000.0,
        stiffness_n_per_m=0.4 * K_PLATE,
        k_e_n_per_m=0.6 * K_PLATE,
    )
    runs = []
    for spoilt in (False, True):
        kernel = controller(numerical, k_e=0.6 * K_PLATE, **CONTROLLERS[name])
        rig = core.VirtualRig(core.RigConfig(core.ServoConfig("pure-delay"), (specimen,)))
        x_cmd, stuck, x_m = 0.0, (0.0, 0.0), np.zeros(ag.size)
        for n in range(ag.size):
            pair = rig.step(x_cmd)[:2]
            if spoilt and 3000 <= n < 3012:
                pair = (BAD[n % len(BAD)], pair[1])
            if spoilt and 5000 <= n < 5000 + STUCK_SAMPLES:
                pair = stuck
            stuck = pair
            sample = kernel.step(*pair, ag[n])
            x_cmd, x_m[n] = sample.x_cmd_next_m, rig.true_displacement_m
        assert_finite(kernel)
        runs.append(x_m)
    assert np.any(runs[1] != runs[0])
    assert rms(runs[1][-2048:] - runs[0][-2048:]) < 0.02 * rms(runs[0])


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.parametrize("integrator", ["central-difference", "forward-euler", "cr", "kr-alpha"])
def test_specimen_that_moves_not_at_all_gives_a_defined_test(name: str, integrator: Any) -> None:
    kernel = controller(structure(integrator), **CONTROLLERS[name])
    ag = smooth_motion(3.0, 8, peak_m=0.2)
    codes = [kernel.step(0.0, 0.0, value).status for value in ag]
    assert set(codes) == {0}
    assert_finite(kernel)


@pytest.mark.parametrize("name", CONTROLLERS)
def test_nan_in_the_ground_motion_ends_the_run_and_keeps_the_state_finite(name: str) -> None:
    ag = smooth_motion(2.0, 9, peak_m=0.4)
    ag[700] = np.nan
    rig = core.VirtualRig(core.RigConfig(core.ServoConfig("pure-delay", delay_samples=1), (PLATE,)))
    kernel = controller(structure(), **CONTROLLERS[name])
    records = run_virtual(kernel, rig, ag)
    assert records.size == 701
    assert records["code"][-1] == NOT_FINITE
    assert np.all(records["code"][:-1] == 0)
    assert_finite(kernel)
    assert_finite(rig)
