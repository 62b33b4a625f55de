"""A real kernel for the tests: Debian's user-mode Linux, a plain process that has SocketCAN.

``run`` boots it, sets CAN interfaces up, runs one command on the host's own files and returns the
command's exit code. The guest sees the whole host read-only under an overlay in its memory: what it
writes is gone afterwards, except in the job folder. Nothing is installed; the kernel's package is
unpacked below ``build/vm``. With ``systemd`` it is a whole system whose first process that is, on a
disk that outlives its power: the command may ask for another boot, see `AGAIN`.

From a shell: ``python tests/vm/guest.py [--systemd] [--preload] -- COMMAND...``
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
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
GUEST_XSTATE: Final = 2696
"""Bytes in which Debian's user-mode kernel 6.1 keeps a process's extended registers (FP_SIZE)."""

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

AGAIN: Final = "/run/job/again"
"""With systemd: a word that the command leaves here is its end, a good one; the guest is booted
again, and the command run once more, RTHYB_BOOT one higher. "off": when the guest has shut down,
which the command has asked for; "cut": the power is gone at once."""
BOOTS_MOST: Final = 5
DISK_MIB: Final = 1024

MEMORY_MIB: Final = 1024
BOOT_TIMEOUT_S: Final = 60.0
MOUNTED: Final = ("/dev", "/proc", "/run", "/sys")
"""Where the guest has file systems of its own, so that the host's are out of sight."""
SYSTEMD: Final = Path("/lib/systemd/systemd")

# The first program of the guest, from its memory: modules, then the host's files as its root.
INIT: Final = """\
#!/bin/busybox sh
/bin/busybox --install -s /bin
mount -t proc proc /proc
for module in /modules/*; do insmod "$module" || echo "guest: no $module"; done
mount -t hostfs -o ro,/ host /host
mount -t devtmpfs devtmpfs /dev
mount -t ext4 -o noatime /dev/ubda /memory 2>/dev/null || mount -t tmpfs -o size=80% memory /memory
mkdir -p /memory/upper /memory/work
mount -t overlay -o lowerdir=/host,upperdir=/memory/upper,workdir=/memory/work overlay /new
mount -t proc proc /new/proc
mount -t sysfs sysfs /new/sys
mount -t devtmpfs devtmpfs /new/dev
mkdir -p /new/dev/pts /new/dev/shm
mount -t devpts -o ptmxmode=666 devpts /new/dev/pts
mount -t tmpfs tmpfs /new/dev/shm
mount -t tmpfs -o mode=755 tmpfs /new/run
mkdir -m 1777 /new/run/job /new/run/tmp
mount -t hostfs -o "$(sed 's/.* rthyb_job=\\([^ ]*\\).*/\\1/' /proc/cmdline)" job /new/run/job
rm -f /new/.dockerenv
chroot /new /bin/sh /run/job/setup
first="/bin/sh /run/job/boot"
[ ! -e /new/run/job/prepare ] || . /new/run/job/prepare
umount /proc /dev
exec switch_root /new $first
"""

# What every guest has before its second program, from the job folder. The rebuild of the editable
# install is the host's work, and so cmake does nothing here (SKBUILD_EDITABLE_SKIP would do more
# than its name says: with it the compiled core is not found at all).
SETUP: Final = """\
export PATH={path}
hostname guest
mkdir /run/bin
ln -s {true} /run/bin/cmake
ip link set lo up
ip -batch /run/job/interfaces || echo 'guest: an interface is missing'
"""

# With systemd as the second program: once a disk, what a fresh PC has; then a unit of the command.
# Nothing of the host is started, and nobody tidies up its /tmp, which takes a guest minutes. A
# folder that only root may enter would hide the program from the guest's users.
PREPARE: Final = """\
if [ ! -e /memory/prepared ]; then
    rm -rf /new/etc/systemd/system /new/etc/fstab /new/etc/init.d /new/etc/rc?.d /new/etc/*shadow
    mkdir -p /new/etc/systemd/system
    for unit in {masked}; do ln -s /dev/null "/new/etc/systemd/system/$unit"; done
    for folder in {entered}; do chmod o+x "/new$folder"; done
    mkdir -p /new/etc/tmpfiles.d
    : >/new/etc/tmpfiles.d/tmp.conf
    : >/memory/prepared
fi
mkdir -p /new/run/systemd/system/multi-user.target.wants
cp /new/run/job/unit /new/run/systemd/system/guest-job.service
ln -s ../guest-job.service /new/run/systemd/system/multi-user.target.wants
first={systemd}
"""
MASKED: Final = (
    "getty.target",
    "proc-sys-fs-binfmt_misc.automount",
    "systemd-binfmt.service",
    "systemd-firstboot.service",
    "systemd-hwdb-update.service",
    "systemd-logind.service",
    "systemd-networkd.socket",
    "systemd-resolved.service",
    "systemd-timesyncd.service",
)
UNIT: Final = """\
[Service]
Type=oneshot
ExecStart=/bin/sh /run/job/boot
StandardInput=null
"""

# The last, from the job folder: command and exit code. What the command leaves running may hold its
# output open, so the end of that is not waited for without limit.
BOOT: Final = """\
exec </dev/null >/dev/console 2>&1
export PATH={path}
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
    """The guest machine is not available or has failed; the command is not to blame."""


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


def _require(*programs: tuple[str, str]) -> None:
    """Find programs on the host, or have their packages installed where that is allowed."""
    search = os.environ.get("PATH", os.defpath) + ":/usr/sbin:/sbin"
    missing = {package for name, package in programs if not shutil.which(name, path=search)}
    if not missing:
        return
    if os.geteuid() or not shutil.which("apt-get"):
        raise GuestError(f"the guest needs more: sudo apt-get install {' '.join(missing)}")
    _call("apt-get", "-qq", "update")
    # Another installation may be under way beside this one.
    wait = "DPkg::Lock::Timeout=300"
    _call("apt-get", "-qq", "-o", wait, "install", "-y", "--no-install-recommends", *missing)


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
        GuestError: they are not available on this machine; the text says what to do.
    """
    _require(("ip", "iproute2"))
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


def build(name: str, *options: str) -> Path:
    """Have a C source of this folder compiled below ``build/vm``; return its file."""
    _require(("gcc", "gcc"), ("gcc", "libc6-dev"))
    source, built = Path(__file__).with_name(f"{name}.c"), STORE / name
    if not built.exists() or built.stat().st_mtime < source.stat().st_mtime:
        STORE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=STORE) as made:
            part = Path(made) / name
            strict = ("-std=c11", "-O2", "-Wall", "-Wextra", "-Werror")
            _call("gcc", *strict, str(source), "-o", str(part), *options)
            part.replace(built)
    return built


def preloaded(always: bool = False) -> list[Path]:
    """Return what this processor has the kernel need before its own libraries.

    Args:
        always: even where this processor's registers fit into the kernel's area.
    """
    library = build("xstate", "-shared", "-fPIC", "-ldl")
    area = int(ctypes.CDLL(str(library)).xstate_area())
    if area <= GUEST_XSTATE and not always:
        return []
    print(
        f"This processor's registers take {area} bytes, the guest's kernel knows {GUEST_XSTATE}: "
        "it starts with xstate.c before it",
        flush=True,
    )
    return [library]


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
    systemd: bool = False,
    preload: bool = False,
) -> Done:
    """Boot the guest, run a command there in the project's folder, pass its output on.

    Args:
        command: the program, found on the host's PATH with this Python's folder first, and its
            arguments.
        interfaces: what ``ip -batch`` makes before; `INTERFACES` by default.
        environment: all that the command finds in its environment, beside PATH, HOME, TMPDIR, the
            boot's number and the reference thread's program.
        timeout: seconds for the command; boot has `BOOT_TIMEOUT_S` of its own.
        memory_mib: of the guest.
        systemd: with a system around the command, see the module.
        preload: have `xstate.c` before the kernel even where the processor does not ask for it.

    Raises:
        GuestError: the machine is not available, failed twice, or the command took too long; with
            the end of the console's output.
    """
    fetch()
    if systemd:
        _require((str(SYSTEMD), "systemd"), ("udevadm", "udev"), ("mke2fs", "e2fsprogs"))
    if any(ROOT.is_relative_to(folder) for folder in MOUNTED):
        raise GuestError(f"the guest sees nothing of {ROOT}: move the project elsewhere")
    with tempfile.TemporaryDirectory(dir=STORE, prefix="job-") as made:
        initramfs(Path(made) / "initramfs")
        job = _Job(
            Path(made),
            command,
            interfaces,
            environment,
            timeout,
            memory_mib,
            systemd,
            [build("clock", "-shared", "-fPIC", "-ldl"), *preloaded(preload)],
            build("reference", "-lpthread"),
        )
        for last in (False, True):
            try:
                return _attempt(job)
            except _MachineFailure as failure:
                if last:
                    raise GuestError(str(failure)) from failure
                print(f"{failure}\nBooting once more", file=sys.stderr, flush=True)
    raise AssertionError


@dataclass(frozen=True)
class _Job:
    """What `run` was told, and a folder for it."""

    folder: Path
    command: Sequence[str]
    interfaces: str
    environment: Mapping[str, str]
    timeout: float
    memory_mib: int
    systemd: bool
    preloaded: Sequence[Path]
    reference: Path

    @property
    def shared(self) -> Path:
        """The folder that the guest sees as /run/job."""
        return self.folder / "job"

    @property
    def disk(self) -> Path:
        """The file that is the guest's disk, with systemd."""
        return self.folder / "disk"

    def write(self) -> None:
        """Begin anew: an empty shared folder with what the guest starts from, an empty disk."""
        shutil.rmtree(self.shared, ignore_errors=True)
        self.shared.mkdir()
        files = {"interfaces": self.interfaces, "setup": _setup()}
        if self.systemd:
            files |= {"prepare": _prepare(), "unit": UNIT}
            with self.disk.open("wb") as disk:
                disk.truncate(DISK_MIB << 20)
            tool = shutil.which("mke2fs", path=_path())
            _call(str(tool), "-q", "-F", "-t", "ext4", str(self.disk))
        for name, text in files.items():
            (self.shared / name).write_text(text)


class _MachineFailure(Exception):
    """The machine ended without an exit code: worth another try."""


def _attempt(job: _Job) -> Done:
    """Run it from its first boot to its last."""
    job.write()
    boot_s = command_s = 0.0
    for boot in range(1, BOOTS_MOST + 1):
        again = job.shared / Path(AGAIN).name
        for left in (again, job.shared / "started", job.shared / "code"):
            left.unlink(missing_ok=True)
        (job.shared / "boot").write_text(_boot(job, boot))
        done = _one_boot(job, again)
        boot_s, command_s = boot_s + done.boot_s, command_s + done.command_s
        if not again.exists():
            return Done(done.code, boot_s, command_s)
    raise GuestError(f"the command wanted more than {BOOTS_MOST} boots")


def _one_boot(job: _Job, again: Path) -> Done:
    shared, timeout = job.shared, job.timeout
    with (job.folder / "console").open("w+b") as console, _output() as output:
        begin = time.monotonic()
        machine = _start(job, console, output)
        try:
            up = _wait(machine, begin + BOOT_TIMEOUT_S, shared / "started")
            end = _wait(machine, up + timeout, shared / "code", again) if up else 0.0
            cut = again.exists() and again.read_text() == "cut"
            if end and not cut:
                _wait(machine, end + (BOOT_TIMEOUT_S if job.systemd else 10.0))
        finally:
            _kill(machine)
        tail = _tail(console)
    if end:
        code = 0 if again.exists() else int((shared / "code").read_text())
        return Done(code, up - begin, end - up)
    if up and time.monotonic() >= up + timeout:
        raise GuestError(f"the command took more than {timeout:g} s in the guest\n{tail}")
    what = (
        "ended before the command did"
        if up
        else "did not come up (it is a process that needs ptrace)"
    )
    raise _MachineFailure(f"the guest {what}\n{tail}")


def _path() -> str:
    programs = [str(Path(sys.executable).parent), str(UNPACKED / "usr/bin")]
    path = ["/run/bin", *programs, os.environ.get("PATH", os.defpath), "/usr/sbin", "/sbin"]
    return ":".join(path)


def _setup() -> str:
    return SETUP.format(
        path=shlex.quote(_path()), true=shlex.quote(shutil.which("true") or "/bin/true")
    )


def _prepare() -> str:
    parents = {
        parent
        for used in (ROOT, Path(sys.base_prefix), Path(sys.base_prefix).resolve())
        for parent in (used, *used.parents)
    }
    return PREPARE.format(
        masked=shlex.join(MASKED), entered=shlex.join(sorted(map(str, parents))), systemd=SYSTEMD
    )


def _boot(job: _Job, number: int) -> str:
    known = {"PATH": _path(), "HOME": "/run/tmp", "TMPDIR": "/run/tmp", "LANG": "C.UTF-8"}
    known |= {"RTHYB_BOOT": str(number), "RTHYB_REFERENCE": str(job.reference)}
    known |= job.environment
    assignments = [f"{name}={value}" for name, value in known.items()]
    return BOOT.format(
        path=shlex.quote(known["PATH"]),
        folder=shlex.quote(str(ROOT)),
        environment=shlex.join(["env", "-i", *assignments]),
        command=shlex.join(job.command),
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


def _start(job: _Job, console: BinaryIO, output: int) -> subprocess.Popen[bytes]:
    """One processor only: a user-mode kernel that is moved about loses two fifths of its speed."""
    folder = job.folder
    cpu = _idlest()
    environment = {
        "PATH": os.defpath,
        "TMPDIR": str(_memory_folder(folder, job.memory_mib)),
        "LD_PRELOAD": ":".join(map(str, job.preloaded)),
    }
    machine = subprocess.Popen(
        [
            *("taskset", "-c", str(cpu)),
            LINUX,
            f"mem={job.memory_mib}M",
            f"initrd={folder / 'initramfs'}",
            f"rthyb_job={job.shared}",
            *([f"ubd0={job.disk}"] if job.systemd else []),
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
        env=environment,
    )
    # What else is busy here is another session, and between sessions this counts and not `nice`.
    with contextlib.suppress(OSError):
        Path(f"/proc/{machine.pid}/autogroup").write_text("-20")
    return machine


def _idlest() -> int:
    """Return the processor that had least to do for a moment: another guest may be on one."""

    def idle() -> dict[int, int]:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
        rows = [line.split() for line in lines if line.startswith("cpu") and line[3] != " "]
        return {int(row[0][3:]): int(row[4]) for row in rows}

    before = idle()
    time.sleep(0.3)
    after = idle()
    return max(os.sched_getaffinity(0), key=lambda cpu: (after[cpu] - before[cpu], cpu))


def _memory_folder(folder: Path, memory_mib: int) -> Path:
    """Where the guest's memory lies as a file: containers often have a small /dev/shm."""
    shared = Path("/dev/shm")
    if shared.is_dir() and os.access(shared, os.W_OK):
        free = os.statvfs(shared)
        if free.f_bavail * free.f_frsize > memory_mib << 20:
            return shared
    return folder


def _wait(machine: subprocess.Popen[bytes], until: float, *files: Path) -> float:
    """Return when a file appeared (monotonic, s); 0: the machine ended or the time is over."""
    while time.monotonic() < until:
        ended = machine.poll() is not None
        if any(file.exists() for file in files):
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
    parser.add_argument("--systemd", action="store_true", help="a whole system, see AGAIN")
    parser.add_argument("--preload", action="store_true", help="xstate.c, on any processor")
    parser.add_argument("command", nargs="+")
    given = parser.parse_args()
    try:
        done = run(
            given.command, timeout=given.timeout, systemd=given.systemd, preload=given.preload
        )
    except GuestError as error:
        print(f"guest: {error}", file=sys.stderr)
        return 125
    print(f"guest: boot {done.boot_s:.1f} s, command {done.command_s:.1f} s", flush=True)
    return done.code


if __name__ == "__main__":
    sys.exit(main())
