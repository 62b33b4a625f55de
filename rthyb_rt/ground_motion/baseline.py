"""Baseline check: is the ground at rest at the end of the record?"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rthyb_rt.ground_motion.acceleration import GroundMotion

#: A record passes if its final velocity is at most this fraction of its peak velocity.
FINAL_VELOCITY_LIMIT = 0.05


@dataclass(frozen=True)
class BaselineCheck:
    """Result of integrating a record as it is, from rest.

    Attributes:
        mean_mps2: mean acceleration, m/s2.
        peak_velocity_mps: largest |velocity|, m/s.
        final_velocity_mps: velocity at the last sample, m/s.
        peak_displacement_m: largest |displacement|, m.
        final_displacement_m: displacement at the last sample, m.
        ok: whether the final velocity is at most 5 % of the peak velocity.
        message: the result in one sentence, with the criterion.
    """

    mean_mps2: float
    peak_velocity_mps: float
    final_velocity_mps: float
    peak_displacement_m: float
    final_displacement_m: float
    ok: bool
    message: str


def baseline_check(motion: GroundMotion) -> BaselineCheck:
    """Integrate a record twice from rest by the trapezoidal rule and check its end.

    The criterion is |v_end| <= 0.05 max|v|. The final displacement is reported but not checked,
    because a static offset of the ground can be real. The record is never changed; a record that
    fails can still be used, because the structure's displacement relative to the ground depends
    little on a slow drift of the ground.
    """
    a = motion.acceleration_mps2
    velocity = np.concatenate([[0.0], np.cumsum(0.5 * (a[1:] + a[:-1])) * motion.dt_s])
    displacement = np.concatenate(
        [[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1])) * motion.dt_s]
    )
    peak = float(np.abs(velocity).max())
    final = float(velocity[-1])
    ok = abs(final) <= FINAL_VELOCITY_LIMIT * peak
    share = 100.0 * abs(final) / peak if peak > 0.0 else 0.0
    message = (
        f"final velocity {final:.3g} m/s is {share:.1f} % of the peak velocity {peak:.3g} m/s"
        f" (accepted: {100.0 * FINAL_VELOCITY_LIMIT:g} %);"
        f" final displacement {displacement[-1]:.3g} m"
    )
    if not ok:
        message += "; the record may need a baseline correction, or was cut while moving"
    return BaselineCheck(
        mean_mps2=float(a.mean()),
        peak_velocity_mps=peak,
        final_velocity_mps=final,
        peak_displacement_m=float(np.abs(displacement).max()),
        final_displacement_m=float(displacement[-1]),
        ok=ok,
        message=message,
    )
