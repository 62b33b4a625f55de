"""Tests on a rig of one axis or of several."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rthyb_rt.analysis import loop_stability
from rthyb_rt.config import AxesRig, RigFile, TestFile
from rthyb_rt.ground_motion import GroundMotion
from rthyb_rt.lab import axes_experiment, axis_wires, experiment
from rthyb_rt.lab.experiment import Setup


def prepare(test: TestFile, rig: RigFile | AxesRig, record: GroundMotion) -> Setup:
    """Return a test in real time with all settings of the core, and notes on the closed loop.

    Args:
        test, rig: the two files.
        record: the ground motion as read, neither cut nor scaled.

    Raises:
        InputError: everything that is wrong in the files, in the record, or between them.
    """
    if isinstance(rig, AxesRig):
        setup = axes_experiment.prepare(test, rig, real_time=True, record=record)
    else:
        setup = experiment.prepare(test, rig, real_time=True, record=record)
    return replace(setup, notes=(*setup.notes, *loop_stability.demand(setup)))


def at_rest(rig: RigFile | AxesRig) -> Setup:
    """Return a setup in whose state IDLE the drives of a rig remain where they are.

    Raises:
        InputError: the values of the rig file are inconsistent.
    """
    if isinstance(rig, AxesRig):
        return axes_experiment.at_rest(rig)
    axis_wires.check(rig)
    return experiment.prescribed(rig, "at-rest", np.zeros(1))
