"""Run the core's C tests on an emulated 64-bit ARM processor: ``make test-aarch64``.

zig compiles each test for aarch64 and for this machine's processor, both against the same static
C library (musl); Debian's qemu-aarch64-static runs the former. The counters of the station, loop
and drive test with random input must be the same on both processors, which they are only if the
arithmetic agrees bit for bit. Two tests are left out: those that replace glibc's allocator and
forbid system calls, because the emulator offers neither.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "build" / "aarch64"
FLAGS = (
    *("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno"),
    *("-Wl,--no-gc-sections", "-Icsrc"),
)
SAME = (("handover",), ("fuzz/fuzz_station", "ticks", "1000000", "1"))
"""Tests whose output must be that of this machine's processor."""
THREADS = (("ring_stress",), ("loop_stress",))
"""Tests with several threads, whose counts depend on timing: they must end with status 0."""


def build(test: str, machine: str) -> Path:
    """Compile a test for a machine, and return the program."""
    made = WORK / f"{Path(test).name}-{machine}"
    sources = [f"tests/{test}.c", *(str(path) for path in sorted((ROOT / "csrc").glob("*.c")))]
    zig = (sys.executable, "-m", "ziglang", "cc", "-target", f"{machine}-linux-musl")
    subprocess.run([*zig, *FLAGS, *sources, "-o", made], cwd=ROOT, check=True)
    return made


def output(*command: str | Path) -> str:
    """Return what a test printed, without its speed; stop if it failed."""
    ran = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if ran.returncode:
        sys.exit(f"{ran.stdout}{ran.stderr}{' '.join(map(str, command))}: {ran.returncode}")
    return re.sub(r"\d+ ticks/s", "", ran.stdout)


def main() -> None:
    WORK.mkdir(parents=True, exist_ok=True)
    for test, *arguments in (*SAME, *THREADS):
        begun = time.monotonic()
        emulated = output("qemu-aarch64-static", build(test, "aarch64"), *arguments)
        note = ""
        if (test, *arguments) in SAME:
            here = output(build(test, os.uname().machine), *arguments)
            if emulated != here:
                sys.exit(f"{test} differs.\nThis machine:\n{here}\naarch64:\n{emulated}")
            note = ", the same as here"
        print(f"{test}: passed on aarch64{note}, {time.monotonic() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
