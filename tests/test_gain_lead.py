"""Laws `inverse` and `gain-alpha-beta`: scipy's filters, numpy's least squares, exact inverses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import scipy.signal
from kernels import Floats, smooth_motion

from rthyb_rt import config, core
from rthyb_rt.benchmark import plants as rths_benchmark
from rthyb_rt.config import rigsettings
from rthyb_rt.core.laws import LAWS as ALL_LAWS
from rthyb_rt.errors import InputError
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record import recording

EXAMPLE = Path(__file__).resolve().parents[1] / "examples" / "frame-three-storeys.toml"
LAWS = ("inverse", "gain-alpha-beta")
ROLL_OFF_HZ = 30.0
FIT_HZ = 120.0

TEST = """schema = "rthyb-test/1"
test = { name = "t" }
numerical = { period_s = 0.5, damping_ratio = 0.02 }
"""


def table_of(name: str) -> str:
    return name.replace("-", "_")


def law(name: str, h: float, noise_m: float = 0.0, **own: float) -> core.Law:
    settings = {"roll_off_hz": ROLL_OFF_HZ} | own
    keyed = {f"{table_of(name)}.{key}": value for key, value in settings.items()}
    return core.Law(core.LawConfig(name, keyed, rest_noise_m=noise_m), period_s=h)


def powers(order: int) -> list[Floats]:
    """(1 - 1/z)^j in powers of 1/z, each padded to the order."""
    found = [np.array([1.0])]
    for _ in range(order):
        found.append(np.convolve(found[-1], [1.0, -1.0]))
    return [np.pad(p, (0, order + 1 - p.size)) for p in found]


def inverse_filter(b: Floats, h: float, roll_off_hz: float = FIT_HZ) -> tuple[Floats, Floats]:
    """C(z) = 1 + sum of b_j ((1 - 1/z) / h)^j / (1 + r (1 - 1/z))^5, in powers of 1/z."""
    rho = math.exp(-2.0 * math.pi * roll_off_hz * h)
    r = rho / (1.0 - rho)
    bottom = np.array([1.0])
    for _ in range(5):
        bottom = np.convolve(bottom, [1.0 + r, -r])
    top = bottom + sum(b[j] / h**j * p for j, p in enumerate(powers(5)))
    return np.asarray(top), bottom


def lead_filter(gain: float, delay: float, curvature: float, h: float) -> tuple[Floats, Floats]:
    """Eqn 2.5 with gain and curvature, in powers of 1/z; delay and curvature in samples."""
    w1, w2 = rigsettings.weights(ROLL_OFF_HZ, h)
    bottom = np.array([w1, w2, 1.0])
    terms = (gain - 1.0, delay, curvature)
    top = bottom + bottom.sum() * sum(t * p for t, p in zip(terms, powers(2), strict=True))
    return np.asarray(top), bottom


def servo(h: float) -> Floats:
    """Coefficients b of an inverse that undoes an actuator of fifth order nearly: 67 Hz, 2 %."""
    w = 2.0 * math.pi * 67.0
    lag = np.polymul([1.0 / (2.0 * math.pi * 7.7), 1.0], [1.0 / 290.0**2, 1.2 / 290.0, 1.0])
    whole = np.polymul(lag, [1.0 / w**2, 0.04 / w, 1.0])[::-1]
    rho = math.exp(-2.0 * math.pi * FIT_HZ * h)
    r = rho / (1.0 - rho)
    own = np.array([math.comb(5, j) * (r * h) ** j for j in range(6)])
    # A continuous plant's coefficients, with its own differences: stable, and not quite the plant.
    return np.asarray(1.01 * whole - own)


def coefficients(b: Floats) -> dict[str, float]:
    return {f"b{j}": float(value) for j, value in enumerate(b)}


# ---- the lead -----------------------------------------------------------------------------------


@pytest.mark.parametrize("fs_hz", [256.0, 1024.0, 4096.0])
def test_the_lead_is_eqn_2_5_with_a_gain_rolled_off_at_one_frequency(fs_hz: float) -> None:
    h = 1.0 / fs_hz
    own = {"gain0": 0.93, "delay0_s": 0.018, "curvature0_s2": 1.2e-4}
    x = np.asarray(smooth_motion(3.0, 1))
    led = law("gain-alpha-beta", h, **own).run(x)
    top, bottom = lead_filter(0.93, 0.018 * fs_hz, 1.2e-4 * fs_hz**2, h)
    poles = np.roots(bottom)
    assert np.abs(poles) == pytest.approx(math.exp(-2.0 * math.pi * ROLL_OFF_HZ * h), rel=1e-6)
    expected = scipy.signal.lfilter(top, bottom, x - x[0]) + x[0]
    np.testing.assert_allclose(led, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_the_inverse_is_the_rational_filter_of_its_coefficients(fs_hz: float) -> None:
    h = 1.0 / fs_hz
    b = servo(h)
    x = np.asarray(smooth_motion(3.0, 2))
    led = law("inverse", h, fit_roll_off_hz=FIT_HZ, **coefficients(b)).run(x)
    expected = scipy.signal.lfilter(*inverse_filter(b, h), x - x[0]) + x[0]
    np.testing.assert_allclose(led, expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_a_rig_that_is_as_it_was_fitted_follows_the_command_exactly(fs_hz: float) -> None:
    h = 1.0 / fs_hz
    b = servo(h)
    top, bottom = inverse_filter(b, h)
    x = np.asarray(smooth_motion(3.0, 3))
    sent = law("inverse", h, fit_roll_off_hz=FIT_HZ, **coefficients(b)).run(x)
    reached = scipy.signal.lfilter(bottom, top, sent)
    np.testing.assert_allclose(reached, x, atol=1e-8 * np.abs(x).max())


def test_without_coefficients_the_inverse_is_none_at_all() -> None:
    x = smooth_motion(2.0, 4)
    np.testing.assert_allclose(law("inverse", 1.0 / 1024.0).run(x), x, atol=1e-16)


# ---- what is learnt -----------------------------------------------------------------------------


def follow(made: core.Law, sent: Floats, came: Floats) -> dict[str, Floats]:
    return made.follow(np.zeros_like(sent), sent, came)[1]


def excitation(fs_hz: float, duration_s: float = 8.0) -> Floats:
    t = np.arange(round(duration_s * fs_hz)) / fs_hz
    waves = np.sin(9.0 * t) + 0.6 * np.sin(23.0 * t) + 0.3 * np.sin(48.0 * t + 1.0)
    return np.asarray(0.005 * waves * (1.0 - np.exp(-((t / 0.5) ** 3))))


LOOSE = {"gain_sigma": 1.0, "delay_sigma_s": 0.1, "curvature_sigma_s2": 0.01}


@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize("fs_hz", [1024.0, 4096.0])
def test_gain_delay_and_curvature_of_a_rig_of_their_own_form_are_found(
    name: str, fs_hz: float
) -> None:
    h = 1.0 / fs_hz
    wanted = (1.06, 0.012 * fs_hz, 6e-5 * fs_hz**2)
    top, bottom = lead_filter(*wanted, h)
    sent = excitation(fs_hz)
    came = scipy.signal.lfilter(bottom, top, sent)
    own = dict(LOOSE)
    if name == "inverse":
        b = servo(h)
        own |= {"fit_roll_off_hz": FIT_HZ, **coefficients(b)}
        inverse_top, inverse_bottom = inverse_filter(b, h)
        came = scipy.signal.lfilter(inverse_bottom, inverse_top, came)
    found = follow(law(name, h, **own), sent, came)
    keys = (
        ("gain", "alpha", "beta") if name != "inverse" else ("gain", "delay_left", "curvature_left")
    )
    got = [found[key][-1] for key in keys]
    np.testing.assert_allclose(got, wanted, rtol=2e-3)


def expected_estimate(
    sent: Floats, came: Floats, h: float, noise_m: float, own: dict[str, float], start: Floats
) -> Floats:
    """The same once more: scipy's filters, sums instead of recursions; the last row."""
    w1, w2 = rigsettings.weights(own["roll_off_hz"], h)
    s = w1 + w2 + 1.0
    sections = scipy.signal.butter(2, own["cutoff_hz"], fs=1.0 / h, output="sos")

    def band(x: Floats, settled: bool) -> Floats:
        zi = scipy.signal.sosfilt_zi(sections) * (0.0 if settled else x[0])
        low = scipy.signal.sosfilt(sections, x, zi=zi)[0]
        level, weight = (0.0, h / 3.2) if settled else (x[0], 1.0)
        out = np.empty_like(low)
        for n, value in enumerate(low):
            level += (value - level) * weight
            out[n] = value - level
            weight = weight if settled else max(weight / (1.0 + weight), h / 3.2)
        return out

    def regressors(p: Floats, m: Floats) -> tuple[Floats, Floats]:
        e = np.concatenate([[0.0, 0.0], p - m])
        before = np.concatenate([[0.0, 0.0], m])
        slope, bend = np.diff(before)[1:], np.diff(before, 2)
        mu = w1 * e[2:] + w2 * e[1:-1] + e[:-2]
        return 1e3 * mu, 1e3 * s * np.column_stack([m, slope, bend])

    impulse = np.zeros(round(8.0 / h))
    impulse[0] = noise_m
    mu0, phi0 = regressors(np.zeros_like(impulse), band(impulse, True))
    noise_r, noise_q = phi0.T @ phi0, phi0.T @ mu0
    rest = float(np.sum((mu0 - phi0 @ start) ** 2))
    sigma = np.array(
        [own["gain_sigma"], own["delay_sigma_s"] / h, own["curvature_sigma_s2"] / h**2]
    )
    ridge = 0.5 / (own["cutoff_hz"] * h) * max(rest, 1e-12) / sigma**2
    mu, phi = regressors(band(sent, False), band(came, False))
    power = scipy.signal.lfilter([5.0 * h], [1.0, 5.0 * h - 1.0], phi[:, 1] ** 2)
    open_ = power > max(own["gate_factor"] * noise_r[1, 1], 1e-18)
    age = np.cumsum(open_[::-1])[::-1] - 1
    weights = np.where(open_, (1.0 - h / own["memory_s"]) ** age, 0.0)
    r, q = phi.T @ (weights[:, None] * phi), phi.T @ (weights * mu)
    total = weights.sum()
    shares = [0.5 * r[i, i] / (total * noise_r[i, i]) for i in range(3) if noise_r[i, i] > 0.0]
    share = min([1.0, *shares])
    left = r - share * total * noise_r + np.diag(ridge)
    return np.asarray(np.linalg.solve(left, q - share * total * noise_q + ridge * start))


@pytest.mark.parametrize("fs_hz", [512.0, 1024.0])
@pytest.mark.parametrize("noise_m", [0.0, 8e-6, 1e-4])
def test_the_estimate_is_numpys_least_squares_less_noise_with_its_prior(
    fs_hz: float, noise_m: float
) -> None:
    h = 1.0 / fs_hz
    own = {
        "roll_off_hz": 30.0, "cutoff_hz": 10.0, "gate_factor": 10.0, "memory_s": 1.0,
        "gain_sigma": 0.05, "delay_sigma_s": 0.004, "curvature_sigma_s2": 1.6e-5,
    }  # fmt: skip
    start = np.array([-0.02, 0.015 * fs_hz, 1e-4 * fs_hz**2])
    top, bottom = lead_filter(0.95, 0.017 * fs_hz, 1.1e-4 * fs_hz**2, h)
    rng = np.random.default_rng(5)
    sent = excitation(fs_hz, 6.0)
    came = scipy.signal.lfilter(bottom, top, sent) + noise_m * rng.normal(size=sent.size)
    first = {"gain0": 0.98, "delay0_s": 0.015, "curvature0_s2": 1e-4}
    found = follow(law("gain-alpha-beta", h, noise_m, **own, **first), sent, came)
    got = np.array([found["gain"][-1] - 1.0, found["alpha"][-1], found["beta"][-1]])
    expected = expected_estimate(sent, came, h, noise_m, own, start)
    np.testing.assert_allclose(got, expected, rtol=1e-5, atol=1e-7)
    assert not np.allclose(got, start, rtol=1e-3)


def test_a_command_that_the_limiter_held_back_teaches_nothing_false() -> None:
    """The pair is the drive's own command and what came of it, not what the law had asked for."""
    h = 1.0 / 1024.0
    b = servo(h)
    top, bottom = inverse_filter(b, h)
    x = excitation(1024.0)
    sent = np.clip(law("inverse", h, fit_roll_off_hz=FIT_HZ, **coefficients(b)).run(x), -4e-3, 4e-3)
    came = scipy.signal.lfilter(bottom, top, sent)
    made = law("inverse", h, fit_roll_off_hz=FIT_HZ, **coefficients(b), **LOOSE)
    found = made.follow(x, sent, came)[1]
    assert np.abs(found["gain"] - 1.0).max() < 1e-3
    assert np.abs(found["delay_left"]).max() < 1e-2


def test_noise_alone_moves_nothing() -> None:
    rng = np.random.default_rng(3)
    came = 8e-6 * rng.normal(size=20_000)
    for name in LAWS:
        made = law(name, 1.0 / 1024.0, 8e-6)
        first = made.report()
        follow(made, np.zeros_like(came), came)
        assert made.report() == first


def test_bounds_hold_whatever_comes_back() -> None:
    rng = np.random.default_rng(4)
    sent = excitation(1024.0)
    bounds = {"gain_most": 0.2, "delay_least_s": -0.01, "delay_most_s": 0.02}
    made = law("inverse", 1.0 / 1024.0, **bounds, **LOOSE)
    found = follow(made, sent, 0.05 * rng.normal(size=sent.size))
    assert np.abs(found["gain"] - 1.0).max() <= 0.2 + 1e-12
    assert -10.24 - 1e-9 <= found["delay_left"].min() <= found["delay_left"].max() <= 20.48 + 1e-9
    assert np.abs(found["curvature_left"]).max() <= 0.5 * 20.48**2 * (1 + 1e-9)


# ---- what is refused ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        (
            'type = "inverse"\ninverse = { delay_least_s = 0.06 }',
            "delay_most_s = 0.0585938 s, its default; must be greater than delay_least_s = 0.06 s",
        ),
        (
            'type = "inverse"\ninverse = { delay_least_s = 0.02, delay_most_s = 0.01 }',
            "delay_most_s = 0.01 s; must be greater than delay_least_s = 0.02 s",
        ),
        (
            'type = "inverse"\ninverse = { b0 = 0, b1 = 0, b2 = 0, b3 = -1, b4 = 0, b5 = 0 }',
            "rig as fitted is unstable",
        ),
        (
            'type = "inverse"\ninverse = { b0 = 0 }',
            "found b0 without b1, b2, b3, b4, b5; the coefficients of the inverse belong together",
        ),
        (
            'type = "inverse"\ninverse = { b0 = 0, b1 = 0.02, b2 = 0, b4 = 0, b5 = 0 }',
            "found b0, b1, b2, b4, b5 without b3;",
        ),
        ('type = "gain-alpha-beta"\ngain_alpha_beta = { gain0 = 1.5 }', "within gain_most"),
        ('type = "gain-alpha-beta"\ngain_alpha_beta = { delay0_s = 0.07 }', "to delay_most_s"),
        (
            'type = "gain-alpha-beta"\ngain_alpha_beta = { curvature0_s2 = 0.01 }',
            "half of delay_most_s squared",
        ),
        ('type = "inverse"\ninverse = { memory_s = 0.01 }', "from 0.05 to 600 s"),
        ('type = "inverse"\ninverse = { gain_sigma = 0 }', "above 0"),
    ],
)
def test_settings_that_do_not_fit_are_named(lines: str, complaint: str) -> None:
    with pytest.raises(InputError) as caught:
        config.parse_test(f"{TEST}[controller]\n{lines}\n", "test.toml")
    assert complaint in str(caught.value)


@pytest.mark.parametrize("key", ["roll_off_hz", "cutoff_hz", "fit_roll_off_hz"])
def test_a_frequency_beyond_half_the_rate_is_named_with_the_rate(key: str) -> None:
    text = TEST.replace('"t"', '"t", sample_rate_hz = 512')
    rig = config.load_rig(config.shipped_rig("rths-benchmark"))
    keys = f'type = "inverse"\ninverse = {{ {key} = 300 }}'
    test = config.parse_test(f"{text}[controller]\n{keys}\n")
    with pytest.raises(InputError, match=r"below half of test\.sample_rate_hz = 512 Hz"):
        config.derive(test, rig)


NO_INVERSE = "{ b0 = 0, b1 = 0, b2 = 0, b3 = 0, b4 = 0, b5 = 0 }"


@pytest.mark.parametrize("rig_name", ["shaking-table-portal-frame", "rths-benchmark"])
def test_coefficients_that_are_all_zero_are_refused_with_and_without_a_response(
    rig_name: str,
) -> None:
    rig = config.load_rig(config.shipped_rig(rig_name))
    for bare in (False, True):
        if bare and rig.identified is not None:
            none = {"frequency_hz": [], "amplitude": [], "delay_at_frequency_s": []}
            rig = rig.model_copy(update={"identified": rig.identified.model_copy(update=none)})
        keys = f'type = "inverse"\ninverse = {NO_INVERSE}'
        test = config.parse_test(f"{TEST}[controller]\n{keys}\n", "test.toml")
        with pytest.raises(InputError, match="all 0, which is no inverse"):
            config.derive(test, rig)


@pytest.mark.parametrize("given", [{}, {"b0": 0.0}, {f"b{j}": 0.0 for j in range(5)}])
def test_an_incomplete_inverse_never_replaces_the_fit_to_the_response(
    given: dict[str, float],
) -> None:
    """Settings that did not come from a file: a rig without a response is refused nevertheless."""
    bare = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    rig = config.load_rig(config.shipped_rig("rths-benchmark"))
    assert bare.identified is not None
    none = {"frequency_hz": [], "amplitude": [], "delay_at_frequency_s": []}
    bare = bare.model_copy(update={"identified": bare.identified.model_copy(update=none)})
    test = config.parse_test(f'{TEST}[controller]\ntype = "inverse"\n')
    own = test.controller.with_settings({f"inverse.{key}": value for key, value in given.items()})
    test = test.model_copy(update={"controller": own})
    with pytest.raises(InputError, match="needs the identified response"):
        config.derive(test, bare)
    fitted = config.derive(test, rig).law_settings
    assert abs(fitted["inverse.b1"] - rig.identified.delay_s) < 0.1 * rig.identified.delay_s


def test_a_run_without_phase_lead_can_be_repeated_from_its_resolved_test() -> None:
    """Its inverse was never fitted, and is written out as zeros."""
    rig = config.load_rig(config.shipped_rig("shaking-table-portal-frame"))
    test = config.parse_test(f'{TEST}[controller]\ntype = "inverse"\nplc_enabled = false\n')
    resolved = config.resolve(test, config.derive(test, rig))
    assert resolved.controller.setting("inverse.b1") == 0.0
    config.derive(resolved, rig)


@pytest.mark.parametrize("name", LAWS)
def test_a_setting_that_is_no_number_is_refused_by_the_core(name: str) -> None:
    for key in ALL_LAWS[name].parameters:
        for bad in (math.nan, math.inf, -math.inf):
            with pytest.raises(core.CoreError):
                core.Law(core.LawConfig(name, {key.key: bad}))


# ---- on the benchmark's transfer system ---------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 7003])
@pytest.mark.parametrize("name", LAWS)
def test_frame_of_the_benchmark_is_followed_to_half_a_percent(name: str, seed: int | None) -> None:
    """Without the sensor's noise; the plant is the identified one, or another drawn at random."""
    rig = rths_benchmark.nominal() if seed is None else rths_benchmark.drawn(seed)
    more = {
        "controller.type": name,
        "numerical.matrices.integrator": "rk4",
        "limits.force_n": "8.9 kN",
        "ground_motion.duration_s": "20",
        "test.free_vibration_s": "0",
    }
    test = config.load_test(EXAMPLE, more)
    setup = experiment.prepare(test, rig)
    assert setup.derived.force_lateness_s == pytest.approx(0.5 / 1024.0)
    assert setup.derived.rfc_cutoff_hz == rig.identified.roll_off_hz  # type: ignore[union-attr]
    rec = virtual_time.run(setup, truth=True)
    assert rec.meta["end_reason"] == "completed"
    rows = rec.samples[rec.samples["state"] == recording.RUNNING][: setup.ticks]
    wanted = rows["x_num_m"]
    error = np.std(rows["x_true_m"] - wanted) / np.std(wanted)
    assert error < (0.002 if name == "inverse" else 0.006)
    reference = setup.reference["x_ref_m"]
    assert np.std(wanted - reference) / np.std(reference) < 0.004
