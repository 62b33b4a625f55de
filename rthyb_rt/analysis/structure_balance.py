"""Energy balance of a structure with many degrees of freedom, and of several interfaces.

A recording contains only the motion of the interfaces. Between two samples the numerical part is
linear in the forces applied to it, so that these follow from its next position: driven by them and
by the recorded ground motion, the part repeats the test and every degree of freedom becomes known.
The energies are those of `rthyb_rt.analysis.balance`, as sums over the degrees of freedom:

    E_input = -integral load' a_g dx        E_kinetic = v' M v / 2      E_damping = integral v' C dx
    E_strain = x' K x / 2 + sum of r^2 / (2 k) + F' K_e^-1 F / 2

with r the forces of the nonlinear elements within the structure, k their initial stiffness, F the
forces applied at the interfaces, and K_e the elastic stiffness of the specimen. The remaining work
on an element, integral r du - r^2 / (2 k), is dissipated in it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis.balance import EnergyBalance, uninterrupted
from rthyb_rt.core import DenseConfig
from rthyb_rt.core.numerical_parts import DensePart, SparsePart
from rthyb_rt.core.sparse import GROUND, RESPONSES_MAX, Response, SparseConfig

if TYPE_CHECKING:
    from rthyb_rt.config.own_structure import OwnStructure
    from rthyb_rt.config.sparse_structure import SparseStructure
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]
PartConfig = DenseConfig | SparseConfig

_BLOCK: Final = 1024
"""Rows whose degrees of freedom are kept in memory at a time."""


def of_recording(rec: RecordedTest) -> EnergyBalance | None:
    """Return the balance of a recording of a structure; None for others, or if it never ran.

    Only rows up to the first interruption of the test proper, less the last row, are used.
    """
    from rthyb_rt.analysis.summary import recorded_structure

    structure = recorded_structure(rec)
    rows = uninterrupted(rec)
    if structure is None or rows.size < 4:
        return None
    s = rec.samples[rows]
    x_num, x_meas, f_meas = (s[name][:, None] for name in ("x_num_m", "x_meas_m", "f_meas_n"))
    return balance(structure.part, rec.time_s()[rows], s["ag_mps2"], x_num, x_meas, f_meas)


def of_axes(rec: RecordedTest, structure: SparseStructure | OwnStructure) -> EnergyBalance | None:
    """Return the balance of a recording of several axes.

    None if it never ran, or if the energies within a user-defined part are not known.

    Args:
        rec: the recording.
        structure: its numerical part, as in its summary.

    Raises:
        InputError: its files are of another version.
    """
    from rthyb_rt import config
    from rthyb_rt.config import lonesensors

    rows = uninterrupted(rec)
    if rows.size < 4 or not isinstance(structure.part, SparseConfig):
        return None
    rig = config.parse_any_rig(rec.rig_toml, "recording: rig")
    assert isinstance(rig, config.AxesRig)
    count, tie = len(rig.axis), rig.core_kinematics()
    s = rec.samples[rows]
    directions = range(1, tie.directions)
    x_num = np.column_stack([s["x_num_m"], *(s[f"x_num_m_{j}"] for j in directions)])
    x_axes, f_axes = (
        np.column_stack([rec.axis(i)[key][rows] for i in range(count)])
        for key in ("x_meas_m", "f_meas_n")
    )
    if tie.sensors:
        sensors = lonesensors.values_of(rig.lone_sensors, s)
        x_meas, f_meas = tie.measured_pose(x_axes, sensors), tie.measured_forces(f_axes, sensors)
        return balance(structure.part, rec.time_s()[rows], s["ag_mps2"], x_num, x_meas, f_meas)
    x_meas, f_meas = np.empty_like(x_num), np.empty_like(x_num)
    for n, (at, force) in enumerate(zip(x_axes, f_axes, strict=True)):
        # Pins rotate with the pose: forces are those of the latest pose.
        x_meas[n], _ = tie.pose(at)
        f_meas[n], _ = tie.forces(force)
    return balance(structure.part, rec.time_s()[rows], s["ag_mps2"], x_num, x_meas, f_meas)


def balance(
    config: PartConfig, t_s: Floats, ag_mps2: Floats, x_num_m: Floats, x_meas_m: Floats,
    f_meas_n: Floats,
) -> EnergyBalance | None:  # fmt: skip
    """Return the energies of a structure in a test.

    Args:
        config: the numerical part.
        t_s: time, (n,), s.
        ag_mps2: ground acceleration, (n,), m/s^2.
        x_num_m, x_meas_m: position of the part along its interfaces, and of the specimen, (n, m), m
            or rad.
        f_meas_n: forces of the specimen along them, (n, m), N or N m.

    Returns:
        The balance of all rows but the last, whose force affects no further row; None if the part
        does not begin where the recording does, or if a value is missing.
    """
    rows = _whole(ag_mps2, x_num_m, x_meas_m, f_meas_n)
    if rows < 4:
        return None
    ag, x, x_m, f = (values[:rows] for values in (ag_mps2, x_num_m, x_meas_m, f_meas_n))
    run = _Run(config, ag, x)
    if not run.begins:
        return None
    held = isinstance(config, DenseConfig) and config.integrator == "rk4"
    within = run.energies(held=held)
    ag, x, x_m, f, used = ag[:-1], x[:-1], x_m[:-1], f[:-1], run.used
    flexibility = _flexibility(config)
    stored, elastic = _stored(f, flexibility), _stored(used, flexibility)
    taken, given = _work(f, x_m), _work(used, x, held=held)
    found = {
        "input_j": within["input"],
        "fed_j": (taken - stored) - (given - elastic),
        "kinetic_j": within["kinetic"],
        "damping_j": within["damping"],
        "strain_j": within["strain"] + elastic,
        "specimen_j": taken - stored,
        "elements_j": within["elements"],
    }
    return EnergyBalance(
        t_s[: rows - 1], **{name: value - value[0] for name, value in found.items()}
    )


def _whole(*signals: Floats) -> int:
    """Return the number of rows before the first missing value."""
    fine = np.logical_and.reduce([np.isfinite(s).reshape(len(s), -1).all(axis=1) for s in signals])
    missing = np.flatnonzero(~fine)
    return int(missing[0]) if missing.size else len(fine)


def _flexibility(config: PartConfig) -> Floats:
    """Return K_e^-1, (m, m); 0 where the specimen has no stiffness to store energy."""
    if isinstance(config, DenseConfig):
        k_e = np.array([[config.k_e_n_per_m]])
    else:
        k_e = np.diag(config.k_e_n_per_m).astype(np.float64)
        if config.k_e_between:
            k_e = k_e + np.array(config.k_e_between)
    holds = bool((np.linalg.eigvalsh(k_e) > 0.0).all())
    return np.linalg.inv(k_e) if holds else np.zeros_like(k_e)


def _stored(force: Floats, flexibility: Floats) -> Floats:
    return np.asarray(0.5 * np.einsum("ni,ij,nj->n", force, flexibility, force))


def _work(force: Floats, along: Floats, *, held: bool = False) -> Floats:
    """Return the running work of forces, (n, m) each; ``held``: each is held for one sample."""
    mean = force[:-1] if held else 0.5 * (force[1:] + force[:-1])
    return _running(np.einsum("ni,ni->n", mean, np.diff(along, axis=0)))


def _running(steps: Floats) -> Floats:
    return np.concatenate([[0.0], np.cumsum(steps)])


class _Run:
    """Runs a part again along the recorded positions.

    Attributes:
        begins: whether it begins where the recording does.
        used: the forces applied to it, (n - 1, m), after `energies`.
    """

    def __init__(self, config: PartConfig, ag: Floats, x: Floats) -> None:
        self.ag, self.x = ag, x
        self.joints = config.joints if isinstance(config, SparseConfig) else ()
        self.parts: list[DensePart | SparsePart]
        if isinstance(config, DenseConfig):
            # Forces applied to the part: with a force delay, those of an earlier sample.
            self.config: PartConfig = replace(config, force_delay=0)
            self.parts = [DensePart(self.config, float(x[0, 0]))]
        else:
            self.config = config
            self.parts = [SparsePart(one) for one in _with_responses(config)]
        at_rest = self.parts[0].displacements()
        rows = _interface_rows(config)
        self.begins = bool(np.abs(rows @ at_rest - x[0]).max() <= 1e-9 + 1e-6 * np.abs(x).max())
        self.used = np.zeros((len(ag) - 1, x.shape[1]))
        self._forces = np.zeros((len(ag) - 1, len(self.joints)))

    def energies(self, *, held: bool) -> dict[str, Floats]:
        """Return input, kinetic, damping, strain and elements, (n - 1,) each, J."""
        m, k, c_times, load = _matrices(self.config)
        h, rows = self.config.period_s, len(self.ag) - 1
        kinetic, strain, moved = np.zeros(rows), np.zeros(rows), np.zeros(rows)
        lost, across = np.zeros(rows), np.zeros((rows, len(self.joints)))
        for first, x in self._blocks():
            # Rows first - 1 to first + n, so that every row has both neighbours.
            here = slice(first, first + len(x) - 2)
            v = (x[2:] - x[:-2]) / (2.0 * h)
            kinetic[here] = 0.5 * np.einsum("ni,ni->n", v, (m @ v.T).T)
            strain[here] = 0.5 * np.einsum("ni,ni->n", x[1:-1], (k @ x[1:-1].T).T)
            # The integrators' own damping uses the velocity at the sample, not between two.
            lost[here] = np.einsum("ni,ni->n", v, c_times(v.T).T) * h
            moved[here] = (x[1:-1] - x[:-2]) @ load
            for i, joint in enumerate(self.joints):
                for at, sign in ((joint.above, 1.0), (joint.below, -1.0)):
                    if at != GROUND:
                        across[here, i] += sign * x[1:-1, at]
        ag = self.ag[:-1]
        mean = ag[:-1] if held else 0.5 * (ag[1:] + ag[:-1])
        springs = np.array([max(joint.stiffness_n_per_m, 0.0) for joint in self.joints])
        per_n = np.divide(0.5, springs, out=np.zeros_like(springs), where=springs > 0.0)
        by_elements = np.square(self._forces) @ per_n
        taken = _work(self._forces, across)
        return {
            "input": _running(-mean * moved[1:]),
            "kinetic": kinetic,
            "damping": _running(0.5 * (lost[1:] + lost[:-1])),
            "strain": strain + by_elements,
            "elements": taken - by_elements,
        }

    def _blocks(self) -> Iterator[tuple[int, Floats]]:
        """Yield blocks of rows with one row before and one after: (number of the first row, x)."""
        rows = len(self.ag) - 1
        now = self.parts[0].displacements()
        # The row before the first mirrors the one after it, since the part begins at rest.
        held, first = [now, now], 0
        for n in range(rows):
            held.append(self._step(n))
            if n == 0:
                held[0] = held[2] if self._at_rest() else 2.0 * held[1] - held[2]
            if len(held) == _BLOCK + 2 or n == rows - 1:
                yield first, np.array(held)
                first += len(held) - 2
                held = held[-2:]

    def _at_rest(self) -> bool:
        speed = getattr(self.config, "first_v_m_per_s", None)
        return speed is None or not np.any(speed)

    def _step(self, n: int) -> Floats:
        ag = float(self.ag[n])
        used = self.parts[0].force_for(ag, self.x[n + 1])
        self.used[n] = used
        forces = used.tolist()
        for i, part in enumerate(self.parts):
            part.answer_all(ag, forces)
            if self.joints:
                begin = i * RESPONSES_MAX
                reported = part.reported(RESPONSES_MAX)
                self._forces[n, begin : begin + reported.size] = reported
            part.advance()
        return self.parts[0].displacements()


def _with_responses(config: SparseConfig) -> list[SparseConfig]:
    """Return copies of the part that together report the force of every element."""
    names = [Response(f"element_{i}", "N", joints=((i, 1.0),)) for i in range(len(config.joints))]
    groups: Sequence[Sequence[Response]] = [
        names[i : i + RESPONSES_MAX] for i in range(0, len(names), RESPONSES_MAX)
    ] or [()]
    return [replace(config, responses=tuple(group)) for group in groups]


def _interface_rows(config: PartConfig) -> Floats:
    if isinstance(config, SparseConfig):
        return config.interface_rows()
    row = np.zeros((1, len(config.load_kg)))
    row[0, config.at] = 1.0
    return row


def _matrices(config: PartConfig) -> tuple[Any, Any, Callable[[Floats], Floats], Floats]:
    """Return M, K, the product of C with velocities (n, k), and the load (n,) of the part."""
    load = np.asarray(config.load_kg, np.float64)
    if isinstance(config, SparseConfig):
        m, k = config.mass_kg.matrix(), config.stiffness_n_per_m.matrix()
        return m, k, config.damping_times, load
    m, c, k = (
        np.array(matrix)
        for matrix in (config.mass_kg, config.damping_n_s_per_m, config.stiffness_n_per_m)
    )
    return m, k, lambda v: c @ v, load
