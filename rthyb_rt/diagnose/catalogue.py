"""The catalogue of effects for display: each effect, its fingerprint, and what separates them."""

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
class EffectEntry:
    """One effect.

    Attributes:
        name: name in the answer.
        plain: common name.
        place: where it acts.
        params: names with units, as in the answer.
        equation: its law in one line.
        fingerprint: its appearance in the model's residual.
        shown_by: kind of experiment that shows it, and why.
        alike: effects with which it can be confused, each with what separates the two.
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
     "at one frequency, both are in phase or antiphase with displacement; over a sweep, the "
     "force of a mass grows with the square of frequency, that of a spring does not"),
    ("stiffness", "cubic",
     "at one amplitude, a straight line approximates much of a cubic; over several amplitudes, "
     "the share of a cubic grows with the square of amplitude"),
    ("stiffness", "degradation",
     "an error of the stiffness is there from the first cycle; degradation grows with the "
     "distance travelled"),
    ("stiffness", "gap",
     "a gap takes up the same displacement at every amplitude, so its share falls as amplitude "
     "grows"),
    ("stiffness", "act_gain",
     "an error of the gain appears between command and displacement, an error of the stiffness "
     "between displacement and force"),
    ("stiffness", "crosstalk",
     "if the force in the other direction is proportional to this one, the two are "
     "indistinguishable; an independent motion in the other direction separates them"),
    ("cubic", "stopper",
     "the force of a stop is exactly zero until contact; that of a cubic is small there, but not "
     "zero"),
    ("cubic", "hysteresis",
     "both soften; yielding forms a loop that dissipates energy, a cubic spring unloads along "
     "the path on which it was loaded"),
    ("cubic", "pinching",
     "pinching removes force around zero and none beyond; a cubic changes the force most at the "
     "largest displacement"),
    ("hysteresis+degradation", "hysteresis+pinching+degradation",
     "both aim at the farthest point so far; without pinching straight towards it, with it the "
     "force stays low until shortly before"),
    ("hysteresis+degradation", "hysteresis",
     "a plain loop unloads and reloads alike at every amplitude; after a large cycle, one that "
     "degrades is softer in small ones"),
    ("hysteresis+pinching+degradation", "hysteresis",
     "a plain loop returns to the same force in every cycle; a damaged column becomes softer and "
     "slacker, so repeated cycles at one amplitude separate them"),
    ("power_damping", "viscous",
     "at one amplitude, a straight line approximates a power of velocity near one; over several "
     "amplitudes, the share of a low power falls as amplitude grows"),
    ("power_damping+maxwell", "power_damping",
     "on a spring, the force lags behind the velocity, the more the faster it changes; a stiff "
     "spring shows only in fast motion"),
    ("power_damping+maxwell", "maxwell",
     "relaxation is linear: its force doubles with the motion; that of a power of velocity does "
     "not, which several amplitudes show"),
    ("power_damping", "coulomb",
     "friction has its full size even at the smallest velocity; the force of a low power still "
     "grows with velocity, which a wide range of amplitudes shows"),
    ("quadratic", "bias",
     "at one amplitude, the mean of a parabola equals an offset; as the amplitude decreases, the "
     "parabola vanishes and the offset remains"),
    ("quadratic", "stopper",
     "the force of a stop on one side is exactly zero until contact"),
    ("gap", "pinching",
     "a gap has an edge at the same place in every cycle; pinching is smooth and may widen with "
     "the largest displacement so far"),
    ("gap", "coulomb",
     "with play, the force of a spring is too small by the same amount in both directions, which "
     "looks like friction of the wrong sign; after a reversal, it changes only over the whole "
     "play"),
    ("gap", "gap+coulomb",
     "with friction behind the gap, the force levels off; with a spring behind it, the force "
     "keeps growing with displacement"),
    ("viscous", "coulomb",
     "at one speed, the two are indistinguishable; over several amplitudes, friction keeps its "
     "size and the force of a dashpot grows with velocity"),
    ("viscous", "quad_damping",
     "at one amplitude and frequency, the two are nearly indistinguishable; over several "
     "amplitudes, the force grows with velocity or with its square"),
    ("viscous", "time_skew",
     "around one frequency, the two are indistinguishable; over a sweep, the effect of a skew "
     "grows with the rate of the whole force, and every step of the force is late as well"),
    ("viscous", "maxwell",
     "in slow motion, relaxation acts like a dashpot; at frequencies above 1 / (2 pi tau), it "
     "acts like a spring"),
    ("coulomb", "stribeck",
     "both jump with the sign of velocity; dry friction has no peak at low velocity, so the "
     "motion must be both slow and fast to separate them"),
    ("coulomb", "lugre",
     "bristles cause a slope over displacement after each reversal; if they are short compared "
     "with the motion, they act like dry friction"),
    ("coulomb", "hysteresis",
     "a slider on a spring can be described as either; dry friction jumps at a reversal, "
     "yielding changes over twice its yield displacement"),
    ("coulomb", "quantisation",
     "the error of rounding is never more than half a step, and does not depend on velocity"),
    ("coulomb", "gap+coulomb",
     "behind a gap, the force is zero for part of the travel after each reversal"),
    ("stribeck", "lugre",
     "a Stribeck peak appears whenever the motion is slow; that of bristles appears only after "
     "reversals"),
    ("stribeck", "quad_damping",
     "with too much damping in the model, dry friction appears to fall with velocity; at higher "
     "velocity this fall continues, while that of a Stribeck peak levels off"),
    ("lugre", "hysteresis",
     "beside a spring of unknown stiffness, bristles are equivalent to a yielding spring, and "
     "both are named; a stated stiffness separates them"),
    ("gap+coulomb", "gap+coulomb+bias",
     "friction that is stronger in one direction has two levels; half their difference is named "
     "as a bias"),
    ("gap+coulomb", "pinching",
     "pinching reduces the force of a spring around zero displacement; behind a gap, the force "
     "is zero after each reversal, wherever that occurs"),
    ("gap+coulomb+bias", "bias",
     "an offset of the load cell is also there within the gap; the bias of uneven friction is "
     "not"),
    ("inertia", "second_mode",
     "far below its own frequency, a mass on a spring acts like a rigid mass; a sweep through "
     "that frequency excites it"),
    ("second_mode", "hum",
     "a mass oscillates when it is moved and then decays; hum continues at rest and is not in "
     "phase with the motion"),
    ("hysteresis", "pinching",
     "both make the loop narrower or wider; pinching acts at zero displacement, yielding at the "
     "largest"),
    ("hysteresis", "degradation",
     "after yielding, small cycles have the initial stiffness again; after degradation they do "
     "not"),
    ("hysteresis", "maxwell",
     "both form loops; those of yielding do not depend on rate, those of relaxation do"),
    ("degradation", "drift",
     "degradation grows in phase with displacement; a drift continues when nothing moves"),
    ("maxwell", "time_skew",
     "around one frequency, both shift the phase of the force; over a sweep, the effect of "
     "relaxation levels off at high frequency, that of a skew grows"),
    ("bias", "drift",
     "over a short recording, a slow drift looks like an offset; a longer recording, or two "
     "halves far apart in time, separate them"),
    ("time_skew", "delay",
     "a delay of the actuator appears between command and displacement, a time skew of the load "
     "cell between displacement and force"),
    ("delay", "oil_column",
     "slow motion shows the sum of both lags; over a sweep, an oil column changes the amplitude "
     "as well"),
    ("delay", "delay_rate",
     "at one speed, the two are indistinguishable; over several amplitudes, a constant delay "
     "stays the same"),
    ("delay_rate", "rate_limit",
     "a limit has no effect below its velocity; a delay that grows with velocity has an effect "
     "at any velocity"),
    ("act_gain", "oil_column",
     "a gain is the same at every frequency; the amplitude of an oil column changes near its "
     "natural frequency"),
    ("act_gain", "rate_limit",
     "both shorten the stroke; a limit does so only where the motion is fast"),
)  # fmt: skip
"""Effects that can be confused, and what separates them."""


def entries() -> dict[str, EffectEntry]:
    """Return every effect by name: of the specimen, of the load cell, of the actuator."""
    laws = sorted(effects.catalogue().values(), key=lambda e: e.sensor)
    out = [_entry(e, "load cell" if e.sensor else "specimen") for e in (*laws, QUANTISATION)]
    out += [_entry(a, "actuator") for a in CATALOGUE]
    return {e.name: e for e in out}


def _entry(e: Effect | ActuatorEffect, place: Place) -> EffectEntry:
    return EffectEntry(
        e.name, called(e.name), place, tuple(p.name for p in e.params), e.equation, e.fingerprint,
        e.shown_by, alike(e.name),
    )  # fmt: skip


def alike(name: str) -> tuple[tuple[str, str], ...]:
    """Return the effects with which one can be confused, each with what separates the two."""
    return tuple(
        (second if first == name else first, parts)
        for first, second, parts in PAIRS
        if name in (first, second)
    )
