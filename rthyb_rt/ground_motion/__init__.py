"""Ground motions: reading, scaling, checking and resampling of acceleration records.

``load("elcentro-1940-ns")`` returns the built-in record, ``load("file.AT2")`` a file in any of the
formats PEER AT2, COSMOS V1/V2, CSMIP Volume 1/2, K-NET or two columns; `resample` gives the
accelerations at the controller's rate.
"""

from __future__ import annotations

from rthyb_rt.ground_motion.acceleration import GroundMotion
from rthyb_rt.ground_motion.acceleration_units import STANDARD_GRAVITY_MPS2
from rthyb_rt.ground_motion.baseline import BaselineCheck, baseline_check
from rthyb_rt.ground_motion.motion_files import BUILTIN, FORMATS, builtin, load, read
from rthyb_rt.ground_motion.resampling import resample

__all__ = [
    "BUILTIN",
    "FORMATS",
    "STANDARD_GRAVITY_MPS2",
    "BaselineCheck",
    "GroundMotion",
    "baseline_check",
    "builtin",
    "load",
    "read",
    "resample",
]
