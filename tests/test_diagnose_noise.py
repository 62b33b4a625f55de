"""Diagnosis where the noise is of another colour than white, and where nothing pushes a body."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

from rthyb_rt.diagnose import engine, reading, result

FS_HZ, K, C, M = 512.0, 4e5, 1200.0, 30.0
X_STD, F_STD = 1.5e-6, 6.0
F_HZ, ZETA, LATE_S = 25.0, 0.8, 0.004


def red(random: np.random.Generator, size: int, std: float) -> np.ndarray:
    """Noise of which most lies below 40 Hz: half of its power in white, half through a lag."""
    slow = lfilter([1.0], [1.0, -0.8], random.standard_normal(size + 200))[200:]
    slow /= np.std(slow)
    return std * (0.7 * slow + 0.714 * random.standard_normal(size))


def motion(fs_hz: float, late_s: float = LATE_S) -> tuple[np.ndarray, ...]:
    """Command, displacement, velocity, acceleration of a second-order lag, by its closed form."""
    t = np.arange(int(14.0 * fs_hz)) / fs_hz
    u, x, v, a = (np.zeros(t.size) for _ in range(4))
    w0 = 2.0 * np.pi * F_HZ
    for f_hz, size, phase in ((0.7, 4e-3, 0.0), (1.9, 2e-3, 1.0), (3.3, 1e-3, 2.0)):
        w = 2.0 * np.pi * f_hz
        gain = w0**2 / (w0**2 - w**2 + 2j * ZETA * w0 * w) * np.exp(-1j * w * late_s)
        turning = size * np.exp(1j * (w * t + phase))
        u += turning.imag
        for n, out in enumerate((x, v, a)):
            out += (gain * turning * (1j * w) ** n).imag
    return t, u, x, v, a


def written(folder: Path, columns: dict[str, np.ndarray], baseline: str) -> result.DiagnosisResult:
    table = np.column_stack(list(columns.values()))
    np.savetxt(folder / "r.csv", table, delimiter=",", header=",".join(columns), comments="")
    (folder / "b.toml").write_text(baseline, encoding="utf-8")
    return engine.diagnose(
        reading.read_case(folder / "r.csv", reading.read_model(folder / "b.toml"))
    )


DRIVE = f"""
schema = "rthyb-baseline/1"
family = "drive"
fs_hz = {FS_HZ}
[specimen]
k = {K}
c = {C}
moving_mass = {M}
k_tol = 0.01
c_tol = 0.15
[actuator]
delay_s = {LATE_S}
f_hz = {F_HZ}
zeta = {ZETA}
gain = 1.0
[noise]
x_std = {X_STD}
f_std = {F_STD}
"""


@pytest.mark.long
def test_red_noise_of_the_displacement_within_its_sheet_is_no_unknown_law(tmp_path):
    """What the sheet allows for is noise of any colour: the friction on the force has its name."""
    random = np.random.default_rng(1)
    t, u, x, v, a = motion(FS_HZ)
    force = K * x + C * v + M * a + 150.0 * np.tanh(v / 1e-3)
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + red(random, t.size, X_STD),
        "f_meas": force + F_STD * random.standard_normal(t.size),
    }
    d = written(tmp_path, columns, DRIVE)
    assert (d.verdict, d.effects) == ("explained", ["coulomb"])
    assert d.candidates[0].params["Fc_N"] == pytest.approx(150.0, rel=0.05)


@pytest.mark.long
def test_displacement_that_leaves_thrice_its_sheet_is_not_taken_for_noise(tmp_path):
    """A burst that no actuator of the catalogue makes is located, sheet or no sheet."""
    random = np.random.default_rng(4)
    t, u, x, v, a = motion(FS_HZ)
    bump = 4e-5 * np.exp(-(((t - 7.0) / 0.4) ** 2)) * np.sin(2.0 * np.pi * 11.0 * t)
    columns = {
        "t": t,
        "x_cmd": u,
        "x_meas": x + bump + red(random, t.size, X_STD),
        "f_meas": K * x + C * v + M * a + F_STD * random.standard_normal(t.size),
    }
    d = written(tmp_path, columns, DRIVE)
    assert d.verdict == "unknown"
    assert any(begin < 7.0 < end for begin, end in d.windows)


@pytest.mark.long
def test_free_decay_of_a_naive_pendulum_is_no_agreement(tmp_path):
    """Nothing pushes: with mass, stiffness and damping all free, all of them zero would agree."""
    m, k, c, k3 = 2.0, 80.0, 0.3, -90.0
    t = np.arange(4000) / 200.0

    def rate(_: float, y: np.ndarray) -> list[float]:
        return [y[1], -(k * y[0] + c * y[1] + k3 * y[0] ** 3) / m]

    done = solve_ivp(rate, (0.0, t[-1]), [0.35, 0.0], t_eval=t, rtol=1e-10, atol=1e-12)
    x = done.y[0] + 2e-5 * np.random.default_rng(5).standard_normal(t.size)
    naive = f"""
schema = "rthyb-baseline/1"
family = "forced"
fs_hz = 200
[specimen]
k = {0.9 * k}
c = {0.8 * c}
moving_mass = {m}
[noise]
x_std = 2e-5
"""
    d = written(tmp_path, {"t": t, "f_in": np.zeros(t.size), "x_meas": x}, naive)
    assert (d.verdict, d.effects) == ("explained", ["cubic"])
    assert d.candidates[0].params["k3_N_m3"] == pytest.approx(k3, rel=0.1)
    assert d.fit["nrmse_before"] > 0.02
