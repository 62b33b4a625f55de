"""Sets of effects evaluated by simulated motion, for freely moving bodies.

Without a load cell the accuracy of the force balance is that of the estimated motion, which is poor
near resonance. The displacement simulated with a set from the recorded input has no such error: it
equals the measured one to within the sensor's noise, or the set is wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from threading import Lock

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ComputedMotion, SimulationError
from rthyb_rt.diagnose import gaps, noise, noise_level, whitening
from rthyb_rt.diagnose.case import Case, Floats, Model
from rthyb_rt.diagnose.effects import having, of_number
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.predict import Augmented, changed, parameters, start_of
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem
from rthyb_rt.diagnose.refinement import clustered

RUNS = 4000
"""Largest number of simulations in a diagnosis, plus a few to complete a fit."""
SLOW = 4
"""Equivalent number of simulations if a law is not a single element of the core."""
KEPT = 32
"""Number of cached motions, for effects that only change how a motion is measured."""
STEPS = 6
STEP = 1e-4
LOST = 4
"""Number of gaps of an input in which it is fitted, at most: the longest."""
LITTLE = 0.03
"""Fraction of a rough fit's chi-squared by which a step must improve it."""

Loose = tuple[tuple[str, float, float], ...]
"""Quantities fitted in a simulation in addition to the parameters: see `Body`."""


def judged(case: Case) -> bool:
    """Return whether a recording is of a freely moving body without a load cell."""
    model = case.model
    if model.k_tol is None or model.k == 0.0 or "x_meas" not in case.channels:
        return False
    if model.family == "forced":
        return True
    return model.family == "ground" and "f_meas" not in case.channels and "ag" in case.channels


def shown(case: Case) -> bool:
    """Return whether a recording is of a body on moving ground with a load cell."""
    model = case.model
    if model.family != "ground" or model.k_tol is None or model.k == 0.0:
        return False
    return all(name in case.channels for name in ("x_meas", "f_meas", "ag"))


class Body:
    """A recording's input and the resulting displacement.

    Attributes:
        held: whether the body is attached to a load cell, which has effects of its own.
        largest: number of effects of the largest set that is searched for.
        whole_rig: whether actuator, specimen and load cell are simulated, and nothing else remains.
        linear: whether each linear effect is evaluated before all others.
        threads: number of parallel simulations.
        met: chi-squared per row below which no further effect is searched for.
        rough: chi-squared per row above which a fit need not be the optimum of its kind.
        rows: one for each difference between simulation and recording.
        loose: quantities fitted in addition to the parameters, within what is known of them: names
            of nuisances, or the initial state, and the largest change in one step and in the fit,
            each in its unit.
        units: standard deviation of each of them that has a prior.
        lost: forces, (m, n), N, of which the input is a sum in addition where it was not recorded.
    """

    largest = 2
    linear = True
    whole_rig = False
    threads = 2

    def __init__(self, case: Case, ctx: Context) -> None:
        self.case, self.ctx, self.runs = case, ctx, RUNS
        self.lock = Lock()
        self._moved: deque[tuple[Augmented, tuple[float, ...], ComputedMotion]] = deque(maxlen=KEPT)
        self.met, self.rough = POLICY.motion_met_alone, POLICY.motion_rough
        self.lost = _not_recorded(case)
        self.loose = self._loose()
        self.held = "f_meas" in case.channels and case.model.family == "ground"
        self.x = case.channels["x_meas"]
        self.other = {k: gaps.filled(v) for k, v in case.recorded.items()}
        rows = case.rows & np.isfinite(self.x)
        for name in ("ag", "f_in"):
            if name in case.channels:
                rows &= np.isfinite(case.channels[name])
        self.rows = np.flatnonzero(rows)
        spread = float(np.std(self.x[self.rows])) or 1.0
        noise = noise_level.noise_of(self.x, case.model.x_std)
        self.sigma = float(np.hypot(noise, POLICY.simulators_differ * spread))
        self.spread = spread
        model = case.model
        self.whole = model.whole_mass
        self.units = {"blur": POLICY.mass_blur * self.whole, "skew": POLICY.offset_prior_s}

    def _loose(self) -> Loose:
        reach = POLICY.nuisance_reach
        begun = (("x", 0.4, np.inf), ("v", 0.4, np.inf))
        lost = tuple((f"lost {i}", 0.4, np.inf) for i in range(len(self.lost)))
        return (("blur", 2.0, reach), ("skew", 2.0, reach), *begun, *lost)

    def _push(self, factor: float) -> tuple[Floats, float]:
        """Return the force on the body, and the mass that is not an element."""
        model = self.case.model
        if model.family == "ground":
            return -model.mass * factor * self.other["ag"], model.mass * factor
        return self.other["f_in"], model.moving_mass * (factor - 1.0)

    def first(self, ranked: Sequence[Fit]) -> list[Fit]:
        """Return the sets whose motion is examined before all others, from those of the balance.

        Args:
            ranked: result of the force balance, best first.
        """
        return []

    def plain(self, members: Sequence[Member]) -> bool:
        """Return whether a set may be examined together with those if they explain the motion."""
        return True

    def quick(self, fit: Fit) -> bool:
        """Return whether every effect is one element of the core, and no loop of many springs."""
        return self.in_core(fit) and having(lambda e: e.many_springs).isdisjoint(fit.names)

    def in_core(self, fit: Fit) -> bool:
        """Return whether every effect of the specimen is elements of the core.

        The force of others is known only along a motion that is known already.
        """
        rest = Augmented(
            self.case.model, self.case.model, fit.members, fit.betas, None, self.ctx.all_ranges
        ).elements(self.case.model.mass)[2]
        return all(m.effect.sensor for m, _ in rest)

    def distinct(self, fit: Fit) -> bool:
        """Return whether no effect of the set is another one of it under a different name."""
        return True

    def quiet(self, fit: Fit) -> bool:
        """Return whether the residual of a set's motion is within the data sheet, without bursts.

        As for the force: noise has any colour, and the measured level is that of its white part.
        """
        sheet, x = self.case.model.x_std, np.zeros(self.x.size)
        if not sheet or self.case.model.k_tol is None or self.whole_rig:
            return False
        rows = np.zeros(x.size, dtype=np.bool_)
        rows[self.rows] = True
        x[self.rows] = fit.residual * self.sigma
        if not rows.all():
            x = np.interp(np.arange(x.size), self.rows, x[self.rows])
        own = whitening.likelihood(x, rows, self.ctx.v, self.case.fs_hz, self.sigma, sheet)[1]
        white = fit.residual if own is None else own.whiten(x)[rows]
        wider = sheet * (1.0 + (own.scatter if own is not None else 0.0))
        # No zero of the sensor is fitted: a constant is a body that rests elsewhere.
        return whitening.within_sheet(x[rows], wider, 0.0) and noise.steady(white, self.case.fs_hz)

    def _ends(self, first: Augmented, place: tuple[str, int, int]) -> tuple[float, float]:
        """Return the range of a parameter: for a shape, that of its effect, as logarithms."""
        kind, i, j = place
        if kind != "theta":
            return (-0.98, np.inf)
        member = first.members[i]
        low, high = member.effect.limits(self.ctx, member.trial)[j]
        at = abs(member.trial.theta[j])
        return (min(float(np.log(low / at)), 0.0), max(float(np.log(high / at)), 0.0))

    def motion(self, problem: ResidualProblem, fit: Fit) -> ComputedMotion | None:
        """Return the motion that a set simulates; None unless it equals the measured displacement.

        To within noise, or within the accuracy of friction laws: an estimate is less accurate. The
        load cell's own effects do not move the body and are omitted.
        """
        felt = [i for i, m in enumerate(fit.members) if not m.effect.sensor]
        begun = replace(
            fit,
            members=tuple(fit.members[i] for i in felt),
            betas=tuple(fit.betas[i] for i in felt),
        )
        # A set with a scatter has been fitted to its simulated motion.
        known = fit.scatter is not None and len(felt) == len(fit.members)
        found = fit if known else self.settled(problem, begun)
        if found is None:
            return None
        base = self.case.model
        plain = _with_nuisance(base, problem, found)
        own = Augmented(plain, base, found.members, found.betas, None, self.ctx.all_ranges)
        blur = [b for b, n in zip(found.nuisance, problem.nuisances, strict=True)
                if n.name == "blur"]  # fmt: skip
        push, mass = self._push(float(np.exp(sum(blur) / self.whole)))
        try:
            start = found.start or start_of(own, push, mass, self.case, self.other, self.x)
            push = push + np.array(found.lost) @ self.lost if found.lost else push
            motion = own.moved_by(push, mass, self.case.t, self.other, start)
        except (SimulationError, core.CoreError):
            return None
        rest = (motion.x - self.x)[self.rows] / self.sigma
        left = float(rest @ rest)
        if left < POLICY.motion_met * self.rows.size:
            return motion
        # Chi-squared that was scaled down for correlated rows: more than noise is left, which may
        # be a law that is missing, or friction, whose simulators differ.
        if found.chi2 < left and not any(m.effect.dry for m in found.members):
            return None
        null = self.refined(problem, replace(fit, members=(), betas=()))
        return motion if null is not None and left < POLICY.motion_close * null.chi2 else None

    def sharp(self, fit: Fit) -> Fit | None:
        """Return a set with sharp steps of dry friction and elastic stops; None if it has them."""
        members = tuple(replace(m, trial=m.effect.sharp(m.trial)) for m in fit.members)
        return replace(fit, members=members) if members != fit.members else None

    def _known(self, problem: ResidualProblem, fit: Fit) -> Floats:
        """Return the loose quantities as an earlier fit has left them, in units of their priors.

        Values of mass and time offset from the force balance are not used.
        """
        known: dict[str, float] = {}
        if fit.scatter is not None:
            known = {n.name: float(b) for b, n in zip(fit.nuisance, problem.nuisances, strict=True)}
            known |= {f"lost {i}": q for i, q in enumerate(fit.lost)}
        return np.array(
            [
                np.clip(known.get(name, 0.0) / self.units.get(name, 1.0), -most, most)
                for name, _, most in self.loose
            ]
        )

    def reproduced(self, problem: ResidualProblem, fit: Fit) -> bool:
        """Return whether a set, fitted, simulates the measured displacement to within its noise."""
        found = self.refined(problem, fit)
        return found is not None and found.chi2 < POLICY.motion_met * self.rows.size

    def settled(self, problem: ResidualProblem, fit: Fit) -> Fit | None:
        """Return a set as from `refined`, with or without a width of its dry friction.

        An estimated motion smooths the step, and a simulated body creeps because of its width when
        it sticks: it is simulated without a width first, and with one if that is not sufficient. So
        is a stop without rounding or loss, which an estimated motion shows where there is none. A
        contact that seemed to shear along the estimate is a step as well; one that sheared in a
        simulation, see `motion_fitter.MotionFitter.plain_friction`, continues to do so.
        """
        sharp = self.sharp(fit)
        found = self.refined(problem, sharp) if sharp is not None else None
        if found is not None and found.chi2 < POLICY.motion_met_alone * self.rows.size:
            return found
        estimated = fit.scatter is None and any(m.effect.shears(m.trial) for m in fit.members)
        if found is not None and estimated:
            return found
        rounded = self.refined(problem, fit)
        fits = [f for f in (found, rounded) if f is not None]
        return min(fits, key=lambda f: f.chi2, default=None)

    def start(self, first: Augmented) -> tuple[float, float] | None:
        """Return initial displacement (m) and velocity (m/s) for a set; None: not possible."""
        push, mass = self._push(1.0)
        try:
            return start_of(first, push, mass, self.case, self.other, self.x)
        except (SimulationError, core.CoreError):
            return None

    def _begun(self, at: tuple[float, float], loose: Floats) -> tuple[float, float]:
        """Return the initial state of a motion: the estimate, and loose changes of it."""
        moved = {name: float(q) for (name, _, _), q in zip(self.loose, loose, strict=True)}
        rate = 2.0 * np.pi * self.spread
        return (at[0] + moved.get("x", 0.0) * self.spread, at[1] + moved.get("v", 0.0) * rate)

    def differences(self, now: Augmented, loose: Floats, at: tuple[float, float]) -> Floats:
        """Return recording less simulation in units of the noise, one for each of the rows."""
        start, lost = self._begun(at, loose), loose[loose.size - len(self.lost) :]
        key = (float(loose[0]), *start, *lost)
        motion = next((m for n, k, m in list(self._moved) if n is now and k == key), None)
        if motion is None:
            push, mass = self._push(float(np.exp(POLICY.mass_blur * loose[0])))
            motion = now.moved_by(push + lost @ self.lost, mass, self.case.t, self.other, start)
            # A time shift does not change the motion: its slope needs no further simulation.
            self._moved.append((now, key, motion))
        x = motion.x - loose[1] * POLICY.offset_prior_s * motion.v
        return np.asarray((x - self.x)[self.rows] / self.sigma)

    def refined(self, problem: ResidualProblem, fit: Fit) -> Fit | None:
        """Fit a set's parameters to its simulated motion; None if it cannot be simulated.

        Stiffness, damping and the loose quantities are fitted as well, within what is known of
        them. Chi-squared and residual are those of the simulation.
        """
        base = self.case.model
        fit = _as_effects(problem, fit)
        plain = _with_nuisance(base, problem, fit)
        first = Augmented(plain, base, fit.members, fit.betas, None, self.ctx.all_ranges)
        places = [p for p in parameters(first) if p[0] != "m"]
        count = len(places)
        start = fit.start or self.start(first)
        if start is None or self.runs <= 0:
            return None
        cost = 1 if self.quick(fit) else SLOW

        models: dict[bytes, Augmented] = {}

        def residual(p: Floats) -> Floats:
            own = p[:count].tobytes()
            with self.lock:
                now = models.get(own)
                if now is None:
                    now = models[own] = changed(first, places, _logs(places, p))
            prior = self._priors(places, plain, p)
            return np.asarray(np.r_[self.differences(now, p[count:], start), prior])

        def spend(runs: int) -> None:
            self.runs -= runs * cost

        try:
            shapes = [kind == "theta" for kind, _, _ in places]
            reach = np.r_[np.where(shapes, 0.4, 2.0), [step for _, step, _ in self.loose]]
            ends = np.array([self._ends(first, place) for place in places]).reshape(-1, 2)
            loose = [[-most, most] for _, _, most in self.loose]
            linear = {m.name for m in fit.members} & {n.name for n in problem.nuisances}
            p, r, gram, slopes = _least(
                residual, np.r_[np.zeros(count), self._known(problem, fit)],
                reach, np.vstack((ends, loose)), bool(linear) or not any(shapes),
                self.rough * self.rows.size, spend, self.threads,
            )  # fmt: skip
        except (SimulationError, core.CoreError, np.linalg.LinAlgError):
            return None
        best = changed(first, places, _logs(places, p))
        pairs = zip(best.members, best.betas, strict=True)
        if not all(m.effect.sensible(self.ctx, m.trial, b) for m, b in pairs):
            return None
        nuisance = self._nuisance(problem, best.model, p[count:])
        inverse = _inverse(gram)
        n = self.rows.size
        scatter = clustered(slopes[:n], r[:n], inverse)
        found = Fit(
            best.members, best.betas, float(r @ r), fit.count, nuisance, r[:n],
            _covariance(first, places, inverse, nuisance.size),
            _covariance(first, places, scatter, nuisance.size), self._begun(start, p[count:]),
            tuple(map(float, p[p.size - len(self.lost) :])),
        )  # fmt: skip
        return _as_effects(problem, found)

    def _priors(
        self, places: Sequence[tuple[str, int, int]], begun: Model, p: Floats
    ) -> list[float]:
        """Return the deviation of loose quantities and stated values in units of their priors.

        Args:
            places: the parameters of a set.
            begun: the initial model of the fit.
            p: changes of the parameters, then the loose quantities.
        """
        base = self.case.model
        held = {"k": (base.k, begun.k, base.k_tol), "c": (base.c, begun.c, base.c_tol)}
        stated = [j for j, (name, _, _) in enumerate(self.loose) if name in self.units]
        prior = [float(p[len(places) + j]) for j in stated]
        for j, (kind, _, _) in enumerate(places):
            if kind in held:
                known, at, tolerance = held[kind]
                if tolerance:
                    prior.append((at / known * (1.0 + float(p[j])) - 1.0) / tolerance)
        return prior

    def _nuisance(self, problem: ResidualProblem, best: Model, loose: Floats) -> Floats:
        """Return the nuisance parameters for a model and loose quantities in prior units."""
        base = self.case.model
        moved = {of_number("k"): best.k / base.k - 1.0, of_number("c"): best.c - base.c}
        for (name, _, _), q in zip(self.loose, loose, strict=True):
            moved[name] = float(q) * self.units.get(name, 1.0)
        return np.array([moved.get(n.name, 0.0) for n in problem.nuisances])


def _not_recorded(case: Case) -> Floats:
    """Return forces with which an input that has long gaps may be complemented, (m, n), N.

    A constant and a slope in each of the longest gaps: together, any change of displacement and
    velocity at its end. Each is as large as the input.
    """
    name = "ag" if case.model.family == "ground" else "f_in"
    given = case.channels.get(name)
    if given is None:
        return np.zeros((0, case.t.size))
    size = float(np.nanstd(given)) * (case.model.mass if name == "ag" else 1.0)
    long = sorted(gaps.long_gaps(given), key=lambda g: g[0] - g[1])[:LOST]
    out = np.zeros((2 * len(long), case.t.size))
    for i, (a, b) in enumerate(sorted(long)):
        out[2 * i, a:b] = size
        out[2 * i + 1, a:b] = size * np.linspace(-1.0, 1.0, b - a)
    return out


def _as_effects(problem: ResidualProblem, fit: Fit) -> Fit:
    """Return a set whose linear effects include the changes of the corresponding stated values.

    The motion is the same; an unchanged stated value has no cost.
    """
    betas, nuisance, chi2 = list(fit.betas), fit.nuisance.copy(), fit.chi2
    names = [m.name for m in fit.members]
    for j, n in enumerate(problem.nuisances):
        if n.sigma is not None and n.name in names and n.number in ("k", "c"):
            i = names.index(n.name)
            betas[i] = betas[i] + nuisance[j]
            chi2 -= (float(nuisance[j]) / n.sigma) ** 2
            nuisance[j] = 0.0
    return replace(fit, betas=tuple(betas), nuisance=nuisance, chi2=chi2)


def _with_nuisance(model: Model, problem: ResidualProblem, fit: Fit) -> Model:
    for b, nuisance in zip(fit.nuisance, problem.nuisances, strict=True):
        # A nuisance mass is not a stated value, and a dashpot that pushes makes the motion diverge.
        if nuisance.number == "k" or (nuisance.number == "c" and model.c + float(b) > 0.0):
            model = nuisance.moves(model, float(b))
    return model


def _least(
    residual: Callable[[Floats], Floats],
    begun: Floats,
    reach: Floats,
    ends: Floats,
    central: bool,
    rough: float,
    spend: Callable[[int], None],
    threads: int,
) -> tuple[Floats, Floats, Floats, Floats]:
    """Return parameters, residual, normal matrix and slopes of least squares from a start.

    A step is limited to ``reach``, (n,), a parameter to its ``ends``, (n, 2). Slopes are
    ``central`` if priors decide: at resonance, and along the valley of a value and the effect that
    changes it, one-sided slopes are too inaccurate. Above a chi-squared of ``rough`` this is not
    needed: such a fit need only be distinguished from better ones. ``spend`` receives the number of
    residuals computed, in the same order for any number of ``threads``.
    """
    size, p = reach.size, begun

    spend(1)
    r = residual(p)
    low, high = ends.T
    # What only its prior determines is weak compared with the rest: heavy damping would freeze it.
    best, damping = float(r @ r), 1e-8
    if not np.isfinite(best):
        raise SimulationError("the motion diverged")
    gram, jacobian = np.eye(size), np.zeros((r.size, size))
    for _ in range(STEPS):
        columns = _slopes(residual, p, r, central and best < rough, spend, threads)
        if columns is None:
            break
        jacobian = np.column_stack(columns)
        gram = jacobian.T @ jacobian
        right = -jacobian.T @ r
        gain = 0.0
        for _ in range(7):
            step = np.linalg.solve(gram + damping * np.diag(gram.diagonal() + 1e-12), right)
            trial = np.clip(p + np.clip(step, -reach, reach), low, high)
            spend(1)
            new = _simulated(residual, trial)
            now = float(new @ new) if new is not None else np.inf
            if new is not None and np.isfinite(now) and now < best:
                gain, p, r, best = best - now, trial, new, now
                damping = max(damping * 0.1, 1e-10)
                break
            damping *= 30.0
        if gain < (1e-6 if best < rough else LITTLE) * best + 0.05:
            break
    return p, r, gram, jacobian


def _slopes(
    residual: Callable[[Floats], Floats],
    p: Floats,
    r: Floats,
    central: bool,
    spend: Callable[[int], None],
    threads: int,
) -> list[Floats] | None:
    """Return the slope to each parameter; None if one cannot be simulated. See `_least`."""

    def slope(e: Floats) -> tuple[int, Floats | None]:
        ahead = _simulated(residual, p + e)
        if ahead is None or not central:
            return 1, None if ahead is None else (ahead - r) / STEP
        behind = _simulated(residual, p - e)
        return 2, None if behind is None else (ahead - behind) / (2.0 * STEP)

    found = []
    with ThreadPoolExecutor(threads) as pool:
        for runs, own in pool.map(slope, STEP * np.eye(p.size)):
            spend(runs)
            if own is None:
                return None
            found.append(own)
    return found


def _simulated(residual: Callable[[Floats], Floats], p: Floats) -> Floats | None:
    try:
        return residual(p)
    except (SimulationError, core.CoreError):
        return None


def _logs(places: Sequence[tuple[str, int, int]], p: Floats) -> Floats:
    """Return the logarithms of the factors of each place.

    Coefficients change linearly: if two of them are equivalent, like stiffness and mass under a
    sine, the valley between them is then straight.
    """
    factors = np.log(np.maximum(1.0 + p[: len(places)], 1e-3))
    shapes = np.array([kind == "theta" for kind, _, _ in places], dtype=np.bool_)
    return np.asarray(np.where(shapes, p[: len(places)], factors))


def _inverse(gram: Floats) -> Floats:
    scale = np.sqrt(np.maximum(gram.diagonal(), 1e-300))
    inverse = np.linalg.pinv(gram / np.outer(scale, scale), rcond=1e-12, hermitian=True)
    return np.asarray(inverse / np.outer(scale, scale))


def _covariance(
    first: Augmented, places: Sequence[tuple[str, int, int]], inverse: Floats, nuisances: int
) -> Floats:
    """Return the covariance of (log shapes, coefficients, nuisance) as in `problem.Fit`."""
    shapes = [len(m.trial.theta) for m in first.members]
    widths = [len(b) for b in first.betas]
    rows, factors, at = [], [], []
    for row, (kind, i, j) in enumerate(places):
        if kind == "theta":
            at.append(sum(shapes[:i]) + j)
            factors.append(1.0)
        elif kind == "beta":
            at.append(sum(shapes) + sum(widths[:i]) + j)
            factors.append(float(first.betas[i][j]))
        else:
            continue
        rows.append(row)
    size = sum(shapes) + sum(widths) + nuisances
    out = np.zeros((size, size))
    if rows:
        part = inverse[np.ix_(rows, rows)] * np.outer(factors, factors)
        out[np.ix_(at, at)] = part
    return out
