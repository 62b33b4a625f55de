"""What an effect is: a force law that may have been left out of a model.

An effect is a class with a name, parameters, an equation and a method `columns`, which returns its
force per unit of each linear coefficient for given nonlinear shape parameters ``theta``. The search
finds the coefficients by least squares, scans `trials` for theta, and refines the best.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config.fields import written
from rthyb_rt.core.diagnosis_models import ComputedMotion
from rthyb_rt.diagnose.case import Family, Model
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Param:
    """A parameter as it is reported: name with unit, unit, allowed range.

    Raises:
        InputError: there is no name, or the range contains no number.
    """

    name: str
    unit: str
    low: float
    high: float

    def __post_init__(self) -> None:
        where = f"Param {written(self.name)}"
        if not isinstance(self.name, str) or not self.name:
            raise InputError(
                f"found {written(self.name)}; give the name with its unit, as in "
                'Param("gap_m", "m", 1e-9, 1.0)',
                "Param: name",
            )
        ends = (self.low, self.high)
        if any(isinstance(end, bool) or not isinstance(end, (int, float)) for end in ends) or not (
            self.low < self.high
        ):
            raise InputError(
                f"found the range from {written(self.low)} to {written(self.high)}; low and high "
                "must be numbers, and low must be below high",
                where,
            )


@dataclass(frozen=True)
class Context:
    """The quantities on which a force law may depend: the motion, the model, other channels.

    Attributes:
        model: the baseline.
        motion: x, v, a, each (n,).
        t: time, (n,), s.
        force: the force that was measured, for effects of the sensor, (n,), N.
        other: further channels by name.
        late_s: by how much the motion is later than the channels, at the same rows; see `late`.
    """

    model: Model
    motion: ComputedMotion
    t: Floats
    force: Floats
    other: dict[str, Floats]
    ranges: tuple[float, float, float] | None = None
    late_s: float = 0.0

    def late(self, motion: ComputedMotion, seconds: float) -> Context:
        """Return the same rows along this motion, that of this context ``seconds`` later.

        The time at the rows is that of the motion; channels remain as they were read.
        """
        return replace(
            self, motion=motion, t=self.t - seconds, ranges=self.all_ranges,
            late_s=self.late_s + seconds,
        )  # fmt: skip

    @property
    def first_s(self) -> float:
        """Time of the first row of the recording, s; onsets are counted from there."""
        return float(self.t[0]) + self.late_s

    @property
    def x(self) -> Floats:
        """Displacement, m."""
        return self.motion.x

    @property
    def v(self) -> Floats:
        """Velocity, m/s."""
        return self.motion.v

    @property
    def a(self) -> Floats:
        """Acceleration, m/s^2."""
        return self.motion.a

    @property
    def dt(self) -> float:
        """Sampling period, s."""
        return 1.0 / self.model.fs_hz

    @cached_property
    def spring(self) -> Floats:
        """The model's restoring force, N."""
        return self.model.spring(self.x)

    @cached_property
    def total(self) -> Floats:
        """The model's whole force, N."""
        return self.model.force(self.x, self.v, self.a)

    @cached_property
    def x_range(self) -> float:
        """Largest displacement, m."""
        return self.ranges[0] if self.ranges else float(np.max(np.abs(self.x))) or 1e-6

    @cached_property
    def v_range(self) -> float:
        """Largest velocity, m/s, disregarding the highest hundredth of the rows."""
        return self.ranges[1] if self.ranges else float(np.quantile(np.abs(self.v), 0.99)) or 1e-6

    @cached_property
    def f_range(self) -> float:
        """Largest force, N."""
        return self.ranges[2] if self.ranges else float(np.max(np.abs(self.force))) or 1.0

    @cached_property
    def all_ranges(self) -> tuple[float, float, float]:
        """The ranges of this motion, used when the law is evaluated along another motion."""
        return (self.x_range, self.v_range, self.f_range)

    @cached_property
    def travel(self) -> Floats:
        """Path covered so far, m.

        A recording that begins displaced begins with the shortest path there from the unloaded
        specimen, as its springs do: they are loaded straight to the first displacement.
        """
        return np.cumsum(np.abs(np.diff(self.x, prepend=0.0)))

    @cached_property
    def k_free(self) -> bool:
        """Whether the stiffness may be adjusted freely."""
        return self.model.k_tol is None

    @cached_property
    def k_scale(self) -> float:
        """A stiffness of the same order as the specimen's, N/m."""
        return max(abs(self.model.k), 1e-3 * self.f_range / self.x_range)

    def unit(self, kind: str, **params: float) -> Floats:
        """Return the force of one element of the core along the motion, N."""
        element = core.CoreElement(core.element(kind, **params))
        return element.run(self.x, self.v, self.a, self.dt)


SWITCH_S = 0.005
"""Time over which an effect is switched on in mid-recording, for a search by gradients."""
Theta = tuple[float, ...]


@dataclass(frozen=True)
class Trial:
    """One shape of an effect: a variant of its law, with values of its shape parameters."""

    theta: Theta = ()
    variant: str = ""


class Effect:
    """Base of every effect on the force.

    Class attributes:
        name: name in the answer.
        plain: name in the words of a laboratory; empty: ``name`` is used.
        phrase: the same with its size, ``"a gap of {gap_m}"``: `words.Size` says what may stand in
            the braces. Empty: plain, with all parameters.
        params: the parameters that are reported.
        equation: the law in one line.
        fingerprint: what it looks like in a residual.
        shown_by: the kind of experiment that shows it best, and why.
        sensor: it acts in the load cell's signal chain, so the specimen does not feel it.
        momentary: its force depends only on the current x and v, so a closed loop can be simulated
            with it although the core has no element for it.
        carries: for a sensor effect that changes how forces on the specimen are displayed.
        elastic: its force depends only on the current displacement.
        curve: likewise, and it is none of the model's numbers: any function of the displacement is
            nearly a sum of such effects.
        dissipates: it removes energy from a motion at every instant and stores none.
        yields: its spring yields plastically.
        complete: a joint law that is not combined with any other effect of the specimen.
        begins: it may begin in mid-recording; False if it depends on the whole past anyway.
        late: it begins in mid-recording.
        number: the number of the model (`case.Model`) that it changes; empty: none.
        static: it can be seen in a recording whose time is nominal.
        dry: it is a form of dry friction.
        plainer: name of the simpler law that it contains as a special case; that one is named
            instead if this one fits no better.
        contains: names of the laws that it is at certain values of its shape.
        slow_as, fast_as: names of the laws from which motion slow, or fast, against a time of its
            own cannot distinguish it.
        relaxes: its first shape parameter is the time in which its force decays, s.
        sprung: its damping acts through a spring of its own, so that fast motion is not damped.
        settles: in motion that is slow against `settling_s`, it acts like `plainer`.
        slides: it consists of sliders, any number of which is a form of the same effect.
        also: name of the law to which it is equivalent in parallel with a spring of free stiffness.
        of_spring: its parameter that is a fraction of the existing spring.
        replaces_spring: its element includes the model's spring.
        interrupts: its coefficient is the fraction of the model's spring that is inactive around
            zero.
        wears: its force changes with the travel so far.
        many_springs: it is simulated as many elements, or evaluates its force repeatedly.
        zero: it is the zero of the load cell, which a rig file has.
        wanders: it is a zero that changes with time.
        line: it has a single frequency of its own, its first shape parameter, Hz.
        on_body: families in which, without a load cell, it represents a force on the body.
        needs: a channel without which it has no effect.
        foretold: its effect on another recording can be predicted.
        over: the quantity to which it is proportional, if that is neither displacement nor
            velocity: "a", "t", "rate" of the force, or "fy".
        signs: for each linear coefficient '+', '-' or '*' for any sign.
        pinned: standard deviation of each coefficient around 1, or None for a free one.
        bounds: range of each shape parameter as multiples of the trial's own.
    """

    name = ""
    plain = ""
    phrase = ""
    params: tuple[Param, ...] = ()
    equation = ""
    fingerprint = ""
    shown_by: tuple[str, str] = ("sweep", "it covers amplitude and frequency")
    sensor = False
    momentary = False
    carries = False
    elastic = False
    curve = False
    dissipates = False
    yields = False
    complete = False
    begins = True
    late = False
    number: str = ""
    static = False
    dry = False
    plainer = ""
    contains: tuple[str, ...] = ()
    slow_as = fast_as = ""
    relaxes = False
    sprung = False
    settles = False
    slides = False
    also = ""
    of_spring = ""
    replaces_spring = False
    interrupts = False
    wears = False
    many_springs = False
    zero = False
    wanders = False
    line = False
    on_body: tuple[Family, ...] = ()
    needs = ""
    foretold = True
    over = ""
    signs: str = "*"
    pinned: tuple[float | None, ...] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names in the answer; a joint law of several effects has more than one."""
        return (self.name,)

    def trials(self, ctx: Context) -> Sequence[Trial]:
        """Return the shapes to be scanned; one without parameters by default."""
        return [Trial()]

    def columns(self, ctx: Context, trial: Trial) -> list[Floats]:
        """Return the force per unit of each linear coefficient, each (n,), N."""
        raise NotImplementedError

    def by_stroke(self, ctx: Context, trial: Trial, change: float, like: Trial) -> Floats | None:
        """Return the first column if the law's own spring changed with its stroke, (n,), N.

        None if it has no spring that moves independently, or if that motion would diverge.

        Args:
            ctx: the quantities on which it depends.
            trial: its shape.
            change: relative increase of the spring's stiffness at one rms of the stroke.
            like: the shape whose stroke is used.
        """
        return None

    def forms_begun(self, ctx: Context, trial: Trial) -> Sequence[Trial]:
        """Return the forms in which an effect of this shape may begin in mid-recording."""
        return [trial]

    def begun(self, ctx: Context, columns: list[Floats], t0: float) -> list[Floats]:
        """Return its columns, each (n,), N, for an effect that begins at ``t0``, s."""
        switch = 0.5 * (1.0 + np.tanh((ctx.t - t0) / SWITCH_S))
        return [c * switch for c in columns]

    def carried(self, ctx: Context, trial: Trial, force: Floats) -> Floats:
        """Return how a sensor effect that `carries` displays a force on the specimen, (n,), N."""
        return force

    def reading(
        self, ctx: Context, trial: Trial, forces: Callable[[Context], list[Floats]]
    ) -> list[Floats]:
        """Return how a sensor effect that `carries` displays forces along a motion, each (n,), N.

        Args:
            ctx: the recording.
            trial: the shape of this effect.
            forces: gives the forces along the motion of a context, each (n,), N.
        """
        return [self.carried(ctx, trial, force) for force in forces(ctx)]

    def rounded(self, trial: Trial, least: float) -> Trial:
        """Return the shape with a transition over velocity at least ``least`` wide, m/s."""
        return trial

    def sharp(self, trial: Trial) -> Trial:
        """Return the shape as a simulated body is tried with first.

        With a transition of zero width over velocity, which does not creep, and an elastic contact
        with a sharp corner: an estimated motion makes a step wide, and a contact round or lossy.
        """
        return trial

    def like(self, trial: Trial) -> Trial:
        """Return the shape of this law nearest to one of `also`, or of a law that contains it."""
        return trial

    def beyond(self, plain: Trial, trial: Trial) -> Trial:
        """Return a shape of this law in which what it has in common with `plainer` is as there."""
        return trial

    def shears(self, trial: Trial) -> bool:
        """Return whether it is dry friction of a contact that shears before it slips."""
        return False

    def kin(self, trial: Trial) -> Sequence[Trial]:
        """Return the law in the other forms that its memory may have, with the same parameters.

        For a law of the path, whose forms are not functions of the current x and v.
        """
        return ()

    def holds_n_per_m(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return its stiffness before it yields or slides, in addition to the model's; 0: none."""
        return 0.0

    def elastic_until_m(self, trial: Trial) -> float:
        """Return the displacement at which it yields or slides, m; infinite if it never does."""
        return float("inf")

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the parameters by name from linear coefficients and shape."""
        return {self.params[0].name: float(beta[0])}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the form of the law in a few words, among those that share the effect's name."""
        return self.equation

    @property
    def number_at_last(self) -> str:
        """The number of the model that it changes at the end of a recording."""
        return self.number

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return whether the coefficients are physically possible; signs are already checked."""
        return True

    def restates(self, trial: Trial) -> bool:
        """Return whether it only changes a number that the model states, if that is its effect."""
        return not self.late

    def borders(self, trial: Trial) -> str:
        """Return the name of the law to which a fitted shape has degenerated; empty: none."""
        return ""

    def settings(
        self, ctx: Context, trial: Trial
    ) -> tuple[tuple[str, tuple[float | None, ...]], int]:
        """Return (signs, pinned) and how many parameters count as fitted."""
        signs = self.signs
        pinned = self.pinned if self.pinned is not None else (None,) * len(signs)
        return (signs, pinned), len(self.params)

    def limits(self, ctx: Context, trial: Trial) -> list[tuple[float, float]]:
        """Return the allowed range of each shape parameter."""
        return [(abs(value) / 30.0, abs(value) * 30.0) for value in trial.theta]

    def offset_s(self, trial: Trial) -> float:
        """Return by how much the effect shifts the load cell's rows in time, s; 0 for most."""
        return 0.0

    def settling_s(self, trial: Trial) -> float:
        """Return the time of its own against which slow motion makes it act like `plainer`, s.

        0: none does.
        """
        return 0.0

    def steps(self, ctx: Context, trial: Trial) -> list[float]:
        """Return the relative change of each shape parameter over which slopes are taken."""
        return [1e-3] * len(trial.theta)

    def of_loop(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the relative change that it causes in the stiffness of a yielding model's loop."""
        return 0.0

    def mass_kg(self, beta: Floats) -> float | None:
        """Return the mass that the effect adds to a freely moving body, None if it adds none."""
        return None

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the effect as elements of the core, or None if there are none (sensor effects)."""
        return None

    def on_a_body(
        self, ctx: Context, trial: Trial, beta: Floats
    ) -> list[core.ElementConfig] | None:
        """Return the same for a freely moving body, whose dry friction may have zero width."""
        return self.elements(ctx, trial, beta)
