"""A real kernel for the tests: Debian's user-mode Linux, a plain process that has SocketCAN.

``run`` boots it, sets CAN interfaces up, runs one command on the host's own files and returns the
command's exit code. The guest sees the whole host read-only under an overlay in its memory: what it
writes is gone afterwards, except in the job folder. Nothing is installed; the kernel's package is
unpacked below ``build/vm``.

From a shell: ``python tests/vm/guest.py -- COMMAND...``
"""

from __future__ import annotations

import argparse
import contextlib
import os
import platform
import shlex
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Final

ROOT: Final = Path(__file__).resolve().parents[2]
STORE: Final = ROOT / "build" / "vm"
UNPACKED: Final = STORE / "root"
LINUX: Final = UNPACKED / "usr/bin/linux.uml"
BUSYBOX: Final = UNPACKED / "bin/busybox"
PACKAGES: Final = ("user-mode-linux", "busybox-static", "can-utils")
MODULES: Final = ("overlay", "can-raw", "vcan", "vxcan", "slcan")

INTERFACES: Final = """\
link add vcan0 type vcan
link add vcan1 mtu 72 type vcan
link add vxcan0 type vxcan peer name vxcan1
link set vcan0 up
link set vcan1 up
link set vxcan0 up
link set vxcan1 up
"""
"""What `run` gives to ``ip -batch``: vcan1 takes CAN FD frames, vxcan0 and vxcan1 are one cable."""

ENVIRONMENT: Final[Mapping[str, str]] = {
    "RTHYB_GUEST": "1",
    "RTHYB_VCAN": "vcan0",
    "RTHYB_VCAN_FD": "vcan1",
    "RTHYB_VXCAN": "vxcan0,vxcan1",
    "PYTHONDONTWRITEBYTECODE": "1",
    "PYTHONUNBUFFERED": "1",
}

MEMORY_MIB: Final = 1024
BOOT_TIMEOUT_S: Final = 60.0
MOUNTED: Final = ("/dev", "/proc", "/run", "/sys")
"""Where the guest has file systems of its own, so that the host's are out of sight."""

# The first program of the guest, from its memory: modules, then the host's files as its root.
INIT: Final = """\
#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t proc proc /proc
for module in /modules/*; do insmod "$module" || echo "guest: no $module"; done
mount -t hostfs -o ro,/ host /host
mount -t tmpfs -o size=80% memory /memory
mkdir /memory/upper /memory/work
mount -t overlay -o lowerdir=/host,upperdir=/memory/upper,workdir=/memory/work overlay /new
mount -t proc proc /new/proc
mount -t sysfs sysfs /new/sys
mount -t devtmpfs devtmpfs /new/dev
mkdir -p /new/dev/pts /new/dev/shm
mount -t devpts -o ptmxmode=666 devpts /new/dev/pts
mount -t tmpfs tmpfs /new/dev/shm
mount -t tmpfs tmpfs /new/run
mkdir -m 1777 /new/run/job /new/run/tmp
mount -t hostfs -o "$(sed 's/.* rthyb_job=\\([^ ]*\\).*/\\1/' /proc/cmdline)" job /new/run/job
rm -f /new/.dockerenv
umount /proc
exec switch_root /new /bin/sh /run/job/boot
"""

# The second, from the job folder: interfaces, command, exit code. What the command leaves running
# may hold its output open, so the end of that is not waited for without limit. The rebuild of the
# editable install is the host's work, and so cmake does nothing here (SKBUILD_EDITABLE_SKIP would
# do more than its name says: with it the compiled core is not found at all).
BOOT: Final = """\
exec </dev/null >/dev/console 2>&1
hostname guest
mkdir /run/bin
ln -s {true} /run/bin/cmake
ip link set lo up
ip -batch /run/job/interfaces || echo 'guest: an interface is missing'
stty -F /dev/ttyS0 raw -echo
cd {folder}
: >/run/job/started
mkfifo /run/output
cat /run/output >/dev/ttyS0 &
{environment} {command} >/run/output 2>&1
echo $? >/run/job/code.part
timeout 2 tail -s 0.05 --pid=$! -f /dev/null
mv /run/job/code.part /run/job/code
sync
exec {busybox} poweroff -f
"""


class GuestError(Exception):
    """The guest machine cannot be had or has failed; the command is not to blame."""


@dataclass(frozen=True)
class Done:
    """How a command ended, and how long machine and command took."""

    code: int
    boot_s: float
    command_s: float


# ---- what it is made of -------------------------------------------------------------------------


def _call(*command: str, cwd: Path | None = None) -> None:
    """Run a tool of the host; its output only when it fails."""
    ran = subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)
    if ran.returncode:
        raise GuestError(f"{shlex.join(command)} failed:\n{ran.stdout}{ran.stderr}".rstrip())


def _require_ip() -> None:
    """Find ``ip`` on the host, or have it installed where that is allowed."""
    search = os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin"
    if shutil.which("ip", path=search):
        return
    if os.geteuid() or not shutil.which("apt-get"):
        raise GuestError("make test-vm needs ip: sudo apt-get install iproute2")
    _call("apt-get", "-qq", "update")
    _call("apt-get", "-qq", "install", "-y", "--no-install-recommends", "iproute2")


def _download(folder: Path) -> None:
    """Fetch the packages; a machine that never asked for any has no list of them yet."""
    try:
        _call("apt-get", "-qq", "download", *PACKAGES, cwd=folder)
    except GuestError as error:
        if os.geteuid():
            raise GuestError(f"{error}\nDebian's lists may be old: sudo apt-get update") from error
        _call("apt-get", "-qq", "update")
        _call("apt-get", "-qq", "download", *PACKAGES, cwd=folder)


def fetch() -> None:
    """Have the kernel and its tools below ``build/vm``; nothing is done when they are there.

    Raises:
        GuestError: they cannot be had on this machine; the text says what to do.
    """
    _require_ip()
    if UNPACKED.is_dir():
        return
    for tool in ("apt-get", "dpkg-deb"):
        if platform.machine() != "x86_64" or not shutil.which(tool):
            raise GuestError(
                f"make test-vm needs {', '.join(PACKAGES)} of Debian for amd64, and {tool}"
            )
    print(f"Fetching {', '.join(PACKAGES)}", flush=True)
    STORE.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=STORE) as made:
        folder, root = Path(made), Path(made) / "root"
        folder.chmod(0o755)
        _download(folder)
        for package in sorted(folder.glob("*.deb")):
            _call("dpkg-deb", "-x", str(package), str(root))
        root.rename(UNPACKED)


def modules(wanted: Iterable[str] = MODULES) -> list[Path]:
    """Return the files of kernel modules, each after those that it needs."""
    (index,) = (UNPACKED / "usr/lib/uml/modules").glob("*/modules.dep")
    needs = {
        Path(name).stem: [Path(name), *map(Path, after.split())]
        for name, _, after in (line.partition(":") for line in index.read_text().splitlines())
    }
    ordered: dict[Path, None] = {}
    for name in wanted:
        ordered |= dict.fromkeys(index.parent / file for file in reversed(needs[name]))
    return list(ordered)


def initramfs(path: Path) -> None:
    """Write the archive that the kernel unpacks into its memory (cpio, format newc)."""
    with path.open("wb") as file:
        for folder in ("bin", "dev", "host", "memory", "modules", "new", "proc"):
            _entry(file, folder, 0o40755)
        _entry(file, "init", 0o100755, INIT.encode())
        _entry(file, "bin/busybox", 0o100755, BUSYBOX.read_bytes())
        for n, module in enumerate(modules()):
            _entry(file, f"modules/{n:02}-{module.name}", 0o100644, module.read_bytes())
        _entry(file, "TRAILER!!!", 0)


def _entry(file: BinaryIO, name: str, mode: int, data: bytes = b"") -> None:
    """Append one member: 13 numbers of 8 hexadecimal digits, name and content padded to 4 bytes."""
    numbers = (file.tell(), mode, 0, 0, 1, 0, len(data), 0, 0, 0, 0, len(name) + 1, 0)
    head = b"070701" + b"".join(b"%08X" % number for number in numbers)
    for part in (head + name.encode() + b"\0", data):
        file.write(part + bytes(-len(part) % 4))


# ---- running it ---------------------------------------------------------------------------------


def run(
    command: Sequence[str],
    *,
    interfaces: str = INTERFACES,
    environment: Mapping[str, str] = ENVIRONMENT,
    timeout: float = 300.0,
    memory_mib: int = MEMORY_MIB,
) -> Done:
    """Boot the guest, run a command there in the project's folder, pass its output on.

    Args:
        command: the program, found on the host's PATH with this Python's folder first, and its
            arguments.
        interfaces: what ``ip -batch`` makes before; `INTERFACES` by default.
        environment: all that the command finds in its environment, beside PATH, HOME and TMPDIR.
        timeout: seconds for the command; boot has `BOOT_TIMEOUT_S` of its own.
        memory_mib: of the guest.

    Raises:
        GuestError: the machine cannot be had, failed twice, or the command took too long; with the
            end of the console's output.
    """
    fetch()
    if any(ROOT.is_relative_to(folder) for folder in MOUNTED):
        raise GuestError(f"the guest sees nothing of {ROOT}: move the project elsewhere")
    with tempfile.TemporaryDirectory(dir=STORE, prefix="job-") as made:
        initramfs(Path(made) / "initramfs")
        for last in (False, True):
            try:
                return _attempt(Path(made), command, interfaces, environment, timeout, memory_mib)
            except _MachineFailure as failure:
                if last:
                    raise GuestError(str(failure)) from failure
                print(f"{failure}\nBooting once more", file=sys.stderr, flush=True)
    raise AssertionError


class _MachineFailure(Exception):
    """The machine ended without an exit code: worth another try."""


def _attempt(
    folder: Path,
    command: Sequence[str],
    interfaces: str,
    environment: Mapping[str, str],
    timeout: float,
    memory_mib: int,
) -> Done:
    job = folder / "job"
    shutil.rmtree(job, ignore_errors=True)
    job.mkdir()
    (job / "interfaces").write_text(interfaces)
    (job / "boot").write_text(_boot(command, environment))
    with (folder / "console").open("w+b") as console, _output() as output:
        begin = time.monotonic()
        machine = _start(folder, job, console, output, memory_mib)
        try:
            up = _wait(machine, job / "started", begin + BOOT_TIMEOUT_S)
            end = _wait(machine, job / "code", up + timeout) if up else 0.0
            if end:
                _wait(machine, folder / "never", end + 10.0)
        finally:
            _kill(machine)
        tail = _tail(console)
    if end:
        return Done(int((job / "code").read_text()), up - begin, end - up)
    if up and time.monotonic() >= up + timeout:
        raise GuestError(f"the command took more than {timeout:g} s in the guest\n{tail}")
    what = (
        "ended before the command did"
        if up
        else "did not come up (it is a process that needs ptrace)"
    )
    raise _MachineFailure(f"the guest {what}\n{tail}")


def _boot(command: Sequence[str], environment: Mapping[str, str]) -> str:
    programs = [str(Path(sys.executable).parent), str(UNPACKED / "usr/bin")]
    path = ["/run/bin", *programs, os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"]
    known = {"PATH": ":".join(path), "HOME": "/run/tmp", "TMPDIR": "/run/tmp", "LANG": "C.UTF-8"}
    assignments = [f"{name}={value}" for name, value in (known | dict(environment)).items()]
    return f"export PATH={shlex.quote(known['PATH'])}\n" + BOOT.format(
        true=shlex.quote(shutil.which("true") or "/bin/true"),
        folder=shlex.quote(str(ROOT)),
        environment=shlex.join(["env", "-i", *assignments]),
        command=shlex.join(command),
        busybox=shlex.quote(str(BUSYBOX)),
    )


@contextlib.contextmanager
def _output() -> Iterator[int]:
    """Give the writing end of a pipe whose bytes go to standard output at once."""
    read, write = os.pipe()

    def pass_on() -> None:
        while data := os.read(read, 65536):
            sys.stdout.buffer.write(data)
            sys.stdout.buffer.flush()

    reader = threading.Thread(target=pass_on)
    sys.stdout.flush()
    reader.start()
    try:
        yield write
    finally:
        os.close(write)
        reader.join()
        os.close(read)


def _start(
    folder: Path, job: Path, console: BinaryIO, output: int, memory_mib: int
) -> subprocess.Popen[bytes]:
    """One processor only: a user-mode kernel that is moved about loses two fifths of its speed."""
    machine = subprocess.Popen(
        [
            *("taskset", "-c", str(max(os.sched_getaffinity(0)))),
            LINUX,
            f"mem={memory_mib}M",
            f"initrd={folder / 'initramfs'}",
            f"rthyb_job={job}",
            f"uml_dir={folder}/",
            "umid=guest",
            "quiet",
            "con=null",
            "con0=null,fd:1",
            "ssl=null",
            f"ssl0=null,fd:{output}",
        ],
        stdin=subprocess.DEVNULL,
        stdout=console,
        stderr=console,
        pass_fds=(output,),
        start_new_session=True,
        env={"PATH": os.defpath, "TMPDIR": str(_memory_folder(folder, memory_mib))},
    )
    # What else is busy here is another session, and between sessions this counts and not `nice`.
    with contextlib.suppress(OSError):
        Path(f"/proc/{machine.pid}/autogroup").write_text("-20")
    return machine


def _memory_folder(folder: Path, memory_mib: int) -> Path:
    """Where the guest's memory lies as a file: containers often have a small /dev/shm."""
    shared = Path("/dev/shm")
    if shared.is_dir() and os.access(shared, os.W_OK):
        free = os.statvfs(shared)
        if free.f_bavail * free.f_frsize > memory_mib << 20:
            return shared
    return folder


def _wait(machine: subprocess.Popen[bytes], file: Path, until: float) -> float:
    """Return when the file appeared (monotonic, s); 0: the machine ended or the time is over."""
    while time.monotonic() < until:
        ended = machine.poll() is not None
        if file.exists():
            return time.monotonic()
        if ended:
            break
        time.sleep(0.02)
    return 0.0


def _kill(machine: subprocess.Popen[bytes]) -> None:
    """End the kernel and the processes that it holds."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(machine.pid, signal.SIGKILL)
    machine.wait()


def _tail(console: BinaryIO, lines: int = 40) -> str:
    console.seek(0)
    text = console.read().decode(errors="replace").splitlines()
    return "\n".join(["The console's last lines:", *text[-lines:]])


def main() -> int:
    """Run what stands after ``--`` and return its exit code; 125 for a failure of the machine."""
    parser = argparse.ArgumentParser(description="Run a command on a kernel that has SocketCAN.")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds for the command")
    parser.add_argument("command", nargs="+")
    given = parser.parse_args()
    try:
        done = run(given.command, timeout=given.timeout)
    except GuestError as error:
        print(f"guest: {error}", file=sys.stderr)
        return 125
    print(f"guest: boot {done.boot_s:.1f} s, command {done.command_s:.1f} s", flush=True)
    return done.code


if __name__ == "__main__":
    sys.exit(main())
