"""Sets of effects evaluated by simulating the whole rig, for compliant actuators.

A servo-hydraulic actuator yields to its specimen, and the motion of a specimen that sticks does not
determine its force: the force along an estimated motion only provides candidates. The decision is
made by simulating the rig from the recorded command, in the core, with the set in its specimen:
displacement and load cell must equal the recorded ones to within noise.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import replace
from math import ceil

import numpy as np

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import ComputedMotion, SimulationError
from rthyb_rt.diagnose import augment, gaps, noise_level
from rthyb_rt.diagnose.case import Case, Floats
from rthyb_rt.diagnose.effects.base import Context
from rthyb_rt.diagnose.effects.sensor import shifted
from rthyb_rt.diagnose.freebody import Body, Loose, _with_nuisance
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.predict import Augmented
from rthyb_rt.diagnose.problem import Fit, ResidualProblem
from rthyb_rt.lab import experiment

RUNS = 700
"""Largest number of simulations in a diagnosis, plus a few to complete a fit."""
KEPT = 64
"""Number of cached simulations, a third of a megabyte each."""
LONGEST_S, BEYOND_S = 20.0, 2.0
"""Simulated part of a recording: its duration, and the time after the largest displacement."""
STEEP = 1.0
"""Largest fraction of a velocity that the slope of friction removes from a table in one substep; at
two, the leapfrog integration becomes unstable."""
SMOOTH = 5e-3
"""Least width of a simulated friction step, relative to the largest velocity."""
UNSEEN = 3.0
"""Displacement that its noise hides, in standard deviations of the noise."""
FINER = 4
"""Largest factor on the rig's own substeps for steep friction, beyond which its step is widened."""


def given(case: Case) -> bool:
    """Return whether a case's motion must be simulated with its model's own rig."""
    model = case.model
    if model.rig is None or model.actuator is not None:
        return False
    return all(case.get(name) is not None for name in ("x_cmd", "x_meas", "f_meas"))


def as_given(case: Case) -> ComputedMotion | None:
    """Return the motion of the model's own rig along the recorded command, without noise.

    None if the measured motion differs.
    """
    if not given(case):
        return None
    rig = case.model.rig
    assert rig is not None
    made = ComputedMotion(
        *core.VirtualRig(experiment.rig_config(rig, case.fs_hz)).motion(
            gaps.filled(case.channels["x_cmd"])
        )
    )
    x_meas = case.channels["x_meas"]
    rows = case.rows & np.isfinite(x_meas)
    sigma = noise_level.noise_of(x_meas, case.model.x_std)
    off = float(np.mean(((x_meas - made.x)[rows] / sigma) ** 2))
    return made if off < POLICY.rig_follows else None


def config_of(model: Augmented) -> core.RigConfig:
    """Return the model's rig with the effects in its specimen and ideal sensors."""
    rig = model.base.rig
    assert rig is not None
    config = experiment.rig_config(rig, model.base.fs_hz)
    made = augment.specimen(model)
    elements = augment.beside_table(made.elements, rig)
    elements, mass_kg = augment.mass_off_table(elements, rig)
    servo = config.servo
    if servo.kind == "servo-hydraulic":
        servo = replace(servo, moving_mass_kg=mass_kg)
        ridden = sum(e.params[0] for e in elements if e.kind == "inertia")
        most = STEEP * max(servo.moving_mass_kg + ridden, 1e-6) * model.base.fs_hz
        wanted = ceil(sum(_steepness(e) for e in elements) / most)
        servo = replace(servo, substeps=min(max(servo.substeps, wanted), FINER * servo.substeps))
        elements = [_no_steeper(e, most * servo.substeps) for e in elements]
    exact = core.SensorConfig()
    return replace(config, servo=servo, elements=tuple(elements), displacement=exact, force=exact)


def _steepness(item: core.ElementConfig) -> float:
    """Return the largest slope of an element's force over velocity, N s/m."""
    p = dict(zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True))
    if item.kind == "viscous":
        return abs(p["c_n_s_per_m"])
    if item.kind in ("coulomb", "stribeck"):
        return abs(p.get("fs_n", p["fc_n"])) / p["width_m_per_s"]
    return 0.0


def _no_steeper(item: core.ElementConfig, most: float) -> core.ElementConfig:
    """Return an element whose step over velocity the substeps can resolve."""
    if item.kind not in ("coulomb", "stribeck") or _steepness(item) <= most:
        return item
    p = dict(zip(core.ELEMENT_PARAMS[item.kind], item.params, strict=True))
    p["width_m_per_s"] *= _steepness(item) / most
    return core.element(item.kind, **p)


def read(model: Augmented, force: Floats, ctx: Context) -> Floats:
    """Return the load cell's reading of a force, (n,), with its own effects in the set."""
    n = force.size
    for member, beta in zip(model.members, model.betas, strict=True):
        if member.effect.carries:
            force = shifted(force, member.trial.theta[0] * float(beta[0]) / ctx.dt)
        elif member.effect.sensor:
            columns = member.effect.columns(ctx, member.trial)
            for b, c in zip(beta, columns, strict=True):
                force = force + b * c[:n]
    return force


def along(model: Augmented, case: Case, other: dict[str, Floats]) -> tuple[Floats, Floats] | None:
    """Return displacement and force, each (n,), of the model's rig along a command.

    None if the model has no such rig, if a rig cannot represent or predict an effect, or if the
    measured motion differs.
    """
    if model.base.rig is None or model.actuator is not None or "x_cmd" not in other:
        return None
    sensors = [m for m in model.members if m.effect.sensor]
    known = {m.name for m in sensors if m.effect.foretold and not m.effect.needs}
    if not set(augment.specimen(model).lost) <= known:
        return None
    try:
        rig = core.VirtualRig(config_of(model))
    except core.CoreError:
        return None
    x, f = rig.run(other["x_cmd"])
    x_meas = case.channels.get("x_meas")
    if x_meas is not None and np.isfinite(x_meas).any():
        sigma = noise_level.noise_of(x_meas, model.base.x_std)
        if not float(np.nanmean((x_meas - x) ** 2)) < POLICY.rig_follows * sigma**2:
            return None
    still = ComputedMotion(x, np.gradient(x) * case.fs_hz, np.zeros_like(x))
    return x, read(model, f, model.context(still, case.t, other))


class RigBody(Body):
    """The recorded command, and the resulting displacement and force.

    Attributes:
        rows: those of the force, then those of the displacement.
    """

    largest = 3
    linear = False
    whole_rig = True

    def __init__(self, case: Case, ctx: Context) -> None:
        super().__init__(case, ctx)
        self.held = False
        self.met = POLICY.rig_nothing_left
        self.f = case.channels["f_meas"]
        peak = int(np.argmax(np.abs(self.other["x_meas"])))
        last = max(LONGEST_S * case.fs_hz, peak + BEYOND_S * case.fs_hz)
        self.command = self.other["x_cmd"]
        self.simulated = self.command[: int(min(last, case.t.size))]
        self.sigma_f = noise_level.force_noise(self.f, case.model.f_std)
        self.sigma = noise_level.noise_of(self.x, case.model.x_std)
        good = case.rows & np.isfinite(self.x) & np.isfinite(self.f)
        self.judged = np.flatnonzero(good[: self.simulated.size])
        self.rows = np.arange(2 * self.judged.size)
        self.units = {"bias": case.tare_error_n or 1e-9, "skew": POLICY.offset_prior_s}
        self.runs = RUNS
        self._made: OrderedDict[core.RigConfig, tuple[Floats, Floats]] = OrderedDict()

    def _loose(self) -> Loose:
        reach = POLICY.nuisance_reach
        return (("bias", 2.0, reach), ("skew", 2.0, reach))

    def quick(self, fit: Fit) -> bool:
        """Return whether a rig can represent every effect on the specimen."""
        model = self.case.model
        made = augment.specimen(
            Augmented(model, model, fit.members, fit.betas, None, self.ctx.all_ranges)
        )
        sensors = {m.name for m in fit.members if m.effect.sensor}
        return set(made.lost) <= sensors

    def distinct(self, fit: Fit) -> bool:
        """Return whether the set has no more than one law of dry friction.

        A yielding element is dry friction if the noise hides the displacement at which it yields.
        """
        unseen_m = UNSEEN * self.sigma
        dry = any(m.effect.dry for m in fit.members)
        return not dry or all(m.effect.elastic_until_m(m.trial) > unseen_m for m in fit.members)

    def start(self, first: Augmented) -> tuple[float, float] | None:
        """Return rest, as every test of this program starts at rest."""
        return 0.0, 0.0

    def refined(self, problem: ResidualProblem, fit: Fit) -> Fit | None:
        """Fit a set's parameters to displacement and force; None if it cannot be simulated."""
        return super().refined(problem, self._smooth(fit))

    def settled(self, problem: ResidualProblem, fit: Fit) -> Fit | None:
        """Return the same as `refined`: friction in a rig has a width."""
        return self.refined(problem, fit)

    def _smooth(self, fit: Fit) -> Fit:
        """Return a set whose dry contacts have a step over velocity, like the rig's friction."""
        least = SMOOTH * self.ctx.v_range
        if any(m.effect.complete for m in fit.members):
            return fit
        members = [replace(m, trial=m.effect.rounded(m.trial, least)) for m in fit.members]
        return replace(fit, members=tuple(members))

    def differences(self, now: Augmented, loose: Floats, at: tuple[float, float]) -> Floats:
        """Return recording less simulation in units of the noise, force and then displacement."""
        if not all(
            m.effect.sensible(self.ctx, m.trial, b)
            for m, b in zip(now.members, now.betas, strict=True)
        ):
            raise SimulationError("no physical law")
        try:
            x, f = self._run(config_of(now))
        except core.CoreError as error:
            raise SimulationError(str(error)) from error
        f = read(now, f, self.ctx)
        late_s = loose[1] * POLICY.offset_prior_s
        f = f + loose[0] * self.units["bias"] - late_s * np.gradient(f) / self.ctx.dt
        rows = self.judged
        off_f, off_x = f[rows] - self.f[rows], x[rows] - self.x[rows]
        # The sensor's zero is that of the tare, a mean over noise.
        off_x = off_x - np.mean(off_x)
        return np.asarray(np.r_[off_f / self.sigma_f, off_x / self.sigma])

    def _run(self, rig: core.RigConfig) -> tuple[Floats, Floats]:
        """Return displacement and force, each (n,), of a rig; the latest results are cached.

        Effects of the load cell do not change the motion, so the result remains valid.
        """
        made = self._made.get(rig)
        if made is None:
            made = core.VirtualRig(rig).run(self.simulated)
            with self.lock:
                self._made[rig] = made
                while len(self._made) > KEPT:
                    self._made.popitem(last=False)
        return made

    def motion(self, problem: ResidualProblem, fit: Fit) -> ComputedMotion | None:
        """Return the motion of the rig with a fitted set."""
        base = self.case.model
        plain = _with_nuisance(base, problem, fit)
        own = Augmented(plain, base, fit.members, fit.betas, None, self.ctx.all_ranges)
        try:
            return ComputedMotion(*core.VirtualRig(config_of(own)).motion(self.command))
        except core.CoreError:
            return None
