"""Measures against closed forms, a second formulation, or scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy import integrate, signal

from rthyb_rt.analysis import measures

FS = 1024.0
K = 666400.0
Floats = NDArray[np.float64]


def sine(
    seconds: float, hz: float, amplitude: float = 1.0, delay_s: float = 0.0
) -> NDArray[np.float64]:
    t = np.arange(round(seconds * FS) + 1) / FS
    return amplitude * np.sin(2.0 * np.pi * hz * (t - delay_s))


# --- errors -----------------------------------------------------------------------------------


def test_rms_of_whole_periods_of_a_sine_is_amplitude_over_root_two() -> None:
    assert measures.rms(sine(4.0, 2.0, 3.0)[:-1]) == pytest.approx(3.0 / np.sqrt(2.0), rel=1e-12)


def test_rms_keeps_the_mean() -> None:
    assert measures.rms(np.full(7, -2.0)) == pytest.approx(2.0)


def test_rms_of_a_diverged_test_does_not_overflow() -> None:
    assert measures.rms([3e200, -4e200]) == pytest.approx(np.sqrt(12.5) * 1e200)


def test_tracking_nrmse_of_a_late_sine_is_two_sin_half_phase() -> None:
    hz, delay = 2.0, 0.017
    x_num, x_meas = sine(8.0, hz)[:-1], sine(8.0, hz, delay_s=delay)[:-1]
    expected = 2.0 * np.sin(np.pi * hz * delay)
    assert measures.tracking_nrmse(x_num, x_meas) == pytest.approx(expected, rel=1e-12)


def test_response_nrmse_counts_an_offset_although_the_shape_agrees() -> None:
    x_ref = sine(8.0, 2.0)[:-1]
    assert measures.response_nrmse(x_ref, x_ref + 0.1) == pytest.approx(0.1 * np.sqrt(2.0))


def test_peak_measures_of_a_known_spike() -> None:
    wanted = np.array([0.0, -4.0, 1.0])
    got = np.array([0.0, -4.0, 2.0])
    assert measures.peak_difference(wanted, got) == 1.0
    assert measures.peak_error(wanted, got) == 0.25


def test_rows_that_are_not_finite_are_left_out_of_both_signals() -> None:
    x_num, x_meas = sine(4.0, 2.0), sine(4.0, 2.0, 0.9)
    dirty_num, dirty_meas = x_num.copy(), x_meas.copy()
    dirty_num[100], dirty_meas[200] = np.inf, np.nan
    keep = np.delete(np.arange(x_num.size), [100, 200])
    assert measures.tracking_nrmse(dirty_num, dirty_meas) == pytest.approx(
        measures.tracking_nrmse(x_num[keep], x_meas[keep]), rel=1e-13
    )
    assert measures.peak_difference(dirty_num, dirty_meas) == pytest.approx(0.1, rel=1e-3)


def test_no_motion_gives_nan_and_no_warning() -> None:
    zero = np.zeros(10)
    assert np.isnan(measures.tracking_nrmse(zero, zero))
    assert np.isnan(measures.peak_error(zero, zero))
    assert measures.peak_difference(zero, zero) == 0.0


def test_no_rows_give_nan() -> None:
    none = np.zeros(0)
    assert np.isnan(measures.tracking_nrmse(none, none))
    assert np.isnan(measures.peak_difference(none, none))


def test_signals_of_different_length_are_refused_with_their_shapes() -> None:
    with pytest.raises(ValueError, match=r"\(3,\), \(4,\)"):
        measures.tracking_nrmse(np.zeros(3), np.zeros(4))


def test_accumulated_error_is_the_sum_of_eqn_4_3() -> None:
    x_ref = np.array([0.0, 1.0, -1.0, 2.0])
    x_meas = np.array([0.5, 1.0, np.nan, 1.0])
    np.testing.assert_allclose(measures.accumulated_error(x_ref, x_meas), [0.5, 0.5, 0.5, 1.5])


# --- frequency evaluation index ---------------------------------------------------------------


@pytest.mark.parametrize("delay_samples", [-3.0, 0.0, 1.3, 17.0])
@pytest.mark.parametrize("gain", [0.9, 1.02])
def test_fei_finds_delay_and_amplitude_of_a_sine(delay_samples: float, gain: float) -> None:
    x_num = sine(10.0, 2.0)[:-1]
    x_meas = sine(10.0, 2.0, gain, delay_samples / FS)[:-1]
    index = measures.fei(x_num, x_meas, FS)
    assert index.delay_s * FS == pytest.approx(delay_samples, abs=1e-9)
    assert index.amplitude == pytest.approx(gain, rel=1e-12)
    assert index.f_eq_hz == pytest.approx(2.0, rel=1e-12)


def test_fei_of_two_sines_weighs_their_gains_by_energy() -> None:
    # 1 mm at 1 Hz with gain 1 and 0.5 mm at 4 Hz with gain 0.8: weights 0.8 and 0.2.
    x_num = sine(10.0, 1.0)[:-1] + sine(10.0, 4.0, 0.5)[:-1]
    x_meas = sine(10.0, 1.0)[:-1] + sine(10.0, 4.0, 0.4)[:-1]
    index = measures.fei(x_num, x_meas, FS)
    assert index.amplitude == pytest.approx(0.8 * 1.0 + 0.2 * 0.8, rel=1e-12)
    assert index.f_eq_hz == pytest.approx(0.8 * 1.0 + 0.2 * 4.0, rel=1e-12)


def test_fei_of_a_broad_motion_agrees_with_the_peak_of_the_cross_correlation() -> None:
    rng = np.random.default_rng(3)
    sos = signal.butter(4, [0.5, 5.0], "bandpass", fs=FS, output="sos")
    x_num = signal.sosfilt(sos, rng.standard_normal(40960)) * signal.windows.tukey(40960)
    x_meas = np.roll(x_num, 17)
    correlation = signal.correlate(x_meas, x_num, "full", "fft")
    lag = signal.correlation_lags(x_num.size, x_num.size)[np.argmax(correlation)]
    assert lag == 17
    assert measures.fei(x_num, x_meas, FS).delay_s * FS == pytest.approx(17.0, rel=0.01)


def test_fei_of_a_first_order_lag_is_its_frequency_response() -> None:
    hz, p = 2.0, np.exp(-2.0 * np.pi * 5.0 / FS)
    x_num = sine(60.0, hz)
    x_meas = signal.lfilter([0.0, 1.0 - p], [1.0, -p], x_num)
    _, (response,) = signal.freqz([0.0, 1.0 - p], [1.0, -p], [hz], fs=FS)
    last = slice(-round(10 * FS), None)
    index = measures.fei(x_num[last], x_meas[last], FS)
    assert index.amplitude == pytest.approx(abs(response), rel=1e-9)
    assert index.delay_s == pytest.approx(-np.angle(response) / (2.0 * np.pi * hz), rel=1e-9)


def test_fei_does_not_see_the_offset_of_a_sensor() -> None:
    x_num = sine(10.0, 2.0)[:-1]
    shifted = measures.fei(x_num + 0.3, 0.9 * x_num + 5.0, FS)
    assert shifted.amplitude == pytest.approx(0.9, rel=1e-9)
    assert shifted.delay_s == pytest.approx(0.0, abs=1e-9)


def test_fei_with_a_lost_stretch_keeps_delay_and_amplitude() -> None:
    x_num = sine(10.0, 2.0)[:-1]
    x_meas = sine(10.0, 2.0, 0.95, 10.0 / FS)[:-1]
    x_meas[4000:4100] = np.nan
    index = measures.fei(x_num, x_meas, FS)
    assert index.delay_s * FS == pytest.approx(10.0, rel=0.02)
    assert index.amplitude == pytest.approx(0.95, rel=0.02)


@pytest.mark.parametrize("x_num", [np.zeros(100), np.full(100, 2.0), np.zeros(0), np.ones(2)])
def test_fei_of_no_motion_is_nan(x_num: Floats) -> None:
    assert all(np.isnan(value) for value in measures.fei(x_num, x_num, FS))


# --- tracking indicator and energy error ------------------------------------------------------


@pytest.mark.parametrize("delay_samples", [-5.0, 10.0])
def test_tracking_indicator_changes_by_pi_a2_sin_phase_a_cycle(delay_samples: float) -> None:
    hz, amplitude, cycles = 2.0, 0.007, 20
    phase = 2.0 * np.pi * hz * delay_samples / FS
    x_num = sine(cycles / hz, hz, amplitude)
    x_meas = sine(cycles / hz, hz, amplitude, delay_samples / FS)
    total = measures.tracking_indicator(x_num, x_meas)
    expected = -cycles * np.pi * amplitude**2 * np.sin(phase)
    assert total[0] == 0.0
    # A polygon of 512 corners a cycle misses 2.5e-5 of the circle's area.
    assert total[-1] == pytest.approx(expected, rel=1e-4)


def test_tracking_indicator_does_not_see_an_amplitude_error() -> None:
    x_num = sine(10.0, 2.0, 0.007)
    assert np.max(np.abs(measures.tracking_indicator(x_num, 0.8 * x_num))) < 1e-15


values = arrays(np.float64, 40, elements=st.floats(-1.0, 1.0, width=32))


@given(x_num=values, x_meas=values)
def test_tracking_indicator_is_the_area_by_the_shoelace_formula(
    x_num: Floats, x_meas: Floats
) -> None:
    shoelace = 0.5 * np.cumsum(x_meas[:-1] * x_num[1:] - x_meas[1:] * x_num[:-1])
    np.testing.assert_allclose(
        measures.tracking_indicator(x_num, x_meas)[1:], shoelace, rtol=0.0, atol=1e-13
    )


@given(f=values, x_num=values, x_meas=values)
def test_energy_error_is_the_work_along_measured_less_commanded(
    f: Floats, x_num: Floats, x_meas: Floats
) -> None:
    work = integrate.trapezoid(f, x_meas) - integrate.trapezoid(f, x_num)
    assert measures.energy_error(f, x_num, x_meas)[-1] == pytest.approx(work, rel=0.0, abs=1e-12)


def test_late_actuator_on_a_spring_feeds_k_pi_a2_sin_phase_a_cycle() -> None:
    hz, amplitude, delay_samples, cycles = 2.0, 0.007, 10.0, 20
    x_num = sine(cycles / hz, hz, amplitude)
    x_meas = sine(cycles / hz, hz, amplitude, delay_samples / FS)
    phase = 2.0 * np.pi * hz * delay_samples / FS
    expected = cycles * K * np.pi * amplitude**2 * np.sin(phase)
    total = measures.energy_error(K * x_meas, x_num, x_meas)
    assert total[-1] == pytest.approx(expected, rel=1e-4)


def test_running_measures_pass_over_a_row_that_is_not_finite() -> None:
    x_num, x_meas = sine(2.0, 2.0), sine(2.0, 2.0, delay_s=0.01)
    x_meas[50] = np.nan
    for total in (
        measures.tracking_indicator(x_num, x_meas),
        measures.energy_error(x_meas, x_num, x_meas),
        measures.accumulated_error(x_num, x_meas),
    ):
        assert np.all(np.isfinite(total))
        assert total[50] == total[49]


def test_input_energy_of_a_constant_push_is_force_times_way() -> None:
    x = np.linspace(0.0, 0.02, 101)
    total = measures.input_energy(np.full(101, -3.0), x, 1000.0)
    assert total[-1] == pytest.approx(3.0 * 1000.0 * 0.02)


def test_hsem_is_the_energy_error_over_input_and_strain_energy() -> None:
    error = np.array([0.0, -3.0, 2.0])
    # Strain energy 100^2 / (2 * 1000) = 5 J, input energy 10 J.
    force = np.array([0.0, -100.0, np.nan])
    assert measures.hsem(error, [0.0, 10.0, 4.0], force, 1000.0) == pytest.approx(0.2)
    assert measures.hsem(error, None, force, 1000.0) == pytest.approx(0.6)
    assert np.isnan(measures.hsem(np.zeros(3), None, np.zeros(3), 1000.0))
