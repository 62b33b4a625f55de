"""All figures of `rthyb check`, of a rig with one axis or several."""

from __future__ import annotations

from matplotlib import rc_context

from rthyb_rt.checking import axes_drawings, drawings
from rthyb_rt.config.own_structure import OwnStructure
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.report import drawing as draw
from rthyb_rt.report import structure as of_structure


def plates(setup: Setup) -> list[draw.Plate]:
    """Return all figures, in the order of the page."""
    if setup.group is not None:
        return [*axes_drawings.plates(setup, setup.group), *_modes(setup)]
    loop = [drawings.stability(setup), drawings.nyquist(setup), drawings.tracking(setup)]
    return loop + _modes(setup)


def _modes(setup: Setup) -> list[draw.Plate]:
    """Return the mode shapes, as in the report, if the matrices of the structure are known."""
    whole = setup.derived if setup.group is None else setup.group.derived
    structure = whole.structure
    if structure is None or isinstance(structure, OwnStructure):
        return []
    with rc_context(draw.STYLE):
        return [of_structure.modes(structure)]
