"""Free decays beside a naive model, and second recordings that begin with a past."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import body
from rthyb_rt.diagnose import effects, engine
from rthyb_rt.diagnose.case import Case, Model
from rthyb_rt.diagnose.effects.base import Trial
from rthyb_rt.diagnose.predict import Augmented, nrmse, predict
from rthyb_rt.diagnose.problem import Member

FS_HZ, MASS, K, C = 200.0, 8.0, 2000.0, 2.0
CUBIC = core.element("cubic", k3_n_per_m3=-2e5)
DRY = core.element("coulomb", fc_n=0.25, width_m_per_s=1e-4)
DRAG = core.element("quad_damping", c2_n_s2_per_m2=12.0)


@pytest.mark.long
@pytest.mark.parametrize(
    ("missing", "names"),
    [
        pytest.param((), [], id="nothing"),
        pytest.param((DRY,), ["coulomb"], id="coulomb"),
        pytest.param((CUBIC, DRY), ["coulomb", "cubic"], id="coulomb+cubic"),
        pytest.param((CUBIC, DRAG), ["cubic", "quad_damping"], id="cubic+quad_damping"),
    ],
)
def test_spring_and_damping_of_a_free_decay_are_named_beside_a_naive_model(
    missing: tuple[core.ElementConfig, ...], names: list[str]
) -> None:
    n = int(16.0 * FS_HZ)
    own = [core.element("stiffness", k_n_per_m=K), core.element("viscous", c_n_s_per_m=C)]
    x = body(MASS, [*own, *missing], np.zeros(n), FS_HZ, (0.05, 0.0), substeps=40).x
    noise = 2e-5
    channels = {"x_meas": x + noise * np.random.default_rng(1).standard_normal(n),
                "f_in": np.zeros(n)}  # fmt: skip
    model = Model("forced", FS_HZ, 0.9 * K, 1.2 * C, MASS, x_std=noise)
    d = engine.diagnose(Case("swing", model, np.arange(n) / FS_HZ, channels, np.ones(n, bool)))

    assert sorted(d.effects) == names
    assert d.verdict == ("explained" if names else "none")


@pytest.mark.long
@pytest.mark.parametrize("seed", [1, 2])
def test_a_pendulum_whose_swing_hardly_changes_shows_how_far_it_softens(seed: int) -> None:
    """Eight swings, in which the amplitude falls by a tenth: a power law fits the balance as well.

    The pendulum is solved by SciPy, and its k3 is that of the series of k L sin(x / L).
    """
    k, m, c, length, fs_hz = 0.26, 0.004, 2.2e-4, 0.55, 200.0
    t, noise = np.arange(int(6.5 * fs_hz)) / fs_hz, 4.6e-5

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -(k * length * np.sin(y[0] / length) + c * y[1]) / m]

    x = solve_ivp(rate, (0.0, t[-1]), [0.42, -0.6], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    x += noise * np.random.default_rng(seed).standard_normal(t.size)
    model = Model("forced", fs_hz, k, 1.25 * c, m, x_std=noise)
    channels = {"x_meas": x, "f_in": np.zeros(t.size)}
    d = engine.diagnose(Case("swing", model, t, channels, np.ones(t.size, dtype=np.bool_)))

    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    k3 = d.candidates[0].params["k3_N_m3"]
    assert k3 == pytest.approx(-k / (6.0 * length**2), rel=0.1)


@pytest.mark.parametrize("fs_hz", [50.0, 100.0])
def test_a_pendulum_read_by_video_softens_and_does_nothing_else(fs_hz: float) -> None:
    """From 94 degrees, in steps of .3 degrees, with a tenth of a newton metre's accuracy at best.

    Noise near the frequency of the swing counts for next to nothing in the linear model's balance,
    but for much in a spring that is three times softer at the end of the swing.
    """
    t, step = np.arange(int(6.0 * fs_hz)) / fs_hz, np.deg2rad(0.3)

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -37.3 * np.sin(y[0]) - 0.034 * y[1]]

    x = solve_ivp(rate, (0.0, t[-1]), [1.64, 0.0], t_eval=t, rtol=1e-10, atol=1e-12).y[0]
    model = Model("forced", fs_hz, 37.3, 0.034, 1.0, x_std=step / np.sqrt(12.0))
    channels = {"x_meas": step * np.round(x / step), "f_in": np.zeros(t.size)}
    d = engine.diagnose(Case("swing", model, t, channels, np.ones(t.size, dtype=np.bool_)))

    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    assert d.candidates[0].params["k3_N_m3"] == pytest.approx(-37.3 / 6.0, rel=0.1)


def test_a_second_recording_may_have_another_rate() -> None:
    t = np.arange(4000) / 200.0
    spring = Member(effects.catalogue()["cubic"], Trial())
    model = Model("drive", 100.0, 1e4, 30.0)
    made = Augmented(model, model, (spring,), (np.array([1.0]),), None, (0.05, 0.3, 1e3))
    every = np.ones(t.size, dtype=np.bool_)

    def force(rows: slice) -> np.ndarray:
        own = replace(model, fs_hz=200.0 / (rows.step or 1))
        x = 0.03 * np.sin(2.0 * np.pi * t[rows])
        f = predict(made, Case("second", own, t[rows], {"x_meas": x}, every[rows])).f
        return f[20:-20]

    twice, once = force(slice(None)), force(slice(None, None, 2))
    assert once == pytest.approx(twice[20:-20:2], abs=2e-3 * np.max(np.abs(once)))


def test_a_second_recording_begins_where_its_first_rows_of_force_say() -> None:
    """A friction slider that was pushed before is off by all of its friction until it slips."""
    t = np.arange(2000) / 100.0
    x = 4e-4 * np.sin(2.0 * np.pi * 0.5 * t) * np.linspace(0.3, 1.0, t.size)
    model = Model("drive", 100.0, 1e6)
    slider = Member(effects.catalogue()["hysteresis"], Trial((1e-3,), "bw1"))
    made = Augmented(model, model, (slider,), (np.array([1.0]),), None, (5e-3, 0.1, 1e4))
    past = np.concatenate((np.linspace(0.0, 3e-3, 500), np.linspace(3e-3, 0.0, 500)))
    loop = core.element("hysteresis", k_n_per_m=1e6, post_yield_ratio=0.0, a=1.0, b=500.0,
                        c=500.0, eta=1.0)  # fmt: skip
    truth = 1e6 * x + core.CoreElement(loop).run(np.concatenate((past, x)))[past.size :]
    head = np.where(t < 2.0, truth, np.nan)
    every = np.ones(t.size, dtype=np.bool_)

    def error(f_meas: np.ndarray) -> float:
        case = Case("second", model, t, {"x_meas": x, "f_meas": f_meas}, every)
        return nrmse(predict(made, case).f, truth)

    assert error(head) < 0.05 < 0.5 < error(np.full(t.size, np.nan))


def test_a_recording_that_goes_on_begins_where_its_first_rows_say_if_the_body_does_not_return() -> (
    None
):
    """The error of a mass by a fiftieth, carried through the recording before, lasts."""
    fs_hz, mass, c = 200.0, 100.0, 40.0
    rng = np.random.default_rng(3)
    push = np.convolve(rng.standard_normal(3000), np.hanning(60), "same")
    truth = body(1.02 * mass, [core.element("viscous", c_n_s_per_m=c)], push, fs_hz).x
    t, cut = np.arange(3000) / fs_hz, 2000
    model = Model("forced", fs_hz, 0.0, c, mass)
    every = np.ones(3000, dtype=np.bool_)
    first = {"x_meas": truth[:cut], "f_in": push[:cut]}
    before = Case("first", model, t[:cut], first, every[:cut])
    made = Augmented(model, model, (), (), None, None)

    def error(rows: int, noise_m: float = 0.0) -> float:
        readings = truth[cut:] + noise_m * rng.standard_normal(1000)
        known = np.where(np.arange(1000) < rows, readings, np.nan)
        second = {"x_meas": known, "f_in": push[cut:]}
        case = Case("second", model, t[cut:], second, every[cut:])
        return nrmse(predict(made, case, before).x[200:400], truth[cut + 200 : cut + 400])

    assert error(200) < 0.25 * error(4)
    # So few readings do not show its velocity.
    assert error(8, 2e-5) == error(4)
