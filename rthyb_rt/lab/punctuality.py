"""Is this PC punctual enough? Timing of a thread, facts about the machine, and a verdict.

Every figure is shown beside that of a bare reference thread of the same priority, half a period
apart within the same seconds: common delays are due to the machine, the rest to the program.
"""

from __future__ import annotations

import json
import os
import platform
import resource
import tempfile
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rthyb_rt import core
from rthyb_rt.config.rate import STANDARD, Rate
from rthyb_rt.core.ticker import (
    AwakeProcessors,
    JitterRun,
    Latency,
    Payload,
    Timing,
    unlock_memory,
)
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader, claim, default_folder

SCHEMA: Final = "rthyb-jitter/2"
TELEMETRY_HZ: Final = 50.0
"""How often a dashboard reads the ring."""

REPEAT_ABOVE_NS: Final = 10_000_000
"""If the reference thread was later than this, the machine was disturbed: the run is repeated."""
ATTEMPTS: Final = 3
FIT_SHARE: Final = 0.25
"""Share of a period within which a command must be sent: feedback and command take 34-42 % of it
on CAN at 1 Mbit/s, and the drive's own sampling needs a further part."""
FIT_PERCENT: Final = 99.9

Progress = Callable[[int, int], None]


def criterion(rate: Rate = STANDARD) -> str:
    """Return the requirement that a PC must meet at a rate."""
    return (
        f"no tick skipped and {FIT_PERCENT} % of the commands sent within "
        f"{FIT_SHARE * 1e6 * rate.period_s:.0f} µs ({100 * FIT_SHARE:.0f} % of a tick) after they "
        "were due, in every run, with real-time priority and locked memory"
    )


@dataclass(frozen=True)
class Load:
    """Work of the timed thread: one sample per tick, by default that of the built-in test.

    Attributes:
        controller, rig, excitation: settings of the sample.
        rate: rate of the samples.
    """

    controller: core.ControllerConfig
    rig: core.RigConfig
    excitation: npt.NDArray[np.float64]
    rate: Rate = STANDARD

    @classmethod
    def built_in(cls, rate: Rate = STANDARD) -> Load:
        """Return controller, virtual rig and ground motion of the built-in test, at a rate."""
        from rthyb_rt import config
        from rthyb_rt.lab import experiment

        at = {} if rate == STANDARD else {"test.sample_rate_hz": f"{rate.hz:g}"}
        test = config.load_test(config.builtin_test_path(), at)
        setup = experiment.prepare(test, config.load_rig(config.find_rig(test.rig)))
        return cls(setup.controller, setup.virtual_rig, setup.ag_mps2, rate)


@dataclass(frozen=True)
class KindOfRun:
    """One kind of run."""

    payload: Payload
    burner: bool
    telemetry: bool = False

    @property
    def title(self) -> str:
        """Title for tables and plots."""
        payload = {
            "none": "no payload",
            "sample": "one sample a tick",
            "exchange": "one sample and link exchange",
        }[self.payload]
        beside = {"telemetry": self.telemetry, "busy Python": self.burner}
        others = " and ".join(name for name, there in beside.items() if there)
        return f"{payload}, together with {others}" if others else payload


CASES: Final = (
    KindOfRun("sample", False),
    KindOfRun("exchange", False),
    KindOfRun("exchange", False, telemetry=True),
    KindOfRun("sample", True),
    KindOfRun("exchange", True),
)


@dataclass(frozen=True)
class JitterResult:
    """A finished run.

    Attributes:
        attempts: number of attempts, of which the last one counts.
        disturbed: whether the reference thread was too late in that one as well.
        rate: of both threads.
    """

    case: KindOfRun
    measured: Timing
    reference: Timing
    attempts: int
    disturbed: bool
    rate: Rate = STANDARD

    @property
    def ratio(self) -> float:
        """p99 of the wake-up over that of the reference thread."""
        return self.measured.wake.percentile_ns(99.0) / max(
            self.reference.wake.percentile_ns(99.0), 1
        )

    @property
    def late_ns(self) -> int:
        """Upper bound of the time after which FIT_PERCENT of the commands had been sent."""
        # Half of the exceptions may be late wake-ups, the other half late sends.
        each = 0.5 * (100.0 + FIT_PERCENT)
        return self.measured.wake.percentile_ns(each) + self.measured.sent.percentile_ns(each)


# ---- measuring ----------------------------------------------------------------------------------


@contextmanager
def busy_python() -> Iterator[None]:
    """Keep a Python thread busy that releases the GIL only when forced to."""

    def burn(done: threading.Event) -> None:
        while not done.is_set():
            sum(range(1000))

    with _beside("burner", burn):
        yield


@contextmanager
def telemetry_ring(rate: Rate = STANDARD) -> Iterator[Ring]:
    """Yield a ring for the tick thread, and read it 50 times per second, as a dashboard does.

    Raises:
        RthybError: there is no space for a ring.
    """
    folder = claim(default_folder())
    with tempfile.TemporaryDirectory(prefix="jitter-", dir=folder) as own, ExitStack() as owned:
        ring = Ring.create(Path(own), _bare_session(rate))
        owned.callback(ring.remove)
        owned.enter_context(_read_steadily(owned.enter_context(RingReader(ring.path))))
        yield ring


def _bare_session(rate: Rate) -> RecordedTest:
    return RecordedTest(
        np.zeros(0, core.RECORD_DTYPE), rate.hz, np.zeros(0), {}, None, test_toml="", rig_toml=""
    )


@contextmanager
def _read_steadily(reader: RingReader) -> Iterator[None]:
    """Convert new rows of a ring to JSON every 20 ms, in a separate thread."""

    def follow(done: threading.Event) -> None:
        last = False
        while not last:
            last = done.wait(1.0 / TELEMETRY_HZ)
            samples = reader.read().samples
            json.dumps({name: samples[name].tolist() for name in ("tick", "x_num_m", "x_meas_m")})

    with _beside("telemetry", follow):
        yield


@contextmanager
def _beside(name: str, work: Callable[[threading.Event], None]) -> Iterator[None]:
    """Run a function in a separate thread until its event is set."""
    done = threading.Event()
    thread = threading.Thread(target=work, args=(done,), name=name, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def measure(
    case: KindOfRun, ticks: int, load: Load | None, cpu: int = -1, progress: Progress | None = None
) -> JitterResult:
    """Time one kind of run; repeat it, up to three times in all, if the reference thread was late.

    Args:
        case: kind of run.
        ticks: length, at the rate of the load.
        load: work of the timed thread; may be None for a case without a sample, at 1024 Hz.
        cpu: processor of the two timed threads; -1: any.
        progress: called with (ticks done, ticks of the run) four times per second.

    Raises:
        RthybError: the system denied a thread.
    """
    for attempt in range(1, ATTEMPTS + 1):
        run = _run_once(case, ticks, load, cpu, progress or (lambda done, total: None))
        reference = run.reference
        disturbed = reference.wake.max_ns > REPEAT_ABOVE_NS
        rate = load.rate if load else STANDARD
        result = JitterResult(case, run.measured, reference, attempt, disturbed, rate)
        if not disturbed:
            break
    return result


def _run_once(
    case: KindOfRun, ticks: int, load: Load | None, cpu: int, progress: Progress
) -> JitterRun:
    rate = load.rate if load else STANDARD
    with ExitStack() as beside:
        awake = beside.enter_context(AwakeProcessors())
        run = JitterRun(
            ticks,
            case.payload,
            load.controller if load else None,
            load.rig if load else None,
            load.excitation if load else (),
            beside.enter_context(telemetry_ring(rate)) if case.telemetry else None,
            cpu=cpu,
            latency_fd=awake.fd,
            rate_hz=rate.whole_hz,
        )
        beside.callback(unlock_memory)
        if case.burner:
            beside.enter_context(busy_python())
        _follow(run, ticks, progress)
    return run


def _follow(run: JitterRun, ticks: int, progress: Progress) -> None:
    """Run in a separate thread, so that this one can show progress and receive Ctrl-C."""
    failures: list[Exception] = []

    def work() -> None:
        try:
            run.run()
        except Exception as error:
            failures.append(error)

    worker = threading.Thread(target=work, name="jitter")
    worker.start()
    try:
        while worker.is_alive():
            worker.join(0.25)
            progress(run.elapsed, ticks)
    finally:
        run.stop()
        worker.join()
    if failures:
        raise failures[0]


def choose_cpu(facts: Mapping[str, Any]) -> int:
    """Return the processor to use: an isolated one, else the last; -1 if there is only one."""
    allowed = facts["cpus_allowed"]
    if len(allowed) < 2:
        return -1
    isolated = [cpu for cpu in facts["isolated_cpus"] if cpu in allowed]
    return int((isolated or allowed)[-1])


# ---- the machine --------------------------------------------------------------------------------


def machine_facts(root: Path = Path("/")) -> dict[str, Any]:
    """Return facts that affect punctuality; None if the system does not report one.

    Args:
        root: folder that contains /proc, /sys and /etc.
    """
    cpu = root / "sys/devices/system/cpu"
    cpuinfo = _read(root / "proc/cpuinfo") or ""
    arguments = (_read(root / "proc/cmdline") or "").split()
    given = dict(word.partition("=")[::2] for word in arguments)
    throttle = _read(root / "proc/sys/kernel/sched_rt_runtime_us")
    # Processors isolated from the scheduler are not among those that a process may use.
    isolated = cpu_list(_read(cpu / "isolated"))
    return {
        "kernel": platform.release(),
        "preemption": _preemption(root),
        "cpu": _cpu_model(cpuinfo),
        "cpus": os.cpu_count(),
        "cpus_allowed": sorted(os.sched_getaffinity(0) | set(isolated)),
        "isolated_cpus": isolated,
        "nohz_full_cpus": cpu_list(_read(cpu / "nohz_full")),
        "irq_affinity": given.get("irqaffinity"),
        "governor": _read(cpu / "cpu0/cpufreq/scaling_governor"),
        "smt_active": _read(cpu / "smt/active") == "1",
        "virtual_machine": _is_virtual(cpuinfo),
        "clock_source": _read(
            root / "sys/devices/system/clocksource/clocksource0/current_clocksource"
        ),
        "rt_runtime_us": None if throttle is None else int(throttle),
        "load_1_min": round(os.getloadavg()[0], 2),
        "rtprio_limit": _limit(resource.RLIMIT_RTPRIO),
        "memlock_limit_bytes": _limit(resource.RLIMIT_MEMLOCK),
        "user_is_root": os.geteuid() == 0,
        "architecture": platform.machine(),
        "compiler": core.build_facts()["compiler"],
        "core": core.version(),
    }


def _read(path: Path) -> str | None:
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return None


def cpu_list(text: str | None) -> list[int]:
    """Return the processors of a list in the kernel's format, "2-3,6"; (null) is empty."""
    found: list[int] = []
    for part in (text or "").split(","):
        first, _, last = part.strip().partition("-")
        if first.isdigit():
            found += range(int(first), int(last or first) + 1)
    return found


def _preemption(root: Path) -> str:
    """Return the kernel's preemption model, "PREEMPT_RT" if it is a real-time kernel."""
    if _read(root / "sys/kernel/realtime") == "1":
        return "PREEMPT_RT"
    version = (_read(root / "proc/version") or "").replace("-", "_").split()
    models = [word for word in version if word.startswith("PREEMPT")]
    if not models:
        return "none"
    # In debugfs, readable by root only: "none voluntary (full) lazy".
    chosen = _read(root / "sys/kernel/debug/sched/preempt") or ""
    _, found, rest = chosen.partition("(")
    return f"{models[0]} ({rest.partition(')')[0]})" if found else models[0]


def processor() -> str:
    """Return the name of this PC's processor, or else its architecture."""
    return _cpu_model(_read(Path("/proc/cpuinfo")) or "")


def _cpu_model(cpuinfo: str) -> str:
    for line in cpuinfo.splitlines():
        if line.startswith("model name"):
            return line.partition(":")[2].strip()
    return platform.machine()


def _is_virtual(cpuinfo: str) -> bool:
    flags = next((line for line in cpuinfo.splitlines() if line.startswith("flags")), "")
    return "hypervisor" in flags.split()


def _limit(which: int) -> int | None:
    """Return the soft limit; None if there is none."""
    soft = resource.getrlimit(which)[0]
    return None if soft == resource.RLIM_INFINITY else soft


# ---- the verdict --------------------------------------------------------------------------------


@dataclass(frozen=True)
class PunctualityVerdict:
    """Whether a PC is punctual enough.

    Attributes:
        sentence: the result, its reason, and what to change, in one sentence.
        faults: requirements that were not met.
        remedies: what to change, each as (keyword, how to do it).
    """

    fit: bool
    sentence: str
    faults: tuple[str, ...]
    remedies: tuple[tuple[str, str], ...]


def judge(results: Sequence[JitterResult], facts: Mapping[str, Any]) -> PunctualityVerdict:
    """Compare the runs with the criterion."""
    faults = tuple(_faults(results))
    ticks = min(result.measured.counts.elapsed for result in results)
    rate = results[0].rate
    length = f"{ticks / rate.hz:.0f} s" if ticks >= rate.hz else f"{ticks} ticks"
    worst = max(results, key=lambda result: result.late_ns)
    if not faults:
        sentence = (
            f"This PC is fit for {rate.hz:g} Hz, as far as {len(results)} runs of {length} can "
            f"show: no tick was skipped and {FIT_PERCENT} % of the commands were sent within "
            f"{worst.late_ns / 1e3:.0f} µs."
        )
        return PunctualityVerdict(True, sentence, (), ())
    remedies = tuple(_remedies(results, facts))
    change = ", ".join(keyword for keyword, _ in remedies) or "the other programs that run on it"
    sentence = (
        f"This PC is not fit for {rate.hz:g} Hz, because {', '.join(faults)}; to improve it, "
        f"change: {change}."
    )
    return PunctualityVerdict(False, sentence, faults, remedies)


def _faults(results: Sequence[JitterResult]) -> Iterator[str]:
    skipped = sum(result.measured.counts.skipped for result in results)
    elapsed = sum(result.measured.counts.elapsed for result in results)
    if skipped:
        yield f"{skipped} of {elapsed} ticks were skipped"
    worst = max(results, key=lambda result: result.late_ns)
    allowed_ns = FIT_SHARE * 1e9 * worst.rate.period_s
    if worst.late_ns > allowed_ns:
        yield (
            f"{FIT_PERCENT} % of the commands were sent only within {worst.late_ns / 1e3:.0f} µs "
            f"(required: {allowed_ns / 1e3:.0f} µs)"
        )
    had = privileges_of_all(results)
    if "fifo" not in had:
        yield "there was no real-time priority"
    if "memory_locked" not in had:
        yield "memory could not be locked"


def privileges_of_all(results: Sequence[JitterResult]) -> set[str]:
    """Return the privileges that the measured thread had in every run, by name."""
    return set.intersection(*(set(result.measured.privileges) for result in results))


def _remedies(
    results: Sequence[JitterResult], facts: Mapping[str, Any]
) -> Iterator[tuple[str, str]]:
    had = privileges_of_all(results)
    if not {"fifo", "memory_locked"} <= had:
        yield (
            "rtprio and memlock limits",
            "in /etc/security/limits.d/rthyb.conf put '@rthyb - rtprio 95' and "
            "'@rthyb - memlock unlimited', join the group rthyb, log in again; in a systemd unit "
            "LimitRTPRIO=95 and LimitMEMLOCK=infinity",
        )
    if facts["virtual_machine"]:
        yield (
            "a dedicated PC",
            "a virtual machine is stalled by its host for tens of ms, whatever its own settings "
            "are",
        )
    if facts["preemption"] != "PREEMPT_RT":
        yield (
            "PREEMPT_RT kernel",
            "on Debian: apt install linux-image-rt-amd64, then boot it",
        )
    if (facts["cpus"] or 1) < 2:
        yield "a second processor core", "the tick thread needs one of its own"
    else:
        yield from _core_of_its_own(facts)
    if facts["governor"] not in (None, "performance"):
        yield (
            "governor performance",
            f"it is {facts['governor']}; cpupower frequency-set -g performance",
        )
    if "processors_awake" not in had:
        yield (
            "processor sleep",
            "let the user write to /dev/cpu_dma_latency: a udev rule "
            'KERNEL=="cpu_dma_latency", GROUP="rthyb", MODE="0660"',
        )
    if facts["load_1_min"] > 0.5 * (facts["cpus"] or 1):
        yield (
            "other load",
            f"load average {facts['load_1_min']:g}: stop programs that are not needed",
        )


def _core_of_its_own(facts: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    last = (facts["cpus"] or 1) - 1
    if not facts["isolated_cpus"]:
        yield (
            "isolcpus",
            f"keep a core free for the tick thread: kernel parameters isolcpus={last} "
            f"nohz_full={last} rcu_nocbs={last}",
        )
    if facts["irq_affinity"] is None:
        others = f"0-{last - 1}" if last > 1 else "0"
        yield (
            "IRQ affinity",
            f"keep interrupts off that core: kernel parameter irqaffinity={others}, and no "
            "irqbalance",
        )


# ---- for programs -------------------------------------------------------------------------------


def document(
    results: Sequence[JitterResult], facts: Mapping[str, Any], verdict: PunctualityVerdict
) -> dict[str, Any]:
    """Return all results as a document; times in ns, histograms as [begin, end, count]."""
    return {
        "schema": SCHEMA,
        "fit": verdict.fit,
        "verdict": verdict.sentence,
        "sample_rate_hz": results[0].rate.whole_hz,
        "criterion": criterion(results[0].rate),
        "remedies": [{"what": what, "how": how} for what, how in verdict.remedies],
        "machine": dict(facts),
        "runs": [
            {
                "payload": result.case.payload,
                "busy_python": result.case.burner,
                "telemetry": result.case.telemetry,
                "attempts": result.attempts,
                "disturbed": result.disturbed,
                "p99_over_reference": result.ratio,
                "measured": _timing(result.measured),
                "reference": _timing(result.reference),
            }
            for result in results
        ],
    }


def _timing(timing: Timing) -> dict[str, Any]:
    return {
        **timing.counts._asdict(),
        "privileges": list(timing.privileges),
        "lost_pairs": timing.lost,
        "not_sent": timing.not_sent,
        "major_faults": timing.major_faults,
        "minor_faults": timing.minor_faults,
        "blocked": timing.blocked,
        "preempted": timing.preempted,
        "wake_ns": _figures(timing.wake),
        "wake_to_sent_ns": _figures(timing.sent) if timing.sent.count else None,
    }


def _figures(latency: Latency) -> dict[str, Any]:
    edges, counts = Latency.edges_ns(), latency.buckets()
    return {
        "count": latency.count,
        "mean": round(latency.mean_ns, 1),
        **{f"p{p:g}": latency.percentile_ns(p) for p in (50.0, 90.0, 99.0, 99.9)},
        "max": latency.max_ns,
        "histogram": [
            [int(edges[i]), int(edges[i + 1]) if i + 1 < edges.size else None, int(counts[i])]
            for i in np.flatnonzero(counts)
        ],
    }
