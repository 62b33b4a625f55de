"""Margins known before a test runs: gains of the lead, critical delays, the estimator's loop."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from rthyb_rt import config, core, ground_motion
from rthyb_rt.analysis import margins
from rthyb_rt.analysis.margins import Lead, OneDegree
from rthyb_rt.core import MotionConfig
from rthyb_rt.ground_motion import GroundMotion

# The structure of Section 4.2: T = 0.5 s, 2 % of critical damping.
MASS_KG, DAMPING, K_E = 30000.0, 15080.0, 4737410.0
INTEGRATORS = ("central-difference", "forward-euler", "cr", "kr-alpha")


def structure(
    integrator: core.Integrator = "central-difference",
    *,
    mass_kg: float = MASS_KG,
    damping: float = DAMPING,
    stiffness: float = 0.0,
    k_e: float = K_E,
    rho_inf: float = 1.0,
) -> MotionConfig:
    return MotionConfig(integrator, mass_kg, damping, stiffness, k_e, rho_inf=rho_inf)


# ---- gains of the phase lead --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("beta", "first_sample", "nyquist"), [(144.5, 324.0, 1837.0), (0.0, 35.0, 103.0)]
)
def test_lead_of_17_samples_has_the_stated_gains(
    beta: float, first_sample: float, nyquist: float
) -> None:
    lead = Lead(17.0, beta, 3.0, 2.0)
    assert lead.first_sample_gain == pytest.approx(first_sample, rel=1e-12)
    assert lead.nyquist_gain == pytest.approx(nyquist, rel=1e-12)


@pytest.mark.parametrize("weights", [(3.0, 2.0), (1.5, -2.0), (-4.0, 1.0)])
def test_gains_are_what_the_compensator_does(weights: tuple[float, float]) -> None:
    lead = Lead(12.0, 40.0, *weights)
    stepped, _ = core.Plc(*weights).step(12.0, 40.0, 1e-3)
    assert lead.first_sample_gain == pytest.approx(stepped / 1e-3, rel=1e-12)
    fastest = 1e-3 * (-1.0) ** np.arange(400)
    compensated = core.Plc(*weights).run(fastest, 12.0, 40.0)
    assert lead.nyquist_gain == pytest.approx(abs(compensated[-1]) / 1e-3, rel=1e-9)


def test_no_compensation_has_gain_one() -> None:
    assert Lead().first_sample_gain == 1.0
    assert Lead().nyquist_gain == 1.0


# ---- the delay that a structure survives --------------------------------------------------------


@pytest.mark.parametrize("rho_inf", [1.0, 0.5])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_integrator_as_a_transfer_function_is_the_cores(
    integrator: core.Integrator, rho_inf: float
) -> None:
    motion = structure(integrator, rho_inf=rho_inf)
    top, bottom = margins.compliance(motion)
    force = np.random.default_rng(1).normal(0.0, 1e4, 500)
    expected = signal.lfilter(np.pad(top, (bottom.size - top.size, 0)), bottom, force)
    running = core.Motion(motion)
    computed = [0.0] + [running.step(0.0, -value)[0] for value in force[:-1]]
    np.testing.assert_allclose(computed, expected, rtol=0.0, atol=1e-9 * np.abs(expected).max())


def test_prescribed_motion_has_no_structure_to_judge() -> None:
    with pytest.raises(ValueError, match="prescribed"):
        margins.compliance(MotionConfig("prescribed"))


@pytest.mark.parametrize(
    ("integrator", "without", "followed"),
    [("central-difference", 3, 39), ("forward-euler", 2, 34)],
)
def test_largest_stable_delay_of_the_half_second_structure(
    integrator: core.Integrator, without: int, followed: int
) -> None:
    motion = structure(integrator)
    assert math.floor(margins.critical_delay(OneDegree(motion))) == without
    largest = margins.largest_followed_delay(OneDegree(motion), Lead(), 80)
    assert largest is not None
    assert abs(largest - followed) <= 1


def test_critical_delay_without_lead_is_twice_the_damping_ratio_over_the_frequency() -> None:
    # A delay tau takes k tau off the damping: 2 zeta / omega is what there is.
    omega = math.sqrt(K_E / MASS_KG)
    zeta = DAMPING / (2.0 * math.sqrt(K_E * MASS_KG))
    assert margins.critical_delay(OneDegree(structure())) == pytest.approx(
        2.0 * zeta / omega * core.FS_HZ, rel=0.01
    )


@pytest.mark.parametrize("lead", [Lead(), Lead(10.0), Lead(17.0, 144.5), Lead(40.0)])
@pytest.mark.parametrize("stiffness", [0.0, 2.0 * K_E])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_critical_delay_agrees_with_the_roots_at_every_delay(
    integrator: core.Integrator, stiffness: float, lead: Lead
) -> None:
    motion = structure(integrator, stiffness=stiffness)
    critical = margins.critical_delay(OneDegree(motion), lead)
    start = round(lead.alpha)
    assert (critical > 0.0) == OneDegree(motion).is_stable(start, lead)
    if critical > 0.0:
        for delay in range(start, math.floor(critical) + 1):
            assert OneDegree(motion).is_stable(delay, lead)
        assert not OneDegree(motion).is_stable(math.floor(critical) + 1, lead)


def free_vibration(delay_samples: int, alpha: float) -> np.ndarray:
    """Displacement after a jolt, with the delay in the loop and the lead at a fixed alpha."""
    controller = core.Controller(
        core.ControllerConfig(
            law=core.LawConfig("paper", {"alpha0": alpha}, adapts=False),
            rfc=core.RfcConfig(k_e_n_per_m=K_E, enabled=False),
            motion=structure(),
        )
    )
    rig = core.VirtualRig(
        core.RigConfig(
            core.ServoConfig("pure-delay", delay_samples=float(delay_samples)),
            (core.element("stiffness", k_n_per_m=K_E),),
            load_cell="specimen",
        )
    )
    jolt = np.zeros(20 * 1024)
    jolt[:10] = 0.01
    records = np.zeros(jolt.size, dtype=core.RECORD_DTYPE)
    controller.run_virtual(rig, jolt, records)
    return np.asarray(records["x_num_m"])


@pytest.mark.parametrize("alpha", [0.0, 10.0, 17.0])
def test_free_vibration_dies_out_below_the_critical_delay_and_grows_above(alpha: float) -> None:
    last = math.floor(margins.critical_delay(OneDegree(structure()), Lead(alpha)))
    for delay, grows in ((last, False), (last + 1, True)):
        x = free_vibration(delay, alpha)
        early, late = np.abs(x[2048:4096]).max(), np.abs(x[-2048:]).max()
        assert (late > early) == grows


def test_undamped_structure_survives_no_delay() -> None:
    assert margins.critical_delay(OneDegree(structure(damping=0.0))) == 0.0
    assert (
        margins.largest_followed_delay(
            OneDegree(structure("forward-euler", damping=0.0)), Lead(), 9
        )
        is None
    )


def test_weak_specimen_beside_a_stiff_damped_computed_part_bears_any_delay() -> None:
    motion = structure(stiffness=100.0 * K_E, damping=20.0 * DAMPING)
    assert margins.critical_delay(OneDegree(motion)) == math.inf
    assert OneDegree(motion).is_stable(200)
    assert margins.largest_followed_delay(OneDegree(motion), Lead(), 12) == 12


# ---- the delay estimator's loop -----------------------------------------------------------------


@pytest.mark.parametrize("delay", [10, 17, 40])
def test_estimate_behind_a_delay_oscillates_above_half_pi(delay: int) -> None:
    def rate(g: float) -> float:
        """Largest root of e[n+1] = e[n] - g / delay e[n - delay]."""
        roots = np.roots([1.0, -1.0, *np.zeros(delay - 1), g / delay])
        return float(np.abs(roots).max())

    assert rate(0.9 * margins.OSCILLATES) < 1.0
    assert rate(1.1 * margins.OSCILLATES) > 1.0
    # At the advised gain an error still dies out within three delays.
    assert rate(margins.LITTLE_MARGIN) ** (3 * delay) < 0.4


@pytest.mark.parametrize(("gain", "expected"), [(0.1, 0.87), (0.3, 2.6)])
def test_guard_on_tcu068_with_ten_samples_of_delay(
    tcu068_first_50_s: GroundMotion, gain: float, expected: float
) -> None:
    motion = tcu068_first_50_s.scaled(pga_g=0.2)
    ag = ground_motion.resample(motion, core.FS_HZ)
    x = OneDegree(structure("forward-euler")).elastic_displacement_m(ag)
    phi = margins.peak_excitation(x, Lead(w1=3.0, w2=2.0))
    assert margins.estimator_loop_gain(gain, 10.0, phi) == pytest.approx(expected, rel=0.01)


def test_peak_excitation_of_a_ramp_is_its_slope_times_six() -> None:
    ramp = 0.25e-3 * np.arange(100)
    assert margins.peak_excitation(ramp, Lead()) == pytest.approx(6.0 * 0.25)
    assert margins.peak_excitation(ramp, Lead(), reference_m=0.01) == pytest.approx(0.6 * 0.25)
    assert margins.peak_excitation([0.0], Lead()) == 0.0


# ---- lag or delay -------------------------------------------------------------------------------

RIG = """
schema = "rthyb-rig/1"
rig = {{ name = "r", elastic_stiffness_n_per_m = 1e5 }}
actuator = {{ {actuator} }}
specimen = [{{ element = "stiffness", k_n_per_m = 1e5 }}]
{identified}
"""
PURE = 'kind = "pure-delay", delay_samples = 10'


@pytest.mark.parametrize(
    ("actuator", "lag"),
    [
        (PURE, False),
        ('kind = "first-order", roll_off_hz = 5', True),
        ('kind = "servo-hydraulic"', True),
        ('kind = "second-order", natural_frequency_hz = 10, damping_ratio = 0.7', True),
        (
            'kind = "second-order", natural_frequency_hz = 100, damping_ratio = 0.5, '
            "delay_s = 0.01",
            False,
        ),
    ],
)
def test_kind_of_actuator_tells_lag_from_delay_before_an_identification(
    actuator: str, lag: bool
) -> None:
    rig = config.parse_rig(RIG.format(actuator=actuator, identified=""))
    assert margins.is_lag(rig) is lag


@pytest.mark.parametrize(
    ("delays", "amplitudes", "lag"),
    [
        ("[0.017, 0.0169]", "[1.0, 0.99]", False),
        ("[0.017, 0.011]", "[1.0, 0.99]", True),
        ("[0.017, 0.0169]", "[1.0, 0.6]", True),
    ],
)
def test_identified_sweep_tells_lag_from_delay(delays: str, amplitudes: str, lag: bool) -> None:
    identified = (
        "[identified]\nalpha = 17\ndelay_s = 0.017\nfrequency_hz = [1, 8]\n"
        f"delay_at_frequency_s = {delays}\namplitude = {amplitudes}\n"
    )
    rig = config.parse_rig(RIG.format(actuator=PURE, identified=identified))
    assert margins.is_lag(rig) is lag
