"""Sets of effects, each refined by the motion that they simulate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from rthyb_rt.diagnose.effects.base import Floats, Trial
from rthyb_rt.diagnose.fitted import bent
from rthyb_rt.diagnose.fitter import LEADING, SetFitter, in_place, plainer_friction, without
from rthyb_rt.diagnose.freebody import Body
from rthyb_rt.diagnose.policy import POLICY
from rthyb_rt.diagnose.problem import Fit, Member, ResidualProblem, compatible, names_of

SETTLED = 0.01
"""Fraction of a misfit by which a further fit of a motion must improve it."""
PARTS = 150
"""Simulations reserved for subsets of the best sets: three fits of a set of two."""
AGAIN = 3
"""Largest number of times that such a fit is restarted."""


class MotionFitter(SetFitter):
    """Refines sets by the motion that they simulate."""

    def __init__(self, problem: ResidualProblem, body: Body, first: SetFitter) -> None:
        super().__init__(problem)
        self.body, self.first = body, first
        self.tried: list[Fit] = []
        self.scale = 1.0
        # A simulated motion is no estimate, but two accurate simulators differ slightly.
        self.exact, self.rows = True, float(body.rows.size)
        self.judged = "rig" if body.whole_rig else "motion"

    def complete(self, enough: float) -> None:
        """Try each number of the model beside the best set that can be larger.

        If it leaves more than ``enough``: one that came to the front last, by the subsets of a
        wrong one, has not been extended.
        """
        fit = next((f for f in self.ranked if len(f.names) < self.body.largest), None)
        if fit is None or fit.chi2 < enough:
            return
        self.body.runs = max(self.body.runs, PARTS)
        for effect in self.problem.effects:
            members = (*fit.members, Member(effect, Trial()))
            if effect.number and compatible(members) and names_of(members) not in self.by_names:
                self.fit(members)

    def move(self, fit: Fit) -> Fit | None:
        """Refine a set that was found in the force balance; the better of its shapes is kept.

        A set that reproduces the motion cannot be improved from another start, and one that has an
        effect twice is the same as without the second.
        """
        if not self.body.distinct(fit):
            return None
        known = self.by_names.get(fit.names)
        if known is not None and known.chi2 < POLICY.motion_met_alone * self.rows:
            return known
        return self._simulated(fit)

    def _simulated(self, fit: Fit) -> Fit | None:
        found = self.body.settled(self.problem, fit)
        if found is None:
            return None
        self._scaled(found)
        self.tried.append(found)
        old = self.by_names.get(fit.names)
        if old is None or found.chi2 < old.chi2:
            self.by_names[fit.names] = found
        return self.by_names[fit.names]

    def fit(self, members: Iterable[Member], driving: bool = False) -> Fit | None:
        """Refine a set in the force balance, and then by its motion; None as from either."""
        begun = self.first.fit(members, driving)
        return self.move(begun) if begun is not None else None

    def rescale(self, scale: float, plain: Fit) -> None:
        """Scale down the evidence of rows in all simulations, past and future.

        Coloured noise makes rows less informative; the tolerances of the model are unaffected.
        """
        self.scale = scale
        for fit in (plain, *self.tried):
            self._scaled(fit)

    def _scaled(self, fit: Fit) -> None:
        own = float(fit.residual @ fit.residual)
        fit.chi2 += own / self.scale - own

    def pointless(self, names: tuple[str, ...]) -> bool:
        """Return whether a set need not be simulated: if without one or more of its effects, or
        with fewer others, the noise is reached and no stated value leaves its tolerance.

        For a whole rig, a set with one more effect is simulated nevertheless: its force may be
        small.
        """
        met = [f for f in self.by_names.values() if f.chi2 < POLICY.motion_met_alone * self.rows]
        return any(
            len(f.names) + (self.body.whole_rig and set(f.names) < set(names)) < len(names)
            for f in met
            if not bent(self.problem, f)
        )

    def plain_friction(self) -> None:
        """Replace a more complex friction by dry friction in the best sets.

        They contain it as a special case, and a rig that is reproduced with one may be without it.
        """
        plainer = plainer_friction()
        for fit in self.ranked[:LEADING]:
            rich = [i for i, m in enumerate(fit.members) if m.name in plainer]
            if len(rich) != 1 or plainer[fit.members[rich[0]].name] in fit.names:
                continue
            name = plainer[fit.members[rich[0]].name]
            dry = next((e for e in self.problem.effects if e.name == name), None)
            if dry is None:
                continue
            own = fit.members[rich[0]]
            sheared = in_place(self.problem, dry, own) if own.effect.slides else None
            members, betas = list(fit.members), list(fit.betas)
            members[rich[0]] = Member(dry, sheared or Trial())
            betas[rich[0]] = fit.betas[rich[0]][:1]
            twin = replace(fit, members=tuple(members), betas=tuple(betas), covariance=None)
            known = self.by_names.get(twin.names)
            # It may have been tried as a step, which fits worse than a contact that shears.
            if known is None or (sheared is not None and known.chi2 > (1.0 + SETTLED) * fit.chi2):
                self.move(twin)

    def springs(self) -> None:
        """Try the best sets with each form of their elastic springs, and each form alone.

        The spring is nearly all of the force of a free decay, and the balance, along an estimated
        motion, can prefer a form with which the motion cannot be simulated. Beside a friction that
        imitates the damping, the right form may fit no better.
        """
        alone: set[Member] = set()
        for fit in self.ranked[:LEADING]:
            for i, own in enumerate(fit.members):
                trials = own.effect.trials(self.problem.ctx) if own.effect.elastic else ()
                forms = {t.variant: t for t in reversed(trials) if t.variant != own.trial.variant}
                for trial in forms.values():
                    other = replace(own, trial=trial)
                    self.fit((*fit.members[:i], other, *fit.members[i + 1 :]))
                    if len(fit.members) > 1 and other not in alone:
                        alone.add(other)
                        self.fit((other,))

    def _in_form(self, fit: Fit, which: int, member: Member, beta: Floats) -> None:
        members = (*fit.members[:which], member, *fit.members[which + 1 :])
        betas = (*fit.betas[:which], beta, *fit.betas[which + 1 :])
        self.move(replace(fit, members=members, betas=betas, covariance=None))

    def settle(self) -> None:
        """Continue with the best sets until they no longer change, then with their subsets.

        A set with one more law may have found the optimum that its subset has missed.
        """
        for fit in self.ranked[:LEADING]:
            self._refine(fit)
        # Regardless of the number of simulations so far: a subset that was not evaluated must not
        # count as one that fails.
        self.body.runs = max(self.body.runs, PARTS)
        done: set[tuple[str, ...]] = set()
        for _ in range(2):
            ahead = self.ranked[:LEADING]
            for fit in [f for f in ahead if len(f.members) > 1 and f.names not in done]:
                done.add(fit.names)
                for i in range(len(fit.members)):
                    part = without(self.problem, fit, i)
                    # If the rig is reproduced, only the misfit of the subsets is needed.
                    met = self.body.whole_rig and fit.chi2 < POLICY.motion_met_alone * self.rows
                    if not (met and part.names in self.by_names):
                        self.move(part)

    def elsewhere(self) -> None:
        """Refine the best set again from where larger sets left its laws, if its friction sticks.

        The misfit of such a motion has many minima, nearly as deep as one another. The deepest one
        counts, and their scatter is part of the interval.
        """
        best = self.leading
        if best is None or not any(m.effect.dry for m in best.members):
            return
        larger = [
            f
            for f in self.ranked
            if len(f.members) == len(best.members) + 1 and set(best.names) < set(f.names)
        ]
        for fit in larger[:LEADING]:
            added = [i for i, m in enumerate(fit.members) if m.name not in best.names]
            part = without(self.problem, fit, added[0])
            if part.names == best.names and self.body.distinct(part):
                self._simulated(part)

    def _refine(self, fit: Fit) -> None:
        for _ in range(AGAIN):
            before = fit.chi2
            if before < POLICY.motion_met_alone * self.rows:
                break
            found = self.move(fit)
            if found is None or found.chi2 > (1.0 - SETTLED) * before:
                break
            fit = found
