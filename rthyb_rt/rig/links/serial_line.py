"""A serial line: pyserial opens and locks it; this module makes it raw and verifies it."""

from __future__ import annotations

import array
import contextlib
import errno
import fcntl
import grp
import os
import stat
import termios
import tty
from pathlib import Path
from typing import Any, Final

import serial
from serial import serialposix

from rthyb_rt.config import busload
from rthyb_rt.core import wire
from rthyb_rt.core.sizes import STANDARD_RATE_HZ
from rthyb_rt.errors import InputError
from rthyb_rt.rig.links import locks
from rthyb_rt.rig.links.opened import Opened, Owned

BAUD_TOLERANCE: Final = 0.02
"""Greatest mismatch of two UARTs; a driver takes the nearest rate that its divider allows."""
PTY_MAJORS: Final = range(136, 144)
SYSFS: Final = Path("/sys")
_SPEED_AT: Final = 10  # c_ospeed in struct termios2, in 32-bit words


def open_line(path: str, baud: int, rate_hz: int = STANDARD_RATE_HZ) -> Opened:
    """Open a serial line for either side: raw, 8N1, no flow control, exclusively.

    Args:
        path: the device, such as ``/dev/ttyUSB0``.
        baud: bit/s.
        rate_hz: samples per second.

    Raises:
        InputError: no such device, not a serial line, in use, no permission, or a rate that the
            driver does not support or that is too slow for the samples.
    """
    _check_speed(path, baud, rate_hz)
    _check_device(path)
    with Owned() as owned:
        port = _port(path, baud)
        owned.callback(port.close)
        fd = int(port.fd)
        fcntl.ioctl(fd, termios.TIOCEXCL)
        owned.callback(_let_others, fd)
        try:
            _make_raw(fd)
        except (termios.error, OSError) as error:
            raise InputError(
                f"cannot be set up: {error.args[-1]}; plug the adapter in again, or use another "
                "one",
                path,
            ) from error
        _check_rate(fd, path, baud)
        facts = _facts(port, path, baud, rate_hz)
        _discard(fd)
        kind = "pty" if facts["pty"] else "serial"
        return Opened(
            kind="stream",
            fd=fd,
            codec=wire.serial(),
            real_time=True,
            name=f"{path}, {kind} {baud} Bd",
            facts=facts,
            owned=owned.pop_all(),
        )


def _check_speed(path: str, baud: int, rate_hz: int) -> None:
    fault = busload.serial_fault(baud, rate_hz=rate_hz)
    if fault:
        raise InputError(fault, path)


def _check_device(path: str) -> None:
    """Refuse anything but a serial line, since merely opening some devices starts them."""
    try:
        found = os.stat(path)
    except OSError as error:
        raise InputError(_not_opened(path, error.errno, error.strerror), path) from None
    if not stat.S_ISCHR(found.st_mode) or _subsystem(found.st_rdev) not in ("tty", None):
        raise InputError(f"is not a serial line; {_lines_here()}", path)


def _subsystem(device: int) -> str | None:
    """Return what a character device belongs to; None if the kernel does not report it."""
    if os.major(device) in PTY_MAJORS:
        return "tty"
    link = SYSFS / "dev" / "char" / f"{os.major(device)}:{os.minor(device)}" / "subsystem"
    return os.path.basename(os.path.realpath(link)) if link.exists() else None


def _port(path: str, baud: int) -> Any:
    try:
        return serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
    except serial.SerialException as error:
        cause = error.__context__
        number = error.errno if error.errno is not None else getattr(cause, "args", (None,))[0]
        why = os.strerror(number) if isinstance(number, int) else str(error)
        raise InputError(_not_opened(path, number, why), path) from None
    except (ValueError, OSError, termios.error) as error:
        raise InputError(
            f"cannot be set up for {baud} Bd: {error}; choose a rate that both sides support", path
        ) from None


def _not_opened(path: str, number: object, why: str | None) -> str:
    """Return why a device could not be opened and what to do, as text."""
    if number in (errno.ENOENT, errno.ENOTDIR):
        return f"no such device; {_lines_here()}"
    if number in (errno.EACCES, errno.EPERM):
        group = _group(path)
        return (
            f"no permission; it belongs to the group {group}: "
            f"`sudo usermod -aG {group} $USER`, then log in again"
        )
    if number == errno.EWOULDBLOCK:
        return (
            f"{locks.holder(path)} has it open; a serial line can have only one user: stop that "
            "program first"
        )
    if number == errno.EBUSY:
        return "another process has opened it exclusively; stop that process first (`fuser -v`)"
    if number in (errno.ENOTTY, errno.EINVAL):
        return f"is not a serial line; {_lines_here()}"
    if number in (errno.ENXIO, errno.ENODEV, errno.EIO):
        return f"there is no hardware behind it ({why}): is the adapter plugged in?"
    return f"cannot be opened: {why}; try again; if that fails, check `dmesg` and the adapter"


def _lines_here() -> str:
    folder = SYSFS / "class" / "tty"
    with contextlib.suppress(OSError):
        # Only adapters: ttyS0 and others exist on every machine, with or without hardware.
        adapters = [p.name for p in folder.iterdir() if p.name.startswith(("ttyUSB", "ttyACM"))]
        if adapters:
            return f"serial adapters here: {', '.join(f'/dev/{name}' for name in sorted(adapters))}"
    return "there is no USB serial adapter here; is it plugged in? see /dev/serial/by-id"


def _group(path: str) -> str:
    try:
        return grp.getgrgid(os.stat(path).st_gid).gr_name
    except (OSError, KeyError):
        return "dialout"


def _let_others(fd: int) -> None:
    """Allow others to open a pty, which outlives us while its other end is open."""
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCNXCL)


def _make_raw(fd: int) -> None:
    """Set raw mode, 8N1, no flow control and no hang-up on close; the rate stays as it is."""
    tty.setraw(fd, termios.TCSANOW)
    mode = termios.tcgetattr(fd)
    iflag, _, cflag, *_, cc = mode
    mode[0] = iflag & ~(termios.IXOFF | termios.IXANY | termios.IGNBRK | termios.PARMRK)
    off = termios.CRTSCTS | termios.HUPCL | termios.CSTOPB | termios.PARENB | termios.CSIZE
    mode[2] = (cflag & ~off) | termios.CS8 | termios.CREAD | termios.CLOCAL
    # With 0, an empty line would read as 0 bytes and could not be distinguished from a hang-up.
    cc[termios.VMIN], cc[termios.VTIME] = 1, 0
    termios.tcsetattr(fd, termios.TCSANOW, mode)
    os.set_blocking(fd, False)


def _check_rate(fd: int, path: str, baud: int) -> None:
    """Verify 8N1 and the rate, since tcsetattr succeeds if it could apply anything at all."""
    cflag = termios.tcgetattr(fd)[2]
    wrong = termios.PARENB | termios.CSTOPB | termios.CRTSCTS
    if cflag & wrong or cflag & termios.CSIZE != termios.CS8:
        raise InputError(
            "the driver does not support 8N1 without flow control; use an adapter that does", path
        )
    speed = _speed(fd)
    if speed is not None and abs(speed - baud) > BAUD_TOLERANCE * baud:
        raise InputError(
            f"{baud} Bd is not supported: the driver chose {speed} Bd; choose a rate that both "
            "sides support",
            path,
        )


def _speed(fd: int) -> int | None:
    """Return the rate that the driver has set, bit/s; None if it cannot be queried."""
    words = array.array("I", [0] * 64)
    try:
        fcntl.ioctl(fd, serialposix.TCGETS2, words)
    except OSError:
        return None
    return words[_SPEED_AT]


def _facts(port: Any, path: str, baud: int, rate_hz: int) -> dict[str, Any]:
    device = os.path.realpath(path)
    facts: dict[str, Any] = {
        "device": device,
        "baud": baud,
        "pty": os.major(os.fstat(port.fd).st_rdev) in PTY_MAJORS,
        "low_latency": _low_latency(port),
        "line_load": busload.serial_load(baud, rate_hz=rate_hz),
    }
    at_bus = SYSFS / "class" / "tty" / os.path.basename(device) / "device"
    driver = at_bus / "driver"
    if driver.exists():
        facts["driver"] = os.path.basename(os.path.realpath(driver))
    timer = at_bus / "latency_timer"
    with contextlib.suppress(OSError, ValueError):
        facts["latency_timer_ms"] = int(timer.read_text())
    if facts.get("latency_timer_ms", 0) > 1:
        facts["notes"] = [
            f"the adapter holds received bytes back for up to {facts['latency_timer_ms']} ms; set "
            f"it to 1 ms: `echo 1 | sudo tee {timer}`"
        ]
    return facts


def _low_latency(port: Any) -> bool:
    """Ask the driver to forward bytes at once; a pty and some drivers do not support it."""
    try:
        port.set_low_latency_mode(True)
    except (ValueError, NotImplementedError):
        return False
    return True


def _discard(fd: int) -> None:
    """Discard what arrived before the line was locked."""
    termios.tcflush(fd, termios.TCIFLUSH)
