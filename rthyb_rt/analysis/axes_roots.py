"""Stability of the closed loop of a test on several axes, before it runs: roots and margins.

As for one axis (`rthyb_rt.analysis.loop_roots`), with matrices. The interface's command x_c leads
to those of the axes by the kinematics at rest, T; they pass the control law C and the identified
axes G, and return as the interface's reading x_m = T^+ G C T x_c. With Z the specimen's stiffness,
damping and mass, LP the low-pass and tau V the delay of the force compensation, K its stiffness:

    f* = Z x_m + K (LP + tau V) x_c - K LP x_m,   x_c = -N f*

The axes are known at the frequencies of a sweep only. There x_m and the force Z x_m are fitted by
real poles behind a common delay, which is stable by construction; beyond the sweep the model rolls
off. If no fit follows the sweep, the loop is not judged.

Redundant actuators are identified one by one, so G is diagonal, and the model of each is used
without a further fit. The forces by which they oppose each other have no resultant along the
interface, and load cells that are not in line with the actuators do not measure them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import axes_resonances, loop_roots, margins, unseen_response
from rthyb_rt.analysis.axes_resonances import Pair
from rthyb_rt.analysis.linear_parts import LinearStep
from rthyb_rt.analysis.loop_roots import AnyLoop, Block, LoopVerdict, closed_roots
from rthyb_rt.config import response
from rthyb_rt.config.axes_response import response_of_rig
from rthyb_rt.config.matrix_response import MatrixResponse, fitted_terms
from rthyb_rt.core import ControllerConfig
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLeadConfig
from rthyb_rt.core.sparse import SparseConfig

if TYPE_CHECKING:
    from rthyb_rt.config import AxesRig, Rate
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

POLES_HZ: Final = (2.0, 5.0, 12.0, 25.0, 50.0, 100.0, 200.0)
"""About an octave apart: from the slow modes of a servo to where a command at 1024 Hz ends."""
MOST_LATE: Final = 64
"""Largest delay that is tried, in samples: a loop with a longer one has no use."""
MOST_ERROR: Final = response.MOST_ERROR
"""Largest error of the fit in the sweep, as a share of the response at rest; as for one axis."""


GOOD: Final = 0.02
"""Error of the fit that is not worth a larger model beyond the sweep: of the order of what the
sweep itself leaves uncertain, 1 to 2 % on the shipped rigs from one sweep to the next."""
_QUIET: Final = tuple(0.1 * 0.25**k for k in range(8))
"""Trial weights on the size of the response beyond the sweep, where it is not known."""
_BEYOND_TONES: Final = 40
_WORTH: Final = 2.0
"""Factor by which each pole pair must reduce the error; as for the orders of one axis."""


@dataclass(frozen=True)
class System:
    """A linear system, s[n+1] = A s[n] + B u[n], y[n] = C s[n] + D u[n].

    Attributes:
        a, b, c, d: (n, n), (n, inputs), (outputs, n), (outputs, inputs).
        response: transfer function at z, (k,), as (k, outputs, inputs); it is put together from
            those of the parts, since the roots of delays in series are not separable.
    """

    a: Floats
    b: Floats
    c: Floats
    d: Floats
    response: Callable[[Complexes], Complexes]

    def then(self, other: System) -> System:
        """Return the series connection: the other system fed by this one."""
        n, m = len(self.a), len(other.a)
        a = np.zeros((n + m, n + m))
        a[:n, :n], a[n:, n:], a[n:, :n] = self.a, other.a, other.b @ self.c
        return System(
            a,
            np.vstack([self.b, other.b @ self.d]),
            np.hstack([other.d @ self.c, other.c]),
            other.d @ self.d,
            lambda z: other.response(z) @ self.response(z),
        )

    def plus(self, other: System) -> System:
        """Return the sum of both outputs for a common input."""
        n, m = len(self.a), len(other.a)
        a = np.zeros((n + m, n + m))
        a[:n, :n], a[n:, n:] = self.a, other.a
        return System(
            a,
            np.vstack([self.b, other.b]),
            np.hstack([self.c, other.c]),
            self.d + other.d,
            lambda z: self.response(z) + other.response(z),
        )

    def times(self, by: Floats) -> System:
        """Return the system with its output multiplied by a matrix from the left."""
        return System(self.a, self.b, by @ self.c, by @ self.d, lambda z: by @ self.response(z))


def constant(matrix: Floats) -> System:
    """Return a system without memory."""
    rows, columns = matrix.shape
    return System(
        np.zeros((0, 0)),
        np.zeros((0, columns)),
        np.zeros((rows, 0)),
        matrix,
        lambda z: np.broadcast_to(matrix.astype(complex), (z.size, rows, columns)),
    )


def on_each(block: Block, count: int) -> System:
    """Return a block for each of several inputs: all its outputs for the first, the second, ..."""
    one = np.eye(count)

    def spread(matrix: Floats) -> Floats:
        return np.asarray(np.kron(one, matrix), np.float64)

    return System(
        spread(block.a),
        spread(block.b[:, None]),
        spread(block.c),
        spread(block.d[:, None]),
        lambda z: np.asarray(np.kron(one[None], block.response(z)[:, :, None]), np.complex128),
    )


def side_by_side(blocks: list[Block]) -> System:
    """Return blocks of one output each for as many inputs."""
    one = np.eye(len(blocks))
    whole = constant(np.zeros_like(one))
    for block, own in zip(blocks, one, strict=True):
        whole = whole.plus(constant(own[None, :]).then(on_each(block, 1)).times(own[:, None]))
    return whole


def _mixed(block: Block, weights: Floats) -> System:
    """Return the sum over a block's outputs, each times its matrix.

    Args:
        block: as many outputs as there are matrices.
        weights: (block's outputs, outputs, inputs).
    """
    shapes, rows, columns = weights.shape
    return on_each(block, columns).times(weights.transpose(1, 2, 0).reshape(rows, columns * shapes))


# ---- the parts ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Axes:
    """Fitted axes with their specimen.

    Attributes:
        system: commands of the axes -> x_m along the interface, then the forces along it.
        swept_hz: highest frequency of the sweep.
        error: largest error of x_m in the sweep, as a share of the largest response.
    """

    system: System
    swept_hz: float
    error: float


def fitted_axes(rig: AxesRig, found: MatrixResponse, period_s: float) -> Axes | None:
    """Return the axes as identified, or None if no model follows the sweep.

    Args:
        rig: the rig, with specimen and kinematics.
        found: its response at the rate of the controller.
        period_s: sampling period.
    """
    f = found.frequency_hz
    if f.size < response.LEAST_TONES:
        return None
    moved = rig.core_kinematics().weights() @ found.response
    w2 = (2.0 * math.pi * f) ** 2
    k_e = np.array(rig.k_e)
    z = k_e + np.zeros((f.size, 1, 1), complex)
    if rig.specimen.damping is not None:
        z = z + 1j * np.sqrt(w2)[:, None, None] * np.array(rig.specimen.damping)
    if rig.specimen.mass is not None:
        z = z - w2[:, None, None] * np.array(rig.specimen.mass)
    # Forces as displacements at rest, so that both count alike.
    per_k = np.linalg.inv(k_e)
    wanted = np.concatenate([moved, per_k @ z @ moved], axis=1)
    error, block, weights = _model_of(f, wanted, len(k_e), period_s)
    if error > MOST_ERROR:
        return None
    size = len(k_e)
    system = _mixed(block, weights.reshape(-1, 2 * size, moved.shape[2]))
    both = np.zeros((2 * size, 2 * size))
    both[:size, :size], both[size:, size:] = np.eye(size), k_e
    return Axes(system.times(both), float(f[-1]), error)


class _Fits:
    """Fits of x_m and of the force, as a displacement, by poles behind a delay.

    Args:
        f: frequencies of the sweep, (k,).
        wanted: both, one below the other, (k, 2 size, axes).
        size: number of directions.
        period_s: sampling period.
    """

    def __init__(self, f: Floats, wanted: Complexes, size: int, period_s: float) -> None:
        self.f, self.h, self.moved = f, period_s, wanted[:, :size]
        self.z = np.exp(2j * np.pi * f * period_s)
        self.beyond = np.exp(2j * np.pi * np.linspace(f[-1] * period_s, 0.5, _BEYOND_TONES))
        self.right = _stacked(wanted).reshape(2 * f.size, -1)
        self.aim = np.concatenate([self.right, np.zeros((2 * _BEYOND_TONES, self.right.shape[1]))])

    def best_of(self, blocks: list[_Poles], scale: Floats) -> tuple[float, _Poles, Floats]:
        """Return the error of the best fit, its poles, and their weights.

        Args:
            blocks: the poles that are tried.
            scale: what an error counts against, at each row, (2 k, 1).
        """
        trials = [(one, _stacked(one.response(self.z)), _stacked(one.response(self.beyond)))
                  for one in blocks]  # fmt: skip
        best: tuple[float, _Poles, Floats] | None = None
        for quiet in _QUIET:
            for block, columns, outside in trials:
                rows = np.concatenate([columns, quiet * outside])
                weights = np.linalg.lstsq(rows, self.aim, rcond=1e-12)[0]
                error = float((np.abs(columns @ weights - self.right) / scale).max())
                if best is None or error < best[0]:
                    best = error, block, weights
            if best is not None and best[0] <= GOOD:
                break
        assert best is not None
        return best


def _model_of(
    f: Floats, wanted: Complexes, size: int, period_s: float
) -> tuple[float, _Poles, Floats]:
    """Return error, poles and weights of the simplest model that follows a sweep, or of the best.

    Pole pairs are added one by one where real poles do not follow it, each only if it halves what
    is left: a further pair can also follow noise.
    """
    fits = _Fits(f, wanted, size, period_s)
    peak = np.abs(fits.moved).max(axis=(1, 2))
    real = [_Poles.of(period_s, late) for late in range(MOST_LATE + 1)]
    best = fits.best_of(real, np.full((2 * f.size, 1), peak.max()))
    if best[0] <= GOOD:
        return best
    # A peak is no reason to be less accurate elsewhere.
    scale = np.tile(np.maximum(peak, peak[0]), 2)[:, None]
    grid = axes_resonances.Grid(fits.z, fits.beyond, _QUIET[-1], period_s)
    late = [one for one in real if one.late * period_s <= _slowest_s(f, fits.moved)]
    fixed = [grid.rows(one.response(fits.z), one.response(fits.beyond)) for one in late]
    for count in range(1, axes_resonances.most_pairs(f.size, 1 + real[0].rho.size) + 1):
        at, pairs = axes_resonances.found_pairs(grid, f, fixed, fits.aim, count)
        found = fits.best_of([_Poles.of(period_s, at, tuple(pairs))], scale)
        if found[0] * _WORTH <= best[0]:
            best = found
        if best[0] <= GOOD:
            break
    return best


def _slowest_s(f: Floats, moved: Complexes) -> float:
    """Return the longest delay of the slowest sine, s: no delay in series with it is longer.

    Each axis counts by the direction that it moves most, either way: the phase of a small coupling
    is that of noise.
    """
    most = np.abs(moved[0]).argmax(axis=0)
    turns = -np.angle(moved[0][most, np.arange(most.size)]) % np.pi
    return float(turns.max() / (2.0 * np.pi * f[0]))


def each_alone(rig: AxesRig, rate: Rate) -> Axes | None:
    """Return redundant axes by the model of each; None if one of them has none.

    Args:
        rig: the rig, whose axes were identified before they were attached to the specimen.
        rate: rate of the commands.
    """
    views = [rig.of_axis(name) for name in rig.names]
    models = [response.plant(view) for view in views]
    tie, size = rig.core_kinematics(), len(rig.k_e)
    weights, back = tie.weights(), tie.back()
    impedance = [
        np.zeros((size, size)) if rows is None else np.array(rows, dtype=np.float64)
        for rows in (rig.k_e, rig.specimen.damping, rig.specimen.mass)
    ]
    whole = constant(np.zeros((2 * size, len(views))))
    errors, swept_hz = [0.0], []
    for i, (model, view) in enumerate(zip(models, views, strict=True)):
        if model is None:
            return None
        motion = loop_roots.motion(model, rate.period_s, response.hold_of(view))
        outputs = np.zeros((2 * size, 3))
        outputs[:size, 0] = weights[:, i]
        outputs[size:] = np.column_stack([by @ back[:, i] for by in impedance])
        chosen = constant(np.eye(len(views))[i : i + 1])
        whole = whole.plus(chosen.then(on_each(motion, 1)).times(outputs))
        errors.append(model.error)
        swept_hz.append(model.swept_hz)
    return Axes(whole, min(swept_hz), max(errors))


def is_swept(rig: AxesRig) -> bool:
    """Return whether a rig file has the responses from which the loop is judged."""
    if not rig.is_redundant:
        return rig.identified is not None
    found = [rig.of_axis(name).identified for name in rig.names]
    return all(one is not None and len(one.frequency_hz) > 1 for one in found)


def swept_response(setup: Setup) -> MatrixResponse | None:
    """Return the response matrix of a test's axes; None without a sweep, or of redundant axes."""
    assert setup.group is not None
    rig = setup.group.rig
    if rig.is_redundant or rig.identified is None:
        return None
    return response_of_rig(rig, rig.identified, setup.rate)


def axes_and_laws(setup: Setup) -> tuple[Axes, list[System]] | None:
    """Return the axes of a test, and its control laws with their initial settings and as adapted.

    None if the response of the axes is not known, or no model follows it.
    """
    assert setup.group is not None
    rig = setup.group.rig
    if rig.is_redundant:
        alone = each_alone(rig, setup.rate)
        return None if alone is None else (alone, laws(setup, None))
    found = swept_response(setup)
    if found is None:
        return None
    axes = fitted_axes(rig, found, setup.controller.period_s)
    return None if axes is None else (axes, laws(setup, found))


def _stacked(values: Complexes) -> Floats:
    """Return the real parts, and below them the imaginary ones."""
    return np.concatenate([values.real, values.imag])


@dataclass(frozen=True)
class _Poles(Block):
    """A delay of late + 1 samples, and what poles make of it: outputs (1, 1 + real + 2 pairs)."""

    late: int
    rho: Floats
    pairs: tuple[Pair, ...]
    period_s: float

    @classmethod
    def of(cls, h: float, late: int, pairs: tuple[Pair, ...] = ()) -> _Poles:
        """Return those of `POLES_HZ` that a sampling period allows, and pole pairs."""
        rho = np.exp(-2.0 * math.pi * np.array([f for f in POLES_HZ if 2.0 * f * h < 1.0]) * h)
        n, real = late + 1, late + 1 + rho.size
        a = np.zeros((real + 2 * len(pairs),) * 2)
        a[np.arange(1, n), np.arange(n - 1)] = 1.0
        a[n:real, n:real], a[n:real, n - 1] = np.diag(rho), 1.0 - rho
        c = np.eye(len(a))[n - 1 :]
        for k, pair in enumerate(pairs):
            # States: z u / D and u / D, with D = z^2 + a1 z + a0.
            new, a1, a0 = real + 2 * k, *pair.of_z(h)
            a[new, [n - 1, new, new + 1]] = 1.0, -a1, -a0
            a[new + 1, new] = 1.0
            rest, rate = (1.0 + a1 + a0), 2.0 * math.pi * pair.natural_hz * h
            own = c[rho.size + 1 + 2 * k :]
            own[:2] = 0.0
            own[0, new + 1] = rest
            own[1, [new, new + 1]] = rest / rate, -rest / rate
        return cls(a, np.eye(len(a))[0], c, np.zeros(len(c)), late, rho, pairs, h)

    def response(self, z: Complexes) -> Complexes:
        """Return the transfer function at z (k,) as (k, outputs)."""
        behind = (1.0 - self.rho) / (z[:, None] - self.rho)
        own = [pair.response(z, self.period_s) for pair in self.pairs]
        waits = z[:, None] ** -(self.late + 1.0)
        return np.asarray(waits * np.hstack([np.ones((z.size, 1)), behind, *own]))


def matrix_law(config: MatrixLeadConfig, terms: Floats) -> System:
    """Return the matrix law with gain less 1, delay (s) and curvature (s^2), (3, axes, axes)."""
    h, size = config.period_s, config.size
    rho = math.exp(-2.0 * math.pi * config.roll_off_hz * h)
    bottom = np.array([1.0 / rho**2, -2.0 / rho, 1.0])
    filtered = [
        loop_roots.rational(bottom.sum() * np.array(top), bottom)
        for top in ([1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -2.0, 1.0])
    ]
    block = filtered[0].beside(filtered[1]).beside(filtered[2])
    per_sample = terms / np.array([1.0, h, h * h])[:, None, None]
    lead = constant(np.eye(size)).plus(_mixed(block, per_sample))
    if config.inverse is None:
        return lead
    return lead.then(inverse_law(config.inverse, h))


def inverse_law(inverse: MatrixInverse, h: float) -> System:
    """Return C(z) of `rthyb_rt.config.matrix_response`."""
    block = loop_roots.gain(1.0)
    for f in inverse.pole_hz:
        rho = math.exp(-2.0 * math.pi * f * h)
        block = block.beside(loop_roots.rational(np.array([1.0, -1.0]), np.array([1.0, -rho])))
    return _mixed(block, np.asarray(inverse.coefficients, np.float64))


def laws(setup: Setup, found: MatrixResponse | None) -> list[System]:
    """Return the control laws of a test with their initial settings, and as adapted."""
    config, h = setup.controller, setup.controller.period_s
    count = len(config.axes)
    if not config.lead_enabled:
        return [constant(np.eye(count))]
    if config.matrix_lead is not None:
        assert found is not None
        own = config.matrix_lead
        first = np.zeros((3, count, count)) if own.first is None else np.asarray(own.first)
        adapted = fitted_terms(found, h, own.roll_off_hz, coupled=own.coupled, before=own.inverse)
        return [matrix_law(own, first), matrix_law(own, adapted)]
    assert setup.group is not None
    rig, of_axes = setup.group.rig, []
    for axis in config.axes:
        law = axis.law or config.law
        view = rig.of_axis(axis.name)
        model = response.plant(view)
        if model is None:
            return []
        of_axes.append(loop_roots.laws(law, model, h, response.hold_of(view)))
    # Each law has its initial settings first; one that does not adapt has only those.
    chosen = [0, -1] if any(len(of) > 1 for of in of_axes) else [0]
    return [side_by_side([of[which] for of in of_axes]) for which in chosen]


# ---- the loop -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class AxesLoop(AnyLoop):
    """A loop in parts: f* -> x_c, the feedback through the axes, and that without them."""

    # Each factor takes the eigenvalues of some hundred states: the margin is found to .5 %.
    searched = (13, 8)

    part: LinearStep
    law: System
    axes: System
    beside: System

    def roots(self, by: float = 1.0) -> Complexes:
        """Return the roots of the loop with the axes' response multiplied by a factor."""
        back = self.law.then(self.axes).times(by * np.eye(len(self.part.c))).plus(self.beside)
        part = self.part
        return closed_roots((part.a, part.b, part.c), (back.a, back.b, back.c, back.d))

    def opened(self, z: Complexes) -> Complexes:
        """Return the loop opened at all axes, for z (k,): eigenvalues by magnitude, (k, m).

        A common gain or delay of the axes multiplies each of them: the loop is at its limit where
        one is -1.
        """
        moved = self.part.response(z)
        by_axes = self.law.then(self.axes).response(z)
        inner = np.eye(len(self.part.c)) - moved @ self.beside.response(z)
        values = np.linalg.eigvals(-np.linalg.solve(inner, moved @ by_axes))
        order = np.argsort(-np.abs(values), axis=1)
        return np.asarray(np.take_along_axis(values, order, axis=1))

    def delay_margin(self) -> float:
        """Return the additional delay of all axes at which stability ends, samples; inf: none."""
        peaks = np.abs(np.angle(np.concatenate([self.roots(), self.roots(0.0)])))

        def branch(i: int) -> float:
            return margins.first_crossing(lambda z: self.opened(z)[:, i], peaks, 0)

        return min(branch(i) for i in range(len(self.part.c)))


def loop_of(config: ControllerConfig, axes: Axes, law: System, jacobian: Floats) -> AxesLoop:
    """Assemble the loop of a test, with the stiffness of the force compensation at k_e.

    Raises:
        CoreError: the numerical part has a motion without stiffness.
    """
    assert isinstance(config.numerical, SparseConfig)
    part = LinearStep.of(config.numerical)
    size, h = len(part.c), config.period_s
    one, none = np.eye(size), np.zeros((size, size))
    k, cutoff_hz, lateness_s = none, 0.0, 0.0
    if config.matrix_rfc is not None:
        rfc = config.matrix_rfc
        k = np.asarray(rfc.k_e) if rfc.enabled else none
        cutoff_hz, lateness_s = rfc.cutoff_hz, rfc.lateness_s
    filtered = on_each(loop_roots.low_pass(cutoff_hz, h), size)
    force = axes.system.times(np.hstack([none, one]))
    beside = filtered.times(k)
    if k.any():
        moved = axes.system.times(np.hstack([one, none]))
        force = force.plus(moved.then(filtered).times(-k))
        if lateness_s:
            velocity = on_each(loop_roots.backward_velocity(h), size)
            beside = beside.plus(velocity.times(k * lateness_s))
    return AxesLoop(part, constant(jacobian).then(law), force, beside)


def judge(setup: Setup) -> LoopVerdict | None:
    """Return the stability of the loop of a test; None if the axes' response is not known.

    The worse of the laws' initial settings and those to which the response leads them.
    """
    assert setup.group is not None
    rig, config = setup.group.rig, setup.controller
    if not isinstance(config.numerical, SparseConfig):
        return None
    known = axes_and_laws(setup)
    if known is None:
        return None
    axes, states = known
    tie, k_e, h = rig.core_kinematics(), np.array(rig.k_e), config.period_s
    blocks = unseen_response.separate_specimens(rig, swept_response(setup))
    verdicts = []
    for law in states:
        loop = loop_of(config, axes, law, tie.jacobian())
        f_hz, z = loop_roots.above(axes.swept_hz, h, loop)
        gains = unseen_response.loop_gain(loop, k_e, tie.weights(), z, blocks)
        verdicts.append(loop_roots.verdict(loop, setup.rate, axes.swept_hz, (f_hz, gains)))
    return loop_roots.worst(verdicts) if verdicts else None
