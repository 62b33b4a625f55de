"""Whether the closed loop of a test is stable, on a rig of one axis or of several."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from rthyb_rt.analysis import axes_roots, loop_roots
from rthyb_rt.analysis.loop_roots import LoopVerdict
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.lab.experiment import Setup

_FAST_AXES: Final = (
    "compensate the delay of every axis (the control law matrix also compensates their coupling), "
    "increase the damping of the structure, or lower controller.rfc.cutoff_hz"
)


def judge(setup: Setup) -> LoopVerdict | None:
    """Return the stability of the loop of a test; None if the rig's response is not known."""
    return loop_roots.judge(setup) if setup.group is None else axes_roots.judge(setup)


def remark(setup: Setup, found: LoopVerdict | None) -> str | None:
    """Return a remark for the user on a loop that is unstable or nearly so, or None."""
    if setup.group is None:
        return loop_roots.remark(found)
    return loop_roots.remark(found, _FAST_AXES)


def remark_of(setup: Setup) -> str | None:
    """Return the remark for a test in which nothing real can be damaged."""
    return remark(setup, judge(setup))


def is_real(setup: Setup) -> bool:
    """Return whether a link of the rig leads to a real drive."""
    links = [setup.rig.link] if setup.group is None else [a.link for a in setup.group.rig.axis]
    return any(link is not None and not link.virtual for link in links)


def demand(setup: Setup) -> str | None:
    """Refuse an unstable test on a real link; return the remark for any other test.

    Raises:
        InputError: the loop is unstable, and a link of the rig leads to a real drive.
    """
    found = judge(setup)
    text = remark(setup, found)
    if found is not None and found.unstable and is_real(setup):
        raise InputError(
            text or "", f'test "{setup.test.test.name}" on rig "{setup.rig_file.rig.name}"'
        )
    return text
