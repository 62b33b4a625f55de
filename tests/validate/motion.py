"""Motions: a free body by an implicit exact-propagation scheme, actuators, the closed loop.

The linear part of every system is propagated exactly between breakpoints (its input runs straight
there). The force of the laws is an unknown of the step, found between brackets: a set-valued law,
which has a force but no velocity while it sticks, needs nothing of its own in this scheme.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit

from validate import laws
from validate.laws import Law


def propagator(system: np.ndarray, drive: np.ndarray, h: float) -> np.ndarray:
    """[Phi, B0, B1] of y' = system y + drive u over h, u running straight from u0 to u1."""
    n = system.shape[0]
    big = np.zeros((n + 2, n + 2))
    big[:n, :n] = system * h
    big[:n, n] = drive * h
    big[n, n + 1] = 1.0
    squarings = max(0, math.ceil(math.log2(max(np.abs(big).sum(axis=1).max(), 1e-9))) + 4)
    scaled = big / 2.0**squarings
    total, term = np.eye(n + 2), np.eye(n + 2)
    for i in range(1, 14):
        term = term @ scaled / i
        total = total + term
    for _ in range(squarings):
        total = total @ total
    step, ramp = total[:n, n], total[:n, n + 1]
    return np.column_stack((total[:n, :n], step - ramp, ramp))


@njit(cache=True)
def _law_sum(kinds, ps, onsets, s, q, x, v, t, h):
    """Force of all laws at a trial end of the step; their memories go to q."""
    total = 0.0
    for i in range(kinds.size):
        f = laws.advance(kinds[i], ps[i], s[i], q[i], x, v, 0.0, t, h)
        total += f * laws.gate(t, onsets[i])
    return total


@njit(cache=True)
def _settle(kinds, ps, onsets, s, q, x, v, bx, bv, guess, t, h):
    """The force g with g = laws(x - bx g, v - bv g): iterated, or bracketed where laws jump."""
    g = guess
    new = _law_sum(kinds, ps, onsets, s, q, x - bx * g, v - bv * g, t, h)
    for _ in range(4):
        g, last = new, g
        new = _law_sum(kinds, ps, onsets, s, q, x - bx * g, v - bv * g, t, h)
        if abs(new - g) <= 1e-9 * (abs(g) + 1e-3):
            return new
        if (new - g) * (g - last) > 0 and abs(new - g) > abs(g - last):
            break
    low, high = min(g, new), max(g, new)
    for _ in range(60):
        g = 0.5 * (low + high)
        new = _law_sum(kinds, ps, onsets, s, q, x - bx * g, v - bv * g, t, h)
        if new > g:
            low = g
        else:
            high = g
        if high - low <= 1e-9 * (abs(g) + 1e-3):
            break
    return 0.5 * (low + high)


@njit(cache=True)
def _free(table, kinds, ps, onsets, load, h, x, v):
    n = load.size
    out = np.zeros((3, n))
    s = np.zeros((kinds.size, laws.NS))
    q = np.zeros((kinds.size, laws.NS))
    laws.begin(s, kinds, x, v)
    g = _law_sum(kinds, ps, onsets, s, q, x, v, 0.0, h)
    s[:] = q
    out[0, 0], out[1, 0], out[2, 0] = x, v, g
    for j in range(1, n):
        r = load[j - 1] - g
        xs = table[0, 0] * x + table[0, 1] * v + table[0, 2] * r + table[0, 3] * load[j]
        vs = table[1, 0] * x + table[1, 1] * v + table[1, 2] * r + table[1, 3] * load[j]
        g = _settle(kinds, ps, onsets, s, q, xs, vs, table[0, 3], table[1, 3], g, j * h, h)
        x, v = xs - table[0, 3] * g, vs - table[1, 3] * g
        s[:] = q
        out[0, j], out[1, j], out[2, j] = x, v, g
    return out


def free_body(
    mass: float, c: float, k: float, specimen: list[Law], load: np.ndarray, h: float,
    start: tuple[float, float] = (0.0, 0.0),
) -> np.ndarray:  # fmt: skip
    """x, v, a and the force of the laws of mass x'' + c x' + k x + laws = load, rows of h apart."""
    system = np.array([[0.0, 1.0], [-k / mass, -c / mass]])
    table = propagator(system, np.array([0.0, 1.0 / mass]), h)
    x, v, g = _free(table, *laws.packed(specimen), np.ascontiguousarray(load), h, *start)
    return np.array([x, v, (load - c * v - k * x - g) / mass, g])


# ---- actuators ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class Actuator:
    """What moves the specimen. `kind`: second, first, pure or hydraulic; rates of change beside it.

    A first-order lag has its corner in f_hz; a hydraulic one its oil column in f_hz and zeta.
    """

    kind: str = "second"
    delay_s: float = 0.004
    f_hz: float = 25.0
    zeta: float = 0.8
    gain: float = 1.0
    kappa: float = 0.0  # s^2/m: the delay grows with velocity
    kappa_on: str = "output"  # with |v|, or "smooth" about v = 0
    vmax: float = math.inf
    limit: str = "slew"  # the command is slowed down, or the valve saturates
    stall_n: float = math.inf  # hydraulic: force at which the valve gives nothing
    load_k: float = 0.0  # hydraulic: what it pushes against

    @property
    def lag_s(self) -> float:
        """Delay that a slow command sees."""
        w = 2 * math.pi * self.f_hz
        own = {"second": 2 * self.zeta / w, "first": 1 / w, "pure": 0.0}
        return self.delay_s + own.get(self.kind, 1 / _LOOP_GAIN + _VALVE_S)


_CORNER = 0.03  # of the largest speed: how far a smooth |v| is from the sharp one
_LOOP_GAIN, _VALVE_S = 95.0, 0.0025  # 1/s of the servo's loop, lag of its valve
KINDS = ("second", "first", "pure", "hydraulic")


@njit(cache=True)
def _hydraulic(y, u, h, w, zeta, stall, load_k, vmax):
    """Loop gain, valve with the root law of flow, oil column, table: y is spool, piston, x, v."""
    spool = y[0] + h * (_LOOP_GAIN * (u - y[2]) - y[0]) / _VALVE_S
    spool = min(max(spool, -vmax), vmax)
    share = 1.0 - np.sign(spool) * load_k * y[2] / stall
    flow = spool * math.sqrt(max(share, 0.0))
    piston = y[1] + h * flow
    accel = w * w * (piston - y[2]) + 2.0 * zeta * w * (flow - y[3])
    v = y[3] + h * accel
    y[0], y[1], y[2], y[3] = spool, piston, y[2] + h * v, v
    return accel


@njit(cache=True)
def _slewed(y, u, slope, h, vmax):
    """Where a signal that is no faster than vmax comes to in h behind one that runs straight.

    Exact where both meet inside the step: what a step misses there stays until they meet again.
    """
    gap, along = u - y, min(max(slope, -vmax), vmax)
    chase = math.copysign(vmax, gap)
    closing = math.copysign(1.0, gap) * (chase - slope)
    alone = h if closing <= 0.0 else min(abs(gap) / closing, h)
    return y + chase * alone + along * (h - alone)


@njit(cache=True)
def _step(code, par, table, y, u0, u1, h):
    """One step of an actuator without its delay; y holds its state, y[2:4] motion, y[4] shaper."""
    vmax, valve = par[3], par[4] > 0.0
    if not valve and vmax < 1e9:
        u0, u1 = y[4], _slewed(y[4], u0, (u1 - u0) / h, h, vmax)
        y[4] = u1
    if code == 3:
        return _hydraulic(y, u0, h, par[0], par[1], par[5], par[6], vmax if valve else 1e9)
    if code == 2:
        y[3] = (u1 - y[2]) / h
        y[2] = u1
        return 0.0
    x = table[0, 0] * y[2] + table[0, 1] * y[3] + table[0, 2] * u0 + table[0, 3] * u1
    v = table[1, 0] * y[2] + table[1, 1] * y[3] + table[1, 2] * u0 + table[1, 3] * u1
    if code == 1:  # the state of a first-order lag is its place alone
        v = par[0] * (u1 - x)
        y[2], y[3] = x, v
        return par[0] * ((u1 - u0) / h - v)
    accel = par[0] ** 2 * (u1 - x) - 2.0 * par[1] * par[0] * v
    if valve and abs(v) > vmax:
        v = math.copysign(vmax, v)
        x = y[2] + 0.5 * h * (y[3] + v)
        accel = (v - y[3]) / h
    y[2], y[3] = x, v
    return accel


@njit(cache=True)
def _track(code, par, table, u, h, sub):
    n = sub * (u.size - 1) + 1
    out = np.zeros((3, n))
    y = np.zeros(5)
    y[1], y[2], y[4] = u[0], u[0], u[0]
    out[0, 0] = u[0]
    for j in range(1, n):
        row, part = (j - 1) // sub, (j - 1) % sub
        slope = (u[row + 1] - u[row]) / sub
        a = _step(code, par, table, y, u[row] + slope * part, u[row] + slope * (part + 1), h)
        out[0, j], out[1, j], out[2, j] = y[2], y[3], a
    return out


@njit(cache=True)
def hermite(x0, v0, x1, v1, part, h):
    """Displacement between two instants of which place and velocity are known."""
    b = part * part * (3.0 - 2.0 * part)
    c = part * (1.0 - part) * (1.0 - part)
    d = part * part * (part - 1.0)
    return x0 * (1.0 - b) + x1 * b + h * (c * v0 + d * v1)


@njit(cache=True)
def _late(fine, back, h):
    """A fine motion as it was `back[j]` seconds before."""
    out = np.zeros(fine.shape)
    for j in range(fine.shape[1]):
        where = max(j - back[j] / h, 0.0)
        i = min(int(where), fine.shape[1] - 2)
        part = where - i
        out[0, j] = hermite(fine[0, i], fine[1, i], fine[0, i + 1], fine[1, i + 1], part, h)
        for row in (1, 2):
            out[row, j] = fine[row, i] + part * (fine[row, i + 1] - fine[row, i])
    return out


def compiled(a: Actuator, h: float) -> tuple[int, np.ndarray, np.ndarray]:
    """Code, numbers and exact propagator of an actuator for the compiled steps."""
    w = 2 * math.pi * a.f_hz
    if a.kind == "first":
        system, drive = np.array([[-w, 0.0], [0.0, 0.0]]), np.array([w, 0.0])
    else:
        system, drive = np.array([[0.0, 1.0], [-w * w, -2 * a.zeta * w]]), np.array([0.0, w * w])
    valve = 1.0 if a.limit == "valve" else 0.0
    par = np.array([w, a.zeta, a.gain, min(a.vmax, 1e12), valve, min(a.stall_n, 1e15), a.load_k])
    return KINDS.index(a.kind), par, propagator(system, drive, h)


def track(command: np.ndarray, dt: float, sub: int, a: Actuator) -> np.ndarray:
    """x, v, a at `sub` steps a row of an actuator that follows rows of command, joined straight."""
    h = dt / sub
    u = np.ascontiguousarray(a.gain * command, float)
    fine = _track(*compiled(a, h), u, h, sub)
    # A step of the fine grid gives the velocity of these two late by half of it, and the
    # acceleration of all but the exact one late by as much or more.
    if a.kind in ("pure", "hydraulic"):
        fine[1] = np.gradient(fine[0], h)
    if a.kind != "second":
        fine[2] = np.gradient(fine[1], h)
    if a.kind == "pure":  # its velocity steps at rows: the mean over a row either way
        fine[1] = np.convolve(np.pad(fine[1], sub, mode="edge"), np.ones(2 * sub + 1), "valid")
        fine[1] /= 2 * sub + 1
        fine[2] = 0.0
    at = np.arange(fine.shape[1]) - a.delay_s / h
    if not a.kappa:
        return _late(fine, np.full(fine.shape[1], a.delay_s), h)
    # The velocity of the motion that it delays: of any other, the piston would jerk at turns.
    v, accel = (np.interp(at, np.arange(at.size), row) for row in fine[1:])
    corner = _CORNER * np.max(np.abs(v)) if a.kappa_on == "smooth" else 0.0
    speed = np.hypot(v, corner)
    late = _late(fine, a.delay_s + a.kappa * (speed - corner), h)
    if a.kind != "second":
        late[1] = np.gradient(late[0], h)
        late[2] = np.gradient(late[1], h)
        return late
    # By the chain rule: the acceleration jumps where the command has bent, between rows, and a
    # difference of velocities would smear it over the row beside. Steps end where it bends.
    step = np.clip(np.floor(at).astype(int), 0, at.size - 2)
    jerk = (fine[2, step + 1] - fine[2, step]) / h
    toward = np.divide(v, speed, out=np.zeros_like(v), where=speed > 0.0)
    bent = np.divide(corner**2 * accel**2, speed**3, out=np.zeros_like(v), where=speed > 0.0)
    pace = 1.0 - a.kappa * toward * accel
    late[2] = late[2] * pace**2 - late[1] * a.kappa * (toward * jerk + bent)
    late[1] *= pace
    return late


def stated(a: Actuator) -> Actuator:
    """The second-order actuator that a lab would state for this one, where one comes near."""
    w = 2 * math.pi * a.f_hz
    if a.kind == "first":  # a second pole far above, its lag taken off the delay
        far = 2 * math.pi * 300.0
        f = math.sqrt(w * far)
        return Actuator("second", a.delay_s - 1 / far, f / (2 * math.pi), (w + far) / (2 * f))
    if a.kind == "pure":
        return Actuator("second", a.delay_s - 1.4 / (2 * math.pi * 400.0), 400.0, 0.7)
    return a


# ---- the closed loop ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Loop:
    """The numerical part, the compensators, and what the sensors of the loop add."""

    mass: float
    c: float
    k_e: float
    alpha: float  # samples of lead
    rfc: bool = True
    ag_shift: int = 0
    skew_s: float = 0.0
    lsb_n: float = 0.0


@njit(cache=True)
def _tangent(f, x, i, window, k_e):
    """Slope of force over displacement in the last `window` rows, between 0 and k_e."""
    if i < 2 * window:
        return k_e
    mf = mx = 0.0
    for j in range(i - window, i):
        mf += f[j] / window
        mx += x[j] / window
    cov = var = 0.0
    for j in range(i - window, i):
        cov += (f[j] - mf) * (x[j] - mx)
        var += (x[j] - mx) ** 2
    return k_e if var <= 0.0 else min(max(cov / var, 0.0), k_e)


@njit(cache=True)
def _rows(fine, force, when, h):
    """Displacement and force at an instant that lies within the fine history."""
    i = max(min(int(when), fine.shape[1] - 2), 0)
    part = when - i
    return force[i] + part * (force[i + 1] - force[i])


@njit(cache=True)
def _loop(code, par, table, back, kinds, ps, onsets, core, ag, dt, sub, c, added, xn, fn):
    """core: specimen k, c, mass. c: mass, damping, k_e, alpha, rfc, skew, lsb, gain."""
    n, h = ag.size, dt / sub
    fine, lag = np.zeros((3, sub * (n - 1) + 1)), np.zeros((3, sub * (n - 1) + 1))
    force = np.zeros(fine.shape[1])
    s, q = np.zeros((kinds.size, laws.NS)), np.zeros((kinds.size, laws.NS))
    num, cmd, fm, xm, clean = np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n)
    y, v = np.zeros(5), 0.0
    e1 = e2 = 0.0
    for i in range(1, n):
        kt = _tangent(fm, xm, i, 100, c[2]) if c[4] > 0 else 0.0
        fed = fm[i - 1] + kt * (num[i - 1] - xm[i - 1])
        v = (v * (1 - 0.5 * dt * c[1] / c[0]) - dt * (fed / c[0] + ag[i])) / (
            1 + 0.5 * dt * c[1] / c[0]
        )
        num[i] = num[i - 1] + dt * v
        e = (6.0 * c[3] * (num[i] - num[i - 1]) - 2.0 * e1 - e2) / 3.0
        e1, e2 = e, e1
        cmd[i] = num[i] + e
        for part in range(sub):
            j = (i - 1) * sub + part + 1
            slope = c[7] * (cmd[i] - cmd[i - 1]) / sub
            u0 = c[7] * cmd[i - 1] + slope * part
            a = _step(code, par, table, y, u0, u0 + slope, h)
            fine[0, j], fine[1, j], fine[2, j] = y[2], y[3], a
            where = max(j - back[0] / h, 0.0)
            k = min(int(where), j - 1)
            v0 = fine[1, k] + (where - k) * (fine[1, k + 1] - fine[1, k])
            a0 = fine[2, k] + (where - k) * (fine[2, k + 1] - fine[2, k])
            jerk = (fine[2, k + 1] - fine[2, k]) / h
            where = max(where - back[1] * abs(v0) / h, 0.0)
            k = min(int(where), j - 1)
            w = where - k
            lag[0, j] = hermite(fine[0, k], fine[1, k], fine[0, k + 1], fine[1, k + 1], w, h)
            # Time runs unevenly behind such a delay: by the chain rule, its second term included.
            pace = 1.0 - back[1] * np.sign(v0) * a0
            bend = -back[1] * np.sign(v0) * jerk
            vb = fine[1, k] + w * (fine[1, k + 1] - fine[1, k])
            ab = fine[2, k] + w * (fine[2, k + 1] - fine[2, k])
            lag[1, j], lag[2, j] = vb * pace, ab * pace**2 + vb * bend
            total = core[0] * lag[0, j] + core[1] * lag[1, j] + core[2] * lag[2, j]
            for m in range(kinds.size):
                f = laws.advance(
                    kinds[m], ps[m], s[m], q[m], lag[0, j], lag[1, j], lag[2, j], j * h, h
                )
                total += f * laws.gate(j * h, onsets[m])
            s[:] = q
            force[j] = total
        seen = max(min(i * sub - c[5] / h, 1.0 * i * sub), 0.0)
        clean[i] = _rows(fine, force, seen, h) + added[i]
        fm[i] = clean[i] + fn[i]
        if c[6] > 0:
            fm[i] = round(fm[i] / c[6]) * c[6]
        xm[i] = lag[0, i * sub] + xn[i]
        if not abs(xm[i]) < 1.0:
            break
    return num, cmd, fm, xm, clean, lag, force


def closed_loop(
    loop: Loop, a: Actuator, specimen: tuple[float, float, float], effects: list[Law],
    ag: np.ndarray, dt: float, sub: int, added: np.ndarray, x_noise: np.ndarray,
    f_noise: np.ndarray,
) -> dict[str, np.ndarray]:  # fmt: skip
    """A closed hybrid test, noise and all; `added` is what the load cell shows beside the force."""
    shifted = np.roll(ag, loop.ag_shift)
    numbers = np.array(
        [loop.mass, loop.c, loop.k_e, loop.alpha, float(loop.rfc), loop.skew_s, loop.lsb_n, a.gain]
    )
    done = _loop(
        *compiled(a, dt / sub), np.array([a.delay_s, a.kappa]), *laws.packed(effects),
        np.array(specimen), shifted, dt, sub, numbers, added, x_noise, f_noise,
    )  # fmt: skip
    return dict(
        zip(("x_num", "x_cmd", "f_meas", "x_meas", "f", "fine", "force"), done, strict=True)
    )
