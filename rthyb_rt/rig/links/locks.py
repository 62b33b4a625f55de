"""One user of a link at a time: a file that is locked while the link is open.

The kernel releases the lock however its holder ends; a file that remains is harmless.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
import re
import stat
import tempfile
from pathlib import Path
from typing import Final

from rthyb_rt.errors import InputError
from rthyb_rt.rig.links.opened import Owned, Side

SHARED_FOLDER: Final = Path("/run/lock")
"""Folder in which locks of all users are visible; not writable for all on every system."""


def hold(owned: Owned, what: str, key: str, side: Side) -> None:
    """Prevent others from using a link at the same end until ``owned`` is closed.

    Args:
        owned: takes ownership of the lock.
        what: the link, for messages.
        key: identifies the link uniquely.
        side: both ends of a link may be on one machine, with a lock each.

    Raises:
        InputError: another process holds the lock, or no lock can be created.
    """
    path = folder() / f"rthyb-{_slug(key)}-{side}.lock"
    try:
        fd = _locked(path)
    except BlockingIOError:
        raise InputError(
            f"{holder(path)} has it open as {side}; a link can have only one {side} at a time: "
            "stop that program first",
            what,
        ) from None
    except OSError as error:
        raise InputError(f"cannot be locked, {path}: {error.strerror}", what) from error
    owned.callback(_release, fd, path)


def folder() -> Path:
    """Return the folder of the locks: shared by all users if possible."""
    own = os.environ.get("XDG_RUNTIME_DIR", "")
    for candidate in (SHARED_FOLDER, Path(own) if own else None):
        if candidate is not None and candidate.is_dir() and os.access(candidate, os.W_OK):
            return candidate
    return Path(tempfile.gettempdir())


def holder(path: str | Path) -> str:
    """Return which process holds the lock on a file, as text."""
    try:
        status, listed = os.stat(path), Path("/proc/locks").read_text()
    except OSError:
        return "another process"
    file = (os.major(status.st_dev), os.minor(status.st_dev), status.st_ino)
    for line in listed.splitlines():
        words = line.split()
        if len(words) > 5 and words[1] == "FLOCK":
            major, minor, inode = words[5].split(":")
            if (int(major, 16), int(minor, 16), int(inode)) == file and int(words[4]) > 0:
                return f"process {words[4]}"
    return "another process"


def _slug(key: str) -> str:
    """Return a readable file name that is unique to a key."""
    plain = re.sub(r"[^A-Za-z0-9]+", "-", key).strip("-")
    if plain == key:
        return plain
    return f"{plain[-40:]}-{hashlib.sha256(key.encode()).hexdigest()[:12]}"


def _locked(path: Path) -> int:
    """Return a locked descriptor of the file that currently has this name."""
    while True:
        fd = _open(path)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # The previous holder removes its file: the name may be free, or another file's.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(fd), os.stat(path)):
                    return fd
        except BaseException:
            os.close(fd)
            raise
        os.close(fd)


def _release(fd: int, path: Path) -> None:
    with contextlib.suppress(OSError):  # created by another user
        path.unlink()
    os.close(fd)


def _open(path: Path) -> int:
    # Two steps, because the kernel denies O_CREAT on another user's file in a sticky folder.
    flags = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
    try:
        fd = os.open(path, flags)
    except FileNotFoundError:
        try:
            fd = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o444)
        except FileExistsError:
            return _open(path)
    if not stat.S_ISREG(os.fstat(fd).st_mode):
        os.close(fd)
        raise OSError(errno.EINVAL, "not a regular file")
    return fd
