"""Build the source distribution and the wheels, and try them: ``make wheels``.

Everything goes to dist/. Each wheel holds one extension for every Python from 3.11 on (abi3),
linked against glibc 2.17, so that it runs on any Linux distribution since 2014. The x86-64 wheel
is installed into a clean environment with its extra ``report`` and runs the built-in test there.
The aarch64 wheel is compiled and its symbols are checked; it is not run (``make test-aarch64``
runs the core's C tests).
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import sysconfig
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
WORK = ROOT / "build" / "wheels"
GLIBC = "2.17"
MACHINES = ("x86_64", "aarch64")


def run(*command: str | Path, where: Path = ROOT, **environment: str) -> str:
    """Run a command and return its output; print the output and exit if it fails."""
    ran = subprocess.run(
        [str(word) for word in command],
        cwd=where,
        env={**os.environ, **environment},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        check=False,
    )
    if ran.returncode:
        sys.exit(f"{ran.stdout}\n{' '.join(str(word) for word in command)}: {ran.returncode}")
    return ran.stdout


def source_distribution() -> Path:
    """Build the source distribution, and return it."""
    run(sys.executable, "-m", "build", "--no-isolation", "--sdist", "--outdir", DIST, ROOT)
    (found,) = DIST.glob("*.tar.gz")
    return found


def unpacked(archive: Path) -> Path:
    """Unpack the source distribution, from which the wheels are built; return its folder."""
    with tarfile.open(archive) as tar:
        tar.extractall(WORK / "source", filter="data")
    (folder,) = (WORK / "source").iterdir()
    return folder


def foreign_headers(machine: str) -> Path:
    """Return an include folder for compiling for another machine with this one's Python headers.

    Debian's pyconfig.h includes the one of the target machine. Both machines have the same sizes
    of C types, and the stable ABI depends on nothing else in it.
    """
    folder = WORK / "include"
    here = Path(sysconfig.get_path("include"))
    own = sysconfig.get_config_var("MULTIARCH") or f"{MACHINES[0]}-linux-gnu"
    place = folder / f"{machine}-linux-gnu" / here.name / "pyconfig.h"
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(f'#include "{here.parent}/{own}/{here.name}/pyconfig.h"\n', encoding="ascii")
    return folder


def wheel(source: Path, machine: str) -> Path:
    """Build the wheel for one machine, check which C library it needs, and return it."""
    raw = WORK / machine
    options, flags = [f"-Cbuild-dir={WORK / machine / 'build'}"], ""
    if machine != os.uname().machine:
        options += [
            "-Ccmake.define.CMAKE_SYSTEM_NAME=Linux",
            f"-Ccmake.define.CMAKE_SYSTEM_PROCESSOR={machine}",
        ]
        flags = f"-I{foreign_headers(machine)}"
    run(
        *(sys.executable, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation"),
        *(*options, "-w", raw, source),
        CC=str(ROOT / "release" / "zig-cc"),
        CFLAGS=flags,
        ZIG_TARGET=f"{machine}-linux-gnu.{GLIBC}",
        ZIG_PYTHON=sys.executable,
        _PYTHON_HOST_PLATFORM=f"linux-{machine}",
    )
    (made,) = raw.glob("*.whl")
    platform = f"manylinux_{GLIBC.replace('.', '_')}_{machine}"
    shown = run(sys.executable, "-m", "auditwheel", "show", made)
    if f'"{platform}"' not in shown:
        sys.exit(f"{made.name} needs more than glibc {GLIBC}:\n{shown}")
    tags = f"{platform}.manylinux2014_{machine}"
    run(sys.executable, "-m", "wheel", "tags", "--remove", f"--platform-tag={tags}", made)
    (tagged,) = raw.glob("*.whl")
    return Path(shutil.move(tagged, DIST / tagged.name))


def tried(made: Path) -> str:
    """Install a wheel into a clean environment, run a test there, and return its version."""
    place, trial = WORK / "environment", WORK / "trial"
    run(sys.executable, "-m", "venv", "--clear", place)
    run(place / "bin" / "python", "-m", "pip", "install", "-q", f"{made}[report]")
    trial.mkdir()
    rthyb = place / "bin" / "rthyb"
    said = run(rthyb, "--version", where=trial) + run(rthyb, "run", where=trial)
    for name in ("recording.h5", "report.html"):
        if len(list(trial.glob(f"runs/*/{name}"))) != 1:
            sys.exit(f"the wheel's `rthyb run` left no {name}:\n{said}")
    return said.splitlines()[0]


def main() -> None:
    for folder in (DIST, WORK):
        shutil.rmtree(folder, ignore_errors=True)
    source = source_distribution()
    print(f"{source.relative_to(ROOT)}  {source.stat().st_size / 1e6:.1f} MB", flush=True)
    folder = unpacked(source)
    for machine in MACHINES:
        made = wheel(folder, machine)
        ours = machine == os.uname().machine
        state = f"runs: {tried(made)}" if ours else "compiled and checked, not run"
        print(f"{made.relative_to(ROOT)}  {made.stat().st_size / 1e6:.1f} MB  {state}", flush=True)


if __name__ == "__main__":
    main()
