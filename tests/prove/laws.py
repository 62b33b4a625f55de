"""Force laws of the true specimen, each in another formulation than a simulator would first take.

Hysteresis is an Iwan chain of Jenkins elements. Presliding friction is a Maxwell-slip chain with
yields spread so that its reversal curve is an exponential. Dry friction is a slider on a contact of
2 um, or an impulse in the set-valued sense where the motion is free. The Maxwell branch and the
second mode are propagated exactly, the inelastic base model by its closed form in tanh.

Every law advances in displacement or time by one fine step. SI units: m, m/s, m/s^2, N, s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numba import njit

# Codes of the laws in the kernel: up to 16 those of the format, beyond those of no catalogue.
STIFFNESS, VISCOUS, COULOMB, STRIBECK, LUGRE, QUAD_DAMPING, INERTIA, GAP = range(1, 9)
CUBIC, QUADRATIC, STOPPER, HYSTERESIS, PINCHING, DEGRADATION, MAXWELL, SECOND_MODE = range(9, 17)
LOCAL_BUMP, CROSS_XV, ONE_SIDED, PARAMETRIC, COGGING, INTERMITTENT, WEDGE, FADING = range(31, 39)

CODES = {
    "stiffness": STIFFNESS,
    "viscous": VISCOUS,
    "coulomb": COULOMB,
    "stribeck": STRIBECK,
    "lugre": LUGRE,
    "quad_damping": QUAD_DAMPING,
    "inertia": INERTIA,
    "gap": GAP,
    "cubic": CUBIC,
    "quadratic": QUADRATIC,
    "stopper": STOPPER,
    "hysteresis": HYSTERESIS,
    "pinching": PINCHING,
    "degradation": DEGRADATION,
    "maxwell": MAXWELL,
    "second_mode": SECOND_MODE,
    "local_bump": LOCAL_BUMP,
    "cross_xv": CROSS_XV,
    "one_sided_damping": ONE_SIDED,
    "parametric_stiffness": PARAMETRIC,
    "cogging": COGGING,
    "intermittent": INTERMITTENT,
    "wedge_friction": WEDGE,
    "fading_stiffness": FADING,
}

ELEMENTS = 32  # sliders in a chain
STATES = ELEMENTS + 6
PARAMETERS = 10
CONTACT = 2e-6  # m, shear of a dry contact before it slips
NEVER = -1e9


@dataclass
class Effect:
    """One law of the specimen: its name in the format, parameters as the format names them.

    `shape` holds what the format has no name for (side of a stop, spread of yields, sharpness), and
    `onset_s` the time from which the law acts.
    """

    name: str
    params: dict[str, float]
    shape: dict[str, float] = field(default_factory=dict)
    onset_s: float = NEVER


@dataclass
class Specimen:
    """The elastic or inelastic base with mass and damping, and the laws added to it."""

    k: float
    c: float
    mass: float
    bouc_wen: dict[str, float] | None = None
    effects: tuple[Effect, ...] = ()

    def without(self, index: int) -> Specimen:
        rest = tuple(e for i, e in enumerate(self.effects) if i != index)
        return Specimen(self.k, self.c, self.mass, self.bouc_wen, rest)

    def bare(self) -> Specimen:
        return Specimen(self.k, self.c, self.mass, self.bouc_wen)

    def compiled(self, step_s: float) -> tuple[Any, ...]:
        """base (6,), laws (n, PARAMETERS), chains (n, 2, ELEMENTS), states (n + 1, STATES)."""
        b = self.bouc_wen
        base = np.array([self.k, self.c, self.mass, 0.0, 1.0, 1.0])
        if b:
            base[3:] = (1.0, b["alpha"], b["xy"])
        n = len(self.effects)
        laws = np.zeros((n, PARAMETERS))
        tables = np.zeros((n, 2, ELEMENTS))
        for i, effect in enumerate(self.effects):
            laws[i], tables[i] = _row(effect, step_s)
        return base, laws, tables, np.zeros((n + 1, STATES))


def _row(effect: Effect, h: float) -> tuple[np.ndarray, np.ndarray]:
    p, s = effect.params, effect.shape
    table = np.zeros((2, ELEMENTS))
    values: list[float] = []
    match effect.name:
        case "stiffness":
            values = [p["dk_ratio"]]
        case "viscous":
            values = [p["c_Ns_m"]]
        case "coulomb":
            values = [p["Fc_N"]]
        case "stribeck":
            values = [p["Fc_N"], p["Fs_N"], p["vs_m_s"], s.get("exponent", 2.0)]
        case "lugre":
            values = [p["Fc_N"]]
            table = friction_chain(p["Fc_N"], p["sigma0_N_m"])
        case "quad_damping":
            values = [p["c2_Ns2_m2"]]
        case "inertia":
            values = [p["m_kg"]]
        case "gap":
            values = [p["gap_m"], s.get("play", 0.0)]
        case "cubic":
            values = [p["k3_N_m3"]]
        case "quadratic":
            values = [p["k2_N_m2"]]
        case "stopper":
            values = [p["ks_N_m"], p["xs_m"], s.get("side", 0.0), s.get("loss", 0.0)]
        case "hysteresis":
            values = [p["alpha"]]
            table = yielding_chain(p["xy_m"], s.get("spread", 0.6))
        case "pinching":
            values = [p["depth"], p["width_ratio"]]
        case "degradation":
            values = [p["loss"], p["travel_m"]]
        case "maxwell":
            tau = p["tau_s"]
            decay = math.exp(-h / tau)
            values = [p["km_N_m"], decay, tau / h * (1.0 - decay)]
        case "second_mode":
            w = 2 * math.pi * p["f2_Hz"]
            values = [p["m2_kg"], w * w, 2 * s.get("zeta", 0.02) * w]
        case "local_bump":
            values = [s["force"], p["x_m"], p["width_m"]]
        case "cross_xv" | "one_sided_damping":
            values = [p["b"]]
        case "parametric_stiffness":
            values = [p["depth"], 2 * math.pi * p["f_Hz"], s.get("phase", 0.0)]
        case "cogging":
            values = [p["amp_N"], p["pitch_m"], s.get("phase", 0.0)]
        case "intermittent":
            values = [p["amp_N"], s["t1"], s["t2"], s["t3"], s["t4"], s["pitch_m"]]
        case "wedge_friction":
            values = [p["slope_N_m"]]
        case "fading_stiffness":
            values = [p["depth"], p["tau_s"], p["x_m"]]
        case other:
            raise ValueError(f"no law is called {other!r}")
    row = np.zeros(PARAMETERS)
    row[0], row[1] = CODES[effect.name], effect.onset_s
    row[2 : 2 + len(values)] = values
    return row, table


def yielding_chain(xy: float, spread: float) -> np.ndarray:
    """Jenkins elements of equal stiffness share, their yields triangular about xy with mean xy."""
    q = (np.arange(ELEMENTS) + 0.5) / ELEMENTS
    triangular = np.where(q < 0.5, np.sqrt(2 * q) - 1, 1 - np.sqrt(2 * (1 - q)))
    return np.array([np.full(ELEMENTS, 1.0 / ELEMENTS), xy * (1 + spread * triangular)])


def friction_chain(level: float, sigma0: float) -> np.ndarray:
    """Maxwell-slip elements whose reversal curve is that of a bristle of stiffness sigma0.

    A chain reverses along twice its virgin curve; so that the reversal is
    -F + 2 F (1 - exp(-sigma0 u / F)), its yields are exponential with mean F / (2 sigma0) and its
    stiffness is 2 sigma0.
    """
    edges = np.linspace(0.0, 1.0, ELEMENTS + 1)
    inner = edges[1:-1]
    cut = np.concatenate(([0.0], -np.log1p(-inner), [np.inf]))
    tail = np.concatenate((np.exp(-cut[:-1]) * (cut[:-1] + 1), [0.0]))
    mean = (tail[:-1] - tail[1:]) * ELEMENTS  # of the exponential law within each share
    return np.array([np.full(ELEMENTS, 2 * sigma0 / ELEMENTS), level / (2 * sigma0) * mean])


@njit(cache=True)
def second_mode_matrix(w2: float, d: float, h: float, out: np.ndarray) -> None:
    """Discrete transition of (r, r') and the input columns for x'' at both ends of the step."""
    # Taylor series of the exponential: w h is a few thousandths, six terms reach rounding.
    a = np.zeros((4, 4))
    a[0, 1] = h
    a[1, 0] = -w2 * h
    a[1, 1] = -d * h
    a[1, 2] = -h
    a[2, 3] = 1.0  # the slope of x'' counted per step
    e = np.eye(4)
    term = np.eye(4)
    for k in range(1, 12):
        term = term @ a / k
        e = e + term
    for i in range(2):
        out[i, 0] = e[i, 0]
        out[i, 1] = e[i, 1]
        out[i, 2] = e[i, 2] - e[i, 3]
        out[i, 3] = e[i, 3]


@njit(cache=True)
def bouc_wen_step(z: float, dx: float, xy: float) -> float:
    """z after a monotonic step dx: dz/dx = 1 - (z/xy)^2 (0.55 + 0.45 sgn(dx z)), in closed form."""
    sign = 1.0 if dx >= 0 else -1.0
    z, left = sign * z, abs(dx)
    if z < 0:
        root = math.sqrt(0.1)
        tangent = z * root / xy
        to_zero = -xy / root * math.atanh(max(tangent, -0.999999))
        if to_zero >= left:
            step = math.tanh(root * left / xy)
            return sign * xy / root * (tangent + step) / (1 + tangent * step)
        left -= to_zero
        z = 0.0
    step = math.tanh(left / xy)
    return sign * xy * (z / xy + step) / (1 + z / xy * step)


@njit(cache=True)
def chain_force(table: np.ndarray, s: np.ndarray, x: float) -> float:
    """Parallel Jenkins elements: each spring stretches to its yield, then its slider follows."""
    total = 0.0
    for i in range(table.shape[1]):
        stretch = x - s[i]
        limit = table[1, i]
        if stretch > limit:
            s[i] = x - limit
            stretch = limit
        elif stretch < -limit:
            s[i] = x + limit
            stretch = -limit
        total += table[0, i] * stretch
    return total


@njit(cache=True)
def slider(s: np.ndarray, x: float, level: float) -> float:
    """One dry contact of shear CONTACT and strength level >= 0."""
    stretch = x - s[0]
    if stretch > CONTACT:
        s[0] = x - CONTACT
        stretch = CONTACT
    elif stretch < -CONTACT:
        s[0] = x + CONTACT
        stretch = -CONTACT
    return level * stretch / CONTACT


@njit(cache=True)
def slip_level(row: np.ndarray, speed: float) -> float:
    """Friction force while slipping at that speed: constant, or falling from Fs to Fc."""
    if row[0] == COULOMB:
        return row[2]
    return row[2] + (row[3] - row[2]) * math.exp(-((speed / row[4]) ** row[5]))


@njit(cache=True)
def pinched(x: float, s: np.ndarray, depth: float, width: float) -> float:
    """Elastic displacement of a joint that slips in its own worn hole.

    Within `width` of the largest excursion so far the stiffness is (1 - depth); beyond, the joint
    closes again and meets the virgin line at that excursion. s[0] holds the excursion.
    """
    u = abs(x)
    if u >= s[0]:
        s[0] = u
        return x
    bend = width * s[0]
    low = (1 - depth) * bend
    value = (1 - depth) * u if u < bend else low + (s[0] - low) * (u - bend) / (s[0] - bend)
    return value if x > 0 else -value


@njit(cache=True)
def stop_force(row: np.ndarray, x: float, v: float) -> float:
    """Unilateral contact that loses energy: k d (1 + loss v), never adhesive; side 0 means both."""
    k, at, side, loss = row[2], row[3], row[4], row[5]
    f = 0.0
    if side >= 0 and x > at:
        f = max(k * (x - at) * (1 + loss * v), 0.0)
    elif side <= 0 and x < -at:
        f = min(k * (x + at) * (1 - loss * v), 0.0)
    return f


@njit(cache=True)
def outside(row: np.ndarray, t: float, x: float, v: float, k: float) -> float:
    """Laws that no catalogue holds and that need no state."""
    code = int(row[0])
    if code == LOCAL_BUMP:
        return row[2] * math.exp(-0.5 * ((x - row[3]) / row[4]) ** 2)
    if code == CROSS_XV:
        return row[2] * x * v
    if code == ONE_SIDED:
        return row[2] * v if x * v < 0 and x > 0 else 0.0
    if code == PARAMETRIC:
        return k * x * row[2] * math.sin(row[3] * t + row[4])
    if code == COGGING:
        return row[2] * math.sin(2 * math.pi * x / row[3] + row[4])
    if code == INTERMITTENT:
        touching = row[3] < t < row[4] or row[5] < t < row[6]
        return row[2] * math.sin(2 * math.pi * x / row[7]) ** 2 if touching else 0.0
    return 0.0


@njit(cache=True)
def reset(base: np.ndarray, laws: np.ndarray, states: np.ndarray, x: float) -> None:
    """Every slider and chain relaxed at x."""
    states[:] = 0.0
    n = laws.shape[0]
    states[n, 1] = x
    for i in range(n):
        code = int(laws[i, 0])
        if code in (COULOMB, STRIBECK, LUGRE, HYSTERESIS):
            states[i, :ELEMENTS] = x
        elif code in (DEGRADATION, WEDGE, FADING):
            states[i, 1] = x
        if code == HYSTERESIS:
            states[i, :ELEMENTS] = 0.0


@njit(cache=True)
def position_force(
    t: float,
    x: float,
    v: float,
    h: float,
    base: np.ndarray,
    laws: np.ndarray,
    tables: np.ndarray,
    states: np.ndarray,
    dry: bool,
) -> float:
    """All of the force but c v, mass terms, viscous and inertia laws; states go one step on.

    dry = False leaves Coulomb and Stribeck friction to the caller, who solves it with the motion.
    """
    n = laws.shape[0]
    effective = x
    factor = 1.0
    total = 0.0
    chain = -1
    for i in range(n):
        row = laws[i]
        s = states[i]
        code = int(row[0])
        on = t >= row[1]
        if code == GAP:
            if row[3] > 0:  # play: the far end stays until the slack is taken up
                s[0] = min(max(s[0], x - row[2]), x + row[2])
                moved = s[0]
            else:
                moved = x - row[2] if x > row[2] else (x + row[2] if x < -row[2] else 0.0)
            if on:
                effective = moved
        elif code == PINCHING:
            value = pinched(x, s, row[2], row[3])
            if on:
                effective = value
        elif code == DEGRADATION:
            if on:
                s[0] += abs(x - s[1])
                factor *= 1 - row[2] * (1 - math.exp(-s[0] / row[3]))
            s[1] = x
        elif code == STIFFNESS:
            if on:
                factor *= 1 + row[2]
        elif code == HYSTERESIS:
            chain = i
        elif code == LUGRE:
            value = chain_force(tables[i], s, x)
            if on:
                total += value
            else:
                s[:ELEMENTS] = x
        elif code in (COULOMB, STRIBECK):
            if dry:
                value = slider(s, x, slip_level(row, abs(v)))
                if on:
                    total += value
        elif code == MAXWELL:
            s[0] = s[0] * row[3] + row[2] * row[4] * (x - s[1])
            s[1] = x
            if on:
                total += s[0]
        elif code == WEDGE:
            total += slider(s, x, row[2] * abs(x))
        elif code == FADING:  # softens while it is held out, heals while it is home
            s[0] += h / row[3] * ((1.0 if abs(x) > row[4] else 0.0) - s[0])
            factor *= 1 - row[2] * s[0]
        elif not on:
            continue
        elif code == QUAD_DAMPING:
            total += row[2] * v * abs(v)
        elif code == CUBIC:
            total += row[2] * x * x * x
        elif code == QUADRATIC:
            total += row[2] * x * x
        elif code == STOPPER:
            total += stop_force(row, x, v)
        elif code > 30:
            total += outside(row, t, x, v, base[0])
    own = states[n]
    if base[3] > 0:
        own[0] = bouc_wen_step(own[0], effective - own[1], base[5])
        elastic = base[0] * (base[4] * effective + (1 - base[4]) * own[0])
    elif chain >= 0:
        yielded = chain_force(tables[chain], states[chain], effective)
        share = laws[chain, 2]
        if t >= laws[chain, 1]:
            elastic = base[0] * (share * effective + (1 - share) * yielded)
        else:
            elastic = base[0] * effective
    else:
        elastic = base[0] * effective
    own[1] = effective
    return elastic * factor + total


@njit(cache=True)
def linear_terms(t: float, base: np.ndarray, laws: np.ndarray) -> tuple[float, float]:
    """Damping coefficient and moving mass that act at t."""
    c, m = base[1], base[2]
    for i in range(laws.shape[0]):
        if t >= laws[i, 1]:
            if laws[i, 0] == VISCOUS:
                c += laws[i, 2]
            elif laws[i, 0] == INERTIA:
                m += laws[i, 2]
    return c, m


@njit(cache=True)
def mode_force(row: np.ndarray, s: np.ndarray, m: np.ndarray, a0: float, a1: float) -> float:
    """Reaction of the second mass; s holds its displacement against the specimen and the rate."""
    r = m[0, 0] * s[0] + m[0, 1] * s[1] + m[0, 2] * a0 + m[0, 3] * a1
    rate = m[1, 0] * s[0] + m[1, 1] * s[1] + m[1, 2] * a0 + m[1, 3] * a1
    s[0], s[1] = r, rate
    return -row[2] * (row[3] * r + row[4] * rate)


@njit(cache=True)
def modes(laws: np.ndarray, h: float) -> np.ndarray:
    out = np.zeros((laws.shape[0], 2, 4))
    for i in range(laws.shape[0]):
        if laws[i, 0] == SECOND_MODE:
            second_mode_matrix(laws[i, 3], laws[i, 4], h, out[i])
    return out


@njit(cache=True)
def prescribed(
    t0: float,
    h: float,
    x: np.ndarray,
    v: np.ndarray,
    a: np.ndarray,
    base: np.ndarray,
    laws: np.ndarray,
    tables: np.ndarray,
    states: np.ndarray,
) -> np.ndarray:
    """Force along a given motion, N, one value a fine step."""
    f = np.empty(x.size)
    transition = modes(laws, h)
    reset(base, laws, states, x[0])
    last = a[0]
    for i in range(x.size):
        t = t0 + i * h
        c, m = linear_terms(t, base, laws)
        f[i] = position_force(t, x[i], v[i], h, base, laws, tables, states, True)
        f[i] += c * v[i] + m * a[i]
        for j in range(laws.shape[0]):
            if laws[j, 0] == SECOND_MODE:
                value = mode_force(laws[j], states[j], transition[j], last, a[i])
                if t >= laws[j, 1]:
                    f[i] += value
        last = a[i]
    return f


def along(
    specimen: Specimen, t0: float, h: float, x: np.ndarray, v: np.ndarray, a: np.ndarray
) -> np.ndarray:
    """Force of the specimen along x, v, a (m, m/s, m/s^2; one value a step h from t0)."""
    return prescribed(t0, h, x, v, a, *specimen.compiled(h))
