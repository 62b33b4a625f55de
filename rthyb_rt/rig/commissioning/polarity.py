"""Does the displacement follow the command, and does the force rise with it?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from rthyb_rt.config import RigFile, defaults
from rthyb_rt.config.rigfile import DisplacementChannel
from rthyb_rt.rig.commissioning.guided_motion import MotionResult

SLOPE_TOLERANCE: Final = defaults.DISPLACEMENT_SHARE
"""Allowed deviation of displacement/command from 1; shaft and amplifier contribute to it."""


@dataclass(frozen=True)
class PolarityVerdict:
    """Result of a slow motion.

    Attributes:
        slope: displacement over command.
        stiffness_n_per_m: force over displacement; None if either is too small.
        faults: what is wrong, each with its remedy.
        reversed: whether a sign is wrong: displacement or force have the opposite direction.
    """

    slope: float
    stiffness_n_per_m: float | None
    faults: tuple[str, ...]
    reversed: bool = False

    @property
    def good(self) -> bool:
        """Whether nothing is wrong."""
        return not self.faults


def judge(rig: RigFile, moved: MotionResult) -> PolarityVerdict:
    """Judge a motion that has come to rest."""
    command_m, x_m, f_n = moved.commanded_m, moved.moved_m, moved.change_n
    slope = x_m / command_m if abs(command_m) > 0.0 else 0.0
    stiffness = None
    if abs(x_m) > moved.certain("x_meas_m") and abs(f_n) > moved.certain("f_meas_n"):
        stiffness = f_n / x_m
    faults = []
    if abs(x_m) <= moved.certain("x_meas_m"):
        faults.append(
            f"the displacement did not follow: {_mm(x_m)} when {_mm(command_m)} was commanded; is "
            "the actuator on and its sensor connected?"
        )
    elif slope < 0.0:
        faults.append(
            f"the displacement moved against the command: {_mm(x_m)} when {_mm(command_m)} were "
            f"commanded; {displacement_remedy(rig)}"
        )
    elif abs(slope - 1.0) > SLOPE_TOLERANCE:
        faults.append(
            f"the displacement moved by {_mm(x_m)} when {_mm(command_m)} was commanded, a "
            f"ratio of {slope:.3g}; from {1 - SLOPE_TOLERANCE:g} to {1 + SLOPE_TOLERANCE:g} is "
            "allowed: check the scales of displacement and command in [calibration], and the "
            "drive's units"
        )
    if stiffness is None:
        faults.append(
            f"the force did not respond: {f_n:.3g} N for {_mm(x_m)}; is a specimen mounted and "
            "the load cell connected? For a soft specimen use a larger distance"
        )
    elif stiffness < 0.0 and slope > 0.0:
        faults.append(
            f"the force falls as the displacement rises: k_e = {1e-3 * stiffness:.4g} kN/m; "
            f"{force_remedy(rig)}"
        )
    seen = abs(x_m) > moved.certain("x_meas_m")
    backwards = seen and (slope < 0.0 or (stiffness is not None and stiffness < 0.0))
    return PolarityVerdict(slope, stiffness, tuple(faults), backwards)


def force_remedy(rig: RigFile) -> str:
    """Return the change of the rig file that reverses the force."""
    sign = -rig.calibration.force.polarity
    return (
        "check the polarity of the load cell: in the rig file's [calibration], "
        f"force = {{ polarity = {sign} }}"
    )


def displacement_remedy(rig: RigFile) -> str:
    """Return the changes of the rig file that reverse displacement or command.

    A command that the file does not mention follows the displacement, so both must be given.
    """
    sensor = rig.calibration.displacement
    command = rig.calibration.command or sensor
    kept, turned = _table(command, command.polarity), _table(command, -command.polarity)
    return (
        "check which way the actuator moved. If the direction was correct, invert its sensor: in "
        f"the rig file's [calibration], displacement = {_table(sensor, -sensor.polarity)} and "
        f"command = {kept}. If it was wrong, invert the drive: command = {turned}"
    )


def _table(channel: DisplacementChannel, polarity: int) -> str:
    parts = [f"polarity = {polarity}"]
    if channel.scale != 1.0:
        parts.append(f"scale = {channel.scale!r}")
    if channel.offset_m != 0.0:
        parts.append(f"offset_m = {channel.offset_m!r}")
    return f"{{ {', '.join(parts)} }}"


def _mm(x_m: float) -> str:
    return f"{x_m * 1e3:.3g} mm"
