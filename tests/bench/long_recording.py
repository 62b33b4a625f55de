"""Recordings for timing the diagnosis: repeated sweeps with a lag and missing dry friction."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rthyb_rt import core

K, C = 5.0e5, 1500.0
DELAY_SAMPLES, F_HZ, ZETA = 4.0, 30.0, 0.8
X_STD, F_STD = 3e-6, 15.0


def write(folder: Path, seconds: float) -> tuple[Path, Path]:
    """Write recording.csv and baseline.toml of a driven specimen; return their paths.

    Sweeps of eight seconds follow one another, at five amplitudes in turn; the specimen has dry
    friction of 130 N that the model lacks.
    """
    rows = round(seconds * core.FS_HZ)
    config = core.RigConfig(
        core.ServoConfig(
            "second-order", hold="foh", natural_frequency_hz=F_HZ, damping_ratio=ZETA, gain=1.0,
            delay_samples=DELAY_SAMPLES,
        ),
        (
            core.element("stiffness", k_n_per_m=K),
            core.element("viscous", c_n_s_per_m=C),
            core.element("coulomb", fc_n=130.0, width_m_per_s=5e-4),
        ),
        core.SensorConfig(X_STD),
        core.SensorConfig(F_STD),
        seed=5,
    )  # fmt: skip
    u = _command(rows)
    x, f = core.VirtualRig(config).run(u)
    recording, model = folder / "recording.csv", folder / "baseline.toml"
    np.savetxt(
        recording, np.column_stack([np.arange(rows) / core.FS_HZ, u, x, f]), delimiter=",",
        comments="", header="t,x_cmd,x_meas,f_meas", fmt="%.9g",
    )  # fmt: skip
    model.write_text(
        f"""schema = "rthyb-baseline/1"
family = "drive"
fs_hz = {core.FS_HZ}
[specimen]
k = {K}
c = {C}
k_tol = 0.01
c_tol = 0.15
[actuator]
delay_s = {DELAY_SAMPLES / core.FS_HZ}
f_hz = {F_HZ}
zeta = {ZETA}
[noise]
x_std = {X_STD}
f_std = {F_STD}
""",
        encoding="utf-8",
    )
    return recording, model


def _command(rows: int) -> np.ndarray:
    length = round(8.0 * core.FS_HZ)
    t = np.arange(length) / core.FS_HZ
    sweep = np.sin(2 * np.pi * (0.3 * t + 0.5 * 3.7 / 8.0 * t**2))
    sweep *= np.clip(t / 0.5, 0.0, 1.0) * np.clip((8.0 - t) / 0.5, 0.0, 1.0)
    count = -(-rows // length)
    return np.concatenate([(3 + n % 5) * 1e-3 * sweep for n in range(count)])[:rows]
