"""Inverse compensation (Chen & Ricles 2009): against their own model of the actuator."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from kernels import H, smooth_motion

from rthyb_rt import core


def inverse(delay_s: float, fs_hz: float = 1024.0) -> core.Law:
    return core.Law(
        core.LawConfig("chen-ricles", {"chen_ricles.delay_s": delay_s}), period_s=1.0 / fs_hz
    )


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
def test_the_actuator_of_their_model_is_undone_exactly(fs_hz: float) -> None:
    """m[n+1] = m[n] + (c[n+1] - m[n]) / alpha, sample by sample."""
    alpha = 0.016 * fs_hz + 1.0
    x = smooth_motion(4.0, 3)
    m, worst = 0.0, 0.0
    for wanted, c in zip(x, inverse(0.016, fs_hz).run(x), strict=True):
        m += (c - m) / alpha
        worst = max(worst, abs(m - wanted))
    assert worst < 1e-15


def test_the_command_is_alpha_z_less_alpha_less_one_over_z() -> None:
    x, alpha = smooth_motion(3.0, 5), 18.0
    expected = scipy.signal.lfilter([alpha, -(alpha - 1.0)], [1.0], x)
    law = inverse((alpha - 1.0) * H)
    np.testing.assert_allclose(law.run(x), expected, atol=1e-15)
    assert law.report()["alpha"] == pytest.approx(alpha - 1.0)


def test_it_is_the_phase_lead_of_the_paper_with_weights_without_end() -> None:
    """Eqn 2.5 for W1 -> infinity; at W1 = 1000, W2 = 0, to a thousandth of the lead."""
    x = smooth_motion(4.0, 1)
    settings = {"w1": 1e3, "w2": 0.0, "alpha0": 16.0}
    paper = core.Law(core.LawConfig("paper", settings, adapts=False)).run(x)
    own = inverse(16.0 * H).run(x)
    assert np.abs(own - paper).max() < 2e-3 * np.abs(own - x).max()


def test_a_straight_motion_behind_a_pure_delay_arrives_on_time() -> None:
    t = np.arange(2048) * H
    led = inverse(16.0 * H).run(0.01 * t)
    np.testing.assert_allclose(led[1:], 0.01 * (t[1:] + 16.0 * H), rtol=1e-12)
