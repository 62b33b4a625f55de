"""What interrupted or ended a test, with its figures: value reached, limit, and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.core import RUNNING, STATES, STATUS
from rthyb_rt.numbers import delay, number
from rthyb_rt.record.recording import RecordedTest

if TYPE_CHECKING:
    from rthyb_rt.analysis.summary import SummarySettings
    from rthyb_rt.core import StationConfig


class _Watched(NamedTuple):
    """Name and unit of a watched quantity for messages; ``factor`` converts SI to the unit."""

    name: str
    unit: str
    factor: float


_WATCHED: Final[dict[str, _Watched]] = {
    "position": _Watched("command", "mm", 1e3),
    "velocity": _Watched("velocity of the command", "mm/s", 1e3),
    "increment": _Watched("step of the command", "mm", 1e3),
    "force": _Watched("force", "kN", 1e-3),
    "tracking": _Watched("tracking error", "mm", 1e3),
    "indicator": _Watched("slope of the tracking indicator", "mm²/s", 1e6),
    "energy": _Watched("energy error", "J", 1.0),
    "sensor_stuck": _Watched("the displacement was frozen for", "samples", 1.0),
    "sensor_jump": _Watched("the displacement jumped by", "mm", 1e3),
    "force_stuck": _Watched("the force was frozen for", "samples", 1.0),
    "force_jump": _Watched("the force jumped by", "kN", 1e-3),
    "rig_position": _Watched("command before the tare", "mm", 1e3),
    "rig_force": _Watched("force before the tare", "kN", 1e-3),
    "lost_pairs": _Watched("pairs lost", "%", 100.0),
    "lost_warning": _Watched("pairs lost", "%", 100.0),
    "skip_warning": _Watched("skipped", "% of the ticks", 100.0),
    "link_lost": _Watched("no usable pair for", "ticks", 1.0),
    "sensor_lost": _Watched("no usable reading for", "ticks", 1.0),
    "sensor_range": _Watched("the displacement read", "mm", 1e3),
    "force_range": _Watched("the load cell read", "kN", 1e-3),
    "sensor_disagrees": _Watched("differs from the other displacement sensors by", "mm", 1e3),
    "force_disagrees": _Watched("differs from the other load cells by", "kN", 1e-3),
    "skips": _Watched("skipped", "ticks", 1.0),
    "skip_share": _Watched("skipped", "% of the ticks", 100.0),
    "stalled": _Watched("this PC stalled for", "ticks", 1.0),
}
_TURNED: Final[dict[str, _Watched]] = {
    "position": _Watched("command", "mrad", 1e3),
    "force": _Watched("moment", "kN m", 1e-3),
}
"""Watched quantities of a rotation."""

_ALONE: Final[dict[str, _Watched]] = {
    "position": _Watched("displacement", "mm", 1e3),
}
"""Watched quantities of a sensor without an actuator."""

_OF_MOTION: Final = (
    "position", "velocity", "increment", "force", "tracking", "indicator", "energy",
    "rig_position", "rig_force",
)  # fmt: skip
"""Limits that a growing motion reaches, whatever the reason for its growth."""
_KEYS: Final = {
    "position": "command_position_m",
    "force": "force_n",
    "tracking": "tracking_error_m",
}
NONE: Final = ("", "none", "completed", "operator", "signal")
"""Causes that are not faults."""

_OFF_COURSE: Final = [STATES.index(name) for name in ("HOLD", "RAMP_OUT", "TRIPPED")]


@dataclass(frozen=True)
class Met:
    """A limit that interrupted or ended a test.

    Attributes:
        cause: cause in the words of the station.
        value, limit: value reached and limit, SI; both 0 if the cause has no number.
        time_s: time since the first sample of the test proper; nan if unknown.
        alpha: delay estimate at that time, samples; nan if unknown.
    """

    cause: str
    value: float
    limit: float
    time_s: float = float("nan")
    alpha: float = float("nan")


def whose(
    axis: int | None, interface: int | None, axes: Sequence[str], interfaces: Sequence[str]
) -> str:
    """Return the axis or direction to which a cause belongs, in words; "" if none.

    Args:
        axis, interface: their numbers in the station.
        axes, interfaces: their names; () for one axis.
    """
    if axis is not None and axis < len(axes):
        return f"axis {axes[axis]}"
    if interface is not None and interface < len(interfaces):
        return f"direction {interfaces[interface]}"
    return ""


def sensor_of(config: StationConfig, sensor: int) -> str:
    """Return a sensor without an actuator, to which a cause belongs, in words.

    Args:
        config: settings of the station.
        sensor: its number in the station.
    """
    name = config.sensors[sensor].name if sensor < len(config.sensors) else ""
    return f"sensor {name or sensor + 1}"


def figures(
    cause: str, value: float, limit: float, *, turns: bool = False, alone: bool = False
) -> str:
    """Return value and limit in words: "force 15.0 kN (limit 15 kN)"; "" without figures.

    Args:
        cause: cause in the words of the station.
        value, limit: value reached and limit, SI.
        turns: they belong to a rotation, in rad and N m.
        alone: they belong to a sensor without an actuator.
    """
    # Skipped ticks are counted consecutively, or as a share.
    watched = _WATCHED.get("skip_share" if cause == "skips" and limit < 1.0 else cause)
    if turns:
        watched = _TURNED.get(cause, watched)
    if alone:
        watched = _ALONE.get(cause, watched)
    if watched is None or not limit:
        return ""
    met = abs(value) * watched.factor
    counted = watched.unit in ("samples", "ticks")
    text = f"{f'{met:.0f}' if counted else number(met)} {watched.unit}"
    return f"{watched.name} {text} (limit {limit * watched.factor:g} {watched.unit})"


def found(rec: RecordedTest, given: SummarySettings) -> Met | None:
    """Return what interrupted or ended a recorded test, None if nothing did.

    For older recordings without these figures, the value is taken from the rows and the limit from
    the test file.
    """
    facts = facts_of(rec.meta)
    rows = rec.samples
    row = _row(rec)
    cause = str(facts.get("cause", "")) if facts else _cause_of(rows)
    if cause in NONE:
        return None
    value, limit = (float(facts.get(key, 0.0)) for key in ("cause_value", "cause_limit"))
    if not limit and rows.size:
        value, limit = _of_rows(rows, row, cause), given.limits.get(_KEYS.get(cause, ""), 0.0)
    if not rows.size:
        return Met(cause, value, limit)
    return Met(cause, value, limit, float(rec.time_s()[row]), float(rows["alpha"][row]))


def facts_of(meta: dict[str, Any]) -> dict[str, Any]:
    """Return the station's statement about a test, in real or virtual time; {} if there is none."""
    for name in ("station", "real_time"):
        facts = meta.get(name)
        if isinstance(facts, dict):
            return facts
    return {}


def _row(rec: RecordedTest) -> int:
    """Return the last row before the test was interrupted."""
    off = np.isin(rec.samples["state"], _OFF_COURSE)
    started = np.flatnonzero(rec.samples["state"] == RUNNING)
    first = np.flatnonzero(off & (np.arange(off.size) >= (started[0] if started.size else 0)))
    return max(0, int(first[0]) - 1 if first.size else off.size - 1)


def _cause_of(rows: NDArray[np.void]) -> str:
    """Return the cause in the code of the last row, for virtual-time recordings before 0.2."""
    code = int(rows["code"][-1]) if rows.size else 0
    if not code & STATUS["trip"]:
        return ""
    return next((name for name in _KEYS if code & STATUS[f"{name}_limit"]), "")


def _of_rows(rows: NDArray[np.void], row: int, cause: str) -> float:
    near = rows[max(0, row - 1) : row + 2]
    values = {
        "position": near["x_plc_m"],
        "force": near["f_meas_n"],
        "tracking": near["x_meas_m"] - near["x_num_m"],
    }.get(cause, np.zeros(1))
    return float(np.max(np.abs(values[np.isfinite(values)]), initial=0.0))


def sentence(met: Met, given: SummarySettings) -> str:
    """Return the end of a test with its figures and what `rthyb check` knows of it.

    Args:
        met: the limit that was reached.
        given: settings of the test.

    Returns:
        Such as "force 15.0 kN (limit 15 kN) at 3.1 s; without compensation this structure remains
        stable up to a delay of 3.3 samples (3.2 ms); the rig has 17 samples (16.6 ms)"; "" without
        figures.
    """
    text = figures(met.cause, met.value, met.limit)
    if not text:
        return ""
    if np.isfinite(met.time_s):
        text += f" at {met.time_s:.1f} s"
    known = _known(met, given) if met.cause in _OF_MOTION else ""
    return f"{text}; {known}" if known else text


def _known(met: Met, given: SummarySettings) -> str:
    """Return what was known before the test ran that explains the end."""
    peak = {"position": given.reference_peak_m, "force": given.reference_peak_n}.get(met.cause)
    if peak is not None and peak > met.limit:
        watched = _WATCHED[met.cause]
        reached = f"{number(peak * watched.factor)} {watched.unit}"
        return f"even the reference simulation reaches {reached}"
    critical, identified = given.critical_delay_samples, given.alpha_identified
    if critical is None or identified is None or np.isinf(critical):
        return ""
    survives, rig_has = delay(critical, given.fs_hz, 2), delay(identified, given.fs_hz)
    if not given.plc_enabled:
        helped = " phase lead" if given.rfc_enabled else " compensation"
        return (
            f"without{helped} this structure remains stable up to a delay of {survives}; the rig "
            f"has {rig_has}"
        )
    stood = "" if np.isnan(met.alpha) else f", alpha was at {delay(met.alpha, given.fs_hz)}"
    return (
        f"this structure tolerates an error of {survives} in alpha; the rig's delay is "
        f"{rig_has}{stood}"
    )
