"""From a sample to the screen: a ring that is filled at 1024 Hz, `rthyb live`, and a browser.

The page records when each frame was on the screen; a sample is visible with the first frame that
contains it. Both clocks are this machine's.
"""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rthyb_rt import config, core
from rthyb_rt.core import FLAGS, RUNNING
from rthyb_rt.lab import experiment, virtual_time
from rthyb_rt.record.ring import Ring

CHROMIUM = shutil.which("chromium") or ""
SETTLE_S, MEASURE_S = 4.0, 12.0
PROGRAM = [sys.executable, "-c", "import sys; from rthyb_rt.cli import main; sys.exit(main())"]


@dataclass(frozen=True)
class Screen:
    """Resources and delays of a live view.

    Attributes:
        p50_ms, p95_ms: from a sample to the screen.
        server_share: load of one core.
        page_share: load of one core by the page's scripts.
        browser_share: load of one core by the entire browser, including painting.
        frames_per_s: frames drawn.
    """

    p50_ms: float
    p95_ms: float
    server_share: float
    page_share: float
    browser_share: float
    frames_per_s: float


def missing() -> str:
    """Return what is missing for the measurement, or an empty text."""
    if not CHROMIUM:
        return "chromium"
    return "" if importlib.util.find_spec("playwright") else "playwright"


def rows(first: int, count: int) -> np.ndarray:
    """Return rows of a test with periodic motion."""
    tick = np.arange(first, first + count)
    made = np.zeros(count, core.RECORD_DTYPE)
    phase = 2.0 * np.pi * 2.0 * tick / core.FS_HZ
    size_m = 5e-3 * np.sin(2.0 * np.pi * 0.1 * tick / core.FS_HZ)
    made["tick"], made["state"], made["flags"] = tick, RUNNING, FLAGS["fresh"]
    made["x_num_m"] = size_m * np.sin(phase)
    made["x_cmd_m"] = size_m * np.sin(phase + 0.2)
    made["x_meas_m"] = size_m * np.sin(phase - 0.02)
    made["f_meas_n"] = 6e5 * size_m * np.sin(phase + 0.3)
    made["alpha"], made["k_t_n_per_m"] = 16.0 + size_m * 100.0, 6e5 + size_m * 1e7
    made["energy_error_j"], made["wake_late_ns"] = 1e-3 * tick, 5000 + tick % 977 * 40
    return made


class Producer(threading.Thread):
    """Fills a ring at 1024 rows per second, and records when each row was available."""

    def __init__(self, ring: Ring) -> None:
        super().__init__(daemon=True)
        self.ring, self.pushed_ms, self.over = ring, [], False

    def run(self) -> None:
        """Push what is due, every 2 ms."""
        begin, count = time.monotonic(), 0
        while not self.over:
            due = int((time.monotonic() - begin) * core.FS_HZ) - count
            if due > 0:
                self.ring.push(rows(count, due))
                self.pushed_ms += [time.time() * 1e3] * due
                count += due
            time.sleep(0.002)


def cpu_s(pids: list[int]) -> float:
    """Return the processor time of processes so far."""
    ticks = 0
    for pid in pids:
        try:
            fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        ticks += int(fields[11]) + int(fields[12])
    return ticks / os.sysconf("SC_CLK_TCK")


def family(pid: int) -> list[int]:
    """Return a process and all its descendants."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found, seen = [pid], 0
    while seen < len(found):
        found += [child for child, parent in parents.items() if parent == found[seen]]
        seen += 1
    return found


def measure() -> Screen:
    """Measure for 15 seconds."""
    test = config.load_test(config.builtin_test_path())
    rec = virtual_time.run(experiment.prepare(test, config.load_rig(config.find_rig(test.rig))))
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        ring = Ring.create(Path(name), rec)
        producer = Producer(ring)
        producer.start()
        server = subprocess.Popen(
            [*PROGRAM, "live", str(ring.path), "--port", "0", "--json"],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            assert server.stdout is not None
            said = ""
            while not said.endswith("}\n"):
                said += server.stdout.readline()
            return _watch(json.loads(said)["url"], server.pid, producer)
        finally:
            server.terminate()
            server.wait()
            producer.over = True
            producer.join()
            ring.remove()


def _watch(url: str, server: int, producer: Producer) -> Screen:
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page: Any = browser.new_page(viewport={"width": 1920, "height": 1080})
        counters = page.context.new_cdp_session(page)
        counters.send("Performance.enable")
        page.goto(url)
        time.sleep(SETTLE_S)
        ours = [pid for pid in family(os.getpid()) if _is_chromium(pid)]
        page.evaluate("rthybLive.drawn.length = 0")
        begin, server_s, browser_s = time.monotonic(), cpu_s([server]), cpu_s(ours)
        script_s = _script_s(counters)
        time.sleep(MEASURE_S)
        drawn = np.array(page.evaluate("rthybLive.drawn"))
        took_s = time.monotonic() - begin
        server_s, browser_s = cpu_s([server]) - server_s, cpu_s(ours) - browser_s
        script_s = _script_s(counters) - script_s
        browser.close()
    pushed_ms = np.array(producer.pushed_ms)
    samples = np.arange(int(drawn[0, 0]) + 1, int(drawn[-1, 0]) + 1)
    shown = drawn[np.searchsorted(drawn[:, 0], samples), 1]
    late_ms = shown - pushed_ms[samples]
    return Screen(
        float(np.median(late_ms)),
        float(np.percentile(late_ms, 95)),
        server_s / took_s,
        script_s / took_s,
        browser_s / took_s,
        len(drawn) / took_s,
    )


def _script_s(counters: Any) -> float:
    """Return the run time of the page's scripts so far."""
    found = counters.send("Performance.getMetrics")["metrics"]
    return float(next(one["value"] for one in found if one["name"] == "ScriptDuration"))


def _is_chromium(pid: int) -> bool:
    try:
        return "chrom" in Path(f"/proc/{pid}/comm").read_text()
    except OSError:
        return False


if __name__ == "__main__":
    print(measure())
