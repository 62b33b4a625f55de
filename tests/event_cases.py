"""Recordings of a rig on which something changes in mid-test, computed without the package.

The actuator is simulated on a fine grid with parameters that change at one time, its state being
continuous; the load cell changes at that time, too. Every number is drawn from a seed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.linalg import expm
from scipy.signal import StateSpace, butter, lsim, sosfiltfilt

FINE = 32


@dataclass
class Rig:
    """A drive rig with its sensors, an excitation, and the time of an event."""

    random: np.random.Generator
    seconds: float = 12.0
    fs_hz: float = 0.0
    k: float = 0.0
    c: float = 0.0
    mass: float = 0.0
    delay_s: float = 0.0
    f_hz: float = 0.0
    zeta: float = 0.0
    x_std: float = 0.0
    f_std: float = 0.0
    t0: float = 0.0
    t: np.ndarray = field(default_factory=lambda: np.zeros(0))
    command: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def lag(self) -> dict[str, float]:
        return {"delay_s": self.delay_s, "f_hz": self.f_hz, "zeta": self.zeta, "gain": 1.0,
                "vmax": np.inf}  # fmt: skip


def rig(seed: int, fs_hz: float = 256.0) -> Rig:
    """A rig with numbers drawn from a seed; the event is in the middle third of the test."""
    random = np.random.default_rng([20_26, seed])
    u = random.uniform
    out = Rig(random, fs_hz=fs_hz)
    out.k, out.mass = np.exp(u(*np.log((2e5, 2e6)))), u(10.0, 60.0)
    out.c = u(0.002, 0.004) * out.k
    out.delay_s, out.f_hz, out.zeta = u(0.003, 0.008), u(20.0, 38.0), u(0.6, 1.0)
    out.t = np.arange(round(out.seconds * out.fs_hz)) / out.fs_hz
    out.t0 = out.seconds * u(0.35, 0.65)
    out.command = u(0.004, 0.012) * shape(
        out.t, str(random.choice(["random", "cyclic", "sweep"])), random
    )
    out.x_std = float(np.std(out.command)) * u(2e-4, 6e-4)
    out.f_std = out.k * float(np.std(out.command)) * u(0.003, 0.008)
    return out


def band(t: np.ndarray, low: float, high: float, random: np.random.Generator) -> np.ndarray:
    """Random motion of rms 1 in a band, faded in and out."""
    sos = butter(3, [low, high], "bandpass", fs=1.0 / (t[1] - t[0]), output="sos")
    y = sosfiltfilt(sos, random.standard_normal(t.size)) * fade(t)
    return y / np.std(y)


def fade(t: np.ndarray) -> np.ndarray:
    return np.sin(0.5 * np.pi * np.clip(np.minimum(t, t[-1] - t) / 0.6, 0.0, 1.0)) ** 2


def shape(t: np.ndarray, kind: str, random: np.random.Generator) -> np.ndarray:
    """A command of peak 1."""
    if kind == "random":
        y = band(t, 0.3, 3.0, random)
    elif kind == "sweep":
        f0, f1 = random.uniform(0.3, 0.5), random.uniform(3.0, 4.5)
        y = np.sin(2 * np.pi * (f0 * t + 0.5 * (f1 - f0) / t[-1] * t**2)) * fade(t)
    else:
        f = random.uniform(0.8, 1.4)
        y = (0.6 + 0.4 * np.sin(2 * np.pi * 0.11 * t)) * np.sin(2 * np.pi * f * t) * fade(t)
        y += 0.25 * np.sin(2 * np.pi * 2.7 * f * t + 1.0) * fade(t)
    return y / np.max(np.abs(y))


def moved(bench: Rig, before: dict[str, float], after: dict[str, float]) -> np.ndarray:
    """x, v, a at the rows, (3, n): lag exact over fine steps, with other parameters from t0 on."""
    h = 1.0 / (FINE * bench.fs_hz)
    n = (bench.t.size - 1) * FINE + 1
    fine = np.arange(n) * h
    first = int(np.searchsorted(fine, bench.t0))
    out = np.zeros((3, n))
    state, held = np.zeros(2), 0.0
    for numbers, start, stop in ((before, 0, first), (after, first, n)):
        w, d = 2 * np.pi * numbers["f_hz"], 4 * np.pi * numbers["f_hz"] * numbers["zeta"]
        # Exact if the target is constant at its mean over a step.
        whole = expm(np.array([[0, 1, 0], [-w * w, -d, w * w], [0, 0, 0]]) * h)
        late = numbers["gain"] * np.interp(fine - numbers["delay_s"], bench.t, bench.command)
        most = numbers["vmax"] * h
        for i in range(start, stop):
            target = held + min(max(late[i] - held, -most), most)
            out[0, i], out[1, i] = state
            out[2, i] = w * w * (target - state[0]) - d * state[1]
            following = late[min(i + 1, n - 1)]
            then = target + min(max(following - target, -most), most)
            state = whole[:2, :2] @ state + whole[:2, 2] * 0.5 * (target + then)
            held = target
    return out[:, ::FINE]


Extra = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def recorded(
    bench: Rig,
    folder: Path,
    law: Extra | None = None,
    cell: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None,
    before: dict[str, float] | None = None,
    after: dict[str, float] | None = None,
    fy_std: float = 0.0,
) -> tuple[Path, Path]:
    """Write recording and baseline; return their paths.

    Args:
        bench: the rig.
        folder: output folder.
        law: force of the specimen missing from the model, a function of (t, x, v, a).
        cell: reading of the load cell, a function of (force, orthogonal force).
        before, after: changes of the actuator relative to the model, up to t0 and from then on.
        fy_std: noise of the orthogonal load cell relative to its signal.
    """
    random, t = bench.random, bench.t
    before = before or {}
    x, v, a = moved(bench, bench.lag | before, bench.lag | before | (after or {}))
    error = np.clip(random.standard_normal(2), -1.5, 1.5)
    force = bench.k * (1 + 0.01 * error[0]) * x + bench.c * (1 + 0.15 * error[1]) * v
    force += bench.mass * a
    if law is not None:
        force = force + law(t, x, v, a)
    fy = 0.6 * np.std(force) * band(t, 0.3, 4.0, random)
    shown = cell(force, fy) if cell else force
    columns = {
        "t": t, "x_cmd": bench.command,
        "x_meas": x + bench.x_std * random.standard_normal(t.size),
        "f_meas": shown + bench.f_std * random.standard_normal(t.size),
        "fy_meas": fy + (fy_std * np.std(fy) + 0.3 * bench.f_std) * random.standard_normal(t.size),
    }  # fmt: skip
    return written(folder, columns, baseline(bench))


def baseline(bench: Rig) -> str:
    """The laboratory's model of the rig."""
    return f"""schema = "rthyb-baseline/1"
family = "drive"
fs_hz = {bench.fs_hz}
[specimen]
k = {bench.k}
c = {bench.c}
moving_mass = {bench.mass}
k_tol = 0.01
c_tol = 0.15
[actuator]
delay_s = {bench.delay_s}
f_hz = {bench.f_hz}
zeta = {bench.zeta}
gain = 1.0
[noise]
x_std = {bench.x_std}
f_std = {bench.f_std}
"""


def written(folder: Path, columns: dict[str, np.ndarray], model: str) -> tuple[Path, Path]:
    folder.mkdir(parents=True, exist_ok=True)
    recording, toml = folder / "recording.csv", folder / "baseline.toml"
    np.savetxt(recording, np.column_stack(list(columns.values())), delimiter=",", fmt="%.9g",
               header=",".join(columns), comments="")  # fmt: skip
    toml.write_text(model, encoding="utf-8")
    return recording, toml


def late(signal: np.ndarray, seconds: float, fs_hz: float) -> np.ndarray:
    """A signal delayed by a number of seconds, by the phase of its spectrum."""
    pad = 2048
    whole = np.pad(signal, pad, mode="reflect", reflect_type="odd")
    f = np.fft.rfftfreq(whole.size, 1.0 / fs_hz)
    return np.fft.irfft(np.fft.rfft(whole) * np.exp(-2j * np.pi * f * seconds), whole.size)[
        pad:-pad
    ]


def on_ground(
    seed: int,
    folder: Path,
    dashpot: float = 0.0,
    cell: Callable[[np.ndarray, float], np.ndarray] | None = None,
    felt: Callable[[np.ndarray, float], np.ndarray] | None = None,
) -> tuple[Path, Path]:
    """Write a recording of a body on a shaking table, and the laboratory's model; return the paths.

    Args:
        seed: seed of all numbers.
        folder: output folder.
        dashpot: damping missing from the model, relative to the model's own.
        cell, felt: readings of load cell and accelerometer, as functions of signal and rate.
    """
    random, fs_hz = np.random.default_rng([2027, seed]), 256.0
    u, t = random.uniform, np.arange(round(12.0 * fs_hz)) / fs_hz
    k, f0, zeta = np.exp(u(*np.log((3e5, 1.5e6)))), u(1.2, 2.4), u(0.03, 0.06)
    mass = k / (2 * np.pi * f0) ** 2
    c = 2.0 * zeta * np.sqrt(k * mass)
    error = np.clip(random.standard_normal(2), -1.5, 1.5)
    stiff, damp = k * (1 + 0.01 * error[0]), c * (1 + 0.15 * error[1] + dashpot)
    ag = u(1.0, 2.0) * band(t, 0.4, 6.0, random)
    system = StateSpace(
        [[0.0, 1.0], [-stiff / mass, -damp / mass]], [[0.0], [-1.0]], np.eye(2), np.zeros((2, 1))
    )
    x, v = lsim(system, ag, t)[1].T
    force, a = stiff * x + damp * v, -(stiff * x + damp * v) / mass
    shown = cell(force, fs_hz) if cell else force
    weighed = felt(a, fs_hz) if felt else a
    stds = [part * float(np.std(s)) for part, s in ((5e-4, x), (0.006, force), (0.01, a))]
    noise = [std * random.standard_normal(t.size) for std in stds]
    columns = {
        "t": t, "ag": ag, "x_meas": x + noise[0], "f_meas": shown + noise[1],
        "a_meas": weighed + noise[2],
    }  # fmt: skip
    return written(folder, columns, f"""schema = "rthyb-baseline/1"
family = "ground"
fs_hz = {fs_hz}
[specimen]
k = {k}
c = {c}
k_tol = 0.01
c_tol = 0.15
[numerical]
m = {mass}
[noise]
x_std = {stds[0]}
f_std = {stds[1]}
a_std = {stds[2]}
""")  # fmt: skip
