"""Scaling, cutting, baseline and resampling of ground motions, against scipy and closed forms."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
import scipy.integrate
import scipy.signal

from rthyb_rt import ground_motion
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion, baseline_check, resample


def motion_of(samples: np.ndarray, rate_hz: float) -> GroundMotion:
    """Return a motion with these samples."""
    return GroundMotion("test", "made up", 1.0 / rate_hz, samples)


class MultiSine:
    """Band-limited signal of nine sines between 0.05 Hz and a highest frequency."""

    def __init__(self, highest_hz: float) -> None:
        generator = np.random.default_rng(15)
        self.frequency_hz = np.linspace(0.05, highest_hz, 9)
        self.phase = generator.uniform(0.0, 2.0 * np.pi, 9)

    def __call__(self, time_s: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * self.frequency_hz * time_s[:, None] + self.phase
        return np.asarray(np.sin(angle).sum(axis=1))


# --- the record itself ---------------------------------------------------------------------------


def test_samples_cannot_be_changed_nor_shared() -> None:
    samples = np.array([0.0, 1.0, -2.0])
    motion = motion_of(samples, 100)
    samples[0] = 9.0
    assert motion.acceleration_mps2[0] == 0.0
    with pytest.raises(ValueError, match="read-only"):
        motion.acceleration_mps2[0] = 1.0


def test_one_run_of_a_campaign_cannot_change_the_ground_motion_of_the_next() -> None:
    built_in = ground_motion.builtin("elcentro-1940-ns")
    with pytest.raises(ValueError, match="read-only"):
        built_in.acceleration_mps2[0] = 1.0
    with pytest.raises(TypeError):
        built_in.details["unit"] = "g"  # type: ignore[index]
    first = resample(built_in)
    untouched = first.copy()
    first *= 2.0
    np.testing.assert_array_equal(resample(built_in), untouched)


def test_records_of_equal_samples_and_other_intervals_are_told_apart() -> None:
    samples = MultiSine(10.0)(np.arange(200) / 50.0)
    slow, fast = (resample(motion_of(samples, hz), 100.0) for hz in (50.0, 100.0))
    assert slow.size == 2 * fast.size
    np.testing.assert_array_equal(fast, samples)


def test_a_record_too_long_to_be_kept_is_resampled_like_a_short_one() -> None:
    motion = motion_of(MultiSine(10.0)(np.arange(200) / 50.0), 50.0)
    long = resample(motion, 100.0, duration_s=2**20 / 100.0 + 1.0)
    np.testing.assert_array_equal(long[:400], resample(motion, 100.0))
    assert not long[600:].any()


@pytest.mark.parametrize("samples", [[], [[1.0]], [np.nan], [np.inf]])
def test_samples_that_are_no_row_of_finite_numbers_are_refused(samples: list[float]) -> None:
    with pytest.raises(ValueError, match="finite"):
        motion_of(np.array(samples), 100)


@pytest.mark.parametrize("dt_s", [0.0, -0.01, np.nan, np.inf])
def test_interval_must_be_positive(dt_s: float) -> None:
    with pytest.raises(ValueError, match="dt_s"):
        GroundMotion("a", "b", dt_s, np.zeros(3))


def test_scaling_to_a_pga_and_by_a_factor() -> None:
    motion = ground_motion.load("elcentro-1940-ns")
    scaled = motion.scaled(pga_g=0.04)
    assert scaled.pga_g == pytest.approx(0.04, rel=1e-14)
    twice_turned = scaled.scaled(factor=-2.0)
    np.testing.assert_allclose(
        twice_turned.acceleration_mps2, motion.acceleration_mps2 * (-0.08 / motion.pga_g)
    )
    assert float(twice_turned.details["scale"]) == pytest.approx(-0.08 / motion.pga_g)
    assert "scale" not in motion.details


def test_scale_that_makes_no_sense_is_refused() -> None:
    motion = ground_motion.load("elcentro-1940-ns")
    for pga_g in (-0.1, np.nan, np.inf):
        with pytest.raises(InputError, match="PGA"):
            motion.scaled(pga_g=pga_g)
    with pytest.raises(InputError, match="factor"):
        motion.scaled(factor=np.inf)
    with pytest.raises(InputError, match="no motion"):
        motion_of(np.zeros(10), 100).scaled(pga_g=0.1)
    with pytest.raises(ValueError, match="either"):
        motion.scaled(pga_g=0.1, factor=2.0)


def test_window_and_free_vibration_count_samples_exactly() -> None:
    motion = motion_of(np.arange(13102.0), 200)
    first = motion.window(0.0, 50.0)
    assert first.acceleration_mps2.size == 10_000
    assert first.padded(10.0).acceleration_mps2.size == 12_000
    assert first.padded(10.0).duration_s == pytest.approx(60.0, abs=1e-9)
    later = motion.window(1.0)
    assert later.acceleration_mps2[0] == 200.0
    assert later.acceleration_mps2[-1] == 13101.0
    assert motion.window(1.0, 1e9).acceleration_mps2.size == 13102 - 200
    assert motion.window() is motion
    assert motion.padded(0.0) is motion
    assert later.details["window"] == "1 s to 65.51 s"


@pytest.mark.parametrize(
    ("start_s", "duration_s"), [(-1.0, None), (2.0, None), (0.5, 0.0), (0.5, -1.0), (0.5, np.nan)]
)
def test_window_outside_the_record_is_refused(start_s: float, duration_s: float | None) -> None:
    with pytest.raises(InputError):
        motion_of(np.ones(200), 100).window(start_s, duration_s)


def test_window_between_two_samples_is_refused() -> None:
    with pytest.raises(InputError, match="no sample"):
        motion_of(np.ones(200), 100).window(0.503, 0.001)


@pytest.mark.parametrize("time_s", [-1.0, np.nan, np.inf])
def test_free_vibration_must_be_a_time(time_s: float) -> None:
    with pytest.raises(InputError, match="free vibration"):
        motion_of(np.ones(20), 100).padded(time_s)


# --- baseline ------------------------------------------------------------------------------------


def test_baseline_check_integrates_as_scipy_does_and_leaves_the_record_alone() -> None:
    motion = ground_motion.load("elcentro-1940-ns")
    before = motion.acceleration_mps2.copy()
    check = baseline_check(motion)
    integrate = scipy.integrate.cumulative_trapezoid
    velocity = integrate(before, dx=0.02, initial=0)
    displacement = integrate(velocity, dx=0.02, initial=0)
    assert check.final_velocity_mps == pytest.approx(velocity[-1], rel=1e-9)
    assert check.peak_velocity_mps == pytest.approx(np.abs(velocity).max(), rel=1e-12)
    assert check.final_displacement_m == pytest.approx(displacement[-1], rel=1e-6)
    assert check.peak_displacement_m == pytest.approx(np.abs(displacement).max(), rel=1e-12)
    assert check.mean_mps2 == pytest.approx(before.mean())
    assert check.ok
    np.testing.assert_array_equal(motion.acceleration_mps2, before)


def test_offset_of_the_sensor_fails_the_baseline_check() -> None:
    motion = ground_motion.load("elcentro-1940-ns")
    shifted = GroundMotion("x", "y", motion.dt_s, motion.acceleration_mps2 + 0.005)
    check = baseline_check(shifted)
    assert not check.ok
    assert "5 %" in check.message
    assert "baseline correction" in check.message


def test_record_at_rest_passes_the_baseline_check() -> None:
    assert baseline_check(motion_of(np.zeros(10), 100)).ok


# --- resampling ----------------------------------------------------------------------------------


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0, 1.0 / 0.0049987, 1000.0])
def test_band_limited_signal_is_reproduced_at_1024_hz(rate_hz: float) -> None:
    signal = MultiSine(0.8 * rate_hz / 2)
    record = motion_of(signal(np.arange(int(20 * rate_hz)) / rate_hz), rate_hz)
    found = resample(record)
    time_s = np.arange(found.size) / 1024.0
    edge_s = 64 / rate_hz
    inner = (time_s > edge_s) & (time_s < record.duration_s - edge_s)
    exact = signal(time_s[inner])
    assert np.abs(found[inner] - exact).max() < 1e-4 * np.abs(exact).max()
    linear = resample(record, method="linear")
    assert np.abs(linear[inner] - exact).max() > 0.01 * np.abs(exact).max()


def test_interpolation_equals_the_sum_over_the_windowed_sinc() -> None:
    """The polynomial form of the kernel against the printed formula, for both directions."""
    samples = np.random.default_rng(1).standard_normal(400)
    beta, steps = 0.1102 * (100 - 8.7), np.arange(400)
    for rate_hz in (100.0, 1000.0, 2500.0):
        found = resample(motion_of(samples, rate_hz), 617.3)
        ratio = 617.3 / rate_hz
        cutoff = 1.0 if ratio >= 1 else 0.95 * ratio
        reach = np.ceil(64 / cutoff)
        u = np.arange(found.size)[:, None] / ratio - steps
        window = np.i0(beta * np.sqrt(np.clip(1 - (u / reach) ** 2, 0, None))) / np.i0(beta)
        within = (u >= -reach) & (u < reach)
        kernel = cutoff * np.sinc(cutoff * u) * np.where(within, window, 0.0)
        np.testing.assert_allclose(found, kernel @ samples, atol=1e-12)


def test_scipy_polyphase_resampling_agrees() -> None:
    """An independent filter of the same sharpness: scipy's polyphase resampling, 50 -> 1024 Hz."""
    record = ground_motion.load("elcentro-1940-ns")
    found = resample(record)
    up, down = 512, 25
    taps = scipy.signal.firwin(2 * 64 * up + 1, 1.0 / up, window=("kaiser", 0.1102 * 91.3))
    theirs = scipy.signal.resample_poly(record.acceleration_mps2, up, down, window=taps)
    size = min(found.size, theirs.size)
    difference = np.abs(found[:size] - theirs[:size]).max()
    assert difference < 1e-3 * record.pga_mps2


@pytest.mark.parametrize("rate_hz", [50.0, 100.0, 200.0])
def test_nothing_is_invented_above_the_records_nyquist_frequency(rate_hz: float) -> None:
    """White noise up to .9 of the Nyquist frequency: beyond it less than -60 dB of the peak."""
    generator = np.random.default_rng(7)
    noise = generator.standard_normal(int(30 * rate_hz))
    taps = scipy.signal.firwin(301, 0.9, window=("kaiser", 10))
    envelope = scipy.signal.windows.tukey(noise.size, 0.3)
    record = motion_of(np.convolve(noise, taps, "same") * envelope, rate_hz)

    def power_db_above_nyquist(samples: np.ndarray) -> float:
        spectrum = np.abs(np.fft.rfft(samples * np.hanning(samples.size)))
        above = np.fft.rfftfreq(samples.size, 1 / 1024) > rate_hz / 2
        return float(20 * np.log10(spectrum[above].max() / spectrum.max()))

    assert power_db_above_nyquist(resample(record)) < -60
    assert power_db_above_nyquist(resample(record, method="linear")) > -30


def test_el_centro_has_no_content_beyond_the_transition_band() -> None:
    """The table reaches its Nyquist frequency of 25 Hz; the kernel stops 5 % above it."""
    found = resample(ground_motion.load("elcentro-1940-ns"))
    spectrum = np.abs(np.fft.rfft(found * np.hanning(found.size)))
    beyond = np.fft.rfftfreq(found.size, 1 / 1024) > 1.06 * 25
    assert 20 * np.log10(spectrum[beyond].max() / spectrum.max()) < -90


def test_energy_is_preserved() -> None:
    record = ground_motion.load("elcentro-1940-ns").padded(3.0)
    before = np.sum(record.acceleration_mps2**2) * record.dt_s
    after = np.sum(resample(record) ** 2) / 1024
    assert after == pytest.approx(before, rel=1e-3)


def test_own_samples_are_kept_where_instants_coincide() -> None:
    record = ground_motion.load("elcentro-1940-ns")
    found = resample(record)
    # 50 Hz and 1024 Hz meet every 25 samples of the record, every 512 of the controller.
    np.testing.assert_array_equal(found[::512], record.acceleration_mps2[::25])
    np.testing.assert_array_equal(resample(record, 50.0), record.acceleration_mps2)
    np.testing.assert_array_equal(resample(record, 100.0)[::2], record.acceleration_mps2)


def test_downsampling_from_2000_hz_removes_what_would_fold_back() -> None:
    """700 Hz would appear at 324 Hz; a 100 Hz sine beside it stays."""
    time_s = np.arange(20_000) / 2000.0
    wanted = np.sin(2 * np.pi * 100 * time_s)
    record = motion_of(wanted + np.sin(2 * np.pi * 700 * time_s), 2000.0)
    found = resample(record)
    fine_s = np.arange(found.size) / 1024.0
    inner = (fine_s > 0.2) & (fine_s < 9.8)
    error = found[inner] - np.sin(2 * np.pi * 100 * fine_s[inner])
    assert np.abs(error).max() < 1e-4


@pytest.mark.parametrize("fs_hz", [1024.0, 400.0, 37.3])
def test_linear_is_numpys_interpolation(fs_hz: float) -> None:
    record = ground_motion.load("elcentro-1940-ns")
    found = resample(record, fs_hz, method="linear")
    instants = np.arange(found.size) / fs_hz
    within = instants <= record.time_s[-1]
    expected = np.interp(instants[within], record.time_s, record.acceleration_mps2)
    np.testing.assert_allclose(found[within], expected, atol=1e-12)


@pytest.mark.parametrize("method", ["band-limited", "linear"])
def test_length_follows_the_duration_and_rest_follows_the_record(method: str) -> None:
    record = motion_of(np.ones(500), 100)
    assert resample(record, method=method).size == 5 * 1024  # type: ignore[arg-type]
    longer = resample(record, method=method, duration_s=20.0)  # type: ignore[arg-type]
    assert longer.size == 20 * 1024
    assert np.all(longer[6 * 1024 :] == 0.0)
    assert resample(record, method=method, duration_s=1.0).size == 1024  # type: ignore[arg-type]


def test_resampling_refuses_misuse() -> None:
    record = motion_of(np.ones(50), 100)
    for wrong in ({"fs_hz": 0.0}, {"fs_hz": np.nan}, {"duration_s": -1.0}, {"duration_s": 1e9}):
        with pytest.raises(ValueError, match=r"positive|samples"):
            resample(record, **wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="method"):
        resample(record, method="cubic")  # type: ignore[arg-type]


@pytest.mark.speed
@pytest.mark.parametrize("rate_hz", [50.0, 200.0, 1.0 / 0.0049987])
def test_resampling_90_s_costs_less_than_a_tenth_of_them_by_the_plain_formula(
    rate_hz: float,
) -> None:
    """A ratio within one run: about 20 ms against 130 ms on a usual PC."""
    record = motion_of(np.random.default_rng(3).standard_normal(int(90 * rate_hz)), rate_hz)

    def plain_formula() -> None:
        u = np.linspace(-64.0, 64.0, 128 * 9216)
        np.sinc(u) * np.i0(10.06 * np.sqrt(1.0 - (u / 64.0) ** 2))

    def best_of_three(work: Callable[[], object]) -> float:
        costs = []
        for _ in range(3):
            start = time.perf_counter()
            work()
            costs.append(time.perf_counter() - start)
        return min(costs)

    assert best_of_three(lambda: resample(record)) < best_of_three(plain_formula)
