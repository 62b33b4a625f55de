"""Small recordings with a known truth, computed independently of the package: a lag by matrix
exponential, force laws in numpy."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import numpy as np
from scipy import signal

FS = 256.0
"""Rows per second: few, but enough for a lag of 28 Hz. Cases at the core's rate set their own."""
K, C, M = 5.0e5, 1500.0, 40.0
DELAY, F_HZ, ZETA = 0.0052, 28.0, 0.9
FINE = 32  # steps per row
X_STD, F_STD = 3.0e-6, 15.0


def command(kind: str = "sweep", seconds: float = 8.0, amplitude: float = 7e-3) -> np.ndarray:
    """Return a command, (n,), m."""
    t = np.arange(int(seconds * FS)) / FS
    if kind == "sine":
        return amplitude * np.sin(2 * np.pi * 1.5 * t + 0.4)
    if kind == "triangle":
        return amplitude * signal.sawtooth(2 * np.pi * 0.6 * t + np.pi / 2, 0.5)
    phase = 2 * np.pi * (0.3 * t + 0.5 * (4.0 - 0.3) / seconds * t**2)
    rise = np.clip(t / 0.5, 0.0, 1.0)
    return amplitude * rise * np.sin(phase)


def moved(u: np.ndarray, delay: float = DELAY, gain: float = 1.0, fine: int = FINE):
    """Return x, v, a of the actuator at the rows, from rest; the command is interpolated linearly.

    Most cases share one command: each motion is computed once, and is read-only.
    """
    return _moved(u.tobytes(), delay, gain, fine)


@cache
def _moved(command: bytes, delay: float, gain: float, fine: int) -> tuple[np.ndarray, ...]:
    u = np.frombuffer(command)
    n = u.size
    t = np.arange((n - 1) * fine + 1) / (FS * fine)
    late = np.interp(t - delay, np.arange(n) / FS, u)
    w = 2 * np.pi * F_HZ
    system = signal.StateSpace(
        [[0, 1], [-(w**2), -2 * ZETA * w]], [[0], [gain * w**2]], np.eye(2), np.zeros((2, 1))
    )
    _, y, _ = signal.lsim(system, late, t, X0=[gain * late[0], 0.0])
    a = w**2 * (gain * late - y[:, 0]) - 2 * ZETA * w * y[:, 1]
    found = tuple(np.ascontiguousarray(z[::fine]) for z in (y[:, 0], y[:, 1], a))
    for z in found:
        z.flags.writeable = False
    return found


def baseline(**changes: object) -> str:
    """Return the text of a baseline file; ``changes`` replace its numbers."""
    values: dict[str, object] = {
        "k": K, "c": C, "moving_mass": M, "k_tol": 0.01, "c_tol": 0.15, "family": '"drive"',
        "fs_hz": FS,
    } | changes  # fmt: skip
    return "\n".join(
        [
            'schema = "rthyb-baseline/1"',
            f"family = {values['family']}",
            f"fs_hz = {values['fs_hz']}",
            "[specimen]",
            *(f"{k} = {values[k]}" for k in ("k", "c", "moving_mass", "k_tol", "c_tol")),
            "[actuator]",
            f"delay_s = {DELAY}",
            f"f_hz = {F_HZ}",
            f"zeta = {ZETA}",
            "gain = 1.0",
            "[noise]",
            f"x_std = {X_STD}",
            f"f_std = {F_STD}",
        ]
    )


def rig(actuator: str = "", more: str = "") -> str:
    """Return the text of a rig file with a spring and an actuator; ``more`` extends the specimen.

    ``actuator``: further lines of the actuator's table.
    """
    return f"""schema = "rthyb-rig/1"
[rig]
name = "lab"
elastic_stiffness_n_per_m = 5e5
[actuator]
kind = "second-order"
natural_frequency_hz = 30
damping_ratio = 0.8
delay_s = 0.004
{actuator}
[[specimen]]
element = "stiffness"
k_n_per_m = 5e5
{more}"""


def channels(extra=None, *, kind: str = "sweep", delay: float = DELAY, seed: int = 1,
             amplitude: float = 7e-3) -> dict[str, np.ndarray]:  # fmt: skip
    """Return t, x_cmd, x_meas, f_meas; ``extra(t, x, v, a)`` is missing from the model, N."""
    rng = np.random.default_rng(seed)
    u = command(kind, amplitude=amplitude)
    x, v, a = moved(u, delay)
    t = np.arange(u.size) / FS
    f = K * 1.004 * x + C * 0.95 * v + M * a
    if extra is not None:
        f = f + extra(t, x, v, a)
    return {
        "t": t,
        "x_cmd": u,
        "x_meas": x + X_STD * rng.standard_normal(u.size),
        "f_meas": f + F_STD * rng.standard_normal(u.size),
    }


def write(folder: Path, columns: dict[str, np.ndarray], model: str | None = None):
    """Write recording.csv and baseline.toml; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    recording, toml = folder / "recording.csv", folder / "baseline.toml"
    np.savetxt(
        recording, np.column_stack(list(columns.values())), delimiter=",", comments="",
        header=",".join(columns), fmt="%.9g",
    )  # fmt: skip
    toml.write_text(model if model is not None else baseline(), encoding="utf-8")
    return recording, toml
