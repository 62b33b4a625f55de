"""Whether the closed loop of a test is stable, on a rig of one axis or of several."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rthyb_rt.analysis import axes_noise, axes_roots, command_noise, loop_roots
from rthyb_rt.analysis.loop_roots import LoopVerdict
from rthyb_rt.config import response
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.lab.experiment import Setup

_FAST_AXES: Final = (
    "compensate the delay of every axis (the control law matrix also compensates their coupling), "
    "increase the damping of the structure, or lower controller.rfc.cutoff_hz"
)
_CALMER_KEYS: Final = {"roll_off_hz": "lower", "filter_s": "raise", "order": "lower"}
"""Settings with which a law leads fast motion less, by the last part of their keys."""
_INVERSE: Final = "inverse"


def judge(setup: Setup) -> LoopVerdict | None:
    """Return the stability of the loop of a test; None if the rig's response is not known."""
    return loop_roots.judge(setup) if setup.group is None else axes_roots.judge(setup)


def remarks(setup: Setup, found: LoopVerdict | None) -> list[str]:
    """Return remarks on a loop that is unstable or nearly so, or passes on much noise."""
    if found is None:
        return []
    fast = _advice(setup, found) if setup.group is None else _FAST_AXES
    if found.unstable:
        # What noise asks of a loop in which it is not damped has no standard deviation.
        return list(filter(None, [loop_roots.remark(found, fast)]))
    noise = command_noise.judge(setup) if setup.group is None else axes_noise.judge(setup)
    return [text for text in (loop_roots.remark(found, fast), command_noise.remark(noise)) if text]


def _advice(setup: Setup, found: LoopVerdict | None) -> str:
    """Return what to do against an instability at a resonance, with the keys of the test's law."""
    config = setup.controller
    law, other = config.law.law, f"use the control law {_INVERSE}"
    if law.passes or not config.lead_enabled:
        return f"nothing compensates the delay of the rig: {other}"
    ways = [
        f"{_CALMER_KEYS[last]} controller.{p.key}"
        for p, value in zip(law.parameters, config.law.values(), strict=True)
        if (last := p.key.rpartition(".")[2]) in _CALMER_KEYS
        and (value > p.low or _CALMER_KEYS[last] == "raise")
    ]
    if law.parameter("w1") is not None and not law.as_printed:
        swept = f"{response.TOP_HZ:g} Hz"
        ways.append(f"remove controller.w1 and w2 if the rig was identified up to {swept}")
    cutoff_hz = config.rfc.cutoff_hz
    if config.rfc.enabled and found is not None and not 0.0 < cutoff_hz <= found.frequency_hz:
        # A low-pass below the resonance has done what it can.
        ways.append("set controller.rfc.cutoff_hz below the resonance")
    if law.name != _INVERSE:
        ways.append(other)
    return f"the lead drives a resonance of actuator and specimen: {_one_of(ways)}"


def _one_of(ways: list[str]) -> str:
    """Return alternatives as a list in words."""
    *first, last = ways
    return f"{', '.join(first)}, or {last}" if len(first) > 1 else " or ".join(ways)


def remarks_of(setup: Setup) -> list[str]:
    """Return the remarks for a test in which nothing real can be damaged."""
    return remarks(setup, judge(setup))


def is_real(setup: Setup) -> bool:
    """Return whether a link of the rig leads to a real drive."""
    links = [setup.rig.link] if setup.group is None else [a.link for a in setup.group.rig.axis]
    return any(link is not None and not link.virtual for link in links)


def demand(setup: Setup) -> list[str]:
    """Refuse an unstable test on a real link; return the remarks for any other test.

    Raises:
        InputError: the loop is unstable, and a link of the rig leads to a real drive.
    """
    found = judge(setup)
    texts = remarks(setup, found)
    if found is not None and found.unstable and is_real(setup):
        raise InputError(
            "; ".join(texts), f'test "{setup.test.test.name}" on rig "{setup.rig_file.rig.name}"'
        )
    return texts
