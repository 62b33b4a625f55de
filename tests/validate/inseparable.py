"""Cases in which the excitation leaves several laws equal: the whole set, found by refitting.

Equal means: no more parameters than the truth, a sign that nature has, and a chi-squared within 9.
Every other name of one parameter has to be 36 away, so that the set has no doubtful member.
"""

from __future__ import annotations

import numpy as np

from validate import drawn, fairness, recipes, rig
from validate.drawn import Size
from validate.fairness import Blocks, Scale
from validate.recipes import Case, Plan
from validate.rig import Bench, Effect, Redraw, Run
from validate.signals import Rng, rms

# Truth, excitation. Signs are such that a relaxation, which has two parameters and in its limits is
# a dashpot or a spring, cannot stand in: its spring is positive.
RECIPES = (
    ("stiffness", "sine"), ("inertia", "sine"), ("viscous", "sine"), ("time_skew", "sine"),
    ("time_skew", "triangle"), ("viscous", "triangle"),
)  # fmt: skip
FORCE_ONE = (
    "viscous", "coulomb", "quad_damping", "inertia", "stiffness", "cubic", "quadratic", "gap",
    "bias", "drift", "time_skew",
)  # fmt: skip
MOTION_ONE = ("delay", "act_gain", "delay_rate", "rate_limit")
POSITIVE = ("coulomb", "inertia", "gap", "delay_rate")
EXPERIMENTS = {
    "sweep": "sweep", "random": "random", "multi_frequency": "multisine",
    "multi_amplitude": "steps",
}  # fmt: skip


def equal_set(
    scale: Scale, library: Blocks, y: np.ndarray, names: tuple[str, ...]
) -> tuple[set[str], set[str]]:
    """Names equal to y and names in doubt; without those of a sign that they cannot have."""

    def possible(name: str, size: float) -> bool:
        way = -1.0 if name in ("gap", "delay_rate") else 1.0  # columns as their force runs
        return name not in POSITIVE or way * size > 0

    equal, doubtful = fairness.equals(scale, library, y, names)
    return {n for n, s in equal.items() if possible(n, s)}, {
        n for n, s in doubtful.items() if possible(n, s)
    }


def _judged(bench: Bench, run: Run, e: Effect) -> tuple[set[str], set[str]]:
    """Equal and doubtful names of a run with one effect.

    Equal in the force are laws that are so to the sharpest eye; a duller one tells those apart that
    are, and what the two see otherwise is in doubt.
    """
    if e.channel == "force":
        library = recipes._force_library(bench, run)
        dull, sharp = (
            equal_set(recipes._force_scale(bench, run, sharpest), library, run.parts[0], FORCE_ONE)
            for sharpest in (False, True)
        )
        return dull[0], dull[1] | sharp[1] | (dull[0] ^ sharp[0])
    changes = recipes._motion_changes(bench, run)
    library = fairness.motion_library(run.x, run.v, run.a, bench.fs, changes)
    return equal_set(recipes._motion_scale(bench, run), library, run.parts[0], MOTION_ONE)


def _signed(name: str, size: Size, rng: Rng) -> Effect:
    """The effect with the sign that leaves a relaxation out."""
    for _ in range(60):
        e = drawn.CATALOGUE[name](size, rng)
        value = next(iter(e.params.values()))
        if value * {"stiffness": -1, "viscous": -1}.get(name, 1) > 0:
            return e
    raise Redraw("never of that sign")


def experiments(
    bench: Bench, e: Effect, test: recipes.Test, size: Size, reach: float, rng: Rng
) -> list[str]:
    """Next experiments that leave one of the names, each performed on the true rig."""
    found = []
    for said, kind in EXPERIMENTS.items():
        other = recipes._test(bench, kind, size.seconds, 0.0, reach, size.f0, rng)
        other.fy *= rms(test.fy) / rms(other.fy)
        run = rig.perform(bench, [e], other.signal, other.fy, 0, rng)
        equal, doubtful = _judged(bench, run, e)
        if equal <= {e.name} and doubtful <= {e.name}:
            found.append(said)
    return found


def inseparable(plan: Plan, rng: Rng) -> Case:
    """One effect under an excitation that cannot tell it from others."""
    bench, size, test, reach = recipes._base(plan, rng, (0.05, 0.15))
    e = _signed(plan.names[0], size, rng)
    run = rig.perform(bench, [e], test.signal, test.fy, test.lead, rng)
    recipes._beyond_noise(bench, [e], run, plan.level)
    scale = (
        recipes._force_scale(bench, run)
        if e.channel == "force"
        else recipes._motion_scale(bench, run)
    )
    recipes._visible(scale, e.name, run.parts[0], plan.level)
    equal, doubtful = _judged(bench, run, e)
    equal.add(e.name)
    if doubtful - {e.name}:
        raise Redraw("in doubt whether equal: " + ", ".join(sorted(doubtful)))
    if len(equal) < 2:
        raise Redraw("nothing is equal to it")
    following = experiments(bench, e, test, size, reach, rng)
    if not following:
        raise Redraw("no experiment tells them apart")
    case = recipes._finish(
        plan, bench, [e], run, test, size, reach, rng, "ambiguous", {"equal": sorted(equal)}
    )
    case.ambiguous = [[name] for name in sorted(equal)]
    case.next_experiment = following
    return case  # fmt: skip
