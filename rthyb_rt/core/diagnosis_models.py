"""The diagnosis' compiled simulators: an actuator along its command, a body under a force."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt._core import ffi, lib
from rthyb_rt.core.settings import init_element
from rthyb_rt.errors import RthybError

Floats = NDArray[np.float64]
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
    """Displacement, velocity, acceleration at the rows, each (n,); ``start`` rows are transient."""

    x: Floats
    v: Floats
    a: Floats


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
        before: actuator up to a row, which may be fractional; displacement and velocity continue.

    Raises:
        SimulationError: a setting is out of range, or the motion diverged.
    """
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
    moved = ComputedMotion(x, v, a)
    if model.kappa_of == "motion" and model.kappa_s2_m != 0.0:
        return _late_by_speed(moved, model.kappa_s2_m, fs_hz, before[0] if before else 0.0)
    return moved


def _late_by_speed(
    on_time: ComputedMotion, kappa_s2_m: float, fs_hz: float, row: float
) -> ComputedMotion:
    """Return ``x(t) = x0(t - kappa |v0(t)|)`` from a row on, and its derivatives.

    Between the rows, x0 is the cubic that has the displacements and velocities of both.
    """
    n = on_time.x.size
    x, v = np.empty(n), np.empty(n)
    for first in range(0, n, BLOCK):  # in blocks: a long recording has no dozen copies
        at = np.arange(first, min(first + BLOCK, n))
        own, speed = on_time.v[at], np.where(at >= row, kappa_s2_m * np.abs(on_time.v[at]), 0.0)
        place = np.clip(at - speed * fs_hz, 0.0, n - 1.0)
        i = np.minimum(place.astype(np.intp), max(n - 2, 0))
        j, s = np.minimum(i + 1, n - 1), place - i
        x0, x1, v0, v1 = on_time.x[i], on_time.x[j], on_time.v[i] / fs_hz, on_time.v[j] / fs_hz
        x[at] = x0 + s * (
            v0 + s * (3.0 * (x1 - x0) - 2.0 * v0 - v1 + s * (2.0 * (x0 - x1) + v0 + v1))
        )
        growth = np.where(speed != 0.0, kappa_s2_m * np.sign(own) * on_time.a[at], 0.0)
        v[at] = (on_time.v[i] + s * (on_time.v[j] - on_time.v[i])) * (1.0 - growth)
    return ComputedMotion(x, v, np.gradient(v) * fs_hz if n > 1 else on_time.a)


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
