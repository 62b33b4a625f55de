"""A controller's delay estimate and tangent stiffness, recovered from its signals alone.

A closed loop recorded by another program contains neither. Both follow from its signals:

* the phase-lead compensator (Eqn 2.5, S = W1 + W2 + 1) as a recursion,
  ``W1 e[n] + W2 e[n-1] + e[n-2] = alpha[n] S (x_num[n] - x_num[n-1])`` with ``e = x_cmd - x_num``,
  gives ``alpha[n]`` wherever the command moves;
* the numerical part, ``m (x'' + ag) + c x' + F = 0``, gives the force ``F`` that it received, and
  the restoring-force compensator (Eqn 3.2), ``F = f + k_t (x_num - x_meas)``, gives ``k_t[n]``
  wherever there is a tracking error.

Both are slopes of a line through the origin, fitted over a short window, with a standard error that
includes noise and variation within the window; where it is large, as at rest, the value is NaN.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.noise_level import white_noise
from rthyb_rt.diagnose.policy import POLICY

WINDOW_S = 1.0 / 32.0
"""Window over which both quantities are assumed constant."""
CYCLE_S = 0.5
"""Time in which alpha changes by no more than a few per cent."""
NOISE_SCATTER = 2.0
"""Factor by which the scatter of white noise in a window may exceed its mean."""


@dataclass(frozen=True)
class Slope:
    """A quantity recovered along the recording.

    Attributes:
        value: (n,), in `unit`; NaN where it is not identifiable.
        error: standard error of each value, (n,), same unit.
        unit: unit of both.
        why: reason if nothing could be recovered, else "".
    """

    value: Floats
    error: Floats
    unit: str
    why: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the summary for the answer."""
        good = np.isfinite(self.value)
        if self.why or not good.any():
            return {"possible": False, "why": self.why or "not identifiable anywhere"}
        value = self.value[good]
        return {
            "possible": True,
            "unit": self.unit,
            "median": float(np.median(value)),
            "range": [float(value.min()), float(value.max())],
            "standard_error": float(np.median(self.error[good])),
            "identified_share": float(good.mean()),
        }


@dataclass(frozen=True)
class Recovered:
    """Quantities recovered from a closed loop: alpha in samples, k_t in N/m."""

    alpha: Slope
    k_t: Slope

    def to_json(self) -> dict[str, Any]:
        """Return the summary for the answer."""
        return {"alpha": self.alpha.to_json(), "k_t_n_per_m": self.k_t.to_json()}


def recover(case: Case) -> Recovered:
    """Recover alpha and k_t of a recorded closed loop, each (n,)."""
    return Recovered(recover_alpha(case), recover_stiffness(case))


def _without(case: Case, unit: str, why: str) -> Slope:
    nothing = np.full(case.t.size, np.nan)
    return Slope(nothing, nothing, unit, why)


def recover_alpha(case: Case) -> Slope:
    """Recover the delay estimate in use for each command, in samples."""
    missing = [name for name in ("x_num", "x_cmd") if name not in case.channels]
    if missing:
        return _without(case, "samples", f"{' and '.join(missing)} not recorded")
    if case.model.plc is None:
        return _without(case, "samples", "the model does not state controller.plc_w1, plc_w2")
    w1, w2 = case.model.plc
    x = case.channels["x_num"]
    lead = case.channels["x_cmd"] - x
    right = (w1 + w2 + 1.0) * _behind(x, 0, 1)
    left = w1 * lead + w2 * _late(lead, 1) + _late(lead, 2)
    value, error, _ = _slope(left, right, case.fs_hz)
    # Over a cycle, another compensator's command does not fit this line; over a moment, any one
    # does.
    _, _, unclosed = _slope(left, right, case.fs_hz, CYCLE_S)
    if unclosed > POLICY.recovered_unclosed:
        return _without(
            case, "samples",
            f"x_cmd does not follow from x_num by Eqn 2.5 with W1 = {w1:g}, W2 = {w2:g}: "
            f"{100 * unclosed:.0f} % of it remains unexplained",
        )  # fmt: skip
    value[error > POLICY.alpha_error] = np.nan
    return Slope(value, error, "samples")


def recover_stiffness(case: Case) -> Slope:
    """Recover the tangent stiffness of the force compensation, N/m.

    The integrator is not known: velocity by central or backward difference, force at the same row
    or the next, ground motion up to one row off; the combination with the smallest residual is
    used.
    """
    unit = "N/m"
    needed = ("ag", "x_num", "x_meas", "f_meas")
    missing = [name for name in needed if name not in case.channels]
    if missing:
        return _without(case, unit, f"{', '.join(missing)} not recorded")
    if case.model.rfc is False:
        return _without(case, unit, "the model states controller.rfc = false")
    if not case.model.mass > 0.0:
        return _without(case, unit, "the model does not state numerical.m")
    off = case.channels["x_num"] - case.channels["x_meas"]
    size = float(np.nanstd(case.channels["f_meas"])) or 1.0
    best: tuple[float, Floats, Floats] | None = None
    for left in _compensation(case):
        value, error, unclosed = _slope(left, off, case.fs_hz, most=1.5 * abs(case.model.k))
        unclosed *= float(np.nanstd(left)) / size
        if best is None or unclosed < best[0]:
            best = (unclosed, value, error)
    assert best is not None
    unclosed, value, error = best
    if unclosed > POLICY.recovered_unclosed:
        return _without(
            case, unit,
            "x_num does not follow from ag and f_meas by m (x'' + ag) + c x' + F = 0: "
            f"{100 * unclosed:.0f} % of the force remains unexplained",
        )  # fmt: skip
    value[error > POLICY.stiffness_error * (abs(case.model.k) or 1e300)] = np.nan
    return Slope(value, error, unit)


def _compensation(case: Case) -> Iterator[Floats]:
    """Yield F - f along the recording, N, for each form of the equation of motion."""
    model, fs = case.model, case.fs_hz
    x, f, ag = (case.channels[name] for name in ("x_num", "f_meas", "ag"))
    after = _late(x, -1)
    bend = (after - 2.0 * x + _late(x, 1)) * fs**2
    for velocity in (0.5 * (after - _late(x, 1)) * fs, (x - _late(x, 1)) * fs):
        for late in (0, 1):
            for shift in (-1, 0, 1):
                inertia = model.mass * (bend + _late(ag, shift + late)) + model.c_num * velocity
                # The curvature of the command at a row is due to the force of that row, or of the
                # row before.
                yield _late(-inertia, -late) - f


def _late(signal: Floats, rows: int) -> Floats:
    """Return a signal delayed by some rows, (n,); NaN where it has no value."""
    out = np.full(signal.size, np.nan)
    if rows >= 0:
        out[rows:] = signal[: signal.size - rows]
    else:
        out[:rows] = signal[-rows:]
    return out


def _behind(signal: Floats, now: int, before: int) -> Floats:
    return _late(signal, now) - _late(signal, before)


def _slope(
    left: Floats, right: Floats, fs_hz: float, window_s: float = WINDOW_S, most: float = np.inf
) -> tuple[Floats, Floats, float]:
    """Fit ``left = s right`` over a window around each row.

    Returns the slope and its standard error, each (n,), and the rms residual of a slope between 0
    and ``most``, relative to the rms of ``left``.
    """
    good = np.isfinite(left) & np.isfinite(right)
    a, b = np.where(good, left, 0.0), np.where(good, right, 0.0)
    kernel = np.ones(max(int(window_s * fs_hz) | 1, 3))
    power = np.convolve(b * b, kernel, mode="same")
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.convolve(a * b, kernel, mode="same") / power
    value[~(power > 0.0)] = np.nan
    rest = np.where(good & np.isfinite(value), a - np.nan_to_num(value) * b, 0.0)
    count = np.maximum(np.convolve(good.astype(float), kernel, mode="same") - 1.0, 1.0)
    scatter = np.convolve(rest * rest, kernel, mode="same") / count
    # White noise averages out over the window; additional scatter means that the slope changes.
    noise = white_noise(left)
    steady = min(noise, float(np.sqrt(np.median(scatter[good])))) ** 2 if good.any() else 0.0
    moving = np.maximum(scatter - NOISE_SCATTER * steady, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        white = np.minimum(scatter, NOISE_SCATTER * steady) + steady
        error = np.sqrt((white + moving * count) / power)
    value[~good], error[~good] = np.nan, np.nan
    whole = float(np.sqrt(np.mean(a[good] ** 2))) if good.any() else 0.0
    beyond = (a - np.clip(np.nan_to_num(value), 0.0, most) * b)[good]
    left_over = float(np.sqrt(np.mean(beyond**2))) / whole if whole else 1.0
    return value, error, left_over
