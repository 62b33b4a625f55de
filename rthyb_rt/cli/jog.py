"""``rthyb jog``: a small motion of the actuator."""

from __future__ import annotations

from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import quantities, terminal
from rthyb_rt.cli.connecting import connected, load_one_within
from rthyb_rt.cli.inputs import AxisOption, JsonOption, LimitedRigArgument, RigSetOption
from rthyb_rt.cli.quantities import Allowed

if TYPE_CHECKING:
    from rthyb_rt.rig.commissioning.jogging import Jogged

SCHEMA = "rthyb-jog/1"
LIMIT_TRIP = 6
UNPUNCTUAL = 7
REVERSED = 8

DISTANCE = Allowed("m", "mm", -1.0, 1.0, "a length from -1 m to 1 m", "2 mm")
SPEED = Allowed("m/s", "mm/s", 1e-6, 1.0, "a velocity from 0.001 mm/s to 1 m/s", "1 mm/s")

# So that a negative distance is not taken for an option.
CONTEXT = {"ignore_unknown_options": True, "help_option_names": ["--help"]}


def jog(
    rig: LimitedRigArgument,
    distance: Annotated[
        str,
        typer.Argument(
            metavar="DISTANCE",
            help='Distance with its sign, such as "-0.5 mm".',
            show_default=False,
        ),
    ],
    speed: Annotated[
        str, typer.Option(metavar="VELOCITY", help="Highest speed of the motion.")
    ] = "1 mm/s",
    axis: AxisOption = None,
    settings: RigSetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Move the actuator slowly by a distance.

    All limits of the rig file apply: the position limit counts from where the actuator is, the
    force limit from zero load. Ctrl-C decelerates, and the actuator stays where it comes to rest;
    a second Ctrl-C trips. Without a [link] in the rig file, a virtual rig in a separate process is
    moved. On a rig of several axes, --axis selects the one to move; the other drives receive no
    commands and do not move. Ranges and limits of sensors without an actuator act as in a test.

    \b
    Examples:
      rthyb jog my-rig.toml "2 mm"
      rthyb jog my-rig.toml "-0.5 mm" --speed "0.2 mm/s"
      rthyb jog two-axis-frame "0.5 mm" --axis upper

    The exit code is 6 if a limit or a trip ended the motion, 5 if it was refused and nothing moved,
    and 8 if it moved far enough to show that a sign is wrong: that of the displacement, or that of
    the force (k_e < 0).
    """
    from rthyb_rt.rig.commissioning import jogging

    distance_m = quantities.read(distance, "DISTANCE", DISTANCE)
    speed_m_per_s = quantities.read(speed, "--speed", SPEED)
    within = load_one_within(rig, settings, axis)
    with connected(within, hears=True) as connection:
        found = jogging.jog(connection, distance_m, speed_m_per_s)
    file = terminal.people(as_json)
    _print_result(within.name, found, file)
    if as_json:
        terminal.print_json({"schema": SCHEMA, **within.named, **found.as_json()})
    status = _status(found)
    if status:
        raise typer.Exit(status)


def _status(found: Jogged) -> int:
    from rthyb_rt.lab.realtime import TIMING_CAUSES

    if found.cause in TIMING_CAUSES:
        return UNPUNCTUAL
    well = found.cause in ("completed", "operator", "none") and found.state != "TRIPPED"
    if not well:
        return LIMIT_TRIP
    return REVERSED if found.reversed else 0


def _reading(x_m: float) -> str:
    """Return a displacement to 0.1 um, however near zero: ``−1.0001 mm``."""
    return f"{1e3 * x_m:.4f} mm".replace("-", "−")


def _sensor_rows(found: Jogged) -> list[tuple[str, str, str]]:
    """Return a row for each sensor without an actuator."""
    from rthyb_rt.numbers import quantity

    rows = []
    for name, seen in found.sensors.items():
        unit = ("mm", 1e3) if seen["unit"] == "m" else ("N", 1.0)
        change = "no number" if seen["change"] is None else quantity(seen["change"], *unit, 4)
        note = f"change of the sensor; {quantity(seen['expected'], *unit, 4)} by its along"
        rows.append((name, change, note))
    return rows


def _print_result(name: str, found: Jogged, file: IO[str]) -> None:
    from rthyb_rt.numbers import quantity

    stiffness = "too little motion to tell"
    if found.stiffness_n_per_m is not None:
        stiffness = quantity(found.stiffness_n_per_m, "kN/m", 1e-3, 4)
    print(f"{name}: {found.end_reason}\n", file=file)
    terminal.print_table(
        [
            ("Start", _reading(found.start_m), "reading of the displacement"),
            ("End", _reading(found.end_m), "the same"),
            ("Moved", quantity(found.moved_m, "mm", 1e3, 4),
             f"{quantity(found.asked_m, 'mm', 1e3)} requested"),
            ("Force", f"{quantity(found.start_n, 'N', 1.0, 4)} to "
             f"{quantity(found.end_n, 'N', 1.0, 4)}", "reading of the load cell"),
            ("Stiffness", stiffness, "change of force over displacement"),
            *_sensor_rows(found),
        ],
        file,
    )  # fmt: skip
    for fault in found.faults:
        print(f"Attention: {fault}", file=file)
