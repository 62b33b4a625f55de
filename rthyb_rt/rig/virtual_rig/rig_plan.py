"""Rate, faults and duration of a virtual rig."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, get_args

from rthyb_rt.config import STANDARD, Rate
from rthyb_rt.core import loop
from rthyb_rt.errors import InputError

POWER_CUT: Final = "power-cut"
FAULT_KINDS: Final[tuple[str, ...]] = (*get_args(loop.FaultKind), POWER_CUT)
DRIFT_MAX_PPM: Final = 199.0

_VALUES: Final[dict[str, tuple[float, float, str, float | None]]] = {
    "drop": (0.0, 1.0, "", 1.0),
    "drop-command": (0.0, 1.0, "", 1.0),
    "drop-force": (0.0, 1.0, "", 1.0),
    "delay": (0.0, 63.0, "ticks", 1.0),
    "jump": (-10.0, 10.0, "m", None),
    "force": (-1e9, 1e9, "N", None),
}
"""Lowest and highest value of a fault, its unit, and the value without a fault."""

_FOR_EVER: Final = 2**62
_KEYS: Final[dict[str, str]] = {
    "drop": "p",
    "drop-command": "p",
    "drop-force": "p",
    "delay": "ticks",
    "jump": "m",
    "force": "n",
}
"""Key of the value of each fault."""
_FAULT = re.compile(
    r"(?P<kind>[a-z-]+)@(?P<at>[0-9.eE+-]+)(?::(?P<for>[0-9.eE+-]+))?(?:=(?P<value>[0-9.eE+-]+))?"
)


@dataclass(frozen=True)
class RigPlan:
    """Rate, faults and duration of a virtual rig.

    Attributes:
        rate: sample rate; None: that of the rig file's link.
        seed: of sensor noise and faults; None: that of the rig file.
        drift_ppm: by how much its clock is fast, 199 at most.
        faults: the faults, in ticks of its own clock.
        power_cut_s: when its power fails, s after its start; None: never.
        seconds: how long it runs; None: until it is stopped.
        log_ticks: capacity of the log, in ticks.
    """

    seed: int | None = None
    drift_ppm: float = 0.0
    faults: tuple[loop.Fault, ...] = ()
    power_cut_s: float | None = None
    seconds: float | None = None
    log_ticks: int = 0
    rate: Rate | None = None


NO_PLAN: Final = RigPlan()
"""No faults."""


def parse_faults(
    texts: Sequence[str],
    axes: Sequence[str] = (),
    rate: Rate = STANDARD,
    kinds: Sequence[str] = FAULT_KINDS,
) -> tuple[tuple[loop.Fault, ...], float | None]:
    """Return the faults, and the time of a power cut.

    On a rig of several axes, all but ``power-cut`` begin with the axis: ``lower.drop@2.5``.

    Each is ``KIND@SECONDS[:DURATION_S][=VALUE]``, or ``KIND[:KEY=NUMBER,...]`` with the keys
    ``from`` and ``to`` (s) and that of its value: p of lost frames, ticks of a delay, m of a jump,
    n of a force. Without an end, a fault is permanent; the shortest lasts one tick.

    Args:
        texts: the faults.
        axes: names of the axes; () for a rig of one.
        rate: sample rate of the rig, in whose samples a fault begins and lasts.
        kinds: the kinds that are possible here.

    Raises:
        InputError: lists every text that is invalid.
    """
    faults: list[loop.Fault] = []
    cuts: list[float] = []
    problems = []
    for text in texts:
        try:
            axis, rest = _axis_of(text, axes)
            kind, at, lasts, value = _fault_parts(rest, kinds)
        except ValueError as error:
            problems.append(f"{text!r}: {error}")
            continue
        if kind == POWER_CUT:
            cuts.append(at)
            continue
        if axis is None:
            problems.append(
                f"{text!r}: on a rig with several axes a fault starts with the name of its axis, "
                f"such as {axes[0]}.{text}; the axes are {', '.join(axes)}"
            )
            continue
        ticks = _FOR_EVER if lasts is None else rate.ticks(lasts)
        first = round(at * rate.hz)
        faults.append(loop.Fault(kind, first, ticks, value, axis))  # type: ignore[arg-type]
    if problems:
        raise InputError("; ".join(problems))
    return tuple(faults), min(cuts, default=None)


def _axis_of(text: str, axes: Sequence[str]) -> tuple[int | None, str]:
    """Return the number of a fault's axis, or None if it names none, and the rest of the text."""
    if not axes:
        return 0, text
    name, dot, rest = text.partition(".")
    if not dot or not re.fullmatch("[a-z][a-z0-9_-]*", name):
        return None, text
    if name not in axes:
        raise ValueError(f"found the axis {name}; the axes are {', '.join(axes)}")
    return list(axes).index(name), rest


def _fault_parts(text: str, kinds: Sequence[str]) -> tuple[str, float, float | None, float]:
    if "@" not in text:
        return _named_parts(text, kinds)
    match = _FAULT.fullmatch(text)
    if match is None:
        raise ValueError("not KIND@SECONDS[:DURATION_S][=VALUE], such as drop@2.5:0.1=0.5")
    _known(match["kind"], kinds)
    at = _seconds(match["at"])
    lasts = None if match["for"] is None else _seconds(match["for"])
    return match["kind"], at, lasts, _value(match["kind"], match["value"])


def _known(kind: str, kinds: Sequence[str]) -> None:
    if kind in kinds:
        return
    if kind == POWER_CUT:
        raise ValueError(
            "a virtual rig in this process has no power supply of its own; use silence"
        )
    raise ValueError(f"no such kind of fault; allowed are {', '.join(kinds)}")


def _named_parts(text: str, kinds: Sequence[str]) -> tuple[str, float, float | None, float]:
    """Return the parts of ``drop:p=0.02,from=5,to=8``."""
    kind, _, rest = text.partition(":")
    _known(kind, kinds)
    allowed = ("from", "to", *([_KEYS[kind]] if kind in _KEYS else []))
    given: dict[str, str] = {}
    for part in rest.split(",") if rest else ():
        key, equals, number = part.partition("=")
        if not equals or key not in allowed or key in given:
            raise ValueError(
                f"found {part!r}; {kind} accepts {', '.join(allowed)}, each at most once, such as "
                f"{kind}:from=5,to=8"
            )
        given[key] = number
    at = _seconds(given.get("from", "0"))
    lasts = None if "to" not in given else _seconds(given["to"]) - at
    if lasts is not None and lasts <= 0.0:
        raise ValueError(f"it ends at {given['to']} s, before its start at {at:g} s")
    return kind, at, lasts, _value(kind, given.get(_KEYS.get(kind, "")))


def _value(kind: str, text: str | None) -> float:
    if kind not in _VALUES:
        if text is not None:
            raise ValueError(f"found the value {text}; {kind} takes no value")
        return 1.0
    low, high, unit, default = _VALUES[kind]
    if text is None and default is None:
        raise ValueError(f"{kind} needs a value in {unit}, such as {kind}@2.5:0.1={high / 1e3:g}")
    value = default if text is None else float(text)
    if value is None or not low <= value <= high:
        raise ValueError(
            f"found the value {text}; {kind} accepts {low:g} to {high:g} {unit}".rstrip()
        )
    return value


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1e6:
        raise ValueError(f"found {text} s; must be from 0 to 1e6 s")
    return value
