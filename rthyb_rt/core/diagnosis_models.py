"""The diagnosis' compiled simulators: an actuator along its command, a body under a force."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core.settings import init_element
from rthyb_rt.errors import RthybError

Floats = NDArray[np.float64]
Rows = NDArray[np.intp]
Hold = Literal["zoh", "foh"]


class SimulationError(RthybError, ValueError):
    """A simulator rejected its settings, or its motion diverged."""


@dataclass(frozen=True)
class ActuatorModel:
    """``gain exp(-delay s) w^2 / (s^2 + 2 zeta w s + w^2)``, with imperfections.

    Attributes:
        delay_s, f_hz, zeta, gain: the linear part.
        shift_s: shift of the command relative to the rows, in addition to the delay.
        kappa_s2_m: additional delay per m/s.
        kappa_of: what is late by it: the command, by its own velocity ("command") or by the
            actuator's at that time ("actuator"), or the motion, by its own ("motion"): a delay
            before the lag, or after it.
        vmax_m_s: velocity limit of the command, or of the actuator itself; 0 for none.
        jumps: whether it moves in steps from row to row and has the velocity of its last step, like
            the virtual rig's pure delay.
        delay_tol_s: standard deviation of the delay, s; None: not stated, so it is fitted freely.
        f_tol, zeta_tol, gain_tol: of the others, relative to the value; None as above.
    """

    delay_s: float
    f_hz: float
    zeta: float
    gain: float = 1.0
    shift_s: float = 0.0
    kappa_s2_m: float = 0.0
    kappa_of: Literal["actuator", "command", "motion"] = "actuator"
    vmax_m_s: float = 0.0
    vmax_of: Literal["command", "actuator"] = "command"
    hold: Hold = "foh"
    jumps: bool = False
    delay_tol_s: float | None = None
    f_tol: float | None = None
    zeta_tol: float | None = None
    gain_tol: float | None = None


@dataclass(frozen=True)
class ComputedMotion:
    """Displacement, velocity, acceleration at the rows, each (n,).

    Attributes:
        between: the same motion later by a share of a row, 0 to 1, where it is known between rows:
            a held command changes the acceleration abruptly at each, and no curve through the rows
            shows what lies between.
    """

    x: Floats
    v: Floats
    a: Floats
    between: Callable[[float], ComputedMotion] | None = None

    def from_zero(self, zero_m: float) -> ComputedMotion:
        """Return the motion as a sensor shows it that reads ``zero_m`` where it is zero."""
        between = self.between

        def late(share: float) -> ComputedMotion:
            assert between is not None
            return between(share).from_zero(zero_m)

        return replace(self, x=self.x + zero_m, between=late if between is not None else None)


def _in(array: Floats) -> Any:
    return ffi.from_buffer("double[]", np.ascontiguousarray(array, dtype=np.float64))


def _out(array: Floats) -> Any:
    return ffi.from_buffer("double[]", array, require_writable=True)


def _holds(hold: Hold) -> int:
    return int(lib.RTHYB_ZOH if hold == "zoh" else lib.RTHYB_FOH)


BLOCK = 1 << 15
"""Rows that are delayed at a time."""


def actuator(
    model: ActuatorModel,
    x_cmd_m: Floats,
    fs_hz: float,
    before: tuple[float, ActuatorModel] | None = None,
) -> ComputedMotion:
    """Return an actuator's motion along commands of shape (n,), m, starting at rest at the first.

    Args:
        model: the actuator.
        x_cmd_m: command, (n,), m.
        fs_hz: rows per second.
        before: actuator up to a row, which may be fractional and is that end if it is beyond
            either; displacement and velocity continue.

    Raises:
        SimulationError: a setting is out of range, or the motion diverged.
    """
    if before is not None and not np.isfinite(before[0]):
        raise SimulationError(
            f"before: found row {before[0]} as the end of the first actuator; it must be a finite "
            "number: 0 is the first row of the command"
        )
    if np.size(x_cmd_m) > 1 and any(map(_late_by_its_speed, _both(model, before))):
        moved = _late_by_speed(model, np.asarray(x_cmd_m, dtype=np.float64), fs_hz, before)
    else:
        moved = _on_its_own(model, x_cmd_m, fs_hz, before)
    if model.jumps:
        return moved

    def between(share: float) -> ComputedMotion:
        def late(one: ActuatorModel) -> ActuatorModel:
            return replace(one, shift_s=one.shift_s + share / fs_hz)

        then = (before[0] + share, late(before[1])) if before else None
        return actuator(late(model), x_cmd_m, fs_hz, then)

    return replace(moved, between=between)


def _on_its_own(
    model: ActuatorModel, x_cmd_m: Floats, fs_hz: float, before: tuple[float, ActuatorModel] | None
) -> ComputedMotion:
    """Return the motion as the core simulates it; in steps, velocities by differences."""
    first = _compiled(before[1] if before else model, fs_hz)
    u = np.ascontiguousarray(x_cmd_m, dtype=np.float64)
    x, v, a = np.empty_like(u), np.empty_like(u), np.empty_like(u)
    code = lib.rthyb_simulate_actuator(
        first, _compiled(model, fs_hz), before[0] if before else 0.0, _in(u), u.size,
        _out(x), _out(v), _out(a),
    )  # fmt: skip
    if code:
        raise SimulationError(
            f"the actuator {model} cannot be simulated (error {code} of the core)"
        )
    if model.jumps:
        v = np.diff(x, prepend=x[0]) * fs_hz
        a = np.diff(v, prepend=v[0]) * fs_hz
    return ComputedMotion(x, v, a)


def _both(
    model: ActuatorModel, before: tuple[float, ActuatorModel] | None
) -> tuple[ActuatorModel, ...]:
    return (model, before[1]) if before else (model,)


def _late_by_its_speed(model: ActuatorModel) -> bool:
    return model.kappa_of == "motion" and model.kappa_s2_m != 0.0


KAPPA_MAX_S2_M = 1e3
"""Largest additional delay per m/s that is simulated, as in the core."""
FINEST = 8
"""Parts of a row, at most, at which a motion is simulated that is late by its own velocity."""


def _late_by_speed(
    model: ActuatorModel, u: Floats, fs_hz: float, before: tuple[float, ActuatorModel] | None
) -> ComputedMotion:
    """Return ``x(t) = x0(t - kappa |v0(t)|)``, with another kappa up to a row, and its derivatives.

    By the chain rule, with ``T' = 1 - kappa sgn(v0) a0``: ``v = v0(T) T'`` and
    ``a = a0(T) T'^2 - v0(T) kappa sgn(v0) j0``. Between two rows, or two of their parts, x0 and v0
    are the cubics that have the values and slopes of both, and a0 is straight: parts are so short
    that a0 hardly bends in one, after the command has changed its slope.
    """
    for one in _both(model, before):
        if not abs(one.kappa_s2_m) <= KAPPA_MAX_S2_M:
            raise SimulationError(
                f"the actuator {one} cannot be simulated: kappa_s2_m must be a number from "
                f"{-KAPPA_MAX_S2_M:g} to {KAPPA_MAX_S2_M:g}"
            )
    row, first = before or (0.0, model)
    later_s2_m, early_s2_m = (
        one.kappa_s2_m if one.kappa_of == "motion" else 0.0 for one in (model, first)
    )
    on_time, jerk, parts = _on_time(model, u, fs_hz, before)
    fine_hz, last = fs_hz * parts, on_time.x.size - 1
    n = u.size
    x, v, a = np.empty(n), np.empty(n), np.empty(n)
    for begin in range(0, n, BLOCK):  # in blocks: a long recording has no dozen copies
        rows = np.arange(begin, min(begin + BLOCK, n))
        at = rows * parts
        own = on_time.v[at]
        kappa = np.where(rows >= row, later_s2_m, early_s2_m)
        place = np.clip(at - kappa * np.abs(own) * fine_hz, 0.0, last)
        i = np.minimum(place.astype(np.intp), max(last - 1, 0))
        j, s = np.minimum(i + 1, last), place - i
        way = kappa * np.sign(own)
        pace = 1.0 - way * on_time.a[at]
        then = _between(on_time.v, on_time.a / fine_hz, i, j, s)
        x[rows] = _between(on_time.x, on_time.v / fine_hz, i, j, s)
        v[rows] = then * pace
        if jerk is not None:
            a[rows] = (on_time.a[i] + s * (on_time.a[j] - on_time.a[i])) * pace**2
            a[rows] -= then * way * jerk[at]
    return ComputedMotion(x, v, a if jerk is not None else np.gradient(v) * fs_hz)


def _on_time(
    model: ActuatorModel, u: Floats, fs_hz: float, before: tuple[float, ActuatorModel] | None
) -> tuple[ComputedMotion, Floats | None, int]:
    """Return the motion without that delay at parts of rows, its jerk, m/s^3, and parts a row.

    No jerk if the motion does not follow the equation of the lag from row to row: in steps, at a
    velocity limit, or if the lag forgets a change of the command's slope within a part of a row.
    """
    both = tuple(map(_without_it, _both(model, before)))
    rate = max(4.0 * np.pi * m.zeta * m.f_hz for m in both)  # it does so within 1 / (2 zeta w)
    linear = not any(m.jumps or m.vmax_m_s or m.kappa_s2_m for m in both)
    smooth = linear and rate <= FINEST * fs_hz
    parts = int(np.clip(np.ceil(4.0 * rate / fs_hz), 1, FINEST)) if smooth else 1
    at = np.arange(parts * (u.size - 1) + 1) / parts
    finer = u if parts == 1 else u[at.astype(np.intp)]
    if parts > 1 and model.hold == "foh":
        finer = np.interp(at, np.arange(u.size), u)
    early = (before[0] * parts, both[1]) if before else None
    moved = actuator(both[0], finer, fs_hz * parts, early)
    if not smooth:
        return moved, None, parts
    jerk = _jerk(both[0], finer, moved, fs_hz * parts)
    if early is not None:
        first = _jerk(early[1], finer, moved, fs_hz * parts)
        jerk = np.where(np.arange(jerk.size) >= early[0], jerk, first)
    return moved, jerk, parts


def _without_it(model: ActuatorModel) -> ActuatorModel:
    """Return an actuator whose motion is not late by its own velocity, and else the same."""
    return replace(model, kappa_s2_m=0.0) if model.kappa_of == "motion" else model


def _jerk(model: ActuatorModel, u: Floats, moved: ComputedMotion, fs_hz: float) -> Floats:
    """Return the derivative of an actuator's acceleration at every row, (n,), m/s^3.

    Of ``x'' = w^2 (u - x) - 2 zeta w x'``. A command of straight lines changes its slope at every
    row, so that this derivative jumps there: it is no difference of accelerations of the rows.
    """
    w = 2.0 * np.pi * model.f_hz
    slope = np.zeros(u.size)
    if model.hold == "foh":
        late = (model.delay_s + model.shift_s) * fs_hz
        at = np.floor(np.arange(u.size) - late).astype(np.intp)
        within = (at >= 0) & (at < u.size - 1)
        slope[within] = model.gain * np.diff(u)[at[within]] * fs_hz
    return np.asarray(w**2 * (slope - moved.v) - 2.0 * model.zeta * w * moved.a)


def _between(y: Floats, slope: Floats, i: Rows, j: Rows, s: Floats) -> Floats:
    """Return the cubic between rows i and j, at s from 0 to 1, with its slope per row at both."""
    y0, y1, d0, d1 = y[i], y[j], slope[i], slope[j]
    bend = 3.0 * (y1 - y0) - 2.0 * d0 - d1
    return np.asarray(y0 + s * (d0 + s * (bend + s * (2.0 * (y0 - y1) + d0 + d1))))


def _compiled(model: ActuatorModel, fs_hz: float) -> Any:
    return ffi.new(
        "rthyb_actuator_model *",
        {
            "period_s": 1.0 / fs_hz,
            "delay_s": model.delay_s,
            "natural_frequency_hz": model.f_hz,
            "damping_ratio": model.zeta,
            "gain": model.gain,
            "shift_s": model.shift_s,
            "delay_rate_s2_per_m": 0.0 if model.kappa_of == "motion" else model.kappa_s2_m,
            "velocity_limit_m_per_s": model.vmax_m_s,
            "limit_at": int(model.vmax_of == "actuator"),
            "rate_of": int(model.kappa_of == "command"),
            "hold": _holds(model.hold),
        },
    )


def body(
    mass_kg: float,
    elements: Sequence[core.ElementConfig],
    force_n: Floats,
    fs_hz: float,
    start: tuple[float, float] = (0.0, 0.0),
    hold: Hold = "foh",
    substeps: int = 8,
) -> ComputedMotion:
    """Return the motion of ``mass a + elements = force`` under a force of shape (n,), N.

    Raises:
        SimulationError: the mass is not positive, or the motion diverged.
        core.CoreError: an element's parameter is out of range.
    """
    model = ffi.new(
        "rthyb_body_model *",
        {
            "period_s": 1.0 / fs_hz,
            "mass_kg": mass_kg,
            "x0_m": start[0],
            "v0_m_per_s": start[1],
            "hold": _holds(hold),
            "substeps": substeps,
        },
    )
    array = ffi.new("rthyb_element[]", max(len(elements), 1))
    for slot, config in zip(array, elements, strict=False):
        init_element(slot, config)
    p = np.ascontiguousarray(force_n, dtype=np.float64)
    x, v, a = np.empty_like(p), np.empty_like(p), np.empty_like(p)
    code = lib.rthyb_simulate_body(
        model, array, len(elements), _in(p), p.size, _out(x), _out(v), _out(a)
    )
    if code:
        raise SimulationError(
            f"a body of {mass_kg:g} kg cannot be simulated (error {code} of the core)"
        )
    return ComputedMotion(x, v, a)


def play(half_m: float, x_m: Floats) -> Floats:
    """Return the motion behind a backlash of ±``half_m`` driven by ``x_m`` of shape (n,), m."""
    x = np.ascontiguousarray(x_m, dtype=np.float64)
    y = np.empty_like(x)
    if lib.rthyb_simulate_play(half_m, _in(x), x.size, _out(y)):
        raise SimulationError(f"found a play of {half_m:g} m; it must not be negative")
    return y


def iwan(yield_m: Floats, share: Floats, x_m: Floats) -> Floats:
    """Return the plastic displacement of parallel springs that yield in turn, (n,), m."""
    x = np.ascontiguousarray(x_m, dtype=np.float64)
    f = np.empty_like(x)
    y = np.ascontiguousarray(yield_m, dtype=np.float64)
    if lib.rthyb_simulate_iwan(_in(y), _in(share), y.size, _in(x), x.size, _out(f)):
        raise SimulationError(f"found {y.size} springs, more than the core accepts")
    return f
