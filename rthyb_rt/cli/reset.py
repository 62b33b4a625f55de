"""``rthyb reset``: makes a drive follow again that has stopped by itself."""

from __future__ import annotations

from rthyb_rt.cli import terminal
from rthyb_rt.cli.connecting import connected, joined, load_within
from rthyb_rt.cli.inputs import AxisOption, JsonOption, LimitedRigArgument, RigSetOption

SCHEMA = "rthyb-reset/1"


def reset(
    rig: LimitedRigArgument,
    axis: AxisOption = None,
    settings: RigSetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a drive follow commands again after it stopped.

    After a trip, or when commands end without notice, a drive stays stopped until its operator
    resets it. First find out why it stopped and check that nothing is in its way, then reset it.
    Nothing moves: the drive is commanded to hold its position. For a rig that is controlled by a
    service, use `rthyb ctl reset`.

    On a rig of several axes, the drives are reset one after another, or only that of --axis.

    \b
    Examples:
      rthyb reset my-rig.toml
      rthyb reset two-axis-frame --axis lower

    The exit code is 5 if the drive stays stopped; the message says why.
    """
    from rthyb_rt.rig.commissioning import stops

    found = []
    for within in load_within(rig, settings, axis):
        with connected(within) as connection:
            released = stops.release(connection)
        words = (
            "was stopped and now follows again"
            if released
            else "follows; there is nothing to reset"
        )
        print(f"{within.name}: the drive {words}", file=terminal.people(as_json), flush=True)
        found.append((within, {"schema": SCHEMA, **within.named, "reset": released}))
    if as_json:
        terminal.print_json(joined(found))
