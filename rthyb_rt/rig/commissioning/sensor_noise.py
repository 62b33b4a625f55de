"""Is every sensor without an actuator watched: is its noise stated, and as it is at rest?

Limits on repeated readings and on jumps follow from the noise that the rig file states. Without it
there are none; if it is overstated they never act, and if it is understated they end good tests.
"""

from __future__ import annotations

import math
from typing import Final

from rthyb_rt.config import Limit, defaults
from rthyb_rt.config.lonesensors import LoneForce, LoneSensor
from rthyb_rt.numbers import quantity

FACTOR: Final = 3.0
"""Allowed ratio of the noise stated and the noise at rest, either way.

The limit on jumps is `defaults.JUMP_SIGMAS` = 20 standard deviations beyond what a motion can do.
Stated three times too large it is 60, and stated three times too small 7, which no noise reaches.
"""


def unwatched(one: LoneSensor, step: float, measured: float | None = None) -> str:
    """Return in words why repeated readings or jumps of a sensor would not be seen; "": they are.

    Args:
        one: the sensor.
        step: difference of neighbouring readings in its frames, m or N.
        measured: its noise at rest, as commissioning has found it; None: not known.
    """
    (noise_key, noise, lsb), keys = _noise(one), _watches(one)
    both = " and ".join(keys)
    watched = keys | _disagreement(one)
    off = [key for key, limit in watched.items() if limit is not None and not limit.acts]
    if off:
        return f"{' and '.join(off)} must not be switched off on a real drive"
    lacking = [key for key, limit in keys.items() if limit is None]
    if not lacking:
        return ""
    if noise <= 0.0:
        found = f"; {_written(one, measured)} was measured at rest" if measured else ""
        value = f" = {measured:.2g}" if measured else ", as commissioning measures it at rest,"
        return (
            f"{noise_key} and {' and '.join(lacking)} are missing, so that a reading that repeats "
            f"itself or jumps would not end a test{found}: state {noise_key}{value} or {both}"
        )
    coarse = max(lsb, step)
    if "stuck_s" in lacking and defaults.repeat_odds(noise, coarse) > defaults.MOST_LIKELY:
        return (
            f"{noise_key} is {_written(one, noise)}, less than half of the step of its readings, "
            f"{_written(one, coarse)}, so that no limit on repeated readings can be derived: state "
            "stuck_s"
        )
    return ""


def implausible(one: LoneSensor, step: float, measured: float) -> str:
    """Return in words how the stated noise differs from that at rest; "" if it does not, or if none
    is stated.

    Args:
        one: the sensor.
        step: as in `unwatched`.
        measured: standard deviation of its readings at rest, m or N.
    """
    key, noise, lsb = _noise(one)
    # A reading that toggles between two steps has a standard deviation of half a step, at most.
    rounding = 0.5 * max(lsb, step)
    if noise <= 0.0:
        return ""
    if noise > FACTOR * max(measured, rounding):
        harm = "limits on repeated readings and jumps, which follow from it, would not act"
    elif measured > FACTOR * math.hypot(noise, rounding):
        harm = "limits on jumps, which follow from it, would end good tests"
    else:
        return ""
    remedy = f", or state {key} = {measured:.2g}" if measured > 0.0 else ": is it frozen?"
    return (
        f"{key} is {_written(one, noise)}, but its noise at rest is {_written(one, measured)}; a "
        f"factor of {FACTOR:g} is allowed: {harm}. Check the sensor{remedy}"
    )


def _noise(one: LoneSensor) -> tuple[str, float, float]:
    """Return the key of the noise, the noise and the resolution, m or N."""
    if isinstance(one, LoneForce):
        return "noise_std_n", one.noise_std_n, one.lsb_n
    return "noise_std_m", one.noise_std_m, one.lsb_m


def _watches(one: LoneSensor) -> dict[str, Limit | None]:
    """Return the limits that watch for a reading that repeats itself and for jumps, by key."""
    if isinstance(one, LoneForce):
        return {"stuck_s": one.stuck_s, "jump_n": one.jump_n}
    return {"stuck_s": one.stuck_s, "jump_m": one.jump_m}


def _disagreement(one: LoneSensor) -> dict[str, Limit | None]:
    """Return the limit on its difference from the other sensors, by key; it has a default."""
    if isinstance(one, LoneForce):
        return {"disagreement_n": one.disagreement_n}
    return {"disagreement_m": one.disagreement_m}


def _written(one: LoneSensor, value: float) -> str:
    return quantity(value, "N") if isinstance(one, LoneForce) else quantity(value, "um", 1e6)
