"""The drive as a separate process, on its own clock, until its standard input ends.

python drive.py '{"fd": 3, "t0_ns": ..., "ppm": 100, "timed": false, "cpu": 0, "out": "d.npz"}'

``timed``: the tick is called from Python, which records its times; else the core's own loop runs.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from proof import structure

from rthyb_rt import core
from rthyb_rt.core import loop, ticker, wire


def main(spec: dict[str, Any]) -> None:
    """Run, then write log, times (due, woken, done; ns) and the counts of the clock."""
    ticks = round((spec["seconds"] + 30.0) * core.FS_HZ)
    drive = loop.Drive(
        structure.rig(),
        wire.can(),
        loop.Link("can", spec["fd"]),
        log_ticks=ticks,
        drift_ppm=spec["ppm"],
    )
    clock = ticker.Ticker("host", spec["t0_ns"])
    times = np.zeros((ticks, 3), np.int64)

    def run() -> None:
        ticker.become_real_time(cpu=spec["cpu"])
        if not spec["timed"]:
            drive.run(clock)
            return
        gained_ns = 0.0
        while (tick := clock.wait()) is not None:
            drive.tick()
            gained_ns += spec["ppm"] * 1e-6 * ticker.PERIOD_NS
            clock.trim(-int(gained_ns))
            gained_ns -= int(gained_ns)
            times[drive.ticks - 1] = tick.due_ns, tick.woken_ns, ticker.now_ns()

    thread = threading.Thread(target=run)
    thread.start()
    print("ready", flush=True)
    sys.stdin.read()
    clock.stop()
    thread.join()
    facts = {"counts": clock.counts._asdict(), "wake_max_ns": clock.wake.max_ns}
    np.savez(spec["out"], log=drive.log, times=times[: drive.ticks], facts=json.dumps(facts))


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
