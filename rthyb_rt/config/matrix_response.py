"""Several coupled axes: their identified response, and its inverse.

A sweep of each axis in turn gives H, one matrix per frequency: [row of the reading][column of the
command]. The inverse is

C(z) = C_0 + sum of C_k (1 - 1/z) / (1 - rho_k / z),   rho_k = exp(-2 pi f_k h),

with given poles, so that it is stable for all coefficients. The coefficients minimise
``|w (H C - 1)|`` over the sweep, with w = 1 / (1 + (f / 6 Hz)^2) + .01 as for one axis, together
with ``|l C|`` from the sweep's end to half the sample rate, where H is not known and C only
amplifies noise. Of the weights l tried, the largest is used for which no error exceeds `GOOD` at
frequencies where structures respond.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config import response
from rthyb_rt.core.matrix_lead import POLES_MAX, MatrixInverse
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

POLES_HZ: Final = (5.0, 10.0, 20.0, 40.0, 80.0, 160.0)
"""An octave apart: from the slow modes of a servo to the end of a lead at 1024 Hz."""
GOOD: Final = 0.05
"""Error of H C against 1 up to `response.SLOW_HZ` that is not worth a larger inverse: equal to the
initial uncertainty of the gain of the lead in front of it (`MatrixLeadConfig.gain_sigma`)."""
QUIETEST: Final = 1e-1
LOUDEST: Final = 1e-8
"""Trial weights on the size of the inverse, each half of the previous one."""
BEYOND_TONES: Final = 100


@dataclass(frozen=True, eq=False)
class MatrixResponse:
    """Result of a sweep of several axes.

    Attributes:
        frequency_hz: increasing, (n,).
        response: H, (n, axes, axes).
        rest_noise_m: standard deviation of each reading at rest, (axes,).
    """

    frequency_hz: Floats
    response: Complexes
    rest_noise_m: Floats

    def __post_init__(self) -> None:
        """Check shapes and numbers; raises ``InputError``."""
        f, h = self.frequency_hz, self.response
        axes = len(self.rest_noise_m)
        if h.shape != (f.size, axes, axes) or f.size == 0 or axes == 0:
            raise InputError(
                f"found {f.size} frequencies, a response of shape {h.shape} and {axes} axes; "
                "there must be one matrix for each frequency, with a row and a column for each "
                "axis",
                "matrix response",
            )
        if not all(np.isfinite(values).all() for values in (f, h, self.rest_noise_m)):
            raise InputError("found a number that is not finite", "matrix response")
        if f[0] <= 0.0 or (np.diff(f) <= 0.0).any():
            raise InputError("the frequencies must be positive and increasing", "matrix response")


@dataclass(frozen=True, eq=False)
class MatrixFit:
    """A fitted inverse.

    Attributes:
        inverse: the inverse.
        worst: largest entry of ``|H C - 1|`` up to `response.SLOW_HZ`.
        worst_hz: its frequency.
        loudest: largest singular value of C beyond the sweep.
        largest_root: largest pole of the axes as fitted, in z; below 1.
    """

    inverse: MatrixInverse
    worst: float
    worst_hz: float
    loudest: float
    largest_root: float


def fit(
    found: MatrixResponse, period_s: float, pole_hz: Sequence[float] | None = None
) -> MatrixFit:
    """Return the smallest inverse of a response that is accurate enough.

    Args:
        found: the response.
        period_s: sampling period.
        pole_hz: poles of the inverse, at most eight, below half the sample rate; None: those of
            `POLES_HZ` that are below it.

    Raises:
        InputError: the sweep is too short, or no stable inverse is accurate to a tenth.
    """
    if pole_hz is None:
        pole_hz = [one for one in POLES_HZ if one * period_s < 0.5]
    if not 0 < len(pole_hz) <= POLES_MAX or max(pole_hz) * period_s >= 0.5 or min(pole_hz) <= 0:
        raise InputError(
            f"found poles at {', '.join(f'{f:g}' for f in pole_hz) or 'no'} Hz; must be 1 to "
            f"{POLES_MAX}, above 0 and below {0.5 / period_s:g} Hz",
            "matrix response",
        )
    if found.frequency_hz.size < response.LEAST_TONES:
        raise InputError(
            f"the sweep has {found.frequency_hz.size} frequencies; an inverse needs at least "
            f"{response.LEAST_TONES}",
            "matrix response",
        )
    best: MatrixFit | None = None
    weight = QUIETEST
    while weight >= LOUDEST:
        one = _fit(found, period_s, tuple(pole_hz), weight)
        if one.largest_root < 1.0 and (best is None or one.worst < best.worst):
            best = one
            if best.worst <= GOOD:
                break
        weight *= 0.5
    if best is None or best.worst > response.LARGEST_ERROR:
        off = "it is unstable" if best is None else f"off by {100 * best.worst:.0f} %"
        raise InputError(
            f"no inverse of {len(pole_hz)} poles fits the response: {off}; sweep again with more "
            "frequencies or a larger amplitude",
            "matrix response",
        )
    return best


def _fit(
    found: MatrixResponse, period_s: float, pole_hz: tuple[float, ...], loudness: float
) -> MatrixFit:
    f, h = found.frequency_hz, found.response
    axes, top = h.shape[1], float(f[-1])
    weight = 1.0 / (1.0 + (f / response.KNEE_HZ) ** 2) + response.FLOOR
    beyond = np.linspace(top, 0.5 / period_s, BEYOND_TONES)
    inside = MatrixInverse.shapes(f, pole_hz, period_s)
    outside = MatrixInverse.shapes(beyond, pole_hz, period_s)
    # Row (f, reading), unknown (shape, command): the same for every column of C.
    columns = np.einsum("f,foi,fk->foki", weight, h, inside).reshape(f.size * axes, -1)
    quiet = np.kron(loudness * outside, np.eye(axes))
    wanted = np.einsum("f,oj->foj", weight, np.eye(axes)).reshape(f.size * axes, axes)
    rows = np.concatenate([columns.real, columns.imag, quiet.real, quiet.imag])
    right = np.concatenate([wanted, np.zeros((rows.shape[0] - len(wanted), axes))])
    scale = np.linalg.norm(rows, axis=0)
    solved = np.linalg.lstsq(rows / scale, right, rcond=1e-12)[0] / scale[:, None]
    inverse = MatrixInverse(pole_hz, solved.reshape(len(pole_hz) + 1, axes, axes))
    error = np.abs(h @ inverse.response(f, period_s) - np.eye(axes)).max(axis=(1, 2))
    error = np.where(f <= max(response.SLOW_HZ, float(f[0])), error, -1.0)
    worst = int(np.argmax(error))
    loudest = float(np.linalg.norm(inverse.response(beyond, period_s), 2, axis=(1, 2)).max())
    return MatrixFit(
        inverse, float(error[worst]), float(f[worst]), loudest, largest_root(inverse, period_s)
    )


def largest_root(inverse: MatrixInverse, period_s: float) -> float:
    """Return the largest pole, in z, of the system with this inverse: inf if it has none."""
    c = np.asarray(inverse.coefficients)
    axes, poles = c.shape[1], len(inverse.pole_hz)
    rho = np.exp(-2.0 * np.pi * np.asarray(inverse.pole_hz) * period_s)
    feed = c.sum(axis=0)
    if np.linalg.cond(feed) > 1e12 or np.linalg.cond(c[0]) > 1e12:
        return float("inf")
    # States: the last input, then the memory of each pole; the output is 0.
    kept = [-r * own for r, own in zip(rho, c[1:], strict=True)]
    last = np.linalg.solve(feed, np.hstack([feed - c[0], *kept]))
    a = np.zeros((axes * (poles + 1),) * 2)
    a[:axes] = last
    for k, r in enumerate(rho):
        own = slice(axes * (k + 1), axes * (k + 2))
        a[own] = last
        a[own, :axes] -= np.eye(axes)
        a[own, own] += r * np.eye(axes)
    return float(np.abs(np.linalg.eigvals(a)).max())


def fitted_terms(
    found: MatrixResponse, period_s: float, roll_off_hz: float, *, coupled: bool, before: Any = None
) -> Floats:
    """Return gain less 1, delay (s) and curvature (s^2) of the lead that best inverts a response.

    Args:
        found: the response.
        period_s: sampling period.
        roll_off_hz: roll-off frequency of the lead.
        coupled: whether to use off-diagonal terms; otherwise each axis is fitted separately.
        before: inverse between lead and axes, a `MatrixInverse`, or None.

    Returns:
        (3, axes, axes).
    """
    f, h = found.frequency_hz, found.response
    if before is not None:
        h = h @ before.response(f, period_s)
    axes = h.shape[1]
    rho = float(np.exp(-2.0 * np.pi * roll_off_hz * period_s))
    w1, w2 = 1.0 / rho**2, -2.0 / rho
    if not coupled:
        terms = np.zeros((3, axes, axes))
        for i in range(axes):
            own = response.fitted_terms(f, h[:, i, i], period_s, w1, w2, (0, 1, 2))
            terms[:, i, i] = own * np.array([1.0, period_s, period_s**2])
        return terms
    back = np.exp(-2j * np.pi * f * period_s)
    shapes = np.stack([(1.0 - back) ** j for j in range(3)], axis=1)
    shapes *= ((w1 + w2 + 1.0) / (w1 + w2 * back + back**2))[:, None]
    weight = 1.0 / (1.0 + (f / response.KNEE_HZ) ** 2) + response.FLOOR
    columns = np.einsum("f,foi,ft->foti", weight, h, shapes).reshape(f.size * axes, -1)
    wanted = np.einsum("f,foj->foj", weight, np.eye(axes) - h).reshape(f.size * axes, axes)
    rows = np.concatenate([columns.real, columns.imag])
    scale = np.linalg.norm(rows, axis=0)
    right = np.concatenate([wanted.real, wanted.imag])
    solved = np.linalg.lstsq(rows / scale, right, rcond=None)[0] / scale[:, None]
    unit = np.array([1.0, period_s, period_s**2])[:, None, None]
    return np.asarray(solved.reshape(3, axes, axes) * unit)
