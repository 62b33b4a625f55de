"""The random plants of the benchmark problem of real-time hybrid simulation.

Silva, Gomez, Maghareh, Dyke, Spencer, "Benchmark control problem for real-time hybrid simulation",
Mechanical Systems and Signal Processing 135 (2020) 106381, Table 2: the standard deviations of the
parameters of its perturbed plants.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from rthyb_rt import config
from rthyb_rt.config.rigfile import RigFile, ServoValve

DEVIATIONS: Final = {
    "leakage_per_s": 1.3,
    "valve_b1_per_s": 3.3,
    "valve_b2_per_s2": 3.3e3,
    "stiffness_n_per_m": 5e4,
}
"""Standard deviations of a3, b1, b2 and of the specimen's stiffness, each in its own unit."""


def nominal() -> RigFile:
    """Return the nominal plant with its sensors."""
    return config.load_rig(config.shipped_rig("rths-benchmark"))


def drawn(seed: int, width: float = 1.0) -> RigFile:
    """Return a perturbed plant; its identified values are still those of the nominal one.

    The specimen's damping follows its stiffness at the same damping ratio, as in the benchmark's
    own code. The noise of the sensors has the same seed as the plant.

    Args:
        seed: the same seed gives the same plant.
        width: factor on the stated standard deviations.
    """
    rig = nominal()
    if not isinstance(rig.actuator, ServoValve):
        raise TypeError(f"rig {rig.rig.name} has an actuator of the kind {rig.actuator.kind}")
    normal = dict(zip(DEVIATIONS, np.random.default_rng(seed).normal(size=4), strict=True))
    moved = {key: width * DEVIATIONS[key] * float(z) for key, z in normal.items()}
    more = moved.pop("stiffness_n_per_m")
    actuator = {key: max(getattr(rig.actuator, key) + by, 0.0) for key, by in moved.items()}
    specimen = []
    whole = sum(e.k_n_per_m for e in rig.specimen if e.element == "stiffness")
    for item in rig.specimen:
        if item.element == "stiffness":
            item = item.model_copy(update={"k_n_per_m": whole + more})
        elif item.element == "viscous":
            ratio = (whole + more) / whole
            item = item.model_copy(update={"c_n_s_per_m": item.c_n_s_per_m * ratio**0.5})
        specimen.append(item)
    return rig.model_copy(
        update={
            "rig": rig.rig.model_copy(update={"seed": seed}),
            "actuator": rig.actuator.model_copy(update=actuator),
            "specimen": specimen,
        }
    )
