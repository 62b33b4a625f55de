"""How a test ends, in words and in exit codes."""

from __future__ import annotations

from typing import Final

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
    "skips": "too many skipped ticks",
    "stalled": "this PC stalled",
    "heartbeat": "the program was silent for a second",
}
TIMING_CAUSES: Final = ("skips", "stalled", "heartbeat")
"""Causes that lie in this PC and not in the test."""


class TimingError(RthybError):
    """This PC is not as punctual as the test demands."""

    exit_code = 7


class RefusedError(RthybError):
    """A command that is not for the present state."""

    exit_code = 5


def end_reason(state: str, cause: str) -> str:
    """Return in words how a test ended: "completed", or what took it off its course."""
    words = WORDS.get(cause, cause.replace("_", " "))
    if state == "TRIPPED":
        return f"tripped: {words}"
    if cause == "operator":
        return "stopped by the operator"
    if cause == "completed":
        return "completed"
    return "ended before it began" if cause == "none" else f"ramped out: {words}"
