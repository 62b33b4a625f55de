"""All figures of `rthyb check`, of a rig with one axis or several."""

from __future__ import annotations

from rthyb_rt.checking import axes_drawings, drawings
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.report import drawing as draw


def plates(setup: Setup) -> list[draw.Plate]:
    """Return all figures, in the order of the page."""
    if setup.group is not None:
        return axes_drawings.plates(setup, setup.group)
    return [drawings.stability(setup), drawings.nyquist(setup), drawings.tracking(setup)]
