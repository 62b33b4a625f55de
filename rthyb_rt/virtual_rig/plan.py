"""What a virtual rig does besides following its commands."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, get_args

from rthyb_rt import core, loop
from rthyb_rt.errors import InputError

POWER_CUT: Final = "power-cut"
FAULT_KINDS: Final[tuple[str, ...]] = (*get_args(loop.FaultKind), POWER_CUT)
DRIFT_MAX_PPM: Final = 199.0

_FOR_EVER: Final = 2**62
_FAULT = re.compile(
    r"(?P<kind>[a-z-]+)@(?P<at>[0-9.eE+-]+)(?::(?P<for>[0-9.eE+-]+))?(?:=(?P<value>[0-9.eE+-]+))?"
)


@dataclass(frozen=True)
class Plan:
    """What a virtual rig does besides following its commands.

    Attributes:
        seed: of sensor noise and of faults; None takes the rig file's.
        drift_ppm: how much its clock is fast, 199 at most.
        faults: what goes wrong, in ticks of its own.
        power_cut_s: when its power goes, s after its start; None: never.
        seconds: how long it runs; None: until it is stopped.
        log_ticks: how many ticks the log has room for.
    """

    seed: int | None = None
    drift_ppm: float = 0.0
    faults: tuple[loop.Fault, ...] = ()
    power_cut_s: float | None = None
    seconds: float | None = None
    log_ticks: int = 0


NO_PLAN: Final = Plan()
"""Nothing goes wrong."""


def parse_faults(texts: Sequence[str]) -> tuple[tuple[loop.Fault, ...], float | None]:
    """Return the faults, and when the power goes, from ``KIND@SECONDS[:DURATION_S][=VALUE]``.

    Without a duration a fault stays to the end; the shortest one lasts a tick.

    Raises:
        InputError: with every text that cannot be understood.
    """
    faults: list[loop.Fault] = []
    cuts: list[float] = []
    problems = []
    for text in texts:
        try:
            kind, at, lasts, value = _fault_parts(text)
        except ValueError as error:
            problems.append(f"{text!r}: {error}")
            continue
        if kind == POWER_CUT:
            cuts.append(at)
            continue
        ticks = _FOR_EVER if lasts is None else max(round(lasts * core.FS_HZ), 1)
        first = round(at * core.FS_HZ)
        faults.append(loop.Fault(kind, first, ticks, value))  # type: ignore[arg-type]
    if problems:
        raise InputError("; ".join(problems))
    return tuple(faults), min(cuts, default=None)


def _fault_parts(text: str) -> tuple[str, float, float | None, float]:
    match = _FAULT.fullmatch(text)
    if match is None:
        raise ValueError("not KIND@SECONDS[:DURATION_S][=VALUE], such as drop@2.5:0.1=0.5")
    if match["kind"] not in FAULT_KINDS:
        raise ValueError(f"no such kind of fault, allowed are {', '.join(FAULT_KINDS)}")
    at = _seconds(match["at"])
    lasts = None if match["for"] is None else _seconds(match["for"])
    value = 1.0 if match["value"] is None else float(match["value"])
    if not math.isfinite(value):
        raise ValueError("the value must be a number")
    return match["kind"], at, lasts, value


def _seconds(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1e6:
        raise ValueError(f"found {text} s, allowed is 0 to 1e6 s")
    return value
