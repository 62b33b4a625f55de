"""Force laws, each advanced along a motion by one step from its own state.

A law never sees the integrator. It is given where the body is at the end of a step and what it
remembered at the beginning, and writes what it remembers then. So an implicit scheme may ask for
the force of a step as often as it likes before it is settled.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numba import njit

NP, NS = 12, 44  # numbers a law may have, numbers it may remember
RAMP = 0.05  # s over which an effect sets in that begins in mid-record

(VISCOUS, POWER, SGN, TANH, STRIBECK, PULSED, CLUTCH, INERTIA) = range(8)
(STIFFNESS, CUBIC, PENDULUM, WIRE, QUADRATIC, EXPONENTIAL) = range(10, 16)
(GAP, GAP_SOFT, STOP, STOP_SOFT, STOP_IMPACT, MAGNET, PARAMETRIC) = range(16, 23)
(JENKINS, IWAN, BOUC_WEN, MENEGOTTO, DEGRADE, BILINEAR) = range(30, 36)
(BRISTLE, MAXWELL, SECOND_MODE, FRACTIONAL, RATE_STATE, SLOSH, BOUC_PINCH) = range(40, 47)
SLIDERS = 24  # of an Iwan model
BRANCHES = 12  # of the bank that stands for a fractional derivative


@dataclass(frozen=True)
class Law:
    """A law of force: its name and parameters in the public format, and the form it has here."""

    name: str
    form: str
    kind: int
    p: tuple[float, ...]
    params: dict[str, float] = field(default_factory=dict)
    scored: tuple[str, ...] = ()
    onset_s: float = -1.0


@njit(cache=True)
def _rate_law(kind, p, v, a, t):
    """Forces of the moment that go with velocity or acceleration, or with time."""
    if kind == VISCOUS:
        return p[0] * v
    if kind == POWER:
        return p[0] * math.copysign(abs(v) ** p[1], v)
    if kind == SGN:
        return p[0] * np.sign(v)
    if kind == TANH:
        return p[0] * math.tanh(v / p[1])
    if kind == STRIBECK:  # Fc, Fs, vs, exponent, width of the step (0: none)
        level = p[0] + (p[1] - p[0]) * math.exp(-(abs(v / p[2]) ** p[3]))
        return level * (np.sign(v) if p[4] == 0.0 else math.tanh(v / p[4]))
    if kind == PULSED:  # a dashpot that something opens and shuts
        return p[0] * v * math.sin(2.0 * math.pi * p[1] * t)
    if kind == CLUTCH:  # a dashpot that grips one way only
        return p[0] * max(v, 0.0)
    return p[0] * a


@njit(cache=True)
def _corner(d, width):
    """max(d, 0) with a corner rounded over `width`."""
    return 0.5 * (d + math.sqrt(d * d + width * width))


@njit(cache=True)
def _spring_law(kind, p, x, v, t):
    """Forces of the moment that go with displacement."""
    if kind == STIFFNESS:
        return p[0] * x
    if kind == CUBIC:
        return p[0] * x**3
    if kind == PENDULUM:  # k, L: a pendulum in place of its small-angle spring
        return p[0] * (p[1] * math.sin(x / p[1]) - x)
    if kind == WIRE:  # a wire across the motion, L long, slack at rest
        return p[0] * x * (1.0 - p[1] / math.sqrt(p[1] ** 2 + x * x))
    if kind == QUADRATIC:
        return p[0] * x * x
    if kind == EXPONENTIAL:  # k, L: a rubber that stiffens one way
        return p[0] * (p[1] * (math.exp(x / p[1]) - 1.0) - x)
    if kind == GAP:
        return -p[0] * min(max(x, -p[1]), p[1])
    if kind == GAP_SOFT:
        return p[0] * (_corner(x - p[1], p[2]) - _corner(-x - p[1], p[2]) - x)
    if kind == STOP:
        return p[0] * (max(x - p[1], 0.0) - max(-x - p[1], 0.0))
    if kind == STOP_SOFT:
        return p[0] * (_corner(x - p[1], p[2]) - _corner(-x - p[1], p[2]))
    if kind == STOP_IMPACT:  # Hunt and Crossley: the loss goes with depth and velocity
        depth = max(abs(x) - p[1], 0.0)
        return math.copysign(p[0] * depth * max(1.0 + p[2] * v * np.sign(x), 0.0), x)
    if kind == MAGNET:
        d = (x - p[1]) / p[2]
        return p[0] * d / (1.0 + d * d) ** 2
    return p[0] * math.sin(2.0 * math.pi * p[1] * t) * x  # PARAMETRIC


@njit(cache=True)
def _bouc_wen(z, dx, xy, n, pinch, width, locked):
    """z after dx, by the midpoint rule in steps that are small against xy."""
    steps = int(abs(dx) / (0.02 * xy)) + 1
    part = dx / steps
    for _ in range(steps):
        mid = z
        for half in (0.5, 1.0):
            rate = 1.0 - abs(mid / xy) ** n * (0.55 + 0.45 * np.sign(part * mid))
            if pinch > 0.0:
                g = math.exp(-((mid / (width * xy)) ** 2))
                # Slip-lock puts a slip in series; else the slope itself is pinched.
                rate *= 1.0 / (1.0 + pinch * g) if locked > 0.0 else 1.0 - pinch * g
            if half == 0.5:
                mid = z + 0.5 * part * rate
            else:
                z += part * rate
    return z


@njit(cache=True)
def _menegotto(p, s, q, x):
    """Menegotto and Pinto: from each reversal a curve towards the lines of yielding.

    p: k, alpha, xy, R. Remembered: x, force, direction, reversal x, reversal force, asymptotes' x.
    """
    k, b, xy, r = p[0], p[1], p[2], p[3]
    way = np.sign(x - s[0])
    if way == 0.0:
        return s[1] - k * x
    if way != s[2]:
        q[3], q[4] = s[0], s[1]
        # Elastic line through the reversal against the line of yielding ahead.
        q[5] = (way * k * xy * (1.0 - b) - s[1] + k * s[0]) / (k * (1.0 - b))
    q[2] = way
    top = way * k * xy * (1.0 - b) + b * k * q[5]
    e = (x - q[3]) / (q[5] - q[3])
    rel = b * e + (1.0 - b) * e / (1.0 + abs(e) ** r) ** (1.0 / r)
    q[1] = q[4] + rel * (top - q[4])
    return q[1] - k * x


@njit(cache=True)
def _path_law(kind, p, s, q, x, v):
    """Forces that remember the path, not the time. s[0] is where the body was."""
    dx = x - s[0]
    q[0] = x
    if kind == JENKINS:  # Fc, stiffness before it slips
        q[1] = min(max(s[1] + p[1] * dx, -p[0]), p[0])
        return q[1]
    if kind == IWAN:  # k, alpha, xy: sliders of equal stiffness, slips spread evenly to 2 xy
        total = 0.0
        for i in range(SLIDERS):
            top = 2.0 * p[2] * (i + 0.5) / SLIDERS
            q[1 + i] = min(max(s[1 + i] + dx, -top), top)
            total += q[1 + i]
        return p[0] * (1.0 - p[1]) * (total / SLIDERS - x)
    if kind == BOUC_WEN:  # k, alpha, xy, n
        q[1] = _bouc_wen(s[1], dx, p[2], p[3], 0.0, 1.0, 0.0)
        return p[0] * (1.0 - p[1]) * (q[1] - x)
    if kind == BOUC_PINCH:  # ..., n, depth, width, slip-lock: pinched less not pinched
        q[1] = _bouc_wen(s[1], dx, p[2], p[3], 0.0, 1.0, 0.0)
        q[2] = _bouc_wen(s[2], dx, p[2], p[3], p[4], p[5], p[6])
        return p[0] * (1.0 - p[1]) * (q[2] - q[1])
    if kind == BILINEAR:  # k, alpha, xy
        q[1] = min(max(s[1] + dx, -p[2]), p[2])
        return p[0] * (1.0 - p[1]) * (q[1] - x)
    if kind == MENEGOTTO:
        return _menegotto(p, s, q, x)
    # DEGRADE: k, loss, scale, way of counting (0 travel, 1 work of the spring, 2 largest amplitude)
    step = abs(dx)
    if p[3] == 1.0:
        step *= abs(0.5 * (x + s[0]))
    q[1] = max(s[1], abs(x)) if p[3] == 2.0 else s[1] + step
    return -p[0] * x * p[1] * (1.0 - math.exp(-q[1] / p[2]))


@njit(cache=True)
def _absorber(p, s, q, x, v, h, soft):
    """A mass m2 on a spring and dashpot that the body carries; `soft` > 0: its spring softens."""
    w, zeta = 2.0 * math.pi * p[1], p[2]
    # Trapezoidal rule on the mass's own motion; the body's motion runs straight between.
    y, u = s[1], s[2]
    d = s[0] - y
    f0 = w * w * d / math.sqrt(1.0 + soft * d * d) + 2.0 * zeta * w * (s[3] - u)
    u1, y1 = u + h * f0, y + h * u
    for _ in range(3):
        d = x - y1
        f1 = w * w * d / math.sqrt(1.0 + soft * d * d) + 2.0 * zeta * w * (v - u1)
        u1 = u + 0.5 * h * (f0 + f1)
        y1 = y + 0.5 * h * (u + u1)
    q[0], q[1], q[2], q[3] = x, y1, u1, v
    return p[0] * f1


@njit(cache=True)
def _memory_law(kind, p, s, q, x, v, h):
    """Forces that remember in time."""
    if kind == BRISTLE:  # Fc, sigma0, Fs, vs, exponent of the bristle: exact at even velocity
        g = p[0] + (p[2] - p[0]) * math.exp(-((v / p[3]) ** 2))
        end = g * np.sign(v)
        q[0] = x
        q[1] = end + (s[1] - end) * math.exp(-p[1] * abs(x - s[0]) / g)
        return q[1]
    if kind == MAXWELL:
        decay = math.exp(-h / p[1])
        q[1] = s[1] * decay + p[0] * (x - s[0]) * p[1] / h * (1.0 - decay)
        q[0] = x
        return q[1]
    if kind == FRACTIONAL:  # a bank of relaxations with times in octaves, weighed by tau^-order
        total = 0.0
        for i in range(BRANCHES):
            tau = p[2] * 2.0**i
            decay = math.exp(-h / tau)
            gain = p[0] * tau ** (-p[1])
            q[1 + i] = s[1 + i] * decay + gain * (x - s[0]) * tau / h * (1.0 - decay)
            total += q[1 + i]
        q[0] = x
        return total
    if kind == RATE_STATE:  # level, a, b, v0, Dc: Dieterich's ageing law; s[1] is log(theta v0/Dc)
        rest = p[4] / max(abs(v), 1e-6)
        theta = math.exp(s[1]) * p[4] / p[3]
        theta = rest + (theta - rest) * math.exp(-h * max(abs(v), 1e-6) / p[4])
        q[1] = math.log(theta * p[3] / p[4])
        inner = 0.5 * v / p[3] * math.exp((1.0 + p[2] * q[1]) / p[1])
        return p[0] * p[1] * math.asinh(inner)
    soft = p[3] if kind == SLOSH else 0.0
    return _absorber(p, s, q, x, v, h, soft)


@njit(cache=True)
def advance(kind, p, s, q, x, v, a, t, h):
    """Force of one law at the end of a step to (x, v, a); what it then remembers goes to q."""
    q[:] = s
    if kind < 10:
        return _rate_law(kind, p, v, a, t)
    if kind < 30:
        return _spring_law(kind, p, x, v, t)
    if kind < 40 or kind == BOUC_PINCH:
        return _path_law(kind, p, s, q, x, v)
    return _memory_law(kind, p, s, q, x, v, h)


@njit(cache=True)
def gate(t, onset):
    """Share of an effect that acts at t: it sets in over RAMP."""
    return 1.0 if onset <= 0.0 else min(max((t - onset) / RAMP, 0.0), 1.0)


@njit(cache=True)
def begin(s, kinds, x, v):
    """Memories of a body that starts at x with v, as if it had always been there."""
    s[:] = 0.0
    for i in range(kinds.size):
        s[i, 0] = x
        if kinds[i] in (SECOND_MODE, SLOSH):
            s[i, 1], s[i, 2], s[i, 3] = x, v, v


@njit(cache=True)
def _along(kinds, ps, onsets, t0, h, x, v, a):
    n, count = x.size, kinds.size
    out = np.zeros((count, n))
    s = np.zeros((count, NS))
    q = np.zeros(NS)
    begin(s, kinds, x[0], v[0])
    for j in range(n):
        t = t0 + j * h
        for i in range(count):
            f = advance(kinds[i], ps[i], s[i], q, x[j], v[j], a[j], t, h)
            s[i] = q
            out[i, j] = f * gate(t, onsets[i])
    return out


def packed(laws: list[Law]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Laws as arrays for the compiled steps: kinds, numbers, onsets."""
    ps = np.zeros((len(laws), NP))
    for row, law in zip(ps, laws, strict=True):
        row[: len(law.p)] = law.p
    kinds = np.array([law.kind for law in laws], np.int64)
    return kinds, ps, np.array([law.onset_s for law in laws], float)


def along(
    laws: list[Law], h: float, x: np.ndarray, v: np.ndarray, a: np.ndarray, t0: float = 0.0
) -> np.ndarray:
    """Force of each law, one row each, along a known motion."""
    columns = (np.ascontiguousarray(c, float) for c in (x, v, a))
    return _along(*packed(laws), t0, h, *columns)
