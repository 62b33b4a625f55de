"""Phase-lead compensator: against the plant of Eqn 2.2-2.4, scipy filters and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.signal
from kernels import FS_HZ, Floats

from rthyb_rt import core


def impulse_response(
    alpha: float, beta: float = 0.0, w1: float = 3.0, w2: float = 2.0, n: int = 4096
) -> Floats:
    impulse = np.zeros(n)
    impulse[0] = 1.0
    return core.Plc(w1, w2).run(impulse, alpha, beta)


def response_at(h: Floats, frequency_hz: float) -> complex:
    z = np.exp(2j * np.pi * frequency_hz / FS_HZ)
    return complex(np.sum(h * z ** -np.arange(h.size)))


def random_settings(count: int, seed: int) -> list[tuple[float, float, float]]:
    """alpha, W1, W2 with poles far enough inside the unit circle to die out in 4096 samples."""
    rng = np.random.default_rng(seed)
    settings: list[tuple[float, float, float]] = []
    while len(settings) < count:
        alpha, w1, w2 = rng.uniform(0.0, 60.0), rng.uniform(-8.0, 8.0), rng.uniform(-8.0, 8.0)
        if abs(w1) > 1.0 and np.max(np.abs(np.roots([w1, w2, 1.0]))) < 0.985:
            settings.append((alpha, w1, w2))
    return settings


def extrapolated_plant(x_c: Floats, alpha: float, w1: float, w2: float) -> Floats:
    """Eqn 2.2 with the averages of Eqn 2.3 and 2.4, solved for x_m[n+1], sample by sample."""
    s = w1 + w2 + 1.0
    x_m = np.zeros_like(x_c)
    for n in range(x_c.size):
        c1, c2 = (x_c[n - 1] if n > 0 else 0.0), (x_c[n - 2] if n > 1 else 0.0)
        m1, m2 = (x_m[n - 1] if n > 0 else 0.0), (x_m[n - 2] if n > 1 else 0.0)
        average_c = w1 * x_c[n] + w2 * c1 + c2
        x_m[n] = (average_c + alpha * s * m1 - w2 * m1 - m2) / (w1 + alpha * s)
    return x_m


# --- the inverse of the plant --------------------------------------------------------------------


def test_compensator_inverts_the_plant_of_eqn_2_2_at_every_frequency() -> None:
    worst = 0.0
    z = np.exp(1j * np.linspace(0.0, np.pi, 2049))
    for alpha, w1, w2 in random_settings(150, seed=1):
        s = w1 + w2 + 1.0
        weights = w1 * z**2 + w2 * z + 1.0
        plant = weights / (weights + alpha * s * (z**2 - z))
        compensator = np.fft.rfft(impulse_response(alpha, w1=w1, w2=w2))
        worst = max(worst, float(np.max(np.abs(plant * compensator - 1.0))))
    assert worst < 1e-12


def test_compensator_and_plant_in_series_give_the_command_back() -> None:
    command = np.random.default_rng(2).normal(size=600)
    for alpha, w1, w2 in random_settings(30, seed=3):
        compensated = core.Plc(w1, w2).run(command, alpha)
        achieved = extrapolated_plant(compensated, alpha, w1, w2)
        assert np.max(np.abs(achieved - command)) < 1e-11


def test_compensator_is_the_filter_of_eqn_2_5_with_its_curvature_term() -> None:
    command = np.random.default_rng(4).normal(size=500)
    rng = np.random.default_rng(5)
    for alpha, w1, w2 in random_settings(50, seed=6):
        beta, s = rng.uniform(-200.0, 200.0), w1 + w2 + 1.0
        numerator = [w1 + (alpha + beta) * s, w2 - (alpha + 2.0 * beta) * s, 1.0 + beta * s]
        expected = scipy.signal.lfilter(numerator, [w1, w2, 1.0], command)
        found = core.Plc(w1, w2).run(command, alpha, beta)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.max(np.abs(expected)))


def test_compensator_with_alpha_and_beta_moving_every_sample_follows_the_recursion() -> None:
    rng = np.random.default_rng(7)
    x, alpha, beta = rng.normal(size=400), rng.uniform(0, 40, 400), rng.uniform(-100, 100, 400)
    w1, w2, s = 3.0, 2.0, 6.0
    expected = np.zeros(400)
    for n in range(400):
        x1, x2 = (x[n - 1] if n > 0 else 0.0), (x[n - 2] if n > 1 else 0.0)
        y1, y2 = (expected[n - 1] if n > 0 else 0.0), (expected[n - 2] if n > 1 else 0.0)
        lead = alpha[n] * s * (x[n] - x1) + beta[n] * s * (x[n] - 2.0 * x1 + x2)
        expected[n] = (w1 * x[n] + w2 * x1 + x2 + lead - w2 * y1 - y2) / w1
    np.testing.assert_allclose(core.Plc().run(x, alpha, beta), expected, rtol=0, atol=1e-9)


def test_sample_by_sample_is_the_same_as_the_whole_run() -> None:
    rng = np.random.default_rng(8)
    x, alpha = rng.normal(size=50), rng.uniform(0, 40, 50)
    plc = core.Plc(3.0, 2.0)
    steps = [plc.step(a, 1.0, value) for a, value in zip(alpha, x, strict=True)]
    assert [code for _, code in steps] == [0] * 50
    np.testing.assert_array_equal([y for y, _ in steps], core.Plc().run(x, alpha, 1.0))


# --- what it does to plain commands --------------------------------------------------------------


@pytest.mark.parametrize(("w1", "w2"), [(3.0, 2.0), (1.5, -0.4), (-4.0, 1.0)])
def test_ramp_is_led_by_exactly_alpha_samples(w1: float, w2: float) -> None:
    n = np.arange(2048.0)
    for alpha in (0.0, 0.5, 17.0, 33.09, 60.0):
        led = core.Plc(w1, w2).run(1e-3 * n, alpha)
        lead_samples = (led - 1e-3 * n) / 1e-3
        assert np.max(np.abs(lead_samples[1024:] - alpha)) < 1e-9


def test_parabola_is_led_by_the_closed_form() -> None:
    # S z^2 / (W1 z^2 + W2 z + 1) has DC gain 1 and leads a ramp by (W2 + 2) / S samples, so that
    # n^2/2 comes out as n^2/2 + alpha (n - 1/2 + (W2 + 2)/S) + beta.
    n = np.arange(512.0)
    for alpha, beta, w1, w2 in ((17.0, 144.5, 3.0, 2.0), (10.0, -20.0, 2.0, 0.5)):
        s = w1 + w2 + 1.0
        expected = 0.5 * n**2 + alpha * (n - 0.5 + (w2 + 2.0) / s) + beta
        found = core.Plc(w1, w2).run(1e-4 * 0.5 * n**2, alpha, beta) / 1e-4
        np.testing.assert_allclose(found[200:], expected[200:], rtol=1e-12, atol=1e-8)


def test_command_at_rest_stays_exact_while_alpha_and_beta_jump() -> None:
    rng = np.random.default_rng(9)
    plc = core.Plc(3.0, 2.0, x0_m=0.0123)
    for _ in range(500):
        y, code = plc.step(rng.uniform(0, 60), rng.uniform(-1800, 1800), 0.0123)
        assert (y, code) == (0.0123, 0)


def test_gain_at_rest_is_one_for_any_setting() -> None:
    for alpha, w1, w2 in random_settings(50, seed=10):
        assert np.sum(impulse_response(alpha, 30.0, w1, w2)) == pytest.approx(1.0, abs=1e-10)


def test_alpha_zero_passes_the_command_through() -> None:
    x = np.random.default_rng(11).normal(size=300)
    np.testing.assert_array_equal(core.Plc().run(x, 0.0), x)


# --- figures of the field notes ------------------------------------------------------------------


def test_gain_on_a_delay_of_17_samples_grows_with_frequency_as_measured() -> None:
    h = impulse_response(17.0)
    for frequency_hz, gain in ((1.0, 1.0053), (2.0, 1.0211), (5.0, 1.1255), (10.0, 1.4383)):
        assert abs(response_at(h, frequency_hz)) == pytest.approx(gain, abs=1e-3)


def test_curvature_term_meets_a_delay_of_17_samples_to_5_hz() -> None:
    # beta of the parabola's closed form: (alpha^2 + alpha)/2 - alpha (W2 + 2)/S.
    h = impulse_response(17.0, 0.5 * (17.0**2 + 17.0) - 17.0 * 4.0 / 6.0)
    for frequency_hz in (1.0, 2.0, 5.0):
        angle = 2.0 * np.pi * 17.0 * frequency_hz / FS_HZ
        error = abs(response_at(h, frequency_hz) * np.exp(-1j * angle) - 1.0)
        assert error < angle**3 / 5.0  # what is left of exp(i angle) after its square is a sixth


def test_first_sample_and_nyquist_gains_are_those_the_designer_is_told() -> None:
    sign = (-1.0) ** np.arange(4096)
    for alpha in (0.0, 10.0, 17.0, 34.0):
        h = impulse_response(alpha)
        assert h[0] == pytest.approx(1.0 + 2.0 * alpha, abs=1e-3)
        assert np.sum(h * sign) == pytest.approx(1.0 + 6.0 * alpha, abs=1e-3)
    h = impulse_response(17.0, 144.5)
    assert h[0] == pytest.approx(324.0, abs=1e-3)
    assert np.sum(h * sign) == pytest.approx(1837.0, abs=1e-3)


def test_poles_of_weights_3_and_2_lie_at_radius_0_5774() -> None:
    h = impulse_response(17.0, 30.0)[:30]
    a = np.column_stack([h[4:-1], h[3:-2]])
    c1, c2 = np.linalg.lstsq(a, h[5:], rcond=None)[0]
    np.testing.assert_allclose(np.abs(np.roots([1.0, -c1, -c2])), 0.5774, atol=1e-3)


# --- the stable region, Fig. 2.1 -----------------------------------------------------------------


def test_stability_decision_equals_root_finding_on_641_by_641_weights() -> None:
    # Steps of 1/32 are exact in binary, so the boundary of Fig. 2.1 is met to the bit.
    grid = np.linspace(-10.0, 10.0, 641)
    w1, w2 = np.meshgrid(grid, grid, indexing="ij")
    safe = np.where(w1 == 0.0, 1.0, w1)
    companion = np.zeros((641, 641, 2, 2))
    companion[..., 0, 0], companion[..., 0, 1] = -w2 / safe, -1.0 / safe
    companion[..., 1, 0] = 1.0
    radius = np.max(np.abs(np.linalg.eigvals(companion)), axis=-1)
    by_roots = (w1 != 0.0) & (radius < 1.0 - 1e-7)
    by_core = np.array([[core.plc_is_stable(a, b) for b in grid] for a in grid])
    np.testing.assert_array_equal(by_core, by_roots)


@pytest.mark.parametrize(
    ("w1", "w2"),
    [
        (1.0, 0.0),
        (-1.0, 0.0),
        (0.0, 0.0),
        (3.0, 4.0),
        (3.0, -4.0),
        (-3.0, 2.0),
        (np.nan, 2.0),
        (3.0, np.nan),
        (np.inf, 2.0),
        (3.0, np.inf),
        (1e300, 2.0),
    ],
)
def test_weights_outside_the_stable_region_are_refused(w1: float, w2: float) -> None:
    with pytest.raises(core.CoreError, match="W1 and W2"):
        core.Plc(w1, w2)


@pytest.mark.parametrize("x0_m", [np.nan, np.inf, 1e300])
def test_senseless_start_position_is_refused(x0_m: float) -> None:
    with pytest.raises(core.CoreError):
        core.Plc(3.0, 2.0, x0_m)
