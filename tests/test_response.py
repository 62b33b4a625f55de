"""What an identified response gives to a test: resonance, fitted inverse, defaults of laws."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.optimize
from kernels import Floats

from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.benchmark import plants as rths_benchmark
from rthyb_rt.config import Rate, RigFile, response, rigsettings
from rthyb_rt.config.rigfile import Identified
from rthyb_rt.core.laws import LAWS
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.rig.identification import FREQUENCIES_HZ, SweepPlan, identified_rig, identify

TEST = """schema = "rthyb-test/1"
test = {{ name = "t", sample_rate_hz = {rate} }}
numerical = {{ period_s = 0.5, damping_ratio = 0.02 }}
[controller]
type = "{law}"
{more}
"""
FRAME = """
[numerical.matrices]
integrator = "{integrator}"
force_delay_samples = {late}
m_kg = [1000]
k_n_per_m = [["2 MN/m"]]
damping_ratios = [0.05]
"""
SECTION_4_2 = Path(__file__).parents[1] / "examples" / "section4.2.toml"
TONES = np.array(FREQUENCIES_HZ)


def derived(rig: RigFile, law: str, more: str = "", rate: int = 1024) -> config.Derived:
    return config.derive(config.parse_test(TEST.format(rate=rate, law=law, more=more)), rig)


def framed(rig: RigFile, law: str, integrator: str, late: int, rate: int = 1024) -> config.Derived:
    text = TEST.format(rate=rate, law=law, more="").replace(
        "numerical = { period_s = 0.5, damping_ratio = 0.02 }\n", ""
    )
    return config.derive(
        config.parse_test(text + FRAME.format(integrator=integrator, late=late)), rig
    )


def with_identified(rig: RigFile, **changes: object) -> RigFile:
    assert rig.identified is not None
    return rig.model_copy(update={"identified": rig.identified.model_copy(update=changes)})


def nominal() -> RigFile:
    return rths_benchmark.nominal()


def old() -> RigFile:
    """The same rig file as the version before wrote it."""
    kept = {key: getattr(nominal().identified, key)[:9] for key in ("frequency_hz", "amplitude",
            "delay_at_frequency_s")}  # fmt: skip
    return with_identified(
        nominal(),
        **kept,
        roll_off_hz=None,
        force_in_phase_n_per_m=[],
        force_in_quadrature_n_per_m=[],
    )


def found_of(f: Floats, g: np.ndarray) -> Identified:
    """A response as a rig file has it."""
    lag = -np.unwrap(np.angle(g)) / (2.0 * np.pi * f)
    return Identified(
        alpha=20.0, delay_s=0.02, frequency_hz=list(f), amplitude=list(np.abs(g)),
        delay_at_frequency_s=list(lag),
    )  # fmt: skip


# ---- the first resonance ------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 7001, 7003, 7015])
def test_identify_finds_the_resonance_of_actuator_and_specimen(seed: int | None) -> None:
    """Against the plant's own poles: the transfer functions of the benchmark, written out."""
    rig = nominal() if seed is None else rths_benchmark.drawn(seed)
    a = rig.actuator
    assert a.kind == "servo-valve"
    k = sum(e.k_n_per_m for e in rig.specimen if e.element == "stiffness")
    c = sum(e.c_n_s_per_m for e in rig.specimen if e.element == "viscous")
    valve, specimen = [1.0, a.valve_b1_per_s, a.valve_b2_per_s2], [29.13, c, k]
    flow = np.polyadd(np.polymul([1.0, a.leakage_per_s], specimen),
                      [a.velocity_feedback_n_s_per_m2, 0.0])  # fmt: skip
    whole = np.polyadd(np.polymul(valve, flow), [a.valve_n_per_m_s3])
    poles = np.roots(whole)
    light = poles[(poles.imag > 0) & (-poles.real < 0.1 * np.abs(poles))]
    result = identify(rig, SweepPlan.up_to(80.0))
    assert result.resonance_hz == pytest.approx(float(np.abs(light[0])) / (2 * np.pi), rel=0.02)
    written = identified_rig(rig, result).identified
    assert written is not None
    assert written.roll_off_hz == pytest.approx(0.9 * result.resonance_hz, rel=1e-2)
    assert len(written.force_in_phase_n_per_m) == len(written.frequency_hz) == 15


@pytest.mark.parametrize(
    ("name", "top_hz"),
    [
        ("shaking-table-portal-frame", 80.0),
        ("first-order-5hz", 80.0),
        ("delay-10-elastic", 80.0),
        ("rths-benchmark", 10.0),
        ("rths-benchmark", 40.0),
    ],
)
def test_a_rig_without_one_in_the_sweep_has_no_resonance(name: str, top_hz: float) -> None:
    result = identify(config.load_rig(config.shipped_rig(name)), SweepPlan.up_to(top_hz))
    assert result.resonance_hz is None
    assert identified_rig(nominal(), result).identified.roll_off_hz is None  # type: ignore[union-attr]


@pytest.mark.parametrize("damping", [0.01, 0.1, 0.19, 0.3])
@pytest.mark.parametrize("at_hz", [25.0, 55.0])
def test_only_what_swings_is_a_resonance(damping: float, at_hz: float) -> None:
    w, s = 2 * np.pi * at_hz, 2j * np.pi * TONES
    g = np.exp(-0.004 * s) / ((1 + s / 60.0) * (1 + 2 * damping * s / w + (s / w) ** 2))
    found = response.resonance_hz(TONES, g, 0.02)
    assert found == (pytest.approx(at_hz, rel=0.01) if damping < 0.2 else None)


def test_a_response_that_no_plant_explains_has_no_resonance() -> None:
    rng = np.random.default_rng(1)
    g = np.exp(2j * np.pi * rng.uniform(size=TONES.size))
    assert response.resonance_hz(TONES, g, 0.02) is None


# ---- the response at another rate ---------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [512.0, 2048.0, 4096.0])
def test_response_at_another_rate_is_that_of_the_plant_held_as_long(rate_hz: float) -> None:
    """A lag of 8 Hz behind a zero-order hold, in closed form at both rates."""
    w = 2 * math.pi * 8.0

    def held(f: float, h: float) -> complex:
        p, z = math.exp(-w * h), cmath.exp(2j * math.pi * f * h)
        return (1 - p) / (z - p)

    # Beyond that, what the hold mirrors about half the rate is part of the closed form.
    top_hz = min(rate_hz, 1024.0) / 40.0
    f = np.array([tone for tone in FREQUENCIES_HZ if tone <= top_hz])
    swept = np.array([held(one, 1.0 / 1024.0) for one in f])
    got = response.response(found_of(f, swept), Rate(rate_hz), hold="zoh")
    expected = np.array([held(one, 1.0 / rate_hz) for one in f])
    np.testing.assert_allclose(got, expected, rtol=0.01)


# ---- the fit ------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [1024.0, 4096.0])
def test_fit_is_scipys_bounded_least_squares_of_the_same_residual(rate_hz: float) -> None:
    import scipy.optimize

    rate = Rate(rate_hz)
    g = response.response(nominal().identified, rate)  # type: ignore[arg-type]
    made = response.fit(TONES, g, rate.period_s, 120.0)
    weight = 1.0 / (1.0 + (TONES / 6.0) ** 2) + 0.01
    delta = 1.0 - np.exp(-2j * np.pi * TONES * rate.period_s)
    rho = math.exp(-2 * math.pi * 120.0 / rate_hz)
    lag = (1.0 + rho / (1.0 - rho) * delta) ** 5
    size = np.abs(made.b)

    def residual(x: Floats) -> Floats:
        c = 1.0 + sum(x[j] * size[j] * (delta * rate_hz) ** j for j in range(6)) / lag
        off = weight * (c * g - 1.0)
        return np.concatenate([off.real, off.imag])

    again = scipy.optimize.least_squares(residual, np.zeros(6), xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert np.sum(residual(made.b / size) ** 2) <= np.sum(again.fun**2) * (1 + 1e-6)
    np.testing.assert_allclose(made.b, again.x * size, rtol=1e-3)
    assert made.largest_root < 1.0
    assert made.worst < response.LARGEST_ERROR


def test_fitted_lead_undoes_a_rig_of_its_own_form() -> None:
    h, wanted = 1.0 / 1024.0, (0.97, 0.017, 1.1e-4)
    w1, w2 = rigsettings.weights(60.0, h)
    f = TONES[TONES <= 10.0]
    delta = 1.0 - np.exp(-2j * np.pi * f * h)
    terms = (wanted[0] - 1.0) + wanted[1] / h * delta + wanted[2] / h**2 * delta**2
    c = 1.0 + (w1 + w2 + 1.0) * terms / (w1 + w2 * (1 - delta) + (1 - delta) ** 2)
    start = response.fitted_lead(f, 1.0 / c, h, w1, w2)
    assert (start.gain, start.delay_s, start.curvature_s2) == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"frequency_hz": [], "amplitude": [], "delay_at_frequency_s": []}, "there is none: run"),
        (
            "10 Hz",
            "9 frequencies up to 10 Hz; the control law inverse needs 8 or more, up to at least 40",
        ),
        ("few", "has 3 frequencies up to 80 Hz"),
        ("slipped", "no inverse of order 5 fits the response: at"),
        ("leading", "the fit to the response is unstable: its largest root is"),
    ],
)
def test_inverse_names_a_response_that_it_cannot_use(change: object, complaint: str) -> None:
    rig, s = nominal(), 2j * np.pi * TONES
    if change == "10 Hz":
        rig = old()
    elif change == "few":
        f = np.array([1.0, 10.0, 80.0])
        rig = rig.model_copy(update={"identified": found_of(f, 1.0 / (1.0 + 0.02j * f))})
    elif change == "slipped":
        assert rig.identified is not None
        high = [a * (1.6 if i == 5 else 1.0) for i, a in enumerate(rig.identified.amplitude)]
        rig = with_identified(rig, amplitude=high)
    elif change == "leading":
        rig = rig.model_copy(update={"identified": found_of(TONES, 1.0 / (1.0 - s / 300.0))})
    else:
        assert isinstance(change, dict)
        rig = with_identified(
            rig, **change, force_in_phase_n_per_m=[], force_in_quadrature_n_per_m=[]
        )
    with pytest.raises(InputError) as caught:
        derived(rig, "inverse")
    assert complaint in str(caught.value)
    assert "rthyb identify" in str(caught.value)
    assert len(caught.value.problems) == 1


@pytest.mark.parametrize("identified", [True, False])
def test_law_fitted_to_a_response_that_is_too_short_is_refused_under_its_own_name(
    monkeypatch: pytest.MonkeyPatch, identified: bool
) -> None:
    monkeypatch.setitem(LAWS, "ours", replace(LAWS["inverse"], name="ours"))
    test = config.parse_test(TEST.format(rate=1024, law="inverse", more=""))
    test = test.model_copy(
        update={"controller": test.controller.model_copy(update={"type": "ours"})}
    )
    rig = old() if identified else old().model_copy(update={"identified": None})
    with pytest.raises(InputError, match="the control law ours needs") as caught:
        config.derive(test, rig)
    assert "law inverse" not in str(caught.value)


def test_gain_alpha_beta_needs_no_more_than_the_sweep_to_ten_hertz() -> None:
    settings = derived(old(), "gain-alpha-beta").law_settings
    assert settings["gain_alpha_beta.gain0"] == pytest.approx(0.99, abs=0.02)
    assert settings["gain_alpha_beta.delay0_s"] == pytest.approx(0.024, abs=0.002)
    assert settings["gain_alpha_beta.roll_off_hz"] == 60.0
    bare = old().model_copy(update={"identified": Identified(alpha=20.48, delay_s=0.02)})
    settings = derived(bare, "gain-alpha-beta").law_settings
    assert settings["gain_alpha_beta.delay0_s"] == pytest.approx(0.02)
    assert settings["gain_alpha_beta.curvature0_s2"] == 0.0


# ---- defaults by the rig's resonance ------------------------------------------------------------


@pytest.mark.parametrize("law", ["alpha-beta", "inverse"])
def test_a_strong_motion_behind_an_unknown_delay_is_followed_to_a_twentieth_of_a_percent(
    tcu068_first_50_s: GroundMotion, law: str
) -> None:
    """Section 4.2 of the paper; the rig is swept to 40 Hz, and the estimate begins at 0."""
    rig = config.load_rig(config.shipped_rig("delay-10-bouc-wen"))
    k_e_n_per_m = rig.rig.elastic_stiffness_n_per_m
    rig = identified_rig(rig, identify(rig, SweepPlan.up_to(40.0)))
    # Swept at 2 mm, where it has begun to yield a little.
    assert rig.rig.elastic_stiffness_n_per_m == pytest.approx(k_e_n_per_m, rel=0.01)
    test = config.load_test(SECTION_4_2, {"controller.type": law, "ground_motion.pga_g": "0.2"})
    setup = experiment.prepare(test, rig, record=tcu068_first_50_s)
    found = summary.summarize(virtual_time.run(setup)).as_json()
    assert found["end_reason"] == "completed"
    assert found["response_nrmse"] < 5e-4
    assert found["tracking_nrmse"] < 5e-4


def best_curvature(roll_off_hz: float, rate: int) -> float:
    """Beta in samples of 1/1024 s, by a general minimizer of |C G - 1| over the slow tones."""
    found = nominal().identified
    assert found is not None
    f = np.array(found.frequency_hz)
    slow = f <= response.SLOW_HZ
    g = response.response(found, Rate(rate), hold=response.hold_of(nominal()))[slow]
    f = f[slow]
    z = np.exp(2j * np.pi * f / rate)
    rho = math.exp(-2 * math.pi * roll_off_hz / rate)
    rolled = (1 - rho) ** 2 / (1 - rho / z) ** 2
    weight = 1 / (1 + (f / response.KNEE_HZ) ** 2) + response.FLOOR

    def left(terms: Floats) -> Floats:
        alpha_s, beta_s2 = terms * (1e-2, 1e-4)
        slope = (1 - 1 / z) * rate
        error = weight * ((1 + rolled * (alpha_s * slope + beta_s2 * slope**2)) * g - 1)
        return np.concatenate([error.real, error.imag])

    made = scipy.optimize.least_squares(left, [2.0, 2.0], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    return float(made.x[1]) * 1e-4 * 1024**2


@pytest.mark.parametrize("rate", [1024, 4096])
@pytest.mark.parametrize("law", ["robust", "alpha-beta"])
def test_a_known_resonance_rolls_the_lead_and_the_force_compensation_off(
    law: str, rate: int
) -> None:
    found = derived(nominal(), law, rate=rate)
    rho = math.exp(-2 * math.pi * 60.2 / rate)
    settings = found.law_settings
    assert settings["w1"] == pytest.approx(1 / rho**2)
    assert settings["w2"] == pytest.approx(-2 / rho)
    poles = np.roots([settings["w1"], settings["w2"], 1.0])
    assert np.abs(poles) == pytest.approx(rho, rel=1e-6)
    assert settings["delay_estimator.cutoff_hz"] == 10.0
    assert found.rfc_cutoff_hz == 60.2
    assert settings["beta0"] == pytest.approx(best_curvature(60.2, rate), rel=1e-6)
    assert not any("rolled off as before" in note for note in found.notes)


def test_what_the_test_says_itself_comes_first() -> None:
    given = derived(nominal(), "alpha-beta", "w1 = 4\nrfc = { cutoff_hz = 0 }")
    assert (given.law_settings["w1"], given.law_settings["w2"]) == (4.0, 2.0)
    assert given.law_settings["delay_estimator.cutoff_hz"] == 25.0
    assert given.rfc_cutoff_hz == 0.0
    assert given.law_settings["beta0"] == 0.0
    assert derived(nominal(), "robust", "beta0 = 7").law_settings["beta0"] == 7.0
    assert derived(nominal(), "robust", "beta0 = 7").law_settings["w2"] < 0.0
    other = derived(nominal(), "alpha-beta", "delay_estimator = { cutoff_hz = 15 }")
    assert other.law_settings["delay_estimator.cutoff_hz"] == 15.0
    assert other.law_settings["w2"] < 0.0


def test_the_papers_controller_keeps_the_papers_weights() -> None:
    found = derived(nominal(), "paper")
    assert (found.law_settings["w1"], found.law_settings["w2"]) == (3.0, 2.0)
    assert found.law_settings["beta0"] == 0.0
    assert (found.rfc_cutoff_hz, found.force_lateness_s) == (0.0, 0.0)
    assert not any("rolled off" in note for note in found.notes)


def test_a_rig_file_with_a_resonance_and_no_roll_off_is_told_where_the_resonance_is() -> None:
    rig = nominal()
    assert rig.identified is not None
    found = derived(
        rig.model_copy(
            update={"identified": rig.identified.model_copy(update={"roll_off_hz": None})}
        ),
        "alpha-beta",
    )
    note = next(note for note in found.notes if "rolled off as before" in note)
    assert "a resonance at 66.88 Hz but no identified.roll_off_hz" in note
    assert "add roll_off_hz = 60.2 to [identified]" in note


@pytest.mark.parametrize("law", ["robust", "alpha-beta"])
def test_an_old_rig_file_keeps_what_was_and_is_told_so(law: str) -> None:
    found = derived(old(), law)
    settings = found.law_settings
    assert (settings["w1"], settings["w2"]) == (3.0, 2.0)
    assert settings["delay_estimator.cutoff_hz"] == 25.0
    assert settings["beta0"] == 0.0
    assert (found.rfc_cutoff_hz, found.force_lateness_s) == (0.0, 0.0)
    note = next(note for note in found.notes if "rolled off as before" in note)
    assert "no resonance up to 10 Hz" in note
    assert "--max-frequency" in note
    swept = derived(config.load_rig(config.shipped_rig("shaking-table-portal-frame")), law)
    note = next(note for note in swept.notes if "rolled off as before" in note)
    assert "no resonance up to 80 Hz" in note
    assert "no action is needed" in note


@pytest.mark.parametrize(
    ("law", "integrator", "late", "rate", "samples"),
    [
        ("alpha-beta", "rk4", 0, 1024, 0.5),
        ("alpha-beta", "rk4", 1, 4096, 1.5),
        ("inverse", "cr", 0, 1024, 0.0),
        ("ats", "cr", 1, 1024, 1.0),
        ("paper", "rk4", 1, 1024, 0.0),
        ("none", "rk4", 1, 1024, 0.0),
    ],
)
def test_the_force_is_as_late_as_integrator_and_delay_make_it(
    law: str, integrator: str, late: int, rate: int, samples: float
) -> None:
    found = framed(nominal(), law, integrator, late, rate)
    assert found.force_lateness_s == pytest.approx(samples / rate)
    assert framed(old(), "alpha-beta", integrator, late, rate).force_lateness_s == 0.0


def test_a_resolved_test_runs_the_same_on_an_old_rig_file() -> None:
    """All that came from the rig is written out: a recording's own test file says it."""
    test = config.parse_test(TEST.format(rate=1024, law="inverse", more=""))
    whole = config.derive(test, nominal())
    again = config.parse_test(config.dump(config.resolve(test, whole)))
    other = config.derive(again, old())
    assert other.law_settings == whole.law_settings
    assert other.rfc_cutoff_hz == whole.rfc_cutoff_hz
    assert (
        experiment.prepare(again, old()).controller
        == experiment.prepare(test, nominal()).controller
    )
