"""Runs of the multi-axial benchmark, and their criteria.

"Experimental benchmark control problem on multi-axial real-time hybrid simulation" (Frontiers in
Built Environment, research topic 2023-2025): a frame with one bay in the laboratory, moved by two
coupled actuators.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.benchmark import benchmark_runs, cases, marths_laws
from rthyb_rt.benchmark import marths_frame as frame
from rthyb_rt.core.coupled_plant import CoupledPlant
from rthyb_rt.core.library import STATUS
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]

NOMINAL: Final = benchmark_runs.NOMINAL
RUNAWAY: Final = 1.0
"""Displacement of the interface, m, and rotation, rad, at which a run is considered unstable."""
LOST: Final = STATUS["out_of_range"]
"""Also unstable: no position of the specimen is consistent with its actuators."""


@dataclass(frozen=True)
class MarthsRun:
    """One run.

    Attributes:
        law: one of `marths_laws.NAMES`.
        motion: one of `cases.MOTIONS`, scaled by `cases.SCALE`.
        plant: the seed of a perturbed plant, or `NOMINAL`.
        integrator: integrator of the numerical part, one of `PARTS`.
        width: size of the perturbation, in the benchmark's standard deviations.
        noisy: whether the readings have noise.
    """

    law: str
    motion: str
    plant: int = NOMINAL
    integrator: str = "newmark"
    width: float = 1.0
    noisy: bool = True


@dataclass(frozen=True)
class MarthsOutcome:
    """Result of a run: its figures by name, none if it became unstable."""

    run: MarthsRun
    figures: dict[str, float]

    @property
    def completed(self) -> bool:
        """Whether the run was completed."""
        return bool(self.figures)


@dataclass(frozen=True, eq=False)
class MarthsSignals:
    """Signals of a run; n samples, axes 1 and 2.

    Attributes:
        target_m, reading_m, true_m, command_m: of the actuators, (n, 2) each.
        pose: x and theta from the readings, (n, 2).
        displacement: of the numerical part, (n, 29).
        force: force and moments of the specimen, (n, 3).
    """

    target_m: Floats
    reading_m: Floats
    true_m: Floats
    command_m: Floats
    pose: Floats
    displacement: Floats
    force: Floats

    @classmethod
    def of(cls, samples: int) -> MarthsSignals:
        """Return empty arrays for this number of samples."""
        freedoms = len(frame.numerical().influence)
        return cls(*(np.zeros((samples, width)) for width in (2, 2, 2, 2, 2, freedoms, 3)))

    def put(self, n: int, row: Sequence[Floats]) -> None:
        """Store the values of sample n, in the order of the attributes."""
        for name, value in zip(self.__dataclass_fields__, row, strict=True):
            getattr(self, name)[n] = value


@functools.cache
def ground_motion(name: str) -> Floats:
    """Return the scaled accelerations of a motion up to the time of its last point, m/s2, (n,).

    Raises:
        InputError: no motion has this name.
    """
    record = cases.motion(name)
    time_s = record.time_s
    count = round(float(time_s[-1]) * frame.RATE_HZ) + 1
    at_s = np.arange(count) / frame.RATE_HZ
    return np.asarray(cases.SCALE * np.interp(at_s, time_s, record.acceleration_mps2))


@functools.cache
def reference(motion: str) -> Floats:
    """Return the displacements of the whole frame, (n, 29)."""
    return frame.Newmark(frame.reference()).run(ground_motion(motion))


@functools.cache
def joined(motion: str) -> Floats:
    """Return those of the numerical part joined to the frame model, (n, 29)."""
    return frame.Newmark(frame.joined()).run(ground_motion(motion))


PARTS: Final[dict[str, type[frame.Newmark | frame.KrAlpha]]] = {
    "newmark": frame.Newmark,
    "kr-alpha": frame.KrAlpha,
}
"""Integrators of the numerical part: the benchmark's, and this program's own."""


def simulate(run: MarthsRun) -> MarthsSignals | None:
    """Carry out one run; None if it became unstable.

    Targets, commands and readings of a row belong to the same instant t_n, from which on the
    commands apply to the plant. ``newmark`` computes the targets of t_n from the forces of t_n,
    ``kr-alpha`` from those of the previous sample, as in a test of this program.
    """
    ag = ground_motion(run.motion)
    seed = None if run.plant == NOMINAL else run.plant
    noise_m = frame.NOISE_M if run.noisy else 0.0
    rig = CoupledPlant(frame.plant(seed, run.plant + 1, noise_m, run.width))
    law, tie = marths_laws.compensation(run.law), frame.kinematics()
    part = PARTS[run.integrator](frame.numerical())
    found = MarthsSignals.of(ag.size)
    x = np.zeros(found.displacement.shape[1])
    target, command = np.zeros(2), np.zeros(2)
    for n, ground in enumerate(ag.tolist()):
        reading, force, status = rig.latch()
        if not part.ahead:
            x = part.step(ground, frame.TO_INTERFACE @ force)
            target, _ = tie.axes(_node(x))
            command = np.clip(law.lead(target), -frame.STROKE_M, frame.STROKE_M)
        if status & LOST or not np.abs(x).max() < RUNAWAY:
            return None
        found.put(n, (target, reading, rig.true_m, command, rig.pose, x, force))
        law.observe(command, reading)
        rig.apply(command)
        if part.ahead:
            x = part.step(ground, frame.TO_INTERFACE @ force)
            target, _ = tie.axes(_node(x))
            command = np.clip(law.lead(target), -frame.STROKE_M, frame.STROKE_M)
    return found


# ---- criteria -----------------------------------------------------------------------------------

MEANINGS: Final = {
    "J1": "delay of actuators 1 and 2, ms",
    "J2": "tracking error of actuators 1 and 2, rms, %",
    "J3": "the same, peak, %",
    "J5": "error of x and theta against the numerical part, rms, %",
    "J6": "the same, peak, %",
    "J7": "error of x and theta against the reference, rms, %",
    "J8": "error of x and theta of storeys 2 and 3 against the reference, rms, %",
    "J9": "as J7, peak, %",
    "J10": "as J8, peak, %",
    "true": "J2 without sensor noise, %",
    "joined": "as J7, against the numerical part and the force model solved together, %",
    "joined-upper": "as J8, against the same, %",
    "command": "largest command of actuators 1 and 2, mm",
    "force": "largest force of actuators 1 and 2, kN",
}
"""Meanings of the figures; each has two or four values, numbered from 1. J4 is J1."""

COUNTS: Final = {name: 4 if name in ("J8", "J10", "joined-upper") else 2 for name in MEANINGS}


def figures(run: MarthsRun, signals: MarthsSignals) -> dict[str, float]:
    """Return the figures of a completed run, over the whole record, by name and number."""
    target, reading = signals.target_m, signals.reading_m
    upper = list(frame.UPPER.values())
    storeys = signals.displacement[:, upper]
    node = _node(signals.displacement)
    whole, as_one = reference(run.motion), joined(run.motion)
    found = {
        "J1": [1e3 * _delay(target[:, i], reading[:, i]) / frame.RATE_HZ for i in (0, 1)],
        "J2": _rms(reading - target, target),
        "J3": _peak(reading - target, target),
        "J5": _rms(signals.pose - node, node),
        "J6": _peak(signals.pose - node, node),
        "J7": _rms(signals.pose - _node(whole), _node(whole)),
        "J8": _rms(storeys - whole[:, upper], whole[:, upper]),
        "J9": _peak(signals.pose - _node(whole), _node(whole)),
        "J10": _peak(storeys - whole[:, upper], whole[:, upper]),
        "true": _rms(signals.true_m - target, target),
        "joined": _rms(signals.pose - _node(as_one), _node(as_one)),
        "joined-upper": _rms(storeys - as_one[:, upper], as_one[:, upper]),
        "command": 1e3 * np.abs(signals.command_m).max(axis=0),
        "force": 1e-3 * np.abs(actuator_forces(signals)).max(axis=0),
    }
    return {
        f"{name}.{i + 1}": float(value)
        for name, values in found.items()
        for i, value in enumerate(values)
    }


def actuator_forces(signals: MarthsSignals) -> Floats:
    """Return the forces of the actuators that balance those of the specimen, N, (n, 2)."""
    tie = frame.kinematics()
    found = np.empty_like(signals.reading_m)
    for n, reading in enumerate(signals.reading_m):
        tie.pose(reading)
        found[n] = np.linalg.solve(tie.jacobian().T, signals.force[n, :2])
    return found


def _node(displacement: Floats) -> Floats:
    """Return x and theta of the joint at the coupler, with the laboratory's sign, (..., 2)."""
    return np.asarray(displacement[..., [frame.X, frame.TURN]] * [1.0, -1.0])


def _delay(target: Floats, reading: Floats) -> int:
    """Return the lag, samples, with the largest magnitude of the correlation.

    MATLAB's finddelay; of equally good lags the smallest.
    """
    size = 1 << (2 * target.size - 1).bit_length()
    product = np.fft.irfft(np.conj(np.fft.rfft(target, size)) * np.fft.rfft(reading, size), size)
    lags = np.concatenate([np.arange(target.size), -np.arange(1, target.size)])
    found = np.abs(product[lags])
    best = lags[found >= found.max() * (1.0 - 1e-12)]
    return int(best[np.argmin(np.abs(best))])


def _rms(error: Floats, of: Floats) -> Floats:
    return np.asarray(100.0 * error.std(axis=0) / of.std(axis=0))


def _peak(error: Floats, of: Floats) -> Floats:
    return np.asarray(100.0 * np.abs(error).max(axis=0) / np.abs(of).max(axis=0))


# ---- many runs ----------------------------------------------------------------------------------


def measure(run: MarthsRun) -> MarthsOutcome:
    """Carry out one run, and evaluate it."""
    signals = simulate(run)
    return MarthsOutcome(run, {} if signals is None else figures(run, signals))


def planned(
    laws: Sequence[str],
    motions: Sequence[str],
    plants: int,
    integrator: str = "newmark",
    width: float = 1.0,
) -> list[MarthsRun]:
    """Return all combinations as runs, on the nominal plant and on ``plants`` perturbed ones.

    ``width``: size of the perturbation, in the benchmark's standard deviations.

    Raises:
        InputError: there is no such law, motion or integrator, one is given twice, or there are
            not as many plants.
    """
    benchmark_runs.require_once({"--law": laws, "--motion": motions})
    if integrator not in PARTS:
        raise InputError(f"found {integrator!r}; must be one of {', '.join(PARTS)}", "--integrator")
    for name in laws:
        marths_laws.compensation(name)
    for name in motions:
        cases.motion(name)
    if not 0 <= plants <= len(frame.SEEDS):
        raise InputError(
            f"found {plants}; must be 0 to {len(frame.SEEDS)} perturbed plants, in addition to "
            "the nominal one",
            "--plants",
        )
    seeds = (NOMINAL, *frame.SEEDS[:plants])
    return [
        MarthsRun(law, motion, seed, integrator, width)
        for motion in motions
        for law in laws
        for seed in seeds
    ]


def measured(
    wanted: Sequence[MarthsRun], jobs: int = 1, tell: Callable[[int, int, str], None] | None = None
) -> list[MarthsOutcome]:
    """Carry out runs, in their order, with the given number of processes.

    Args:
        wanted: the runs.
        jobs: number of processes that compute, each with one thread.
        tell: called with (runs done, total runs, the law) after each.

    Raises:
        InputError: the number of processes is below one.
    """
    found = []
    for outcome in benchmark_runs.each(measure, wanted, jobs):
        found.append(outcome)
        if tell is not None:
            tell(len(found), len(wanted), outcome.run.law)
    return found
