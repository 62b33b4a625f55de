"""Installation of the service in a system: units, users, folders, device rules."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from rthyb_rt.errors import RthybError
from rthyb_rt.record.recording import replacing

PLACES: Final[dict[str, str]] = {
    "rthyb.service": "etc/systemd/system/rthyb.service",
    "rthyb-recorder.service": "etc/systemd/system/rthyb-recorder.service",
    "rthyb-live.service": "etc/systemd/system/rthyb-live.service",
    "rthyb-can@.service": "etc/systemd/system/rthyb-can@.service",
    "rthyb.sysusers": "etc/sysusers.d/rthyb.conf",
    "rthyb.tmpfiles": "etc/tmpfiles.d/rthyb.conf",
    "70-rthyb.rules": "etc/udev/rules.d/70-rthyb.rules",
    "rthyb.bash-completion": "usr/share/bash-completion/completions/rthyb",
    "rthyb.zsh-completion": "usr/share/zsh/vendor-completions/_rthyb",
    "rthyb.fish-completion": "usr/share/fish/vendor_completions.d/rthyb.fish",
    "rthyb.1": "usr/share/man/man1/rthyb.1",
}
"""Destination of each file, relative to the root of the system."""

RIG: Final = "etc/rthyb/rig.toml"
_PROGRAM: Final = "@RTHYB@"
HIDDEN: tuple[str, ...] = ("/home", "/root", "/run/user", "/tmp", "/var/tmp")
"""Folders that are invisible to the service: a program there would not start."""
_PACKAGE: Final = Path(__file__).resolve().parents[1]

Steps = tuple[tuple[str, ...], ...]

INSTALLED: Final[Steps] = (
    ("systemd-sysusers",),
    ("systemd-tmpfiles", "--create", "rthyb.conf"),
    ("systemctl", "daemon-reload"),
    ("udevadm", "control", "--reload"),
    ("udevadm", "trigger", "--subsystem-match=misc", "--subsystem-match=tty"),
    # For an adapter that is already plugged in, its rule starts the unit on the event "add".
    (
        *("udevadm", "trigger", "--action=add"),
        *("--subsystem-match=net", "--sysname-match=can[0-9]*"),
    ),
)
"""Commands that make the running system load the files."""
REMOVING: Final[Steps] = (
    ("systemctl", "disable", "--now", "rthyb-live", "rthyb", "rthyb-recorder"),
    ("systemctl", "stop", "rthyb-can@*.service"),
)
"""Commands that end the service before its units are removed: a moving test is ramped out."""
REMOVED: Final[Steps] = (("systemctl", "daemon-reload"), ("udevadm", "control", "--reload"))
"""Commands that make the running system forget the files."""


def sources() -> Path:
    """Return the folder that contains the files to install."""
    packaged = _PACKAGE / "_systemd"
    return packaged if packaged.is_dir() else _PACKAGE.parent / "systemd"


def program() -> Path:
    """Return the program of this installation, as started by a unit.

    Raises:
        RthybError: it does not exist, or is in a folder that is invisible to the service.
    """
    path = Path(sys.prefix) / "bin" / "rthyb"
    if not path.is_file():
        raise RthybError(f"{path}: this installation has no program rthyb")
    # An environment in /opt does not help if its interpreter or its sources are in a home folder,
    # or if its path is a link to one.
    for needed in (path, path.resolve(), Path(sys.executable).resolve(), _PACKAGE):
        for folder in HIDDEN:
            if needed.is_relative_to(folder):
                raise RthybError(
                    f"{needed} is in {folder}, which the service cannot see; install into /opt "
                    "with the system's Python, for example: /usr/bin/python3 -m venv "
                    "/opt/rthyb, /opt/rthyb/bin/pip install WHEEL, and /opt/rthyb/bin/rthyb "
                    "install-service"
                )
    return path


def install(
    root: Path, starts: Path, rig: str | None = None, dbc: Sequence[Path] = ()
) -> list[Path]:
    """Write the files; older versions are replaced, except for a rig file.

    Args:
        root: root of the system.
        starts: program that the units start.
        rig: text of the rig file; None: left to the operator.
        dbc: files to which the rig file refers by name only.

    Returns:
        The files that were written.

    Raises:
        RthybError: a file cannot be written, or a different DBC file exists.
    """
    written = []
    new = rig is not None and not (root / RIG).exists()
    for path in dbc if new else ():
        written += _beside(root / RIG, path)
    for name, place in PLACES.items():
        text = (sources() / name).read_text(encoding="utf-8")
        written.append(_write(root / place, text.replace(_PROGRAM, str(starts))))
    if new and rig is not None:
        written.append(_write(root / RIG, rig))
    return written


def _beside(rig: Path, dbc: Path) -> list[Path]:
    """Copy a DBC file to the folder of the rig file, unless it is already there."""
    target = rig.with_name(dbc.name)
    try:
        content = dbc.read_bytes()
        if target.exists():
            if target.read_bytes() != content:
                raise RthybError(
                    f"already exists and differs from {dbc}; move it elsewhere, or rename your "
                    "file",
                    where=str(target),
                )
            return []
    except OSError as error:
        raise RthybError(f"cannot be read ({error.strerror})", where=str(dbc)) from error
    with replacing(target) as temporary:
        temporary.write_bytes(content)
        temporary.chmod(0o644)
    return [target]


def _write(path: Path, text: str) -> Path:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
        temporary.chmod(0o644)
    return path


def remove(root: Path) -> list[Path]:
    """Remove what `install` wrote, except for rig file and recordings.

    Raises:
        RthybError: a file cannot be removed.
    """
    removed = []
    for place in PLACES.values():
        path = root / place
        try:
            path.unlink()
            removed.append(path)
        except FileNotFoundError:
            continue
        except OSError as error:
            raise RthybError(f"cannot be removed ({error.strerror})", where=str(path)) from error
    return removed


def carry_out(steps: Steps) -> list[str]:
    """Run commands in the running system; return what failed, as text."""
    failed = []
    for step in steps:
        words = " ".join(step)
        if shutil.which(step[0]) is None:
            failed.append(f"{words}: not available on this system")
            continue
        ran = subprocess.run(step, capture_output=True, text=True, check=False)
        if ran.returncode:
            failed.append(f"{words}: {(ran.stderr or ran.stdout).strip() or ran.returncode}")
    return failed


def needs_root(root: Path) -> bool:
    """Return whether only root can write the files."""
    return root == Path("/") and os.geteuid() != 0
