"""The compiled simulators of the diagnosis against closed forms and a second formulation."""

from __future__ import annotations

import diagnose_cases as cases
import numpy as np
import pytest

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import (
    ActuatorModel,
    SimulationError,
    actuator,
    body,
    iwan,
    play,
)
from rthyb_rt.diagnose.case import BoucWen
from rthyb_rt.diagnose.effects.sensor import shifted
from rthyb_rt.diagnose.estimate import white_noise

LAG = ActuatorModel(cases.DELAY, cases.F_HZ, cases.ZETA)


@pytest.fixture(autouse=True)
def at_the_rate_of_a_station(monkeypatch):
    """What is held against closed forms here costs nothing, and is finer."""
    monkeypatch.setattr(cases, "FS", core.FS_HZ)


def test_the_actuator_agrees_with_a_finer_simulation():
    u = cases.command()
    x, v, a = cases.moved(u)
    motion = actuator(LAG, u, cases.FS)
    assert np.max(np.abs(motion.x - x)) < 2e-8
    assert np.max(np.abs(motion.v - v)) < 3e-6
    assert np.max(np.abs(motion.a - a)) < 2e-3


def test_a_held_command_steps_like_the_closed_form():
    u = np.r_[np.zeros(5), np.ones(300)] * 1e-3
    lag = ActuatorModel(0.0, 20.0, 1.0, hold="zoh")
    motion = actuator(lag, u, cases.FS)
    t = np.maximum(np.arange(u.size) - 5, 0) / cases.FS
    w = 2 * np.pi * 20.0
    assert motion.x == pytest.approx(1e-3 * (1 - np.exp(-w * t) * (1 + w * t)), abs=1e-12)


@pytest.mark.parametrize("zeta", [0.2, 1.0, 12.0])
def test_delay_that_grows_by_nothing_and_a_limit_never_met_change_nothing(zeta):
    u = cases.command()
    plain = actuator(ActuatorModel(0.004, 25.0, zeta), u, cases.FS)
    other = actuator(ActuatorModel(0.004, 25.0, zeta, kappa_s2_m=1e-12, vmax_m_s=1e3), u, cases.FS)
    assert np.max(np.abs(plain.x - other.x)) < 1e-7


@pytest.mark.parametrize("where", ["command", "actuator"])
def test_a_velocity_limit_is_kept(where):
    u = cases.command()
    motion = actuator(ActuatorModel(0.0, 40.0, 1.0, vmax_m_s=0.05, vmax_of=where), u, cases.FS)
    assert np.max(np.abs(motion.v)) < 0.0505


def test_an_actuator_at_its_own_velocity_limit_accelerates_no_more():
    u = cases.command()
    model = ActuatorModel(0.0, 40.0, 1.0, vmax_m_s=0.05, vmax_of="actuator")
    motion = actuator(model, u, cases.FS)
    rate = np.gradient(motion.v) * cases.FS
    # Two rows from any corner: there the difference of the velocities straddles it.
    limited = np.abs(motion.v) > 0.05 - 1e-9
    corner = np.convolve(np.abs(np.diff(limited, prepend=False)), np.ones(5), mode="same") > 0
    assert limited.sum() > 500
    assert np.max(np.abs((motion.a - rate)[limited & ~corner])) < 1e-6
    assert np.max(np.abs((motion.a - rate)[~corner])) < 0.02 * np.max(np.abs(rate))


def test_a_body_on_a_spring_swings_as_it_must():
    mass, k = 50.0, 5e4
    w = np.sqrt(k / mass)
    n = 2048
    motion = body(
        mass, [core.element("stiffness", k_n_per_m=k)], np.zeros(n), cases.FS, (1e-3, 0.0),
        substeps=16,
    )  # fmt: skip
    t = np.arange(n) / cases.FS
    assert motion.x == pytest.approx(1e-3 * np.cos(w * t), abs=2e-6)


def test_a_constant_force_ends_at_rest_on_the_spring():
    elements = [core.element("stiffness", k_n_per_m=1e5), core.element("viscous", c_n_s_per_m=4e3)]
    motion = body(100.0, elements, np.full(4096, 500.0), cases.FS)
    assert motion.x[-1] == pytest.approx(5e-3, rel=1e-3)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_force_that_is_no_number_does_not_pass_as_a_motion(bad):
    force = np.zeros(100)
    force[50] = bad
    with pytest.raises(SimulationError):
        body(1.0, [core.element("stiffness", k_n_per_m=1.0)], force, cases.FS)


def test_what_cannot_be_simulated_is_refused():
    with pytest.raises(SimulationError):
        actuator(ActuatorModel(0.0, -1.0, 1.0), np.zeros(10), cases.FS)
    with pytest.raises(SimulationError):
        actuator(LAG, np.r_[np.zeros(10), np.nan, np.zeros(90)], cases.FS)
    with pytest.raises(SimulationError):
        body(0.0, [], np.zeros(10), cases.FS)
    with pytest.raises(SimulationError):
        iwan(np.ones(33), np.ones(33), np.zeros(4))


def test_a_play_follows_after_its_gap_and_a_slider_slips_at_its_limit():
    x = np.array([0.0, 1.0, 2.0, 1.5, 0.0, -3.0])
    assert play(1.0, x) == pytest.approx([0.0, 0.0, 1.0, 1.0, 1.0, -2.0])
    assert iwan(np.array([1.0]), np.array([1.0]), x) == pytest.approx(x - play(1.0, x))


def test_bouc_wen_is_that_of_the_interchange_format():
    loop = BoucWen(0.2, 3e-3, 2.0, 0.55, 0.45)
    x = 8e-3 * np.sin(np.linspace(0.0, 20.0, 60000))
    force = core.Element(loop.element(4e5)).run(x)
    z, expected = 0.0, np.zeros(x.size)
    for i in range(1, x.size):
        dx = x[i] - x[i - 1]
        z += dx * (1.0 - abs(z / loop.xy) ** loop.n * (0.55 + 0.45 * np.sign(dx * z)))
        expected[i] = 4e5 * (0.2 * x[i] + 0.8 * z)
    assert np.max(np.abs(force - expected)) < 2e-3 * np.max(np.abs(expected))


def test_a_signal_is_shifted_by_parts_of_a_row():
    t = np.arange(400) / 100.0
    late = shifted(np.sin(2 * np.pi * t), 2.3)
    assert late[10:-10] == pytest.approx(np.sin(2 * np.pi * (t - 0.023))[10:-10], abs=1e-5)


def test_noise_is_read_off_under_a_motion():
    noisy = cases.command() * 1e5 + 3.0 * np.random.default_rng(0).standard_normal(8192)
    assert white_noise(noisy) == pytest.approx(3.0, rel=0.05)
