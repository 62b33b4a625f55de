"""Elements of damping, isolation and yielding: against closed forms and second formulations."""

from __future__ import annotations

import itertools
import math
import re
import typing

import numpy as np
import pytest
import scipy.integrate
import scipy.optimize
import scipy.special
from kernels import Floats, H, opensees, smooth_motion, time_s
from test_element import ONE_OF_EACH

from rthyb_rt import config, core
from rthyb_rt.config import fields
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment


def run(kind: str, x: Floats, **change: float) -> Floats:
    element = core.CoreElement(core.element(kind, **(ONE_OF_EACH[kind] | change)))
    return element.run(x, np.gradient(x, H) if x.size > 1 else 0.0)


def there_and_back(*turns: float, step: float = 1e-5) -> Floats:
    """A path from 0 through the turning points, in even steps."""
    legs = [np.zeros(1)]
    for a, b in zip((0.0, *turns), turns, strict=False):
        legs.append(np.linspace(a, b, max(round(abs(b - a) / step), 1) + 1)[1:])
    return np.concatenate(legs)


def work(f: Floats, x: Floats) -> float:
    return float(scipy.integrate.trapezoid(f, x))


# --- laws of the velocity ------------------------------------------------------------------------


@pytest.mark.parametrize("exponent", [0.15, 0.35, 1.0, 2.0])
def test_power_damping_dissipates_in_a_cycle_what_soong_and_constantinou_give(
    exponent: float,
) -> None:
    amplitude, omega, c = 0.03, 2 * np.pi * 1.5, 2500.0
    t = np.linspace(0.0, 2 * np.pi / omega, 20001)
    x, v = amplitude * np.sin(omega * t), amplitude * omega * np.cos(omega * t)
    damper = core.element(
        "power_damping", force_n=c, at_m_per_s=1.0, exponent=exponent, width_m_per_s=1e-6
    )
    shape = 2 ** (2 + exponent) * scipy.special.gamma(1 + exponent / 2) ** 2
    expected = c * omega**exponent * amplitude ** (1 + exponent)
    expected *= shape / scipy.special.gamma(2 + exponent)
    assert work(core.CoreElement(damper).run(x, v), x) == pytest.approx(expected, rel=1e-6)


def test_power_damping_is_a_dashpot_or_a_quadratic_damper_at_exponents_1_and_2() -> None:
    v = np.linspace(-0.5, 0.5, 101)
    for exponent, law in ((1.0, v), (2.0, v * np.abs(v))):
        damper = core.element(
            "power_damping", force_n=3e3, at_m_per_s=1.0, exponent=exponent, width_m_per_s=1e-7
        )
        np.testing.assert_allclose(core.CoreElement(damper).run(v, v), 3e3 * law, atol=1e-8)


def test_power_damping_is_straight_within_its_width_however_small_the_exponent() -> None:
    slope = [run_at(v) / v for v in (1e-9, 1e-7, 1e-6)]
    np.testing.assert_allclose(slope, slope[0], rtol=1e-3)


def run_at(v: float) -> float:
    damper = core.element("power_damping", **(ONE_OF_EACH["power_damping"] | {"exponent": 0.05}))
    return core.CoreElement(damper).force(0.0, v, 0.0, H)


# --- the sliding pendulum ------------------------------------------------------------------------


def test_friction_pendulum_is_its_differential_equation_by_scipy() -> None:
    p = ONE_OF_EACH["friction_pendulum"] | {"xy_m": 3e-3}
    w1, w2 = 2 * np.pi * 0.9, 2 * np.pi * 2.3

    def motion(t: float) -> tuple[float, float]:
        return (
            0.02 * math.sin(w1 * t) + 0.009 * math.sin(w2 * t),
            0.02 * w1 * math.cos(w1 * t) + 0.009 * w2 * math.cos(w2 * t),
        )

    def rate(t: float, y: Floats) -> list[float]:
        z, v = y[0], motion(t)[1]
        return [(v - 0.9 * abs(v) * z * abs(z) - 0.1 * v * z * z) / p["xy_m"]]

    t = time_s(3.0)
    x, v = np.array([motion(now) for now in t]).T
    z = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), [0.0], "DOP853", t_eval=t, rtol=1e-10, atol=1e-12, max_step=2e-3
    ).y[0]
    mu = 0.07 - 0.04 * np.exp(-30.0 * np.abs(v))
    found = core.CoreElement(core.element("friction_pendulum", **p)).run(x, v)
    turns = np.max(np.abs(found - (4e4 / 1.5 * x + mu * 4e4 * z)))
    assert turns < 5e-3 * np.max(np.abs(found))  # the rows that a reversal lies within


def test_contact_of_the_friction_pendulum_does_not_depend_on_the_number_of_steps() -> None:
    ends = np.array([0.0, 4e-4, 3e-4, -2e-4, -5e-3, -4.9e-3, 0.01])
    fine = there_and_back(*ends[1:], step=1e-7)
    at = np.searchsorted(np.cumsum(np.abs(np.diff(fine, prepend=0.0))),
                         np.cumsum(np.abs(np.diff(ends, prepend=0.0))) - 1e-12)  # fmt: skip
    slider = core.element("friction_pendulum", **ONE_OF_EACH["friction_pendulum"])
    many, few = core.CoreElement(slider).run(fine)[at], core.CoreElement(slider).run(ends)
    np.testing.assert_allclose(few, many, rtol=1e-9, atol=1e-7)


def test_friction_pendulum_slides_at_weight_over_radius_and_mu_times_weight() -> None:
    slider = core.CoreElement(core.element("friction_pendulum", **ONE_OF_EACH["friction_pendulum"]))
    assert slider.force(0.05, 10.0, 0.0, H) == pytest.approx(4e4 / 1.5 * 0.05 + 0.07 * 4e4)
    assert slider.force(0.04, -1e-9, 0.0, H) == pytest.approx(4e4 / 1.5 * 0.04 - 0.03 * 4e4)


# --- Iwan's chain and Masing's rule --------------------------------------------------------------


def test_iwan_chain_loads_along_its_backbone_and_turns_along_twice_of_it() -> None:
    out, back = there_and_back(9e-3), there_and_back(9e-3, -9e-3)
    backbone = run("iwan", out)
    whole = run("iwan", back)
    at = np.arange(12) / 12 * 2 + 1 / 12
    yields = 4e-3 * (1 + 0.8 * (at - 1))
    expected = 0.05e6 * out + 0.95e6 * np.mean(np.minimum(out[:, None], yields), axis=1)
    np.testing.assert_allclose(backbone, expected, rtol=1e-9)
    turned = whole[out.size - 1 :]
    way = np.linspace(0.0, 18e-3, turned.size)
    twice = 2 * np.interp(way / 2, out, backbone)  # Masing 1926
    np.testing.assert_allclose(turned, backbone[-1] - twice, atol=1e-4 * backbone[-1])


def test_iwan_chain_dissipates_four_times_yield_force_and_plastic_way_of_each_spring() -> None:
    loop = there_and_back(9e-3, -9e-3, 9e-3)[900:]
    found = run("iwan", there_and_back(9e-3, -9e-3, 9e-3))[900:]
    yields = 4e-3 * (1 + 0.8 * ((2 * np.arange(12) + 1) / 12 - 1))
    expected = 4 * 0.95e6 * np.mean(yields * np.maximum(9e-3 - yields, 0.0))
    assert work(found, loop) == pytest.approx(expected, rel=1e-4)


# --- Menegotto & Pinto ---------------------------------------------------------------------------


def menegotto_pinto_by_branches(x: Floats) -> Floats:
    """Stress and strain over yield, the branches as Filippou, Popov & Bertero 1983 print them."""
    b, r0, cr1, cr2 = 0.03, 20.0, 0.925, 0.15
    strain, out = x / 4e-3, np.zeros_like(x)
    last, stress, reversal, extremes = 0.0, 0.0, (0.0, 0.0), [-1.0, 1.0]
    way = 0
    for i, e in enumerate(strain):
        if e != last:
            now = 1 if e > last else -1
            if now != way:
                reversal, way = (last, stress), now
                extremes = [min(extremes[0], last), max(extremes[1], last)]
                # e0: (e0 - er) + sr = now (1 - b) + b e0
                e0 = (now * (1 - b) + reversal[0] - reversal[1]) / (1 - b)
                s0 = now * (1 - b) + b * e0
                xi = abs(extremes[(now + 1) // 2] - e0)
                r = r0 * (1 - cr1 * xi / (cr2 + xi))
            star = (e - reversal[0]) / (e0 - reversal[0])
            bent = b * star + (1 - b) * star / (1 + abs(star) ** r) ** (1 / r)
            stress = bent * (s0 - reversal[1]) + reversal[1]
            last = e
        out[i] = stress
    return out * 1e6 * 4e-3


def test_menegotto_pinto_is_the_published_branches() -> None:
    x = smooth_motion(4.0, 5, peak_m=0.03)
    expected = menegotto_pinto_by_branches(x)
    np.testing.assert_allclose(
        run("menegotto_pinto", x), expected, atol=1e-6 * np.max(np.abs(expected))
    )


def test_menegotto_pinto_stays_between_its_asymptotes_and_begins_elastic() -> None:
    x = there_and_back(0.02, 0.0199, 0.02, -0.03, -0.0299, -0.03, 0.001, 0.0, 0.05)
    f = run("menegotto_pinto", x)
    assert np.all(np.abs(f - 0.03e6 * x) <= 0.97e6 * 4e-3 * (1 + 1e-12))
    assert run("menegotto_pinto", np.array([1e-6]))[0] == pytest.approx(1.0, rel=1e-6)
    assert f[-1] == pytest.approx(0.97e6 * 4e-3 + 0.03e6 * 0.05, rel=0.02)


def test_menegotto_pinto_trembling_on_its_asymptote_stays_there() -> None:
    x = 0.02 + 1e-9 * np.resize([1.0, -1.0], 20000)
    f = run("menegotto_pinto", np.concatenate((there_and_back(0.02), x)))
    assert np.all(np.abs(f) <= 0.97e6 * 4e-3 + 0.03e6 * 0.021)


# --- isotropic and kinematic hardening -----------------------------------------------------------


def chaboche_by_increments(x: Floats, parts: int, **change: float) -> Floats:
    """Plastic flow by the consistency condition, explicitly in small increments."""
    k, fy, h, gamma, growth, rate = (ONE_OF_EACH["chaboche"] | change).values()
    f = q = path = 0.0
    out = np.zeros_like(x)
    for i in range(1, x.size):
        step = (x[i] - x[i - 1]) / parts
        for _ in range(parts):
            size = fy + growth * (1 - math.exp(-rate * path))
            way = math.copysign(1.0, f - q)
            flow = 0.0
            if abs(f - q) >= size and way * step > 0:
                modulus = h - gamma * q * way + rate * growth * math.exp(-rate * path)
                flow = k * step / (k + modulus)
            f += k * (step - flow)
            q += h * flow - gamma * q * abs(flow)
            path += abs(flow)
        out[i] = f
    return out


def test_chaboche_is_the_consistency_condition_by_small_increments() -> None:
    x = 0.012 * np.sin(2 * np.pi * np.linspace(0.0, 3.0, 301)) * np.linspace(0.3, 1.0, 301)
    x[0] = 0.0
    found = run("chaboche", x)
    assert np.max(np.abs(found - chaboche_by_increments(x, 300))) < 2e-3 * np.max(np.abs(found))


def test_chaboche_on_first_loading_is_its_closed_form() -> None:
    plastic = np.linspace(0.0, 0.2, 400)
    force = 3e3 + 3e5 / 150 * -np.expm1(-150 * plastic) + 1500 * -np.expm1(-12 * plastic)
    np.testing.assert_allclose(run("chaboche", force / 1e6 + plastic), force, rtol=1e-9)
    np.testing.assert_allclose(run("chaboche", np.array([force[-1] / 1e6 + 0.2])), force[-1:])


def test_chaboche_without_recovery_and_growth_is_bilinear_and_closes_its_loop() -> None:
    change = {"recovery_per_m": 0.0, "isotropic_n": 0.0}
    x = there_and_back(0.02, -0.02, 0.02)
    f = run("chaboche", x, **change)
    slope = 1e6 * 3e5 / 1.3e6
    assert f[2000] == pytest.approx(3e3 + slope * (0.02 - 3e-3))
    assert f[6000] == pytest.approx(-3e3 - slope * (0.02 - 3e-3))
    assert f[-1] == pytest.approx(f[2000])
    plastic = (f[2000] - 3e3) / 3e5
    assert work(f[2000:], x[2000:]) == pytest.approx(4 * 3e3 * 2 * plastic / 2, rel=1e-3)


def test_chaboche_grows_to_its_final_size_in_many_cycles() -> None:
    turns = np.resize([0.02, -0.02], 400)
    f = run("chaboche", there_and_back(*turns, step=1e-3), kinematic_n_per_m=0.0)
    assert np.max(np.abs(f)) == pytest.approx(4500.0, rel=1e-9)
    assert np.max(np.abs(f[:21])) < 3500.0


# --- the reinforced concrete column --------------------------------------------------------------

WHOLE = {
    "pivot": 1e12, "strength_lost_at_ultimate": 0.0, "strength_lost_with_energy": 0.0,
    "stiffness_lost_with_energy": 0.0, "slip": 0.0,
}  # fmt: skip


def test_rc_column_without_wear_is_bouc_wens_loop() -> None:
    x = smooth_motion(3.0, 6, peak_m=0.02)
    half = 0.5 / 5e-3**2
    loop = core.element(
        "hysteresis", k_n_per_m=1e6, post_yield_ratio=0.04, a=1.0, b=half, c=half, eta=2.0
    )
    expected = core.CoreElement(loop).run(x)
    np.testing.assert_allclose(
        run("rc_column", x, **WHOLE), expected, atol=1e-9 * np.max(np.abs(expected))
    )


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_rc_column_unloads_towards_the_pivot_from_its_largest_excursion(side: float) -> None:
    sharp = WHOLE | {"pivot": 4.0, "eta": 20.0}
    x = side * there_and_back(0.03, 0.0299)
    f = run("rc_column", x, **sharp)
    slope = (f[-1] - f[3000]) / (x[-1] - x[3000])
    # The line from (0.03, f) to the pivot at -4 times the yield point.
    pivot_x, pivot_f = -side * 4 * 5e-3, -side * 4 * 5e3
    assert slope == pytest.approx((f[3000] - pivot_f) / (x[3000] - pivot_x), rel=1e-6)


def test_rc_column_loses_strength_with_amplitude_up_to_its_ultimate_displacement() -> None:
    x = there_and_back(0.08)
    f = run("rc_column", x, **(WHOLE | {"strength_lost_at_ultimate": 0.3})) - 0.04e6 * x
    for at, share in ((0.02, 0.1), (0.035, 0.2), (0.05, 0.3), (0.07, 0.3)):
        assert f[round(at / 1e-5)] == pytest.approx(0.96 * 5e3 * (1 - share), rel=2e-3)
    again = run("rc_column", there_and_back(0.05, -0.05), **(WHOLE | {"slip": 0.0}))
    assert again[-1] == pytest.approx(-0.96 * 5e3 - 0.04e6 * 0.05, rel=2e-3)


def test_rc_column_loses_strength_and_stiffness_with_the_work_done_on_it() -> None:
    turns = np.resize([0.02, -0.02], 40)
    lost = {"strength_lost_with_energy": 0.4, "stiffness_lost_with_energy": 0.5}
    x = there_and_back(*turns, step=5e-5)
    f = run("rc_column", x, **(WHOLE | lost))
    yielding = f - 0.04e6 * x
    spent = np.maximum.accumulate(
        scipy.integrate.cumulative_trapezoid(yielding, x, initial=0.0)
    ) / 800.0  # fmt: skip
    tops = 400 + 1600 // 2 * np.arange(20) * 2
    np.testing.assert_allclose(
        yielding[tops], 0.96 * 5e3 * (1 - 0.4 * np.minimum(spent[tops], 1.0)), rtol=5e-3
    )
    assert yielding[tops[-1]] == pytest.approx(0.6 * 0.96 * 5e3, rel=1e-3)
    slope = np.diff(yielding)[tops] / np.diff(x)[tops]
    assert slope[0] > 0.85 * 0.96e6
    assert slope[-1] == pytest.approx(0.5 * 0.96e6, rel=2e-3)


def test_rc_column_slips_by_the_way_that_the_bell_encloses() -> None:
    """From -0.9 to 0.9 of the strength: what slip adds to the way is its bell's integral."""
    level, width, slip = 0.3, 0.2, 0.2
    ways = []
    for share in (0.0, slip):
        change = WHOLE | {"slip": share, "slip_level": level, "slip_width": width}
        x = there_and_back(0.03, -0.03, 0.03)
        z = (run("rc_column", x, **change) - 0.04e6 * x) / (0.96 * 5e3)
        last = slice(9000, None)
        ways.append(np.interp(0.9, z[last], x[last]) - np.interp(-0.9, z[last], x[last]))
    bell = scipy.special.erf((0.9 - level) / width / math.sqrt(2))
    bell -= scipy.special.erf((-0.9 - level) / width / math.sqrt(2))
    assert ways[1] - ways[0] == pytest.approx(bell * slip * 2 * 0.025, rel=5e-3)


def test_rc_column_is_elastic_before_it_yields_whatever_its_slip() -> None:
    f = run("rc_column", np.array([1e-5, 2e-5]))
    np.testing.assert_allclose(f, [10.0, 20.0], rtol=1e-4)


# --- aimed at the peak --------------------------------------------------------------------------


def peak_oriented_by_rows(x: Floats, k_up: float, k_down: float) -> Floats:
    """The rule, row by row: what was reached on this side, its force, and the share of it here."""
    largest = {True: 2e-4, False: 2e-4}
    force = np.zeros(x.size)
    for i, here in enumerate(x):
        down = bool(here < 0.0)
        largest[down] = max(largest[down], abs(here))
        whole = (k_down if down else k_up) * 0.02 * (largest[down] / 0.02) ** 0.6
        force[i] = np.sign(here) * whole * (abs(here) / largest[down]) ** 2.2
    return force


def test_peak_oriented_is_slack_within_what_was_reached_and_returns_to_it() -> None:
    x = there_and_back(0.01, -0.004, 0.01, 0.03, -0.03, 0.03)
    f = run("peak_oriented", x)
    np.testing.assert_allclose(f, peak_oriented_by_rows(x, 1e6, 8e5), rtol=1e-12)
    tops = np.flatnonzero(np.isclose(x, 0.01, atol=1e-9))
    assert f[tops[0]] == pytest.approx(1e6 * 0.02 * 0.5**0.6)
    assert f[tops[1]] == pytest.approx(f[tops[0]])  # it is aimed at
    assert f[tops[-1]] == pytest.approx(1e6 * 0.02 * 1.5**0.6 / 3**2.2)  # slack, beyond it


def test_peak_oriented_spring_returns_all_work_except_that_of_going_farther() -> None:
    x = there_and_back(0.02, -0.02, 0.02, 0.0)
    f = run("peak_oriented", x)
    assert work(f[8000:], x[8000:]) == pytest.approx(0.0, abs=1e-2)
    assert work(f[:4001], x[:4001]) > 1.0


def test_peak_oriented_reaches_one_side_without_the_other() -> None:
    only_up = run("peak_oriented", there_and_back(0.02, 0.0, -0.01))
    never_up = run("peak_oriented", there_and_back(-0.01))
    assert only_up[-1] == pytest.approx(never_up[-1], rel=1e-12)


# --- a damper on a spring ------------------------------------------------------------------------


def by_scipy(x: Floats, km: float, exponent: float) -> Floats:
    """The same differential equation, by an implicit method of high order."""
    t = np.arange(x.size) * H

    def rate(at: float, f: Floats) -> Floats:
        v = (np.interp(at + 1e-9, t, x) - np.interp(at - 1e-9, t, x)) / 2e-9
        return km * (v - 0.2 * np.sign(f) * np.abs(f / 900.0) ** (1 / exponent))

    found = scipy.integrate.solve_ivp(
        rate, (0.0, t[-1]), [0.0], "Radau", t, rtol=1e-8, atol=1e-5, max_step=H / 4
    )
    return np.asarray(found.y[0])


@pytest.mark.parametrize("km", [5e4, 1e6])
@pytest.mark.parametrize("exponent", [0.35, 1.0, 1.8])
def test_damper_on_a_spring_is_the_differential_equation_of_scipy(
    km: float, exponent: float
) -> None:
    t = np.arange(512) * H
    x = 0.01 * np.sin(2 * np.pi * 3.0 * t) * np.minimum(4 * t, 1.0)
    expected = by_scipy(x, km, exponent)
    found = run("nonlinear_maxwell", x, km_n_per_m=km, exponent=exponent)
    assert np.max(np.abs(found - expected)) < 3e-3 * np.max(np.abs(expected))


def test_damper_on_a_spring_of_exponent_1_is_maxwells() -> None:
    x = smooth_motion(3.0, 3, peak_m=0.01)
    ours = run("nonlinear_maxwell", x, exponent=1.0)
    maxwell = core.element("maxwell", km_n_per_m=4e5, tau_s=900.0 / 0.2 / 4e5)
    expected = core.CoreElement(maxwell).run(x, dt_s=H)
    assert np.std(ours - expected) < 2e-3 * np.std(expected)


def test_damper_on_a_stiff_spring_is_the_damper_alone_without_ringing() -> None:
    """Its time constant is far below the period of the samples."""
    x = smooth_motion(3.0, 3, peak_m=0.01)
    v = np.gradient(x, H)
    ours = run("nonlinear_maxwell", x, km_n_per_m=1e10)
    alone = 900.0 * np.sign(v) * np.abs(v / 0.2) ** 0.35
    fast = np.abs(v) > 0.1 * np.max(np.abs(v))
    assert np.max(np.abs(ours - alone)[fast]) < 0.03 * np.max(np.abs(alone))


@pytest.mark.parametrize("exponent", [0.05, 0.35, 1.0, 2.0])
def test_damper_on_a_stiff_spring_that_is_held_does_not_change_its_sign(exponent: float) -> None:
    x = np.minimum(np.arange(400), 100) * 2e-4
    f = run("nonlinear_maxwell", x, km_n_per_m=1e8, exponent=exponent)
    assert np.all(f >= -1e-9)
    assert np.all(np.diff(f[100:]) <= 1e-9)


def test_damper_on_a_spring_relaxes_to_nothing_when_it_is_held() -> None:
    x = np.minimum(np.arange(8192), 100) * 2e-4
    f = run("nonlinear_maxwell", x, exponent=0.5)
    held = f[100:]
    assert np.all(np.diff(held) <= 0.0)
    # f' = -km v0 (f/F)^2 from f0: 1/f grows linearly.
    expected = 1.0 / (1.0 / held[0] + 4e5 * 0.2 / 900.0**2 * H * np.arange(held.size))
    np.testing.assert_allclose(held, expected, rtol=2e-3)


# --- reloading towards the farthest point -------------------------------------------------------

SHARP = {
    "sharpness": 50.0, "pinching": 0.0, "energy_j": 1e15, "strength_down_over_up": 1.0,
    "corner_on_line": 1.0,
}  # fmt: skip


def first_loading(far: float, n: float = 8.0) -> float:
    r = far / 5e-3
    return 5e3 * (0.05 * r + 0.95 * r / (1 + r**n) ** (1 / n))


def at(x: Floats, f: Floats, where: float, leg: slice) -> float:
    order = np.argsort(x[leg])
    return float(np.interp(where, x[leg][order], f[leg][order]))


def test_takeda_loads_along_its_backbone_and_unloads_more_softly_the_farther_it_was() -> None:
    x = there_and_back(0.03, 0.02)
    f = run("takeda", x, energy_j=1e15)
    np.testing.assert_allclose(f[:3001], [first_loading(far) for far in x[:3001]], rtol=1e-9)
    slope = (f[3001] - f[3000]) / (x[3001] - x[3000])
    assert slope == pytest.approx(1e6 * (5.0 / 30.0) ** 0.4, rel=1e-6)
    down = run("takeda", -x, energy_j=1e15)
    np.testing.assert_allclose(down, -0.8 * f, rtol=1e-12)


def test_takeda_reloads_straight_towards_the_yield_point_and_then_the_farthest_one() -> None:
    x = there_and_back(0.03, -0.02, 0.03)
    f = run("takeda", x, **SHARP)
    unloading = 1e6 * (5.0 / 30.0) ** 0.4
    zero = 0.03 - f[3000] / unloading
    aim = -first_loading(5e-3, 50.0)
    first = slice(3000, 8001)
    for share in (0.25, 0.5, 1.0):
        there = zero + share * (-5e-3 - zero)
        assert at(x, f, there, first) == pytest.approx(share * aim, abs=5.0)
    back = slice(8000, None)
    zero = -0.02 - f[8000] / (1e6 * (5.0 / 20.0) ** 0.4)
    assert at(x, f, 0.5 * (zero + 0.03), back) == pytest.approx(0.5 * f[3000], abs=5.0)
    assert f[-1] == pytest.approx(f[3000])


def test_takeda_pinched_reloads_in_two_lines_and_still_arrives() -> None:
    x = there_and_back(0.03, -0.03, 0.03)
    for pinching in (0.0, 0.5, 1.0):
        f = run("takeda", x, **(SHARP | {"pinching": pinching, "pinching_level": 0.25}))
        unloading = 1e6 * (5.0 / 30.0) ** 0.4
        zero, top = -0.03 - f[9000] / unloading, f[3000]
        direct = zero + 0.25 * (0.03 - zero)
        late = min(0.03 - 0.75 * top / unloading, 0.03 - 1e-3 * (0.03 - zero))
        corner = direct + pinching * (late - direct)
        assert at(x, f, corner, slice(9000, None)) == pytest.approx(0.25 * top, abs=10.0)
        assert f[-1] == pytest.approx(top)


def test_takeda_loses_strength_with_the_work_done_on_it() -> None:
    x = there_and_back(*np.resize([0.02, -0.02], 20), step=5e-5)
    f = run("takeda", x, **(SHARP | {"energy_j": 1e3}))
    spent = np.maximum.accumulate(scipy.integrate.cumulative_trapezoid(f, x, initial=0.0))
    tops = 400 + 1600 * np.arange(10)
    expected = first_loading(0.02, 50.0) * np.exp(-spent[tops] / 1e3)
    np.testing.assert_allclose(f[tops], expected, rtol=5e-3)
    assert f[tops[-1]] < 0.5 * f[tops[0]]


@pytest.mark.parametrize("pinching", [0.0, 0.7])
def test_takeda_arrives_at_the_same_force_in_one_step_as_in_many(pinching: float) -> None:
    turns = (0.03, -0.02, 0.01, -0.035, 0.034, 0.0)
    change = SHARP | {"pinching": pinching}
    finely = run("takeda", there_and_back(*turns), **change)
    ends = np.cumsum([0, *(round(abs(b - a) / 1e-5) for a, b in itertools.pairwise((0, *turns)))])
    at_once = run("takeda", np.array([0.0, *turns]), **change)
    np.testing.assert_allclose(at_once, finely[ends], atol=1e-6)


@pytest.mark.parametrize(("pinching", "on_line"), [(0.0, 1.0), (1.0, 1.0), (0.0, 0.0), (0.3, 0.0)])
@pytest.mark.parametrize("ratio", [0.0, 0.5, 0.9])
@pytest.mark.parametrize("exponent", [0.0, 0.4, 1.0])
def test_takeda_takes_energy_in_every_closed_cycle(
    ratio: float, exponent: float, pinching: float, on_line: float
) -> None:
    """Also where the exponent alone would let it unload more softly than it was loaded."""
    change = {
        "post_yield_ratio": ratio, "unloading_exponent": exponent, "pinching": pinching,
        "energy_j": 1e15, "strength_down_over_up": 0.5, "corner_on_line": on_line,
    }  # fmt: skip
    for turns in ((0.05, 0.0), (0.05, -0.05, 0.05, 0.0), (-0.03, 0.05, 0.01, 0.05, 0.0)):
        x = there_and_back(*turns, step=2e-5)
        f = run("takeda", x, **change)
        assert work(f, x) > -1e-6 * work(np.abs(f), np.arange(x.size) * 2e-5)


def test_takeda_that_is_pinched_to_no_force_has_none_short_of_where_it_began() -> None:
    x = there_and_back(0.3, -0.3, step=1e-4)
    change = SHARP | {"post_yield_ratio": -0.1, "pinching_level": 0.0}
    assert np.max(np.abs(run("takeda", x, **change))) < 5.01e3


def test_takeda_that_softens_never_pushes() -> None:
    x = there_and_back(0.2, -0.2)
    f = run("takeda", x, **(SHARP | {"post_yield_ratio": -0.1}))
    assert f[5000] == pytest.approx(first_loading(0.05, 50.0) - 0.15 * 1e6 * 0.045, rel=1e-3)
    assert np.all(f[:20001] >= 0.0)
    assert f[20000] == 0.0


@pytest.mark.parametrize(("pinch_x", "pinch_y"), [(1.0, 1.0), (0.4, 0.3), (0.8, 0.2), (0.3, 0.7)])
@pytest.mark.parametrize("exponent", [0.0, 0.4])
def test_takeda_is_the_hysteretic_material_of_opensees(
    exponent: float, pinch_x: float, pinch_y: float
) -> None:
    ops = opensees()
    k, xy, a, x = 1e6, 5e-3, 0.05, smooth_motion(3.0, 4, peak_m=0.03)
    points = [v for far in (xy, 5 * xy, 20 * xy) for v in (k * (xy + a * (far - xy)), far)]
    ops.wipe()
    ops.model("basic", "-ndm", 1, "-ndf", 1)
    ops.uniaxialMaterial(
        "Hysteretic", 1, *points, *(-v for v in points), pinch_x, pinch_y, 0.0, 0.0, exponent
    )
    ops.testUniaxialMaterial(1)
    theirs = []
    for there in x:
        ops.setStrain(float(there))
        theirs.append(ops.getStress())
    change = SHARP | {"unloading_exponent": exponent, "sharpness": 1000.0}
    if pinch_x < 1.0:
        change |= {"pinching": pinch_x, "pinching_level": pinch_y, "corner_on_line": 0.0}
    ours = run("takeda", x, **change)
    # The corner of theirs is sharp.
    assert np.std(ours - theirs) < 2e-3 * np.std(theirs)


# --- all that yield ------------------------------------------------------------------------------

LOOPS = ("iwan", "menegotto_pinto", "chaboche", "rc_column", "takeda")


@pytest.mark.parametrize("kind", LOOPS)
def test_loop_does_not_depend_on_the_rate(kind: str) -> None:
    x = smooth_motion(2.0, 2, peak_m=0.03)
    make = core.element(kind, **ONE_OF_EACH[kind])
    slow = core.CoreElement(make).run(x, dt_s=0.5)
    np.testing.assert_array_equal(slow, core.CoreElement(make).run(x, 5.0, 100.0, dt_s=1e-4))
    dense = np.interp(np.arange(0.0, x.size - 1, 0.125), np.arange(x.size), x)
    finely = core.CoreElement(make).run(dense)[::8]
    assert np.max(np.abs(finely - slow[: finely.size])) < 5e-3 * np.max(np.abs(slow))


@pytest.mark.parametrize("kind", [*LOOPS, "friction_pendulum"])
def test_closed_cycle_dissipates(kind: str) -> None:
    x = there_and_back(0.02, -0.02, 0.02)
    assert work(run(kind, x)[2000:], x[2000:]) > 10.0


@pytest.mark.parametrize("kind", LOOPS)
def test_senseless_motion_is_passed_over_without_a_trace(kind: str) -> None:
    element = core.element(kind, **ONE_OF_EACH[kind])
    plain, hit = core.CoreElement(element), core.CoreElement(element)
    for x in 0.02 * np.sin(np.linspace(0.0, 12.0, 500)):
        expected = plain.force(x, 0.0, 0.0, H)
        assert hit.force(x, 0.0, 0.0, H) == expected
        for wild in (np.nan, np.inf, -np.inf, 1e300):
            assert hit.force(wild, wild, wild, wild) == expected


# --- rig files -----------------------------------------------------------------------------------

RIG = """schema = "rthyb-rig/1"
[rig]
name = "laws"
elastic_stiffness_n_per_m = {k}
[actuator]
kind = "pure-delay"
delay_samples = 2
[[specimen]]
element = "{kind}"
"""
NEW = {
    str(typing.get_args(model.model_fields["element"].annotation)[0]): model
    for model in config.rigfile.kinds()
    if model.__name__ in (
        "CoulombUnevenElement", "GapUnevenElement", "PowerDampingElement", "PowerSpringElement",
        "PendulumElement", "FrictionPendulumElement", "IwanElement", "MenegottoPintoElement",
        "ChabocheElement", "RcColumnElement", "PeakOrientedElement",
        "TakedaElement", "NonlinearMaxwellElement", "RockingElement",
    )
}  # fmt: skip


def rig_text(kind: str, k: float = 1e6, **change: float) -> str:
    values = ONE_OF_EACH[kind] | change
    return RIG.format(kind=kind, k=k) + "".join(f"{key} = {v}\n" for key, v in values.items())


@pytest.mark.parametrize("kind", NEW)
def test_rig_file_gives_the_core_its_element(kind: str) -> None:
    rig = config.parse_rig(rig_text(kind))
    element = experiment.specimen_elements(rig)[0]
    assert element == core.element(kind, **ONE_OF_EACH[kind])
    assert config.parse_rig(config.dump(rig)).specimen == rig.specimen


@pytest.mark.parametrize("kind", NEW)
def test_ends_of_the_ranges_of_a_rig_file_are_within_those_of_the_core(kind: str) -> None:
    for key, info in NEW[kind].model_fields.items():
        limits = [part for part in info.metadata if isinstance(part, fields.Range)]
        for value in [end for part in limits for end in (part.low, part.high)]:
            change = {key: value}
            if (kind, key) == ("rc_column", "xy_m"):
                change["ultimate_m"] = 50.0
            if (kind, key, value) == ("rc_column", "ultimate_m", 1e-5):
                change["xy_m"] = 1e-6
            if (kind, key) == ("peak_oriented", "reach_m"):
                change["start_m"] = 1e-7
            if (kind, key) == ("peak_oriented", "start_m"):
                change["reach_m"] = 50.0
            rig = config.parse_rig(rig_text(kind, **change))
            core.CoreElement(experiment.specimen_elements(rig)[0])
        for part in limits:
            for beyond in (part.low - 1.0, part.high * 2.0 + 1.0):
                with pytest.raises(InputError, match=rf"rig.toml:\d+: specimen.0.{key}: found"):
                    config.parse_rig(rig_text(kind, **{key: beyond}), "rig.toml")


def test_rc_column_that_ends_before_it_yields_is_refused_at_its_line() -> None:
    with pytest.raises(InputError, match=r"rig.toml:\d+: specimen.0.ultimate_m: found 0.004; must"):
        config.parse_rig(rig_text("rc_column", ultimate_m=0.004), "rig.toml")


def test_spring_aimed_at_the_peak_that_ends_within_its_first_excursion_is_refused() -> None:
    with pytest.raises(InputError, match=r"rig.toml:\d+: specimen.0.reach_m: found 0.0001; must"):
        config.parse_rig(rig_text("peak_oriented", reach_m=1e-4), "rig.toml")


def test_damper_stated_at_one_metre_per_second_is_stated_by_its_constant() -> None:
    text = RIG.format(kind="power_damping", k=1e6) + "force_n = '2 kN'\nexponent = 0.3\n"
    element = experiment.specimen_elements(config.parse_rig(text))[0]
    assert element.params == (2000.0, 1.0, 0.3, 5e-4)


TEST = """schema = "rthyb-test/1"
[test]
name = "laws"
[ground_motion]
record = "elcentro-1940-ns"
[numerical]
mass_kg = {mass}
damping_ratio = 0.02
[controller]
type = "none"
"""


def notes(rig: str, mass: float) -> str:
    test = config.parse_test(TEST.format(mass=mass))
    return " ".join(config.derive(test, config.parse_rig(rig)).notes)


@pytest.mark.parametrize("kind", LOOPS)
def test_elastic_stiffness_is_held_against_the_yielding_element(kind: str) -> None:
    assert "check rig.elastic_stiffness" in notes(rig_text(kind, k=2e6), 1e3)
    assert "check rig.elastic_stiffness" not in notes(rig_text(kind), 1e3)


def test_elastic_stiffness_of_a_spring_aimed_at_the_peak_is_that_of_its_first_excursion() -> None:
    first = 1e6 * (0.02 / 2e-4) ** 0.4  # of the stiffer direction
    assert "check rig.elastic_stiffness" in notes(rig_text("peak_oriented", k=1e6), 1e3)
    assert "check rig.elastic_stiffness" not in notes(rig_text("peak_oriented", k=first), 1e3)


def test_damping_and_friction_too_steep_for_the_reference_are_named_with_a_width() -> None:
    spring = '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 1e6\n'
    for kind, change in (
        ("power_damping", {"force_n": 1e5}),
        ("coulomb_uneven", {"fc_down_n": 5e4}),
    ):
        found = re.search(
            r"width of at least (\S+) m/s", notes(rig_text(kind, **change) + spring, 1e4)
        )
        assert found
        wide = rig_text(kind, **change, width_m_per_s=1.1 * float(found[1])) + spring
        assert "too steep" not in notes(wide, 1e4)


@pytest.mark.parametrize("kind", NEW)
def test_whole_test_runs_with_the_element_as_its_specimen(kind: str) -> None:
    spring = '[[specimen]]\nelement = "stiffness"\nk_n_per_m = 5e5\n'
    rig = config.parse_rig(rig_text(kind) + spring)
    test = config.parse_test(TEST.format(mass=2e4).replace("[num", "pga_g = 0.05\n[num"))
    reference = experiment.reference(experiment.prepare(test, rig))
    assert np.all(np.isfinite(reference["x_ref_m"]))
    assert np.max(np.abs(reference["x_ref_m"])) < 0.5
