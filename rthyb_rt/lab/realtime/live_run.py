"""A run whose rows pass through a ring, from which its conductor reads them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core import FLAGS, ticker
from rthyb_rt.core.wire import Codec
from rthyb_rt.lab import experiment
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.lab.runs import Run
from rthyb_rt.record import ring
from rthyb_rt.record.recording import RecordedTest
from rthyb_rt.record.ring import Ring, RingReader

LOOK_BACK_TICKS: Final = 64
GOOD_PAIRS: Final = 48
"""Valid pairs among the last `LOOK_BACK_TICKS` that a test needs to begin."""

_NOT_FOLLOWING: Final = FLAGS["stopped"] | FLAGS["down"]
_CHUNK: Final = 256


def follows(flags: NDArray[np.uint32]) -> bool:
    """Return whether valid pairs arrive from a drive that follows, by the newest rows' flags."""
    fresh = np.count_nonzero(flags & FLAGS["fresh"])
    return bool(fresh >= GOOD_PAIRS and not (flags & _NOT_FOLLOWING).any())


def stays_stopped(flags: NDArray[np.uint32]) -> bool:
    """Return whether pairs arrive from a drive that has stopped by itself, by the newest flags."""
    received = flags[(flags & FLAGS["lost"]) == 0]
    return bool(received.size >= GOOD_PAIRS and (received & FLAGS["stopped"]).all())


@dataclass(frozen=True)
class Counted:
    """Values of the counters of a link at one instant; with several axes, their sum.

    ``axes``: those of each of several axes, ``{"wire", "link"}``; empty for one axis.
    """

    ticks: ticker.TickCounts
    loop: dict[str, int]
    wire: dict[str, int]
    link: dict[str, int]
    wake: ticker.Latency
    sent: ticker.Latency
    delays: NDArray[np.int64]
    axes: tuple[dict[str, dict[str, int]], ...]


@dataclass(kw_only=True)
class LiveRun(Run):
    """A station and its ring; created by `make`.

    One thread reads the rows (`news`); any thread may read the log.

    Attributes:
        ring: the ring to which the tick thread writes every record.
        reader: reader of the ring.
        keeps: whether every row is kept in memory for a recording, or only those needed for the
            spread of a tare.
        counted: counters when the station began to run.
        missed: ranges [first, last] of rows that were overwritten before they were read.
        recent_flags: flags of the last `LOOK_BACK_TICKS` rows.
    """

    ring: Ring
    reader: RingReader
    keeps: bool
    counted: Counted | None = None
    missed: list[list[int]] = field(default_factory=list)
    recent_flags: NDArray[np.uint32] = field(default_factory=lambda: np.zeros(0, np.uint32))
    _next_row: int = 0
    _parts: list[NDArray[np.void]] = field(default_factory=list)
    _kept_rows: int = 0

    @classmethod
    def make(
        cls,
        setup: Setup,
        clock: str,
        codecs: Codec | Sequence[Codec],
        folder: Path | None = None,
        *,
        config: core.StationConfig | None = None,
        facts: Mapping[str, Any] | None = None,
        keeps: bool = False,
        **more: Any,
    ) -> Self:
        """Create a station and its ring.

        Args:
            setup: the test.
            clock: the clock of the test.
            codecs: frames of the link, or of each axis' link, which a bit-identical replay needs.
            folder: folder of the ring; None: `rthyb_rt.record.ring.default_folder`.
            config: settings of the station; None: those of the test.
            facts: further facts for the recording, by name.
            keeps: see the attribute.
            more: fields of a subclass.

        Raises:
            RthybError: there is no space for the ring.
            CoreError: a setting is rejected.
        """
        config = config or experiment.station_config(setup, real=True)
        run = Run.begin(setup, clock, config, facts)
        given = [codecs] if isinstance(codecs, Codec) else codecs
        run.bare.replay.codec = b"".join(codec.table for codec in given)
        filled = Ring.create(folder or ring.default_folder(), run.bare)
        try:
            reader = RingReader(filled.path)
        except BaseException:
            filled.remove()
            raise
        return cls(**vars(run), ring=filled, reader=reader, keeps=keeps, **more)

    def close(self) -> None:
        """Close the ring without deleting it; a second call has no effect."""
        self.reader.close()
        self.ring.close()

    def remove(self) -> None:
        """Delete the ring and its session file; a second call has no effect."""
        self.reader.close()
        self.ring.remove()

    def renew(self) -> None:
        """Write the session file beside the ring, for a recorder or a recovery."""
        self.ring.renew_session(self.known())

    # ---- the log --------------------------------------------------------------------------------

    def news(self) -> Iterator[NDArray[np.void]]:
        """Read new rows, and yield them in parts, each of shape (n,)."""
        while (rows := self.reader.read(_CHUNK)).samples.size:
            if rows.first != self._next_row:
                self.missed.append([self._next_row, rows.first - 1])
            self._next_row = self.reader.next
            samples = rows.samples.copy()
            self.take(samples)
            yield samples

    def take(self, samples: NDArray[np.void]) -> None:
        """Add rows to the log, in order, shape (n,)."""
        super().take(samples)
        self._keep(samples)
        self.recent_flags = np.concatenate([self.recent_flags, samples["flags"]])[-LOOK_BACK_TICKS:]

    def _keep(self, samples: NDArray[np.void]) -> None:
        self._parts.append(samples)
        self._kept_rows += samples.size
        if self.keeps:
            return
        while self._kept_rows - self._parts[0].size >= self.config.tare_ticks:
            self._kept_rows -= self._parts.pop(0).size

    def spread_m(self, axis: int = 0) -> float:
        """Return how far the displacement reading of an axis moved during the last tare."""
        ticks, field = self.config.tare_ticks, f"x_read_m.{axis}" if axis else "x_read_m"
        parts = self._parts[-ticks:]
        read = [part[field][part["flags"] & FLAGS["fresh"] != 0] for part in parts]
        x_m = np.concatenate([np.zeros(0), *read])[-ticks:]
        return float(np.ptp(x_m)) if x_m.size else 0.0

    def recording(self) -> RecordedTest:
        """Return the recording of a run that keeps its rows, without the entries about its end."""
        rec = self.known()
        rec.samples = ring.joined(self._parts)
        rec.replay.skips = ring.skips(rec.samples)
        if self.missed:
            # Row k of the reference belongs to the k-th row of the test, which is no longer true.
            rec.reference = None
        return rec
