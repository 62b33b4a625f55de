"""How far a test moves on when it is held or ramped out at any instant of its reference."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt import core
from rthyb_rt.config import STANDARD, STANDARD_HZ, Rate
from rthyb_rt.lab import experiment

if TYPE_CHECKING:
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]

TURN_S, LEAST_TURN_S = 16 / STANDARD_HZ, 2 / STANDARD_HZ
"""Time in which the deceleration builds up and fades: csrc/station.c, station_ticks."""

_PIECES = 33
"""Points at which a braking path is evaluated."""
_INSTANTS = 8
"""Number of worst instants, each by displacement and by force, that are simulated."""
_APART = 16
"""Least ticks between two of them: direct neighbours of the worst are almost equal to it."""


@dataclass(frozen=True)
class BrakingCourse:
    """Displacement, velocity and acceleration of a command at every tick, (n,), m and s.

    Both derivatives are those that the station knows when it begins to brake.
    """

    x: Floats
    v: Floats
    a: Floats

    @classmethod
    def of(cls, x_m: ArrayLike, rate: Rate = STANDARD) -> BrakingCourse:
        """Return the course of displacements at a rate; it begins at rest."""
        h = rate.period_s
        x = np.asarray(x_m, dtype=np.float64)
        padded = np.concatenate([np.full(2, x[0] if x.size else 0.0), x])
        a = np.diff(padded, 2) / h**2
        v = np.diff(padded)[1:] / h + 0.5 * h * a
        return cls(x, v, a)


@dataclass(frozen=True)
class Brake:
    """The braking path from one state or from many, as planned by `brake` of csrc/station.c.

    The acceleration changes from ``a`` to ``end_a`` in ``turn_s``, is constant for ``steady_s``,
    and changes to 0 in ``turn_s``.
    """

    x: Floats
    v: Floats
    a: Floats
    end_a: Floats
    turn_s: Floats
    steady_s: Floats

    @classmethod
    def of(
        cls,
        x: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        most_m_per_s2: float,
        rate: Rate = STANDARD,
    ) -> Brake:
        """Return the brake with a given deceleration, at a rate."""
        h, most = rate.period_s, most_m_per_s2
        way = np.where(np.asarray(v) < 0, -1.0, 1.0)
        speed, ahead = np.abs(v), np.clip(way * np.asarray(a), -most, most)
        soon = np.clip(speed / (most - ahead / 2) / h, rate.ticks(LEAST_TURN_S), rate.ticks(TURN_S))
        turn = h * np.floor(soon)
        rest = np.maximum((speed + ahead * turn / 2) / most - turn, 0)
        steady = h * np.ceil(rest / h - 1e-9)
        needed = (speed + ahead * turn / 2) / (turn + steady)
        return cls(
            np.asarray(x), np.asarray(v), way * ahead, -way * needed, turn, np.asarray(steady)
        )

    @property
    def lasts_s(self) -> Floats:
        """Total duration."""
        return np.asarray(2 * self.turn_s + self.steady_s)

    def at(self, t_s: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Return displacement, velocity and acceleration at times after the beginning."""
        x, v, a, left = self.x, self.v, self.a, np.asarray(t_s, np.float64)
        zero = np.zeros_like(self.end_a)
        for lasts, end in (
            (self.turn_s, self.end_a),
            (self.steady_s, self.end_a),
            (self.turn_s, zero),
        ):
            t = np.clip(left, 0, lasts)
            jerk = (end - a) / np.where(lasts > 0, lasts, np.inf)
            x = x + t * (v + t * (a / 2 + t * jerk / 6))
            v, a, left = v + t * (a + t * jerk / 2), a + t * jerk, left - t
        return x, v, a


@dataclass(frozen=True)
class RunOn:
    """Farthest point of a test that is braked at the worst instant of its reference.

    Attributes:
        brake_m_per_s2: the deceleration.
        displacement_m, displacement_at_s: greatest displacement, and when its braking begins.
        force_n, force_at_s: the same for the force of the specimen's elements.
    """

    brake_m_per_s2: float
    displacement_m: float
    displacement_at_s: float
    force_n: float
    force_at_s: float


def run_on(setup: Setup) -> RunOn:
    """Brake the reference simulation of a test at every tick and return the worst case.

    Args:
        setup: the test, with its reference.
    """
    limits = setup.derived.limits
    most = limits.brake_acceleration_m_per_s2 or limits.path_acceleration_m_per_s2
    rate = setup.rate
    course = BrakingCourse.of(setup.reference["x_ref_m"], rate)
    brakes = Brake.of(course.x, course.v, course.a, most, rate)
    shares = np.linspace(0, 1, _PIECES)
    reach = np.max([np.abs(brakes.at(u * brakes.lasts_s)[0]) for u in shares], axis=0)
    # Candidates are found with the elastic stiffness, then simulated with the elements.
    k_e = setup.derived.k_e_n_per_m
    elastic = np.abs(setup.reference["f_ref_n"] + k_e * (brakes.at(brakes.lasts_s)[0] - course.x))
    instants = sorted({*_worst(reach), *_worst(elastic)})
    forces = [_force(setup, course, n, most) for n in instants]
    furthest, strongest = int(np.argmax(reach)), int(np.argmax(forces))
    return RunOn(
        brake_m_per_s2=most,
        displacement_m=float(reach[furthest]),
        displacement_at_s=furthest * rate.period_s,
        force_n=forces[strongest],
        force_at_s=instants[strongest] * rate.period_s,
    )


def _worst(values: Floats) -> list[int]:
    """Return the ticks of the greatest values, at some distance from each other."""
    left, found = values.copy(), list[int]()
    for _ in range(min(_INSTANTS, math.ceil(values.size / _APART))):
        n = int(np.argmax(left))
        found.append(n)
        left[max(n - _APART, 0) : n + _APART + 1] = -np.inf
    return found


def _force(setup: Setup, course: BrakingCourse, n: int, most_m_per_s2: float) -> float:
    """Return the greatest force of the specimen while braking from tick n."""
    h = setup.rate.period_s
    brake = Brake.of(course.x[n], course.v[n], course.a[n], most_m_per_s2, setup.rate)
    ticks = round(float(brake.lasts_s) / h)
    way = brake.at(h * np.arange(1, ticks + 1))
    x, v, a = (
        np.concatenate([before[: n + 1], after])
        for before, after in zip((course.x, course.v, course.a), way, strict=True)
    )
    total = sum(
        core.CoreElement(one).run(x, v, a, h) for one in experiment.reference_elements(setup)
    )
    return float(np.abs(np.asarray(total)[n:]).max(initial=0.0)) if np.size(total) > 1 else 0.0
