"""A run: a station, and the book that is kept of what it does."""

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
from rthyb_rt.record.recording import Recording

AT_REST: Final = ("IDLE", "ZEROED", "ARMED", "TRIPPED")
"""States in which nothing moves on this program's word."""

_IDLE, _ZEROED, _HOLD, _TRIPPED = map(STATES.index, ("IDLE", "ZEROED", "HOLD", "TRIPPED"))
_MOVING: Final = [STATES.index(name) for name in STATES if name not in AT_REST]


def _of_further(tares: Sequence[tuple[float, float]]) -> dict[str, float]:
    """Return the tares of axes 1 on, under the names of the first with their number."""
    found = dict[str, float]()
    for axis, (x_m, f_n) in enumerate(tares):
        if axis:
            found |= {f"displacement_m.{axis}": x_m, f"force_n.{axis}": f_n}
    return found


@dataclass(kw_only=True)
class Run:
    """A station, and what a recording of it is to know.

    Attributes:
        setup: the test.
        config: settings of the station.
        station: what ticks.
        bare: the recording as it was before its first row.
        commands: every operator command so far: ``{"tick", "command", "refused"}``.
        parameters: every set of parameters: ``{"generation", "tick", "values"}``.
        running: rows of the test proper so far.
        zeroed, held: whether ZEROED, or HOLD, was ever entered.
        moved: whether a command other than the reading at rest has ever left.
        tripped_rows: rows in TRIPPED.
        idle_rows: rows in IDLE at the end.
        caused, caused_by, caused_in_figures: `causing`, `whose` and `cause_in_figures` at the trip,
            once that is seen; a reset takes them from the station.
        longest_skip: the most ticks that were skipped at a time.
    """

    setup: Setup
    config: core.StationConfig
    station: core.Station
    bare: Recording
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
        """Make a station, and open the book.

        Args:
            setup: the test.
            clock: what it goes by.
            config: settings of the station.
            facts: what else the recording is to know, by name.
            more: fields of a subclass.

        Raises:
            CoreError: a setting is refused.
        """
        station = core.Station(config, setup.ag_mps2)
        parameters = [experiment.first_parameters(setup, config)]
        bare = experiment.blank(setup, clock)
        bare.meta |= facts or {}
        bare.replay.parameters = list(parameters)
        return cls(
            setup=setup, config=config, station=station, bare=bare, parameters=parameters, **more
        )

    # ---- the book -------------------------------------------------------------------------------

    def take(self, samples: NDArray[np.void]) -> None:
        """Note rows in the book, in order, shape (n,)."""
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
        """The station's cause, the value that was met and the limit's."""
        return self.station.cause, self.station.cause_value, self.station.cause_limit

    @property
    def begun(self) -> bool:
        """Whether more has come of it than a tare: its end is one at rest."""
        return self.zeroed or self.moved or self.tripped_rows > 0

    @property
    def progress(self) -> tuple[int, int]:
        """Samples of the test proper so far, and of the whole test."""
        return min(self.running, self.setup.ticks), self.setup.ticks

    # ---- what the recording is to know ----------------------------------------------------------

    def known(self) -> Recording:
        """Return the recording without its rows, with what tare and commands have become."""
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
        """Which of several axes, or directions, the station's cause belongs to; "": of none."""
        return self._of(self.station.cause_axis, self.station.cause_interface)

    def _of(self, axis: int | None, interface: int | None) -> str:
        return trips.whose(axis, interface, self.bare.axis_names, self.bare.interface_names)

    @property
    def cause_in_figures(self) -> str:
        """The cause with the value met and the limit's, of several axes with whose it is.

        "" where it has no figures.
        """
        station = self.station
        return self._figures(self.causing, station.cause_axis, station.cause_interface)

    @property
    def refusal_in_figures(self) -> str:
        """The same of what stands against the command that the station refused last."""
        station = self.station
        return self._figures(station.refusal, station.refusal_axis, station.refusal_interface)

    def _figures(
        self, met: tuple[str, float, float], axis: int | None, interface: int | None
    ) -> str:
        turns = interface is not None and self._turns(interface)
        told, whose = trips.figures(*met, turns=turns), self._of(axis, interface)
        return f"{whose}: {told}" if told and whose else told

    def _turns(self, interface: int) -> bool:
        """Tell whether a direction is a rotation, whose limits are in rad and N m."""
        group = self.setup.group
        return group is not None and group.rig.kinematics.turns()[interface]

    def note_cause(self) -> None:
        """Keep the cause of a trip, before a reset takes it from the station."""
        told = self.cause_in_figures
        self.caused, self.caused_by, self.caused_in_figures = self.causing, self.whose, told

    @property
    def ended_by(self) -> str:
        """The limit that took the test off its course, with its figures and when; "": none did."""
        cause, told = self.causing[0], self.cause_in_figures
        if self.caused is not None:
            cause, told = self.caused[0], self.caused_in_figures
        if cause in trips.NONE or not told:
            return ""
        return f"{told} at {self.running / self.setup.rate.hz:.1f} s"

    def ending(self, state: str) -> dict[str, Any]:
        """Return what ``meta`` of the recording says of the end.

        Args:
            state: the station's, by what the thread that ticks has told.
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
