"""The catalogue of effects as a reader wants it: every effect, what it is like, what parts them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rthyb_rt.diagnose import effects
from rthyb_rt.diagnose.actuation import CATALOGUE, ActuatorEffect
from rthyb_rt.diagnose.effects.base import Effect
from rthyb_rt.diagnose.effects.sensor import QUANTISATION
from rthyb_rt.diagnose.words import called

Place = Literal["specimen", "load cell", "actuator"]


@dataclass(frozen=True)
class Entry:
    """One effect.

    Attributes:
        name: as in the answer.
        plain: as a laboratory calls it.
        place: where it sits.
        params: names with units, as in the answer.
        equation: its law in a line.
        fingerprint: what it looks like in what the model leaves.
        shown_by: kind of experiment that shows it, and why.
        alike: effects that it is confused with, each with what parts the two.
    """

    name: str
    plain: str
    place: Place
    params: tuple[str, ...]
    equation: str
    fingerprint: str
    shown_by: tuple[str, str]
    alike: tuple[tuple[str, str], ...]


PAIRS: tuple[tuple[str, str, str], ...] = (
    ("stiffness", "inertia",
     "at one frequency both are in line with displacement; over a sweep the force of a mass grows "
     "with the square of frequency, that of a spring does not"),
    ("stiffness", "cubic",
     "at one amplitude a straight line stands for much of a cubic; at several the share of a cubic "
     "grows with the square of amplitude"),
    ("stiffness", "degradation",
     "a spring that is too weak is so from the first cycle; what is lost grows with the path"),
    ("stiffness", "gap",
     "a gap takes up the same displacement at every amplitude, so its share falls as amplitude "
     "grows"),
    ("stiffness", "act_gain",
     "a gain shows between command and displacement, a stiffness between displacement and force"),
    ("stiffness", "crosstalk",
     "where the force in the other direction follows this one they are one thing; an independent "
     "motion in the other direction parts them"),
    ("cubic", "stopper",
     "a stop is exactly nothing before it is met; a cubic is small there, not nothing"),
    ("cubic", "hysteresis",
     "both soften; yielding makes a loop that takes energy, a cubic goes back the way it came"),
    ("cubic", "pinching",
     "pinching takes force away around zero and leaves it beyond; a cubic changes it most at the "
     "largest displacement"),
    ("hysteresis+pinching+degradation", "hysteresis",
     "a plain loop comes back to the same force in every cycle; a worn column grows softer and "
     "slacker, so cycles at one amplitude, one after the other, part them"),
    ("power_damping", "viscous",
     "at one amplitude a straight line stands for a power of velocity near one; at several the "
     "share of a low power falls as amplitude grows"),
    ("power_damping", "coulomb",
     "friction keeps its size from the smallest velocity on; a low power still grows, which a wide "
     "range of amplitudes shows"),
    ("quadratic", "bias",
     "at one amplitude the mean of a parabola is an offset; towards small amplitude the parabola "
     "vanishes and the offset stays"),
    ("quadratic", "stopper",
     "a stop at one side is exactly nothing before it is met"),
    ("gap", "pinching",
     "a gap has an edge at the same place in every cycle; pinching is smooth and may widen with "
     "the largest displacement so far"),
    ("gap", "coulomb",
     "behind a play a spring falls short by the same force either way, which looks like friction "
     "of the wrong sign; after a reversal it takes the whole play to change"),
    ("gap", "gap+coulomb",
     "with friction behind the gap the force comes to a level; with a spring behind it the force "
     "goes on with displacement"),
    ("viscous", "coulomb",
     "at one speed they are one thing; at several amplitudes friction keeps its size, the force of "
     "a dashpot grows with velocity"),
    ("viscous", "quad_damping",
     "at one amplitude and frequency they are nearly one thing; over several amplitudes the force "
     "grows with velocity or with its square"),
    ("viscous", "time_skew",
     "around one frequency they are one thing; over a sweep a skew grows with the rate of the "
     "whole force, and every step of the force comes late as well"),
    ("viscous", "maxwell",
     "slow motion shows a dashpot only; at frequencies beyond 1 / (2 pi tau) relaxation turns into "
     "a spring"),
    ("coulomb", "stribeck",
     "both jump with the sign of velocity; dry friction has no peak at low velocity, so the motion "
     "has to be slow as well as fast"),
    ("coulomb", "lugre",
     "bristles make a slope over displacement after each reversal; where they are short against "
     "the motion they are dry friction"),
    ("coulomb", "hysteresis",
     "a slider on a spring is both; dry friction jumps at a reversal, yielding takes the way of "
     "twice its yield displacement"),
    ("coulomb", "quantisation",
     "rounding never lies farther off than half a step and knows nothing of velocity"),
    ("coulomb", "gap+coulomb",
     "behind a gap the force is nothing for a part of the way after each reversal"),
    ("stribeck", "lugre",
     "a peak that belongs to low velocity is there at every slow moment; one of bristles is there "
     "after reversals alone"),
    ("stribeck", "quad_damping",
     "a model with too much damping makes dry friction look like a fall with velocity; at higher "
     "velocity that fall goes on, the one from a peak comes to a level"),
    ("lugre", "hysteresis",
     "beside a spring that nobody knows, bristles are a spring that yields, and both are named; a "
     "stated stiffness parts them"),
    ("gap+coulomb", "gap+coulomb+bias",
     "one that grips harder one way has two levels; half their difference is named as a bias"),
    ("gap+coulomb", "pinching",
     "pinching takes a part of a spring's force around zero; behind a gap the force is nothing "
     "after each reversal, wherever that is"),
    ("gap+coulomb+bias", "bias",
     "an offset of the load cell is there in the gap as well, that of an uneven grip is not"),
    ("inertia", "second_mode",
     "far below its own frequency a mass on a spring is a mass; a sweep through that frequency "
     "makes it ring"),
    ("second_mode", "hum",
     "a mass rings when it is moved and dies away; hum goes on at rest and in phase with nothing"),
    ("hysteresis", "pinching",
     "both narrow or widen the loop; pinching acts at zero displacement, yielding at the largest"),
    ("hysteresis", "degradation",
     "after yielding small cycles have their first stiffness again; after a loss they do not"),
    ("hysteresis", "maxwell",
     "both are loops; those of yielding do not depend on rate, those of relaxation do"),
    ("degradation", "drift",
     "a loss grows in phase with displacement, a drift continues when nothing moves"),
    ("maxwell", "time_skew",
     "around one frequency both turn the force; over a sweep relaxation comes to an end at high "
     "frequency, a skew grows"),
    ("bias", "drift",
     "over a short recording a slow drift is an offset; a longer one, or two halves apart, part "
     "them"),
    ("time_skew", "delay",
     "a late actuator shows between command and displacement, a late load cell between "
     "displacement and force"),
    ("delay", "oil_column",
     "slow motion shows the sum of both lags; over a sweep a column changes the amplitude as well"),
    ("delay", "delay_rate",
     "at one speed they are one thing; at several amplitudes a delay stays the same"),
    ("delay_rate", "rate_limit",
     "a limit does nothing below its velocity; a delay that grows with velocity is there from rest "
     "on"),
    ("act_gain", "oil_column",
     "a gain is the same at every frequency, a column's amplitude changes towards its own"),
    ("act_gain", "rate_limit",
     "both make the stroke shorter; a limit does so only where the motion is fast"),
)  # fmt: skip
"""Effects that are confused, and what parts them."""


def entries() -> dict[str, Entry]:
    """Return every effect by name: of the specimen, of the load cell, of the actuator."""
    laws = sorted(effects.catalogue().values(), key=lambda e: e.sensor)
    out = [_entry(e, "load cell" if e.sensor else "specimen") for e in (*laws, QUANTISATION)]
    out += [_entry(a, "actuator") for a in CATALOGUE]
    return {e.name: e for e in out}


def _entry(e: Effect | ActuatorEffect, place: Place) -> Entry:
    return Entry(
        e.name, called(e.name), place, tuple(p.name for p in e.params), e.equation, e.fingerprint,
        e.shown_by, alike(e.name),
    )  # fmt: skip


def alike(name: str) -> tuple[tuple[str, str], ...]:
    """Return the effects that one is confused with, each with what parts the two."""
    return tuple(
        (second if first == name else first, parts)
        for first, second, parts in PAIRS
        if name in (first, second)
    )
