"""``rthyb rig``: a virtual rig at a link."""

from __future__ import annotations

import os
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import interrupts, terminal
from rthyb_rt.cli.connecting import axes_of
from rthyb_rt.cli.inputs import JsonOption, RigSetOption
from rthyb_rt.errors import InputError, RthybError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from rthyb_rt.config import AxesRig, Rate, RigFile
    from rthyb_rt.config.rigfile import LinkTable
    from rthyb_rt.rig.virtual_rig import RigPlan, RigResult, WireEnd

SCHEMA = "rthyb-rig-run/1"


def rig(
    file: Annotated[
        str | None,
        typer.Argument(
            metavar="RIG",
            help="Rig file or name of a shipped rig. Default: the rig of the built-in test.",
            show_default=False,
        ),
    ] = None,
    can: Annotated[
        str | None,
        typer.Option(
            metavar="INTERFACE",
            help="CAN interface, such as vcan0; for several axes one each, separated by commas.",
            show_default=False,
        ),
    ] = None,
    serial: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Serial line; for several axes one each, separated by commas.",
            show_default=False,
        ),
    ] = None,
    socket: Annotated[
        str | None,
        typer.Option(
            metavar="PATH",
            help="Socket to which controllers connect; for several axes one each, separated by "
            "commas.",
            show_default=False,
        ),
    ] = None,
    pty: Annotated[
        bool,
        typer.Option(
            "--pty", help="Create a pseudo-terminal (one for each axis) and print its path."
        ),
    ] = False,
    settings: RigSetOption = None,
    seed: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            min=0,
            max=2**32 - 1,
            help="Seed for sensor noise and faults, instead of the rig file's.",
            show_default=False,
        ),
    ] = None,
    drift_ppm: Annotated[
        float,
        typer.Option(
            metavar="PPM", help="Parts per million by which its clock runs fast, -199 to 199."
        ),
    ] = 0.0,
    fault: Annotated[
        list[str] | None,
        typer.Option(
            metavar="[AXIS.]KIND@S[:S][=VALUE]",
            help="Fault, start, duration and value, as listed above. Can be repeated.",
            show_default=False,
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="N", help="End after N seconds.", show_default=False),
    ] = None,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write what the drive received and did in each tick, as .npy or .h5.",
            show_default=False,
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a virtual rig at a link, in real time.

    The virtual drive receives commands and sends displacement and force at link.sample_rate_hz, by
    default 1024 times per second. It has its own clock and its own watchdog: 19.5 ms after the
    last new command (20 ticks of 1/1024 s) it stops. Unless an option names a link, the rig file's
    [link] is used. Controllers can connect and disconnect at any time; Ctrl-C ends the virtual
    rig. A rig of several axes has a drive and a link for each, and a fault names its axis.

    \b
    Faults, from second S of its clock, for S seconds or to the end, with a VALUE:
      drop, drop-command, drop-force       lost frames; VALUE: probability
      delay                                feedback is late; VALUE: ticks, up to 63
      reorder, duplicate, corrupt          every other frame late, each sent twice, one bit wrong
      stuck, jump, force, not-finite       sensor faults; VALUE: m or N added
      silence, power-cut                   no communication; no power from then on

    \b
    Examples:
      rthyb rig --can vcan0
      rthyb rig my-rig.toml --socket /tmp/rig --fault drop@5:2=0.1 --seed 3
      rthyb rig --pty --drift-ppm 50 --fault power-cut@20
      rthyb rig two-axis-frame --can vcan0,vcan1 --fault lower.drop@5:2=0.1
    """
    from rthyb_rt import config
    from rthyb_rt.rig import virtual_rig

    name = file or config.load_test(config.builtin_test_path()).rig
    changes: dict[str, str] = {}
    for part in config.split_overrides(settings or ()):
        changes |= part
    rig_file = config.load_any_rig(config.find_rig(name), changes)
    rate = rig_file.rate
    plan = _plan(seed, drift_ppm, fault, seconds, log, axes_of(rig_file), rate)
    if log is not None:
        _check_log(log)
    people = terminal.people(as_json)
    stop = virtual_rig.StopRequest()
    with _lines(rig_file, can, serial, socket, pty) as lines, interrupts.on_interrupt(stop.set):
        at = ", ".join(line.name for line in lines)

        def ready() -> None:
            print(f"{rig_file.rig.name} at {at}, {rate.hz:g} Hz", file=people, flush=True)

        result = virtual_rig.serve(rig_file, lines, plan, stop, ready)
    if log is not None:
        virtual_rig.write_log(log, result.log, rate)
    terminal.print_table(_rows(result, log), people)
    if as_json:
        path = None if log is None else str(log)
        terminal.print_json({"schema": SCHEMA, **result.as_json(), "log": path})


def _plan(
    seed: int | None,
    drift_ppm: float,
    fault: list[str] | None,
    seconds: float | None,
    log: Path | None,
    axes: Sequence[str],
    rate: Rate,
) -> RigPlan:
    from rthyb_rt.rig import virtual_rig

    if not abs(drift_ppm) <= virtual_rig.DRIFT_MAX_PPM:
        raise typer.BadParameter(
            f"found {drift_ppm:g}; must be from -199 to 199", param_hint="--drift-ppm"
        )
    if seconds is not None and not 0.0 < seconds <= 1e6:
        raise typer.BadParameter(
            f"found {seconds:g}; must be above 0, up to 1e6 s", param_hint="--seconds"
        )
    if log is not None and log.suffix not in virtual_rig.LOG_SUFFIXES:
        raise typer.BadParameter(
            f"found {log}; a log must end with {' or '.join(virtual_rig.LOG_SUFFIXES)}",
            param_hint="--log",
        )
    try:
        faults, cut_s = virtual_rig.parse_faults(fault or (), axes, rate)
    except InputError as error:
        raise typer.BadParameter(str(error), param_hint="--fault") from error
    room_s = min(seconds or virtual_rig.LOG_SECONDS, virtual_rig.LOG_SECONDS)
    return virtual_rig.RigPlan(
        seed=seed,
        drift_ppm=drift_ppm,
        faults=faults,
        power_cut_s=cut_s,
        seconds=seconds,
        log_ticks=round((room_s + 1.0) * rate.hz) if log else 0,
    )


def _check_log(log: Path) -> None:
    """Refuse at once what would otherwise fail at the end, when the log would be lost."""
    folder = next(folder for folder in log.absolute().parents if folder.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK | os.X_OK):
        raise RthybError(
            f"the log cannot be written to {folder}; check the folder's permissions, or choose "
            "another file with --log",
            where=str(log),
        )


@contextmanager
def _lines(
    rig_file: RigFile | AxesRig,
    can: str | None,
    serial: str | None,
    socket: str | None,
    pty: bool,
) -> Iterator[list[WireEnd]]:
    """Open the requested link, or that of each of several axes."""
    from rthyb_rt.config import AxesRig
    from rthyb_rt.rig import virtual_rig

    wires = (("--can", can), ("--serial", serial), ("--socket", socket))
    given = [name for name, value in (*wires, ("--pty", pty)) if value]
    if len(given) > 1:
        raise typer.BadParameter(f"{' and '.join(given)} cannot be combined: choose one")
    axes = axes_of(rig_file)
    with ExitStack() as owned:
        if pty:
            lines = [virtual_rig.pty_line()[0] for _ in axes or ("",)]
        elif isinstance(rig_file, AxesRig):
            lines = virtual_rig.lines_of(_with_links(rig_file, wires))
        else:
            lines = [virtual_rig.line_of(_link(rig_file.link, can, serial, socket))]
        for line in lines:
            owned.callback(line.close)
        yield lines


def _with_links(rig: AxesRig, wires: Sequence[tuple[str, str | None]]) -> AxesRig:
    """Return a rig of several axes with the requested channels instead of its own.

    Raises:
        InputError: lists the problems of all links together.
    """
    from rthyb_rt.config.linkframes import shared_links

    found = {name: value for name, value in wires if value is not None}
    if found:
        ((option, text),) = found.items()
        channels = text.split(",")
        if len(channels) != len(rig.axis):
            raise typer.BadParameter(
                f"found {text}, which are {len(channels)}; the rig has {len(rig.axis)} axes "
                f"({', '.join(rig.names)}): give one for each, separated by commas",
                param_hint=option,
            )
        axes = []
        for axis, channel in zip(rig.axis, channels, strict=True):
            named = dict.fromkeys(("can", "serial", "socket")) | {
                option.removeprefix("--"): channel
            }
            axes.append(axis.model_copy(update={"link": _link(axis.link, **named)}))
        rig = rig.model_copy(update={"axis": axes})
    if rig.link is None:
        raise _no_wire()
    for number, fault in shared_links(rig):
        raise InputError(fault, f"axis.{rig.names[number]}.link")
    return rig


def _no_wire() -> typer.BadParameter:
    return typer.BadParameter(
        "the rig file has no [link]; choose --can, --serial, --socket or --pty"
    )


def _link(
    own: LinkTable | None, can: str | None, serial: str | None, socket: str | None
) -> LinkTable:
    """Return the rig file's link, with the requested channel instead of its own."""
    from pydantic import ValidationError

    from rthyb_rt.config.rigfile import LinkTable

    for kind, channel in (("can", can), ("serial", serial), ("socket", socket)):
        if channel is None:
            continue
        given: dict[str, Any] = {}
        if own is not None:
            same = own.kind == kind
            given = own.model_dump() if same else {"sample_rate_hz": own.sample_rate_hz}
        try:
            return LinkTable(**(given | {"kind": kind, "channel": str(channel)}))
        except ValidationError as error:
            message = error.errors()[0]["msg"].removeprefix("Value error, ")
            raise typer.BadParameter(message, param_hint=f"--{kind}") from error
    if own is None:
        raise _no_wire()
    return own


def _rows(result: RigResult, log: Path | None) -> list[tuple[str, str, str]]:
    stops = f"{result.watchdog_stops} by the watchdog, {result.told_stops} commanded"
    rows = [
        ("Ticks", str(result.ticks), f"{result.skipped} more missed"),
        ("Commands", str(result.commands), "frames received"),
        ("Stops", stops, "number of its own stops"),
        ("Phase", result.phase + (", power cut" if result.power_cut else ""), "at the end"),
    ]
    if log is not None:
        rows.append(("Log", str(log), f"the first {len(result.log)} ticks"))
    return rows
