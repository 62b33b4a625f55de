"""Readings in which the force of a law jumps.

Friction jumps between two rows, in which the velocity changes sign; a delayed load cell shows it
later. Which of the two readings already has the new force depends on a fraction of a row, and so on
errors of the motion that no parameter describes: each of them may be wrong by half of the jump.
Along an estimated motion, whose reversals are less exact, so may the readings beside them. A law
that begins in mid-test is fitted with a smooth start, and may have begun at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rthyb_rt.diagnose import fitted
from rthyb_rt.diagnose.case import Floats
from rthyb_rt.diagnose.effects.base import SWITCH_S
from rthyb_rt.diagnose.onset import lasting
from rthyb_rt.diagnose.problem import Fit, ResidualProblem

INSTANTS = 200
"""Number of jumps of a force whose readings are separate, at most: the largest. Also the largest
number of readings at the beginning of a law."""
UNSEEN = 0.1
"""Size of a wrong reading, in standard deviations of the noise, below which it is disregarded."""
ASIDE = 3
"""Rows between a jump and the changes of the force with which it is compared: a delay by a fraction
of a row spreads it over two."""
ISOLATED = 5.0
"""Least ratio of a jump to the changes of the force two and three rows away. That of a sine is 4.2
at most, at whatever number of rows a cycle; a step of friction is that of one or two rows."""
OPEN = 0.05
"""Largest part of the rows that may be readings in which a force jumps. Each row that is left open
loses its noise as well: the rms of the rest falls by half of this."""
SWITCHES = 4.0
"""Reach of the switch with which a force begins, in its time constants: 0.03 % are left there."""


def with_readings(
    problem: ResidualProblem, fit: Fit, design: Floats, prior: Floats
) -> tuple[Floats, Floats]:
    """Return design, (rows, p + m), and prior with these readings, each by itself."""
    whole, _ = _beside(problem, _wrong(problem, fit), design)
    more = np.r_[np.zeros(design.shape[1]), np.ones(whole.shape[1] - design.shape[1])]
    return whole, np.pad(prior, (0, more.size - prior.shape[0])) + np.diag(more)


def without_readings(problem: ResidualProblem, fit: Fit, rest: Floats) -> Floats:
    """Return a residual of the force, (n,), N, without what these readings may be wrong by.

    As it is for a long recording, of which only a part of the rows is evaluated, and if the jumps
    are too many to be told from a force that changes as fast everywhere.
    """
    if problem.pieces is not None or problem.rows.size != np.count_nonzero(problem.estimate.rows):
        return rest
    wrong = _wrong(problem, fit, ISOLATED)
    if np.count_nonzero(wrong) > OPEN * problem.rows.size:
        return rest
    seen = problem.seen(rest)
    design, places = _beside(problem, wrong, np.zeros((seen.size, 0)))
    corrected = rest.copy()
    if places:
        normal = design.T @ design + np.eye(len(places))
        corrected[places] -= np.linalg.solve(normal, design.T @ seen) * wrong[places]
    return corrected


def _wrong(problem: ResidualProblem, fit: Fit, isolated: float = 0.0) -> Floats:
    """Return by how much each reading may be wrong, (n,), N.

    Args:
        problem: the problem.
        fit: the set.
        isolated: how many times a jump must be as large as the changes of the force beside it.
    """
    laws = [i for i, m in enumerate(fit.members) if not m.effect.sensor]
    total = np.sum([fitted.contribution(problem, fit, i) for i in laws], axis=0)
    wrong = np.zeros(problem.ctx.t.size)
    if total.size <= 2 * ASIDE + 1:
        return wrong
    for i in laws:
        if fit.members[i].effect.late:
            wrong = np.maximum(wrong, _of_switch(problem, fit, i))
    change = np.diff(total)
    jump = np.abs(change[ASIDE:-ASIDE] - 0.5 * (change[: -2 * ASIDE] + change[2 * ASIDE :]))
    shifts = [ASIDE + k for k in (-ASIDE, 1 - ASIDE, ASIDE - 1, ASIDE)]
    beside = np.max([np.abs(change[k : k + jump.size]) for k in shifts], axis=0)
    jump[jump < isolated * beside] = 0.0
    reach = np.arange(2) if problem.estimate.exact else np.arange(-1, 3)
    for at in np.argsort(jump)[: -INSTANTS - 1 : -1]:
        near = at + ASIDE + reach
        wrong[near] = np.maximum(wrong[near], 0.5 * jump[at])
    return wrong


def _of_switch(problem: ResidualProblem, fit: Fit, member: int) -> Floats:
    """Return how a force that begins smoothly differs from one that begins at once, (n,), N.

    Zero for all of them if they are too many readings.
    """
    one, ctx = fit.members[member], problem.ctx
    since = ctx.t - ctx.first_s - one.trial.theta[-1]
    near = np.abs(since) < SWITCHES * SWITCH_S
    if np.count_nonzero(near) > INSTANTS:
        return np.zeros(since.size)
    members = (*fit.members[:member], lasting(one), *fit.members[member + 1 :])
    whole = fitted.contribution(problem, replace(fit, members=members), member)
    off = np.where(since >= 0.0, whole, 0.0) - fitted.contribution(problem, fit, member)
    return np.where(near, np.abs(off), 0.0)


def _beside(problem: ResidualProblem, wrong: Floats, design: Floats) -> tuple[Floats, list[int]]:
    """Return a design with what is seen if a reading is wrong, and which readings these are."""
    one = np.zeros(wrong.size)
    one[problem.rows[problem.rows.size // 2]] = 1.0
    # Readings too small to be seen are not filtered one by one: a filter is alike at every row.
    heard = float(np.linalg.norm(problem.seen(one)))
    known, places = design.shape[1], np.flatnonzero(wrong * heard > UNSEEN)
    # In one piece: a copy of it would be the largest array of a long recording.
    whole = np.empty((design.shape[0], known + places.size))
    whole[:, :known] = design
    visible: list[int] = []
    for row in places:
        reading = np.zeros(wrong.size)
        reading[row] = wrong[row]
        at = known + len(visible)
        whole[:, at] = problem.seen(reading)
        if whole[:, at] @ whole[:, at] > UNSEEN**2:
            visible.append(int(row))
    return whole[:, : known + len(visible)], visible
