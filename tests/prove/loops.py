"""The closed hybrid test: numerical part, phase-lead and restoring-force compensation, rig.

The equation of motion is propagated exactly for a force held over the sample. The actuator and the
specimen run at 16 fine steps a sample; the command runs straight between rows and reaches row i at
instant i.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from scipy.linalg import expm

from prove import laws, rigs


@dataclass(frozen=True)
class Controller:
    """Compensation of the paper: weights, first alpha in samples, adaptation, averaging length."""

    alpha: float
    k_e: float
    w1: float = 3.0
    w2: float = 2.0
    adaptive: bool = True
    rfc: bool = True
    rate: float = 0.0  # adaptive gain, 1/(mm^2 sample)
    samples: int = 50  # of the averaged tangent stiffness
    strong_until_s: float = 1e9


@dataclass(frozen=True)
class Sensors:
    """What stands between the true force and f_meas, inside the loop as outside of it."""

    skew_s: float = 0.0
    bias: float = 0.0
    drift: float = 0.0
    hum_hz: float = 0.0
    hum: float = 0.0
    hum_phase: float = 0.0
    crosstalk: float = 0.0
    lsb: float = 0.0

    def clean(self, t: np.ndarray, f: np.ndarray, fy: np.ndarray) -> np.ndarray:
        """What the cell reads without noise and rounding, N; f already taken at t - skew."""
        hum = self.hum * np.sin(2 * math.pi * self.hum_hz * t + self.hum_phase)
        return f + self.bias + self.drift * t + hum + self.crosstalk * fy

    def rounded(self, f: np.ndarray) -> np.ndarray:
        return np.round(f / self.lsb) * self.lsb if self.lsb > 0 else f


@njit(cache=True)
def _run(
    extra: np.ndarray,
    x_noise: np.ndarray,
    ag: np.ndarray,
    dt: float,
    motion: np.ndarray,
    step: np.ndarray,
    p: np.ndarray,
    skew_steps: float,
    lsb: float,
    control: np.ndarray,
    base: np.ndarray,
    rows: np.ndarray,
    tables: np.ndarray,
    states: np.ndarray,
    x_limit: float,
) -> tuple[np.ndarray, np.ndarray, int]:
    """Rows (4, n): x_num, x_cmd, f clean, f measured; fine (4, 16 (n-1) + 1): x, v, a, f.

    extra: what the cell adds to the true force, row by row, noise left out (0) and noise (1).
    """
    n = ag.size
    per = 16
    h = dt / per
    out = np.zeros((4, n))
    fine = np.zeros((4, per * (n - 1) + 1))
    w1, w2, alpha, k_e, rate = control[0], control[1], control[2], control[3], control[4]
    window, rfc, until = int(control[5]), control[6] > 0, control[7]
    total = w1 + w2 + 1
    x_cmd = np.zeros(n)
    x_num = np.zeros(n)
    x_meas = np.zeros(n)
    s = np.zeros(4)
    transition = laws.modes(rows, h)
    laws.reset(base, rows, states, 0.0)
    velocity = 0.0
    last_a = 0.0
    k_t = k_e
    for i in range(n):
        # The rig, from row i - 1 to row i.
        first = 0 if i == 0 else per * (i - 1) + 1
        for g in range(first, per * i + 1):
            t = g * h
            if g > 0:
                rigs.actuator_step(x_cmd[: i + 1], t, h, dt, step, p, s)
            c, m = laws.linear_terms(t, base, rows)
            f = laws.position_force(t, s[0], s[1], h, base, rows, tables, states, True)
            f += c * s[1] + m * s[3]
            for j in range(rows.shape[0]):
                if rows[j, 0] == laws.SECOND_MODE:
                    value = laws.mode_force(rows[j], states[j], transition[j], last_a, s[3])
                    if t >= rows[j, 1]:
                        f += value
            last_a = s[3]
            fine[0, g], fine[1, g], fine[2, g], fine[3, g] = s[0], s[1], s[3], f
        if not abs(s[0]) < x_limit:
            return out, fine, i
        # What the controller sees.
        position = per * i - skew_steps
        whole = math.floor(position)
        if whole < 0:
            f_row = fine[3, 0]
        else:
            share = position - whole
            f_row = (
                fine[3, whole]
                if share == 0.0
                else (fine[3, whole] * (1 - share) + fine[3, whole + 1] * share)
            )
        out[2, i] = f_row + extra[0, i]
        f_seen = out[2, i] + extra[1, i]
        if lsb > 0:
            f_seen = np.round(f_seen / lsb) * lsb
        out[3, i] = f_seen
        x_meas[i] = s[0] + x_noise[i]
        if i == n - 1:
            break
        # Delay estimator, Eqn 2.8 - 2.11, displacements in mm.
        if i >= 2 and rate > 0:
            mu = 1e3 * (
                w1 * (x_cmd[i] - x_meas[i])
                + w2 * (x_cmd[i - 1] - x_meas[i - 1])
                + x_cmd[i - 2]
                - x_meas[i - 2]
            )
            phi = 1e3 * total * (x_meas[i] - x_meas[i - 1])
            alpha += rate * phi * (mu - alpha * phi) / (1 + phi * phi)
            alpha = min(max(alpha, 0.0), 40.0)
        # Averaged tangent stiffness, Eqn 3.3 as a ratio of sums, three stages.
        if i * dt > until or i <= 2 * window:
            k_t = k_e
        else:
            up, down = 0.0, 1e-18
            for q in range(i - window, i):
                dx = x_meas[q + 1] - x_meas[q - 4]
                up += (out[3, q + 1] - out[3, q - 4]) * dx
                down += dx * dx
            k_t = min(max(up / down, 0.0), k_e)
        fed_back = f_seen + (k_t * (x_num[i] - x_meas[i]) if rfc else 0.0)
        pull = -ag[i + 1] - fed_back / motion[2, 0]
        x_num[i + 1] = x_num[i] + motion[0, 1] * velocity + motion[0, 2] * pull
        velocity = motion[1, 1] * velocity + motion[1, 2] * pull
        before = x_num[i - 1] if i >= 1 else 0.0
        ahead = (w1 + total * alpha) * x_num[i + 1] + (w2 - total * alpha) * x_num[i] + before
        held = x_cmd[i - 1] if i >= 1 else 0.0
        x_cmd[i + 1] = (ahead - w2 * x_cmd[i] - held) / w1
    for i in range(n):
        out[0, i], out[1, i] = x_num[i], x_cmd[i]
    return out, fine, n


@dataclass
class Closed:
    """Signals of a closed test: rows (n,) and fine signals (16 (n - 1) + 1,)."""

    x_num: np.ndarray
    x_cmd: np.ndarray
    f_clean: np.ndarray
    f_meas: np.ndarray
    fine: np.ndarray
    finished: bool


def closed_test(
    ag: np.ndarray, dt: float, mass: float, damping: float, actuator: rigs.Actuator,
    specimen: laws.Specimen, sensors: Sensors, controller: Controller, fy: np.ndarray,
    f_noise: np.ndarray, x_noise: np.ndarray, x_limit: float = 0.05,
) -> Closed:  # fmt: skip
    """A hybrid test from rest under ag (m/s^2). x_limit stops it where it runs away."""
    t = np.arange(ag.size) * dt
    a = np.array([[0.0, 1.0, 0.0], [0.0, -damping / mass, 1.0], [0.0, 0.0, 0.0]])
    e = expm(a * dt)
    motion = np.zeros((3, 3))
    motion[:2] = e[:2]
    motion[2, 0] = mass
    extra = np.array([sensors.clean(t, np.zeros_like(t), fy), f_noise])
    h = dt / rigs.FINE
    control = np.array(
        [
            controller.w1, controller.w2, controller.alpha, controller.k_e,
            controller.rate if controller.adaptive else 0.0, controller.samples,
            float(controller.rfc), controller.strong_until_s,
        ]
    )  # fmt: skip
    rows, fine, done = _run(
        extra, x_noise, ag, dt, motion, *actuator.compiled(h), sensors.skew_s / h, sensors.lsb,
        control, *specimen.compiled(h), x_limit,
    )  # fmt: skip
    return Closed(rows[0], rows[1], rows[2], rows[3], fine, done == ag.size)
