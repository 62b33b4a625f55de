"""``rthyb reset``: a drive that has stopped by itself follows again, on its operator's word."""

from __future__ import annotations

from rthyb_rt.cli import terminal
from rthyb_rt.cli.connecting import connected, load_rig
from rthyb_rt.cli.inputs import JsonOption, LimitedRigArgument, RigSetOption

SCHEMA = "rthyb-reset/1"


def reset(
    rig: LimitedRigArgument,
    settings: RigSetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Make a drive follow commands again after it stopped.

    After a trip, or when commands end without a proper goodbye, a drive stays stopped until its
    operator resets it. First find out why it stopped and check that nothing is in its way, then
    reset it. Nothing moves: the drive is told to stay where it stands. For a rig that a service
    runs, use `rthyb ctl reset`.

    \b
    Example:
      rthyb reset my-rig.toml

    The exit code is 5 if the drive stays stopped; the message says why.
    """
    from rthyb_rt.rig.commissioning import stops

    given, _ = load_rig(rig, settings)
    with connected(given) as connection:
        released = stops.release(connection)
    words = "was stopped, and follows again" if released else "follows: there is nothing to reset"
    print(f"{given.rig.name}: the drive {words}", file=terminal.people(as_json))
    if as_json:
        terminal.print_json({"schema": SCHEMA, "rig_name": given.rig.name, "reset": released})
