"""One sample asks nothing of the allocator or the kernel, holds no lock and keeps no global.

The tick thread around it asks the kernel for the clock and the link, and for nothing else.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections import defaultdict
from pathlib import Path

import pytest
from core_objects import core_objects, linked
from rthyb_rt._core import lib

from rthyb_rt.core.laws import LAWS

TESTS = Path(__file__).resolve().parent
CORE = TESTS.parent / "csrc"

# What the arithmetic of a sample may call beside the core's own functions.
HARMLESS = re.compile(
    r"(a?sin|a?cos|a?tan|tanh|exp|expm1|ldexp|log|log1p|pow|sqrt|hypot|floor|ceil|fmin|fmax|fabs|copysign"
    r"|l?l?rint|nearbyint|sincos|memcpy|memset|memmove|strlen|strcmp|__(memcpy|memset|memmove)_chk"
    r"|__stack_chk_fail|_GLOBAL_OFFSET_TABLE_|__(start|stop)_rthyb_laws)"
)


def run(program: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    # A preloaded library, such as a sanitizer's, would bring its own allocator.
    environment = {key: value for key, value in os.environ.items() if key != "LD_PRELOAD"}
    return subprocess.run(
        [program, *arguments],
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


@pytest.fixture(scope="module")
def objects() -> dict[str, Path]:
    """The object file of every source of the core."""
    return core_objects()


@pytest.fixture(scope="module")
def program(objects: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/allocation.c with the core."""
    folder = tmp_path_factory.mktemp("allocation")
    return linked(folder / "allocation", [TESTS / "allocation.c", *objects.values()])


@pytest.fixture(scope="module")
def every_case(program: Path) -> subprocess.CompletedProcess[str]:
    return run(program)


@pytest.mark.long
def test_no_sample_of_any_controller_on_any_rig_allocates_or_calls_the_kernel(
    every_case: subprocess.CompletedProcess[str],
) -> None:
    done = every_case
    assert done.returncode == 0, "a system call was made, or a set-up was refused"
    cases, samples, allocations, _ = map(int, done.stdout.split())
    # Five integrators of one degree of freedom, two dense, a sparse part; two axes in four ways.
    assert cases == len(LAWS) * 2 * 8 * 4 * 2 * 2 + 4
    assert samples == 600 * cases
    assert allocations == 0


def test_an_allocation_would_have_been_counted(program: Path) -> None:
    done = run(program, "allocate")
    assert done.returncode == 0
    _, _, allocations, _ = map(int, done.stdout.split())
    assert allocations == 2  # malloc and free


def test_a_system_call_would_have_ended_the_program(
    program: Path, every_case: subprocess.CompletedProcess[str]
) -> None:
    _, _, _, watched = map(int, every_case.stdout.split())
    expected = -signal.SIGKILL if watched else 0
    assert run(program, "call").returncode == expected


# ---- the tick thread -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def loop_program(objects: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """tests/loop_allocation.c with the core: a run of loop and drive from start to join."""
    folder = tmp_path_factory.mktemp("allocation")
    return linked(folder / "loop_allocation", [TESTS / "loop_allocation.c", *objects.values()])


CLOCKS = {"host": lib.RTHYB_CLOCK_HOST, "link": lib.RTHYB_CLOCK_LINK}


@pytest.mark.long
@pytest.mark.parametrize("clock", CLOCKS)
def test_no_tick_from_start_to_join_allocates_or_calls_anything_but_clock_and_link(
    loop_program: Path, clock: str
) -> None:
    done = run(loop_program, str(CLOCKS[clock]), "1500")
    assert done.returncode == 0, "a system call was made, or a set-up was refused"
    elapsed, sent, allocations, _ = map(int, done.stdout.split())
    assert elapsed >= 1500
    assert sent > 500
    assert allocations == 0


def test_an_allocation_of_a_tick_would_have_been_counted(loop_program: Path) -> None:
    done = run(loop_program, str(CLOCKS["host"]), "300", "allocate")
    assert done.returncode == 0
    assert int(done.stdout.split()[2]) == 4  # malloc and free, twice


def test_a_system_call_of_a_tick_would_have_ended_the_run(loop_program: Path) -> None:
    watched = int(run(loop_program, str(CLOCKS["host"]), "50").stdout.split()[3])
    expected = -signal.SIGSYS if watched else 0
    assert run(loop_program, str(CLOCKS["host"]), "300", "call").returncode == expected


# ---- what the objects hold -----------------------------------------------------------------------


class Symbols:
    """What the objects of the core define, need and keep in writable memory, from nm."""

    def __init__(self, objects: dict[str, Path]) -> None:
        self.home: dict[str, str] = {}
        self.laws: set[str] = set()  # sources that the linker makes known to control_law.c
        self.needs: defaultdict[str, set[str]] = defaultdict(set)
        self.writable: defaultdict[str, set[str]] = defaultdict(set)
        for source, target in objects.items():
            command = ["nm", "--format=sysv", target]
            listing = subprocess.run(command, capture_output=True, text=True, check=True)
            for line in listing.stdout.splitlines():
                columns = [column.strip() for column in line.split("|")]
                if len(columns) == 7:
                    self._take(source, columns[2], columns[0], columns[6])

    def _take(self, source: str, kind: str, name: str, section: str) -> None:
        # A constant table of addresses is written once, by whoever loads the core.
        constant = section.startswith(".data.rel.ro")
        if kind in "UwWvV" and kind != "W":
            self.needs[source].add(name)
        elif kind in "BbDdCSsGg" and not constant:
            self.writable[source].add(name)
        if kind in "TWR" or (kind == "D" and constant):
            self.home[name] = source
        if name.endswith("_entry") and kind in "rRdD":
            self.laws.add(source)

    def reached_from(self, *functions: str) -> set[str]:
        """Return the source files that calling these functions can lead to."""
        reached: set[str] = set()
        waiting = [self.home[function] for function in functions]
        while waiting:
            source = waiting.pop()
            if source not in reached:
                reached.add(source)
                waiting += [self.home[n] for n in self.needs[source] if n in self.home]
                waiting += self.laws if source == "control_law.c" else ()
        return reached


@pytest.fixture(scope="module")
def symbols(objects: dict[str, Path]) -> Symbols:
    return Symbols(objects)


@pytest.fixture(scope="module")
def sample_path(symbols: Symbols) -> set[str]:
    files = symbols.reached_from("rthyb_controller_step", "rthyb_rig_step")
    assert {
        "controller.c",
        "control_law.c",
        *(source.name for source in CORE.glob("law_*.c")),
        "plc.c",
        "rfc.c",
        "motion.c",
        "numerical.c",
        "numerical_dense.c",
        "rig.c",
        "element.c",
        "loops.c",
        "friction.c",
        "dampers.c",
    } <= files
    return files


@pytest.mark.long
def test_the_sample_path_calls_nothing_but_arithmetic_and_copies(
    symbols: Symbols, sample_path: set[str]
) -> None:
    outside = {
        (source, name)
        for source in sample_path
        for name in symbols.needs[source]
        if name not in symbols.home and not HARMLESS.fullmatch(name)
    }
    assert outside == set()


def test_the_sample_path_keeps_no_global(symbols: Symbols, sample_path: set[str]) -> None:
    assert {s: symbols.writable[s] for s in sample_path if symbols.writable[s]} == {}
