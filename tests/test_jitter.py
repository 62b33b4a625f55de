"""`rthyb jitter`: timing beside a reference thread, the facts of a machine, the verdict.

Machines stall, the one that runs this too: what is asserted are ratios to the reference thread of
the same seconds, and what holds on any machine.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rthyb_rt import cli, core
from rthyb_rt.cli.jitter import UNFIT
from rthyb_rt.config import Rate
from rthyb_rt.core.ticker import PRIVILEGES, JitterRun, Latency, Payload, TickCounts, Timing
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import punctuality
from rthyb_rt.lab.punctuality import CASES, JitterResult, KindOfRun
from rthyb_rt.record.ring import RingReader, Rows, default_folder
from rthyb_rt.report import punctuality_page as page

pytestmark = pytest.mark.alone

ALL = tuple(PRIVILEGES)
MS = 1_000_000

LOAD = punctuality.Load(
    core.ControllerConfig(
        core.LawConfig("paper", {"alpha0": 10.0}, adapts=False),
        core.RfcConfig(k_e_n_per_m=1e6),
        core.MotionConfig("central-difference", mass_kg=6000.0, damping_n_s_per_m=3000.0),
    ),
    core.RigConfig(
        core.ServoConfig("pure-delay", delay_samples=10),
        (core.element("stiffness", k_n_per_m=1e6),),
    ),
    np.sin(np.arange(2048) / 50.0),
)

# ---- runs ---------------------------------------------------------------------------------------


def assert_every_tick_is_accounted_for(timing: Timing, ticks: int) -> None:
    counts = timing.counts
    assert counts.executed + counts.skipped == counts.elapsed >= ticks
    assert counts.elapsed - ticks <= counts.longest_skip
    assert timing.wake.count == counts.executed == timing.wake.buckets().sum()
    assert "signals_blocked" in timing.privileges
    assert counts.skipped == 0 or timing.wake.max_ns > 900_000


@pytest.mark.parametrize("payload", ["none", "sample", "exchange"])
def test_every_tick_of_both_threads_is_accounted_for(payload: Payload) -> None:
    result = punctuality.measure(KindOfRun(payload, False), 300, LOAD)
    measured, reference = result.measured, result.reference
    assert_every_tick_is_accounted_for(measured, 300)
    assert_every_tick_is_accounted_for(reference, 300)
    assert measured.sent.count == (0 if payload == "none" else measured.counts.executed)
    assert reference.sent.count == 0
    assert measured.not_sent == 0
    assert measured.lost < measured.counts.executed
    assert (measured.lost > 0) == (payload == "exchange")  # at the first tick nothing has come


def test_a_tick_waits_for_the_clock_alone_and_reads_no_page_from_disk() -> None:
    measured = punctuality.measure(KindOfRun("exchange", False), 300, LOAD).measured
    assert measured.blocked == 0
    assert measured.major_faults == 0 or "memory_locked" not in measured.privileges


def test_telemetry_reader_finds_the_record_of_every_tick_that_was_executed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parts: list[np.ndarray] = []
    read = RingReader.read

    def keep(reader: RingReader) -> Rows:
        parts.append((rows := read(reader)).samples)
        return rows

    monkeypatch.setattr(RingReader, "read", keep)
    folder = default_folder()
    before = set(folder.glob("jitter-*"))
    measured = punctuality.measure(
        KindOfRun("exchange", False, telemetry=True), 1024, LOAD
    ).measured
    ticks = np.concatenate([part["tick"] for part in parts])
    np.testing.assert_array_equal(ticks, np.arange(measured.counts.executed))
    assert sum(part.size > 0 for part in parts) > 1
    assert set(folder.glob("jitter-*")) == before


def test_a_payload_without_controller_is_refused() -> None:
    with pytest.raises(RthybError, match="could not be started"):
        JitterRun(10, "sample").run()


def test_a_run_ends_early_when_it_is_told_to() -> None:
    run = JitterRun(1024 * 3600)
    told: list[int] = []

    def stop_soon(done: int, total: int) -> None:
        assert total == 1024 * 3600
        told.append(done)
        run.stop()

    punctuality._follow(run, 1024 * 3600, stop_soon)
    counts = run.measured.counts
    assert told
    assert counts.executed + counts.skipped == counts.elapsed < 1024 * 3600


@pytest.mark.parametrize("rate_hz", [512.0, 2048.0])
def test_a_run_at_the_rate_of_a_drive_takes_that_long(rate_hz: float) -> None:
    load = punctuality.Load.built_in(Rate(rate_hz))
    assert load.controller.period_s == 1.0 / rate_hz
    punctuality.measure(KindOfRun("exchange", False, telemetry=True), 200, load)
    began_ns = time.monotonic_ns()
    result = punctuality.measure(KindOfRun("sample", False), round(0.25 * rate_hz), load)
    assert time.monotonic_ns() - began_ns >= 0.24e9 * result.attempts
    assert result.rate.hz == rate_hz
    # A stall of the machine may extend over the last tick.
    counts = result.measured.counts
    assert 0 <= counts.elapsed - round(0.25 * rate_hz) <= counts.longest_skip


def test_the_verdict_is_of_the_rate_and_of_its_quarter_of_a_tick() -> None:
    """A command that is sent after 130 us is in time at 1024 Hz, and too late at 2048 Hz."""
    slow = timing(*(122_000,) * 2000)
    for rate, fit, allowed in ((Rate(), True, "244"), (Rate(2048.0), False, "122")):
        verdict = punctuality.judge([replace(one, rate=rate) for one in results(slow)], GOOD_PC)
        assert verdict.fit == fit
        assert f"fit for {rate.hz:g} Hz" in verdict.sentence
        assert f"{allowed} µs" in punctuality.criterion(rate)
    assert "only within 1" in verdict.sentence
    assert "(required: 122 µs)" in verdict.sentence


@pytest.mark.speed
@pytest.mark.parametrize("case", [*CASES, KindOfRun("none", False)], ids=lambda case: case.title)
def test_wake_up_is_as_punctual_as_that_of_a_bare_thread(case: KindOfRun) -> None:
    cpu = punctuality.choose_cpu(punctuality.machine_facts())
    for _ in range(3):  # a stall that only one of two threads met says nothing about them
        result = punctuality.measure(case, 1024, LOAD, cpu)
        if "fifo" not in result.measured.privileges:
            pytest.skip("without real-time priority nothing is promised, and none is granted here")
        measured, reference = (
            timing.wake.percentile_ns(99.0) for timing in (result.measured, result.reference)
        )
        if measured <= 1.25 * reference + 20_000:
            return
    pytest.fail(f"p99 {measured / 1e3:.0f} µs, of the reference thread {reference / 1e3:.0f} µs")


# ---- made-up runs -------------------------------------------------------------------------------


def latency(*times_ns: int) -> Latency:
    result = Latency()
    for time_ns in times_ns:
        result.record(time_ns)
    return result


def timing(
    *wake_ns: int, skipped: int = 0, privileges: tuple[str, ...] = ALL, sent_ns: int = 8000
) -> Timing:
    executed = len(wake_ns)
    return Timing(
        counts=TickCounts(executed + skipped, executed, skipped, skipped),
        wake=latency(*wake_ns),
        sent=latency(*(sent_ns,) * executed),
        privileges=privileges,
        lost=0,
        not_sent=0,
        major_faults=0,
        minor_faults=0,
        blocked=0,
        preempted=0,
    )


GOOD = timing(*(10_000,) * 2000)
GOOD_PC: dict[str, Any] = {
    "kernel": "6.1-rt", "preemption": "PREEMPT_RT", "cpu": "a processor", "cpus": 4,
    "cpus_allowed": [0, 1, 2, 3], "isolated_cpus": [3], "nohz_full_cpus": [3],
    "irq_affinity": "0-2", "governor": "performance", "virtual_machine": False, "load_1_min": 0.1,
}  # fmt: skip


def results(measured: Timing = GOOD, reference: Timing = GOOD) -> list[JitterResult]:
    return [JitterResult(case, measured, reference, 1, False) for case in CASES]


@dataclass
class FakeRun:
    """A run that gives the next of the reference threads it was made with."""

    references: list[Timing]

    def __call__(self, *_: Any) -> Any:
        reference = self.references.pop(0)
        return type("Run", (), {"measured": GOOD, "reference": reference})


@pytest.mark.parametrize(
    ("stalls_ns", "attempts", "disturbed"),
    [([10 * MS], 1, False), ([40 * MS, 1], 2, False), ([11 * MS, 80 * MS, 12 * MS], 3, True)],
)
def test_a_run_whose_reference_thread_was_over_10_ms_late_is_repeated_twice_at_most(
    stalls_ns: list[int], attempts: int, disturbed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = FakeRun([timing(stall) for stall in [*stalls_ns, 1]])
    monkeypatch.setattr(punctuality, "_run_once", fake)
    result = punctuality.measure(CASES[0], 10, None)
    assert (result.attempts, result.disturbed) == (attempts, disturbed)
    assert result.reference.wake.max_ns == stalls_ns[-1]


def test_a_punctual_pc_is_fit_and_nothing_is_to_be_changed() -> None:
    verdict = punctuality.judge(results(), GOOD_PC)
    assert verdict.fit
    assert verdict.remedies == ()
    assert verdict.sentence.startswith("This PC is fit")
    assert "5 runs of 2 s" in verdict.sentence


@pytest.mark.parametrize(
    ("measured", "fault"),
    [
        (timing(*(10_000,) * 1999, 5 * MS, skipped=5), "25 of 10025 ticks were skipped"),
        (timing(*(10_000,) * 1900, *(300_000,) * 100), "only within"),
        (timing(*(10_000,) * 2000, sent_ns=240_000), "only within"),
        (replace(GOOD, privileges=("memory_locked",)), "no real-time priority"),
        (replace(GOOD, privileges=("fifo",)), "memory could not be locked"),
    ],
)
def test_each_fault_makes_a_pc_unfit(measured: Timing, fault: str) -> None:
    one_bad = [*results()[:-1], results(measured)[-1]]
    verdict = punctuality.judge(results(measured), GOOD_PC)
    assert not verdict.fit
    assert fault in verdict.sentence
    assert verdict.sentence.count(". ") == 0  # one sentence
    assert not punctuality.judge(one_bad, GOOD_PC).fit


def test_one_late_tick_in_four_thousand_is_forgiven_if_none_was_skipped() -> None:
    assert punctuality.judge(results(timing(*(10_000,) * 3999, 900_000)), GOOD_PC).fit


@pytest.mark.parametrize(
    ("facts", "remedy"),
    [
        ({"preemption": "PREEMPT_DYNAMIC (full)"}, "PREEMPT_RT"),
        ({"isolated_cpus": []}, "isolcpus"),
        ({"irq_affinity": None}, "IRQ affinity"),
        ({"governor": "powersave"}, "governor"),
        ({"virtual_machine": True}, "a dedicated PC"),
        ({"cpus": 1}, "second processor core"),
        ({"load_1_min": 3.0}, "load"),
    ],
)
def test_the_remedy_is_named_for_what_the_machine_lacks(facts: dict[str, Any], remedy: str) -> None:
    skipping = results(timing(*(10_000,) * 100, skipped=1))
    unhelped = punctuality.judge(skipping, GOOD_PC).sentence
    assert remedy not in unhelped
    assert "the other programs that run" in unhelped
    verdict = punctuality.judge(skipping, {**GOOD_PC, **facts})
    assert remedy in verdict.sentence
    assert [what for what, how in verdict.remedies if remedy in what and len(how) > 10]


def test_missing_rights_are_remedied_by_limits() -> None:
    verdict = punctuality.judge(results(replace(GOOD, privileges=())), GOOD_PC)
    words = dict(verdict.remedies)
    assert "LimitRTPRIO" in words["rtprio and memlock limits"]
    assert "cpu_dma_latency" in words["processor sleep"]


# ---- the machine --------------------------------------------------------------------------------


def system(root: Path, **files: str) -> Path:
    for name, text in files.items():
        path = root / name.replace("__", "/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text + "\n", encoding="utf-8")
    return root


def test_facts_of_a_tuned_pc(tmp_path: Path) -> None:
    facts = punctuality.machine_facts(
        system(
            tmp_path,
            sys__kernel__realtime="1",
            sys__devices__system__cpu__isolated="2-3,6",
            sys__devices__system__cpu__nohz_full="2-3",
            sys__devices__system__cpu__cpu0__cpufreq__scaling_governor="performance",
            proc__cmdline="quiet irqaffinity=0-1 isolcpus=2-3,6",
            proc__cpuinfo="model name\t: Some CPU @ 3 GHz\nflags\t\t: fpu sse",
        )
    )
    assert facts["preemption"] == "PREEMPT_RT"
    assert facts["isolated_cpus"] == [2, 3, 6]
    assert facts["nohz_full_cpus"] == [2, 3]
    assert facts["irq_affinity"] == "0-1"
    assert facts["governor"] == "performance"
    assert facts["cpu"] == "Some CPU @ 3 GHz"
    assert facts["virtual_machine"] is False
    assert punctuality.choose_cpu({**facts, "cpus_allowed": [0, 1, 2, 3]}) == 3


def test_facts_of_a_virtual_machine_with_nothing_set(tmp_path: Path) -> None:
    facts = punctuality.machine_facts(
        system(
            tmp_path,
            proc__version="Linux version 6.18 (gcc) #1 SMP PREEMPT_DYNAMIC @0",
            sys__kernel__debug__sched__preempt="none voluntary (full) lazy",
            sys__devices__system__cpu__isolated="",
            sys__devices__system__cpu__nohz_full="(null)",
            proc__cpuinfo="flags : fpu hypervisor",
        )
    )
    assert facts["preemption"] == "PREEMPT_DYNAMIC (full)"
    assert facts["isolated_cpus"] == facts["nohz_full_cpus"] == []
    assert facts["virtual_machine"] is True
    assert facts["governor"] is facts["irq_affinity"] is None
    assert punctuality.choose_cpu({**facts, "cpus_allowed": [0, 1]}) == 1
    assert punctuality.choose_cpu({**facts, "cpus_allowed": [0]}) == -1


def test_facts_of_a_system_that_says_nothing(tmp_path: Path) -> None:
    facts = punctuality.machine_facts(tmp_path)
    assert facts["preemption"] == "none"
    assert facts["rt_runtime_us"] is None
    json.dumps(facts)


# ---- page and command ---------------------------------------------------------------------------


def test_steps_of_the_figure_hold_every_tick_and_lie_where_the_times_do() -> None:
    edges_us, per_cent = page.shares(latency(500, 30_000, 30_500, 10**12))
    assert per_cent.sum() == pytest.approx(100.0)
    filled = np.flatnonzero(per_cent)
    assert edges_us[filled[0]] <= 0.5 < edges_us[filled[0] + 1]
    assert (np.diff(edges_us) > 0.0).all()
    assert edges_us[filled[-1]] >= 6.8e7


Rthyb = Callable[..., tuple[int, str, str]]


@pytest.fixture
def rthyb(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> Rthyb:
    """Run a command in this process, in an empty folder: exit code, stdout, stderr."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments: object) -> tuple[int, str, str]:
        capsys.readouterr()
        code = cli.main([str(argument) for argument in arguments])
        streams = capsys.readouterr()
        return code, streams.out, streams.err

    return call


@pytest.fixture
def unfit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let every run be one in which ticks were skipped, the first of them repeated."""
    skipping = timing(*(10_000,) * 100, skipped=3)

    def measure(case: KindOfRun, *_: Any) -> JitterResult:
        return JitterResult(case, skipping, GOOD, 3 if case == CASES[0] else 1, False)

    monkeypatch.setattr(punctuality, "measure", measure)


def test_timing_of_this_pc_is_measured_shown_and_written(rthyb: Rthyb, tmp_path: Path) -> None:
    code, out, _ = rthyb("jitter", "--seconds", 0.2, "--out", "pc", "--json")
    assert code == 0
    found = json.loads(out)
    assert found["schema"] == punctuality.SCHEMA
    assert found["fit"] == found["verdict"].startswith("This PC is fit")
    assert [
        (run["payload"], run["telemetry"], run["busy_python"]) for run in found["runs"]
    ] == [
        ("sample", False, False), ("exchange", False, False), ("exchange", True, False),
        ("sample", False, True), ("exchange", False, True),
    ]  # fmt: skip
    for run in found["runs"]:
        for thread in (run["measured"], run["reference"]):
            assert thread["executed"] + thread["skipped"] == thread["elapsed"] >= 205
            assert sum(row[2] for row in thread["wake_ns"]["histogram"]) == thread["executed"]
        assert run["reference"]["wake_to_sent_ns"] is None
    assert {"kernel", "preemption", "cpu", "governor", "isolated_cpus", "load_1_min"} <= set(
        found["machine"]
    )
    written = json.loads((tmp_path / "pc" / "jitter.json").read_text(encoding="utf-8"))
    assert written == {key: value for key, value in found.items() if key != "paths"}
    assert found["paths"] == {"results": "pc/jitter.json", "page": "pc/jitter.html"}


@pytest.mark.usefixtures("unfit")
def test_an_unfit_pc_is_told_what_to_change(rthyb: Rthyb, tmp_path: Path) -> None:
    code, out, _ = rthyb("jitter", "--seconds", 1)
    assert code == 0  # measured, and that was asked for
    assert "This PC is not fit for 1024 Hz, because 15 of 515 ticks were skipped" in out
    assert "A PC is fit if: " in out
    assert "run 3 times, because the reference thread was over 10 ms late before" in out
    (html,) = tmp_path.glob("runs/jitter-*/jitter.html")
    text = html.read_text(encoding="utf-8")
    assert text.count("<svg") == len(CASES)
    assert "was run 3 times" in text
    assert "What to change" in text
    assert "src=" not in text


@pytest.mark.usefixtures("unfit")
def test_only_with_require_an_unfit_pc_is_a_failure(rthyb: Rthyb) -> None:
    assert rthyb("jitter", "--seconds", 1, "--require")[0] == UNFIT == 7


@pytest.mark.usefixtures("unfit")
def test_an_older_measurement_is_not_overwritten(rthyb: Rthyb, tmp_path: Path) -> None:
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "jitter.json").write_text("{}", encoding="utf-8")
    code, _, err = rthyb("jitter", "--out", "old")
    assert code == 2
    assert "already exists" in err


@pytest.mark.parametrize("seconds", ["0", "-1", "nan", "1e9"])
def test_a_senseless_length_is_refused(rthyb: Rthyb, seconds: str) -> None:
    code, _, err = rthyb("jitter", "--seconds", seconds)
    assert code == 2
    assert "must be from one tick" in err
