"""The figures of Chen & Tsai's numerical studies, as independent code found them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from kernels import (
    FS_HZ,
    Floats,
    G,
    H,
    controller,
    damping_ratio,
    resonance,
    rms,
    run_virtual,
    time_s,
    track,
)

from rthyb_rt import core
from rthyb_rt.ground_motion import GroundMotion

MASS, DAMPING, K = 30000.0, 15080.0, 4737410.0
ROLL_OFF_5_HZ = core.ServoConfig("first-order", roll_off_hz=31.42 / (2 * np.pi))
ROLL_OFF_ONE_MORE = core.ServoConfig(
    "first-order", roll_off_hz=31.42 / (2 * np.pi), delay_samples=1
)
BOUC_WEN = core.element(
    "hysteresis", k_n_per_m=K, post_yield_ratio=0.02, a=1, b=300, c=200, eta=1.5
)
ELASTIC = core.element("stiffness", k_n_per_m=K)


# --- Section 4.1: the delay estimator ------------------------------------------------------------


def least_squares_alpha(plant: Any, frequency_hz: float) -> float:
    """Re{W (1/H - 1) conj(S (1 - 1/z))} / |S (1 - 1/z)|^2 with W1 = 3, W2 = 2."""
    z = np.exp(2j * np.pi * frequency_hz / FS_HZ)
    phi = 6.0 * (1.0 - 1.0 / z)
    mu = (3.0 + 2.0 / z + 1.0 / z**2) * (1.0 / plant(z) - 1.0)
    return float((mu * np.conj(phi)).real / abs(phi) ** 2)


def lag(extra_samples: int) -> Any:
    """x_m[n] = p x_m[n-1] + (1 - p) x_p[n-1-extra]."""
    p = np.exp(-31.42 / FS_HZ)
    return lambda z: (1.0 - p) * z ** (-1 - extra_samples) / (1.0 - p / z)


@pytest.mark.parametrize(
    ("servo", "plant", "frequency_hz", "gain", "alpha", "band"),
    [
        (
            core.ServoConfig("pure-delay", delay_samples=10),
            lambda z: z**-10,
            1.0,
            0.3,
            9.991,
            0.02,
        ),
        (
            core.ServoConfig("pure-delay", delay_samples=17),
            lambda z: z**-17,
            2.0,
            0.1,
            16.870,
            0.02,
        ),
        (ROLL_OFF_5_HZ, lag(0), 1.0, 0.3, 33.089, 0.01),
        (ROLL_OFF_ONE_MORE, lag(1), 1.0, 0.3, 34.085, 0.02),
    ],
    ids=["delay 10", "delay 17", "lag", "lag and one sample"],
)
def test_single_sine_of_1_mm_settles_the_printed_law(
    servo: core.ServoConfig, plant: Any, frequency_hz: float, gain: float, alpha: float, band: float
) -> None:
    command = 1e-3 * np.sin(2 * np.pi * frequency_hz * time_s(60.0))
    records = track(command, servo, core.EstimatorConfig(law="gradient", gain=gain))
    settled = np.mean(records["alpha"][-10_240:])
    assert settled == pytest.approx(alpha, abs=band)
    assert settled == pytest.approx(least_squares_alpha(plant, frequency_hz), abs=0.02)


@pytest.mark.parametrize(
    ("servo", "alpha"), [(ROLL_OFF_5_HZ, 33.06), (ROLL_OFF_ONE_MORE, 33.98)], ids=["lag", "lag+1"]
)
def test_section_4_1_sweep_settles_in_12_s(servo: core.ServoConfig, alpha: float) -> None:
    t = time_s(120.0)
    command = 1e-3 * np.sin(2 * np.pi * (0.1 * t + 0.5 * (10.0 - 0.1) / 120.0 * t**2))
    records = track(command, servo, core.EstimatorConfig(law="gradient", gain=1.0))
    estimate = records["alpha"]
    mean = np.mean(estimate[20 * 1024 : 60 * 1024])
    assert mean == pytest.approx(alpha, abs=0.1)
    outside = np.flatnonzero(np.abs(estimate[: 60 * 1024] / mean - 1.0) > 0.02)
    assert outside[-1] / FS_HZ == pytest.approx(12.0, abs=1.0)


def test_sweep_in_metres_instead_of_millimetres_learns_nothing() -> None:
    t = time_s(120.0)
    command = 1e-3 * np.sin(2 * np.pi * (0.1 * t + 0.5 * (10.0 - 0.1) / 120.0 * t**2))
    law = core.EstimatorConfig(law="gradient", gain=1.0, reference_m=1.0)
    assert np.max(track(command, ROLL_OFF_5_HZ, law)["alpha"]) < 1.0


# --- Section 4.2: the inelastic structure --------------------------------------------------------


@pytest.fixture(scope="module")
def shaking(tcu068_first_50_s: GroundMotion) -> Floats:
    """TCU068 EW, first 50 s to 0.2 g, straight between its samples, and 10 s of rest."""
    record = tcu068_first_50_s
    ag = np.interp(time_s(60.0), record.time_s, record.acceleration_mps2, right=0.0)
    return np.asarray(ag * 0.2 * G / np.max(np.abs(record.acceleration_mps2)))


def structure(integrator: Any) -> core.MotionConfig:
    return core.MotionConfig(integrator, mass_kg=MASS, damping_n_s_per_m=DAMPING, k_e_n_per_m=K)


def hybrid_test(
    ag: Floats,
    *,
    law: Any = "gradient",
    gain: float = 0.005,
    alpha0: float = 0.0,
    plc: bool = True,
    rfc: bool = False,
    specimen: core.ElementConfig = BOUC_WEN,
    delay: int = 10,
    integrator: str = "forward-euler",
) -> Any:
    c = controller(
        structure(integrator),
        estimator=core.EstimatorConfig(law=law, gain=gain, alpha0=alpha0),
        rfc={"k_e_n_per_m": K, "enabled": rfc, "window": 51, "end_tick": 50 * 1024},
        lead_enabled=plc,
    )
    servo = core.ServoConfig("pure-delay", delay_samples=delay)
    return run_virtual(c, core.VirtualRig(core.RigConfig(servo, (specimen,))), ag)


@pytest.fixture(scope="module")
def exact(shaking: Floats) -> Floats:
    x, _, _ = core.Motion(structure("forward-euler")).reference([BOUC_WEN], shaking)
    return x


def accumulated(records: Any, exact: Floats) -> float:
    """Eqn 4.3 at the end, m."""
    return float(np.sum(np.abs(records["x_meas_m"] - exact[: records.size])))


def error(records: Any, exact: Floats) -> float:
    return rms(records["x_meas_m"] - exact[: records.size]) / rms(exact)


def test_exact_solution_peaks_at_36_34_mm(exact: Floats) -> None:
    assert 1e3 * np.max(np.abs(exact)) == pytest.approx(36.34, abs=0.1)


def test_exact_solution_is_forward_euler_written_again(shaking: Floats, exact: Floats) -> None:
    # Eqn 4.2 from one sample to the next by twenty small steps of its own.
    n = 20 * 1024
    x = v = z = 0.0
    expected = np.zeros(n)
    for i, ag in enumerate(shaking[:n].tolist()):
        expected[i] = x
        acceleration = (-MASS * ag - DAMPING * v - 0.02 * K * x - 0.98 * K * z) / MASS
        du = H * v / 20.0
        for _ in range(20):
            z += du - 300.0 * abs(du) * abs(z) ** 0.5 * z - 200.0 * du * abs(z) ** 1.5
        x, v = x + H * v, v + H * acceleration
    assert rms(expected - exact[:n]) < 2e-3 * rms(exact[:n])


def test_uncompensated_test_ends_in_a_limit_cycle(shaking: Floats, exact: Floats) -> None:
    records = hybrid_test(shaking, law="fixed", plc=False)
    assert records.size == shaking.size
    assert error(records, exact) > 0.50
    assert 1e3 * np.ptp(records["x_meas_m"][55 * 1024 :]) == pytest.approx(17.9, abs=0.5)
    assert accumulated(records, exact) == pytest.approx(396.0, abs=5.0)


def test_uncompensated_elastic_specimen_passes_100_mm_at_11_2_s(shaking: Floats) -> None:
    records = hybrid_test(shaking, law="fixed", plc=False, specimen=ELASTIC)
    passed = np.flatnonzero(np.abs(records["x_meas_m"]) > 0.1)[0] / FS_HZ
    assert passed == pytest.approx(11.2, abs=0.2)


def test_adaptive_compensator_converges_after_more_than_12_s(
    shaking: Floats, exact: Floats
) -> None:
    records = hybrid_test(shaking)
    estimate = records["alpha"]
    assert estimate[-1] == pytest.approx(9.96, abs=0.03)
    outside = np.flatnonzero(np.abs(estimate / estimate[-1] - 1.0) > 0.05)
    assert outside[-1] / FS_HZ == pytest.approx(13.3, abs=1.0)
    assert accumulated(records, exact) == pytest.approx(22.5, abs=1.0)


def test_force_compensation_takes_the_accumulated_error_down_by_five(
    shaking: Floats, exact: Floats
) -> None:
    alone, both = hybrid_test(shaking), hybrid_test(shaking, rfc=True)
    assert accumulated(both, exact) == pytest.approx(3.3, abs=0.4)
    assert accumulated(alone, exact) / accumulated(both, exact) >= 5.0
    assert error(both, exact) < 0.01
    assert both["alpha"][-1] == pytest.approx(9.96, abs=0.03)


@pytest.mark.parametrize(
    ("settings", "metres", "band"),
    [
        ({"plc": False, "rfc": True}, 10.7, 1.1),
        ({"alpha0": 10.0}, 13.6, 0.7),
        ({"alpha0": 10.0, "rfc": True}, 3.4, 0.4),
    ],
    ids=["RFC only", "PLC 10", "PLC 10 + RFC"],
)
def test_accumulated_error_of_fixed_settings(
    shaking: Floats, exact: Floats, settings: dict[str, Any], metres: float, band: float
) -> None:
    records = hybrid_test(shaking, law="fixed", **settings)
    assert accumulated(records, exact) == pytest.approx(metres, abs=band)


@pytest.mark.parametrize("integrator", ["forward-euler", "central-difference"])
def test_gain_of_section_4_1_wrecks_section_4_2(shaking: Floats, integrator: str) -> None:
    motion = core.Motion(structure(integrator))
    exact, _, _ = motion.reference([BOUC_WEN], shaking)
    calm = hybrid_test(shaking, gain=0.1, integrator=integrator)
    wild = hybrid_test(shaking, gain=0.3, integrator=integrator)
    assert error(calm, exact) < 0.03
    assert error(wild, exact) > 0.10


# --- damping and the largest stable delay --------------------------------------------------------


@pytest.mark.parametrize(
    ("integrator", "percent"),
    [("forward-euler", 1.3865), ("central-difference", 2.0), ("cr", 2.0), ("kr-alpha", 2.0)],
)
def test_two_per_cent_of_damping_after_the_integrator(integrator: str, percent: float) -> None:
    ag = np.zeros(4096)
    ag[0] = 1.0
    w = 2 * np.pi / 0.5
    motion = core.MotionConfig(
        integrator,  # type: ignore[arg-type]
        mass_kg=MASS,
        damping_n_s_per_m=2 * 0.02 * w * MASS,
        k_e_n_per_m=MASS * w**2,
    )
    specimen = core.element("stiffness", k_n_per_m=MASS * w**2)
    x, _, _ = core.Motion(motion).reference([specimen], ag)
    pole = resonance(x[1:], 2)[0]
    assert 100.0 * damping_ratio(pole) == pytest.approx(percent, abs=0.002)


def spectral_radius(integrator: str, delay: int, plc: bool) -> float:
    """Largest root of the loop's characteristic polynomial, in z^-1: numerical part times force.

    Central difference: [m (1 - q)^2 / h^2 + c (1 - q^2) / (2 h)] X + q k C q^D X = 0, q = 1/z;
    forward Euler: [m (1 - q)^2 / h^2 + c q (1 - q) / h] X + q^2 k C q^D X = 0.
    """
    poly = np.polynomial.polynomial
    one_minus_q = np.array([1.0, -1.0])
    if integrator == "central-difference":
        damping, order = DAMPING / (2 * H) * np.array([1.0, 0.0, -1.0]), 1
    else:
        damping, order = DAMPING / H * np.array([0.0, 1.0, -1.0]), 2
    own = poly.polyadd(MASS / H**2 * poly.polymul(one_minus_q, one_minus_q), damping)
    weights, lead = np.array([3.0, 2.0, 1.0]), 6.0 * delay * one_minus_q
    numerator = poly.polyadd(weights, lead) if plc else weights
    force = K * np.concatenate([np.zeros(order + delay), numerator])
    loop = poly.polyadd(poly.polymul(own, weights), force)
    return float(np.max(np.abs(np.roots(loop))))  # as powers of z: highest first


def survives(integrator: str, delay: int, plc: bool) -> bool:
    """Whether two minutes of free vibration of the core's own loop end smaller than they began."""
    ag = np.zeros(120 * 1024)
    ag[:20] = 1.0
    records = hybrid_test(
        ag,
        law="fixed",
        alpha0=float(delay) if plc else 0.0,
        plc=plc,
        specimen=ELASTIC,
        delay=delay,
        integrator=integrator,
    )
    x = np.abs(records["x_meas_m"])
    return bool(np.max(x[-4096:]) < np.max(x[8192:12288]))


@pytest.mark.parametrize(
    ("integrator", "plc", "expected"),
    [
        ("central-difference", False, 3),
        ("central-difference", True, 39),
        ("forward-euler", False, 2),
        ("forward-euler", True, 34),
    ],
)
def test_largest_stable_delay_of_an_elastic_specimen(
    integrator: str, plc: bool, expected: int
) -> None:
    delays = range(max(expected - 3, 0), expected + 4)
    by_core = [d for d in delays if survives(integrator, d, plc)]
    by_roots = [d for d in delays if spectral_radius(integrator, d, plc) < 1.0]
    assert by_core == by_roots
    assert max(by_core) == pytest.approx(expected, abs=1)
