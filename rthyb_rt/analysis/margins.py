"""Stability margins of a test, known before it runs.

Two instabilities can occur whatever the quality of the actuator: the delayed force feeds energy
into the structure until the motion diverges, or the delay estimator, whose loop contains the delay,
oscillates. Delays and ``alpha`` are in samples, ``beta`` in samples squared; ``z`` is an advance by
one sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt.config import RigFile
from rthyb_rt.core import PERIOD_S, Law, LawConfig, Motion, MotionConfig, element

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

LITTLE_MARGIN: Final = 0.5
"""Loop gain of the delay estimator above which its estimate rings."""

OSCILLATES: Final = math.pi / 2
"""Loop gain above which an integrator with a pure delay is unstable."""

LEAST_DELAY_MARGIN: Final = 1.0
"""Smaller errors of alpha are not significant: holding a command changes the delay by as much."""

# An impulse response is computed for this long, or until it has decayed to this share.
_LONGEST_LEAD: Final = 256
_SILENT: Final = 1e-12

# A rig counts as a lag if delay or gain fall below this share; the scatter of a sweep is smaller.
_FALLS = 0.9


@dataclass(frozen=True)
class Lead:
    """The phase-lead compensator (Eqn 2.5 with curvature term) at a fixed alpha and beta.

    As created it has no effect: C(z) = 1.
    """

    alpha: float = 0.0
    beta: float = 0.0
    w1: float = 3.0
    w2: float = 2.0

    @property
    def s(self) -> float:
        """S = W1 + W2 + 1."""
        return self.w1 + self.w2 + 1.0

    def polynomials(self) -> tuple[Floats, Floats]:
        """Return numerator and denominator of C(z), highest power first, each (3,)."""
        bottom = np.array([self.w1, self.w2, 1.0])
        slope, curvature = np.array([1.0, -1.0, 0.0]), np.array([1.0, -2.0, 1.0])
        return bottom + self.s * (self.alpha * slope + self.beta * curvature), bottom

    @property
    def first_sample_gain(self) -> float:
        """Gain of a command step in its first sample: C at infinity."""
        return float(self._gain(math.inf))

    @property
    def nyquist_gain(self) -> float:
        """Gain of the highest frequency that samples can represent: C(-1)."""
        return abs(self._gain(-1.0))

    def _gain(self, z: float) -> float:
        top, bottom = self.polynomials()
        if math.isinf(z):
            return float(top[0] / bottom[0])
        return float(np.polyval(top, z) / np.polyval(bottom, z))


@dataclass(frozen=True)
class SampledLead:
    """Any control law in its initial state, by its impulse response: C(z) = sum of h[n] z^-n.

    Attributes:
        response: h, shape (n,).
    """

    response: Floats

    @property
    def alpha(self) -> float:
        """Lead of slow motions, samples."""
        h = self.response
        return -float(np.arange(h.size) @ h) / float(h.sum())

    def polynomials(self) -> tuple[Floats, Floats]:
        """Return numerator and denominator of C(z), highest power first, each (n,)."""
        bottom = np.zeros(self.response.size)
        bottom[0] = 1.0
        return self.response, bottom

    @property
    def first_sample_gain(self) -> float:
        """Gain of a command step in its first sample: C at infinity."""
        return float(self.response[0])

    @property
    def nyquist_gain(self) -> float:
        """Gain of the highest frequency that samples can represent: C(-1)."""
        return abs(float(self.response[::2].sum() - self.response[1::2].sum()))


def lead_of(law: LawConfig, period_s: float = PERIOD_S) -> Lead | SampledLead:
    """Return a control law with its initial settings as a linear filter.

    Args:
        law: the law.
        period_s: sampling period.

    Raises:
        CoreError: the settings of the law are invalid.
    """
    given = dict(zip((p.key for p in law.law.parameters), law.values(), strict=True))
    if {"alpha0", "beta0", "w1", "w2"} <= set(given):
        pace = PERIOD_S / period_s
        return Lead(given["alpha0"] * pace, given["beta0"] * pace**2, given["w1"], given["w2"])
    pulse = np.zeros(_LONGEST_LEAD)
    pulse[0] = 1.0
    response = Law(law, period_s=period_s).run(pulse)
    significant = np.flatnonzero(np.abs(response) > _SILENT * np.abs(response).max())
    return SampledLead(response[: significant[-1] + 1])


# ---- stability of a structure with delay --------------------------------------------------------


def compliance(motion: MotionConfig) -> tuple[Floats, Floats]:
    """Return the integrator as a transfer function from net force to displacement.

    Args:
        motion: the numerical part. Its stiffnesses only matter if the integrator's coefficients
            contain them (CR, KR-alpha).

    Returns:
        Numerator and denominator in z, highest power first: x[n+1] from the net force at t_n.
    """
    h, m, c = motion.period_s, motion.mass_kg + motion.added_mass_kg, motion.damping_n_s_per_m
    k = motion.stiffness_n_per_m + motion.k_e_n_per_m
    one_less = np.array([1.0, -1.0])  # z - 1
    if motion.integrator == "central-difference":
        half = 0.5 * h * c
        return np.array([h * h, 0.0]), np.array([m + half, -2.0 * m, m - half])
    if motion.integrator == "forward-euler":
        return np.array([h * h / m]), _times(one_less, [1.0, h * c / m - 1.0])
    if motion.integrator == "cr":
        # Chen & Ricles (2008)
        a1 = 4.0 * m / (4.0 * m + 2.0 * h * c + h * h * k)
        return np.array([h * h * a1 / m, 0.0]), _times(one_less, [1.0, h * a1 * c / m - 1.0])
    if motion.integrator == "kr-alpha":
        # Kolay & Ricles (2014); the weighted equilibrium adds the third pole.
        rho = motion.rho_inf
        am, af = (2.0 * rho - 1.0) / (rho + 1.0), rho / (rho + 1.0)
        gamma = 0.5 - am + af
        beta = 0.25 * (0.5 + gamma) ** 2
        whole = m + gamma * h * c + beta * h * h * k
        a1 = m / whole
        a2 = (0.5 + gamma) * a1
        a3 = (am * m + af * gamma * h * c + af * beta * h * h * k) / whole
        # At rho = 1 both have the factor z + 1, which is not a motion of the structure.
        weight = np.array([1.0 - af, af] if rho < 1.0 else [0.5])
        inner = _times([1.0 - a3, a3] if rho < 1.0 else [0.5], one_less)
        top = h * h / m * _times([a2, a1 - a2], weight)
        return top, _times(one_less, np.polyadd(inner, c * h * a1 / m * weight))
    raise ValueError(f"no equation of motion is known for {motion.integrator!r}")


def _times(*factors: ArrayLike) -> Floats:
    """Return the product of polynomials."""
    product: Floats = np.ones(1)
    for factor in factors:
        product = np.convolve(product, np.asarray(factor, dtype=np.float64))
    return product


class DelayedStructure(Protocol):
    """A numerical part and an elastic specimen to which the command is applied with a delay.

    The specimen is a spring ``k_e_n_per_m``: f[n] = k_e x_p[n-D]. Restoring-force compensation is
    not included: with the exact k_e it removes the delay from the equation of motion altogether.
    """

    def is_stable(self, delay_samples: int, lead: Lead | SampledLead | None = None) -> bool:
        """Return whether every characteristic root is inside the unit circle.

        Args:
            delay_samples: pure delay between compensated command and motion.
            lead: the compensator, or None.
        """

    def loop(self, lead: Lead | SampledLead) -> tuple[Callable[[Complexes], Complexes], Floats]:
        """Return L of 1 + L z^-D = 0 for z on the unit circle, (k,), and its narrow peaks.

        The peaks are angles of resonances of the numerical part alone, which can be narrower than
        any grid, (m,).
        """

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """Return the motion of the structure with a specimen that does not yield, (n,).

        Yielding slows a structure down, so this motion is the most demanding for an estimator.

        Args:
            ag_mps2: ground acceleration, (n,).
        """


@dataclass(frozen=True)
class OneDegree:
    """A `DelayedStructure` with one degree of freedom, by the polynomials of its integrator."""

    motion: MotionConfig

    def _polynomials(self, lead: Lead | SampledLead) -> tuple[Floats, Floats]:
        """Return P and Q of the characteristic equation P(z) z^D + Q(z) = 0."""
        top, bottom = compliance(self.motion)
        lead_top, lead_bottom = lead.polynomials()
        own = np.polyadd(bottom, self.motion.stiffness_n_per_m * top)
        return _times(own, lead_bottom), self.motion.k_e_n_per_m * _times(top, lead_top)

    def is_stable(self, delay_samples: int, lead: Lead | SampledLead | None = None) -> bool:
        """See `DelayedStructure`."""
        p, q = self._polynomials(lead or Lead())
        roots = np.roots(np.polyadd(np.concatenate([p, np.zeros(delay_samples)]), q))
        return bool(np.all(np.abs(roots) < 1.0))

    def loop(self, lead: Lead | SampledLead) -> tuple[Callable[[Complexes], Complexes], Floats]:
        """See `DelayedStructure`."""
        p, q = self._polynomials(lead)

        def of(z: Complexes) -> Complexes:
            return np.asarray(np.polyval(q, z) / np.polyval(p, z))

        return of, np.abs(np.angle(np.roots(p)))

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """See `DelayedStructure`."""
        spring = element("stiffness", k_n_per_m=self.motion.k_e_n_per_m)
        return Motion(self.motion).reference([spring], ag_mps2)[0]


def critical_delay(structure: DelayedStructure, lead: Lead | SampledLead | None = None) -> float:
    """Return the longest pure delay for which a structure with elastic specimen is stable.

    A characteristic root can cross the unit circle only at an angle theta at which
    |L| = 1, and these angles do not depend on the delay (Walton & Marshall 1987); at each, the
    delays for which a root is there are (arg L + pi + 2 pi k) / theta. Stability ends at the
    smallest of these above the delay for which the compensator is set.

    Args:
        structure: numerical part and specimen; a delay within the part is additional.
        lead: the compensator at a fixed alpha, or None; without force compensation.

    Returns:
        The delay in samples, in general not an integer; inf if stable for every delay, 0 if already
        unstable at the delay alpha (at no delay, without compensator).
    """
    lead = lead or Lead()
    start = round(lead.alpha)
    if not structure.is_stable(start, lead):
        return 0.0
    loop, peaks = structure.loop(lead)
    return first_crossing(loop, peaks, start)


def first_crossing(loop: Callable[[Complexes], Complexes], peaks: Floats, start: int) -> float:
    """Return the smallest delay above `start` at which a root of 1 + loop z^-D leaves the circle.

    Args:
        loop: the loop without its delay, for z on the unit circle, (k,).
        peaks: angles of resonances that may be narrower than the grid, (m,).
        start: an integer delay at which the loop is stable, samples.
    """
    critical = math.inf
    for theta in _crossings(loop, peaks):
        angle = float(np.angle(loop(np.exp(1j * np.array([theta])))[0]))
        first, turn = (angle + math.pi) / theta, 2.0 * math.pi / theta
        critical = min(critical, first + turn * (math.floor((start - first) / turn) + 1))
    return critical


def delay_margin(critical_samples: float) -> float:
    """Return the error of the delay estimate at which the structure is still stable, samples.

    Whatever is compensated, the error remains as a pure delay. Force compensation cannot be relied
    on, because its tangent stiffness is zero where noise and friction hide it. A delay d of a
    spring k acts as the damping -k d (Horiuchi et al., EESD 28 (1999) 1121); at the critical delay
    it has consumed all damping of the structure, near 2 zeta / (omega h) for light damping.

    Args:
        critical_samples: `critical_delay` without compensator.

    Returns:
        The margin, at least `LEAST_DELAY_MARGIN`; inf if stable for every delay.
    """
    return max(critical_samples, LEAST_DELAY_MARGIN)


def _crossings(loop: Callable[[Complexes], Complexes], peaks: Floats) -> list[float]:
    """Return the angles in (0, pi] at which |loop| = 1."""

    def excess(theta: Floats) -> Floats:
        return np.asarray(np.abs(loop(np.exp(1j * theta))) - 1.0, dtype=np.float64)

    grid = np.union1d(np.geomspace(1e-5, math.pi, 20001), peaks[peaks > 1e-5])
    sign = excess(grid) > 0.0
    change = np.flatnonzero(sign[1:] != sign[:-1])
    low, high = grid[change], grid[change + 1]
    for _ in range(60):
        middle = 0.5 * (low + high)
        same = (excess(middle) > 0.0) == sign[change]
        low, high = np.where(same, middle, low), np.where(same, high, middle)
    return [float(theta) for theta in low]


def largest_followed_delay(
    structure: DelayedStructure, lead: Lead, most: int, step: int = 1
) -> int | None:
    """Return the largest pure delay at which the test is stable with alpha equal to the delay.

    Args:
        structure: numerical part and specimen.
        lead: the compensator; alpha is replaced by the delay and beta, if it has one, by
            delay^2 / 2.
        most: delay at which the search ends, samples.
        step: coarse step of the search, samples; the last interval is searched sample by sample.

    Returns:
        The delay, ``most`` if stable throughout, None if unstable even at 0.
    """

    def survives(delay: int) -> bool:
        beta = delay**2 / 2.0 if lead.beta else 0.0
        return structure.is_stable(delay, Lead(float(delay), beta, lead.w1, lead.w2))

    survived = -1
    for delay in (*range(0, most, step), most):
        if not survives(delay):
            too_much = next(n for n in range(survived + 1, delay + 1) if not survives(n))
            return too_much - 1 if too_much else None
        survived = delay
    return most


# ---- loop of the delay estimator ----------------------------------------------------------------


def peak_excitation(x_m: ArrayLike, lead: Lead, reference_m: float = 1e-3) -> float:
    """Return the peak of the estimator's input phi = S (x[n] - x[n-1]) / reference (Eqn 2.8).

    Args:
        x_m: displacement that the actuator will follow, shape (n,), m.
        lead: the compensator, for its W1 and W2.
        reference_m: displacement that makes the law unit-free, m.
    """
    steps = np.abs(np.diff(np.asarray(x_m, dtype=np.float64)))
    return abs(lead.s) * float(steps.max(initial=0.0)) / reference_m


def estimator_loop_gain(gain: float, delay_samples: float, phi: float) -> float:
    """Return g = gamma alpha phi^2 / (1 + phi^2) of the paper's delay estimator (Eqn 2.11).

    An error of the estimate is corrected at the rate gamma phi^2 / (1 + phi^2) per sample, but
    appears only alpha samples later: an integrator with a delay. Above `LITTLE_MARGIN` it rings,
    above `OSCILLATES` it oscillates, for a pure delay.

    Args:
        gain: gamma, per reference displacement squared per sample.
        delay_samples: delay of the actuator.
        phi: peak of the estimator's input, see `peak_excitation`.
    """
    return gain * delay_samples * phi**2 / (1.0 + phi**2)


def is_lag(rig: RigFile) -> bool:
    """Return whether the rig behaves as a lag rather than as a pure delay.

    Decided by the identified sweep, if there is one: delay or gain decrease with frequency.
    Otherwise decided by the type of actuator.
    """
    found = rig.identified
    if found is not None and len(found.frequency_hz) > 1:
        order = np.argsort(found.frequency_hz)
        curves = (found.delay_at_frequency_s, found.amplitude)
        ends = [(curve[order[0]], curve[order[-1]]) for curve in curves]
        return any(last < _FALLS * first for first, last in ends)
    actuator = rig.actuator
    if actuator.kind == "second-order":
        lag_s = 2.0 * actuator.damping_ratio / (2.0 * math.pi * actuator.natural_frequency_hz)
        return lag_s > actuator.delay_s
    return actuator.kind != "pure-delay"
