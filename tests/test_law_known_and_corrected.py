"""Laws of one delay: third-order (known), aic, darby, ahmadizadeh (corrected as the test runs)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from kernels import FS_HZ, Floats, H, smooth_motion, time_s

from rthyb_rt import config, core
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time

CORRECTED = ("aic", "darby", "ahmadizadeh")


def law(name: str, period_s: float = H, **settings: float) -> core.Law:
    own = {f"{name.replace('-', '_')}.{key}": value for key, value in settings.items()}
    return core.Law(core.LawConfig(name, own), period_s=period_s)


def differences(x: Floats, h: float, count: int) -> Floats:
    before = np.concatenate([np.full(count - 1, x[0]), x])
    return np.column_stack([np.diff(before, i)[count - 1 - i :] / h**i for i in range(count)])


def closed(made: core.Law, x: Floats, late: int) -> tuple[Floats, list[dict[str, float]]]:
    """The law at an actuator that is a delay: what comes back, and what is reported."""
    sent = np.zeros(x.size + late + 1)
    came, told = np.zeros(x.size), []
    for n in range(x.size):
        came[n] = sent[n]
        made.observe(sent[n + late], came[n])
        sent[n + late + 1], _ = made.lead(float(x[min(n + 1, x.size - 1)]))
        told.append(made.report())
    return came, told


# ---- third-order --------------------------------------------------------------------------------


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_third_order_is_the_sum_of_its_derivatives(fs_hz: float) -> None:
    x = smooth_motion(2.0, 3)
    x -= x[0]
    a = (0.98, 0.02, 0.2 * 0.02**2, 0.03 * 0.02**3)
    made = law("third-order", 1 / fs_hz, a0=0.98, a1_s=0.02, a2_share=0.2, a3_share=0.03)
    np.testing.assert_allclose(made.run(x), differences(x, 1 / fs_hz, 4) @ a, rtol=0, atol=1e-9)


def test_third_order_inverts_three_equal_lags() -> None:
    """Behind them, by backward Euler, nothing is left but rounding."""
    tau = 0.018 / 3
    x = smooth_motion(3.0, 5)
    x -= x[0]
    y = np.array(law("third-order", a1_s=3 * tau).run(x))
    for _ in range(3):
        before, state = np.empty_like(y), 0.0
        for n, value in enumerate(y):
            state = (tau / H * state + value) / (1 + tau / H)
            before[n] = state
        y = before
    np.testing.assert_allclose(y, x, rtol=0, atol=1e-12)


# ---- aic ----------------------------------------------------------------------------------------


def aic_formulated(x: Floats, came: Floats, first_s: float) -> Floats:
    """alpha after each sample, by cumulative sums of the published areas, in samples."""
    c, m = x, came
    area = np.concatenate([[0.0], np.cumsum(0.5 * (c[1:] + c[:-1]) * np.diff(m))])
    tracked = np.concatenate([[0.0], np.cumsum(0.5 * (m[1:] + m[:-1]) * np.diff(c))])
    indicator = 0.5 * (area - tracked) / 1e-6
    integral = np.concatenate([[0.0], np.cumsum(indicator[:-1])]) * H
    return np.asarray(first_s * FS_HZ + 0.4 * indicator + 0.04 * integral)


def test_aic_follows_the_tracking_indicator() -> None:
    t = time_s(4.0)
    x = 0.002 * np.sin(2 * np.pi * 2.0 * t) * (1 - np.exp(-((t / 0.3) ** 3)))
    came = np.concatenate([np.zeros(4), x[:-4]])  # four samples of lag are left
    made = law("aic", delay_s=0.01)
    told = []
    made.lead(x[0])
    for n in range(x.size):
        made.observe(x[n], came[n])
        made.lead(x[min(n + 1, x.size - 1)])
        told.append(made.report()["alpha"])
    expected = aic_formulated(x, came, 0.01)
    np.testing.assert_allclose(told, np.minimum(expected, 0.06 * FS_HZ), rtol=1e-9, atol=1e-9)
    assert told[-1] > 0.01 * FS_HZ + 1.0


def test_aic_leads_by_its_delay_along_a_straight_line() -> None:
    x = 0.01 * np.arange(50)
    np.testing.assert_allclose(law("aic", delay_s=0.02).run(x)[1:], x[1:] + 0.02 * 0.01 / H)


# ---- darby --------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2, 3])
def test_darby_leads_a_polynomial_by_its_delay_of_whole_samples_exactly(order: int) -> None:
    late = 16
    n = np.arange(400.0)
    x = np.polyval([1e-9, -2e-7, 3e-5, 0.0][3 - order :], n)
    led = law("darby", delay_s=late * H, order=order, cp_s_per_m=0.0).run(x)
    wanted = np.polyval([1e-9, -2e-7, 3e-5, 0.0][3 - order :], n + late)
    np.testing.assert_allclose(led[order * late :], wanted[order * late :], rtol=1e-9, atol=1e-15)


def test_darby_corrects_the_delay_by_its_published_rule() -> None:
    x = smooth_motion(3.0, 4, peak_m=0.003)
    came = 0.9 * np.concatenate([np.zeros(9), x[:-9]])
    made, tau, told, expected = law("darby", delay_s=0.012), 0.012, [], []
    made.lead(x[0])
    for n in range(x.size):
        made.observe(0.0, came[n])
        v = (x[n] - (x[n - 1] if n else 0.0)) / H
        tau = min(max(tau + 0.05 * math.tanh(200.0 * v) * (x[n] - came[n]), 0.0), 0.06)
        made.lead(x[min(n + 1, x.size - 1)])
        told.append(made.report()["alpha"])
        expected.append(tau / H)
    np.testing.assert_allclose(told, expected, rtol=1e-9)


# ---- ahmadizadeh --------------------------------------------------------------------------------


def test_ahmadizadeh_corrects_by_the_mean_of_error_over_velocity() -> None:
    t = time_s(4.0)
    x = 0.004 * np.sin(2 * np.pi * 1.5 * t) * (1 - np.exp(-((t / 0.3) ** 3)))
    came = np.concatenate([np.zeros(6), x[:-6]])
    made, tau = law("ahmadizadeh", delay_s=0.01), 0.01
    made.lead(x[0])
    told, expected, ratios = [], [], []
    v = np.concatenate([[0.0], np.diff(x)]) / H
    for n in range(x.size):
        made.observe(0.0, came[n])
        slope = (came[n] - (came[n - 5] if n >= 5 else came[0])) / (5 * H)
        if abs(v[n]) > 0.01 and abs(slope) > 0.01 and v[n] * slope > 0.0:
            ratios.append((x[n] - came[n]) / v[n])
        if (n + 1) % 512 == 0:
            tau = min(max(tau + (0.3 * np.mean(ratios) if ratios else 0.0), 0.0), 0.06)
            ratios = []
        made.lead(x[min(n + 1, x.size - 1)])
        told.append(made.report()["alpha"])
        expected.append(tau / H)
    np.testing.assert_allclose(told, expected, rtol=1e-9)
    assert told[-1] - told[0] > 3.0


def test_ahmadizadeh_leads_a_parabola_by_its_delay() -> None:
    """Backward differences are half a sample late: that times tau is all that is left."""
    n, late = np.arange(300.0), 12
    led = law("ahmadizadeh", delay_s=late * H).run(1e-6 * n**2)
    np.testing.assert_allclose(led[5:], 1e-6 * ((n + late) ** 2 - late)[5:], rtol=1e-9)


# ---- all that correct ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "settings", "left"),
    [
        ("aic", {}, 1.0),
        ("darby", {"order": 2.0, "cp_s_per_m": 0.02}, 1.0),
        ("ahmadizadeh", {}, 1.0),
    ],
)
def test_a_delay_that_was_identified_wrongly_is_found(
    name: str, settings: dict[str, float], left: float
) -> None:
    """A pure delay of 16 samples; the rig file says 8."""
    t = time_s(60.0)
    x = 0.004 * np.sin(2 * np.pi * 1.0 * t) * (1 - np.exp(-((t / 0.5) ** 3)))
    came, told = closed(law(name, delay_s=8 * H, **settings), x, 16)
    assert told[-1]["alpha"] == pytest.approx(16.0, abs=left)
    end = slice(-4096, None)
    assert np.std((came - x)[end]) < 0.05 * np.std(x[end])


@pytest.mark.parametrize("name", CORRECTED)
def test_the_delay_keeps_to_its_bounds_whatever_comes_back(name: str) -> None:
    x = smooth_motion(4.0, 3, peak_m=0.02)
    rng = np.random.default_rng(1)
    for came in (rng.normal(size=x.size), -x, 1e3 * np.sign(x), np.zeros(x.size)):
        found = law(name).follow(x, x, came)[1]
        assert -1e-9 <= found["alpha"].min() <= found["alpha"].max() <= 0.06 * FS_HZ + 1e-9


@pytest.mark.parametrize("name", CORRECTED)
def test_a_first_delay_beyond_the_largest_is_named(name: str) -> None:
    text = f"""schema = "rthyb-test/1"
test = {{ name = "a" }}
numerical = {{ period_s = 0.5, damping_ratio = 0.02 }}
controller = {{ type = "{name}", {name} = {{ delay_s = 0.07 }} }}
"""
    with pytest.raises(InputError, match="delay_max_s"):
        config.parse_test(text, "test.toml")


@pytest.mark.parametrize(
    ("name", "settings", "most"),
    [
        ("third-order", {}, 0.03),
        ("aic", {}, 0.03),
        ("darby", {"controller.darby.order": 2}, 0.05),
        ("ahmadizadeh", {}, 0.05),
    ],
)
def test_the_shaking_table_follows(name: str, settings: dict[str, float], most: float) -> None:
    """The shipped rig and El Centro; without compensation the same test diverges."""
    changes = {"controller.type": name} | settings
    test = config.load_test(config.builtin_test_path(), changes)
    setup = experiment.prepare(test, config.load_rig(config.find_rig(test.rig)))
    rec = virtual_time.run(setup)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.running()]
    error = rows["x_meas_m"] - rows["x_num_m"]
    assert math.sqrt(np.mean(error**2) / np.mean(rows["x_num_m"] ** 2)) < most
