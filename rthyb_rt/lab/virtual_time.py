"""A test in virtual time: the station as in real time, with the virtual rig, without a clock."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core import FLAGS, Channel
from rthyb_rt.core.coupled_rig import CoupledRig
from rthyb_rt.core.mapped_ring import AFTER_TRIP
from rthyb_rt.errors import RthybError
from rthyb_rt.lab import experiment, zeroing
from rthyb_rt.lab.end_reasons import RefusedError
from rthyb_rt.lab.experiment import Progress, Setup
from rthyb_rt.lab.runs import Run
from rthyb_rt.lab.sequence import REST_TICKS, STEP_TICKS, Sequence
from rthyb_rt.record.recording import RecordedTest

WAY_OUT_S: Final = 120.0
"""Time for which a ramp-out is followed: after divergence without limits it would take hours."""
HOLD_S: Final = 1.0
"""Time after which a held test is stopped, because nobody could resume it."""

TRUTH: Final = (Channel("x_true_m", "m"), Channel("f_true_n", "N"))
"""True values of the virtual rig's sensors, without their errors."""


def freedom_channels(setup: Setup) -> tuple[Channel, ...]:
    """Return the channels for the displacements of the numerical part's degrees of freedom."""
    structure = setup.derived.structure
    count = 1 if structure is None else len(structure.labels)
    return tuple(Channel(f"x_part_{number + 1}_m", "m") for number in range(count))


def truth_channels(setup: Setup) -> tuple[Channel, ...]:
    """Return the channels of the true values: `TRUTH`, with its number for each further axis."""
    further = [
        Channel(f"{one.name}_{axis}", one.unit)
        for axis in range(1, setup.controller.axis_count)
        for one in TRUTH
    ]
    return (*TRUTH, *further)


class Bench:
    """A station and a virtual rig, run tick by tick as fast as possible.

    Args:
        setup: the test.
        rig: the virtual rig; None: that of the rig file.
        config: settings of the station; None: those of the test.
        truth: record the true values of the sensors, as the channels `TRUTH`.
        freedoms: record the displacement of every degree of freedom of the numerical part, as the
            channels of `freedom_channels`.

    Attributes:
        run: the station and its log.
    """

    def __init__(
        self,
        setup: Setup,
        rig: core.RigConfig | None = None,
        config: core.StationConfig | None = None,
        *,
        truth: bool = False,
        freedoms: bool = False,
    ) -> None:
        places = freedom_channels(setup) if freedoms else ()
        # The core needs its own additional channels before all others.
        seen = truth_channels(setup) if truth else ()
        setup = replace(setup, channels=seen + places + setup.channels)
        self.run = Run.begin(setup, "virtual", config or experiment.station_config(setup))
        virtual = self._plant(setup, rig, len(seen) + len(places))
        stop_decel = experiment.stop_decel_m_per_s2(setup.rig)
        self._test = core.Virtual(self.run.station, virtual, stop_decel, truth, len(places))
        before = self.config.tare_ticks + self.config.ramp_in_ticks
        self._dtype = core.record_dtype(setup.controller.axis_count)
        self._rows = np.empty(before + setup.ticks + 2 * STEP_TICKS, dtype=self._dtype)
        self._values = np.zeros((self._rows.size, len(setup.channels)))
        self._count = 0

    def _plant(
        self, setup: Setup, rig: core.RigConfig | None, extras: int
    ) -> core.VirtualRig | CoupledRig:
        """Return the virtual rig, whose extra sensors are recorded from that channel on."""
        virtual: core.VirtualRig | CoupledRig
        if setup.group is not None:
            virtual = CoupledRig(setup.group.virtual_rig)
        else:
            virtual = core.VirtualRig(rig or setup.virtual_rig)
        if any(one.sensors.extra for one in setup.rigs):
            virtual.record_extras(self.run.station, extras)
        return virtual

    @property
    def config(self) -> core.StationConfig:
        """Settings of the station."""
        return self.run.config

    @property
    def state(self) -> str:
        """Name of the station's state."""
        return self.run.station.state

    @property
    def causing(self) -> tuple[str, float, float]:
        """The station's latched first cause, the value reached and the limit."""
        return self.run.causing

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused because the reading moved."""
        return self.run.station.zeroing_failed

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        whole = self.run.setup.ticks
        return min(self.run.station.test_tick, whole), whole

    @property
    def now_s(self) -> float:
        """The time of its ticks."""
        return self._count / self.run.setup.derived.fs_hz

    def command(self, name: core.Command) -> int:
        """Run one tick with an operator's command; return its number.

        Raises:
            RefusedError: it was refused.
        """
        state = self.state
        self._tick(1, name)
        refused = bool(self.rows["flags"][-1] & FLAGS["refused"])
        tick = self._count - 1
        self.run.commands.append({"tick": tick, "command": name, "refused": refused})
        if refused:
            raise RefusedError(f"{name}: refused in state {state}")
        return tick

    def advance(self, ticks: int) -> None:
        """Run a number of ticks; fewer if the state changes or a tare fails."""
        self._tick(ticks, "none")

    def settle(self) -> None:
        """Run the ticks that are recorded after a test."""
        kept = AFTER_TRIP if self.state == "TRIPPED" else REST_TICKS
        self.advance(self.run.setup.rate.ticks(kept / core.FS_HZ))

    def not_zeroed(self) -> RthybError:
        """Return why the tare did not end."""
        if why := zeroing.refused(self.run) or zeroing.silent_sensors(self.run):
            return RthybError(f"the virtual rig was not zeroed: {why}")
        law = self.run.setup.controller.law.own
        own = "" if law is None else (
            f"; or check {law.name}: at rest its method lead must return the x_c_m that it is given"
        )  # fmt: skip
        return RthybError(
            "the virtual rig is not at rest: its displacement moves by more than "
            f"{self.config.rest_spread_m * 1e3:.3g} mm (limits.rest_spread_m) during the tare; "
            f"raise that limit, or reduce the noise of sensors.displacement{own}"
        )

    def _tick(self, ticks: int, command: core.Command) -> None:
        end = self._count + ticks
        if end > self._rows.size:
            longer = np.empty(end + self._rows.size, dtype=self._dtype)
            longer[: self._count] = self.rows
            self._rows = longer
            more = np.zeros((longer.size - len(self._values), self._values.shape[1]))
            self._values = np.concatenate([self._values, more])
        part = slice(self._count, end)
        self._count += self._fill(self._rows[part], command, self._values[part])

    def _fill(
        self, rows: core.RecordArray, command: core.Command, values: NDArray[np.float64]
    ) -> int:
        """Run as many ticks as there are rows, or until the state changes."""
        return self._test.run(rows, command, values if values.size else None)

    @property
    def rows(self) -> core.RecordArray:
        """All records so far, (n,)."""
        return self._rows[: self._count]

    def recording(self) -> RecordedTest:
        """Return the recording of the whole run."""
        self.run.take(self.rows)
        rec = self.run.known()
        channels = self.run.setup.channels
        rec.samples = self.rows
        if channels:
            rec.samples = core.rows_of(self.rows, channels, self._values[: self._count])
        rec.meta |= self.run.ending(self.state)
        return rec


def run(
    setup: Setup,
    progress: Progress | None = None,
    *,
    truth: bool = False,
    freedoms: bool = False,
) -> RecordedTest:
    """Run the test with the virtual rig as fast as possible.

    Args:
        setup: the test.
        progress: called with (ticks done, ticks of the test) now and then.
        truth: record the true values of the sensors, as the channels `TRUTH`.
        freedoms: record the displacement of every degree of freedom of the numerical part.

    Returns:
        The recording, all rows from the first tick on; ``meta["end_reason"]`` says how it ended.

    Raises:
        RthybError: the test cannot be started.
    """
    bench = Bench(setup, truth=truth, freedoms=freedoms)
    conduct(bench, progress)
    return bench.recording()


def conduct(bench: Bench, progress: Progress | None = None) -> None:
    """Zero, arm, start, and return to rest, whatever happens in between.

    Raises:
        RthybError: the rig does not come to rest, or a command is refused.
    """
    Sequence(bench, hold_s=HOLD_S, way_out_s=WAY_OUT_S, progress=progress).conduct()
