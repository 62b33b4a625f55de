"""A user-defined numerical part and its specimen, built from the test file's keys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from rthyb_rt import core
from rthyb_rt.config.numerical_structure import Mode
from rthyb_rt.config.own_tables import FmuFile, LibraryFile, PythonClass
from rthyb_rt.config.sparse_structure import JointModel
from rthyb_rt.config.structures import Interface
from rthyb_rt.core import CoreError, ElementConfig
from rthyb_rt.core.numerical_parts import Part
from rthyb_rt.core.own import PythonPartConfig, key_of
from rthyb_rt.core.own_fmu import FmuConfig
from rthyb_rt.core.own_interfaces import IN_ORDER, Places, Stiffness, rows_of
from rthyb_rt.core.own_library import FEW_STEPS, LibraryConfig, tried
from rthyb_rt.core.own_parts import OwnPartConfig
from rthyb_rt.errors import InputError

Floats = NDArray[np.float64]
Rows = Sequence[Sequence[float]]

PERIODS: Final = 24
"""Number of stated periods of free vibration after a pulse, to verify the stated period."""
MOST_TICKS: Final = 20_000
FAR: Final = 0.25
"""Relative error of the stated period that is worth a note: window and margins are derived from the
stated period and change with it."""


@dataclass(frozen=True)
class OwnStructure:
    """A user-defined numerical part.

    Attributes:
        part: settings of the part for the core.
        labels: labels of the reported values.
    """

    part: OwnPartConfig
    labels: tuple[str, ...] = ()

    def modes(self) -> tuple[Mode, ...]:
        """Return no modes: the matrices of the part are not known."""
        return ()

    @property
    def stiffness(self) -> Floats:
        """The specimen's elastic stiffness along the interface, (m, m)."""
        return np.array(rows_of(self.part.k_e_n_per_m))

    def reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats]:
        """Simulate the part joined to a model of the specimen; return the interface's motion.

        For a part with one interface.
        """
        return self.whole_reference(elements, ag_mps2)[:3]

    def whole_reference(
        self, elements: Sequence[ElementConfig], ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Simulate the part joined to a model of the specimen, which acts entirely as a force.

        Args:
            elements: the model.
            ag_mps2: ground acceleration at every sample, (n,).

        Returns:
            Displacement, velocity and force at the interface, (n,) each; the values that the part
            reports, (n, responses).
        """
        ag = np.atleast_1d(np.asarray(ag_mps2, dtype=np.float64))
        return Part(self.part).joined(elements, ag, len(self.part.responses))

    def joint_reference(
        self, model: JointModel, ag_mps2: ArrayLike
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Simulate a part with several interfaces joined to a model of the specimen.

        As with one interface, the model acts entirely as a force. Velocity and acceleration are
        those that the core derives from the displacements of a part that reports no others.

        Args:
            model: the specimen.
            ag_mps2: ground acceleration at every sample, (n,).

        Returns:
            Displacement, velocity and force along the interface, (n, m) each; the values that the
            part reports, (n, responses).
        """
        ag = np.atleast_1d(np.asarray(ag_mps2, dtype=np.float64))
        part, h = Part(self.part), self.part.period_s
        shape, count = (ag.size, len(self.stiffness)), len(self.part.responses)
        x, v, force = np.empty(shape), np.empty(shape), np.empty(shape)
        values = np.empty((ag.size, count))
        elements = [(along, core.CoreElement(one)) for along, one in model.elements]
        for i, excitation in enumerate(ag.tolist()):
            x[i], v[i], a = part.motion()
            force[i] = model.stiffness @ x[i] + model.damping @ v[i] + model.mass @ a
            for along, one in elements:
                force[i, along] += one.force(
                    float(x[i, along]), float(v[i, along]), float(a[along]), h
                )
            part.answer_all(excitation, force[i].tolist())
            values[i] = part.reported(count)
            part.advance()
        return x, v, force, values

    def elastic_displacement_m(self, ag_mps2: ArrayLike) -> Floats:
        """Return the displacement with an elastic specimen, (n,) or, of several, (n, m)."""
        k_e = self.stiffness
        if len(k_e) == 1:
            model = [core.element("stiffness", k_n_per_m=float(k_e[0, 0]))]
            return self.reference(model, ag_mps2)[0]
        none = np.zeros_like(k_e)
        return self.joint_reference(JointModel(k_e, none, none), ag_mps2)[0]


def place_of(given: LibraryFile | FmuFile | PythonClass) -> str:
    """Return the table of a test file that describes a part."""
    kinds = {LibraryFile: "library", FmuFile: "fmu", PythonClass: "python"}
    return f"numerical.{kinds[type(given)]}"


def build(
    given: LibraryFile | FmuFile | PythonClass,
    k_e_n_per_m: float | Rows,
    period_s: float,
    interfaces: Sequence[Interface] = (),
) -> OwnStructure:
    """Return the part that a test file names, loaded and tried out.

    Args:
        given: its table.
        k_e_n_per_m: elastic stiffness of the rig's specimen; with several axes, its rows along the
            interfaces, in their order.
        period_s: sampling period.
        interfaces: tables with the numbers of its interfaces; none for a rig with one axis.

    Raises:
        InputError: it cannot be loaded, rejects its settings, crashes, or does not return.
        OwnCodeError: a class in Python raised an exception.
    """
    place = place_of(given)
    try:
        place_in_part = tuple((one.number or 1) - 1 for one in interfaces) or IN_ORDER
        part = _config(given, _stiffness(k_e_n_per_m), period_s, place_in_part)
        names = tuple(one.name for one in part.responses)
        _require_interfaces(part)
    except CoreError as error:
        raise InputError(str(error), f"{place}.{_key(given, error)}") from error
    try:
        if not isinstance(part, PythonPartConfig):
            tried(part, FEW_STEPS)
        Part(part)
    except CoreError as error:
        raise InputError(str(error), place) from error
    return OwnStructure(part, names)


def _stiffness(given: float | Rows) -> Stiffness:
    if isinstance(given, (int, float)):
        return float(given)
    return tuple(tuple(float(k) for k in row) for row in given)


def _require_interfaces(part: OwnPartConfig) -> None:
    """Reject a part with more or fewer interfaces than the rig has directions.

    Raises:
        CoreError: states both numbers.
    """
    found, wanted = part.interfaces, len(rows_of(part.k_e_n_per_m))
    if found == wanted:
        return
    what = {
        "library": "rthyb_part_interfaces returns",
        "fmu": "the number of names in force is",
        "python": "its attribute interfaces is",
    }[part.kind]
    name = part.own.name if isinstance(part, PythonPartConfig) else part.path
    rig = (
        "the rig has one axis, which moves the specimen in one direction"
        if wanted == 1
        else f"the axes of the rig move the specimen in {wanted} directions"
    )
    raise CoreError(f"{name}: {what} {found}; it must be {wanted}, because {rig}")


def _key(given: LibraryFile | FmuFile | PythonClass, error: CoreError) -> str:
    return key_of(error) if isinstance(given, PythonClass) else "file"


def _config(
    given: LibraryFile | FmuFile | PythonClass,
    k_e_n_per_m: Stiffness,
    period_s: float,
    place: Places,
) -> OwnPartConfig:
    if isinstance(given, PythonClass):
        return PythonPartConfig(given.own, k_e_n_per_m, period_s, place)
    path = str(Path(given.file).resolve())
    parameters = tuple(given.parameters.items())
    if isinstance(given, LibraryFile):
        return LibraryConfig(path, k_e_n_per_m, parameters, period_s, place=place)
    force, displacement = (
        tuple(names) if isinstance(names, list) else names
        for names in (given.force, given.displacement)
    )
    return FmuConfig(
        path, k_e_n_per_m, force, displacement, given.ground_acceleration, parameters,
        tuple(given.record), period_s, place=place,
    )  # fmt: skip


def refuse_in_real_time(part: OwnPartConfig) -> None:
    """Reject a part that does what a real-time tick does not permit.

    Raises:
        InputError: naming what it does on this computer.
    """
    assert not isinstance(part, PythonPartConfig)
    try:
        found = tried(part)
    except CoreError as error:
        raise InputError(str(error), f"numerical.{part.kind}") from error
    most_s, name = 0.5 * part.period_s, Path(part.path).name
    reasons = []
    if found.step_s > most_s:
        reasons.append(
            f"takes {found.step_s * 1e6:.0f} us per step on this computer (median of "
            f"{found.steps}); in real time at most {most_s * 1e6:.0f} us is allowed, half of the "
            "sampling period"
        )
    if found.allocations:
        reasons.append(
            f"allocates or frees memory in its step function, {found.allocations} times in "
            f"{found.steps} steps; keep all memory in its state, or allocate it in init"
        )
    if found.system_call is not None:
        reasons.append(
            f"makes a system call in its step function (system call {found.system_call}); a step "
            "may not open files, print, wait, allocate memory or take a lock"
        )
    if reasons:
        raise InputError(
            f"{name} {'; and it '.join(reasons)}; in virtual time it runs unchanged",
            f"numerical.{part.kind}",
        )


def period_note(structure: OwnStructure, stated_s: float) -> str | None:
    """Compare the period that a file states with the part's own on an elastic specimen.

    Args:
        structure: the part.
        stated_s: stated period of the whole structure.

    Returns:
        A note for the user, or None.

    Raises:
        OwnCodeError: a class in Python raised an exception.
    """
    h = structure.part.period_s
    ticks = int(min(MOST_TICKS, max(64, round(PERIODS * stated_s / h))))
    pulse = np.zeros(ticks)
    pulse[: max(1, round(0.25 * stated_s / h))] = 1.0
    # Rotations and displacements are compared by the energy that they store in the specimen.
    stiffness = np.sqrt(np.abs(np.diag(structure.stiffness)))
    x = structure.elastic_displacement_m(pulse).reshape(ticks, -1) * stiffness
    fourth = ticks // 4
    if np.abs(x[-fourth:]).max() > 2.0 * np.abs(x[:fourth]).max() > 0.0:
        return (
            "with an elastic specimen of stiffness k_e (rig file) the response of the numerical "
            "part to a ground pulse keeps growing: check for a wrong sign, or for a time step that "
            "is too long"
        )
    free = x[fourth // 2 :]
    rows = len(free)
    shown = (free - free.mean(axis=0)) * np.hanning(rows)[:, None]
    spectrum = np.linalg.norm(np.fft.rfft(shown, 8 * rows, axis=0), axis=1)
    at = int(np.argmax(spectrum))
    if at == 0 or not spectrum[at] > 0.0:
        return None
    found_s = 8 * rows * h / at
    if abs(found_s / stated_s - 1.0) <= FAR:
        return None
    return (
        f"numerical states a period of {stated_s:.3g} s for the whole structure, but with an "
        f"elastic specimen its period is {found_s:.3g} s: the window of the force compensation, "
        "the limits and the margins are derived from the stated period; correct period_s or "
        "mass_kg, or your numerical part"
    )
