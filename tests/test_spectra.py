"""Transfer function, coherence and spectra: as scipy has them, and as closed forms have them."""

from __future__ import annotations

import numpy as np
import pytest

from rthyb_rt.analysis import spectra

FS_HZ = 1024.0


def noise(n: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal(n)


@pytest.mark.parametrize("size", [256, 1024, 4096])
def test_every_average_is_that_of_scipy(size: int) -> None:
    signal = pytest.importorskip("scipy.signal")
    x = noise(20000) + 3.0
    y = signal.lfilter([0.2, 0.1], [1, -0.8], x) + 0.3 * noise(20000, 2) - 5.0
    found = spectra.frequency_response(x, y, FS_HZ, size)
    assert found is not None
    f, s_xx = signal.welch(x, FS_HZ, "hann", size)
    _, s_yy = signal.welch(y, FS_HZ, "hann", size)
    _, s_xy = signal.csd(x, y, FS_HZ, "hann", size)
    _, coherence = signal.coherence(x, y, FS_HZ, "hann", size)
    assert found.frequency_hz == pytest.approx(f[1:])
    assert found.input_psd == pytest.approx(s_xx[1:], rel=1e-10)
    assert found.output_psd == pytest.approx(s_yy[1:], rel=1e-10)
    assert found.coherence == pytest.approx(coherence[1:], rel=1e-9)
    assert np.allclose(found.response, s_xy[1:] / s_xx[1:], rtol=1e-9)


def test_gain_and_delay_of_a_lag_behind_a_delay_are_those_of_the_closed_form() -> None:
    """A lag of first order at 8 Hz behind ten samples, driven by band-limited noise."""
    signal = pytest.importorskip("scipy.signal")
    b, a = signal.butter(4, 20.0, fs=FS_HZ)
    x = signal.lfilter(b, a, noise(200 * 1024))
    pole = np.exp(-2 * np.pi * 8.0 / FS_HZ)
    y = np.concatenate([np.zeros(10), signal.lfilter([1 - pole], [1, -pole], x)[:-10]])
    found = spectra.frequency_response(x, y, FS_HZ)
    assert found is not None
    at = (found.frequency_hz > 1.0) & (found.frequency_hz < 15.0)
    z = np.exp(2j * np.pi * found.frequency_hz / FS_HZ)
    wanted = (1 - pole) / (1 - pole / z) * z**-10.0
    assert found.known[at].all()
    assert found.gain[at] == pytest.approx(np.abs(wanted[at]), rel=0.02)
    exact = -np.unwrap(np.angle(wanted)) / (2 * np.pi * found.frequency_hz)
    assert found.delay_s[at] == pytest.approx(exact[at], abs=0.4e-3)


def test_noise_of_the_sensor_costs_the_coherence_that_the_powers_say() -> None:
    x = noise(400_000)
    found = spectra.frequency_response(x, x + 0.5 * noise(400_000, 3), FS_HZ, 1024)
    assert found is not None
    assert found.coherence.mean() == pytest.approx(1 / (1 + 0.25), abs=0.01)


def test_power_is_that_of_the_signal() -> None:
    x = noise(100_000)
    found = spectra.frequency_response(x, x, FS_HZ, 1024)
    assert found is not None
    assert found.input_psd.sum() * FS_HZ / 1024 == pytest.approx(x.var(), rel=0.01)


def test_segments_leave_eight_and_are_no_longer_than_four_seconds() -> None:
    for seconds in (3.0, 10.0, 40.0, 1000.0):
        rows = round(seconds * FS_HZ)
        size = spectra.segment_rows(rows, FS_HZ)
        assert size <= 4 * FS_HZ
        assert (2 * rows // size) - 1 >= 8
        assert size & (size - 1) == 0


@pytest.mark.parametrize(
    "given",
    [np.zeros(5000), np.full(5000, np.nan), np.full(5000, np.inf), np.ones(4)],
    ids=["rest", "nan", "inf", "short"],
)
def test_what_says_nothing_has_no_response(given: np.ndarray) -> None:
    assert spectra.frequency_response(given, np.ones(given.size), FS_HZ) is None


def test_gap_is_bridged_in_both_and_huge_values_overflow_nothing() -> None:
    t = np.arange(20 * 1024) / FS_HZ
    x = sum(np.sin(2 * np.pi * f * t) for f in (1.0, 2.0, 5.0))
    y = np.roll(x, 8)
    y[4000:4005] = np.nan
    found = spectra.frequency_response(1e300 * x, 1e300 * y, FS_HZ)
    assert found is not None
    line = np.argmin(np.abs(found.frequency_hz - 2.0))
    assert found.delay_s[line] == pytest.approx(8 / FS_HZ, abs=2e-4)
    assert found.gain[line] == pytest.approx(1.0, abs=5e-3)
