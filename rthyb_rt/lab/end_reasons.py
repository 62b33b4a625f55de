"""How a test ends, in words and in exit codes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import CAUSES, FLAGS, STATES, STATUS, placed_cause
from rthyb_rt.errors import RthybError

WORDS: Final[dict[str, str]] = {
    "operator": "the operator",
    "signal": "the operator",
    "position": "position limit",
    "velocity": "velocity limit",
    "increment": "increment limit",
    "force": "force limit",
    "tracking": "tracking limit",
    "indicator": "tracking indicator limit",
    "energy": "energy error limit",
    "rig_position": "position limit of the rig",
    "rig_force": "force limit of the rig",
    "lost_pairs": "too many lost pairs",
    "skips": "too many skipped ticks",
    "stalled": "this PC stalled",
    "heartbeat": "the program was silent for a second",
    "not_arrived": "the command came no closer to the end of its path for 10 s; check its "
    "velocity and acceleration limits, and the compensator",
    "apart": "the drives' sample counts drifted apart",
    "no_pose": "the displacements of the axes fit no position of the specimen",
    "sensor_lost": "no usable reading",
    "sensor_range": "end of the range of the displacement sensor",
    "force_range": "end of the range of the load cell",
    "sensor_disagrees": "disagreement of the displacement sensor",
    "force_disagrees": "disagreement of the load cell",
    "not_finite": "a value was not a number",
}
_OF_SENSOR: Final[dict[str, str]] = {
    "sensor_stuck": "frozen reading",
    "force_stuck": "frozen reading",
    "sensor_jump": "jump of the reading",
    "force_jump": "jump of the reading",
    "sensor_range": "end of its range",
    "force_range": "end of its range",
    "sensor_disagrees": "disagreement",
    "force_disagrees": "disagreement",
    "not_finite": "no numeric reading",
}
"""The same for a sensor without an actuator, whose name follows."""
_STOPPED: Final = "has stopped by itself, and may have to be released at its panel."
REMEDIES: Final[dict[str, str]] = {
    "link_lost": "No usable pair of displacement and force arrived for 20 ticks: check the cable, "
    f"and the power and display of the drive; it {_STOPPED}",
    "link_down": "The link itself was lost: check cable, adapter and interface, and release "
    "the drive at its panel if necessary.",
    "drive_stopped": "The drive reported that it had stopped by itself; its panel shows why.",
    "not_finite": "A value that is not a number was received from the drive or computed: check "
    "the sensors first, then the limits and the controller of the test.",
    "sensor_stuck": "The displacement did not change while the command moved: check the sensor "
    "and its connector.",
    "sensor_jump": "The displacement jumped farther than anything can move: check the sensor "
    "and its connector.",
    "force_stuck": "The force did not change while the command moved: check the load cell and "
    "its connector.",
    "force_jump": "The force jumped farther than the motion can change it: check the load cell "
    "and its connector.",
    "lost_pairs": "Too many pairs of displacement and force were lost within a second: check "
    "cable, connectors and bus load.",
    "skips": "This PC was late too often: `rthyb jitter` says what to change.",
    "stalled": "This PC stalled for 20 ticks: `rthyb jitter` says what to change.",
    "apart": "One drive lost samples, or runs on another clock: check the link of each drive and "
    "what synchronises them.",
    "no_pose": "The displacements measured on the axes fit no position of the specimen: check "
    "signs, scales and zeros of the displacement sensors, and pins and bases in the rig file.",
    "sensor_lost": "A sensor that belongs to no axis gave no usable reading for 20 ticks: check "
    "its connector, and whether its range is large enough for the test.",
    "sensor_range": "Again and again the displacement was at the end of its sensor's range, "
    "where a reading is not used: check the sensor's connector, and whether its range is large "
    "enough.",
    "force_range": "Again and again the force was at the end of its load cell's range, where a "
    "reading is not used: check the connector of the cell, and whether its range is large enough.",
    "sensor_disagrees": "The displacement does not fit those of all other displacement sensors: "
    "check mounting, sign and scale of this sensor first, then of the others. Its limit is "
    "disagreement_m in the rig file.",
    "force_disagrees": "The force does not fit those of all other load cells: check mounting, sign "
    "and scale of this cell first, then of the others. Its limit is disagreement_n in the rig "
    "file.",
    "heartbeat": "Something blocked the program for a second, such as a full disk, a suspended "
    "process or a debugger.",
}
"""What to do about an end that is due neither to the test nor to a limit of its motion."""
TIMING_CAUSES: Final = ("skips", "stalled", "heartbeat")
"""Causes that are due to this PC and not to the test."""

_LOST_S: Final = 20 / 1024


class TimingError(RthybError):
    """This PC is not as punctual as the test requires."""

    exit_code = 7


class RefusedError(RthybError):
    """A command that the current state does not allow."""

    exit_code = 5


def in_words(cause: str, of: str | None = None) -> str:
    """Return the name of a cause in words.

    Args:
        cause: the cause, such as "link_lost".
        of: the axis, direction or sensor concerned, if there are several.
    """
    if of and of.startswith("sensor ") and cause in _OF_SENSOR:
        return _OF_SENSOR[cause]
    return WORDS.get(cause, cause.replace("_", " "))


def shown(cause: str, of: str | None = None, figures: str | None = None) -> str:
    """Return a cause as status, journal and live view show it.

    Args:
        cause: the cause, such as "link_lost".
        of: the axis, direction or sensor concerned, if there are several.
        figures: the cause with the measured value and the limit, if it has any.
    """
    return figures or (f"{of}: {in_words(cause, of)}" if of else in_words(cause))


def shown_of(status: Mapping[str, Any]) -> str:
    """Return the cause in a status of the service; "none" if there is none."""
    return shown(status["cause"], status.get("cause_of"), status.get("cause_in_figures"))


def end_reason(state: str, cause: str, *, moved: bool = True, of: str = "") -> str:
    """Return in words how a test ended: "completed", or what interrupted or ended it.

    Args:
        state: the last state.
        cause: cause in the words of the station.
        moved: whether anything had moved; otherwise nothing can have been ramped out.
        of: axis, direction or sensor to which the cause belongs, in words.
    """
    words = f"{in_words(cause, of)} of {of}" if of else in_words(cause)
    if state == "TRIPPED":
        return f"tripped: {words}"
    if cause == "operator":
        return "stopped by the operator"
    if cause == "completed":
        return "completed"
    if cause == "none":
        return "ended before it began"
    return f"ramped out: {words}" if moved else f"ended before anything moved: {words}"


def remedy(cause: str, samples: NDArray[np.void], fs_hz: float, own_part: str = "") -> str:
    """Return what to do about an end; "" if it is due to the test, or the cause already says it.

    Args:
        cause: cause in the words of the station.
        samples: rows of the test, (n,).
        fs_hz: rows per second.
        own_part: file name of the library or FMU that is the numerical part; "" if there is none.
    """
    text = REMEDIES.get(cause, "")
    if cause == "link_lost":
        return _unusable(samples, max(1, round(_LOST_S * fs_hz))) or text
    if cause == "not_finite":
        return _no_number(samples, own_part) or text
    return text


def _no_number(samples: NDArray[np.void], own_part: str) -> str:
    """Return where a value that is not a number came from; "" if the trip was not recorded."""
    latched = np.flatnonzero((samples["cause"] & 255) == CAUSES.index("not_finite"))
    if not latched.size:
        return ""
    row = samples[latched[0]]
    place = placed_cause(int(row["cause"]))
    # A pair that is only missing, of one axis of several, has no displacement and a force of 0.
    missing = bool(row["flags"] & FLAGS["lost"]) and row["f_read_n"] == 0.0
    read = np.isfinite(row["x_read_m"]) and np.isfinite(row["f_read_n"])
    if place.axis is not None or place.sensor is not None or not (read or missing):
        return (
            "A reading that is not a number was received from the drive: check the sensor, its "
            "connector, and what the drive sends for a sensor that has failed."
        )
    if not own_part:
        return (
            "A value that is not a number was computed from readings that were numbers: check the "
            "limits and the controller of the test."
        )
    return (
        "A value that is not a number was computed from readings that were numbers. The numerical "
        f"part is your own, {own_part}: check it first, for a division by zero, a square root or "
        "logarithm of a negative number, and a response that grows without bound. The ground "
        f"acceleration was {row['ag_mps2']:.4g} m/s², the measured force "
        f"{row['f_meas_n']:.4g} N. To find the step, run the test in virtual time, where the "
        "part may print its values."
    )


def _unusable(samples: NDArray[np.void], ticks: int) -> str:
    """Return what to do if readings arrived until the end but none was usable; "" if none arrived.

    ``ticks``: number of ticks without a usable pair after which a link is considered lost.
    """
    tripped = samples["state"] == STATES.index("TRIPPED")
    before = samples[: int(np.argmax(tripped))] if tripped.any() else samples
    last = before[before["flags"] & FLAGS["blind"] == 0][-ticks:]
    whole = last["flags"] & FLAGS["lost"] == 0
    beyond = last["code"] & STATUS["out_of_range"] != 0
    leapt = ~beyond & whole & (last["flags"] & FLAGS["predicted"] != 0)
    if 2 * np.count_nonzero(beyond | leapt) < ticks:
        return ""
    if np.count_nonzero(leapt) > np.count_nonzero(beyond):
        why = "the displacement jumped farther than anything can move; check its sensor"
    else:
        why = (
            "a sensor was at the end of its range, or the drive marked a reading as invalid; "
            "check the sensors of displacement and force"
        )
    return (
        f"Readings arrived, but no usable pair for {ticks} ticks{_as_it_came(last[whole])}: "
        f"{why} and its plug. The drive {_STOPPED}"
    )


def _as_it_came(whole: NDArray[np.void]) -> str:
    if not whole.size:
        return ""
    x_mm, f_kn = 1e3 * float(whole["x_read_m"][-1]), 1e-3 * float(whole["f_read_n"][-1])
    return f" (the last one read {x_mm:.6g} mm and {f_kn:.6g} kN, before the tare)"
