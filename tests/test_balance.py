"""Energy balance and response spectra, held against closed forms and scipy."""

from __future__ import annotations

import numpy as np
import pytest

import rthyb_rt as rt
from rthyb_rt.analysis import balance as of
from rthyb_rt.analysis import response_spectrum as spectrum
from rthyb_rt.analysis.summary import summarize

FS_HZ = 1024.0


def balance_of(rec: rt.Recording) -> of.EnergyBalance:
    found = of.of_recording(rec.raw, summarize(rec.raw).setup)
    assert found is not None
    return found


def test_balance_of_a_damped_free_vibration_is_that_of_the_closed_form() -> None:
    """1 kg on 100 N/m with 2 % of critical, let go at 10 mm; the specimen is the spring."""
    m, k, zeta = 1.0, 100.0, 0.02
    w = np.sqrt(k / m)
    c = 2 * zeta * w * m
    t = np.arange(0, 8, 1 / FS_HZ)
    wd = w * np.sqrt(1 - zeta**2)
    decay = np.exp(-zeta * w * t)
    x = 0.01 * decay * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))
    v = -0.01 * decay * w**2 / wd * np.sin(wd * t)
    zero = np.zeros_like(t)
    found = of.balance(
        t, x, x, k * x, zero, zero, mass_kg=m, damping_n_s_per_m=c, stiffness_n_per_m=0.0,
        k_e_n_per_m=k, fs_hz=FS_HZ,
    )  # fmt: skip
    begin = 0.5 * k * 0.01**2
    assert found.kinetic_j == pytest.approx(0.5 * m * v**2, abs=2e-3 * begin)
    assert found.strain_j == pytest.approx(0.5 * k * x**2 - begin, abs=1e-9 * begin)
    lost = begin - 0.5 * m * v**2 - 0.5 * k * x**2
    assert found.damping_j == pytest.approx(lost, abs=2e-3 * begin)
    assert np.abs(found.specimen_j).max() < 1e-4 * begin
    assert np.abs(found.rest_j).max() < 2e-3 * begin


def test_lag_behind_a_spring_feeds_what_the_closed_form_says() -> None:
    """A spring k, amplitude a, phase lag p gains k pi a^2 sin p a cycle."""
    t = np.arange(0, 5, 1 / FS_HZ)
    p, k, a = 0.1, 1e5, 5e-3
    x, late = a * np.sin(2 * np.pi * t), a * np.sin(2 * np.pi * t - p)
    zero = np.zeros_like(t)
    found = of.balance(
        t, x, late, k * late, zero, zero, mass_kg=1.0, damping_n_s_per_m=0.0,
        stiffness_n_per_m=0.0, k_e_n_per_m=k, fs_hz=FS_HZ, compensated=False,
    )  # fmt: skip
    cycle = round(FS_HZ)
    gained = found.fed_j[4 * cycle] - found.fed_j[3 * cycle]
    assert gained == pytest.approx(k * np.pi * a**2 * np.sin(p), rel=1e-3)
    assert found.specimen_j[4 * cycle] == pytest.approx(found.specimen_j[3 * cycle], abs=1e-6)


CASES = {
    "as it comes": {},
    "without force compensation": {"controller.rfc.enabled": False},
    "Newmark's kin": {"numerical.integrator": "kr-alpha"},
    "computed stiffness": {"numerical.stiffness_n_per_m": 200_000, "numerical.period_s": None,
                           "numerical.mass_kg": 4220},
    "twice the rate": {"test.sample_rate_hz": 2048},
}  # fmt: skip


@pytest.mark.parametrize("change", CASES.values(), ids=CASES)
def test_balance_of_a_test_closes_within_numerics(change: dict[str, object]) -> None:
    test = rt.Test("section5-T0.5", ground_motion={"duration_s": 8}).with_(change)
    found = balance_of(rt.run(test))
    assert found.input_j.max() > 1.0
    # Nothing is left but the differences that stand for velocities: (w h)^2 / 6 is 3e-5.
    assert found.gap < 1e-4


def test_yielding_specimen_takes_the_energy_of_its_loops() -> None:
    test = rt.Test("section4.2").with_(
        {"numerical.integrator": "central-difference", "ground_motion.duration_s": 12}
    )
    found = balance_of(rt.run(test))
    assert found.specimen_j[-1] > 0.5 * found.input_j[-1]
    assert found.gap < 2e-3


def test_recording_of_many_storeys_or_without_a_mass_has_no_balance() -> None:
    rec = rt.run(rt.Test("section5-T0.5", ground_motion={"duration_s": 1}))
    given = summarize(rec.raw).setup
    rec.raw.test_toml = "this is no toml ="
    assert of.of_recording(rec.raw, summarize(rec.raw).setup) is None
    rec.raw.test_toml = "[numerical]\nmass_kg = 1\n[numerical.storeys]\n"
    assert of.of_recording(rec.raw, given) is None


# ---- response spectra ---------------------------------------------------------------------------


def test_spectrum_is_that_of_scipy_oscillator_by_oscillator() -> None:
    signal = pytest.importorskip("scipy.signal")
    b, a = signal.butter(4, 12.0, fs=FS_HZ)
    t = np.arange(15 * 1024) / FS_HZ
    ag = signal.lfilter(b, a, np.random.default_rng(5).standard_normal(t.size))
    ag *= np.exp(-(((t - 6.0) / 3.0) ** 2))
    periods = np.array([0.05, 0.1, 0.3, 0.5, 1.0, 2.0, 3.0])
    found = spectrum.pseudo_acceleration(FS_HZ, acceleration_mps2=ag, periods_s=periods)
    for period, value in zip(periods, found, strict=True):
        w = 2 * np.pi / period
        _, u, _ = signal.lsim(([-1.0], [1.0, 2 * 0.05 * w, w**2]), ag, t)
        assert value == pytest.approx(w**2 * np.abs(u).max(), rel=0.02)


def test_harmonic_base_is_amplified_by_the_dynamic_factor() -> None:
    t = np.arange(60 * 1024) / FS_HZ
    periods = np.array([0.25, 0.5, 1.0])
    found = spectrum.pseudo_acceleration(
        FS_HZ, acceleration_mps2=np.sin(2 * np.pi * t / 0.5), periods_s=periods, damping=0.1
    )
    # In resonance 1 / (2 zeta); with r = 0.5 and 2 at least the steady part of Chopra, Eqn 3.2.11.
    assert found[1] == pytest.approx(1 / 0.2, rel=0.01)
    for value, r in ((found[0], 0.5), (found[2], 2.0)):
        steady = 1 / np.hypot(1 - r**2, 0.2 * r)
        assert steady * 0.98 < value < 2.2 * max(steady, 1.0)


def test_displacement_gives_the_spectrum_of_its_acceleration() -> None:
    t = np.arange(20 * 1024) / FS_HZ
    shape = np.exp(-(((t - 8.0) / 2.0) ** 2))
    x = 0.01 * np.sin(2 * np.pi * 1.5 * t) * shape
    a = np.gradient(np.gradient(x)) * FS_HZ**2
    one = spectrum.pseudo_acceleration(FS_HZ, displacement_m=x)
    other = spectrum.pseudo_acceleration(FS_HZ, acceleration_mps2=a)
    assert one == pytest.approx(other, rel=2e-3)
    both = spectrum.pseudo_acceleration(FS_HZ, displacement_m=x, acceleration_mps2=-a)
    assert both.max() < 2e-3 * one.max()


def test_rate_changes_nothing_and_a_gap_is_bridged() -> None:
    def motion(fs_hz: float) -> np.ndarray:
        t = np.arange(round(20 * fs_hz)) / fs_hz
        return np.sin(2 * np.pi * 3 * t) * np.exp(-(((t - 8.0) / 2.0) ** 2))

    one, other = (
        spectrum.pseudo_acceleration(fs_hz, acceleration_mps2=motion(fs_hz))
        for fs_hz in (512.0, 4096.0)
    )
    assert one == pytest.approx(other, rel=0.02)
    gap = motion(FS_HZ)
    gap[7000:7003] = np.nan
    assert spectrum.pseudo_acceleration(FS_HZ, acceleration_mps2=gap) == pytest.approx(
        spectrum.pseudo_acceleration(FS_HZ, acceleration_mps2=motion(FS_HZ)), rel=1e-3
    )
    assert spectrum.pseudo_acceleration(FS_HZ, displacement_m=np.full(9, np.nan)).max() == 0.0
