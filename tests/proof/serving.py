"""A service as a separate process, whose wake-ups are counted between two lines on its stdin.

python serving.py '{"folder": "...", "runs": "...", "recorder": {"NAME": "VALUE"}}'

The virtual rig is another process on a socket pair, the recorder a third one, with the given
variables in its environment. Prints the time of tick 0 once that is known; after each line on
stdin, prints a line with the results since the previous one.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from service_bench import rig_file

from rthyb_rt.rig import virtual_rig
from rthyb_rt.rig.links import opening
from rthyb_rt.service import systemd
from rthyb_rt.service.daemon import Daemon, Options


class Watched:
    """The daemon, and the timing of its tick thread since the last report."""

    def __init__(self, daemon: Daemon) -> None:
        self.daemon, self._loop = daemon, daemon.engine.loop
        self._wake, self._counts = self._loop.wake.copy(), self._loop.counts

    def said(self) -> dict[str, Any]:
        """Return the timing, and reset it."""
        wake, counts = self._loop.wake.copy(), self._loop.counts
        since = wake.since(self._wake)
        found = {
            "p50_ns": since.percentile_ns(50.0),
            "p99_ns": since.percentile_ns(99.0),
            "max_ns": since.max_ns,
            "executed": counts.executed - self._counts.executed,
            "skipped": counts.skipped - self._counts.skipped,
            "elapsed": counts.elapsed - self._counts.elapsed,
            "privileges": self._loop.privileges,
            "requests": 0 if self.daemon._server is None else self.daemon._server.requests,
        }
        self._wake, self._counts = wake, counts
        return found


def main(spec: dict[str, Any]) -> int:
    """Serve until stdin ends."""
    folder = Path(spec["folder"])
    ours, theirs = opening.socket_pair()
    rig = rig_file()
    # This applies to programs started from here on.
    os.environ.update(spec.get("recorder", {}))
    options = Options(
        socket=folder / "control.sock",
        rings=folder,
        runs=Path(spec["runs"]),
        recorder="own",
        require_realtime=True,
    )
    with ours, systemd.logging_to_stderr():
        companion = virtual_rig.Companion(rig, theirs.fd)
        theirs.close()
        daemon = Daemon(rig, ours, "host", options)

        async def work() -> int:
            running = asyncio.get_running_loop()

            def listen() -> None:
                while not daemon.engine.loop.counts.elapsed:
                    threading.Event().wait(0.001)
                print(daemon.engine.loop.began_ns, flush=True)
                watched = Watched(daemon)
                for _ in sys.stdin:
                    print(json.dumps(watched.said()), flush=True)
                running.call_soon_threadsafe(daemon.stop)

            threading.Thread(target=listen, daemon=True).start()
            return await daemon.work()

        try:
            return asyncio.run(work())
        finally:
            daemon.engine.close()
            daemon._end_recorder()
            ours.close()
            companion.close()


if __name__ == "__main__":
    sys.exit(main(json.loads(sys.argv[1])))
