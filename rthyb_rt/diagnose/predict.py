"""The augmented model: simulated along another recording, and refined there.

The specimen's part of every effect is simulated as elements of the core if there are any; otherwise
force and motion are iterated until they agree.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import (
    ActuatorModel,
    ComputedMotion,
    SimulationError,
    actuator,
    body,
)
from rthyb_rt.diagnose import estimate, gaps, loading_history, noise_level, spectral
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.effects.base import Context, Trial
from rthyb_rt.diagnose.onset import lasting
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Member, columns_of

ROUNDS = 25
HEAD = 300
"""Number of first rows from which the start of a motion is fitted, at most."""
HEAD_LEAST = 8
"""Least number of these rows."""


@dataclass(frozen=True)
class Augmented:
    """The baseline with corrected parameters, together with the effects.

    Attributes:
        model: baseline with fitted stiffness, damping and mass.
        base: the baseline as given, relative to which effects are defined.
        members, betas: effects of the force with their coefficients.
        actuator: actuator including the effects found in it, or None.
        ranges: ranges of the recording to which it was fitted.
        zeros_m: zero of the displacement sensor relative to the command, overall and at the end.
        cell: whether a load cell recorded the force. Effects of the sensor are then its own and
            move nothing; without one an offset represents a force on the body.
    """

    model: Model
    base: Model
    members: tuple[Member, ...]
    betas: tuple[Floats, ...]
    actuator: ActuatorModel | None
    ranges: tuple[float, float, float] | None
    skew_s: float = 0.0
    zeros_m: tuple[float, float] = (0.0, 0.0)
    cell: bool = False

    def lasting(self) -> Augmented:
        """Return the model as at the end of the recording, including effects with an onset."""
        return replace(self, members=tuple(lasting(m) for m in self.members))

    def context(self, motion: ComputedMotion, t: Floats, other: dict[str, Floats]) -> Context:
        """Return the quantities on which laws depend along a motion."""
        return Context(self.base, motion, t, np.zeros(t.size), other, self.ranges)

    def effect_force(
        self, motion: ComputedMotion, t: Floats, other: dict[str, Floats], sensor: bool = True
    ) -> Floats:
        """Return the force of the effects along a motion, (n,), N."""
        ctx = self.context(motion, t, other)
        total = np.zeros(t.size)

        def there(member: Member) -> bool:
            # The phase of a hum in another recording is unknown.
            if member.effect.sensor and not (sensor and member.effect.foretold):
                return False
            return not member.effect.needs or member.effect.needs in other

        shown = [(m, b) for m, b in zip(self.members, self.betas, strict=True) if there(m)]
        for (_, beta), columns in zip(shown, columns_of(ctx, [m for m, _ in shown]), strict=True):
            for b, c in zip(beta, columns, strict=True):
                total += b * c
        return total

    def force(self, motion: ComputedMotion, t: Floats, other: dict[str, Floats]) -> Floats:
        """Return the force that the load cell shows along a motion, (n,), N."""
        return self.model.force(motion.x, motion.v, motion.a) + self.effect_force(motion, t, other)

    def elements(
        self, beside: float = 0.0
    ) -> tuple[list[core.ElementConfig], float, list[tuple[Member, Floats]]]:
        """Return elements, mass, and the effects that have no element.

        Negative mass is not an element but reduces the mass, if there is enough of it (``beside``,
        kg).
        """
        ctx = self.context(
            ComputedMotion(np.zeros(2), np.zeros(2), np.zeros(2)),
            np.arange(2.0) / self.model.fs_hz,
            {},
        )
        pairs = list(zip(self.members, self.betas, strict=True))
        loop = self.base.k * sum(m.effect.of_loop(ctx, m.trial, b) for m, b in pairs)
        model = replace(self.model, k=self.model.k + loop)
        if loop and not model.k > 0.0:  # not a loop that the core accepts
            model, loop = self.model, 0.0
        out, mass = model.elements(), model.moving_mass
        rest: list[tuple[Member, Floats]] = []
        for member, beta in pairs:
            own = None
            if loop and member.effect.of_loop(ctx, member.trial, beta):
                continue
            added = member.effect.mass_kg(beta)
            if added is not None and beside + mass + added > 0.0:
                mass += added
                continue
            if not member.effect.sensor and not member.effect.replaces_spring:
                own = member.effect.on_a_body(ctx, member.trial, beta)
            if own is None:
                rest.append((member, beta))
                continue
            for item in own:
                if item.kind == "inertia":
                    mass += item.params[0]
                else:
                    out.append(item)
        return out, mass, rest

    def moved_by(
        self, push: Floats, mass: float, t: Floats, other: dict[str, Floats],
        start: tuple[float, float] = (0.0, 0.0),
    ) -> ComputedMotion:  # fmt: skip
        """Return the motion of mass and specimen under a force of shape (n,), N."""
        elements, own_mass, rest = self.elements(mass)
        whole = mass + own_mass
        substeps = _substeps(self.model, whole)
        if len(elements) > core.ELEMENTS_MAX:
            elements, rest = self.model.elements(), list(zip(self.members, self.betas, strict=True))

        def run(force: Floats) -> ComputedMotion:
            return body(whole, elements, force, self.model.fs_hz, start, self.model.hold, substeps)

        motion = run(push)
        beside = replace(self, members=tuple(m for m, _ in rest), betas=tuple(b for _, b in rest))
        if not rest:
            return motion
        extra = np.zeros_like(push)
        for k in range(ROUNDS):
            new = beside.effect_force(motion, t, other, sensor=not self.cell)
            change = float(np.std(new - extra))
            extra = extra + (1.0 if k < 4 else 0.5) * (new - extra)
            try:
                motion = run(push - extra)
            except SimulationError:
                break
            if change < 1e-4 * (float(np.std(push)) or 1.0):
                break
        return motion


def _substeps(model: Model, mass: float) -> int:
    """Return the number of substeps that resolves the model's spring, even if four times as stiff.

    A dry contact is much stiffer, but its force is limited: if it is not resolved, it chatters.
    """
    stiffest = abs(model.k) * 4.0
    step = 1.0 / model.fs_hz
    return int(np.clip(np.ceil(step * np.sqrt(stiffest / max(mass, 1e-12)) / 0.25), 4, 64))


@dataclass(frozen=True)
class Prediction:
    """Force and displacement predicted by a model, each (n,); NaN where it cannot."""

    t: Floats
    f: Floats
    x: Floats


def predict(
    augmented: Augmented, case: Case, before: Case | None = None, begun: bool = True
) -> Prediction:
    """Return the prediction of a model for a recording's inputs.

    Args:
        augmented: the model.
        case: the recording; outputs may be missing.
        before: the recording to which the model was fitted. Effects with an onset are present
            throughout in another one; if this one continues it, its history is simulated first.
        begun: whether the first rows of its force show the specimen's loading history.
    """
    if augmented.model.fs_hz != case.fs_hz:
        augmented = replace(augmented, model=replace(augmented.model, fs_hz=case.fs_hz))
    if before is not None and not continues(before, case):
        augmented = augmented.lasting()
    if before is not None and continues(before, case):
        whole = _joined(before, case)
        late = augmented.zeros_m[1]
        result = predict(replace(augmented, zeros_m=(late, late)), whole, begun=False)
        n = case.t.size
        through = Prediction(case.t, result.f[-n:], result.x[-n:])
        return _anew(augmented.lasting(), case, through)
    model = augmented.model
    other = {k: gaps.filled(v) for k, v in case.recorded.items() if np.isfinite(v).any()}
    x_meas = case.channels.get("x_meas")
    measured = _measured(case)
    x_only = np.full(case.t.size, np.nan)
    motion: ComputedMotion | None = None
    if model.family in ("drive", "loop"):
        from rthyb_rt.diagnose import rigged

        answered = rigged.along(augmented, case, other)
        if answered is not None:
            return Prediction(case.t, answered[1], answered[0])
        if augmented.actuator is not None and "x_cmd" in other:
            motion = _commanded(augmented, case)
            x_only = motion.x
        if motion is None or (measured and not _follows(motion.x, other["x_meas"], model)):
            motion = _measured_motion(case) if measured else motion
    else:
        motion = _driven(augmented, case, other, x_meas)
        x_only = motion.x if motion is not None else x_only
        if measured:
            motion = _measured_motion(case)
    if motion is None:
        return Prediction(case.t, np.full(case.t.size, np.nan), x_only)
    if model.family != "drive" or not begun:
        return Prediction(case.t, augmented.force(motion, case.t, other), x_only)
    reach = max(float(np.max(np.abs(motion.x))), augmented.ranges[0] if augmented.ranges else 0.0)
    force = loading_history.force_after(augmented.force, case, motion, other, reach)
    return Prediction(case.t, force, x_only)


def _anew(augmented: Augmented, case: Case, through: Prediction) -> Prediction:
    """Return the prediction of a free body from its first measured rows, if that is better.

    The error of a motion simulated from the beginning of the recording before lasts: a body without
    a spring never returns. A simulation that begins anew knows the state, but not the history, and
    the error of its initial velocity lasts as well.
    """
    model, x_meas = augmented.model, case.channels.get("x_meas")
    if model.family not in ("forced", "ground") or x_meas is None or _measured(case):
        return through
    known = _head(x_meas)
    if known < HEAD_LEAST:
        return through
    anew = predict(augmented, case)

    def off(prediction: Prediction) -> float:
        miss = prediction.x[:known] - x_meas[:known]
        return float(np.sqrt(np.mean(miss**2)))

    if not np.isfinite(off(through)):
        return anew
    # A straight line fitted to n equidistant rows over T has a slope of variance 12 s^2 / (n T^2).
    rate = off(anew) * np.sqrt(12.0 / known) / (known * case.dt)
    mass = model.whole_mass
    lasts = float(case.t[-1] - case.t[0])
    if model.k > 0.0 and mass > 0.0:
        lasts = min(lasts, float(np.sqrt(mass / model.k)))
    error = float(np.hypot(off(anew), rate * lasts))
    return anew if error < POLICY.past_better * off(through) else through


def _head(x_meas: Floats) -> int:
    """Return the number of first rows that are measured, up to those of a start."""
    good = np.isfinite(x_meas)
    return min(int(np.argmin(good)) if not good.all() else good.size, HEAD)


def _measured(case: Case) -> bool:
    """Return whether the displacement was measured to the end, not only at the start.

    Single rows may be missing, as in a recording that is diagnosed.
    """
    x_meas = case.channels.get("x_meas")
    if x_meas is None:
        return False
    good = np.isfinite(x_meas)
    end = good[-max(good.size // 20, 1) :]
    return bool(min(good.mean(), end.mean()) >= POLICY.numbers_least)


def _commanded(augmented: Augmented, case: Case) -> ComputedMotion:
    """Return the motion of the actuator along the command, relative to the sensor's zero."""
    assert augmented.actuator is not None
    motion = actuator(augmented.actuator, gaps.filled(case.channels["x_cmd"]), case.fs_hz)
    return motion.from_zero(augmented.zeros_m[0])


def followed(augmented: Augmented, case: Case, wanted: Case) -> ComputedMotion | None:
    """Return the simulated motion of a recording, if the prediction of another uses one.

    A law fitted along a measured motion compensates for its noise, and is wrong by as much along a
    simulated one. None if the prediction uses the measured motion.
    """
    drive = case.model.family in ("drive", "loop") and augmented.actuator is not None
    if not drive or "x_cmd" not in case.channels or "x_cmd" not in wanted.channels:
        return None
    if _measured(wanted):
        late = replace(augmented, zeros_m=(augmented.zeros_m[1],) * 2)
        ahead = _commanded(late if continues(case, wanted) else augmented, wanted)
        if not _follows(ahead.x, gaps.filled(wanted.channels["x_meas"]), wanted.model):
            return None
    return _commanded(augmented, case)


def _follows(x: Floats, x_meas: Floats, model: Model) -> bool:
    sigma = noise_level.noise_of(x_meas, model.x_std)
    return float(np.std(x - x_meas)) < POLICY.prediction_follows * sigma


def _measured_motion(case: Case) -> ComputedMotion:
    if estimate.quasi_static(case):
        x = gaps.filled(case.channels["x_meas"])
        return ComputedMotion(x, np.gradient(x) * case.fs_hz, np.zeros_like(x))
    motion, _, _ = spectral.smoothed(case, [])
    return motion


def _driven(
    augmented: Augmented, case: Case, other: dict[str, Floats], x_meas: Floats | None
) -> ComputedMotion | None:
    model = augmented.model
    if model.family == "ground" and "ag" in other:
        push, mass = -model.mass * other["ag"], model.mass
    elif model.family == "forced" and "f_in" in other:
        push, mass = other["f_in"], 0.0
    else:
        return None
    start = (0.0, 0.0)
    known = np.flatnonzero(np.isfinite(x_meas)) if x_meas is not None else np.zeros(0, dtype=int)
    if known.size and x_meas is not None:
        start = start_of(augmented, push, mass, case, other, x_meas)
    try:
        return augmented.moved_by(push, mass, case.t, other, start)
    except (SimulationError, core.CoreError):
        return None


def start_of(
    augmented: Augmented, push: Floats, mass: float, case: Case, other: dict[str, Floats],
    x_meas: Floats,
) -> tuple[float, float]:  # fmt: skip
    """Return displacement and velocity at the first row, from the first measured rows."""
    dt = case.dt
    x_meas = gaps.filled_if_short(x_meas)
    end = _head(x_meas)
    if end < HEAD_LEAST:
        return (float(x_meas[0]), 0.0) if end else (0.0, 0.0)
    first = min(end, 12)
    slope = np.polyfit(np.arange(first) * dt, x_meas[:first], 3)
    p = np.array([float(x_meas[0]), float(slope[-2])])
    head = slice(0, end)

    def simulated(q: Floats) -> Floats:
        part = {k: v[head] for k, v in other.items()}
        return augmented.moved_by(
            push[head], mass, case.t[head], part, (float(q[0]), float(q[1]))
        ).x

    spread = float(np.std(x_meas[head]))
    steps = np.array(
        [
            max(spread, 1e-9) * 1e-3,
            max(abs(float(p[1])), spread / dt / end) * 1e-3,
        ]
    )
    try:
        for _ in range(4):
            x = simulated(p)
            jacobian = np.column_stack(
                [(simulated(p + np.eye(2)[j] * steps[j]) - x) / steps[j] for j in range(2)]
            )
            scale = np.maximum(np.sqrt(np.sum(jacobian**2, axis=0)), 1e-300)
            delta, *_ = np.linalg.lstsq(jacobian / scale, x_meas[head] - x, rcond=None)
            p = p + delta / scale
    except (SimulationError, core.CoreError, np.linalg.LinAlgError):
        return (float(x_meas[0]), float(slope[-2]))
    return (float(p[0]), float(p[1]))


def continues(before: Case, case: Case) -> bool:
    """Return whether a recording continues another one."""
    gap = case.t[0] - before.t[-1]
    return case.fs_hz == before.fs_hz and bool(0.5 * case.dt < gap < 1.5 * case.dt)


def _joined(before: Case, case: Case) -> Case:
    n, m = before.t.size, case.t.size

    def chained(first: dict[str, Floats], then: dict[str, Floats]) -> dict[str, Floats]:
        return {
            k: np.concatenate((first.get(k, np.full(n, np.nan)), then.get(k, np.full(m, np.nan))))
            for k in set(first) | set(then)
        }

    # The displacement must not be used if it is to be predicted.
    return replace(
        case,
        t=np.concatenate((before.t, case.t)),
        channels=chained(before.channels, case.channels),
        further=chained(before.further, case.further),
        rows=np.concatenate((before.rows, case.rows)),
    )


def nrmse(predicted: Floats, measured: Floats, first: int = 0) -> float:
    """Return rms(predicted - measured) / std(measured) from a row on, as a fraction."""
    good = np.isfinite(predicted) & np.isfinite(measured)
    good[:first] = False
    if good.sum() < 10:
        return float("nan")
    spread = float(np.std(measured[good]))
    return (
        float(np.sqrt(np.mean((predicted - measured)[good] ** 2))) / spread
        if spread
        else float("nan")
    )


def parameters(augmented: Augmented) -> list[tuple[str, int, int]]:
    """Return the parameters that may be refined: (kind, member, index)."""
    out = []
    model = augmented.model
    if model.k:
        out.append(("k", 0, 0))
    if model.c:
        out.append(("c", 0, 0))
    if model.moving_mass and model.k_tol is None:
        out.append(("m", 0, 0))
    for i, (member, beta) in enumerate(zip(augmented.members, augmented.betas, strict=True)):
        _, pinned = member.effect.settings(
            augmented.context(
                ComputedMotion(np.zeros(2), np.zeros(2), np.zeros(2)), np.arange(2.0), {}
            ),
            member.trial,
        )[0]
        out += [("beta", i, j) for j in range(len(beta)) if pinned[j] is None and beta[j] != 0.0]
        out += [("theta", i, j) for j in range(len(member.trial.theta))]
    return out


def changed(augmented: Augmented, places: Sequence[tuple[str, int, int]], by: Floats) -> Augmented:
    """Return the model with each of some parameters multiplied by exp(by)."""
    model, members, betas = augmented.model, list(augmented.members), list(augmented.betas)
    for (kind, i, j), d in zip(places, by, strict=True):
        factor = float(np.exp(d))
        if kind == "k":
            model = replace(model, k=model.k * factor)
        elif kind == "c":
            model = replace(model, c=model.c * factor)
        elif kind == "m":
            model = replace(model, moving_mass=model.moving_mass * factor)
        elif kind == "beta":
            beta = betas[i].copy()
            beta[j] *= factor
            betas[i] = beta
        else:
            theta = list(members[i].trial.theta)
            theta[j] *= factor
            members[i] = Member(members[i].effect, Trial(tuple(theta), members[i].trial.variant))
    return replace(augmented, model=model, members=tuple(members), betas=tuple(betas))


def output_error(
    augmented: Augmented, case: Case, steps: int = 6, force: bool = False
) -> Augmented:
    """Refine the model by its simulated displacement under ag or f_in.

    Equation-error estimates carry the smoother's bias into a simulation; this does not. Kept only
    if it is better (or with ``force``), with the model's tolerances as priors.
    """
    x_meas = case.channels.get("x_meas")
    if case.model.family not in ("ground", "forced") or x_meas is None:
        return augmented
    other = {k: gaps.filled(v) for k, v in case.recorded.items()}
    places = parameters(augmented)
    rows = case.rows & np.isfinite(x_meas)
    sigma = float(np.std(x_meas[rows])) or 1.0
    priors = _priors(case, places, noise_level.noise_of(x_meas, case.model.x_std) / sigma)
    if augmented.model.family == "ground":
        push, mass = -case.model.mass * other["ag"], case.model.mass
    else:
        push, mass = other["f_in"], 0.0

    start = (
        start_of(augmented, push, mass, case, other, x_meas)
        if case.model.family == "forced"
        else (0.0, 0.0)
    )

    def residual(p: Floats) -> Floats:
        motion = changed(augmented, places, p[: len(places)]).moved_by(
            push, mass, case.t, other, (start[0] + p[-2] * sigma, start[1] + p[-1] * v_scale)
        )
        return np.asarray(np.r_[(motion.x - x_meas)[rows] / sigma, priors * p[: len(places)]])

    v_scale = sigma * 2 * np.pi
    try:
        p, best, first = _descended(residual, np.zeros(len(places) + 2), steps)
    except (SimulationError, core.CoreError, np.linalg.LinAlgError):
        return augmented
    if force or best < POLICY.refined_better * first:
        return changed(augmented, places, p[: len(places)])
    return augmented


def _priors(case: Case, places: Sequence[tuple[str, int, int]], noise: float) -> Floats:
    """Return the prior weight of each parameter's change, (parameters,), from the tolerances.

    Args:
        case: the recording.
        places: the parameters.
        noise: noise of the displacement, in units of the residual.
    """
    tolerances = {"k": case.model.k_tol, "c": case.model.c_tol}
    priors = np.zeros(len(places))
    for j, (kind, _, _) in enumerate(places):
        tolerance = tolerances.get(kind)
        if tolerance:
            priors[j] = noise / tolerance
    return priors


def _descended(
    residual: Callable[[Floats], Floats], p: Floats, steps: int
) -> tuple[Floats, float, float]:
    """Return parameters of damped least squares, and the final and initial sums of squares."""
    r = residual(p)
    first = best = float(r @ r)
    damping = 1e-3
    for _ in range(steps):
        jacobian = np.column_stack(
            [(residual(p + 1e-4 * np.eye(p.size)[j]) - r) / 1e-4 for j in range(p.size)]
        )
        gram, right = jacobian.T @ jacobian, -jacobian.T @ r
        improved = False
        for _ in range(4):
            delta = np.linalg.solve(gram + damping * np.diag(gram.diagonal() + 1e-12), right)
            trial = p + np.clip(delta, -0.3, 0.3)
            try:
                r_new = residual(trial)
            except (SimulationError, core.CoreError):
                damping *= 10
                continue
            now = float(r_new @ r_new)
            if np.isfinite(now) and now < best:
                improved = best - now > 1e-4 * best
                p, r, best, damping = trial, r_new, now, max(damping * 0.2, 1e-9)
                break
            damping *= 10
        if not improved:
            break
    return p, best, first
