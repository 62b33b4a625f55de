"""The check of a test on a rig with several axes."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from rthyb_rt.analysis import axes_roots, loop_stability
from rthyb_rt.analysis.loop_roots import LoopVerdict
from rthyb_rt.checking import cell_corrections
from rthyb_rt.checking.check_tables import loop_rows
from rthyb_rt.checking.remarks import within_reach
from rthyb_rt.config import AxesRig, Limit, TestFile
from rthyb_rt.config.deriving_axes import law_of_axis
from rthyb_rt.config.own_structure import OwnStructure
from rthyb_rt.config.testfile import MATRIX
from rthyb_rt.lab import axes_experiment
from rthyb_rt.lab.experiment import Group, Setup
from rthyb_rt.numbers import number, percent, quantity

Rows = list[tuple[str, str, str]]

SCHEMA: Final = "rthyb-check/1"
MODES: Final = 5
NOT_COMPUTED: Final = (
    "the critical delay and the margin of the delay estimator are computed only for a rig with one "
    "axis"
)


@dataclass(frozen=True, eq=False)
class ExaminedAxes:
    """Result of `rthyb check` for a test on several axes.

    Attributes:
        setup, group: the test, ready to run.
        loop: roots and margins of the loop; None if the axes' responses are not known.
        notes, warnings: information, and problems that should be corrected.
    """

    setup: Setup
    group: Group
    loop: LoopVerdict | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    def tables(self) -> list[Rows]:
        """Return rows for structure, axes, directions, loop: quantity, value, explanation."""
        axes = [self._axis(i) for i in range(len(self.group.rig.axis))]
        return [self._structure(), *axes, self._directions(), self._loop()]

    def _loop(self) -> Rows:
        if isinstance(self.group.derived.structure, OwnStructure):
            return [("Largest root", "not computed", "the matrices of your own part are not known")]
        return loop_rows(self.loop, swept=axes_roots.is_swept(self.group.rig))

    def _structure(self) -> Rows:
        derived = self.group.derived
        structure, fs = derived.structure, quantity(derived.fs_hz, "Hz")
        if isinstance(structure, OwnStructure):
            stated = quantity(1.0 / derived.first.frequency_hz, "s", digits=4)
            kind = structure.part.kind
            return [("Rate", fs, f"a numerical part of your own, {kind}; stated period {stated}")]
        rows: Rows = [("Rate", fs, f"{len(structure.labels)} degrees of freedom")]
        for i, mode in enumerate(structure.modes()[:MODES]):
            damping = f"damping {percent(mode.damping_ratio)} of critical"
            mass = f"{percent(mode.effective_mass, 3)} of the mass"
            frequency = quantity(mode.frequency_hz, "Hz", digits=4)
            rows.append((f"Mode {i + 1}", frequency, f"{damping}, {mass}"))
        return rows

    def _axis(self, i: int) -> Rows:
        rig, own = self.group.rig, self.group.derived.axis[i]
        name, limits = rig.names[i], own.limits.limits
        peak_m, peak_n = (
            float(np.abs(values[:, i]).max())
            for values in (self.group.reference.axis_m, self.group.reference.axis_n)
        )
        by_matrix = self.setup.test.controller.type == MATRIX
        law = MATRIX if by_matrix else law_of_axis(self.setup.test, name).type
        position, force = limits.command_position_m, limits.force_n
        rows: Rows = [
            (f"Axis {name}", law, f"stiffness {quantity(own.k_e_n_per_m, 'kN/m', 1e-3, 4)} "
             "with the other axes at rest"),
            ("  Displacement", quantity(peak_m, "mm", 1e3),
             _of_limit(position.value * 1e3 if position else None, "mm")),
            ("  Force", quantity(peak_n, "kN", 1e-3),
             _of_limit(force.value * 1e-3 if force else None, "kN")),
            ("  Noise at rest", quantity(own.rest_noise_displacement_m, "µm", 1e6),
             quantity(own.rest_noise_force_n, "N")),
        ]  # fmt: skip
        link = rig.axis[i].link
        if link is not None:
            rows.append(("  Link", link.kind, link.channel))
        return rows

    def _directions(self) -> Rows:
        rig, test = self.group.rig, self.setup.test
        rows: Rows = []
        for j, (one, turns) in enumerate(zip(test.interface, rig.kinematics.turns(), strict=True)):
            reference = self.group.reference
            unit, moment = ("mrad", "kN m") if turns else ("mm", "kN")
            position, force = one.limits.of_kind(turns)
            rows += [
                (f"Direction {one.name}",
                 quantity(float(np.abs(reference.x[:, j]).max()), unit, 1e3),
                 _of_limit(position.value * 1e3 if position else None, unit)),
                ("  moment" if turns else "  force",
                 quantity(float(np.abs(reference.force[:, j]).max()), moment, 1e-3),
                 _of_limit(force.value * 1e-3 if force else None, moment)),
            ]  # fmt: skip
        return rows

    def document(self) -> dict[str, Any]:
        """Return the same as plain values."""
        group = self.group
        modes = group.derived.structure.modes()
        return {
            "schema": SCHEMA,
            "test_name": self.setup.test.test.name,
            "rig_name": group.rig.rig.name,
            "modes_hz": [mode.frequency_hz for mode in modes],
            "modes": [mode.document() for mode in modes],
            "axes": {
                name: {
                    "law_settings": dict(own.law_settings),
                    "elastic_stiffness_n_per_m": own.k_e_n_per_m,
                    "reference_peak_m": float(np.abs(group.reference.axis_m[:, i]).max()),
                    "reference_peak_n": float(np.abs(group.reference.axis_n[:, i]).max()),
                }
                for i, (name, own) in enumerate(
                    zip(group.rig.names, group.derived.axis, strict=True)
                )
            },
            "directions": {
                name: {
                    "reference_peak": float(np.abs(group.reference.x[:, j]).max()),
                    "reference_force_peak": float(np.abs(group.reference.force[:, j]).max()),
                }
                for j, name in enumerate(group.rig.directions)
            },
            "loop": None if self.loop is None else asdict(self.loop),
            "notes": list(self.notes),
            "warnings": list(self.warnings),
        }


def _of_limit(limit: float | None, unit: str) -> str:
    """Return a text that compares a peak of the reference with its limit."""
    if limit is None:
        return "peak of the reference; no limit"
    return f"peak of the reference; limit {number(limit, 4)} {unit}"


def _limits_in_reach(setup: Setup, group: Group) -> list[str]:
    """Report the limits of axes and directions that even the reference simulation exceeds."""
    found: list[tuple[str, Limit | None, float, str]] = []
    whole = group.reference
    axis_m, axis_n, x, force = (
        np.abs(signal).max(axis=0).tolist()
        for signal in (whole.axis_m, whole.axis_n, whole.x, whole.force)
    )
    for i, name in enumerate(group.rig.names):
        limits = group.derived.axis[i].limits.limits
        found += [
            (f"axis {name}: command_position_m", limits.command_position_m, axis_m[i], "m"),
            (f"axis {name}: force_n", limits.force_n, axis_n[i], "N"),
        ]
    turns = group.rig.kinematics.turns()
    for j, (one, turn) in enumerate(zip(setup.test.interface, turns, strict=True)):
        position, most = one.limits.of_kind(turn)
        keys = ("position_rad", "moment_n_m") if turn else ("position_m", "force_n")
        units = ("rad", "N m") if turn else ("m", "N")
        found += [
            (f"direction {one.name}: {keys[0]}", position, x[j], units[0]),
            (f"direction {one.name}: {keys[1]}", most, force[j], units[1]),
        ]
    return within_reach(found)


def examine_axes(test: TestFile, rig: AxesRig) -> ExaminedAxes:
    """Check a test on a rig with several axes.

    Raises:
        InputError: with all errors in the files, or inconsistencies between them.
    """
    setup = axes_experiment.prepare(test, rig)
    assert setup.group is not None
    loop = loop_stability.judge(setup)
    warnings = _limits_in_reach(setup, setup.group) + cell_corrections.warnings(rig)
    warnings += loop_stability.remarks(setup, loop)
    if loop is not None and loop.unstable and loop_stability.is_real(setup):
        warnings.append("a test in real time will be refused: the loop is unstable")
    return ExaminedAxes(setup, setup.group, loop, (*setup.notes, NOT_COMPUTED), tuple(warnings))
