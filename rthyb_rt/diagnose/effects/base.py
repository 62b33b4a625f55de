"""What an effect is: a force law that may have been left out of a model.

An effect is a class of its own with a name, parameters, an equation, and `columns`: its force per
unit of each linear coefficient, for shape parameters ``theta`` that enter nonlinearly. The search
finds the coefficients by least squares, scans `trials` for theta, and refines what it keeps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core.diagnosis_models import Motion
from rthyb_rt.diagnose.case import Family, Model

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Param:
    """A parameter as it is reported: name with unit, unit, allowed range."""

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True)
class Context:
    """What a force law may depend on: the motion, the model, other channels.

    Attributes:
        model: the baseline.
        motion: x, v, a, each (n,).
        t: time, (n,), s.
        force: the force that was measured, for effects of the sensor, (n,), N.
        other: further channels by name.
    """

    model: Model
    motion: Motion
    t: Floats
    force: Floats
    other: dict[str, Floats]
    ranges: tuple[float, float, float] | None = None

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
        """Largest velocity but for one row in a hundred, m/s."""
        return self.ranges[1] if self.ranges else float(np.quantile(np.abs(self.v), 0.99)) or 1e-6

    @cached_property
    def f_range(self) -> float:
        """Largest force, N."""
        return self.ranges[2] if self.ranges else float(np.max(np.abs(self.force))) or 1.0

    @cached_property
    def all_ranges(self) -> tuple[float, float, float]:
        """The ranges, to be kept while this law is evaluated along another motion."""
        return (self.x_range, self.v_range, self.f_range)

    @cached_property
    def travel(self) -> Floats:
        """Path covered so far, m."""
        return np.cumsum(np.abs(np.diff(self.x, prepend=self.x[0])))

    @cached_property
    def k_free(self) -> bool:
        """Whether the stiffness is free to be refitted."""
        return self.model.k_tol is None

    @cached_property
    def k_scale(self) -> float:
        """A stiffness of the specimen's order, N/m."""
        return max(abs(self.model.k), 1e-3 * self.f_range / self.x_range)

    def unit(self, kind: str, **params: float) -> Floats:
        """Return the force of one element of the core along the motion, N."""
        element = core.Element(core.element(kind, **params))
        return element.run(self.x, self.v, self.a, self.dt)


SWITCH_S = 0.005
"""Time in which an effect is switched on in mid-record: a search by slopes needs one."""
Theta = tuple[float, ...]


@dataclass(frozen=True)
class Trial:
    """One shape of an effect to be tried: a variant of its law and its shape parameters."""

    theta: Theta = ()
    variant: str = ""


class Effect:
    """Base of every effect on the force.

    Class attributes:
        name: as in the answer.
        plain: as a laboratory calls it; empty: by its name.
        phrase: the same with its size, ``"a gap of {gap_m}"``: `words.Size` says what may stand in
            the braces. Empty: plain, with all parameters.
        params: what is reported.
        equation: the law in one line.
        fingerprint: what it looks like in a residual.
        shown_by: the kind of experiment that shows it best, and why.
        sensor: it sits in the load cell's chain: not felt by the specimen.
        momentary: its force follows from x and v of the moment alone, so that a closed loop can be
            simulated with it though the core has no element for it.
        carries: of a sensor, which passes on what others do to the specimen in its own way.
        elastic: its force follows from the displacement of the moment alone.
        dissipates: it takes energy out of a motion at every moment, and stores none.
        yields: its spring gives way by plastic flow.
        complete: a joint law that no other effect of the specimen stands beside.
        begins: it may begin in mid-record; not where all of the past is in it anyhow.
        late: it begins in mid-record.
        number: the number of the model (`case.Model`) that it moves; empty: none.
        static: it shows where a recording's time is nominal.
        dry: it is dry friction in one of its forms.
        plainer: the law that it goes over into, by name; so that it is named instead where this one
            does no better.
        slow_as: the law that a slow motion does not tell it from, by name.
        relaxes: its first shape parameter is the time in which its force fades, s.
        slides: it is sliders in a row, of which any number is a form of one.
        also: the law that is this one by another name, beside a spring of free stiffness.
        of_spring: its parameter that counts as a part of the spring there is.
        replaces_spring: its element holds the model's spring as well.
        many_springs: it is simulated as many elements, or goes through its force anew.
        zero: it is the zero of the load cell, which a rig file has.
        wanders: it is a zero that does not stay.
        on_body: families in which, without a load cell, it stands for a force on the body.
        needs: a channel without which it does nothing.
        foretold: what it does to another recording can be said.
        over: what it is a line over where that is neither displacement nor velocity: "a", "t",
            "rate" of the force, or "fy".
        signs: one a linear coefficient: '+', '-' or '*' for any.
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
    dissipates = False
    yields = False
    complete = False
    begins = True
    late = False
    number: str = ""
    static = False
    dry = False
    plainer = ""
    slow_as = ""
    relaxes = False
    slides = False
    also = ""
    of_spring = ""
    replaces_spring = False
    many_springs = False
    zero = False
    wanders = False
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
        """Return the first column were the law's own spring to change with its stroke, (n,), N.

        None where it has no spring that moves by itself, or that motion would run away.

        Args:
            ctx: what it depends on.
            trial: its shape.
            change: part of its stiffness that the spring gains by one rms of the stroke.
            like: the shape whose stroke that is.
        """
        return None

    def forms_begun(self, ctx: Context, trial: Trial) -> Sequence[Trial]:
        """Return the forms in which an effect of this shape may begin in mid-record."""
        return [trial]

    def begun(self, ctx: Context, columns: list[Floats], t0: float) -> list[Floats]:
        """Return its columns, each (n,), N, for an effect that begins at ``t0``, s."""
        switch = 0.5 * (1.0 + np.tanh((ctx.t - t0) / SWITCH_S))
        return [c * switch for c in columns]

    def carried(self, ctx: Context, trial: Trial, force: Floats) -> Floats:
        """Return what a sensor that `carries` shows of a force on the specimen, (n,), N."""
        return force

    def rounded(self, trial: Trial, least: float) -> Trial:
        """Return the shape with a step over velocity no sharper than ``least``, m/s."""
        return trial

    def sharp(self, trial: Trial) -> Trial:
        """Return the shape with a step over velocity of no width: what sticks does not creep."""
        return trial

    def like(self, trial: Trial) -> Trial:
        """Return the shape that is the same force as `also` in one of its own."""
        return trial

    def holds_n_per_m(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return the stiffness that it has before it gives way, beside the model's; 0: none."""
        return 0.0

    def report(self, ctx: Context, trial: Trial, beta: Floats) -> dict[str, float]:
        """Return the parameters by name from linear coefficients and shape."""
        return {self.params[0].name: float(beta[0])}

    def form(self, ctx: Context, trial: Trial) -> str:
        """Return the law itself in a few words: which of those that share the effect's name."""
        return self.equation

    def sensible(self, ctx: Context, trial: Trial, beta: Floats) -> bool:
        """Return whether the coefficients make a physical law; signs are checked already."""
        return True

    def borders(self, trial: Trial) -> str:
        """Return the law, by name, that a fitted shape has come up against; empty: none."""
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

    def of_loop(self, ctx: Context, trial: Trial, beta: Floats) -> float:
        """Return by what part of its stiffness it changes the loop of a model that yields."""
        return 0.0

    def mass_kg(self, beta: Floats) -> float | None:
        """Return the mass that the effect is to a body that moves freely, None where it is none."""
        return None

    def elements(self, ctx: Context, trial: Trial, beta: Floats) -> list[core.ElementConfig] | None:
        """Return the effect as elements of the core, or None where it has none (sensor side)."""
        return None

    def on_a_body(
        self, ctx: Context, trial: Trial, beta: Floats
    ) -> list[core.ElementConfig] | None:
        """Return the same for a body that moves freely, whose dry friction may have no width."""
        return self.elements(ctx, trial, beta)
