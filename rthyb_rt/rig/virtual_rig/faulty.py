"""A test on a virtual rig whose drive, sensors and link fail at prescribed ticks."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import get_args

from rthyb_rt.config import STANDARD, Rate
from rthyb_rt.core import loop
from rthyb_rt.lab import realtime
from rthyb_rt.lab.experiment import Progress, Setup
from rthyb_rt.lab.virtual_time import HOLD_S
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.rig.links import opening
from rthyb_rt.rig.virtual_rig.rig_plan import RigPlan, parse_faults
from rthyb_rt.rig.virtual_rig.serving import in_step


def parse_mishaps(
    texts: Sequence[str], axes: Sequence[str] = (), rate: Rate = STANDARD
) -> tuple[loop.Fault, ...]:
    """Return the faults of a test, in ticks from its first sample; arguments as for `parse_faults`.

    Raises:
        InputError: lists every text that is invalid or needs a virtual rig in its own process.
    """
    return parse_faults(texts, axes, rate, get_args(loop.FaultKind))[0]


def run(
    setup: Setup,
    faults: Sequence[loop.Fault],
    *,
    progress: Progress | None = None,
    operator: realtime.Operator | None = None,
    warn: Callable[[str], None] = lambda _: None,
    save: Callable[[RecordedTest], None] | None = None,
) -> RecordedTest:
    """Run a test with faults: frames, drive and watchdogs are as on a rig, but time is virtual.

    Limits that no file states act as they would on a rig, to show what would happen there.

    Args:
        setup: the test; its link is replaced by a socket pair.
        faults: the faults, in ticks from the first sample of the test proper.
        progress, operator, warn, save: as in `rthyb_rt.lab.realtime.run`.

    Returns:
        The recording; its clock is "stepped".

    Raises:
        CoreError: a fault is out of range.
        RthybError: as `rthyb_rt.lab.realtime.run`.
    """
    setup = dataclasses.replace(setup, rig=setup.rig.model_copy(update={"link": None}))
    if setup.group is not None:
        group = dataclasses.replace(setup.group, rig=setup.group.rig.without_links())
        setup = dataclasses.replace(setup, group=group)
    names = setup.axis_names
    ours, theirs = opening.socket_pairs(names) if names else opening.socket_pair()
    with ours, theirs, in_step(setup.rig_file, theirs, RigPlan(rate=setup.rate)) as drive:
        # A fault that is out of range is refused now, not in the middle of the test.
        drive.schedule(faults)
        drive.schedule(())
        begun = False

        def tick() -> None:
            nonlocal begun
            if not begun and drive.received_state == "RUNNING":
                begun = True
                drive.schedule(
                    [dataclasses.replace(f, first=drive.ticks + f.first) for f in faults]
                )
            drive.tick()

        return realtime.run(
            setup,
            ours,
            clock="stepped",
            before_tick=tick,
            progress=progress,
            operator=operator,
            hold_s=HOLD_S,
            warn=warn,
            save=save,
        )
