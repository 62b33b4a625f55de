"""A virtual rig in a separate process, started by a controller."""

from __future__ import annotations

import contextlib
import json
import select
import signal
import subprocess
import sys
from typing import Any, Final

from rthyb_rt import config
from rthyb_rt.config import AxesRig, Rate, RigFile
from rthyb_rt.errors import RthybError
from rthyb_rt.rig.virtual_rig.rig_plan import RigPlan
from rthyb_rt.rig.virtual_rig.serving import StopRequest, serve
from rthyb_rt.rig.virtual_rig.wire_ends import inherited_line

_PEER_PATIENCE_S: Final = 20.0


class Companion:
    """A virtual rig in its own process, at the other end of a socket pair for each axis.

    A Ctrl-C in the terminal does not reach it, and it ends when this process has ended.

    Args:
        rig: the rig to simulate.
        fds: its end of each axis's pair; they remain the caller's, who closes them.
        rate: sample rate; None: that of the rig file's link.

    Raises:
        RthybError: the process did not start; includes its last message.
    """

    def __init__(self, rig: RigFile | AxesRig, *fds: int, rate: Rate | None = None) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "rthyb_rt.rig.virtual_rig"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            pass_fds=fds,
            start_new_session=True,
        )
        try:
            rate_hz = (rate or rig.rate).hz
            order = {"fds": fds, "rig_toml": config.dump(rig), "rate_hz": rate_hz}
            assert self._process.stdin is not None
            with contextlib.suppress(BrokenPipeError), self._process.stdin as order_book:
                order_book.write(json.dumps(order).encode() + b"\n")
            self._process.stdin = None
            self._await_ready()
        except BaseException:
            self._kill()
            raise

    def _await_ready(self) -> None:
        out = self._process.stdout
        assert out is not None
        ready, _, _ = select.select([out], [], [], _PEER_PATIENCE_S)
        if ready and out.readline().strip() == b"ready":
            return
        self._kill()
        raise RthybError(f"the virtual rig's process did not start: {self._last_words()}")

    def _last_words(self) -> str:
        assert self._process.stderr is not None
        said = self._process.stderr.read().decode(errors="replace").strip()
        return said.splitlines()[-1] if said else f"exit status {self._process.returncode}"

    def _kill(self) -> None:
        self._process.kill()
        self._process.wait()

    @property
    def pid(self) -> int:
        """Process ID."""
        return self._process.pid

    def close(self) -> dict[str, Any] | None:
        """Wait until it ends, which closing the connection causes, and return its summary.

        None: it had to be killed, or returned no summary.
        """
        try:
            out, _ = self._process.communicate(timeout=_PEER_PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._kill()
            return None
        with contextlib.suppress(json.JSONDecodeError):
            found = json.loads(out.decode() or "null")
            return found if isinstance(found, dict) else None
        return None


def be_companion() -> None:
    """Run as the process of a `Companion`."""
    order = json.loads(sys.stdin.readline())
    rig = config.parse_any_rig(order["rig_toml"], "rig")
    lines = [inherited_line(int(fd)) for fd in order["fds"]]
    stop = StopRequest()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    plan = RigPlan(rate=Rate(float(order["rate_hz"])))
    result = serve(rig, lines, plan, stop=stop, ready=lambda: print("ready", flush=True))
    # The reader may have been killed.
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(result.as_json()), flush=True)
