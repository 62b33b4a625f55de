"""Times of the Python interface: importing it, one run beside the command, a thousand runs.

``python tests/bench/interface.py`` prints them beside what they are meant to be, and the load of
the machine; ``make bench`` has them among its figures.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

PYTHON = sys.executable
RTHYB = str(Path(sys.executable).with_name("rthyb"))
RUNS, PROCESSES = 1000, 2

IMPORT_MOST_S = 0.15
RUN_OVER_COMMAND_MOST = 1.05
THOUSAND_RUNS_MOST_S = 45.0

RUN = "import sys, rthyb_rt as rt; rec = rt.run(out=sys.argv[1]); rec.table, rec.notices"
SWEEP = """
import sys, rthyb_rt as rt
runs, processes, out = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
found = rt.sweep(repeat_seeds=runs, out=out, jobs=processes, progress=lambda done, whole: None)
sys.exit(len(found) != runs or bool(found.failed or found.stopped))
"""
SCRIPT = """
import sys
from concurrent.futures import ProcessPoolExecutor

from rthyb_rt import config
from rthyb_rt.analysis import summary
from rthyb_rt.lab import experiment, virtual_time


def one(seed):
    test, rig = config.load_both(None, None, [f"rig.seed={seed}"])
    return summary.summarize(virtual_time.run(experiment.prepare(test, rig))).end_reason


if __name__ == "__main__":
    with ProcessPoolExecutor(int(sys.argv[2])) as pool:
        found = list(pool.map(one, range(1, int(sys.argv[1]) + 1)))
    sys.exit(found != ["completed"] * int(sys.argv[1]))
"""
"""The same runs by the parts of the program, without log, table, page or repair of the pool."""


@dataclass(frozen=True)
class Taken:
    """What a command took, its child processes included."""

    seconds: float
    cpu_s: float
    user_s: float


@dataclass(frozen=True)
class Pair:
    """The same job two ways."""

    python: Taken
    other: Taken


def taken(command: Sequence[str], *, processors: int | None = None) -> Taken:
    """Run a command to its end, on so many processors at most.

    Raises:
        RuntimeError: it failed; with what it printed.
    """
    mine = os.sched_getaffinity(0)
    with tempfile.TemporaryFile() as printed:
        start = time.perf_counter()
        os.sched_setaffinity(0, set(sorted(mine)[:processors]))  # which the child inherits
        try:
            process = subprocess.Popen(command, stdout=printed, stderr=subprocess.STDOUT)
        finally:
            os.sched_setaffinity(0, mine)
        # wait4 knows the time of this child and of those it has waited for, and of no other.
        _, status, usage = os.wait4(process.pid, 0)
        seconds = time.perf_counter() - start
        process.returncode = os.waitstatus_to_exitcode(status)
        if process.returncode:
            printed.seek(0)
            raise RuntimeError(
                f"{command[0]} ended with {process.returncode}:\n{printed.read().decode()}"
            )
    return Taken(seconds, usage.ru_utime + usage.ru_stime, usage.ru_utime)


def import_cpu_s(repetitions: int = 5) -> float:
    """Return the processor time of ``import rthyb_rt``, without that of an empty interpreter."""
    codes = ("pass", "import rthyb_rt")
    times = [[taken([PYTHON, "-c", code]).cpu_s for code in codes] for _ in range(repetitions)]
    empty, imported = (min(column) for column in zip(*times, strict=True))
    return imported - empty


def run_and_command(pairs: int = 15) -> list[Pair]:
    """Return alternating runs of the built-in test, with its report, both ways.

    What disturbs the machine disturbs both runs of a pair: compare within pairs only.
    """
    times = []
    with tempfile.TemporaryDirectory() as name:
        for number in range(pairs):
            commands = {
                "python": [PYTHON, "-c", RUN, f"{name}/p{number}"],
                "other": [RTHYB, "run", "--out", f"{name}/c{number}"],
            }
            # Which one comes first changes from pair to pair, and with it what drifts.
            order = sorted(commands, reverse=bool(number % 2))
            times.append(Pair(**{which: taken(commands[which]) for which in order}))
    return times


def ratio_of(pairs: Sequence[Pair]) -> float:
    """Return the median over pairs of the processor time in Python over that of the other way."""
    return statistics.median(pair.python.user_s / pair.other.user_s for pair in pairs)


def sweep_and_script(runs: int = RUNS, processes: int = PROCESSES) -> Pair:
    """Return what so many runs of the built-in test take, by `rthyb_rt.sweep` and by a script."""
    with tempfile.TemporaryDirectory() as name:
        found = []
        for called, text in (("sweep", SWEEP), ("script", SCRIPT)):
            path = Path(name) / f"{called}.py"
            path.write_text(text)
            command = [PYTHON, str(path), str(runs), str(processes), f"{name}/out"]
            found.append(taken(command, processors=processes))
    return Pair(*found)


def main() -> None:
    """Print the three figures, each with the load of the machine before it."""

    def line(name: str, measured: str, most: str) -> None:
        print(f"{name:48} {measured:>10}  {most}", flush=True)

    def loaded() -> None:
        running = "  ".join(f"{load:.2f}" for load in os.getloadavg())
        print(f"load over 1, 5, 15 min: {running}, {os.cpu_count()} processors")

    loaded()
    line("import rthyb_rt, processor time", f"{import_cpu_s():.4f} s", f"≤ {IMPORT_MOST_S} s")
    loaded()
    pairs = run_and_command()
    line(
        "rt.run over rthyb run, processor time",
        f"{ratio_of(pairs):.3f}",
        f"≤ {RUN_OVER_COMMAND_MOST}; median of {len(pairs)} alternating pairs",
    )
    line("  rt.run, median", f"{statistics.median(p.python.user_s for p in pairs):.2f} s", "")
    line("  rthyb run, median", f"{statistics.median(p.other.user_s for p in pairs):.2f} s", "")
    loaded()
    many = sweep_and_script()
    line(
        f"rt.sweep, {RUNS} runs of 40 s, {PROCESSES} processors",
        f"{many.python.seconds:.1f} s",
        f"≤ {THOUSAND_RUNS_MOST_S:g} s; processor time {many.python.cpu_s:.1f} s",
    )
    line(
        "  the same by a script of the program's parts",
        f"{many.other.seconds:.1f} s",
        f"processor time {many.other.cpu_s:.1f} s",
    )
    ratio = many.python.cpu_s / many.other.cpu_s
    line("  sweep over script, processor time", f"{ratio:.3f}", "")
    loaded()


if __name__ == "__main__":
    main()
