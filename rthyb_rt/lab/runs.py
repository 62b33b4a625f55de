"""A run: a station, and a log of its rows and commands."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core import FLAGS, RUNNING, STATES
from rthyb_rt.lab import experiment, trips
from rthyb_rt.lab.end_reasons import end_reason
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest

AT_REST: Final = ("IDLE", "ZEROED", "ARMED", "TRIPPED")
"""States in which this program does not move anything."""

_IDLE, _ZEROED, _HOLD, _TRIPPED = map(STATES.index, ("IDLE", "ZEROED", "HOLD", "TRIPPED"))
_MOVING: Final = [STATES.index(name) for name in STATES if name not in AT_REST]


def _of_further(tares: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Return the tares of the further axes, under the names of the first with their number."""
    found = dict[str, float]()
    for axis, (x_m, f_n) in enumerate(tares):
        if axis:
            found |= {f"displacement_m.{axis}": x_m, f"force_n.{axis}": f_n}
    return found


@dataclass(kw_only=True)
class Run:
    """A station, and the data for a recording of it.

    Attributes:
        setup: the test.
        config: settings of the station.
        station: the station.
        bare: the recording before its first row.
        commands: every operator command so far: ``{"tick", "command", "refused"}``.
        parameters: every set of parameters: ``{"generation", "tick", "values"}``.
        running: rows of the test proper so far.
        zeroed, held: whether ZEROED, or HOLD, has been entered.
        moved: whether any command other than the reading at rest has been sent.
        tripped_rows: rows in TRIPPED.
        idle_rows: rows in IDLE at the end.
        caused, caused_by, caused_in_figures: `causing`, `whose` and `cause_in_figures` at a trip,
            because a reset clears them in the station.
        longest_skip: largest number of consecutive skipped ticks.
    """

    setup: Setup
    config: core.StationConfig
    station: core.Station
    bare: RecordedTest
    parameters: list[dict[str, Any]]
    commands: list[dict[str, Any]] = field(default_factory=list)
    running: int = 0
    zeroed: bool = False
    held: bool = False
    moved: bool = False
    tripped_rows: int = 0
    idle_rows: int = 0
    caused: tuple[str, float, float] | None = None
    caused_by: str = ""
    caused_in_figures: str = ""
    longest_skip: int = 0
    _next_tick: int = 0

    @classmethod
    def begin(
        cls,
        setup: Setup,
        clock: str,
        config: core.StationConfig,
        facts: Mapping[str, Any] | None = None,
        **more: Any,
    ) -> Self:
        """Create a station and its log.

        Args:
            setup: the test.
            clock: the clock of the test.
            config: settings of the station.
            facts: further facts for the recording, by name.
            more: fields of a subclass.

        Raises:
            CoreError: a setting is rejected.
        """
        station = core.Station(config, setup.ag_mps2)
        parameters = [experiment.first_parameters(setup, config)]
        bare = experiment.blank(setup, clock)
        bare.meta |= facts or {}
        bare.replay.parameters = list(parameters)
        return cls(
            setup=setup, config=config, station=station, bare=bare, parameters=parameters, **more
        )

    # ---- the log --------------------------------------------------------------------------------

    def take(self, samples: NDArray[np.void]) -> None:
        """Add rows to the log, in order, shape (n,)."""
        states = samples["state"]
        count = np.bincount(states, minlength=len(STATES))
        self.running += int(count[RUNNING])
        self.zeroed |= bool(count[_ZEROED])
        self.held |= bool(count[_HOLD])
        self.moved |= bool(count[_MOVING].any())
        self.tripped_rows += int(count[_TRIPPED])
        idle = states[::-1] == _IDLE
        self.idle_rows = self.idle_rows + idle.size if idle.all() else int(np.argmin(idle))
        self._count_skips(samples)

    def _count_skips(self, samples: NDArray[np.void]) -> None:
        executed = samples["tick"][(samples["flags"] & FLAGS["blind"]) == 0].astype(np.int64)
        if executed.size:
            steps = np.diff(executed, prepend=self._next_tick - 1)
            self.longest_skip = max(self.longest_skip, int(steps.max()) - 1)
            self._next_tick = int(executed[-1]) + 1

    @property
    def causing(self) -> tuple[str, float, float]:
        """The station's cause, the value reached and the limit."""
        return self.station.cause, self.station.cause_value, self.station.cause_limit

    @property
    def begun(self) -> bool:
        """Whether more than the tare has been run, so that the end is at rest."""
        return self.zeroed or self.moved or self.tripped_rows > 0

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        return min(self.running, self.setup.ticks), self.setup.ticks

    # ---- for the recording ----------------------------------------------------------------------

    def known(self) -> RecordedTest:
        """Return the recording without its rows, with the current tares and commands."""
        x_m, f_n = self.station.tare
        further = self.station.tares if self.config.controller.axis_count > 1 else ()
        replay = dataclasses.replace(
            self.bare.replay,
            parameters=list(self.parameters),
            commands=list(self.commands),
            tares={
                "displacement_m": x_m,
                "force_n": f_n,
                "command_m": self.station.command_tare_m,
                **_of_further(further),
            },
        )
        return dataclasses.replace(self.bare, replay=replay, meta=dict(self.bare.meta))

    @property
    def whose(self) -> str:
        """Axis or direction to which the station's cause belongs; "" if none."""
        station = self.station
        return self._of(station.cause_axis, station.cause_interface, station.cause_sensor)

    def _of(self, axis: int | None, interface: int | None, sensor: int | None) -> str:
        if sensor is not None:
            return trips.sensor_of(self.config, sensor)
        return trips.whose(axis, interface, self.bare.axis_names, self.bare.interface_names)

    @property
    def cause_in_figures(self) -> str:
        """The value that triggered the cause, and the limit; with several axes, also the axis.

        "" if there are no figures.
        """
        station = self.station
        return self._figures(
            self.causing, station.cause_axis, station.cause_interface, station.cause_sensor
        )

    @property
    def refusal_in_figures(self) -> str:
        """The same for the reason why the station refused the last command."""
        station = self.station
        return self._figures(
            station.refusal,
            station.refusal_axis,
            station.refusal_interface,
            station.refusal_sensor,
        )

    def _figures(
        self,
        met: tuple[str, float, float],
        axis: int | None,
        interface: int | None,
        sensor: int | None,
    ) -> str:
        turns = interface is not None and self._turns(interface)
        text = trips.figures(*met, turns=turns, alone=sensor is not None)
        whose = self._of(axis, interface, sensor)
        return f"{whose}: {text}" if text and whose else text

    def _turns(self, interface: int) -> bool:
        """Return whether a direction is a rotation, whose limits are in rad and N m."""
        group = self.setup.group
        return group is not None and group.rig.kinematics.turns()[interface]

    def note_cause(self) -> None:
        """Store the cause of a trip before a reset clears it in the station."""
        text = self.cause_in_figures
        self.caused, self.caused_by, self.caused_in_figures = self.causing, self.whose, text

    @property
    def ended_by(self) -> str:
        """The limit that interrupted or ended the test, with its figures and time; "" if none."""
        cause, text = self.causing[0], self.cause_in_figures
        if self.caused is not None:
            cause, text = self.caused[0], self.caused_in_figures
        if cause in trips.NONE or not text:
            return ""
        return f"{text} at {self.running / self.setup.rate.hz:.1f} s"

    def ending(self, state: str) -> dict[str, Any]:
        """Return the entries about the end for ``meta`` of the recording.

        Args:
            state: state of the station, as reported by the tick thread.
        """
        state = "TRIPPED" if self.tripped_rows else state
        cause, value, limit = self.caused or self.causing
        whose = self.whose if self.caused is None else self.caused_by
        return {
            "end_reason": end_reason(state, cause, moved=self.moved, of=whose),
            "interrupted": self.held,
            "station": {
                "state": state,
                "cause": cause,
                "cause_value": value,
                "cause_limit": limit,
                "indicated": self.station.indicated,
            },
        }
