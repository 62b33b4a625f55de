"""First-order lead (Zhao et al. 2003): against scipy's filter and the lag that it inverts."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from kernels import Floats, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.errors import InputError

RATES = [256.0, 1024.0, 4096.0]


def zhao(tau_s: float, filter_s: float, fs_hz: float = 1024.0) -> core.Law:
    settings = {"zhao.tau_s": tau_s, "zhao.filter_s": filter_s}
    return core.Law(core.LawConfig("zhao", settings), period_s=1.0 / fs_hz)


def lag(x: Floats, tau_s: float, fs_hz: float) -> Floats:
    """1 / (tau s + 1) by backward Euler, in scipy's words."""
    tau = tau_s * fs_hz
    return np.asarray(scipy.signal.lfilter([1.0], [1.0 + tau, -tau], x))


@pytest.mark.parametrize("fs_hz", RATES)
def test_a_lag_is_inverted_exactly_and_the_roll_off_alone_is_left(fs_hz: float) -> None:
    x = smooth_motion(4.0, 3)
    reached = lag(zhao(0.03, 0.0, fs_hz).run(x), 0.03, fs_hz)
    np.testing.assert_allclose(reached, x, atol=1e-15)
    reached = lag(zhao(0.03, 0.004, fs_hz).run(x), 0.03, fs_hz)
    np.testing.assert_allclose(reached, lag(x, 0.004, fs_hz), atol=1e-15)


@pytest.mark.parametrize("fs_hz", RATES)
def test_the_lead_is_scipys_filter_of_the_same_transfer_function(fs_hz: float) -> None:
    x = smooth_motion(4.0, 8)
    tau, fade = 0.021 * fs_hz, 0.002 * fs_hz
    expected = scipy.signal.lfilter([1.0 + tau, -tau], [1.0 + fade, -fade], x)
    np.testing.assert_allclose(zhao(0.021, 0.002, fs_hz).run(x), expected, atol=1e-14)


def test_a_pure_delay_is_undone_to_first_order() -> None:
    """On a straight motion nothing is left; of a sine, half the frequency leaves a quarter."""
    delay_s, left = 16 / 1024, []
    t = np.arange(4096) / 1024.0
    straight = zhao(delay_s, 0.0).run(0.01 * t)
    assert straight[-1] == pytest.approx(0.01 * (t[-1] + delay_s), rel=1e-12)
    for f in (1.0, 0.5):
        led = zhao(delay_s, 0.0).run(np.sin(2 * np.pi * f * t))
        left.append(np.abs(led[2000:-16] - np.sin(2 * np.pi * f * t)[2016:]).max())
    assert left[0] / left[1] == pytest.approx(4.0, rel=0.05)


def test_the_delay_is_the_rigs_and_a_roll_off_above_it_is_refused() -> None:
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    text = 'schema = "rthyb-test/1"\ntest = { name = "z" }\n'
    text += (
        'numerical = { period_s = 0.5, damping_ratio = 0.02 }\ncontroller = { type = "zhao"%s }\n'
    )
    assert rig.identified is not None
    settings = config.derive(config.parse_test(text % ""), rig).law_settings
    assert settings == {"zhao.tau_s": rig.identified.delay_s, "zhao.filter_s": 0.001}
    with pytest.raises(InputError, match="or nothing is led"):
        config.derive(config.parse_test(text % ", zhao = { filter_s = 0.1 }"), rig)
