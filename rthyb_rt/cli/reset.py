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
    """Have a drive follow again that has stopped by itself.

    After a trip, and where commands ceased without a farewell, a drive stands until its operator
    resets it: look why it stopped, and at what is in its way, then reset it. Nothing moves: the
    drive is told to stay where it stands. A rig of the service is reset by `rthyb ctl reset`.

    \b
    Example:
      rthyb reset my-rig.toml

    Exit code 5 says that it stays stopped, and why.
    """
    from rthyb_rt.rig.commissioning import stops

    given, _ = load_rig(rig, settings)
    with connected(given) as connection:
        released = stops.release(connection)
    words = "was stopped, and follows again" if released else "follows: there is nothing to reset"
    print(f"{given.rig.name}: the drive {words}", file=terminal.people(as_json))
    if as_json:
        terminal.print_json({"schema": SCHEMA, "rig_name": given.rig.name, "reset": released})
