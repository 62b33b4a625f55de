"""Computing times of rthyb on this machine, and the error of its kinematics, compared with targets.

Prints the machine's properties and a table, and writes both to runs/bench-<UTC>.json. An absolute
time depends on the machine as much as on the program, so a figure above its target is only marked;
requirements for any machine are in tests/test_speed.py.
"""

from __future__ import annotations

import datetime
import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import driver
import interface
import long_recording
import loops
import numpy as np
import pins
import punctuality
import screen
import structures
from rthyb_rt._core import ffi, lib

from rthyb_rt import config, core
from rthyb_rt.benchmark import benchmark_runs
from rthyb_rt.lab import experiment, virtual_time

ROOT = Path(__file__).resolve().parents[2]
BUILD = ROOT / "build" / "bench"
EXAMPLE = ROOT / "examples" / "section5-T0.5.toml"
MIB = 2**20
CORE_DOES_MORE = "the core also gates, limits, monitors and writes the record"
"""Why the numba loop, which does none of that, is slightly faster."""

# Targets: ns per sample, ms per test of 60 s. Keys are (group, name) of the C driver.
SAMPLE_TARGETS_NS = {("sample", "paper"): 60.0, ("sample", "alpha-beta"): 150.0}
TEST_TARGETS_MS = {"pure delay": 15.0, "first order": 15.0, "servo-hydraulic": 60.0}


@dataclass(frozen=True)
class Figure:
    """One row of the table; ``target`` is a maximum, or with ``at_least`` a minimum."""

    name: str
    measured: float
    unit: str
    target: float | None = None
    at_least: bool = False
    note: str = ""

    @property
    def verdict(self) -> str:
        """Return "ok", "over", or nothing if there is no target."""
        if self.target is None:
            return ""
        good = self.measured >= self.target if self.at_least else self.measured <= self.target
        return "ok" if good else ("under" if self.at_least else "over")


# ---- the machine --------------------------------------------------------------------------------


def machine_facts() -> dict[str, Any]:
    """Return the properties on which computing times depend."""
    return {
        "cpu": _cpu_model(),
        "cores": os.cpu_count(),
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "governor": _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
        or "not readable",
        "hypervisor": _read("/sys/hypervisor/type") or _hypervisor_flag(),
        "load_1_min": round(os.getloadavg()[0], 2),
        "compiler": core.build_facts()["compiler"],
        "core": core.version(),
        "python": platform.python_version(),
        "numpy": np.__version__,
    }


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _cpu_model() -> str:
    for line in _read("/proc/cpuinfo").splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _hypervisor_flag() -> str:
    return "virtual machine" if " hypervisor" in _read("/proc/cpuinfo") else "none seen"


# ---- the C driver -------------------------------------------------------------------------------


def c_figures(rows: list[dict[str, Any]]) -> list[Figure]:
    """Convert the driver's rows to rows of the table."""
    figures = []
    for row in rows:
        group, name, median = row["group"], row["name"], row["median_ns"]
        if group == "length":
            continue
        if group == "test of 60 s":
            target = next((t for k, t in TEST_TARGETS_MS.items() if name.startswith(k)), None)
            note = f"p10 {row['p10_ns'] / 1e6:.1f}"
            figures.append(Figure(f"{group}: {name}", median / 1e6, "ms", target, note=note))
        else:
            target = SAMPLE_TARGETS_NS.get((group, name))
            note = f"p10 {row['p10_ns']:.1f}"
            what = "sample, 1 DOF and 1 axis" if group == "sample" else group
            figures.append(Figure(f"{what}: {name}", median, "ns", target, note=note))
    cost = {
        float(row["name"].split()[0]): row["least_ns"] for row in rows if row["group"] == "length"
    }
    shortest, longest = min(cost), max(cost)
    ratio = (cost[longest] / longest) / (cost[shortest] / shortest)
    figures.append(
        Figure(
            f"length: cost of a second, {longest:.0f} s test over {shortest:.0f} s test",
            ratio,
            "x",
            1.3,
        )
    )
    return figures


# ---- from Python --------------------------------------------------------------------------------


def call_figure() -> Figure:
    """Time rthyb_controller_step called from Python, one sample per call."""
    controller, _ = loops.core_pair()
    struct = controller._c
    sample = ffi.new("rthyb_input *")
    record = ffi.new("rthyb_record *")
    step, calls = lib.rthyb_controller_step, 20_000

    def once() -> float:
        start = time.perf_counter_ns()
        for _ in range(calls):
            step(struct, sample, record)
        return (time.perf_counter_ns() - start) / calls

    times = sorted(once() for _ in range(50))
    note = f"p10 {times[5]:.0f}; the sample and the loop around the call included"
    return Figure("one call from Python, paper", statistics.median(times), "ns", 250.0, note=note)


def virtual_time_figures() -> list[Figure]:
    """Time a test of 60 s in virtual time, as run by the rest of the program."""
    hydraulic = experiment.rig_config(
        config.load_rig(ROOT / "hw/rigs/shaking-table-portal-frame.toml")
    )
    figures = []
    for name, rig, target in (
        ("pure delay, Bouc-Wen", None, 15.0),
        ("shaking table, 16 substeps", hydraulic, 60.0),
    ):
        ag = loops.excitation(60.0)
        if rig is not None:
            ag = ag * 0.1
        records = np.zeros(ag.size, core.RECORD_DTYPE)
        median = statistics.median(loops.in_core(ag, records, rig) for _ in range(21))
        figures.append(Figure(f"test of 60 s from Python: {name}", median * 1e3, "ms", target))
    test = config.load_test(EXAMPLE, {"test.duration_s": "60"})
    setup = experiment.prepare(
        test, config.load_rig(ROOT / "hw/rigs/shaking-table-portal-frame.toml")
    )
    whole = statistics.median(loops.timed(lambda: virtual_time.run(setup)) for _ in range(7))
    figures.append(
        Figure(
            "experiment.run of 60 s", whole * 1e3, "ms", note="with reference simulation, TOML, git"
        )
    )
    return figures


BENCHMARK_TARGETS = {1024: 1000.0, 4096: 250.0}
"""Seconds of the RTHS benchmark per second of computing time on one processor, by rate in Hz."""


def benchmark_figures() -> list[Figure]:
    """Time one run of the RTHS benchmark with its plant, and no reference simulation."""
    figures = []
    for rate_hz, target in BENCHMARK_TARGETS.items():
        run = benchmark_runs.BenchmarkRun("inverse", rate_hz, 1, "elcentro")
        setup = benchmark_runs.prepared(run)
        taken = min(processor_s(lambda setup=setup: virtual_time.run(setup)) for _ in range(5))
        faster = setup.ticks / rate_hz / taken
        name = f"RTHS benchmark with its plant, {rate_hz} Hz"
        note = "times real time on one processor"
        figures.append(Figure(name, faster, "x", target, True, note))
    return figures


def processor_s(work: Callable[[], object]) -> float:
    """Return the processor time of a call, s, which depends little on what else is running."""
    begun = time.process_time()
    work()
    return time.process_time() - begun


def loop_figures() -> list[Figure]:
    """Time one test of 60 s in the core, in NumPy-Python and in numba, and compare the results."""
    c = loops.compare(60.0)
    return [
        Figure("same test: C core", c.core_s * 1e3, "ms"),
        Figure("same test: NumPy-Python loop", c.numpy_s * 1e3, "ms"),
        Figure("same test: numba loop", c.numba_s * 1e3, "ms", note="compiled beforehand"),
        Figure("NumPy-Python over core", c.numpy_s / c.core_s, "x", 20.0, at_least=True),
        Figure("core over numba", c.core_s / c.numba_s, "x", 3.0, note=CORE_DOES_MORE),
        Figure(
            "largest difference of the three",
            c.difference,
            "of peak",
            1e-9,
            note=f"x_num, x_meas, alpha; peak {c.peak_m * 1e3:.0f} mm",
        ),
    ]


# ---- the command line ---------------------------------------------------------------------------


@dataclass(frozen=True)
class Command:
    """Resources used by one command."""

    seconds: float
    table_s: float
    cpu_s: float
    peak_mib: float


def run_command(
    arguments: list[str], folder: Path, last_table_line: str, expected: int = 0
) -> Command:
    """Run ``rthyb`` as from a shell; ``last_table_line``: start of the table's last line."""
    start = time.perf_counter()
    rthyb = Path(sys.executable).with_name("rthyb")
    with subprocess.Popen(
        [rthyb, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        text=True,
    ) as process:
        table_s = 0.0
        for line in process.stdout or ():
            if line.startswith(last_table_line):
                table_s = time.perf_counter() - start
        # wait4 returns this child's own processor time and peak memory; Popen.wait does not.
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != expected:
        raise SystemExit(f"rthyb {' '.join(arguments)} ended with {process.returncode}")
    return Command(
        seconds=time.perf_counter() - start,
        table_s=table_s,
        cpu_s=usage.ru_utime + usage.ru_stime,
        peak_mib=usage.ru_maxrss * 1024 / MIB,
    )


def command_figures() -> list[Figure]:
    """Time `rthyb run` and `rthyb --help`, without the first call of each."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        runs = [run_command(["run"], folder, "Recording") for _ in range(4)][1:]
        helps = [run_command(["--help"], folder, "Usage") for _ in range(6)][1:]
    table_s = statistics.median(r.table_s for r in runs)
    total_s = statistics.median(r.seconds for r in runs)
    return [
        Figure("rthyb run: shell to table", table_s, "s", 3.0),
        Figure("rthyb run: with the report", total_s, "s"),
        Figure("rthyb run: peak memory with report", max(r.peak_mib for r in runs), "MiB", 400.0),
        Figure("rthyb --help: processor time", statistics.median(h.cpu_s for h in helps), "s", 0.4),
    ]


def interface_figures() -> list[Figure]:
    """Time the Python interface: its import, a run beside the command, a thousand runs."""
    imported = interface.import_cpu_s()
    pairs = interface.run_and_command()
    many = interface.sweep_and_script()
    load = os.getloadavg()[2]
    runs = f"{interface.RUNS} runs of 40 s on {interface.PROCESSES} processors"
    return [
        Figure("import rthyb_rt: processor time", imported, "s", interface.IMPORT_MOST_S),
        Figure(
            "rt.run over rthyb run",
            interface.ratio_of(pairs),
            "x",
            interface.RUN_OVER_COMMAND_MOST,
            note=f"processor time, median of {len(pairs)} alternating pairs",
        ),
        Figure(
            f"rt.sweep, {runs}",
            many.python.seconds,
            "s",
            interface.THOUSAND_RUNS_MOST_S,
            note=f"processor time {many.python.cpu_s:.0f} s; load {load:.1f}",
        ),
        Figure(
            "the same by a script of the program's parts",
            many.other.seconds,
            "s",
            note=f"processor time {many.other.cpu_s:.0f} s",
        ),
    ]


def diagnosis_figures() -> list[Figure]:
    """Time `rthyb diagnose` on a short and a long recording with friction not in the model."""
    figures = []
    for seconds, target_s, repetitions in ((15.0, 5.0, 3), (600.0, 60.0, 1)):
        with tempfile.TemporaryDirectory() as name:
            recording, model = long_recording.write(Path(name), seconds)
            arguments = ["diagnose", str(recording), "--model", str(model)]
            runs = [
                run_command(arguments, Path(name), "Next", expected=8) for _ in range(repetitions)
            ]
        what = f"rthyb diagnose, recording of {seconds:.0f} s"
        taken = statistics.median(r.seconds for r in runs)
        cpu = statistics.median(r.cpu_s for r in runs)
        figures += [
            Figure(what, taken, "s", target_s, note=f"processor time {cpu:.1f} s"),
            Figure(f"{what}: peak memory", max(r.peak_mib for r in runs), "MiB", 1024.0),
        ]
    return figures


def timing_figures() -> list[Figure]:
    """Time 1024 ticks per second in C with a bare thread, and the same loop in Python."""
    figures = []
    for result in punctuality.in_core():
        name, wake, sent = result.case.title, result.measured.wake, result.measured.sent
        reference_us = result.reference.wake.percentile_ns(99.0) / 1e3
        counts = result.measured.counts
        figures.append(
            Figure(
                f"wake-up p99: {name}",
                wake.percentile_ns(99.0) / 1e3,
                "us",
                round(1.25 * reference_us + 20.0),
                note=f"bare thread {reference_us:.0f}; {counts.skipped} of {counts.elapsed} "
                f"skipped; run {result.attempts} x",
            )
        )
        if result.case.payload == "exchange":
            sent_us = sent.percentile_ns(50.0) / 1e3
            figures.append(Figure(f"wake-up to sent, p50: {name}", sent_us, "us", 25.0))
    figures += loop_timing_figures()
    for name, loop in punctuality.in_python().items():
        missed = 100.0 * loop.counts.skipped / loop.counts.elapsed
        note = f"p50 {loop.wake.percentile_ns(50.0) / 1e3:.0f}; {missed:.0f} % of ticks skipped"
        p99_us = loop.wake.percentile_ns(99.0) / 1e3
        figures.append(Figure(f"wake-up p99: {name}", p99_us, "us", note=note))
    return figures


def loop_timing_figures() -> list[Figure]:
    """Time the whole tick: CAN frames over a socket pair, station, record, ring."""
    run, attempts = punctuality.in_loop()
    facts, counts, bare_us = run.facts, run.facts["counts"], run.reference.p99_ns / 1e3
    note = (
        f"bare thread {bare_us:.0f}; {counts['skipped']} of {counts['elapsed']} skipped; "
        f"run {attempts} x"
    )
    sent_note = f"p99 {facts['sent_p99_ns'] / 1e3:.0f}"
    allowed_us = round(1.25 * bare_us + 20.0)
    return [
        Figure("wake-up p99: whole loop", facts["wake_p99_ns"] / 1e3, "us", allowed_us, note=note),
        Figure(
            "wake-up to sent, p50: whole loop", facts["sent_p50_ns"] / 1e3, "us", 25.0,
            note=sent_note,
        ),
    ]  # fmt: skip


def structure_figures() -> list[Figure]:
    """Time a step of structures of many degrees of freedom."""
    t = structures.measure()
    return [
        Figure(
            "structure: 1008 DOF, 200 Bouc-Wen, a step",
            t.frame_us,
            "us",
            70.0,
        ),
        Figure(
            "structure: the same over the six full products of the printed method",
            t.frame_us / t.dense_us, "x", 0.25,
            note=f"inverse, K, C, 3 integration matrices: {t.dense_us:.0f} us, no elements",
        ),
        Figure(
            "structure: the same over the product with the full inverse alone",
            t.frame_us / t.product_us, "x",
            note=f"{t.product_us:.0f} us; a step needs the other five as well",
        ),
        Figure(
            "structure: linear, 3024 DOF, a step", t.large_us, "us", 300.0,
            note=f"slender; {t.squat_us:.0f} in 12 wide storeys",
        ),
        Figure(
            "structure: force to command, 1 DOF", t.one_us, "us",
            note="one call from Python included; beside another checkout: make bench-pairs",
        ),
        Figure("structure: force to command, 3024 over 1 DOF", t.answer_us, "us", 5.0),
        Figure(
            "structure: the same, 32 floors with steep friction slipping, over 1 DOF", t.slip_us,
            "us", 5.0,
            note=f"ticks with the most work; {t.slip_most_us:.1f} with Stribeck curves",
        ),
        Figure("structure: memory, 3024 DOF", t.large_mb, "MB", 8.0),
    ]  # fmt: skip


def kinematics_figures() -> list[Figure]:
    """Hold the poses of three pinned axes against their lengths in a second formulation."""
    c = pins.measure()
    size = f"{1e3 * pins.MOST_M:.0f} mm and {1e3 * pins.MOST_RAD:.0f} mrad"
    errors = f"of x and y {c.translation_m:.2g} m, of theta {c.rotation_rad:.2g} rad"
    return [
        Figure(
            f"kinematics of pins, {size}: largest closing error", c.axis_m, "m", 1e-12,
            note=f"{c.poses} poses along a grid; largest error {errors}",
        )
    ]  # fmt: skip


def screen_figures() -> list[Figure]:
    """Time the live view from a sample to the screen, if a browser is installed."""
    missing = screen.missing()
    if missing:
        print(f"Not measured: the live view needs {missing}; make test-live installs it\n")
        return []
    found = screen.measure()
    return [
        Figure(
            "live view: sample to screen, p50",
            found.p50_ms,
            "ms",
            50.0,
            note=f"p95 {found.p95_ms:.0f}; painted by chromium without a GPU, "
            f"{found.frames_per_s:.0f} frames a second",
        ),
        Figure(
            "live view: server, of one core",
            found.server_share * 100.0,
            "%",
            10.0,
            note=f"the page's scripts {found.page_share * 100:.1f} %; all of the browser, which "
            f"paints without a GPU, {found.browser_share * 100:.0f} %",
        ),
    ]


# ---- the table ----------------------------------------------------------------------------------


def print_table(figures: list[Figure]) -> None:
    """Print figure, measured value, target and ok or over."""
    width = max(len(f.name) for f in figures)
    print(f"{'figure':{width}}  {'measured':>10}  {'target':>14}")
    for f in figures:
        measured = f"{f.measured:.3g}" if f.measured < 1000 else f"{f.measured:.0f}"
        bound = "" if f.target is None else f"{'≥' if f.at_least else '≤'} {f.target:g} {f.unit}"
        line = f"{f.name:{width}}  {measured:>10} {f.unit:7} {bound:>12}  {f.verdict:5} {f.note}"
        print(line.rstrip())


def main() -> None:
    """Measure everything, print the table, write the JSON file."""
    facts = machine_facts()
    for key, value in facts.items():
        print(f"{key:13} {value}")
    print("\nMeasuring for four minutes ...\n", flush=True)
    # First, while this process is small: a child's peak includes its memory before exec.
    commands = [*command_figures(), *diagnosis_figures(), *interface_figures()]
    rows = driver.rows(driver.build(ROOT, BUILD))
    ratio = loops.counting_ratio()
    figures = [
        *c_figures(rows),
        call_figure(),
        *virtual_time_figures(),
        *benchmark_figures(),
        Figure("GIL: a thread counts during a test", ratio, "x", 0.5, True, "of its speed alone"),
        *loop_figures(),
        *timing_figures(),
        *structure_figures(),
        *kinematics_figures(),
        *screen_figures(),
        *commands,
    ]
    print_table(figures)
    now = datetime.datetime.now(datetime.UTC)
    path = ROOT / "runs" / f"bench-{now:%Y%m%dT%H%M%SZ}.json"
    path.parent.mkdir(exist_ok=True)
    document = {
        "schema": "rthyb-bench/1",
        "created_utc": now.isoformat(timespec="seconds"),
        "machine": facts,
        "figures": [{**asdict(f), "verdict": f.verdict} for f in figures],
        "c_driver": rows,
    }
    path.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"\n{path.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
