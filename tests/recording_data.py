"""Synthetic recordings for the tests: a damped structure under a ground motion, with a lag."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import FLAGS, RUNNING
from rthyb_rt.record.recording import REFERENCE_UNITS, RecordedTest, ReplayData

FS_HZ = 1024.0
K_E = 666400.0

RECORD_DTYPE = np.dtype(
    [
        ("tick", np.uint64),
        ("due_ns", np.int64),
        ("wake_late_ns", np.int32),
        ("sent_late_ns", np.int32),
        ("flags", np.uint32),
        ("generation", np.uint32),
        ("code", np.uint16),
        ("state", np.uint16),
        ("cause", np.uint32),
        ("ag_mps2", np.float64),
        ("x_num_m", np.float64),
        ("x_plc_m", np.float64),
        ("alpha", np.float64),
        ("beta", np.float64),
        ("k_t_n_per_m", np.float64),
        ("energy_error_j", np.float64),
        ("tracking_indicator_m2", np.float64),
        ("x_read_m", np.float64),
        ("f_read_n", np.float64),
        ("x_cmd_m", np.float64),
        ("x_meas_m", np.float64),
        ("f_meas_n", np.float64),
        ("missing", np.uint32),
        ("echo", np.uint16),
        ("count", np.uint16),
    ]
)

TEST_TOML = """schema = "rthyb-test/1"

[test]
name = "portal-frame-0.5s"
description = "Portal frame, T = 0.5 s, El Centro 1940 NS at 0.04 g"
free_vibration_s = 10.0

[ground_motion]
record = "elcentro-1940-ns"
format = "auto"
pga_g = 0.04
start_s = 0.0
interpolation = "band-limited"

[numerical]
mass_kg = 4220.0
damping_n_s_per_m = 2121.0
stiffness_n_per_m = 0.0
integrator = "central-difference"

[controller]
type = "paper"
w1 = 3.0
w2 = 2.0
alpha0 = 17.0

[controller.delay_estimator]
enabled = true
gain_per_mm2_per_sample = 0.03
alpha_min = 0.0
alpha_max = 60.0

[controller.rfc]
enabled = true
window_periods = 0.1
tangent = "mean-of-ratios"
divisor = "printed"

[limits.tracking_error_m]
value = 0.005
enable = true
action = "trip"
"""

RIG_TOML = """schema = "rthyb-rig/1"

[rig]
name = "table-and-plate"
description = "Shaking table pushing a steel plate"
command_hold = "zoh"
command_shift_s = 0.0
seed = 0
load_cell = "actuator-end"
elastic_stiffness_n_per_m = 666400.0

[actuator]
kind = "servo-hydraulic"
kp_per_s = 63.5
ki_per_s2 = 6.0

[[specimen]]
element = "stiffness"
k_n_per_m = 666400.0

[identified]
alpha = 17.0
delay_s = 0.0166
gain = 0.98
"""


def structure(ag: NDArray[np.float64], period_s: float = 0.5) -> NDArray[np.float64]:
    """Displacement of a 2 % damped structure by central differences, m."""
    h, w = 1.0 / FS_HZ, 2.0 * np.pi / period_s
    a, b = 1.0 / h**2 + 0.02 * w / h, 1.0 / h**2 - 0.02 * w / h
    x = np.zeros(ag.size + 1)
    for n in range(1, ag.size):
        x[n + 1] = (-ag[n] + (2.0 / h**2 - w**2) * x[n] - b * x[n - 1]) / a
    return x[: ag.size]


def ground_motion(duration_s: float, seed: int = 1) -> NDArray[np.float64]:
    """Filtered noise under an envelope, peak 0.04 g, 10 s of rest at the end, m/s^2."""
    rng = np.random.default_rng(seed)
    n = round(duration_s * FS_HZ)
    t = np.arange(n) / FS_HZ
    spectrum = np.fft.rfft(rng.standard_normal(n))
    f = np.fft.rfftfreq(n, 1.0 / FS_HZ)
    spectrum *= np.where(f > 0.2, 1.0, 0.0) / (1.0 + (f / 4.0) ** 4)
    shaking = max(duration_s - 10.0, 0.6 * duration_s)
    shape = np.minimum(t / 2.0, 1.0) * np.exp(-np.maximum(t - 5.0, 0.0) / 7.0) * (t < shaking)
    ag = np.fft.irfft(spectrum, n) * shape
    peak = np.max(np.abs(ag), initial=0.0)
    return ag * (0.04 * 9.80665 / peak if peak > 0.0 else 0.0)


def shifted(x: NDArray[np.float64], samples: float) -> NDArray[np.float64]:
    """The signal delayed by a fractional number of samples."""
    n = np.arange(x.size)
    return np.interp(n - samples, n, x)


def recording(duration_s: float = 40.0, *, reference: bool = True, seed: int = 1) -> RecordedTest:
    """A completed test: lag of 1.3 samples, friction in the loop, a drifting delay estimate."""
    rng = np.random.default_rng(seed)
    ag = ground_motion(duration_s, seed)
    n = ag.size
    x_ref = structure(ag)
    x_num = structure(ag, 0.5003) if n > 10 else x_ref.copy()
    x_meas = 0.995 * shifted(x_num, 1.3) + 2e-6 * rng.standard_normal(n)
    velocity = np.gradient(x_meas) * FS_HZ if n > 1 else np.zeros(n)
    samples = np.zeros(n, dtype=RECORD_DTYPE)
    samples["tick"] = np.arange(n)
    samples["due_ns"] = np.arange(n) * 1953125 // 2
    samples["flags"] = FLAGS["fresh"]
    samples["state"] = RUNNING
    samples["ag_mps2"] = ag
    samples["x_num_m"] = x_num
    samples["x_plc_m"] = shifted(x_num, -17.0)
    samples["x_cmd_m"] = samples["x_plc_m"]
    samples["x_meas_m"] = x_meas
    samples["f_meas_n"] = (
        K_E * x_meas + 80.0 * np.tanh(velocity / 5e-4) + 20.0 * rng.standard_normal(n)
    )
    t = np.arange(n) / FS_HZ
    samples["alpha"] = 17.0 + 0.9 * (1.0 - np.exp(-t / 4.0)) + 0.4 * np.sin(0.9 * t)
    noise = np.convolve(rng.standard_normal(n), np.ones(200) / 14.0, "same")
    samples["k_t_n_per_m"] = np.clip(K_E * (0.8 + 0.5 * noise), 0.0, K_E)
    samples["k_t_n_per_m"][:102] = K_E
    table = None
    if reference:
        table = np.zeros(n, dtype=[(name, np.float64) for name in REFERENCE_UNITS])
        table["x_ref_m"], table["f_ref_n"] = x_ref, K_E * x_ref
    return RecordedTest(
        samples=samples,
        fs_hz=FS_HZ,
        ag_mps2=ag,
        ground_motion={
            "name": "El Centro 1940 NS",
            "source": "Imperial Valley, 18 May 1940, station 117, component S00E",
            "pga_g": 0.04,
            "scale": 0.1254705,
        },
        reference=table,
        test_toml=TEST_TOML,
        rig_toml=RIG_TOML,
        replay=ReplayData(
            codec=bytes(range(256)),
            parameters=[{"generation": 0, "tick": 0, "values": {"w1": 3.0, "w2": 2.0}}],
            commands=[{"tick": 0, "command": "start"}],
            tares={"displacement_m": 1e-6, "force_n": 0.5},
        ),
        meta=meta(),
    )


def meta(**changes: Any) -> dict[str, Any]:
    """The root attributes of a completed test."""
    return {
        "created_utc": "2024-05-17T09:30:00Z",
        "rthyb_version": "0.1.0",
        "core_version": "1",
        "compiler": "gcc 12.2.0",
        "architecture": "x86_64",
        "git_hash": "0123abc",
        "test_name": "portal-frame-0.5s",
        "clock": "virtual",
        "end_reason": "completed",
        "interrupted": False,
    } | changes
