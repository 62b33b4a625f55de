"""Default limits, derived from the sensors' noise at rest and from the motion.

A limit in the test file or in the rig file always replaces one of these.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

from rthyb_rt.config.limits import (
    IncrementLimit,
    Limit,
    Limits,
    Resolved,
    ShareLimit,
    StepLimit,
    TimeLimit,
)
from rthyb_rt.config.rate import STANDARD, STANDARD_HZ, Rate
from rthyb_rt.config.rigfile import RigFile, ServoHydraulic

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

LEAST_STUCK_S: Final = 20 / STANDARD_HZ
"""The same time as for a lost link: a reading that repeats itself carries no information."""
STUCK_ODDS: Final = 1e-12
"""Rate of false alarms due to noise alone: once in thirty years at 1024 samples per second."""
MOST_LIKELY: Final = 0.7
"""Odds of a repeated reading with noise of half a step; a quieter sensor stays on one step."""
JUMP_SIGMAS: Final = 20.0
FASTER: Final = 2.0
"""Multiple of the command's velocity limit that a drive may reach when it overshoots."""
FASTER_THAN_REFERENCE: Final = 8.0
"""Multiple of the reference simulation's velocity, if the command has no velocity limit."""
STEEPER: Final = 4.0
"""Multiple of the largest change of force per sample in the reference simulation."""
SHARE_OF_FORCE_LIMIT: Final = 0.1
"""A smaller jump is not dangerous, because the force limit would detect it."""
FROZEN_S: Final = 128 / STANDARD_HZ
"""Time for which all readings of a tare must be equal to count as frozen. It is longer than
`LEAST_STUCK_S`, because a slow converter may repeat each reading while nothing moves."""
DISPLACEMENT_SHARE: Final = 0.2
"""By which share of its motion a displacement may differ from what is expected of it."""
FORCE_FACTOR: Final = math.sqrt(2.0)
"""Allowed ratio of the change of a load cell to the one expected, either way.

The share of the specimen's force that passes through a cell depends on the specimen as drawn, which
may be off by some tens of percent. The least mistake of a scale is a factor of 2, of a bridge or an
amplifier: the limit is as far from the one as from the other.
"""
ASKEW: Final = math.sin(math.radians(3.0))
"""Share of the response to one motion that may appear in the response to another one.

A sensor that is mounted by eye is up to 3 degrees out of line, and reads the sine of that angle.
"""
LAG_SHARE: Final = 0.25
"""Largest lag of a sensor as a share of the delay from the command of an axis to its reading."""
LAG_SAMPLES: Final = 2.0
"""Besides: readings in the frames of two drives are up to a sample old, each by its own clock."""
SMOOTHED_S: Final = 8 / STANDARD_HZ
"""Time constant of the low-pass filter for the disagreement of sensors, as in the core."""
DISAGREEMENT_SIGMAS: Final = 8.0
"""Standard deviations of the smoothed noise: one false alarm in 10^15 independent samples."""
BEYOND_REFERENCE: Final = 2.0
"""Multiple of the motion of the reference simulation, as is recommended for the position limit."""
LOST_WARNING: Final = 0.01
LOST: Final = 0.1
SKIP_WARNING: Final = 0.01
SKIPS: Final = 50 / 1024


def derived_limits(
    rig: RigFile,
    limits: Resolved,
    peak_velocity_m_per_s: float,
    force_step_n: float,
    rate: Rate = STANDARD,
) -> dict[str, Limit]:
    """Return every limit that can be derived, by key; those per sample are for the given rate.

    Args:
        rig: the rig, with its sensors and its identified properties.
        limits: limits of test and rig together, with the derived velocity limit, if any.
        peak_velocity_m_per_s, force_step_n: peak velocity, and largest change of force per sample,
            of the reference simulation; 0 without one.
        rate: rate of the test.
    """
    displacement, force = rig.sensors.displacement, rig.sensors.force
    identified = rig.identified
    noise_m = identified.rest_noise_displacement_m if identified is not None else None
    noise_n = identified.rest_noise_force_n if identified is not None else None
    sigma_m = displacement.noise_std_m if noise_m is None else noise_m
    sigma_n = force.noise_std_n if noise_n is None else noise_n
    found: dict[str, Limit | None] = {
        "sensor_stuck_s": _stuck(sigma_m, displacement.lsb_m, rate),
        "force_stuck_s": _stuck(sigma_n, force.lsb_n, rate),
        "sensor_jump_m": _jump_m(_velocity(limits), sigma_m, peak_velocity_m_per_s, rate),
        "force_jump_n": _jump_n(rig, limits.limits, sigma_n, force_step_n),
        "lost_pairs_share": ShareLimit(value=LOST, action="ramp-out"),
        "lost_pairs_warning_share": ShareLimit(value=LOST_WARNING, action="indicate"),
        "skipped_ticks_share": ShareLimit(value=SKIPS, action="ramp-out"),
        "skipped_ticks_warning_share": ShareLimit(value=SKIP_WARNING, action="indicate"),
    }
    return {key: limit for key, limit in found.items() if limit is not None}


def repeat_odds(sigma: float, step: float) -> float:
    """Return the odds that a sensor repeats a reading, at worst, in the middle of a step."""
    return math.erf(step / (2.0 * math.sqrt(2.0) * sigma)) if sigma > 0 else 1.0


def _stuck(sigma: float, step: float, rate: Rate) -> TimeLimit | None:
    odds = repeat_odds(sigma, step)
    if odds > MOST_LIKELY:
        return None
    samples = math.ceil(math.log(STUCK_ODDS) / math.log(odds)) if odds > 0 else 0
    ticks = max(samples, rate.ticks(LEAST_STUCK_S), 2)
    return TimeLimit(value=ticks / rate.hz, action="ramp-out")


def frozen_ticks(sigma: float, step: float, tare_ticks: int, rate: Rate = STANDARD) -> int:
    """Return how many equal readings in a row show that a reading is frozen during a tare.

    A reading repeats itself with the odds p of `repeat_odds`, so n of them are equal with the odds
    p^(n - 1). They number as many as `FROZEN_S` has, or the tare if that is shorter, as long as
    this is below `STUCK_ODDS`.

    Args:
        sigma: noise of the sensor.
        step: difference of neighbouring readings.
        tare_ticks: readings of the tare.
        rate: rate of the test.

    Returns:
        The number; 0 if equal readings can be chance: with noise below half a step, or a tare that
        is too short.
    """
    odds, count = repeat_odds(sigma, step), max(2, min(rate.ticks(FROZEN_S), tare_ticks))
    by_chance = odds > MOST_LIKELY or odds ** (count - 1) > STUCK_ODDS
    return 0 if by_chance or count > tare_ticks else count


def allowed_lag(peak_per_s: float, delay_s: float, rate: Rate) -> float:
    """Return by how much a sensor differs that is as late as commissioning accepts, m or N.

    Args:
        peak_per_s: largest rate of change of its reading in the reference simulation.
        delay_s: the largest delay of an axis.
        rate: rate of the test.
    """
    return (LAG_SHARE * delay_s + LAG_SAMPLES / rate.hz) * peak_per_s


def disagreements(
    weights: NDArray[np.float64],
    allowed: Sequence[float],
    sigmas: Sequence[float],
    steps: Sequence[float],
    rate: Rate,
) -> list[float]:
    """Return the constant part of the default limits on the disagreement of sensors.

    Args:
        weights: of all readings in each difference, (n, n), as `Kinematics.differences`.
        allowed: by how much each reading itself may be off, m or N, (n,).
        sigmas, steps: noise of each, and difference of its neighbouring readings, (n,).
        rate: rate of the test.

    Returns:
        The limits, (n,); 0 for a reading that the others do not imply.
    """
    import numpy as np

    weight = 1.0 / (1.0 + SMOOTHED_S * rate.hz)
    smoothed = math.sqrt(weight / (2.0 - weight))
    sizes = np.abs(weights)
    noise = smoothed * np.sqrt(sizes**2 @ np.square(sigmas))
    found = sizes @ (np.array(allowed) + 0.5 * np.array(steps)) + DISAGREEMENT_SIGMAS * noise
    return [float(v) for v in found]


def of_displacement_sensor(
    sigma_m: float,
    step_m: float,
    by_axis: Sequence[float],
    limits: Sequence[Resolved],
    peak_m_per_s: float,
    rate: Rate,
) -> dict[str, Limit]:
    """Return the default limits of a displacement sensor without an actuator, by name.

    They follow from the same rules as those of an axis; a drive that overshoots moves the sensor at
    most as fast as all drives together.

    Args:
        sigma_m: its noise; 0: not known, and there are no default limits.
        step_m: difference of neighbouring readings.
        by_axis: its reading for 1 m of each axis, (axes,).
        limits: of each axis, with the velocity limit.
        peak_m_per_s: largest change of its reading in the reference simulation.
        rate: rate of the test.

    Returns:
        ``stuck``, a time, and ``jump``, a change per sample of this rate, if they can be derived.
    """
    fastest = 0.0
    for share, own in zip(by_axis, limits, strict=True):
        velocity = _velocity(own)
        if abs(share) > 0.0 and (velocity is None or not velocity.enable):
            fastest = FASTER_THAN_REFERENCE * peak_m_per_s
            break
        fastest += abs(share) * FASTER * velocity.value if velocity is not None else 0.0
    jump = None
    if sigma_m > 0 and fastest > 0:
        jump_m = fastest / rate.hz + JUMP_SIGMAS * sigma_m
        jump = IncrementLimit(value=min(jump_m, 100.0), action="ramp-out")
    return _known(stuck=_stuck(sigma_m, step_m, rate), jump=jump)


def of_load_cell(
    sigma_n: float, step_n: float, most_n: float, change_n: float, rate: Rate
) -> dict[str, Limit]:
    """Return the default limits of a load cell without an actuator, by name.

    Args:
        sigma_n: its noise; 0: not known, and there are no default limits.
        step_n: difference of neighbouring readings.
        most_n: its reading with every axis at its force limit; 0: not limited.
        change_n: largest change of its reading per sample in the reference simulation; 0: none.
        rate: rate of the test.

    Returns:
        As for `of_displacement_sensor`.
    """
    jump = None
    if sigma_n > 0 and change_n > 0:
        jump_n = STEEPER * change_n + JUMP_SIGMAS * sigma_n
        jump_n = max(jump_n, SHARE_OF_FORCE_LIMIT * most_n)
        jump = StepLimit(value=min(jump_n, 1e10), action="ramp-out")
    return _known(stuck=_stuck(sigma_n, step_n, rate), jump=jump)


def _known(**limits: Limit | None) -> dict[str, Limit]:
    return {name: limit for name, limit in limits.items() if limit is not None}


def _velocity(limits: Resolved) -> Limit | None:
    given = limits.limits.command_velocity_m_per_s
    return given or limits.derived.get("command_velocity_m_per_s")


def _jump_m(
    velocity: Limit | None, sigma_m: float, peak_m_per_s: float, rate: Rate
) -> IncrementLimit | None:
    if velocity is not None and velocity.enable:
        fastest = FASTER * velocity.value
    else:
        fastest = FASTER_THAN_REFERENCE * peak_m_per_s
    if not (sigma_m > 0 and fastest > 0):
        return None
    jump_m = fastest / rate.hz + JUMP_SIGMAS * sigma_m
    return IncrementLimit(value=min(jump_m, 100.0), action="ramp-out")


def _jump_n(rig: RigFile, limits: Limits, sigma_n: float, step_n: float) -> StepLimit | None:
    if not (sigma_n > 0 and step_n > 0):
        return None
    table = rig.actuator
    seen = isinstance(table, ServoHydraulic) and rig.rig.load_cell == "actuator-end"
    friction_n = table.friction_n if seen and isinstance(table, ServoHydraulic) else 0.0
    jump_n = STEEPER * step_n + 2.0 * friction_n + JUMP_SIGMAS * sigma_n
    force = limits.force_n
    if force is not None and force.acts:
        jump_n = max(jump_n, SHARE_OF_FORCE_LIMIT * force.value)
    return StepLimit(value=min(jump_n, 1e10), action="ramp-out")
