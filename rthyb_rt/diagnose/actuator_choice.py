"""Which effects of the actuator are named, and whether they explain its motion."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose import actuation, noise
from rthyb_rt.diagnose.actuation import Actuation, ActuatorEffect, ActuatorFit
from rthyb_rt.diagnose.case import Case
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.result import Displacement
from rthyb_rt.diagnose.verdict import of_form


@dataclass(frozen=True)
class WeighedSets:
    """Comparison of sets of actuator effects.

    Attributes:
        size: size of the displacement, in units of its noise.
        plain: simulation of the model as given.
    """

    task: Actuation
    null: ActuatorFit
    fits: list[ActuatorFit]
    scale: float
    size: float
    plain: ComputedMotion

    def gain(self, fit: ActuatorFit, less: ActuatorFit) -> float:
        """Return the reduction of chi-squared from one set to another."""
        return less.misfit(self.scale) - fit.misfit(self.scale)

    def worth(self, fit: ActuatorFit) -> bool:
        """Return whether a set earns its price, and has a noticeable effect."""
        # Relative to the model as given: a time offset may already have absorbed part of it.
        moved = float(np.std((fit.motion.x - self.plain.x)[self.task.rows])) / self.task.sigma
        earned = self.gain(fit, self.null) > self.task.price(fit)
        return earned and moved > POLICY.least_force * self.size

    def completes(self, fit: ActuatorFit, effect: ActuatorEffect, without: ActuatorFit) -> bool:
        """Return whether an effect reduces the misfit to noise if the model is known well.

        It is not a matter of form if it earns its price beyond what smooth changes of the form of
        the other effects would earn, and is larger than the errors of any formula.
        """
        n = self.task.rows.size
        stated = self.task.case.model.k_tol is not None
        if not stated or fit.chi2 - n >= POLICY.actuator_at_noise * n:
            return False
        own = self.gain(fit, without)
        least = POLICY.actuator_at_noise_price * self.task.price_of(effect)
        exact = all(e.exact for e in without.effects)
        form = POLICY.least_force if exact else POLICY.actuator_form
        if own < form**2 * self.gain(without, self.null):
            return False
        return own > least and own - self.task.by_form(without) / self.scale > least

    def needed(self, fit: ActuatorFit) -> bool:
        """Return whether no effect of a set can be omitted."""
        least = POLICY.needed_share_actuator * self.gain(fit, self.null)
        for effect in fit.effects:
            rest = tuple(sorted(e.name for e in fit.effects if e is not effect))
            without = next((f for f in self.fits if f.names == rest), None) if rest else self.null
            if without is None:
                continue
            own = self.gain(fit, without)
            if own < self.task.price(fit) / len(fit.effects):
                return False
            if rest and own < least and not self.completes(fit, effect, without):
                return False
        return True

    def alike(self, fit: ActuatorFit, best: ActuatorFit) -> bool:
        """Return whether a set cannot be distinguished from the best one.

        If the recording shows no difference at all between single effects, as between a delay and a
        lag at one frequency, a lower price is no evidence.
        """
        apart = fit.misfit(self.scale) - best.misfit(self.scale)
        if len(fit.effects) == len(best.effects) == 1 and apart < POLICY.twin_evidence:
            return True
        more = max(0, fit.count - best.count)
        dearer = POLICY.dearer_rival_actuator * POLICY.same_evidence * more
        return apart + dearer < POLICY.same_evidence


def displacement(case: Case) -> Displacement | None:
    """Diagnose x_cmd -> x_meas; None if one of the three is missing."""
    base = case.model.actuator
    if base is None or "x_cmd" not in case.channels or "x_meas" not in case.channels:
        return None
    task = Actuation(case, base)
    if task.rows.size < POLICY.least_rows:
        return None
    null, fits, scale = actuation.search(task)
    n = task.rows.size
    before = null.chi2 / n - 1.0
    size = float(np.std(task.x[task.rows])) / task.sigma
    sets = WeighedSets(task, null, fits, scale, size, task.simulate(base))
    good = [f for f in fits if sets.worth(f) and sets.needed(f)]
    best = good[0] if good else _as_stated(task, null)
    equal = [f for f in good if f is not best and sets.alike(f, best)]
    after = best.chi2 / n - 1.0
    left = after / before if before > 0 else 0.0
    nothing = POLICY.excess_as_noise + POLICY.excess_of_nothing_actuator
    known = after < POLICY.excess_as_noise or (not best.effects and before < nothing)
    # If noise may be given any colour, it must be within the data sheet, and without bursts.
    known = known and task.own is None
    known = known or left < of_form(case.model.k_tol is None, len(best.effects) or 1, POLICY)
    # As for the force: noise has any colour, and only its white part is measured.
    quiet = bool(case.model.x_std) and noise.mere(
        task.left(best)[task.rows],
        best.residual,
        (case.model.x_std or 0.0) * (1.0 + (task.own.scatter if task.own is not None else 0.0)),
        case.fs_hz,
    )
    # An effect as small as what is left would not be reported either.
    known = known or quiet or np.sqrt(max(after, 0.0)) < POLICY.least_force * size
    rivals = [f for f in fits if f is not best][:5]
    return Displacement(task, null, best, equal, rivals, scale, left, known, quiet)


def _as_stated(task: Actuation, null: ActuatorFit) -> ActuatorFit:
    """Return nuisance parameters only, without a time offset if that brings nothing.

    A lag behind a held command has a velocity that changes in steps: an offset of a nanosecond in
    the wrong direction, determined by noise, would move each row's step to before the row.
    """
    residual, motion, zero = task.residual(task.base)
    if float(residual @ residual) - null.chi2 > POLICY.same_evidence:
        return null
    return replace(null, model=task.base, residual=residual, motion=motion, zero_m=zero)
