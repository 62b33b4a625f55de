"""A rig's identified response: its first resonance, and the inverse of the control law ``inverse``.

A sweep gives the response G of a rig at some frequencies. The inverse is of fifth order,

C(z) = 1 + sum of b_j ((1 - 1/z) / h)^j / (1 + r (1 - 1/z))^5,   r = rho / (1 - rho),

with all five poles at rho = exp(-2 pi f h), f being the roll-off frequency, so that the inverse
itself is stable for all b_j. The b_j minimise ``|w (C G - 1)|`` with
w = 1 / (1 + (f / 6 Hz)^2) + 0.01: where structures respond, an error of one percent matters; above
that, the fit need only be stable.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.rate import STANDARD, Rate
from rthyb_rt.config.rigfile import Identified, RigFile
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

ORDER: Final = 5
LEAST_TOP_HZ: Final = 40.0
"""With sweeps to less than this, tests fail once the law adapts: 20 and 30 Hz in the benchmark."""
LEAST_TONES: Final = 8
"""Six coefficients need at least six values; half as many again give redundancy."""
LARGEST_ERROR: Final = 0.1
"""Largest error of C G against 1 at frequencies where structures respond."""
SLOW_HZ: Final = 10.0
LIGHT_DAMPING: Final = 0.2
"""A pole pair with less damping amplifies a motion more than 2.5 times: a resonance."""
EXPLAINED: Final = 0.1
"""Largest relative error of a fit of 1/G whose poles are accepted."""
BELOW: Final = 0.9
"""Roll-off of a lead relative to the first resonance: 60 Hz for the benchmark's 67 Hz."""
_DELAYS_TRIED: Final = 49
KNEE_HZ: Final = 6.0
FLOOR: Final = 0.01
"""Residual weight at the highest frequencies."""
TOP_HZ: Final = 80.0
"""End of a complete sweep: the first resonance of actuator and specimen is usually below it; in the
field's benchmark it is at 67 Hz."""
SWEEP: Final = f'`rthyb identify RIG --max-frequency "{TOP_HZ:g} Hz"`'
"""The command for a complete sweep."""
REMEDY: Final = f"run {SWEEP} and use the rig file it writes"


@dataclass(frozen=True)
class Inverse:
    """A fitted inverse.

    Attributes:
        b: b_0 to b_5, in seconds to the power of their index, (6,).
        roll_off_hz: roll-off frequency of its poles.
        period_s: sampling period for which it was fitted.
        worst: largest ``|C G - 1|`` up to `SLOW_HZ`.
        worst_hz: its frequency.
        largest_root: modulus of the largest zero of C, a pole of the rig as fitted.
    """

    b: Floats
    roll_off_hz: float
    period_s: float
    worst: float
    worst_hz: float
    largest_root: float


def response(found: Identified, rate: Rate = STANDARD, *, hold: str | None = "zoh") -> Complexes:
    """Return a rig's identified response for a controller at a given rate, (n,).

    A rig file gives it for a command held for 1/1024 s, whatever the rate of the sweep was. What a
    drive does with its commands between two samples is part of the response, and takes less time at
    a higher rate.

    Args:
        found: the identified response.
        rate: rate of the test.
        hold: ``rig.command_hold``; None: the rig holds nothing (a pure delay).
    """
    f = np.asarray(found.frequency_hz, dtype=np.float64)
    lag_s = np.asarray(found.delay_at_frequency_s)
    swept = np.asarray(found.amplitude) * np.exp(-2j * np.pi * f * lag_s)
    return np.asarray(swept * held_otherwise(f, rate, hold))


def held_otherwise(f_hz: Floats, rate: Rate, hold: str | None) -> Complexes:
    """Return the ratio of the response at a rate to that at 1024 Hz in a rig file, (n,).

    Args:
        f_hz: frequencies, (n,).
        rate: rate of the commands.
        hold: how the drive connects them, from `hold_of`.
    """
    if hold is None or rate == STANDARD:
        return np.ones(f_hz.size, np.complex128)
    return np.asarray(_hold(f_hz, rate.period_s, hold) / _hold(f_hz, STANDARD.period_s, hold))


def resonance_hz(f_hz: Floats, g: Complexes, longest_s: float) -> float | None:
    """Return the first resonance in a response: a lightly damped pole pair within the sweep.

    1 / G is fitted by a polynomial of order 5 in s and a delay, one of several that are tried; its
    zeros are the poles of the rig. A response that this does not fit shows no resonance.

    Args:
        f_hz, g: frequencies, increasing, and response, (n,) each.
        longest_s: longest delay to try.

    Returns:
        The undamped natural frequency; None if there is none or the sweep is too short.
    """
    if f_hz.size < LEAST_TONES:
        return None
    s = 2j * np.pi * f_hz
    unit = float(np.abs(s).max()) / 2.0
    powers = np.array([(s / unit) ** j for j in range(ORDER + 1)]).T * np.abs(g)[:, None]
    best_error, best = math.inf, np.zeros(ORDER + 1)
    for delay_s in np.linspace(0.0, max(longest_s, 0.0), _DELAYS_TRIED):
        wanted = np.exp(-s * delay_s) / g * np.abs(g)
        found = _least_squares(powers, wanted)
        error = float(np.abs(powers @ found - wanted).max())
        if error < best_error:
            best_error, best = error, found
    if best_error > EXPLAINED:
        return None
    poles = np.roots(best[::-1]) * unit
    size = np.abs(poles)
    swept = (size >= 2.0 * np.pi * f_hz[0]) & (size <= 2.0 * np.pi * f_hz[-1])
    light = (poles.imag > 0.0) & (-poles.real > 0.0) & (-poles.real < LIGHT_DAMPING * size)
    found_hz = size[swept & light] / (2.0 * np.pi)
    return float(found_hz.min()) if found_hz.size else None


@lru_cache(maxsize=16)
def resonance_of_sweep(
    frequency_hz: tuple[float, ...], gain: tuple[float, ...], delay_s: tuple[float, ...]
) -> float | None:
    """Return the first resonance in the figures of a sweep, as `resonance_hz` does.

    The fits take as long as a whole test in virtual time, and every run of a test on a rig asks
    again: the results are kept in the process.
    """
    f_hz = np.array(frequency_hz, dtype=np.float64)
    g = np.array(gain) * np.exp(-2j * np.pi * f_hz * np.array(delay_s))
    return resonance_hz(f_hz, g, delay_s[0])


def _hold(f: Floats, h: float, kind: str) -> Complexes:
    """Return the effect of a hold on a sampled sine: once for steps, squared for straight lines."""
    once = np.sinc(f * h) * np.exp(-1j * np.pi * f * h)
    return np.asarray(once if kind == "zoh" else once * once)


def hold_of(rig: RigFile) -> str | None:
    """Return how a rig connects two commands; None if it uses them sample by sample."""
    return None if rig.actuator.kind == "pure-delay" else rig.rig.command_hold


def fitted(rig: RigFile, rate: Rate, roll_off_hz: float, law: str) -> Inverse:
    """Return the inverse of a rig's identified response.

    Args:
        rig: with the response in its section ``identified``.
        rate: rate of the test.
        roll_off_hz: roll-off frequency of the inverse, below half the rate.
        law: name of the control law that needs it, for messages.

    Raises:
        InputError: the response is missing or too short, or the fit is unstable or inaccurate.
    """
    where = f'rig "{rig.rig.name}": identified'
    found = rig.identified
    if found is None or not found.frequency_hz:
        raise InputError(
            f"the control law {law} needs the identified response of the rig, and there is none: "
            f"{REMEDY}",
            where,
        )
    top = max(found.frequency_hz)
    if top < LEAST_TOP_HZ or len(found.frequency_hz) < LEAST_TONES:
        raise InputError(
            f"the response has {len(found.frequency_hz)} frequencies up to {top:g} Hz; the control "
            f"law {law} needs {LEAST_TONES} or more, up to at least {LEAST_TOP_HZ:g} Hz: "
            f"{REMEDY}, or use the law gain-alpha-beta, for which 10 Hz is enough",
            where,
        )
    f = np.asarray(found.frequency_hz, dtype=np.float64)
    inverse = fit(f, response(found, rate, hold=hold_of(rig)), rate.period_s, roll_off_hz)
    if not inverse.largest_root < 1.0:
        raise InputError(
            f"the fit to the response is unstable: its largest root is {inverse.largest_root:.4g} "
            f"and must be below 1; {REMEDY}, with a larger --amplitude if the sensor is noisy, or "
            "use the law gain-alpha-beta",
            where,
        )
    if inverse.worst > LARGEST_ERROR or inverse.b[0] <= -1.0:
        raise InputError(
            f"no inverse of order {ORDER} fits the response: at {inverse.worst_hz:g} Hz the "
            f"error is {100 * inverse.worst:.0f} %; at most {100 * LARGEST_ERROR:g} % is "
            "allowed; check the table of rthyb identify for an outlier, and sweep again with "
            "another --amplitude, or use the law gain-alpha-beta",
            where,
        )
    return inverse


def fit(f_hz: Floats, g: Complexes, period_s: float, roll_off_hz: float) -> Inverse:
    """Return the least-squares inverse of a response, regardless of its accuracy.

    Args:
        f_hz, g: frequencies and response, (n,) each.
        period_s: sampling period.
        roll_off_hz: roll-off frequency of the inverse.
    """
    delta = 1.0 - np.exp(-2j * np.pi * f_hz * period_s)
    rho = math.exp(-2.0 * math.pi * roll_off_hz * period_s)
    r = rho / (1.0 - rho)
    # Scaling by a sine of 8 Hz gives all columns a similar norm.
    scale = (50.0 * period_s) ** -np.arange(ORDER + 1.0)
    columns = np.array([g * scale[j] * delta**j for j in range(ORDER + 1)]).T
    columns /= (1.0 + r * delta)[:, None] ** ORDER
    weight = _weight(f_hz)
    solved = _least_squares(weight[:, None] * columns, weight.astype(np.complex128))
    error = np.abs(columns @ solved - 1.0)
    slow = f_hz <= max(SLOW_HZ, float(f_hz.min()))
    worst = int(np.argmax(np.where(slow, error, -1.0)))
    per_delta = solved * scale
    # (1 + r d)^5 is 1 of C itself.
    own = np.array([math.comb(ORDER, j) * r**j for j in range(ORDER + 1)])
    return Inverse(
        b=(per_delta - own) * period_s ** np.arange(ORDER + 1.0),
        roll_off_hz=roll_off_hz,
        period_s=period_s,
        worst=float(error[worst]),
        worst_hz=float(f_hz[worst]),
        largest_root=float(np.abs(_zeros(per_delta)).max(initial=0.0)),
    )


@dataclass(frozen=True)
class LeadStart:
    """The rolled-off phase lead that best inverts a response: gain, delay (s), curvature (s^2)."""

    gain: float
    delay_s: float
    curvature_s2: float


def fitted_lead(f_hz: Floats, g: Complexes, period_s: float, w1: float, w2: float) -> LeadStart:
    """Return the phase lead of Eqn 2.5, with gain and curvature, that best inverts a response.

    Args:
        f_hz, g: frequencies and response, (n,) each.
        period_s: sampling period.
        w1, w2: weights of the lead.
    """
    more, delay, curvature = fitted_terms(f_hz, g, period_s, w1, w2, (0, 1, 2))
    return LeadStart(1.0 + more, delay * period_s, curvature * period_s**2)


def fitted_terms(
    f_hz: Floats,
    g: Complexes,
    period_s: float,
    w1: float,
    w2: float,
    which: tuple[int, ...],
    others: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[float, float, float]:
    """Return gain less 1, delay and curvature, in samples, of the best lead for a response.

    ``|w (C G - 1)|`` is minimised with the weights of `fit`, where
    ``C = 1 + S (g + a d + b d^2) / (W1 + W2 / z + 1 / z^2)`` and ``d = 1 - 1/z``.

    Args:
        f_hz, g: frequencies and response, (n,) each.
        period_s: sampling period.
        w1, w2: weights of the lead.
        which: which of the three are fitted.
        others: values of those that are not fitted.
    """
    back = np.exp(-2j * np.pi * f_hz * period_s)
    delta = 1.0 - back
    rolled = (w1 + w2 + 1.0) * g / (w1 + w2 * back + back**2)
    scale = (50.0 * period_s) ** -np.arange(3.0)
    columns = np.array([rolled * scale[j] * delta**j for j in range(3)]).T
    weight = _weight(f_hz)
    fitted = list(which)
    terms = np.array(others) / scale
    terms[fitted] = 0.0
    wanted = 1.0 - g - columns @ terms
    terms[fitted] = _least_squares(weight[:, None] * columns[:, fitted], weight * wanted)
    terms *= scale
    return float(terms[0]), float(terms[1]), float(terms[2])


def _weight(f_hz: Floats) -> Floats:
    return np.asarray(1.0 / (1.0 + (f_hz / KNEE_HZ) ** 2) + FLOOR)


def _least_squares(columns: Complexes, wanted: Complexes) -> Floats:
    """Return the real coefficients, (n,), for complex columns (m, n)."""
    rows = np.vstack([columns.real, columns.imag])
    both = np.concatenate([wanted.real, wanted.imag])
    return np.asarray(np.linalg.lstsq(rows, both, rcond=None)[0], dtype=np.float64)


def _zeros(per_delta: Floats) -> Complexes:
    """Return the zeros in z of a polynomial in 1 - 1/z, lowest power first, (n,)."""
    roots = np.roots(per_delta[::-1])
    with np.errstate(divide="ignore"):
        return np.asarray(1.0 / (1.0 - roots))


# ---- a model of the rig -------------------------------------------------------------------------


@dataclass(frozen=True)
class IdentifiedPlant:
    """An identified rig: ``x_m = exp(-s delay) / P(s)`` times the command as the drive holds it.

    Attributes:
        p: coefficients of P, lowest power first, in seconds to the power of their index.
        delay_s: additional pure delay.
        stiffness_n_per_m, damping_n_s_per_m, mass_kg: of the force over x_m.
        swept_hz: highest frequency of the sweep that it explains.
        error: largest relative error of 1/G up to there.
    """

    p: Floats
    delay_s: float
    stiffness_n_per_m: float
    damping_n_s_per_m: float
    mass_kg: float
    swept_hz: float
    error: float

    def response(self, f_hz: Floats, period_s: float, hold: str | None) -> Complexes:
        """Return x_m relative to the samples of a command, (k,) complex.

        Args:
            f_hz: frequencies, (k,), Hz.
            period_s: sampling period, s.
            hold: how the drive connects samples, from `hold_of`.
        """
        s = 2j * np.pi * f_hz
        g = np.exp(-s * self.delay_s) / np.polyval(self.p[::-1], s)
        return np.asarray(g if hold is None else g * _hold(f_hz, period_s, hold))


MOST_ERROR: Final = 0.25
"""Largest error of 1/G: a less accurate model says nothing about the loop's stability."""
_GOOD: Final = 0.01
_WORTH: Final = 2.0
"""A higher order must halve the error of a lower order that is not good enough itself."""


def plant(rig: RigFile) -> IdentifiedPlant | None:
    """Return a model that explains a rig's identified response; None if there is none.

    1/G, less the effect of the drive's hold, is fitted by a polynomial in s and a delay: of the
    orders 0 to `ORDER` and the delays tried, the simplest stable model that is accurate enough.
    Dry friction stops an actuator that a fast, small sine moves little: what no model explains
    there is left out if the rig moves no more than the model says.
    """
    found = rig.identified
    if found is None or len(found.frequency_hz) < 2:
        return None
    f = np.asarray(found.frequency_hz, dtype=np.float64)
    hold = hold_of(rig)
    g = response(found)
    if hold is not None:
        g = g / _hold(f, STANDARD.period_s, hold)
    k, c, m = _impedance(found, rig.rig.elastic_stiffness_n_per_m)
    fewest = f.size if f.max() <= SLOW_HZ else LEAST_TONES
    for count in range(f.size, fewest - 1, -1):
        known, beyond = f[:count], f[count:]
        if count < f.size and known[-1] < SLOW_HZ:
            break
        fit = _simplest(known, g[:count])
        if fit is None:
            continue
        error, p, delay_s = fit
        model = IdentifiedPlant(p, delay_s, k, c, m, float(known.max()), error)
        most = (1.0 + MOST_ERROR) * np.abs(model.response(beyond, STANDARD.period_s, None))
        if (np.abs(g[count:]) <= most).all():
            return model
    return None


def _simplest(f: Floats, g: Complexes) -> tuple[float, Floats, float] | None:
    """Return error, coefficients and delay of the simplest model that is accurate enough."""
    fits = [_polynomial(f, g, order) for order in range(min(ORDER, f.size - 1) + 1)]
    stable = [fit for fit in fits if fit is not None]
    if not stable:
        return None
    least = min(fit[0] for fit in stable)
    if least > MOST_ERROR:
        return None
    good = min(max(_WORTH * least, _GOOD), MOST_ERROR)
    return next(fit for fit in stable if fit[0] <= good)


def _polynomial(f: Floats, g: Complexes, order: int) -> tuple[float, Floats, float] | None:
    """Return error, coefficients and delay of the best stable polynomial of an order."""
    s = 2j * np.pi * f
    unit = float(np.abs(s).max()) / 2.0
    powers = np.array([(s / unit) ** j for j in range(order + 1)]).T * np.abs(g)[:, None]
    slow_s = max(float(-np.angle(g[0]) / (2.0 * np.pi * f[0])), 0.0)
    best: tuple[float, Floats, float] | None = None
    for delay_s in np.linspace(0.0, slow_s, _DELAYS_TRIED):
        wanted = np.exp(-s * delay_s) / g * np.abs(g)
        found = _least_squares(powers, wanted)
        error = float(np.abs(powers @ found - wanted).max())
        if best is not None and error >= best[0]:
            continue
        roots = np.roots(found[::-1])
        if roots.size < order or (roots.real >= 0.0).any():
            continue
        best = error, found / unit ** np.arange(order + 1), float(delay_s)
    return best


def _impedance(found: Identified, k_e_n_per_m: float) -> tuple[float, float, float]:
    """Return stiffness, damping and mass at the load cell; without figures, k_e alone."""
    in_phase = np.asarray(found.force_in_phase_n_per_m)
    if not in_phase.size:
        return k_e_n_per_m, 0.0, 0.0
    w = 2.0 * np.pi * np.asarray(found.frequency_hz, dtype=np.float64)
    # The slow sines determine the stiffness, the fast ones the mass: each is weighted by its own
    # size and by its amplitude, because a sweep limits the velocity.
    moved = np.asarray(found.amplitude) / w
    weight = moved / (k_e_n_per_m + np.abs(in_phase))
    columns = np.column_stack([np.ones_like(w), -(w**2)]) * weight[:, None]
    k, m = np.linalg.lstsq(columns, in_phase * weight, rcond=None)[0]
    return float(k), _viscous(found), max(float(m), 0.0)


_FITTED_S: Final = 2.0
"""`rthyb identify` fits each sine over at least this time."""
_FORM: Final = 0.01
"""Relative error of the three forces in quadrature: what they leave of a noise-free sweep."""


def _viscous(found: Identified) -> float:
    """Return the viscous damping that the sweep establishes, N s/m, for a verdict on stability.

    The force in quadrature, over the displacement, is q = c w + F / X + s: viscous damping, dry
    friction (F is 4/pi times its force, X the amplitude), and hysteresis, whose loop has the same
    shape at every amplitude. None of them is negative. Friction at one amplitude looks like viscous
    damping, but does not grow with the motion: taken for it, it makes an unstable loop seem stable.
    So c is less by two standard errors, and 0 if the file does not give the amplitudes.
    """
    q = np.asarray(found.force_in_quadrature_n_per_m)
    sent = np.asarray(found.command_amplitude_m)
    if not sent.size or not q.any():
        return 0.0
    w = 2.0 * np.pi * np.asarray(found.frequency_hz, dtype=np.float64)
    moved = np.maximum(sent * np.asarray(found.amplitude), 1e-12)
    columns = np.column_stack([w, 1.0 / moved, np.ones_like(w)])
    # A law errs in proportion to its force, the load cell by noise.
    noise = (found.rest_noise_force_n or 0.0) * math.sqrt(2.0 / (_FITTED_S * STANDARD.hz)) / moved
    weight = 1.0 / np.hypot(_FORM * q, np.maximum(noise, 1e-9 * np.abs(q).max()))
    return _certain(columns * weight[:, None], q * weight)


def _certain(columns: Floats, wanted: Floats) -> float:
    """Return the first coefficient of a fit without negative ones, less two standard errors."""
    best, certain = math.inf, 0.0
    for others in ((), (1,), (2,), (1, 2)):
        for used in ((0, *others), others):
            part = columns[:, used]
            size = np.linalg.norm(part, axis=0)
            found = np.linalg.lstsq(part / size, wanted, rcond=1e-10)[0]
            left = float(np.sum((part / size @ found - wanted) ** 2))
            if (found < 0.0).any() or left >= best:
                continue
            best, certain = left, 0.0
            if 0 in used:
                spread = np.linalg.pinv((part / size).T @ (part / size))[0, 0]
                free = max(wanted.size - len(used), 1)
                error = math.sqrt(left / free * spread)
                certain = max(float((found[0] - 2.0 * error) / size[0]), 0.0)
    return certain
