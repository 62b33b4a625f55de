"""Stability of the closed loop of a test, before it runs: roots, gain margin, delay margin.

The loop consists of the numerical part, the control law, the rig as identified (response and
force), and force compensation. It is linear as long as the specimen is elastic, and its largest
root shows whether motion grows. An adaptive phase lead is examined with its initial settings and
with those to which the rig's response leads it; any other law with its initial settings.

    f* = R x_c + k (LP + tau V) x_c,   R = (Z - k LP) G C,   x_c = -N f*

with N the numerical part, C the law, G the rig, Z the force over x_m, LP the low-pass, tau V the
delay of the force compensation and k its tangent stiffness, here k_e.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Final
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import margins
from rthyb_rt.analysis.linear_parts import (
    MANY_STATES,
    LinearPart,
    Triangular,
    solved_response,
)
from rthyb_rt.config import response, rigsettings
from rthyb_rt.config.rate import STANDARD_HZ, Rate
from rthyb_rt.core import ControllerConfig, DenseConfig, LawConfig
from rthyb_rt.core.sparse import SparseConfig
from rthyb_rt.numbers import delay

if TYPE_CHECKING:
    from rthyb_rt.core.laws import LawDescription
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

ROUNDING: Final = 1e-7
"""Distance from 1 within which a root is on the unit circle, where motion and noise do not decay.
A double root is found to the square root of the rounding error, 1.5e-8."""
MOST_GAIN: Final = 4.0
"""Search limit of the gain margin; nobody needs more."""
THIN_GAIN: Final = 1.25
"""The plants of the field's benchmark differ by 10 % in the gain of their actuators."""
THIN_DELAY_SAMPLES: Final = margins.LEAST_DELAY_MARGIN
"""In samples of 1/1024 s: holding a command changes the delay by as much."""


UNSEEN_FORCE: Final = 1.0
"""In elastic forces. So much is fed back by an actuator that still follows if the force over its
motion is twice that of the stiffness, or zero. Above the sweep nothing excludes it: a mass of
k / w^2 does it, or a resonance of actuator and specimen."""


@dataclass(frozen=True)
class Block:
    """A linear system with one input, s[n+1] = A s[n] + b u[n], y[n] = C s[n] + d u[n]; y (m,)."""

    a: Floats
    b: Floats
    c: Floats
    d: Floats

    def response(self, z: Complexes) -> Complexes:
        """Return the transfer function at z (k,) as (k, m)."""
        if not len(self.a):
            return np.broadcast_to(self.d.astype(complex), (z.size, self.d.size))
        if self._triangular is not None:
            return self._triangular.response(z)[:, :, 0] + self.d
        return solved_response(self.a, self.b[:, None], self.c, z)[:, :, 0] + self.d

    @functools.cached_property
    def _triangular(self) -> Triangular | None:
        """The system in triangular form if it has many states; None without SciPy."""
        if len(self.a) <= MANY_STATES or importlib.util.find_spec("scipy") is None:
            return None
        return Triangular.of(self.a, self.b[:, None], self.c)

    def then(self, other: Block) -> Block:
        """Return the series connection: the other system fed by the first output of this one."""
        n, m = len(self.a), len(other.a)
        a = np.zeros((n + m, n + m))
        a[:n, :n], a[n:, n:] = self.a, other.a
        a[n:, :n] = np.outer(other.b, self.c[0])
        b = np.concatenate([self.b, other.b * self.d[0]])
        c = np.hstack([np.outer(other.d, self.c[0]), other.c])
        return Block(a, b, c, other.d * self.d[0])

    def beside(self, other: Block) -> Block:
        """Return both systems with a common input, the outputs of this one first."""
        n, m = len(self.a), len(other.a)
        a = np.zeros((n + m, n + m))
        a[:n, :n], a[n:, n:] = self.a, other.a
        c = np.zeros((len(self.c) + len(other.c), n + m))
        c[: len(self.c), :n], c[len(self.c) :, n:] = self.c, other.c
        return Block(a, np.concatenate([self.b, other.b]), c, np.concatenate([self.d, other.d]))

    def weighted(self, *rows: tuple[float, ...]) -> Block:
        """Return new outputs, each a weighted sum of the present ones."""
        by = np.array(rows)
        return Block(self.a, self.b, by @ self.c, by @ self.d)


def gain(value: float) -> Block:
    """Return a system without memory."""
    return Block(np.zeros((0, 0)), np.zeros(0), np.zeros((1, 0)), np.array([value]))


def rational(top: Floats, bottom: Floats) -> Block:
    """Return the system of a causal transfer function in z, highest power first."""
    bottom = np.trim_zeros(np.asarray(bottom, dtype=np.float64), "f")
    order = bottom.size - 1
    top = np.concatenate([np.zeros(bottom.size - len(top)), top]) / bottom[0]
    back = bottom[1:] / bottom[0]
    a = np.zeros((order, order))
    if order:
        a[0] = -back
        a[np.arange(1, order), np.arange(order - 1)] = 1.0
    b = np.eye(order)[0] if order else np.zeros(0)
    return Block(a, b, (top[1:] - top[0] * back)[None, :], top[:1])


# ---- the parts ----------------------------------------------------------------------------------


def numerical(config: ControllerConfig) -> Block:
    """Return force f*[n] -> displacement of the interface at t_n."""
    if not isinstance(config.numerical, (DenseConfig, SparseConfig)):
        top, bottom = margins.compliance(config.motion)
        whole = np.asarray(np.polyadd(bottom, config.motion.stiffness_n_per_m * top), np.float64)
        return rational(-top, whole)
    part = LinearPart.of(config.numerical)
    if part not in _BLOCKS:
        late = rational(np.array([1.0]), np.array([1.0, 0.0]))
        whole_part = Block(part.a, part.b, part.c[None, :], np.zeros(1))
        _BLOCKS[part] = late.then(whole_part) if part.force_delay else whole_part
    return _BLOCKS[part]


_BLOCKS: Final = WeakKeyDictionary[LinearPart, Block]()
"""The triangular form of a block with many states takes a second."""


def backward_velocity(h: float) -> Block:
    """Return the second-order backward difference of csrc/motion.c."""
    return rational(np.array([3.0, -4.0, 1.0]) / (2.0 * h), np.array([1.0, 0.0, 0.0]))


def rig(model: response.IdentifiedPlant, h: float, hold: str | None) -> Block:
    """Return command -> x_m and force, as seen by a controller with a sampling period.

    Args:
        model: the identified plant.
        h: sampling period.
        hold: ``rig.command_hold``, None for a rig without a hold.
    """
    impedance = (model.stiffness_n_per_m, model.damping_n_s_per_m, model.mass_kg)
    return motion(model, h, hold).weighted((1.0, 0.0, 0.0), impedance)


def motion(model: response.IdentifiedPlant, h: float, hold: str | None) -> Block:
    """Return command -> x_m, its velocity and its acceleration; arguments as for `rig`.

    Derivatives that the order of the model does not have are zero.
    """
    order = model.p.size - 1
    late = model.delay_s / h
    if hold == "foh":
        late += 0.5  # linear interpolation of commands is half a sample behind a zero-order hold
    whole = math.floor(late + 1e-9)
    part = max(late - whole, 0.0)
    if order == 0:
        return later(whole, part).weighted((1.0 / model.p[0],)).weighted((1.0,), (0.0,), (0.0,))
    # Controller form in x, x', x'', ...; the fractional delay makes commands act within a sample.
    top = model.p[order]
    unit = abs(model.p[0] / top) ** (1.0 / order)
    a = np.diag(np.ones(order - 1), 1)
    a[-1] = -model.p[:order] / top / unit ** np.arange(order, 0, -1)
    b = np.zeros(order)
    b[-1] = 1.0 / (top * unit**order)
    phi, gamma = _held(a * unit, b * unit, h)
    _, first = _held(a * unit, b * unit, h * (1.0 - part))
    # Within a sample the old command acts for `part`, the new one for the rest.
    old = gamma - first
    c = np.zeros((3, order + 1))
    for j in range(min(order, 3)):
        c[j, j] = unit**j
    step = np.zeros((order + 1, order + 1))
    step[:order, :order], step[:order, order] = phi, old
    table = Block(step, np.append(first, 1.0), c, np.zeros(3))
    return later(whole).then(table)


def _held(a: Floats, b: Floats, h: float) -> tuple[Floats, Floats]:
    """Return exp(a h) and the input matrix of a command held for h."""
    size = len(a)
    whole = np.zeros((size + 1, size + 1))
    whole[:size, :size], whole[:size, size] = a * h, b * h
    halvings = max(0, math.ceil(math.log2(max(float(np.abs(whole).sum(axis=1).max()), 1e-12))) + 4)
    term = result = np.eye(size + 1)
    for j in range(1, 14):
        term = term @ whole / (j * 2.0**halvings)
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result[:size, :size], result[:size, size]


def later(whole: int, part: float = 0.0) -> Block:
    """Return a delay in samples, with linear interpolation for its fractional part."""
    taps = np.zeros(whole + 2)
    taps[whole], taps[whole + 1] = 1.0 - part, part
    taps = np.trim_zeros(taps, "b")
    return rational(taps, np.eye(1, taps.size)[0])


def low_pass(cutoff_hz: float, h: float) -> Block:
    """Return the Butterworth low-pass of csrc/lowpass.h; cut-off 0: no filter."""
    if not cutoff_hz:
        return gain(1.0)
    k = math.tan(math.pi * cutoff_hz * h)
    norm = 1.0 + math.sqrt(2.0) * k + k * k
    top = np.array([1.0, 2.0, 1.0]) * (k * k / norm)
    bottom = np.array([1.0, 2.0 * (k * k - 1.0) / norm, (1.0 - math.sqrt(2.0) * k + k * k) / norm])
    return rational(top, bottom)


def laws(
    law: LawConfig, model: response.IdentifiedPlant, h: float, hold: str | None
) -> list[Block]:
    """Return a control law with its initial settings, and as adapted to the rig's response."""
    given = dict(zip((p.key for p in law.law.parameters), law.values(), strict=True))
    table = law.name.replace("-", "_")
    if f"{table}.gain_sigma" in given:
        own = {key.partition(".")[2]: value for key, value in given.items()}
        w1, w2 = rigsettings.weights(own["roll_off_hz"], h)
        terms = [own.get("gain0", 1.0) - 1.0, own.get("delay0_s", 0.0) / h,
                 own.get("curvature0_s2", 0.0) / h**2]  # fmt: skip
        lead = _lead(terms, w1, w2)
        return [lead.then(_inverse(own, h)) if "b0" in own else lead]
    first = margins.lead_of(law, h)
    found = [rational(*first.polynomials())]
    if isinstance(first, margins.Lead) and law.adapts:
        f = np.array([one for one in _SLOW_HZ if one <= model.swept_hz])
        z = np.exp(2j * np.pi * f * h)
        g = rig(model, h, hold).response(z)[:, 0]
        held = (0.0, first.alpha, first.beta)
        fitted = response.fitted_terms(f, g, h, first.w1, first.w2, _learnt(law.law), held)
        found.append(_lead(list(fitted), first.w1, first.w2))
    return found


_SLOW_HZ: Final = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0)


def _learnt(law: LawDescription) -> tuple[int, ...]:
    """Return which of gain, delay and curvature a phase lead adapts."""
    return (1, 2) if law.learns_curvature else (1,)


def _lead(terms: list[float], w1: float, w2: float) -> Block:
    bottom = np.array([w1, w2, 1.0])
    slope, bend = np.array([1.0, -1.0, 0.0]), np.array([1.0, -2.0, 1.0])
    added = terms[0] * np.array([1.0, 0.0, 0.0]) + terms[1] * slope + terms[2] * bend
    return rational(bottom + bottom.sum() * added, bottom)


def _inverse(own: dict[str, float], h: float) -> Block:
    """Return C(z) of `rthyb_rt.config.response`, one pole at a time: order five would lose digits.

    With v = d / (1 + r d) it is 1 + sum of b_j / h^j v^j (1 - r v)^(5 - j), a polynomial in v.
    """
    rho = math.exp(-2.0 * math.pi * own["fit_roll_off_hz"] * h)
    r = rho / (1.0 - rho)
    e = np.zeros(response.ORDER + 1)
    e[0] = 1.0
    for j in range(response.ORDER + 1):
        term = np.array([own[f"b{j}"] / h**j])
        for _ in range(response.ORDER - j):
            term = np.convolve(term, [1.0, -r])
        e[j:] += term
    slope = rational(np.array([1.0 - rho, rho - 1.0]), np.array([1.0, -rho]))
    whole = gain(float(e[-1]))
    for value in e[-2::-1]:
        whole = slope.then(whole).beside(gain(float(value))).weighted((1.0, 1.0))
    return whole


# ---- the loop -----------------------------------------------------------------------------------


def closed_roots(
    part: tuple[Floats, Floats, Floats], back: tuple[Floats, Floats, Floats, Floats]
) -> Complexes:
    """Return the roots of a system whose outputs return to its inputs through another one.

    Args:
        part: A, B and C of the first, without a direct path from input to output.
        back: A, B, C and D of the second.
    """
    (a, b, c), (a_back, b_back, c_back, d_back) = part, back
    whole = np.block([[a + b @ d_back @ c, b @ c_back], [b_back @ c, a_back]])
    return np.asarray(np.linalg.eigvals(whole), dtype=np.complex128)


class AnyLoop(ABC):
    """The loop of a rig of one axis or of several."""

    searched: ClassVar[tuple[int, int]] = (25, 20)
    """Factors that are tried in search of the gain margin, and the halvings that follow."""

    @abstractmethod
    def roots(self, by: float = 1.0) -> Complexes:
        """Return the roots of the loop with the rig's response multiplied by a factor."""

    @abstractmethod
    def delay_margin(self) -> float:
        """Return the additional delay of the rig at which stability ends, samples; inf: none."""

    def stable(self, by: float = 1.0) -> bool:
        """Return whether every root is inside the unit circle."""
        return bool(np.abs(self.roots(by)).max() < 1.0 - ROUNDING)

    def gain_margin(self) -> float:
        """Return the factor on the rig's response at which stability ends, at most `MOST_GAIN`."""
        tried, halvings = self.searched
        low, high = 1.0, 1.0
        for high in np.geomspace(1.0, MOST_GAIN, tried)[1:]:
            if not self.stable(float(high)):
                break
            low = float(high)
        else:
            return MOST_GAIN
        for _ in range(halvings):
            middle = 0.5 * (low + float(high))
            low, high = (middle, high) if self.stable(middle) else (low, middle)
        return low


@dataclass(frozen=True)
class LinearLoop(AnyLoop):
    """A loop in parts: -N from f* to x_c, the feedback through the rig, and that without it."""

    part: Block
    by_rig: Block
    beside: Block

    def roots(self, by: float = 1.0) -> Complexes:
        """Return the roots of the loop with the rig's response multiplied by a factor."""
        back = self.by_rig.weighted((by,)).beside(self.beside).weighted((1.0, 1.0))
        part = self.part
        return closed_roots(
            (part.a, part.b[:, None], part.c), (back.a, back.b[:, None], back.c, back.d[:, None])
        )

    def without_rig(self, z: Complexes) -> Complexes:
        """Return what a force fed back by the rig moves x_c by, for z (k,), m/N."""
        moved = self.part.response(z)[:, 0]
        inner = self.beside.response(z)[:, 0]
        return np.asarray(moved / (1.0 - moved * inner))

    def opened(self, z: Complexes) -> Complexes:
        """Return L of 1 + L = 0, the loop opened at the rig, for z (k,)."""
        return np.asarray(-self.without_rig(z) * self.by_rig.response(z)[:, 0])

    def delay_margin(self) -> float:
        """Return the additional delay of the rig at which stability ends, samples; inf: none."""
        peaks = np.abs(np.angle(np.concatenate([self.roots(), self.roots(0.0)])))
        return margins.first_crossing(self.opened, peaks, 0)


def loop_of(
    config: ControllerConfig, model: response.IdentifiedPlant, law: Block, hold: str | None
) -> LinearLoop:
    """Assemble the loop of a test, with the tangent stiffness of force compensation at k_e."""
    h, rfc = config.period_s, config.rfc
    k = rfc.k_e_n_per_m if rfc.enabled else 0.0
    table = rig(model, h, hold)
    lead = law if config.lead_enabled else gain(1.0)
    filtered = low_pass(rfc.cutoff_hz, h)
    # x_m through the low-pass, and the unfiltered force.
    force = table.weighted((0.0, 1.0))
    moved = table.weighted((1.0, 0.0)).then(filtered)
    back = force.beside(moved).weighted((1.0, -k)) if k else force
    late = k * rfc.lateness_s
    beside = filtered.weighted((k,))
    if late:
        # RK4 has its own velocity; this second-order difference is as good for roots.
        beside = beside.beside(backward_velocity(h)).weighted((1.0, late))
    return LinearLoop(numerical(config), lead.then(back), beside)


@dataclass(frozen=True)
class LoopVerdict:
    """Stability of a loop.

    Attributes:
        radius: modulus of the largest root.
        frequency_hz: of that root.
        gain_margin: factor on the rig's response at which stability ends, at most `MOST_GAIN`; 0 if
            the loop is unstable.
        delay_margin_samples: additional delay of the rig at which stability ends, in samples of
            1/1024 s; inf: none; 0 if the loop is unstable.
        swept_hz: frequency up to which the rig's response is known.
        unseen_force: least force, from there to the end of a complete sweep, with which the loop
            could be unstable, as a multiple of the elastic force of the motion commanded, in the
            norm of `rthyb_rt.analysis.unseen_response`; inf: none that matters, or the sweep is
            complete.
        unseen_hz: frequency at which that much suffices.
    """

    radius: float
    frequency_hz: float
    gain_margin: float
    delay_margin_samples: float
    swept_hz: float
    unseen_force: float = math.inf
    unseen_hz: float = 0.0

    @property
    def unstable(self) -> bool:
        """Whether the motion does not decay without excitation: it grows, or neither."""
        return self.radius >= 1.0 - ROUNDING

    @property
    def at_limit(self) -> bool:
        """Whether the motion neither grows nor decays, so that noise builds it up."""
        return self.unstable and self.radius <= 1.0 + ROUNDING

    @property
    def thin(self) -> bool:
        """Whether the loop is close to instability."""
        return not self.unstable and (
            self.gain_margin < THIN_GAIN or self.delay_margin_samples < THIN_DELAY_SAMPLES
        )

    @property
    def unproven(self) -> bool:
        """Whether the response above the sweep, which is not known, decides about stability."""
        return not self.unstable and self.unseen_force < UNSEEN_FORCE


def judge(setup: Setup) -> LoopVerdict | None:
    """Return the stability of the loop of a test; None if the rig's response is not known.

    The worse of the law's initial settings and those to which the response leads it.
    """
    config = setup.controller
    model = response.plant(setup.rig)
    if model is None or config.motion.integrator == "prescribed":
        return None
    hold, h = response.hold_of(setup.rig), config.period_s
    found = []
    for law in laws(config.law, model, h, hold):
        loop = loop_of(config, model, law, hold)
        f_hz, z = above(model.swept_hz, h, loop)
        lead = law if config.lead_enabled else gain(1.0)
        fed_back = model.stiffness_n_per_m * lead.response(z)[:, 0]
        moved = np.abs(loop.without_rig(z) * fed_back)
        found.append(verdict(loop, setup.rate, model.swept_hz, (f_hz, moved)))
    return worst(found)


def above(swept_hz: float, h: float, loop: AnyLoop) -> tuple[Floats, Complexes]:
    """Return the frequencies that a complete sweep would also have, Hz, and their z.

    Those of the loop without its rig are among them: a mode of the numerical part, or one that the
    force compensation makes of it, can be narrower than any grid.
    """
    top = min(0.5 / h, response.TOP_HZ)
    if swept_hz >= top:
        return np.zeros(0), np.zeros(0, complex)
    modes_hz = np.abs(np.angle(loop.roots(0.0))) / (2.0 * math.pi * h)
    inside = modes_hz[(modes_hz > swept_hz) & (modes_hz < top)]
    f_hz = np.union1d(np.geomspace(swept_hz, top, _ABOVE), inside)
    return f_hz, np.exp(2j * np.pi * f_hz * h)


_ABOVE: Final = 300
"""Number of frequencies."""


def worst(found: list[LoopVerdict]) -> LoopVerdict:
    """Return the least stable of the states of a law, with the least force of all of them."""
    least = min(found, key=lambda one: one.unseen_force)
    return replace(
        max(found, key=badness), unseen_force=least.unseen_force, unseen_hz=least.unseen_hz
    )


def badness(found: LoopVerdict) -> tuple[bool, float, float]:
    """Return a key that is larger, the less stable a loop is."""
    return found.unstable, -found.gain_margin, -found.delay_margin_samples


_UNDAMPED: Final = (
    "increase the damping of the structure, or damp what the step cannot resolve with "
    'integrator = "kr-alpha" and rho_inf below 1'
)
_SLOW: Final = "compensate the delay, or increase the damping of the structure"


def remark(found: LoopVerdict | None, fast: str) -> str | None:
    """Return a remark for the user on an unstable or nearly unstable loop, or None.

    Args:
        found: the stability of the loop; None: not known.
        fast: what to do against an instability above the motion of structures.
    """
    if found is None or not (found.unstable or found.thin or found.unproven):
        return None
    known = f"the rig's response is known up to {found.swept_hz:g} Hz"
    if found.thin:
        found_delay = delay(found.delay_margin_samples, STANDARD_HZ)
        return (
            "the whole loop is stable, but with little margin: it tolerates "
            f"{found.gain_margin:.3g} times the rig's gain ({THIN_GAIN:g} are advised) and an "
            f"additional delay of {found_delay}; at least "
            f"{delay(THIN_DELAY_SAMPLES, STANDARD_HZ)} is advised; {known}"
        )
    if found.unproven:
        return (
            f"whether the whole loop is stable is known only up to {found.swept_hz:g} Hz, the end "
            f"of the rig's sweep: above, {found.unseen_force:.2g} times the elastic force of the "
            f"commanded motion can make it unstable, at {found.unseen_hz:.3g} Hz, and a mass or a "
            f"resonance of actuator and specimen can be the cause; {response.REMEDY}"
        )
    remedy = _SLOW if found.frequency_hz <= response.SLOW_HZ else fast
    what = "unstable, so the motion will grow"
    if found.at_limit:
        remedy = _UNDAMPED
        what = "at the limit of stability, so motion does not decay and noise builds it up"
    return (
        "the whole loop (numerical part, control law, rig, force compensation; specimen elastic) "
        f"is {what}: its largest root is {found.radius:.5f} at {found.frequency_hz:.3g} Hz, and "
        f"must be below 1; {known}; {remedy}"
    )


def verdict(
    loop: AnyLoop, rate: Rate, swept_hz: float, unseen: tuple[Floats, Floats] | None = None
) -> LoopVerdict:
    """Return the stability of a loop.

    Where the rig's response is not known, the loop is stable whatever its phase if the loop gain is
    below 1; the force at which it is 1 is what the verdict has of it.

    Args:
        loop: the loop.
        rate: its rate.
        swept_hz: frequency up to which the rig's response is known.
        unseen: frequencies above, Hz, and there the loop gain with a rig that feeds back the
            elastic force of what is commanded, (k,) each; None: not examined.
    """
    roots = loop.roots()
    largest = roots[np.argmax(np.abs(roots))]
    radius, frequency = float(np.abs(largest)), float(abs(np.angle(largest))) * rate.hz
    stable = radius < 1.0 - ROUNDING
    f_hz, loop_gain = (np.zeros(0), np.zeros(0)) if unseen is None else unseen
    at = int(np.argmax(loop_gain)) if loop_gain.size else 0
    felt = bool(loop_gain.size) and loop_gain[at] > 0.0
    return LoopVerdict(
        radius=radius,
        frequency_hz=frequency / (2.0 * math.pi),
        gain_margin=loop.gain_margin() if stable else 0.0,
        delay_margin_samples=loop.delay_margin() / rate.pace if stable else 0.0,
        swept_hz=swept_hz,
        unseen_force=float(1.0 / loop_gain[at]) if felt else math.inf,
        unseen_hz=float(f_hz[at]) if felt else 0.0,
    )
