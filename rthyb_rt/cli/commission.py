"""``rthyb commission``: the checks that a rig needs before its first test."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated

import typer

from rthyb_rt.cli import interrupts, quantities, terminal
from rthyb_rt.cli.connecting import Within, connected, joined, load_within
from rthyb_rt.cli.inputs import AxisOption, JsonOption, LimitedRigArgument, RigSetOption
from rthyb_rt.cli.quantities import Allowed
from rthyb_rt.errors import InputError

if TYPE_CHECKING:
    from rthyb_rt.rig.commissioning.certificate import Certificate
    from rthyb_rt.rig.commissioning.guide import CommissioningSettings

DIFFERENCE = 8

DISTANCE = Allowed("m", "mm", -0.1, 0.1, "a length from -100 mm to 100 mm", "1 mm")


def commission(
    rig: LimitedRigArgument,
    steps: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Steps to run, separated by commas: link, polarity, limits, watchdog, trip. "
            "Earlier results of other steps are kept. Default: all steps.",
            show_default=False,
        ),
    ] = None,
    distance: Annotated[
        str,
        typer.Option(
            metavar="LENGTH",
            help="Distance of the small motions, with its sign, at most limits.command_position_m. "
            "On a rig with sensors without an actuator, the actuator also moves as far to the "
            "other side: twice the distance must be within the limit.",
        ),
    ] = "1 mm",
    yes: Annotated[
        bool, typer.Option("--yes", help="Do not ask before each motion; for scripts.")
    ] = False,
    axis: AxisOption = None,
    settings: RigSetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check link, signs, limits and stops of a rig.

    Stand by the emergency stop. You are asked before each motion. Each passed check is saved with
    its date in RIG.commissioned.json beside the rig file. A real-time test requires these checks,
    and they must be repeated when the link, calibration, actuator, sensors or limits in the rig
    file change.

    On a rig of several axes, the axes are commissioned one after another, each with its own
    RIG.AXIS.commissioned.json, while the other drives receive no commands and do not move; --axis
    selects a single axis. If there are sensors without an actuator, the other drives must be
    switched on, because every sensor is compared with the readings of all axes.

    \b
    Steps:
      link       feedback arrives 1024 times per second; noise and zero at rest
      polarity   a slow motion: displacement follows it, force rises with it, and
                 every sensor without an actuator changes as its along says
      limits     each limit, lowered for one small motion, does what the rig file says
      watchdog   without commands the drive stops by itself and stays stopped until reset
      trip       on TRIPPED the drive stops at once

    \b
    Examples:
      rthyb commission my-rig.toml
      rthyb commission my-rig.toml --steps polarity,limits --distance "0.5 mm"
      rthyb commission two-axis-frame --axis upper

    The exit code is 8 if a check failed.
    """
    from rthyb_rt.lab import sensor_wires
    from rthyb_rt.rig.commissioning import certificate, guide

    wanted = _steps(steps)
    distance_m = quantities.read(distance, "--distance", DISTANCE)
    if abs(distance_m) < 1e-5:
        raise typer.BadParameter(
            f'found "{distance}"; at least 0.01 mm is needed to see any effect',
            param_hint="--distance",
        )
    people = terminal.people(as_json)

    def tell(text: str) -> None:
        print(text, file=people, flush=True)

    ask = _asker(yes, tell)
    plan = guide.CommissioningSettings(
        wanted, distance_m, ask, tell, lambda text: None if yes else ask(text)
    )
    made, documents = [], []
    found_axes = load_within(rig, settings, axis)
    if (whole := found_axes[0].whole) is not None:
        whole.refuse_silent_sensors("commissioning")
        sensor_wires.check(whole)
    for k, within in enumerate(found_axes):
        if k:
            tell("")
        found, target = _commission(within, plan)
        _print_result(found, people)
        tell(f"\nCommissioning  {target}")
        made.append(found)
        documents.append((within, {**found.as_json(), "path": str(target)}))
    for warning in certificate.inconclusive(whole or found_axes[0].rig, found_axes[0].path):
        tell(f"\nNot commissioned: {warning}")
    if as_json:
        terminal.print_json(joined(documents))
    came = [one.steps[name] for one in made for name in wanted if name in one.steps]
    if any(step.passed is False for step in came):
        raise typer.Exit(DIFFERENCE)


def _commission(within: Within, plan: CommissioningSettings) -> tuple[Certificate, Path]:
    from rthyb_rt.rig.commissioning import certificate, guide

    known, _ = certificate.find(within.rig, within.path, within.axis)
    target = certificate.place(within.path, within.axis)
    tell = plan.tell

    def keep(found: Certificate) -> None:
        certificate.write(target, found)
        interrupts.wrote(target)

    with connected(within, hears=True) as connection:
        tell(f"{within.name} over {connection.opened.name}")
        made = guide.commission(connection, plan, known, keep, within.axis)
    tell("")
    return made, target


def _steps(text: str | None) -> tuple[str, ...]:
    from rthyb_rt.rig.commissioning.certificate import STEPS

    if text is None:
        return STEPS
    given = tuple(part.strip() for part in text.split(","))
    unknown = [name for name in given if name not in STEPS]
    if unknown:
        raise typer.BadParameter(
            f'found "{unknown[0]}"; the steps are {", ".join(STEPS)}', param_hint="--steps"
        )
    return given


def _asker(yes: bool, tell: Callable[[str], None]) -> Callable[[str], bool]:
    def ask(question: str) -> bool:
        if yes:
            tell(f"{question} yes")
            return True
        try:
            return typer.confirm(question, err=True)
        except typer.Abort:
            if interrupts.received() is not None:
                raise KeyboardInterrupt from None
            raise InputError(
                "ended where an answer was needed, and nothing moves without one; answer y or n "
                "in a terminal, or use --yes, which answers every question with yes",
                where="standard input",
            ) from None

    return ask


def _print_result(made: Certificate, people: IO[str]) -> None:
    from rthyb_rt.rig.commissioning.certificate import STEPS

    words = {True: "passed", False: "FAILED", None: "not checked"}
    rows = [
        (name, words[step.passed], step.date)
        for name in STEPS
        if (step := made.steps.get(name)) is not None
    ]
    missing = [(name, "not done", "") for name in STEPS if name not in made.steps]
    terminal.print_table([*rows, *missing], people)
