"""Actuator and freely moving specimen, at 16 fine steps a sample.

The actuator is propagated exactly for straight input over a fine step. Base-driven and forced
motion run by leapfrog, dry friction as an impulse that stops the mass or slips at its limit:
set-valued, so that sticking is exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from scipy.linalg import expm

from prove import laws

FINE = 16  # fine steps a sample
COMMAND, VALVE = 0.0, 1.0  # where a rate limit sits


@dataclass(frozen=True)
class Actuator:
    """x = gain exp(-delay s) w^2 / (s^2 + 2 zeta w s + w^2) x_cmd, and what no data sheet says."""

    delay_s: float
    f_hz: float
    zeta: float
    gain: float = 1.0
    kappa_s2_m: float = 0.0  # delay grows by kappa |velocity|
    vmax_m_s: float = 0.0  # 0: no limit
    limit_at: float = COMMAND
    ripple_m: float = 0.0  # reading error of the inner transducer, periodic in stroke
    pitch_m: float = 1.0

    @property
    def lag_s(self) -> float:
        return self.delay_s + self.zeta / (math.pi * self.f_hz)

    def with_(self, **changes: float) -> Actuator:
        return replace(self, **changes)

    def compiled(self, h: float) -> tuple[np.ndarray, np.ndarray]:
        """Transition (2, 4) of (x, v) with inputs at both ends of a step, and the scalars."""
        w = 2 * math.pi * self.f_hz
        a = np.zeros((4, 4))
        a[0, 1] = 1.0
        a[1] = (-w * w, -2 * self.zeta * w, w * w * self.gain, 0.0)
        a[2, 3] = 1.0 / h
        e = expm(a * h)
        step = np.array([[e[i, 0], e[i, 1], e[i, 2] - e[i, 3], e[i, 3]] for i in range(2)])
        scalars = np.array(
            [
                self.delay_s, self.kappa_s2_m, self.vmax_m_s, self.limit_at,
                w * w * self.gain, w * w, 2 * self.zeta * w, self.ripple_m, self.pitch_m,
            ]
        )  # fmt: skip
        return step, scalars


@njit(cache=True)
def command_at(x_cmd: np.ndarray, position: float) -> float:
    """The command between rows, straight; at rest before the first row."""
    if position <= 0:
        return x_cmd[0]
    i = int(position)
    if i >= x_cmd.size - 1:
        return x_cmd[x_cmd.size - 1]
    share = position - i
    return x_cmd[i] * (1 - share) + x_cmd[i + 1] * share


@njit(cache=True)
def actuator_step(
    x_cmd: np.ndarray,
    t: float,
    h: float,
    dt: float,
    step: np.ndarray,
    p: np.ndarray,
    s: np.ndarray,
) -> None:
    """One fine step to t. s: x, v, last input, acceleration, x read by the transducer."""
    u = command_at(x_cmd, (t - p[0] - p[1] * abs(s[1])) / dt)
    if p[2] > 0 and p[3] == 0.0:
        u = min(max(u, s[2] - p[2] * h), s[2] + p[2] * h)
    x = step[0, 0] * s[0] + step[0, 1] * s[1] + step[0, 2] * s[2] + step[0, 3] * u
    v = step[1, 0] * s[0] + step[1, 1] * s[1] + step[1, 2] * s[2] + step[1, 3] * u
    a = p[4] * u - p[5] * x - p[6] * v
    if p[2] > 0 and p[3] == 1.0 and abs(v) > p[2]:
        v = p[2] if v > 0 else -p[2]
        x = s[0] + 0.5 * h * (s[1] + v)
        a = (v - s[1]) / h
    s[0], s[1], s[2], s[3] = x, v, u, a


@njit(cache=True)
def _track(x_cmd: np.ndarray, dt: float, n: int, step: np.ndarray, p: np.ndarray) -> np.ndarray:
    h = dt / 16
    out = np.empty((3, n))
    s = np.zeros(4)
    s[0] = x_cmd[0] * p[4] / p[5]
    s[2] = x_cmd[0]
    for i in range(n):
        if i > 0:
            actuator_step(x_cmd, i * h, h, dt, step, p, s)
        out[0, i], out[1, i], out[2, i] = s[0], s[1], s[3]
    if p[7] != 0.0:
        for i in range(n):
            phase = 2 * math.pi / p[8]
            x, v, a = out[0, i], out[1, i], out[2, i]
            slope = p[7] * phase * math.cos(phase * x)
            out[0, i] = x + p[7] * math.sin(phase * x)
            out[1, i] = v * (1 + slope)
            out[2, i] = a * (1 + slope) - p[7] * phase * phase * math.sin(phase * x) * v * v
    return out


def track(x_cmd: np.ndarray, dt: float, actuator: Actuator) -> np.ndarray:
    """x, v, a (3, 16 (n - 1) + 1) of the actuator under rows of x_cmd, at rest at the first."""
    return _track(x_cmd, dt, FINE * (x_cmd.size - 1) + 1, *actuator.compiled(dt / FINE))


@njit(cache=True)
def _free(
    load: np.ndarray,
    h: float,
    mass: float,
    damping: float,
    base: np.ndarray,
    rows: np.ndarray,
    tables: np.ndarray,
    states: np.ndarray,
) -> np.ndarray:
    """mass x'' + damping x' + F = load (N at fine steps): x, v, a, F."""
    n = load.size
    out = np.empty((4, n))
    transition = laws.modes(rows, h)
    laws.reset(base, rows, states, 0.0)
    x, half = 0.0, 0.0
    a = 0.0
    mode = 0.0
    for i in range(n):
        t = i * h
        c, m = laws.linear_terms(t, base, rows)
        total = m + mass
        v_guess = half + 0.5 * h * a
        f = laws.position_force(t, x, v_guess, h, base, rows, tables, states, False) + mode
        gain = 0.5 * h * (c + damping) / total
        free = (half * (1 - gain) + h / total * (load[i] - f)) / (1 + gain)
        dry = 0.0
        for j in range(rows.shape[0]):
            code = rows[j, 0]
            if code in (laws.COULOMB, laws.STRIBECK) and t >= rows[j, 1]:
                level = laws.slip_level(rows[j], abs(0.5 * (half + free)))
                needed = free * (1 + gain) * total / h
                dry = min(max(needed, -level), level)
                free -= h / total * dry / (1 + gain)
        v = 0.5 * (half + free)
        a_new = (free - half) / h
        out[0, i], out[1, i], out[2, i] = x, v, a_new
        out[3, i] = load[i] - mass * a_new - damping * v
        for j in range(rows.shape[0]):
            if rows[j, 0] == laws.SECOND_MODE:
                # Explicit in the acceleration, one fine step late.
                value = laws.mode_force(rows[j], states[j], transition[j], a, a_new)
                mode = value if t >= rows[j, 1] else 0.0
        x += h * free
        half = free
        a = a_new
    return out


def free_motion(
    load: np.ndarray, h: float, mass: float, damping: float, specimen: laws.Specimen
) -> np.ndarray:
    """x, v, a, F of the specimen on `mass` under a load (N, one value a fine step), from rest."""
    return _free(load, h, mass, damping, *specimen.compiled(h))


def fine_signal(rows: np.ndarray, t_rows: np.ndarray, dt: float) -> np.ndarray:
    """Rows joined by straight lines, at the fine steps."""
    n = FINE * (rows.size - 1) + 1
    return np.interp(np.arange(n) * (dt / FINE), t_rows, rows)
