"""Polynomial extrapolation (Horiuchi et al. 1999): against numpy's polynomials and a pure delay."""

from __future__ import annotations

import numpy as np
import pytest
from kernels import H, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.errors import InputError

ORDERS = [1, 2, 3]


def horiuchi(order: float, samples: int = 12, fs_hz: float = 1024.0) -> core.Law:
    settings = {"horiuchi.order": float(order), "horiuchi.delay_s": samples / fs_hz}
    return core.Law(core.LawConfig("horiuchi", settings), period_s=1.0 / fs_hz)


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
@pytest.mark.parametrize("order", ORDERS)
def test_a_motion_of_that_degree_is_met_exactly_behind_a_pure_delay(
    order: int, fs_hz: float
) -> None:
    samples = round(0.012 * fs_hz)
    t = np.arange(round(fs_hz)) / fs_hz
    x = np.polyval([0.02, -0.03, 0.015, 0.001][3 - order :], t)
    led = horiuchi(order, samples, fs_hz).run(x)
    full = (order + 1) * samples
    np.testing.assert_allclose(led[full:-samples], x[full + samples :], atol=1e-13)


@pytest.mark.parametrize("order", ORDERS)
def test_the_command_is_numpys_polynomial_through_the_last_points(order: int) -> None:
    x, samples = smooth_motion(3.0, 4), 12
    led = horiuchi(order, samples).run(x)
    for n in range(100, x.size, 97):
        back = np.arange(order + 1)
        through = np.polyfit(-back, x[n - back * samples], order)
        assert led[n] == pytest.approx(np.polyval(through, 1.0), abs=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_what_is_left_of_a_sine_falls_with_the_order_of_the_polynomial(order: int) -> None:
    """(1 - z^-D)^(N+1): half the frequency leaves 1 / 2^(N+1)."""
    left = []
    t = np.arange(8192) * H
    for f in (1.0, 0.5):
        x = np.sin(2 * np.pi * f * t)
        led = horiuchi(order).run(x)
        left.append(np.abs(led[1024:-12] - x[1036:]).max())
        assert left[-1] == pytest.approx(
            abs(2 * np.sin(np.pi * f * 12 * H)) ** (order + 1), rel=1e-3
        )
    assert left[0] / left[1] == pytest.approx(2.0 ** (order + 1), rel=0.05)


def test_a_degree_that_is_no_whole_number_is_refused_in_file_and_core() -> None:
    text = """schema = "rthyb-test/1"
test = { name = "h" }
numerical = { period_s = 0.5, damping_ratio = 0.02 }
controller = { type = "horiuchi", horiuchi = { order = 2.5 } }
"""
    with pytest.raises(InputError, match="must be 1, 2 or 3"):
        config.parse_test(text)
    for order in (0.0, 2.5, 4.0):
        with pytest.raises(core.CoreError):
            horiuchi(order)
    with pytest.raises(core.CoreError):
        horiuchi(3, 600)
