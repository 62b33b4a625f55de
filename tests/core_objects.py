"""The core as object files for the C programs of the tests, compiled once for all workers and runs.

They are stored in build/test-objects, in a folder named after a hash of all inputs.
"""

from __future__ import annotations

import fcntl
import hashlib
import shutil
import subprocess
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CORE = ROOT / "csrc"
KEPT = ROOT / "build" / "test-objects"
# Position-independent code and stack protectors would need helpers of compiler and linker.
FLAGS = (
    *("-std=c11", "-O3", "-DNDEBUG", "-ffp-contract=off", "-fno-math-errno"),
    *("-fno-pic", "-fno-stack-protector", f"-I{CORE}"),
)


def gcc(*arguments: str | Path) -> None:
    done = subprocess.run(["gcc", *FLAGS, *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def compiled(source: Path, target: Path) -> Path:
    """Compile one source with the same flags as the others."""
    gcc("-c", source, "-o", target)
    return target


def linked(target: Path, parts: Iterable[Path]) -> Path:
    """Link objects and sources to a program whose symbols are all bound at its start."""
    gcc("-no-pie", *parts, "-lm", "-lpthread", "-Wl,-z,now", "-o", target)
    return target


def core_objects() -> dict[str, Path]:
    """Return the object file of every source of the core, by the name of the source."""
    sources = sorted(CORE.glob("*.c"))
    version = subprocess.run(["gcc", "--version"], capture_output=True, text=True, check=True)
    what = hashlib.sha256(repr((FLAGS, version.stdout)).encode())
    for path in (*sources, *sorted(CORE.glob("*.h"))):
        what.update(path.name.encode() + b"\0" + path.read_bytes())
    folder = KEPT / what.hexdigest()[:16]
    targets = [folder / f"{source.stem}.o" for source in sources]
    KEPT.mkdir(parents=True, exist_ok=True)
    with (KEPT / "lock").open("w") as lock, ThreadPoolExecutor(2) as compilers:
        fcntl.flock(lock, fcntl.LOCK_EX)
        whole = folder / "whole"
        if not whole.exists():
            for other in KEPT.iterdir():
                if other.is_dir():
                    shutil.rmtree(other)
            folder.mkdir()
            list(compilers.map(compiled, sources, targets))
            whole.touch()
    return {source.name: target for source, target in zip(sources, targets, strict=True)}
