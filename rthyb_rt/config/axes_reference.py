"""The reference simulation of a test on a rig with several axes: no actuator, no sensor."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.config.axesfile import AxesRig
from rthyb_rt.config.own_tables import core_element
from rthyb_rt.config.rigfile import ServoHydraulic
from rthyb_rt.config.sparse_structure import (
    JointModel,
    SparseStructure,
    joint_reference,
)
from rthyb_rt.config.testfile import TestFile

if TYPE_CHECKING:
    from rthyb_rt.config.own_structure import OwnStructure

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class AxesReference:
    """Response of the complete structure.

    Attributes:
        x, v, force: displacement, velocity and the specimen's force along the interface, (n,
            directions) each.
        axis_m, axis_n: displacements of the axes, and the forces of their load cells, (n, axes).
        responses: responses of the structure by name, (n, responses).
    """

    x: Floats
    v: Floats
    force: Floats
    axis_m: Floats
    axis_n: Floats
    responses: Floats

    def rows(self, first: int, count: int) -> AxesReference:
        """Return ``count`` rows of all signals from row ``first`` on."""
        return AxesReference(
            *(getattr(self, one.name)[first : first + count] for one in fields(self))
        )


def reference_of(
    test: TestFile, rig: AxesRig, structure: SparseStructure | OwnStructure, ag_mps2: Floats
) -> AxesReference:
    """Simulate the structure with the rig file's specimen joined to it.

    Args:
        test, rig: the two files.
        structure: the numerical part, its interfaces in the order of the rig's directions.
        ag_mps2: ground acceleration at every sample, (n,).
    """
    model = joint_model(test, rig)
    if isinstance(structure, SparseStructure):
        x, v, force, responses = joint_reference(structure, model, ag_mps2)
    else:
        x, v, force, responses = structure.joint_reference(model, ag_mps2)
    tie = rig.core_kinematics()
    axis_m, _ = tie.axes(x)
    if rig.is_redundant or tie.has_forces:
        pushed = tie.pushes(force)
    else:
        pushed = np.asarray(np.linalg.solve(tie.jacobian().T, force.T).T, dtype=np.float64)
    return AxesReference(x, v, force, axis_m, pushed, responses)


def joint_model(test: TestFile, rig: AxesRig) -> JointModel:
    """Return the specimen of a rig file along its interface, for the reference simulation.

    With ``reference.table_forces``, it includes the masses and viscous forces of the tables, which
    load cells at the actuators' ends also measure, but not their dry friction.
    """
    n, given = len(rig.directions), rig.specimen
    stiffness, damping, mass = (
        np.zeros((n, n)) if rows is None else np.array(rows, dtype=np.float64)
        for rows in (given.stiffness, given.damping, given.mass)
    )
    if test.reference.table_forces and rig.rig.load_cell == "actuator-end":
        jacobian = rig.core_kinematics().jacobian()
        for row, axis in zip(jacobian, rig.axis, strict=True):
            if isinstance(axis.actuator, ServoHydraulic):
                mass = mass + axis.actuator.moving_mass_kg * np.outer(row, row)
                damping = damping + axis.actuator.viscous_n_s_per_m * np.outer(row, row)
    elements = tuple(
        (rig.directions.index(one.along), core_element(one.law)) for one in given.element
    )
    return JointModel(stiffness, damping, mass, elements)
