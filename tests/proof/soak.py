"""A service over a long time: one test after another, and no growth.

python tests/proof/soak.py SECONDS

Daemon, recorder and virtual rig are separate processes, connected by a socket; tests are started
through the control socket, whatever ended the previous one. Twice per second, memory, descriptors
and threads of each process and the counters of the ticks are sampled. Completed recordings are
compared with the index and deleted, so that an hour needs no more disk space than a minute.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from realtime_bench import PROGRAM, until
from service_bench import rig_file, short_test

from rthyb_rt import config, core
from rthyb_rt.lab import experiment
from rthyb_rt.record import recording
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.service.control import Client, Refusal
from rthyb_rt.service.daemon import record_of
from rthyb_rt.service.ring_recorder import read_index

LOOK_S = 0.5
TEST_S = 10.0
WARM_UP = 0.25
"""Share of the time after which nothing may grow any more; at least three tests. The pools of the
allocator have settled after about 80 tests."""
PARTS = 6
"""Number of parts of the remaining time, each with its median."""
GROWTH_MB = 0.5
"""Largest growth of memory, from the second part to the last, without the largest step: pages vary,
and a pool that grows once is no leak. A leak of 1.4 MB in five minutes is detected in five minutes,
one of 1.4 MB per hour in an hour."""
PARTIES = ("daemon", "recorder", "rig")


# ---- the parties --------------------------------------------------------------------------------


@contextmanager
def process(folder: Path, name: str, *arguments: object) -> Iterator[subprocess.Popen[bytes]]:
    """Run a command of the program; its output is written to a file."""
    with (folder / f"{name}.log").open("wb") as log:
        made = subprocess.Popen(
            [*PROGRAM, *map(str, arguments)], cwd=folder, stdout=log, stderr=log
        )
        try:
            yield made
        finally:
            made.send_signal(signal.SIGTERM)
            try:
                made.wait(30.0)
            except subprocess.TimeoutExpired:
                made.kill()
                made.wait()


def facts(pid: int) -> tuple[float, int, int]:
    """Return resident memory, MB, and the numbers of descriptors and threads of a process."""
    said = Path(f"/proc/{pid}/status").read_text(encoding="ascii")
    found = dict(line.split(":", 1) for line in said.splitlines() if ":" in line)
    resident_mb = int(found["VmRSS"].split()[0]) / 1024.0
    return resident_mb, len(os.listdir(f"/proc/{pid}/fd")), int(found["Threads"])


# ---- the operator -------------------------------------------------------------------------------


class Operator:
    """Runs one test after another, as long as there is time."""

    def __init__(self, socket: Path, runs: Path) -> None:
        self.client, self.runs = Client(socket), runs
        test = short_test({"test.duration_s": str(TEST_S)})
        self.test = config.dump(test)
        self.record = record_of(experiment.load_motion(test))
        self.digest = ""
        self.ended: Counter[str] = Counter()
        self.rows = self.lost = self.unexplained = 0
        self.gone: set[str] = set()
        self.resets = 0

    def turn(self) -> dict[str, Any]:
        """Check the status, and do what is necessary next; return the status."""
        found: dict[str, Any] = self.client.call("GetStatus")["status"]
        # What is not possible yet will be in half a second.
        with contextlib.suppress(Refusal):
            self.act(found)
        self.tidy()
        return found

    def act(self, found: dict[str, Any]) -> None:
        state, call = found["state"], self.client.call
        if state == "TRIPPED":
            call("Reset")
            self.resets += 1
        elif state == "IDLE" and not found["run_id"]:
            self.digest = call("Load", test_toml=self.test, record=self.record)["digest"]
            call("Zero")
        elif state == "ZEROED":
            call("Start", token=call("Arm", digest=self.digest)["token"])

    def recorded_all(self) -> bool:
        """Return whether everything has been recorded."""
        self.tidy()
        found = self.client.call("GetStatus")["status"]
        time.sleep(LOOK_S)
        return not found["run_id"] and not found["recorder"]["run_id"]

    def tidy(self) -> None:
        """Count the completed recordings, and delete them."""
        for entry in read_index(self.runs):
            if entry["run_id"] in self.gone:
                continue
            self.gone.add(entry["run_id"])
            self.ended[entry["end_reason"]] += 1
            self.rows += entry["rows"]
            self.lost += sum(last - first + 1 for first, last in entry["missing_rows"])
            self.unexplained += unexplained(recording.open_run(self.runs / entry["folder"]))
            shutil.rmtree(self.runs / entry["folder"])


def unexplained(rec: RecordedTest) -> int:
    """Return the number of ticks without a row; in a stall, `core.LOST_TICKS` have one each."""
    tick = rec.samples["tick"].astype(np.int64)
    blind = np.cumsum(rec.samples["flags"] & core.FLAGS["blind"] != 0)
    before = np.flatnonzero(np.diff(tick) > 1)
    made_up = blind[before] - np.where(
        before >= core.LOST_TICKS, blind[before - core.LOST_TICKS], 0
    )
    gaps = np.diff(tick)[before] - 1
    return int(gaps[made_up != core.LOST_TICKS].sum())


# ---- the verdict --------------------------------------------------------------------------------


class Soak:
    """The samples taken, and the faults found."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds
        self.warm_s = max(WARM_UP * seconds, 3.0 * TEST_S)
        self.seen: dict[str, list[tuple[float, ...]]] = {name: [] for name in PARTIES}
        self.ticks: list[tuple[float, int, int, int]] = []
        self.faults: list[str] = []

    def look(self, at_s: float, pids: dict[str, int], status: dict[str, Any]) -> None:
        for name, pid in pids.items():
            self.seen[name].append((at_s, *facts(pid)))
        ticks = status["ticks"]
        counts = ticks["executed"], ticks["skipped"], ticks["elapsed"]
        self.ticks.append((at_s, *counts))
        if counts[0] + counts[1] != counts[2]:
            self.faults.append(f"after {at_s:.1f} s: executed, skipped, elapsed are {counts}")

    def judge(self) -> list[str]:
        """Return what has grown, and what does not add up; print the figures."""
        for name in PARTIES:
            self._judge_party(name)
        at_s, executed, skipped, elapsed = np.array(self.ticks).T
        due = (at_s - at_s[0]) * core.FS_HZ
        # Sampling takes time, and more on a machine that stalls.
        off = np.abs(elapsed - elapsed[0] - due)
        print(
            f"ticks: {int(elapsed[-1])} elapsed = {int(executed[-1])} executed + "
            f"{int(skipped[-1])} skipped in each of {len(self.ticks)} looks; "
            f"{np.median(off):.0f} off the clock in the middle, {off.max():.0f} at most"
        )
        if np.median(off) > core.FS_HZ:
            self.faults.append("ticks do not go with the clock")
        return self.faults

    def _judge_party(self, name: str) -> None:
        rows = np.array(self.seen[name])
        rows = rows[rows[:, 0] >= self.warm_s]
        parts = [np.median(part, axis=0) for part in np.array_split(rows, PARTS) if len(part)]
        first, last = parts[0], parts[-1]
        grown_mb = grown([float(part[1]) for part in parts])
        print(
            f"{name}: {' -> '.join(f'{part[1]:.1f}' for part in parts)} MB resident "
            f"({grown_mb:+.2f} but for one step, allowed {GROWTH_MB:+.2f}), "
            f"most {rows[:, 1].max():.1f}; descriptors {first[2]:.0f} -> {last[2]:.0f} "
            f"(most {rows[:, 2].max():.0f}), threads {first[3]:.0f} -> {last[3]:.0f}"
        )
        if grown_mb > GROWTH_MB:
            self.faults.append(f"{name}: memory grows by {grown_mb:.2f} MB")
        # Not the maximum: a file that is open for a millisecond may be seen by chance.
        for column, what in ((2, "descriptors"), (3, "threads")):
            before, after = first[column], last[column]
            if after > before:
                self.faults.append(f"{name}: {what} grow from {before:.0f} to {after:.0f}")


def grown(medians_mb: list[float]) -> float:
    """Return the growth from the second part of a run to the last without the largest step, MB.

    In the first part the pools still fill, at a decreasing rate, and no more after an hour.
    """
    steps = np.diff(medians_mb[1:])
    return float(steps.sum() - max(steps.max(), 0.0)) if steps.size else 0.0


def soak(seconds: float, folder: Path, memory: Path) -> list[str]:
    """Run the service for this long; return all faults."""
    rings, runs, wire = memory / "rings", folder / "runs", memory / "wire"
    rings.mkdir()
    socket = rings / "control.sock"
    link = f'\n[link]\nkind = "socket"\nchannel = "{wire}"\nvirtual = true\n'
    (folder / "rig.toml").write_text(config.dump(rig_file()) + link, encoding="utf-8")
    watched = Soak(seconds)
    with ExitStack() as owned:
        rig = owned.enter_context(process(folder, "rig", "rig", "rig.toml"))
        until(wire.exists, "the virtual rig")
        places = ("--rings", rings, "--runs", runs)
        recorder = owned.enter_context(process(folder, "recorder", "recorder", *places))
        told = ("serve", "rig.toml", *places, "--recorder", "service")
        daemon = owned.enter_context(process(folder, "daemon", *told))
        until(socket.exists, f"the service; {(folder / 'daemon.log').read_text()}")
        pids = dict(zip(PARTIES, (daemon.pid, recorder.pid, rig.pid), strict=True))
        operator = Operator(socket, runs)
        begin = time.monotonic()
        while (at_s := time.monotonic() - begin) < seconds:
            status = operator.turn()
            watched.look(at_s, pids, status)
            time.sleep(LOOK_S)
        with contextlib.suppress(Refusal):
            operator.client.call("Stop")
        until(operator.recorded_all, "the end of the last test")
        operator.client.close()
    print(f"{seconds:.0f} s, {sum(operator.ended.values())} tests: {dict(operator.ended)}")
    print(
        f"rows: {operator.rows} recorded, {operator.lost} lost, {operator.unexplained} ticks with "
        f"neither row nor stall; {operator.resets} resets"
    )
    faults = watched.judge()
    if operator.lost:
        faults.append(f"{operator.lost} rows are lost")
    if operator.unexplained:
        faults.append(f"{operator.unexplained} ticks have no row")
    if not operator.ended["completed"]:
        faults.append("no test came to its end")
    if daemon.returncode:
        faults.append(f"the daemon ended with {daemon.returncode}")
    return faults


def main() -> int:
    parser = argparse.ArgumentParser(description="Let a service run for long; nothing may grow.")
    parser.add_argument("seconds", type=float)
    seconds = parser.parse_args().seconds
    memory = Path("/dev/shm")
    place = memory if memory.is_dir() and os.access(memory, os.W_OK) else None
    with TemporaryDirectory() as folder, TemporaryDirectory(dir=place) as rings:
        faults = soak(seconds, Path(folder), Path(rings))
    for fault in faults:
        print(f"soak: {fault}", file=sys.stderr)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
