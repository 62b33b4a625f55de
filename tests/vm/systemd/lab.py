"""A lab's PC as the scenarios find it: the service as systemd runs it, its users, a rig at vcan."""

from __future__ import annotations

import json
import math
import os
import pwd
import re
import subprocess
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import stalls
import test_service_daemon
from realtime_bench import until
from service_bench import rig_file
from stalls import Stalled

from rthyb_rt import config
from rthyb_rt.lab import trips
from rthyb_rt.lab.end_reasons import in_words
from rthyb_rt.service import installing
from rthyb_rt.service.control import Client, Refusal

ROOT = Path(__file__).resolve().parents[3]
WHEEL = ROOT / "build" / "vm" / "program"
"""Where `make test-systemd` unpacks the wheel that a lab would install."""
PREFIX = Path("/opt/rthyb")
PROGRAM = PREFIX / "bin" / "rthyb"
SERVICE, RECORDER, DRIVE = "rthyb.service", "rthyb-recorder.service", "virtual-rig.service"
LIVE = "rthyb-live.service"
RINGS, RUNS = Path("/run/rthyb"), Path("/var/lib/rthyb")
RIG = Path("/etc/rthyb/rig.toml")
FOLDER = Path("/run/lab")
KEPT = Path("/run/job/kept.json")
"""What the next boot is to know: a file of the host, and so never lost."""
AGAIN = Path("/run/job/again")
LOOK_S = 0.2
ATTEMPTS = 5
"""One processor, and often a share of it only."""
SPARE = 10
"""Attempts that may come to nothing in one boot before two have to do for each scenario."""
LIVE_USER = "rthyb-live"
LOOKER, OPERATOR, STRANGER = "alice", "olga", "erin"

LINK = """
[link]
kind = "can"
channel = "vcan0"
virtual = true
require_realtime = true
"""


def run(*command: str | Path, check: bool = True) -> subprocess.CompletedProcess[str]:
    ran = subprocess.run(list(map(str, command)), capture_output=True, text=True, check=False)
    if check:
        assert ran.returncode == 0, f"{command}\n{ran.stdout}{ran.stderr}"
    return ran


def systemctl(*arguments: str, check: bool = True) -> str:
    return run("systemctl", *arguments, check=check).stdout.strip()


def shown(unit: str, name: str) -> str:
    """Return a property of a unit."""
    return systemctl("show", "--property", name, "--value", unit)


@contextmanager
def stop_at_a_word() -> Iterator[Path]:
    """Give a file at whose sight systemd stops the service, without a program that it starts."""
    word, units = FOLDER / "stop", Path("/run/systemd/system")
    for name, text in (
        ("word.target", f"[Unit]\nConflicts={SERVICE}\n"),
        ("word.path", f"[Path]\nPathExists={word}\nUnit=word.target\n"),
    ):
        (units / name).write_text(text, encoding="utf-8")
    systemctl("daemon-reload")
    systemctl("start", "word.path")
    try:
        yield word
    finally:
        systemctl("stop", "word.path")
        word.unlink(missing_ok=True)


def journal(*units: str) -> str:
    """Return what units have said since the boot."""
    run("journalctl", "--sync")
    named = [word for unit in units for word in ("--unit", unit)]
    return run("journalctl", "--no-pager", "--quiet", "--output=short-monotonic", *named).stdout


# ---- installation -------------------------------------------------------------------------------


def _make_environment() -> None:
    """Make the lab's environment: the wheel, with the other packages of this one."""
    run(sys.executable, "-m", "venv", "--without-pip", PREFIX)
    packages = PREFIX / Path(sysconfig.get_path("purelib")).relative_to(sys.prefix)
    paths = [str(WHEEL), sysconfig.get_path("purelib")]
    (packages / "lab.pth").write_text("\n".join([*paths, ""]), encoding="utf-8")
    lines = [f"#!{PREFIX}/bin/python", "import sys", "from rthyb_rt.cli import main"]
    PROGRAM.write_text("\n".join([*lines, "sys.exit(main())", ""]), encoding="utf-8")
    PROGRAM.chmod(0o755)


def _hidden() -> list[Path]:
    """Return what that needs of this machine, and no service would see."""
    used = (ROOT, Path(sys.base_prefix), Path(sys.base_prefix).resolve())
    return sorted({path for path in used if any(map(path.is_relative_to, installing.HIDDEN))})


def rig_text(changes: dict[str, str] | None = None) -> str:
    """Return the lab's rig file."""
    return config.dump(rig_file(changes)) + LINK


def install() -> str:
    """Install the service with `rthyb install-service`; return all that it said."""
    FOLDER.mkdir(exist_ok=True)
    made = FOLDER / "rig.toml"
    made.write_text(rig_text(), encoding="utf-8")
    _make_environment()
    command: list[str | Path] = [PROGRAM]
    if hidden := _hidden():
        program = (
            "import sys\nfrom rthyb_rt.cli import main\nfrom rthyb_rt.service import installing"
        )
        program += "\ninstalling.HIDDEN = ()\nsys.exit(main())"
        # -P: not the sources of the folder that this runs in, which have no built core.
        command = [PREFIX / "bin" / "python", "-P", "-c", program]
        _show(hidden)
    ran = run(*command, "install-service", "--rig", made)
    return ran.stdout + ran.stderr


def _show(hidden: Sequence[Path]) -> None:
    """Let the units see a checkout where no lab would have it; the rest stays out of sight."""
    lines = ["[Service]", "ProtectHome=tmpfs", *(f"BindReadOnlyPaths={path}" for path in hidden)]
    for unit in (SERVICE, RECORDER, LIVE):
        folder = Path(f"/etc/systemd/system/{unit}.d")
        folder.mkdir(parents=True)
        (folder / "checkout.conf").write_text("\n".join([*lines, ""]), encoding="utf-8")


def add_users() -> None:
    for name, groups in ((LOOKER, "rthyb"), (OPERATOR, "rthyb,rthyb-operator"), (STRANGER, "")):
        run("useradd", "--create-home", "--user-group", "--groups", groups, name)


def as_user(name: str, *command: str | Path) -> subprocess.CompletedProcess[str]:
    """Run a command with the rights of a user who has just logged in."""
    whole = [*_becoming(name), *command]
    return subprocess.run(whole, **_session(name), capture_output=True, check=False)


def _becoming(name: str) -> list[str | Path]:
    group = pwd.getpwnam(name).pw_gid
    return ["setpriv", f"--reuid={name}", f"--regid={group}", "--init-groups"]


def _session(name: str) -> dict[str, Any]:
    home = pwd.getpwnam(name).pw_dir
    return {"env": {**os.environ, "HOME": home, "USER": name}, "cwd": "/", "text": True}


def interface(name: str) -> str:
    """Return what the kernel says of a network interface."""
    return " ".join(run("ip", "-details", "link", "show", name).stdout.split())


Ask = Callable[..., str]
"""Calls a method of the service; returns "done" or the last word of the error's name."""

_TERMINAL = """
import json, sys
from rthyb_rt.service.control import Client, Refusal
print("there", flush=True)
for line in sys.stdin:
    name, parameters = json.loads(line)
    with Client() as client:
        try:
            client.call(name, **parameters)
            print("done", flush=True)
        except Refusal as error:
            print(error.name.rpartition(".")[2], flush=True)
"""


@contextmanager
def at_terminal(name: str) -> Iterator[Ask]:
    """Give the commands of a user whose program is there already: no start disturbs a test."""
    made = subprocess.Popen(
        [*_becoming(name), PREFIX / "bin" / "python", "-P", "-c", _TERMINAL],
        **_session(name),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert made.stdin is not None
    assert made.stdout is not None
    assert made.stdout.readline().strip() == "there"

    def ask(method: str, **parameters: Any) -> str:
        made.stdin.write(json.dumps([method, parameters]) + "\n")
        made.stdin.flush()
        said = made.stdout.readline().strip()
        assert said, "the client has come to grief"
        return str(said)

    try:
        yield ask
    finally:
        made.communicate()


def ctl(user: str, *arguments: str) -> tuple[int, dict[str, Any], str]:
    """Have a user give a command of `rthyb ctl`; return exit code, answer, and what it said."""
    ran = as_user(user, PROGRAM, "ctl", *arguments, "--json")
    return ran.returncode, json.loads(ran.stdout or "{}"), ran.stderr


# ---- the service and its rig --------------------------------------------------------------------


class Lab(test_service_daemon.Lab):
    """The service that systemd has started, and a rig at its CAN bus."""

    def __init__(self, name: str) -> None:
        self.rings, self.runs, self.socket = RINGS, RUNS, RINGS / "control.sock"
        self.log = FOLDER / f"{name}.npy"
        FOLDER.mkdir(exist_ok=True)
        # It is there before the service and goes after it, as a rig with a supply of its own.
        unit = (f"--unit={DRIVE}", f"--property=Before={SERVICE}", "--property=Nice=-10")
        what = (PROGRAM, "rig", RIG, "--can", "vcan0", "--log", self.log)
        run("systemd-run", "--quiet", "--collect", *unit, *what)

    def status(self) -> dict[str, Any]:
        """Return the status; what a stall has tripped or stopped between two tests is reset."""
        # Who asks all the time takes the one processor away from those who tick.
        time.sleep(LOOK_S)
        found = super().status()
        if not found["run_id"] and (found["state"] == "TRIPPED" or not found["follows"]):
            with Client(self.socket) as client, suppress(Refusal):
                client.call("Reset")
        return found

    def run_until(self, *arguments: Any) -> str:
        try:
            return super().run_until(*arguments)
        except Refusal as error:
            raise Stalled(str(error)) from error

    def await_service(self) -> dict[str, Any]:
        """Wait until all is at rest and the drive follows; return the status then."""

        def at_rest() -> dict[str, Any] | None:
            found = self.status()
            return found if found["state"] == "IDLE" and found["follows"] else None

        found: dict[str, Any] = until(at_rest, "a service in IDLE whose drive follows")
        return found

    def main_pid(self, unit: str = SERVICE) -> int:
        return int(shown(unit, "MainPID"))

    def ended_early(self) -> bool:
        """Return whether a test that nobody has stopped is over, or about to be."""
        found = self.status()
        return found["run_id"] == "" or found["state"] in ("RAMP_OUT", "TRIPPED")

    def restarts(self) -> int:
        """Return how often systemd has started the daemon anew by itself."""
        time.sleep(LOOK_S)
        return int(shown(SERVICE, "NRestarts"))

    def end_drive(self) -> np.ndarray:
        systemctl("stop", DRIVE)
        log: np.ndarray = np.load(self.log)
        return log

    def close(self) -> None:
        systemctl("stop", DRIVE, check=False)


@contextmanager
def lab(name: str) -> Iterator[Lab]:
    """Give a service in IDLE whose drive follows."""
    made = Lab(name)
    try:
        systemctl("restart", SERVICE)
        made.await_service()
        yield made
    finally:
        made.close()


# ---- stalls -------------------------------------------------------------------------------------

TOLD = re.compile(r"^\[ *(\d+\.\d+)\] .*-> (?:TRIPPED|RAMP_OUT) at tick .*, cause: (.+)$", re.M)
TOLD_LATE_S = 1.5
"""By which a line may stand in the journal after what it tells of."""
CAUSES = {
    begin: cause
    for cause in stalls.CAUSES
    for begin in (in_words(cause), trips.figures(cause, 1.0, 1.0).partition("1")[0])
    if begin
}
"""By what the service tells of them begins with: their words, or what was counted."""


def proved(stalled: Stalled, since_s: float) -> str:
    """Return what proves a stall; one without a moment of its own by what the service has told."""
    if stalled.to_s < math.inf:
        return stalls.seen(stalled)
    return stall_told(since_s) or stalls.seen(Stalled(stalled.cause, since_s, time.monotonic()))


def stall_told(since_s: float) -> str:
    """Return what proves one of the stalls that the service has told of; "": none is proved."""
    for at, words in TOLD.findall(journal(SERVICE)):
        told_s = float(at)
        cause = next((one for begin, one in CAUSES.items() if words.startswith(begin)), None)
        if told_s >= since_s and cause is not None:
            found = stalls.seen(Stalled(cause, told_s - TOLD_LATE_S, told_s))
            if found:
                return f"{cause}; {found}"
    return ""


def assert_idle_unless_stalled(since_s: float = 0.0) -> None:
    """A machine that stalls trips the service at rest as well."""
    state = shown(SERVICE, "StatusText")
    assert state == "IDLE" or (state == "TRIPPED" and stall_told(since_s)), state


_in_vain: list[str] = []


def repeated(name: str, attempt: Callable[[Lab], None]) -> None:
    """Try again where the machine stalled, each time with a service and a drive at rest."""
    since_s = time.monotonic()

    def with_lab(number: int) -> None:
        nonlocal since_s
        since_s = time.monotonic()
        with lab(f"{name}-{number}") as made:
            attempt(made)

    def spent(stalled: Stalled) -> str:
        _in_vain.append(name)
        return proved(stalled, since_s)

    stalls.repeated(with_lab, ATTEMPTS if len(_in_vain) < SPARE else 2, spent)


# ---- the end of a boot --------------------------------------------------------------------------


def end_boot(request: pytest.FixtureRequest, how: str, **facts: Any) -> None:
    """End this boot here and now, as `AGAIN` of guest.py says; the next one knows the facts."""
    accounts = stalls.of(request.config)
    accounts.add(request.node.nodeid)
    with request.getfixturevalue("capfd").disabled():
        print(f"\nend of boot {os.environ['RTHYB_BOOT']}: {accounts.total} scenarios so far")
        print("\n".join(accounts.lines()))
    KEPT.write_text(json.dumps(facts), encoding="utf-8")
    part = AGAIN.with_suffix(".part")
    part.write_text(how, encoding="ascii")
    part.replace(AGAIN)
    if how == "off":
        systemctl("poweroff")
    time.sleep(60.0)


def end_boot_in_motion(
    request: pytest.FixtureRequest, how: str, ticks: int, about: Callable[[], dict[str, Any]]
) -> None:
    """End this boot while a test runs, for the next one to look at; without one after stalls.

    Args:
        request: of the scenario.
        how: as in `end_boot`.
        ticks: of the test's motion before the end.
        about: what else the next boot is to know, of the moment before.
    """
    require_no_failure(request.session)

    def attempt(made: Lab) -> None:
        os.sync()
        run_id = made.run_until("RUNNING", ticks, {"test.duration_s": "30"})
        end_boot(request, how, run_id=run_id, **about())

    try:
        repeated(how, attempt)
    except stalls.NotRun as error:
        end_boot(request, how, run_id="", why=str(error))


def run_in_motion() -> str:
    """Return the run in whose motion the last boot ended.

    Raises:
        NotRun: stalls have left it without one.
    """
    if not kept()["run_id"]:
        raise stalls.NotRun(f"the last boot ended at rest: {kept()['why']}")
    return str(kept()["run_id"])


def require_no_failure(session: pytest.Session) -> None:
    """Nobody hears of this boot's failures once it has ended: so go no further with one."""
    if session.testsfailed:
        pytest.fail("a scenario before has failed: the guest is not booted again")


def kept() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(KEPT.read_text(encoding="utf-8"))
    return found
