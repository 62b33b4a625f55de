"""One test on one link: started, conducted and ended in this process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from rthyb_rt import core
from rthyb_rt.core.loop import Clock
from rthyb_rt.core.mapped_ring import AFTER_TRIP
from rthyb_rt.errors import InputError
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.realtime.collector import RECORDER_PERIOD_S, Collector
from rthyb_rt.lab.realtime.conductor import Conductor
from rthyb_rt.lab.realtime.live_run import LiveRun
from rthyb_rt.lab.sequence import REST_TICKS
from rthyb_rt.record.recording import RecordedTest

if TYPE_CHECKING:
    from rthyb_rt.rig.links.opened import Opened


class Session(Conductor):
    """One test on one link; a context manager that leaves nothing running.

    A separate thread collects every record and sends the heartbeat.

    Args:
        setup: the test.
        opened, clock, before_tick: as in `Conductor`.
        folder: folder of the ring; None: `rthyb_rt.record.ring.default_folder`.
        station: settings of the station; None: those of the test.
        facts: further facts for the recording, by name.

    Raises:
        RthybError: there is no space for the ring, or the descriptor cannot be used.
        CoreError: a setting is rejected.
    """

    def __init__(
        self,
        setup: Setup,
        opened: Opened,
        *,
        clock: Clock = "host",
        folder: Path | None = None,
        before_tick: Callable[[], None] | None = None,
        station: core.StationConfig | None = None,
        facts: Mapping[str, Any] | None = None,
    ) -> None:
        run = LiveRun.make(
            setup,
            clock,
            [one.codec for one in opened.all],
            folder,
            config=station,
            facts=facts,
            keeps=True,
        )
        super().__init__(opened, clock, before_tick, run)
        self._collector = Collector(run, self.loop.beat)
        self._watched = False

    def __enter__(self) -> Session:
        """Return the session itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End it."""
        self.close()

    def attended(self) -> None:
        """Supervise the operator's thread: if it does not respond, the test ramps out.

        From this call on `wait` must be called at least once a second.
        """
        self._watched = True
        self._collector.attended()

    def start(self) -> None:
        """Start the ticks and the collection of records; see `Conductor.start`."""
        super().start()
        if self.clock != "stepped":
            self._collector.start()

    def _close_run(self) -> None:
        self._collector.stop()
        self.run.close()

    def discard(self) -> None:
        """Delete the ring and its session file, because the recording contains everything."""
        self.run.remove()

    def wait(self, seconds: float) -> None:
        """Wait; with the stepped clock, execute the ticks of that time.

        Raises:
            RthybError: the recorder failed.
            TimingError: the tick thread has stalled.
        """
        self._pass(seconds)

    def _pass(self, seconds: float) -> None:
        if self._watched:
            self._collector.attended()
        super()._pass(seconds)
        if self.clock == "stepped":
            self._collector.turn()
        self._collector.check()

    def advance(self, ticks: int) -> None:
        """Let a number of ticks pass, at most as long as the operator's thread may wait."""
        self.wait(min(ticks / self.rate.hz, RECORDER_PERIOD_S))

    def settle(self) -> None:
        """Wait for the rows that are recorded after a test."""
        # Longer after a trip, so that the black box is full: it counts rows at any rate.
        tripped = self.state == "TRIPPED"
        kept_s = 1.1 * AFTER_TRIP / self.rate.hz if tripped else REST_TICKS / core.FS_HZ
        end_s = self.now_s + kept_s
        while self.now_s < end_s:
            self.wait(RECORDER_PERIOD_S)

    def not_zeroed(self) -> InputError:
        """Return why the tare did not end."""
        return InputError(self.why_not_zeroed(), self.opened.name)

    def recording(self) -> RecordedTest:
        """Return the recording of the whole session; call after `close`."""
        rec = self.run.recording()
        rec.meta |= self.ending(self.run)
        rec.meta["real_time"] |= {
            "usage": self.loop.usage(),
            "commands_before": self.commands_before,
        }
        return rec
