"""The displacement channel: how the actuator differs from its model, x_cmd to x_meas."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from rthyb_rt.core.diagnosis_models import ActuatorModel, ComputedMotion, SimulationError, actuator
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Param
from rthyb_rt.diagnose.estimate import GAP_S
from rthyb_rt.diagnose.form import gain_of_form, neighbours, of_form
from rthyb_rt.diagnose.gaps import away_from_gaps, filled
from rthyb_rt.diagnose.noise import TRIED
from rthyb_rt.diagnose.noise_level import noise_of
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import penalty
from rthyb_rt.diagnose.refinement import clustered, inflation
from rthyb_rt.diagnose.whitening import Whitener, likeliest


@dataclass(frozen=True)
class ActuatorEffect:
    """One or two parameters of the actuator's model that may be wrong.

    Attributes:
        plain, phrase: common name, and the same with its size; see `effects.Effect`.
        log: its parameters are positive, and fitted by their logarithms.
        late: it begins in mid-recording; until then the model is right.
        limit: it has no effect, and no slope, until it is reached.
        in_rig_file: a rig file's actuator can represent it.
        exact: its law has no other form: a constant delay, a gain, a second-order lag.
    """

    name: str
    params: tuple[Param, ...]
    fields: tuple[str, ...]
    equation: str
    fingerprint: str
    shown_by: tuple[str, str]
    plain: str
    phrase: str
    log: bool = True
    late: bool = False
    limit: bool = False
    in_rig_file: bool = True
    exact: bool = False

    def acts(self, model: ActuatorModel) -> bool:
        """Return whether a model, in which 0 means absent, has it."""
        return any(getattr(model, name) != 0.0 for name in self.fields)

    @property
    def count(self) -> int:
        """Number of fitted parameters, including an onset."""
        return len(self.fields) + int(self.late)

    def starts(self, base: ActuatorModel, v_max: float) -> list[tuple[dict[str, Any], Floats]]:
        """Return settings of the variants and the initial values of each."""
        if self.name == "delay":
            return [({}, np.array([base.delay_s]))]
        if self.name == "act_gain":
            return [({}, np.array([base.gain]))]
        if self.name == "oil_column":
            return [
                ({}, np.array([base.f_hz * r, base.zeta * z]))
                for r, z in ((1.0, 1.0), (0.6, 1.0), (0.5, 3.0), (1.6, 1.0))
            ]
        if self.name == "delay_rate":
            # The command late, before the lag, or the motion, after it.
            of = ("actuator", "command", "motion")
            return [({"kappa_of": w}, np.array([0.0])) for w in of]
        return [
            ({"vmax_of": w}, np.array([v_max * r]))
            for w in ("command", "actuator")
            for r in (0.9, 0.6, 0.35)
        ]

    def report(self, base: ActuatorModel, values: Sequence[float]) -> dict[str, float]:
        """Return the parameters by name."""
        if self.name == "delay":
            return {"dtau_s": values[0] - base.delay_s}
        return dict(zip((p.name for p in self.params), map(float, values), strict=True))


CATALOGUE: tuple[ActuatorEffect, ...] = (
    ActuatorEffect(
        "delay", (Param("dtau_s", "s", -1.0, 1.0),), ("delay_s",), "x(t) = x0(t - dtau)",
        "displacement residual is linear in velocity",
        ("sweep", "the phase of a delay grows with frequency at constant amplitude"),
        "a delay of the actuator", "{dtau_s} {dtau_s:less|more} delay of the actuator", False,
        exact=True,
    ),
    ActuatorEffect(
        "delay_rate", (Param("kappa_s2_m", "s^2/m", -10.0, 10.0),), ("kappa_s2_m",),
        "delay + kappa |v|", "displacement residual grows with the square of velocity",
        ("multi_amplitude", "a delay that grows with velocity differs between amplitudes"),
        "a delay that grows with velocity", "a delay that grows with velocity by {kappa_s2_m}",
        False, in_rig_file=False,
    ),
    ActuatorEffect(
        "act_gain", (Param("gain", "", 0.01, 100.0),), ("gain",), "x = gain x0",
        "displacement residual is linear in displacement",
        ("sweep", "a gain is the same at every frequency"),
        "a gain error of the actuator", "an actuator that moves {gain:4} times as far", exact=True,
    ),
    ActuatorEffect(
        "oil_column", (Param("f_Hz", "Hz", 0.1, 1e5), Param("zeta", "", 1e-3, 1e3)),
        ("f_hz", "zeta"), "x'' + 2 zeta w x' + w^2 x = w^2 u",
        "displacement residual grows with acceleration as well as velocity",
        ("sweep", "the corner of a second-order lag shows as the frequency passes it"),
        "another second-order lag of the actuator",
        "an actuator with {f_Hz} and a damping ratio of {zeta:3}", exact=True,
    ),
    ActuatorEffect(
        "rate_limit", (Param("vmax_m_s", "m/s", 1e-6, 100.0),), ("vmax_m_s",), "|v| <= vmax",
        "displacement lags only where velocity is large",
        ("multi_amplitude", "a velocity limit is reached only at large amplitude"),
        "a velocity limit of the actuator", "an actuator limited to {vmax_m_s}",
        limit=True, in_rig_file=False,
    ),
)  # fmt: skip

LONG_ROWS = 100_000
"""Number of rows from which the effects are fitted on two cores in parallel."""
START_S = 0.01
"""Time from the start in which a displacement is judged to be at rest or moving."""
MASK_S = 0.4
STEPS = 12
UNDAMPED = 1e-9
"""Relative to the diagonal of the normal matrix: size of its rounding errors."""
NEAR = 4.0
"""Misfit, in noise power, up to which a fit may be the answer with coloured noise."""
ZEROS = 10
"""Number of parts of a recording whose displacement may have separate zeros."""
ROW = "row"
"""Name of the field for the onset of an effect."""
LAGS = {"delay", "oil_column"}
"""Effects whose lags a slow motion cannot distinguish."""
TRADES = (1.4, 2.0, 2.8, 4.0)
"""Initial factors of an oil column's frequency together with a delay."""


Before = tuple[float, ActuatorModel] | None
"""The actuator before a row at which it changes in mid-recording."""


@dataclass
class ActuatorFit:
    """Effects of the actuator fitted to the displacement.

    Attributes:
        model: the actuator at the end of the recording.
        before: the actuator up to a row, if an effect begins there.
        covariance: of the parameters and the time offset, from noise alone, (p, p).
        scatter: the same from the residual itself, see `refinement.clustered`.
        slopes: of the whitened rows to the parameters and the time offset, (rows, p).
        motion: the simulated motion, relative to the zero of the displacement sensor.
        zero_m: difference of that zero from the zero of the command, mean of the rows.
        others: the same effects in another form, or from another local minimum.
    """

    effects: tuple[ActuatorEffect, ...]
    model: ActuatorModel
    values: tuple[tuple[float, ...], ...]
    chi2: float
    count: int
    residual: Floats
    covariance: Floats
    scatter: Floats
    slopes: Floats
    motion: ComputedMotion
    zero_m: float = 0.0
    before: Before = None
    others: tuple[ActuatorFit, ...] = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Sorted names."""
        return tuple(sorted(e.name for e in self.effects))

    def misfit(self, scale: float) -> float:
        """Return chi-squared, with the rows' part scaled down but not that of the prior."""
        prior = (self.model.shift_s / POLICY.offset_prior_s) ** 2
        return (self.chi2 - prior) / scale + prior

    def known(self, scale: float) -> Floats:
        """Return the covariance of the parameters, (p, p): from noise, or its scatter if larger.

        Args:
            scale: factor by which evidence is scaled down.
        """
        noise, shown = scale * self.covariance, self.scatter.diagonal()
        wider = np.sqrt(np.maximum(shown / np.maximum(noise.diagonal(), 1e-300), 1.0))
        return np.asarray(noise * np.outer(wider, wider))


def from_rest(case: Case) -> bool:
    """Return whether a recording begins at rest: otherwise its first rows follow earlier commands.

    A command at its zero may be passing through it: then the displacement moves, with more than a
    fraction of its largest velocity in the first hundredth of a second.
    """
    u = filled(case.channels["x_cmd"])
    if not abs(u[0]) < POLICY.command_at_rest * (float(np.max(np.abs(u))) or 1.0):
        return False
    x_meas = case.channels.get("x_meas")
    if x_meas is None:
        return True
    head = max(int(START_S * case.fs_hz), 4)
    t, x = np.arange(head) / case.fs_hz, filled(x_meas)
    sigma = noise_of(x_meas, case.model.x_std) / (float(np.std(t)) * head**0.5)
    slope = float(np.polyfit(t, x[:head], 1)[0])
    largest = float(np.max(np.abs(np.gradient(u)))) * case.fs_hz
    return bool(abs(slope) < POLICY.moving_at_start * largest + 3.0 * sigma)


def settled(case: Case) -> int:
    """Return the first row that is not affected by an unknown initial state."""
    return 0 if from_rest(case) else int(MASK_S * case.fs_hz)


class Actuation:
    """The recorded command and displacement, and the actuator's model between them."""

    def __init__(self, case: Case, base: ActuatorModel) -> None:
        self.case, self.base = case, base
        self.u = filled(case.channels["x_cmd"])
        x = case.channels["x_meas"]
        self.sigma = noise_of(x, case.model.x_std)
        self.own: Whitener | None = None
        rows = case.rows & np.isfinite(x) & np.isfinite(case.channels["x_cmd"])
        self.first = settled(case)
        rows[: self.first] = False
        rows &= away_from_gaps(case.channels["x_cmd"], case.fs_hz, 0.01, GAP_S)
        self.rows = np.flatnonzero(rows)
        self.x = filled(x)
        self.v_max = float(np.max(np.abs(self.simulate(base).v))) or 1e-6
        self.ln_n = float(np.log(max(self.rows.size, 2)))

    def simulate(self, model: ActuatorModel, before: Before = None) -> ComputedMotion:
        """Return the motion of a model, with another model up to a row, along the command."""
        return actuator(model, self.u, self.case.fs_hz, before)

    def residual(
        self, model: ActuatorModel, before: Before = None
    ) -> tuple[Floats, ComputedMotion, float]:
        """Return the residual of a model less its mean: command and sensor have separate zeros.

        A lag, a gain or a velocity limit does not change the mean; the zero of the sensor or of a
        servo valve does, and would bias them.
        """
        motion = self.simulate(model, before)
        off = (self.x - motion.x)[self.rows]
        zero = float(np.mean(off))
        motion = motion.from_zero(zero)
        white = (off - zero) / self.sigma
        if self.own is not None:
            white = self.own.whiten(self._between(self.x - motion.x))[self.rows]
        return white, motion, zero

    def _between(self, off: Floats) -> Floats:
        """Return a residual with a straight line over rows that are not evaluated, (n,)."""
        return np.interp(np.arange(off.size), self.rows, off[self.rows])

    def left(self, fit: ActuatorFit) -> Floats:
        """Return a fit's residual in the displacement, (n,), m; a line between evaluated rows."""
        return self._between(self.x - fit.motion.x)

    def fit_noise(self, fits: Sequence[ActuatorFit]) -> bool:
        """Set the noise to that left by the likeliest of some fits; return whether it is coloured.

        As for the force, see `noise`.
        """
        judged = np.zeros(self.x.size, dtype=np.bool_)
        judged[self.rows] = True

        tried = [(self.left(f), f.motion.v, self.price(f)) for f in fits]
        sheet = self.case.model.x_std
        self.own = likeliest(tried, judged, self.case.fs_hz, self.sigma, sheet)
        return self.own is not None

    def fit(
        self,
        effects: Sequence[ActuatorEffect],
        starts: Sequence[tuple[dict[str, Any], Floats]] | None = None,
        row: float = 0.0,
    ) -> ActuatorFit | None:
        """Fit the parameters of some effects and the time offset between the channels.

        ``starts`` are settings of variants with the parameters' initial values; default: those of
        the single effect. Effects with an onset begin within a few rows of ``row``.
        """
        if starts is None:
            starts = effects[0].starts(self.base, self.v_max) if effects else [({}, np.zeros(0))]

        def first(start: tuple[dict[str, Any], Floats]) -> float:
            settings, values = start
            try:
                r = self.residual(*self.models(effects, settings, values, 0.0, row))[0]
            except SimulationError:
                return np.inf
            return float(r @ r)

        if len(starts) > 2:
            # The most promising ones of each variant.
            starts = sorted(starts, key=first)[:3]
        fits = [self._from(effects, settings, start, row) for settings, start in starts]
        good = sorted((f for f in fits if f is not None), key=lambda f: f.chi2)
        return replace(good[0], others=tuple(good[1:])) if good else None

    def models(
        self,
        effects: Sequence[ActuatorEffect],
        settings: dict[str, Any],
        values: Sequence[float] | Floats,
        shift_s: float,
        row: float,
    ) -> tuple[ActuatorModel, Before]:
        """Return the actuator with the effects' values, and the one before an onset."""
        always: dict[str, Any] = {}
        later: dict[str, Any] = {}
        given = iter(values)
        for effect in effects:
            for name in effect.fields:
                (later if effect.late else always)[name] = float(next(given))
        first = replace(self.base, **settings, **always, shift_s=shift_s)
        return replace(first, **later), (row, first) if later else None

    def _from(
        self, effects: Sequence[ActuatorEffect], settings: dict[str, Any], start: Floats, row: float
    ) -> ActuatorFit | None:
        unknown = _ScaledParameters(self, effects, settings, row)
        found = unknown.least(unknown.first(start))
        if found is None:
            return None
        p, chi2, jacobian = found
        best, before = unknown.model(p)
        values = tuple(tuple(float(getattr(best, f)) for f in e.fields) for e in effects)
        inverse = np.asarray(np.linalg.pinv(jacobian.T @ jacobian, hermitian=True))
        chain = unknown.chain(best)
        units = np.outer(chain, chain)
        whole, motion, zero = self.residual(best, before)
        slopes = jacobian[: whole.size]
        scatter = clustered(slopes, whole, inverse)
        return ActuatorFit(
            tuple(effects), best, values, chi2, sum(e.count for e in effects), whole,
            inverse * units, scatter * units, slopes / chain, motion, zero, before,
        )  # fmt: skip

    def around(
        self, fit: ActuatorFit, scale: float, motion: ComputedMotion
    ) -> list[ComputedMotion]:
        """Return motions for parameters one standard deviation away from a fit, each (n,).

        As many independent ones as there are parameters; none if the motion is not that of the fit,
        except for its time.

        Args:
            fit: the actuator.
            scale: factor by which evidence is scaled down.
            motion: motion along which the force was evaluated.
        """
        v = fit.motion.v
        late = -float((motion.x - fit.motion.x) @ v) / max(float(v @ v), 1e-300)
        known = fit.known(scale) + self.of_form(fit)
        size = np.sqrt(np.maximum(known.diagonal(), 1e-300))
        power, ways = np.linalg.eigh(known / np.outer(size, size))
        settings = {"kappa_of": fit.model.kappa_of, "vmax_of": fit.model.vmax_of}
        values = np.array([v for own in fit.values for v in own])
        out = []
        for p, way in zip(power, ways.T, strict=True):
            step = size * way * float(np.sqrt(max(p, 0.0)))
            row = (fit.before[0] + step[values.size]) if fit.before else 0.0
            moved = values + step[: values.size], fit.model.shift_s + late + float(step[-1])
            try:
                out.append(self.residual(*self.models(fit.effects, settings, *moved, row))[1])
            except SimulationError:
                continue
        return out

    def of_form(self, fit: ActuatorFit) -> Floats:
        """Return the covariance of a fit's parameters due to its effects' forms, (p, p)."""
        out = np.zeros_like(fit.covariance)
        for near in self._near(fit):
            out += of_form(fit.slopes, fit.residual, fit.covariance, near)
        return out

    def by_form(self, fit: ActuatorFit) -> float:
        """Return the reduction of chi-squared if the effects of a fit may take any smooth form."""
        near = self._near(fit)
        return gain_of_form(fit.slopes, fit.residual, fit.covariance, near) if near else 0.0

    def _near(self, fit: ActuatorFit) -> list[Floats]:
        """Return the whitened neighbours of what each effect of a fit moves, each (rows, q)."""
        reach = [float(np.max(np.abs(s))) or 1.0 for s in (fit.motion.x, fit.motion.v)]
        over = list(zip((fit.motion.x, fit.motion.v), reach, strict=True))
        out = []
        for effect in fit.effects:
            less: dict[str, Any] = {f: getattr(self.base, f) for f in effect.fields}
            without = self.simulate(replace(fit.model, **less)).x
            made = fit.motion.x - fit.zero_m - without
            out.append(np.column_stack([self._seen(n) for n in neighbours(made, over)]))
        return out

    def _seen(self, moved: Floats) -> Floats:
        """Return a displacement, (n,), m, as it enters the residual: whitened, (rows,)."""
        own = moved[self.rows] - float(np.mean(moved[self.rows]))
        if self.own is None:
            return np.asarray(own / self.sigma)
        return self.own.whiten(self._between(moved))[self.rows]

    def late_zero(self, fit: ActuatorFit) -> float:
        """Return the zero at the end of the recording, m: that of the mean if it does not drift.

        It drifts if the mean of a tenth of the recording predicts that of the next one better than
        the overall mean does (von Neumann's ratio below one; 2 for independent tenths).
        """
        off = self.left(fit)[self.rows]
        parts = np.array([float(np.mean(p)) for p in np.array_split(off, ZEROS)])
        if off.size < 10 * ZEROS or np.sum(np.diff(parts) ** 2) > np.sum(parts**2):
            return fit.zero_m
        return fit.zero_m + float(parts[-1])

    def price(self, fit: ActuatorFit) -> float:
        """Return what a fit must earn."""
        return sum(self.price_of(e) for e in fit.effects)

    def price_of(self, effect: ActuatorEffect) -> float:
        """Return what one effect must earn."""
        return penalty(self.ln_n, effect.count)


class _ScaledParameters:
    """The parameters of some effects, scaled for least squares; the last one is the time offset."""

    def __init__(
        self, task: Actuation, effects: Sequence[ActuatorEffect], settings: dict[str, Any],
        row: float,
    ) -> None:  # fmt: skip
        self.task, self.effects, self.settings, self.row = task, effects, settings, row
        self.fields = [f for e in effects for f in e.fields]
        self.logs = [e.log for e in effects for _ in e.fields]
        # A heavily damped lag approaches a first-order lag without limit.
        limits = [(np.log(q.low), np.log(q.high)) if e.log else (-np.inf, np.inf)
                  for e in effects for q in e.params]  # fmt: skip
        if any(e.late for e in effects):  # the onset, in rows, is fitted as well
            self.fields, self.logs = [*self.fields, ROW], [*self.logs, False]
            limits.append((-np.inf, np.inf))
        own_scales = {"delay_s": 1e-3, "kappa_s2_m": 1e-2}
        self.scales = np.array([own_scales.get(f, 1.0) for f in self.fields] + [1e-5])
        most = POLICY.offset_reach_s
        self.low, self.high = np.array([*limits, (-most, most)]).T / self.scales

    def first(self, start: Floats) -> Floats:
        """Return the scaled parameters of a start, without time offset."""
        if ROW in self.fields:
            start = np.r_[start, self.row]
        own = [np.log(v) if log else v for v, log in zip(start, self.logs, strict=True)]
        return np.asarray(np.r_[own, 0.0] / self.scales)

    def model(self, p: Floats) -> tuple[ActuatorModel, Before]:
        """Return the actuator for scaled parameters, and the one before an onset."""
        values = [
            float(np.exp(q * s)) if log else float(q * s)
            for q, s, log in zip(p[:-1], self.scales[:-1], self.logs, strict=True)
        ]
        at = values.pop() if ROW in self.fields else 0.0
        shift_s = float(p[-1] * self.scales[-1])
        return self.task.models(self.effects, self.settings, values, shift_s, at)

    def residual(self, p: Floats) -> Floats:
        """Return the residual of the displacement; one more row has the time offset's prior."""
        r = self.task.residual(*self.model(p))[0]
        return np.asarray(np.r_[r, p[-1] * self.scales[-1] / POLICY.offset_prior_s])

    def chain(self, best: ActuatorModel) -> Floats:
        """Return the derivative of each parameter with respect to the scaled one."""
        own = [
            s * (float(getattr(best, f)) if log else 1.0)
            for f, s, log in zip(self.fields, self.scales, self.logs, strict=False)
        ]
        return np.array([*own, self.scales[-1]])

    def least(self, p: Floats) -> tuple[Floats, float, Floats] | None:
        """Return least-squares parameters, chi-squared and slopes; None if the simulation fails."""
        try:
            r = self.residual(p)
        except SimulationError:
            return None
        chi2, damping = float(r @ r), 1e-3
        reach = 1.0 / self.scales.clip(1e-3)
        jacobian = np.zeros((r.size, p.size))
        for _ in range(STEPS):
            self._slopes(p, r, jacobian)
            gram, right = jacobian.T @ jacobian, -jacobian.T @ r
            better = False
            gain = 0.0
            for _ in range(5):
                damped = gram + np.diag(damping * gram.diagonal() + 1e-9)
                step = np.linalg.solve(damped, right)
                last = float(np.clip(p[-1] + step[-1], self.low[-1], self.high[-1]) - p[-1])
                if last != step[-1]:
                    # The others move to their optimum with it at its limit: the trade-off between a
                    # delay or a slower column and a time offset is many times the noise.
                    step = np.r_[
                        np.linalg.solve(damped[:-1, :-1], right[:-1] - last * damped[:-1, -1]), last
                    ]
                moved = np.clip(p + np.clip(step, -reach, reach), self.low, self.high)
                try:
                    trial = self.residual(moved)
                except SimulationError:
                    damping *= 10.0
                    continue
                now = float(trial @ trial)
                if now < chi2:
                    gain, chi2, p, r = chi2 - now, now, moved, trial
                    damping, better = max(damping * 0.2, 1e-9), True
                    break
                damping *= 10.0
            if better and gain >= 1e-5 * chi2 + 0.02:
                continue
            # Damping slows progress along a valley, so the gain looks negligible: a fit that may be
            # the answer has converged only if it also has without damping.
            if damping <= UNDAMPED or chi2 > NEAR * r.size:
                break
            damping = UNDAMPED
        return p, chi2, jacobian

    def _slopes(self, p: Floats, r: Floats, jacobian: Floats) -> None:
        """Fill in the slopes of the residual to each parameter, (rows, parameters)."""
        for j in range(p.size):
            step = 1e-3 if j < p.size - 1 else 1e-1
            moved = p.copy()
            moved[j] += step
            try:
                jacobian[:, j] = (self.residual(moved) - r) / step
            except SimulationError:
                jacobian[:, j] = 0.0


def _warm(
    task: Actuation, group: Sequence[ActuatorEffect], known: dict[str, ActuatorFit]
) -> list[tuple[dict[str, Any], Floats]]:
    """Return starts of a group from the fits of its members, with the others inactive."""
    starts = []
    for lead in group:
        fit = known.get(lead.name)
        if fit is None:
            continue
        settings: dict[str, Any] = {}
        values: list[float] = []
        for effect in group:
            own = known.get(effect.name)
            if own is None:
                return []
            variants: dict[str, dict[str, Any]] = {
                "delay_rate": {"kappa_of": own.model.kappa_of},
                "rate_limit": {"vmax_of": own.model.vmax_of},
            }
            settings |= variants.get(effect.name, {})
            if effect is lead:
                values += [float(getattr(fit.model, f)) for f in effect.fields]
            elif effect.limit:
                values.append(task.v_max)
            else:
                values += [float(getattr(task.base, f)) for f in effect.fields]
        starts.append((settings, np.array(values)))
    names = [e.name for e in group]
    if set(names) >= LAGS and starts:
        starts += _traded(known["oil_column"].model, group, *starts[names.index("oil_column")])
    return starts


def _parts(task: Actuation, fit: ActuatorFit) -> list[ActuatorFit]:
    """Return the sets without one effect, fitted again from the optimum of the whole set.

    A lag started far from its optimum may have ended in another local minimum.
    """
    found = []
    for gone in fit.effects if len(fit.effects) > 1 else ():
        rest = tuple(e for e in fit.effects if e is not gone)
        settings = {"kappa_of": fit.model.kappa_of, "vmax_of": fit.model.vmax_of}
        values = [float(getattr(fit.model, f)) for e in rest for f in e.fields]
        row = fit.before[0] if fit.before else 0.0
        found.append(task.fit(rest, [(settings, np.array(values))], row))
    return [f for f in found if f is not None]


def _traded(
    slow: ActuatorModel, group: Sequence[ActuatorEffect], settings: dict[str, Any], values: Floats
) -> list[tuple[dict[str, Any], Floats]]:
    """Return starts in which a stiffer column lags less and a delay compensates for it.

    Slow motion depends only on their sum, delay + 2 zeta / omega: the valley is long and curved.
    """
    starts = []
    for factor in TRADES:
        f_hz = factor * slow.f_hz
        delay_s = slow.delay_s + slow.zeta / (np.pi * slow.f_hz) - slow.zeta / (np.pi * f_hz)
        fields = {"delay_s": delay_s, "f_hz": f_hz}
        names = [f for e in group for f in e.fields]
        own = [fields.get(name, v) for name, v in zip(names, values, strict=True)]
        starts.append((settings, np.array(own)))
    return starts


def search(task: Actuation) -> tuple[ActuatorFit, list[ActuatorFit], float]:
    """Fit nothing, every effect, and pairs and triples as far as necessary.

    Returns the fit of nothing, all others best first, and the factor that scales evidence.
    """
    found = _search(task)
    return _search(task) if task.fit_noise([found[0], *found[1][:TRIED]]) else found


def _search(task: Actuation) -> tuple[ActuatorFit, list[ActuatorFit], float]:
    """Fit nothing, every effect, and pairs and triples, with the present estimate of the noise."""
    from rthyb_rt.diagnose import actuator_onset

    null = task.fit(())
    if null is None:
        raise SimulationError("the model's own actuator cannot be simulated along this command")
    if task.x.size > LONG_ROWS:
        # Long recordings spend most time here, in the core, which lets other threads run.
        with ThreadPoolExecutor(2) as pool:
            singles = list(pool.map(lambda e: task.fit((e,)), CATALOGUE))
    else:
        singles = [task.fit((e,)) for e in CATALOGUE]
    fits = [f for f in singles if f is not None]
    known = {f.names[0]: f for f in fits}
    n = max(task.rows.size, 1)
    stated = task.case.model.k_tol is not None
    # First a single onset: if it explains everything, no constant pair is needed. As for the force:
    # what a naive model lacks has no onset, and the residual of a lag with a wrong form, before a
    # test would reject it, would be taken for one.
    if stated:
        fits += actuator_onset.propose(task, null, fits)
    for size in (2, 3):
        best = min(fits, key=lambda f: f.chi2)
        left = best.chi2 - n
        groups = list(combinations(CATALOGUE, size))
        # A single effect also leaves errors in the form of its law. If the model is known well, two
        # effects that nearly cancel leave little, so that only noise ends the search for a pair; a
        # delay together with an oil column may leave less than that.
        close = size == 2 and stated
        if left < (
            POLICY.pair_beyond_chance * np.sqrt(2.0 * n)
            if close
            else POLICY.pair_excess * n + POLICY.pair_share * (null.chi2 - n)
        ):
            if not close or best.before or best.names[0] not in LAGS:
                break
            groups = [g for g in groups if {e.name for e in g} == LAGS]
        for group in groups:
            if size == 3 and not set(best.names) <= {e.name for e in group}:
                continue
            starts = _warm(task, group, known)
            if starts and (f := task.fit(group, starts)) is not None:
                fits.append(f)
        fits += _parts(task, min(fits, key=lambda f: f.chi2))
    if stated:
        fits += actuator_onset.propose_beside(task, fits)
    scale = inflation(min(fits, key=lambda f: f.chi2).residual)
    fits.sort(key=lambda f: f.misfit(scale) + task.price(f))
    first: dict[tuple[str, ...], ActuatorFit] = {}
    for f in fits:
        first.setdefault(f.names, f)
    return null, list(first.values()), scale
