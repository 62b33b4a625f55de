"""``rthyb ctl``: drive the service of a rig."""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
import re
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rthyb_rt.cli import streams, terminal
from rthyb_rt.cli.inputs import JsonOption, SetOption

if TYPE_CHECKING:
    from rthyb_rt.ground_motion import GroundMotion
    from rthyb_rt.service.control import Client

SCHEMA = "rthyb-ctl/1"

ctl = typer.Typer(
    name="ctl",
    no_args_is_help=True,
    rich_markup_mode=None,
    help="""Control the service of a rig, `rthyb serve`.

The steps of a test are load, zero, arm, start. Everyone who may watch may also hold and stop.

The exit code is 4 if no service answers, and 5 if it refuses; the message says why.

\b
Examples:
  rthyb ctl status --watch
  rthyb ctl load my-test.toml
  rthyb ctl zero
  rthyb ctl arm
  rthyb ctl start
""",
)

SocketOption = Annotated[
    Path | None,
    typer.Option(
        "--socket",
        metavar="PATH",
        help="Control socket of the service, instead of RTHYB_SOCKET or /run/rthyb/control.sock.",
        show_default=False,
    ),
]


def place(socket: Path | None) -> Path:
    """Return the control socket: as given, from the environment, of the service, or the user's."""
    from rthyb_rt.record import ring
    from rthyb_rt.service.control import SOCKET

    if socket is not None:
        return socket
    if os.environ.get("RTHYB_SOCKET"):
        return Path(os.environ["RTHYB_SOCKET"])
    folder = ring.default_folder()
    own = folder / SOCKET.name
    if SOCKET.exists() or not own.exists():
        return SOCKET
    ring.trusted(folder)
    return own


@contextlib.contextmanager
def _client(socket: Path | None) -> Iterator[Client]:
    from rthyb_rt.service.control import Client

    with Client(place(socket)) as client:
        yield client


def _print_done(command: str, text: str, as_json: bool, **more: Any) -> None:
    print(text, file=terminal.people(as_json))
    if as_json:
        terminal.print_json({"schema": SCHEMA, "command": command, "ok": True, **more})


# ---- status -------------------------------------------------------------------------------------


@ctl.command()
def status(
    socket: SocketOption = None,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Update until Ctrl-C.")] = False,
    every: Annotated[
        float,
        typer.Option(metavar="S", min=0.05, max=60.0, help="Time between updates in seconds."),
    ] = 0.25,
    as_json: JsonOption = False,
) -> None:
    """Show what the rig and its test are doing.

    With --watch, shows a table that is updated continuously; with --json, or if the output is not a
    terminal, one line per update.
    """
    with _client(socket) as client:
        if not watch:
            found = client.call("GetStatus")["status"]
            terminal.print_table(rows(found), terminal.people(as_json))
            if as_json:
                terminal.print_json(found)
            return
        with contextlib.suppress(KeyboardInterrupt):
            _watch(client, every, as_json)


def _watch(client: Client, every_s: float, as_json: bool) -> None:
    if as_json or not sys.stdout.isatty():
        terminal.begin_json_lines()
        while not streams.is_unread(sys.stdout):
            found = client.call("GetStatus")["status"]
            print(json.dumps(found) if as_json else line(found), flush=True)
            time.sleep(every_s)
        return
    from rich.live import Live

    with Live(auto_refresh=False) as live:
        while True:
            live.update(_table(client.call("GetStatus")["status"]), refresh=True)
            time.sleep(every_s)


def _table(found: dict[str, Any]) -> Any:
    from rich.table import Table
    from rich.text import Text

    table = Table.grid(padding=(0, 2, 0, 0))
    for style in ("", "bold", "dim"):
        table.add_column(style=style, overflow="fold")
    for row in rows(found):
        table.add_row(*map(Text, row))
    return table


def _drive(found: dict[str, Any]) -> tuple[str, str]:
    if found["follows"]:
        return "follows", ""
    if found["drive_stopped"]:
        return "has stopped", "find out why, then: rthyb ctl reset"
    return "does not follow", ""


def rows(found: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return a status as rows of label, value and explanation."""
    test, ticks, recorder = found["test"], found["ticks"], found["recorder"]
    newest = found["newest"] or {}
    cause = cause_in_words(found)
    state = found["state"] + (f", {cause}" if cause != "none" else "")
    table = [
        ("Rig", found["rig"], found["link"]),
        ("State", state, f"allowed now: {', '.join(found['allowed'])}"),
        ("Drive", *_drive(found)),
        ("Test", *_test(found, test)),
        *_measured(found, newest),
        (
            "Ticks",
            str(ticks["elapsed"]),
            f"{ticks['skipped']} skipped, wake-up p99 {found['wake']['p99_ns'] / 1e3:.0f} us",
        ),
        ("Recorder", *_recorder(recorder)),
    ]
    if found["armed_by"]:
        table.insert(4, ("Armed by", found["armed_by"], ""))
    if found["indicated"]:
        table.append(("Indicated", ", ".join(found["indicated"]), "limits that only indicate"))
    if found["last"]:
        last = found["last"]
        table.append(("Last test", last["test_name"], last["end_reason"]))
        if last.get("ending"):
            table.append(("", last["ending"], ""))
    return table


def cause_in_words(found: dict[str, Any]) -> str:
    """Return the cause in a status with its figures, or with its axis; "none" if there is none."""
    from rthyb_rt.lab.end_reasons import shown_of

    return shown_of(found)


def _measured(found: dict[str, Any], newest: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Return rows for the newest values: those of a single axis, or one row for each axis."""
    axes: dict[str, dict[str, Any]] = found.get("axes") or {}
    if not axes:
        return [
            ("Displacement", _number(newest.get("x_meas_m"), 1e3, "mm"), _command(newest)),
            ("Force", _number(newest.get("f_meas_n"), 1e-3, "kN"), ""),
            ("Delay", _number(newest.get("alpha"), 1.0, "samples"), "alpha"),
        ]
    rows = [
        (f"Direction {name}", _direction(one), "command")
        for name, one in found["directions"].items()
    ]
    for name, one in axes.items():
        values = f"{_number(one['x_meas_m'], 1e3, 'mm')}, {_number(one['f_meas_n'], 1e-3, 'kN')}"
        parts = [_command(one)]
        if one["link_down"] != "up":
            parts.append(f"link down: {one['link_down']}")
        if one["drive_stopped"]:
            parts.append("its drive has stopped")
        rows.append((f"Axis {name}", values, ", ".join(parts)))
    return rows


def _direction(found: dict[str, Any]) -> str:
    return _number(found["x_num"], 1e3, "mrad" if found["unit"] == "rad" else "mm")


def _test(found: dict[str, Any], test: dict[str, Any] | None) -> tuple[str, str]:
    if test is None:
        return "none", "to load one: rthyb ctl load TEST.toml"
    about = f"{_reached(found, ' of ')}{test['duration_s']:.1f} s, {test['ground_motion']}"
    about += f", PGA {test['pga_g']:.3g} g" if test["pga_g"] else ""
    return f"{test['name']} ({test['digest'][:12]})", about


def _reached(found: dict[str, Any], after: str) -> str:
    """Return how far a test has run, followed by ``after``; "" if none is running.

    A test that has ended is in the row "Last test", also while the service is still TRIPPED.
    """
    if not found["run_id"]:
        return ""
    return f"{found['progress']['ticks'] / found['sample_rate_hz']:.1f}{after}"


def _number(value: float | None, factor: float, unit: str) -> str:
    return "-" if value is None or math.isnan(value) else f"{value * factor:.3f} {unit}"


def _command(newest: dict[str, Any]) -> str:
    return f"command {_number(newest.get('x_cmd_m'), 1e3, 'mm')}" if newest else ""


def _recorder(found: dict[str, Any]) -> tuple[str, str]:
    if not found["wanted"]:
        return "none", "only the ring has the last 64 s"
    if not found["alive"]:
        return "does not respond", ("it is being restarted; data not written within 64 s are lost")
    if found["fault"]:
        return "has a problem", found["fault"]
    free = f"{found['free_bytes'] / 1e9:.1f} GB free in {found['runs']}"
    if not found["run_id"]:
        return "ready", free
    lost = sum(last - first + 1 for first, last in found["missing_rows"])
    return f"{found['rows']} rows" + (f", {lost} lost" if lost else ""), free


def line(found: dict[str, Any]) -> str:
    """Return a status as one line."""
    newest = found["newest"] or {}
    axes: dict[str, dict[str, Any]] = found.get("axes") or {"": newest}
    values = [
        f"{name} {_number(one.get('x_meas_m'), 1e3, 'mm')}, "
        f"{_number(one.get('f_meas_n'), 1e-3, 'kN')}".lstrip()
        for name, one in axes.items()
    ]
    parts = [*values, f"{found['ticks']['skipped']} skipped"]
    state = f"{found['state']} {_reached(found, ' s')}".rstrip()
    return f"{state}, {', '.join(parts)}"


@ctl.command()
def metrics(socket: SocketOption = None) -> None:
    """Print the state in Prometheus' text format."""
    with _client(socket) as client:
        print(client.call("GetMetrics")["text"], end="")


# ---- steps of a test ----------------------------------------------------------------------------


@ctl.command()
def load(
    test: Annotated[
        Path | None,
        typer.Argument(
            metavar="TEST.toml",
            help="Test file, or name of a shipped test. Default: the built-in test.",
            show_default=False,
        ),
    ] = None,
    settings: SetOption = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Send a test and its ground motion to the service.

    The service must be in IDLE. Both files are read here, with your permissions; the service sees
    neither your files nor your home directory. The test runs on the rig of the service, whatever
    rig the test file names.
    """
    from rthyb_rt import config
    from rthyb_rt.lab import experiment
    from rthyb_rt.service.daemon import record_of

    test_settings, rig_settings = config.split_overrides(settings or ())
    if rig_settings:
        raise typer.BadParameter("the rig is that of the service", param_hint="--set")
    test_file = config.load_test(test or config.builtin_test_path(), test_settings)
    motion = experiment.load_motion(test_file)
    record = record_of(motion)
    _check_size(motion, record)
    with _client(socket) as client:
        found = client.call("Load", test_toml=config.dump(test_file), record=record)
    for note in found["notes"]:
        terminal.tell(f"note: {note}")
    digest = found["digest"]
    text = f"Loaded {test_file.test.name}, {digest[:12]}; next: rthyb ctl zero"
    _print_done("load", text, as_json, digest=digest, notes=found["notes"])


def _check_size(motion: GroundMotion, record: dict[str, Any]) -> None:
    """Refuse a ground motion that the service would not accept.

    Raises:
        InputError: the ground motion is too long.
    """
    from rthyb_rt.errors import InputError
    from rthyb_rt.service.control import LOAD_BYTES, REQUEST_BYTES

    points, size = motion.acceleration_mps2.size, len(json.dumps(record))
    most = LOAD_BYTES - REQUEST_BYTES
    if size > most:
        raise InputError(
            f"{motion.name}: its {points} points make a message of {size / 1e6:.1f} MB, but the "
            f"service accepts at most {most / 1e6:.1f} MB, about {points * most // size} points; "
            "keep only the strong-motion part of the record, or resample it to a lower rate"
        )


@ctl.command()
def zero(
    socket: SocketOption = None,
    no_wait: Annotated[
        bool, typer.Option("--no-wait", help="Do not wait until zeroing has finished.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Zero both sensors at rest and begin the recording."""
    with _client(socket) as client:
        client.call("Zero")
        found = {"state": "IDLE"} if no_wait else _await_zeroed(client)
    text = "Zeroing" if no_wait else f"Zeroed, {_tare(found)}; next: rthyb ctl arm"
    _print_done("zero", text, as_json, state=found["state"], tare=found.get("tare"))


def _tare(found: dict[str, Any]) -> str:
    from rthyb_rt import numbers

    return numbers.tare_of_status(found["tare"])


def _await_zeroed(client: Client) -> dict[str, Any]:
    """Wait for the end of the tare, which the service limits, and return the status."""
    from rthyb_rt.errors import RthybError

    while True:
        found: dict[str, Any] = client.call("GetStatus")["status"]
        if found["state"] == "TRIPPED":
            cause = cause_in_words(found)
            raise RthybError(
                f"not zeroed: the rig is TRIPPED, cause: {cause}; find out why, then run "
                "rthyb ctl reset"
            )
        if found["state"] != "IDLE":
            return found
        if not found["run_id"]:
            raise RthybError(f"not zeroed: {found['not_zeroed'] or 'another user has stopped it'}")
        time.sleep(0.05)


@ctl.command()
def arm(
    digest: Annotated[
        str | None,
        typer.Option(
            metavar="HEX",
            help="Digest of the test to arm, as printed by load. Default: the loaded test.",
            show_default=False,
        ),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Arm the zeroed test; only you can then start it.

    The token is kept for `rthyb ctl start`. ARMED ends by itself after limits.armed_timeout_s.
    """
    if digest is not None and not re.fullmatch("[0-9a-f]{8,64}", digest):
        raise typer.BadParameter(
            f"found {digest!r}; give at least the first 8 digits of the digest that load printed",
            param_hint="--digest",
        )
    with _client(socket) as client:
        test = client.call("GetStatus")["status"]["test"] or {}
        whole = str(test.get("digest", ""))
        wanted = whole if digest is None or whole.startswith(digest) else digest
        found = client.call("Arm", digest=wanted)
    _keep_token(place(socket), found["token"])
    seconds = found["timeout_s"]
    text = f"Armed {test.get('name')}, for {seconds:g} s; next: rthyb ctl start"
    _print_done("arm", text, as_json, token=found["token"], timeout_s=seconds)


@ctl.command()
def start(
    token: Annotated[
        str | None,
        typer.Option(metavar="TOKEN", help="Token printed by arm, instead of the saved one."),
    ] = None,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Start the armed test."""
    with _client(socket) as client:
        kept = _kept_token(place(socket)) if token is None else token
        client.call("Start", token=kept)
    _print_done("start", "Started; to watch it: rthyb ctl status --watch", as_json)


@ctl.command()
def hold(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Bring the specimen to rest; `resume` continues the test."""
    with _client(socket) as client:
        client.call("Hold")
    _print_done("hold", "Held", as_json)


@ctl.command()
def resume(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Continue a test that is held."""
    with _client(socket) as client:
        client.call("Resume")
    _print_done("resume", "Resumed", as_json)


@ctl.command()
def stop(
    now: Annotated[
        bool,
        typer.Option(
            "--now", help="Trip: the drive stops where it is and must be reset afterwards."
        ),
    ] = False,
    socket: SocketOption = None,
    as_json: JsonOption = False,
) -> None:
    """Bring the specimen to rest at zero and end the test.

    This is not an emergency stop, which must be hard-wired.
    """
    from rthyb_rt.errors import RthybError

    with _client(socket) as client:
        client.call("Stop", now=now)
        rests = False
        # The stop has been given: it is no failure if the service ends meanwhile.
        with contextlib.suppress(RthybError):
            rests = client.call("GetStatus")["status"]["state"] == "IDLE"
    _print_done("stop", "Tripped" if now else "At rest" if rests else "Stopping", as_json)


@ctl.command()
def reset(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Leave TRIPPED, and make a stopped drive follow again."""
    with _client(socket) as client:
        client.call("Reset")
    _print_done("reset", "Reset", as_json)


@ctl.command()
def reload(socket: SocketOption = None, as_json: JsonOption = False) -> None:
    """Reload the limits of the rig file.

    Possible in IDLE, ZEROED and HOLD. Any other change in the rig file takes effect when the
    service is restarted. The journal lists the limits that changed.
    """
    with _client(socket) as client:
        generation = client.call("Reload")["generation"]
    _print_done("reload", "Limits reloaded", as_json, generation=generation)


# ---- the token ----------------------------------------------------------------------------------


def _token_path(socket: Path) -> Path:
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(runtime) if runtime else Path.home() / ".cache"
    name = hashlib.sha256(str(socket.absolute()).encode()).hexdigest()[:12]
    return folder / f"rthyb-token-{name}"


def _keep_token(socket: Path, token: str) -> None:
    path = _token_path(socket)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
        with open(fd, "w", encoding="ascii") as file:
            file.write(token)
    except OSError as error:
        words = error.strerror or error
        terminal.tell(f"the token cannot be saved ({words}); start with --token {token}")


def _kept_token(socket: Path) -> str:
    try:
        return _token_path(socket).read_text(encoding="ascii")
    except OSError:
        # The service reports what is wrong.
        return ""
