"""The benchmark's structures, motions, rates, plants and entrants."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from rthyb_rt import config, ground_motion
from rthyb_rt.benchmark import plants
from rthyb_rt.config import RigFile, TestFile
from rthyb_rt.config.rigfile import ServoValve
from rthyb_rt.core.laws import LAWS, LawDescription
from rthyb_rt.errors import InputError
from rthyb_rt.ground_motion import GroundMotion

STIFFNESS_N_PER_M: Final = (
    (2.6054884e7, -2.3133939e7, 0.5937035e7),
    (-2.3133939e7, 3.2560774e7, -1.4419971e7),
    (0.5937035e7, -1.4419971e7, 0.9267276e7),
)
"""Stiffness of the whole structure, three storeys; the specimen is part of the first one."""


@dataclass(frozen=True)
class ReferenceStructure:
    """A reference structure: mass of each storey, damping ratio of each mode (Table 1)."""

    mass_kg: float
    damping_ratio: float


CASES: Final = {
    1: ReferenceStructure(1000, 0.05),
    2: ReferenceStructure(1100, 0.04),
    3: ReferenceStructure(1300, 0.03),
    4: ReferenceStructure(1000, 0.03),
}

MOTIONS: Final = {
    "elcentro": "rths-elcentro",
    "kobe": "rths-kobe",
    "morgan": "rths-morgan-hill",
}
"""Built-in records of the three motions, including rest; all are scaled by `SCALE`."""
SCALE: Final = 0.4

SEEDS: Final = tuple(range(7001, 7021))
"""Seeds of the perturbed plants; the benchmark requires 20."""

BENCHMARK_HZ: Final = 4096
RATES: Final = {BENCHMARK_HZ: 1, 1024: 0}
"""Sample rates, and the delay of the force in the numerical part in samples: one in the benchmark's
model, none in the order of a test of this program."""

HELD: Final = 0.5
"""Mean delay, in samples, of a force that is held over one sample."""

WITH_FORCE: Final = "+rfc"
"""Suffix of the name of a law published without it: with the restoring-force compensator."""
FORCE_CUTOFF_HZ: Final = 60.0
"""Cut-off of its low-pass on x_c - x_m: slightly below the plant's first resonance, 67 Hz."""

QUICK: Final[Mapping[str, dict[str, float]]] = {"inverse": {"inverse.memory_s": 0.6}}
QUICK_CUTOFF_HZ: Final = 30.0
"""By law, a shorter memory than the default of 1 s, and a lower cut-off than its 60 Hz: one setting
for all runs, at either rate. A yielding specimen is followed faster (J4 at 1024 Hz, case 1, from
2.72 to 2.64 %), and with the elastic one, for which estimates scatter more, J4 changes by at most
.01."""

BASELINE: Final = "pi-lead"


@dataclass(frozen=True)
class Entrant:
    """An entrant: a control law with its settings, on a rig that may have its own loop.

    Attributes:
        name: name in the table.
        law: ``controller.type``.
        settings: settings of the law, by key; others come from the rig or are defaults.
        rfc: whether the restoring-force compensator is used; it knows the delay of the force.
        cutoff_hz: cut-off of its low-pass; None: default.
        loop: kp and ki of the drive's own loop, 1 and 1/s, or None.
    """

    name: str
    law: str
    settings: Mapping[str, float] = field(default_factory=dict)
    rfc: bool = False
    cutoff_hz: float | None = None
    loop: tuple[float, float] | None = None


def entrant(name: str) -> Entrant:
    """Return the entrant with this name: the benchmark's own controller, or a control law.

    ``pi-lead`` is the benchmark's: 2 + 95/s in the drive, preceded by 50.8 (s + 168.6) / (s +
    8570), whose static gain, .9994, is taken as 1. ``ats`` starts with the coefficients from the
    rig's sweep, and ``third-order`` keeps them: with those of the set-up file of ``ats``, a2 = a1^2
    / 2, the loop is unstable at 67 Hz until it has learnt. ``amb`` starts with its published
    coefficients, those of the actuator without the specimen. ``inverse`` learns with `QUICK`. With
    the suffix `WITH_FORCE`, a law published by others also has the restoring-force compensator.

    Raises:
        InputError: there is no such entrant.
    """
    if name == BASELINE:
        lead = {"zhao.tau_s": 1.0 / 168.6, "zhao.filter_s": 1.0 / 8570.0}
        return Entrant(name, "zhao", lead, loop=(2.0, 95.0))
    law, force = name.removesuffix(WITH_FORCE), name.endswith(WITH_FORCE)
    with_rfc = law in LAWS and LAWS[law].with_rfc
    if law not in LAWS or (force and with_rfc):
        raise InputError(
            f"found {name!r}; must be {BASELINE}, the benchmark's own controller, or a control "
            f"law: {', '.join(LAWS)}; a law without force compensation of its own may be "
            f"followed by {WITH_FORCE}",
            "--law",
        )
    settings = started(LAWS[law]) | QUICK.get(law, {})
    cutoff_hz = FORCE_CUTOFF_HZ if force else QUICK_CUTOFF_HZ if law in QUICK else None
    return Entrant(name, law, settings, rfc=force or with_rfc, cutoff_hz=cutoff_hz)


ORDERS: Final = {"second-order": 2, "third-order": 3}
"""Orders of the inverse with which a law may ask to be started."""


def started(law: LawDescription) -> dict[str, float]:
    """Return the initial values with which a law asks to be started in the benchmark."""
    if law.benchmark_start == "table":
        from_rig = [p for p in law.parameters if p.rig_key]
        return {p.key: p.default for p in from_rig if p.default is not None}
    if law.benchmark_start not in ORDERS:
        return {}
    a0, a1, *more = swept_inverse(plants.nominal(), ORDERS[law.benchmark_start])
    found = {"a0": a0, "a1_s": a1}
    found |= {f"a{n}_share": a / a1**n for n, a in enumerate(more, 2)}
    lasts = {p.key: p.key.rpartition(".")[2] for p in law.parameters}
    return {key: found[last] for key, last in lasts.items() if last in found}


def entrants() -> tuple[Entrant, ...]:
    """Return all entrants, the benchmark's own controller first.

    Every law takes part that needs no value from a test file.
    """
    laws = [name for name, law in LAWS.items() if law.runs_unset]
    names = (BASELINE, *laws, *(f"{law}{WITH_FORCE}" for law in ("amb", "ats")))
    return tuple(entrant(name) for name in names)


SWEPT_HZ: Final = 10.0
"""Frequency up to which a low order is fitted: near the structure's first two modes, and far below
the first resonance of the plant."""


def swept_inverse(rig: RigFile, order: int) -> tuple[float, ...]:
    """Return a0, a1 (s), a2 (s^2) ... of the inverse a0 + a1 s + a2 s^2 ... from a sweep.

    Least squares over the tones up to `SWEPT_HZ` of |G (a0 + a1 s + a2 s^2 ...) - 1|, with G the
    identified response.

    Args:
        rig: the rig with its identified response.
        order: the highest power of s.

    Raises:
        InputError: the rig file has no sweep.
    """
    found = rig.identified
    if found is None or not found.frequency_hz:
        raise InputError(
            "the sweep is missing; run `rthyb identify` and use the rig file it writes",
            f"rig {rig.rig.name}",
        )
    s = 2j * np.pi * np.array(found.frequency_hz)
    gain = np.array(found.amplitude) * np.exp(-s * np.array(found.delay_at_frequency_s))
    slow = np.array(found.frequency_hz) <= SWEPT_HZ
    s, gain = s[slow], gain[slow]
    scale = float(np.abs(s).max())
    columns = gain[:, None] * np.vander(s / scale, order + 1, increasing=True)
    rows = np.concatenate([columns.real, columns.imag])
    wanted = np.concatenate([np.ones(s.size), np.zeros(s.size)])
    found = np.linalg.lstsq(rows, wanted, rcond=None)[0]
    return tuple(float(value) / scale**power for power, value in enumerate(found))


@functools.cache
def motion(name: str) -> GroundMotion:
    """Return one of `MOTIONS`, not scaled.

    Raises:
        InputError: no motion has this name.
    """
    if name not in MOTIONS:
        raise InputError(f"found {name!r}; must be one of {', '.join(MOTIONS)}", "--motion")
    return ground_motion.load(MOTIONS[name])


def test_of(who: Entrant, case: int, rate_hz: int) -> TestFile:
    """Return the test file of a run: the whole structure, from which the specimen is subtracted.

    Args:
        who: the entrant.
        case: one of `CASES`.
        rate_hz: one of `RATES`.

    Raises:
        InputError: with the errors in it.
    """
    nominal, structure = plants.nominal(), CASES[case]
    late_s = (RATES[rate_hz] + HELD) / rate_hz
    known = {item.element: item for item in nominal.specimen}
    test = f"""schema = "rthyb-test/1"
rig = "rths-benchmark"
test = {{ name = "rths-case-{case}", sample_rate_hz = {rate_hz}, free_vibration_s = 0 }}
[ground_motion]
record = "rths-elcentro"
factor = {SCALE}
interpolation = "linear"
[numerical.matrices]
m_kg = {[structure.mass_kg] * 3}
k_n_per_m = {[list(row) for row in STIFFNESS_N_PER_M]}
damping_ratios = [{structure.damping_ratio}]
integrator = "rk4"
force_delay_samples = {RATES[rate_hz]}
[numerical.matrices.specimen]
mass_kg = {getattr(known["inertia"], "m_kg", 0.0)}
damping_n_s_per_m = {getattr(known["viscous"], "c_n_s_per_m", 0.0)}
[controller]
type = "{who.law}"
rfc = {{ enabled = {str(who.rfc).lower()}, force_lateness_s = {late_s if who.rfc else 0.0} }}
"""
    file = config.parse_test(test, f"benchmark case {case}")
    own = file.controller.with_settings(who.settings)
    if who.cutoff_hz is not None:
        low_passed = own.rfc.model_copy(update={"cutoff_hz": who.cutoff_hz})
        own = own.model_copy(update={"rfc": low_passed})
    return file.model_copy(update={"controller": own})


YIELD_M: Final = 1e-3
"""Yield displacement of the yielding specimen: Bouc-Wen with ratio .1, exponent 2.5, weights .1 and
.9, as in the nonlinear example of Galmez and Fermandois (2022)."""
POST_YIELD_RATIO: Final = 0.1
EXPONENT: Final = 2.5
SHARE: Final = 0.1
YIELDING_SUBSTEPS: Final = 64
"""Per sample of 1/1024 s: the yielding force is held over one substep, which reduces the damping of
the plant; with twice as many, no criterion changes by more than .1 points."""


def rig_of(
    who: Entrant,
    seed: int | None,
    rate_hz: int,
    *,
    width: float = 1.0,
    yielding: bool = False,
    noise: float = 1.0,
) -> RigFile:
    """Return the plant of a run, with its sensors at that rate.

    The noise of the sensors has the same density at every rate. What was measured at rest, which
    the laws are set by, grows with it; the identified response does not.

    Args:
        who: the entrant, whose drive may have a loop.
        seed: seed of a perturbed plant; None: the nominal one.
        rate_hz: one of `RATES`.
        width: factor on the stated standard deviations.
        yielding: whether the specimen's stiffness is a Bouc-Wen loop.
        noise: factor on the benchmark's density of noise.
    """
    rig = plants.nominal() if seed is None else plants.drawn(seed, width)
    if who.loop is not None and isinstance(rig.actuator, ServoValve):
        kp, ki = who.loop
        loop = {"loop_kp": kp, "loop_ki_per_s": ki}
        rig = rig.model_copy(update={"actuator": rig.actuator.model_copy(update=loop)})
    if yielding:
        rig = _yielding(rig)
    return _with_noise(rig, noise * (rate_hz / BENCHMARK_HZ) ** 0.5)


def _with_noise(rig: RigFile, share: float) -> RigFile:
    sensors, found = rig.sensors, rig.identified
    displacement = {"noise_std_m": share * sensors.displacement.noise_std_m}
    force = {"noise_std_n": share * sensors.force.noise_std_n}
    quieter = {
        "displacement": sensors.displacement.model_copy(update=displacement),
        "force": sensors.force.model_copy(update=force),
    }
    update: dict[str, object] = {"sensors": sensors.model_copy(update=quieter)}
    if found is not None:
        noise = {
            key: None if value is None else share * value
            for key, value in (
                ("rest_noise_displacement_m", found.rest_noise_displacement_m),
                ("rest_noise_force_n", found.rest_noise_force_n),
            )
        }
        update["identified"] = found.model_copy(update=noise)
    return rig.model_copy(update=update)


def _yielding(rig: RigFile) -> RigFile:
    k_n_per_m = sum(e.k_n_per_m for e in rig.specimen if e.element == "stiffness")
    per_m = 1.0 / YIELD_M**EXPONENT
    loop = config.rigfile.HysteresisElement(
        element="hysteresis",
        k_n_per_m=k_n_per_m,
        post_yield_ratio=POST_YIELD_RATIO,
        eta=EXPONENT,
        b=SHARE * per_m,
        c=(1.0 - SHARE) * per_m,
    )
    others = [item for item in rig.specimen if item.element != "stiffness"]
    actuator = rig.actuator.model_copy(update={"substeps": YIELDING_SUBSTEPS})
    return rig.model_copy(update={"specimen": [loop, *others], "actuator": actuator})
