"""Specimens as materials of OpenSees, and the effects that a diagnosis may call them by.

Right is any of the sets that name the law in the interchange format's words: where a material is
one thing in several of them (a slider is a stick of Dahl's kind, and yields without hardening), any
of these.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from validate.signals import Rng

Sets = tuple[tuple[str, ...], ...]


def _hysteretic(k: float, x: float, level: float, damage: float, softer: float) -> list[float]:
    """Numbers of `Hysteretic`, hardening by 5 %; pinched at this part of the force, not at 1."""
    xy = 0.15 * x
    ends = (xy, 0.6 * x, 3.0 * x)
    points = [v for far in ends for v in (k * (xy + 0.05 * (far - xy)), far)]
    sides = [*points, *(-v for v in points)]
    return [*sides, 1.0 if level == 1.0 else 1.0 - level, level, 0.0, damage, softer]


@dataclass(frozen=True)
class Material:
    """One specimen.

    Attributes:
        name: of what it is.
        right: sets of effects that say so; empty: outside the catalogue, or nothing.
        make: creates material 1 in OpenSees, given the initial stiffness, the largest displacement,
            the largest velocity, and what draws its numbers.
        verdict: `explained`, `none` or `unknown`.
    """

    name: str
    right: Sets
    make: Callable[[Any, float, float, float, Rng], None]
    verdict: str = "explained"


def _beside(ops: Any, k: float, kind: str, *values: float) -> None:
    """A spring and one more material, in parallel."""
    ops.uniaxialMaterial("Elastic", 2, k)
    ops.uniaxialMaterial(kind, 3, *values)
    ops.uniaxialMaterial("Parallel", 1, 2, 3)


def _steel01(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    xy = x * rng.uniform(0.15, 0.5)
    ops.uniaxialMaterial("Steel01", 1, k * xy, k, rng.uniform(0.01, 0.15))


def _steel02(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    xy = x * rng.uniform(0.15, 0.4)
    bend = (rng.uniform(10, 20), 0.925, 0.15)
    ops.uniaxialMaterial("Steel02", 1, k * xy, k, rng.uniform(0.01, 0.1), *bend)


def _elastic_plastic(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    ops.uniaxialMaterial("ElasticPP", 1, k, x * rng.uniform(0.2, 0.6))


def _slider(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    stick = k * rng.uniform(3, 20)
    _beside(ops, k, "ElasticPP", stick, k * x * rng.uniform(0.03, 0.15) / stick)


def _stop(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    at, way = x * rng.uniform(0.4, 0.7), 1.0 if rng.random() < 0.5 else -1.0
    ks = k * rng.uniform(0.3, 2.0)
    _beside(ops, k, "ElasticPPGap", ks, way * 1e3 * k * x, way * at)


def _dashpot(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    _beside(ops, k, "Viscous", k * x * rng.uniform(0.05, 0.2) / v, 1.0)


def _damper(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    power = float(rng.choice([0.3, 0.5, 0.7]))
    _beside(ops, k, "Viscous", k * x * rng.uniform(0.05, 0.2) / v**power, power)


def _braced_damper(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    power = float(rng.choice([0.3, 0.5, 1.0]))
    values = (k * rng.uniform(0.3, 1.5), k * x * rng.uniform(0.1, 0.4) / v**power, power)
    _beside(ops, k, "ViscousDamper", *values)


def _pinched(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    numbers = _hysteretic(k, x, rng.uniform(0.15, 0.4), 0.0, rng.choice([0.0, 0.3, 0.5]))
    ops.uniaxialMaterial("Hysteretic", 1, *numbers)


def _peak_oriented(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    numbers = _hysteretic(k, x, 1.0, 0.0, rng.choice([0.0, 0.3, 0.5]))
    ops.uniaxialMaterial("Hysteretic", 1, *numbers)


def _worn(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    numbers = _hysteretic(k, x, 1.0, rng.uniform(0.02, 0.05), 0.0)
    ops.uniaxialMaterial("Hysteretic", 1, *numbers)


def _bouc_wen(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    xy, alpha = x * rng.uniform(0.2, 0.5), rng.uniform(0.05, 0.3)
    size = 0.5 / xy
    numbers = (alpha, k, 1.0, size, size, 1.0, 0.0, 0.0, 0.0)
    ops.uniaxialMaterial("BoucWen", 1, *numbers)


def _rocking(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    _elastic_in_two_lines(ops, k, x * rng.uniform(0.3, 0.6), x, rng.uniform(0.05, 0.6))


def _stop_on_both_sides(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    _elastic_in_two_lines(ops, k, x * rng.uniform(0.3, 0.7), x, rng.uniform(1.3, 3.0))


def _elastic_in_two_lines(ops: Any, k: float, at: float, x: float, after: float) -> None:
    far = (at, 4.0 * x)
    force = [k * at, k * (at + after * (far[1] - at))]
    lines = ([-far[1], -far[0], 0.0, *far], [-force[1], -force[0], 0.0, *force])
    ops.uniaxialMaterial("ElasticMultiLinear", 1, "-strain", *lines[0], "-stress", *lines[1])


def _two_sliders(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    ops.uniaxialMaterial("Elastic", 2, 0.2 * k)
    ops.uniaxialMaterial("ElasticPP", 3, 0.5 * k, x * rng.uniform(0.1, 0.25))
    ops.uniaxialMaterial("ElasticPP", 4, 0.3 * k, x * rng.uniform(0.35, 0.6))
    ops.uniaxialMaterial("Parallel", 1, 2, 3, 4)


def _flag(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    force = k * x * rng.uniform(0.2, 0.4)
    numbers = (k, k * rng.uniform(0.02, 0.1), force, rng.uniform(0.3, 0.8))
    ops.uniaxialMaterial("SelfCentering", 1, *numbers)


def _elastic(ops: Any, k: float, x: float, v: float, rng: Rng) -> None:
    ops.uniaxialMaterial("Elastic", 1, k)


LOOP: Sets = (("hysteresis",),)
ALL_THREE = ("degradation", "hysteresis", "pinching")
WORN: Sets = (("degradation", "hysteresis"), ALL_THREE)
MATERIALS = (
    Material("steel, two lines", LOOP, _steel01),
    Material("slider beside a spring", (("coulomb",), ("lugre",), *LOOP), _slider),
    Material("pinched joint", (("hysteresis", "pinching"), ALL_THREE), _pinched),
    Material("stop on one side", (("stopper",),), _stop),
    Material("damper on a brace", (("maxwell",), ("maxwell", "power_damping")), _braced_damper),
    Material("steel, rounded", LOOP, _steel02),
    Material("nothing missing", (), _elastic, "none"),
    Material("peak-oriented joint", WORN, _peak_oriented),
    Material("dashpot", (("viscous",),), _dashpot),
    Material("elastic-plastic", LOOP, _elastic_plastic),
    Material("rocking", (("cubic",),), _rocking),
    Material("stop on both sides", (("stopper",),), _stop_on_both_sides),
    Material("Bouc-Wen", LOOP, _bouc_wen),
    Material("damper", (("power_damping",),), _damper),
    Material("worn joint", WORN, _worn),
    Material("two sliders and a spring", LOOP, _two_sliders),
    Material("self-centering brace", (), _flag, "unknown"),
)
