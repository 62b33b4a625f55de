"""A prescribed motion through the station and the link of a test, with every limit in force."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.config import STANDARD, AxesRig, Limit, Rate, RigFile
from rthyb_rt.core import FLAGS, RUNNING, STATES
from rthyb_rt.core.loop import Clock
from rthyb_rt.errors import InputError, Problem, RthybError
from rthyb_rt.lab import beside, experiment, realtime, trips
from rthyb_rt.lab.experiment import Setup
from rthyb_rt.record.recording import RecordedTest

if TYPE_CHECKING:
    from rthyb_rt.rig.links.opened import Opened

Floats = NDArray[np.float64]
Rows = NDArray[np.void]
AnyRig = TypeVar("AnyRig", bound=RigFile | AxesRig)

ATTEMPTS: Final = 3
"""A motion that is spoilt by a stall of the PC or the link is repeated up to this many times."""
SPOILT: Final = (*realtime.TIMING_CAUSES, "link_lost", "lost_pairs")

GENTLE_M_PER_S: Final = 1e-3
"""Speed of motions for which no speed is requested."""

_HOME_M: Final = 5e-6
_RAMP_IN_TICKS: Final = 128
"""In ticks of 1/1024 s."""
_MEAN_S: Final = 0.25
"""Time at rest over which positions and forces are averaged."""
_PEAK_SPEED: Final = 1.875
_PEAK_ACCELERATION: Final = 10.0 / math.sqrt(3.0)
"""Peak acceleration of the quintic from 0 to 1 in unit time."""


class LimitError(RthybError):
    """A limit, or the drive, ended a motion."""

    exit_code = 6


class StoppedError(RthybError):
    """The operator ended a motion."""

    exit_code = 130


def _never_interrupted(_: Callable[[], None]) -> AbstractContextManager[None]:
    return nullcontext()


@dataclass(frozen=True)
class Reach(Generic[AnyRig]):
    """An opened rig, of one axis (`Connection`) or of several (`AxesConnection`).

    Attributes:
        rig: its rig file.
        opened: the links to its drives; they remain the caller's.
        clock, before_tick: as in `rthyb_rt.lab.realtime.Session`.
        on_interrupt: context in which a stop by the operator calls the given function.
        warn: prints a sentence for the operator; each is given only once.
        resets: whether drives that have stopped are reset before a motion.
    """

    rig: AnyRig
    opened: Opened
    clock: Clock = "host"
    before_tick: Callable[[], None] | None = None
    on_interrupt: Callable[[Callable[[], None]], AbstractContextManager[None]] = _never_interrupted
    warn: Callable[[str], None] = lambda _: None
    resets: bool = False
    _warned: set[str] = field(default_factory=set, repr=False)

    def warn_once(self, text: str) -> None:
        """Pass a warning on unless it has been given before."""
        if text not in self._warned:
            self._warned.add(text)
            self.warn(text)


Connection: TypeAlias = Reach[RigFile]
AxesConnection: TypeAlias = Reach[AxesRig]


@dataclass(frozen=True)
class GuidedMotion:
    """A motion of the structure, from where it is now.

    Attributes:
        name: for messages.
        path_m: displacement at every tick, (n,), beginning near 0.
        watches: replace the rig's limits of these names; they count from the motion's start.
        velocity_limit_m_per_s, acceleration_limit_m_per_s2: of the command, instead of the rig's.
        stay: a motion that is interrupted ends where it comes to rest, not where it began.
        whole_force: the force limit counts from zero load, not from the load at the beginning.
        with_sensors: sensors without an actuator are read, and may end the motion.
    """

    name: str
    path_m: Floats
    watches: Mapping[str, core.Watch] = field(default_factory=dict)
    velocity_limit_m_per_s: float | None = None
    acceleration_limit_m_per_s2: float | None = None
    stay: bool = True
    whole_force: bool = True
    with_sensors: bool = True


@dataclass(frozen=True)
class MotionResult:
    """The result of a motion.

    Attributes:
        recording: the complete recording.
    """

    recording: RecordedTest

    @property
    def _mean_ticks(self) -> int:
        return Rate(self.recording.fs_hz).ticks(_MEAN_S)

    def rests(self) -> tuple[Rows, Rows]:
        """Return the rows over which positions and forces are averaged, before and after it."""
        rows, most = self.rows[fresh(self.rows)], self._mean_ticks
        moves = rows["state"] >= STATES.index("RAMP_IN")
        begun = int(np.argmax(moves)) if moves.any() else rows.size
        return rows[:begun][-most:], rows[-most:]

    @property
    def zeroed(self) -> bool:
        """Whether the tare was taken; from then on everything is relative to it."""
        return "ZEROED" in self.states

    @property
    def start_m(self) -> float:
        """Displacement before the motion, calibrated, not tared."""
        tare_m = float(self.recording.replay.tares["displacement_m"])
        return tare_m if self.zeroed else self._at_end("x_meas_m")

    @property
    def start_n(self) -> float:
        """Force before the motion, calibrated, not tared."""
        tare_n = float(self.recording.replay.tares["force_n"])
        return tare_n if self.zeroed else self._at_end("f_meas_n")

    @property
    def rows(self) -> Rows:
        """All rows, beginning with the first tick, (n,)."""
        return self.recording.samples

    @property
    def running(self) -> Rows:
        """Rows of the motion itself, (m,)."""
        rows: Rows = self.rows[self.rows["state"] == RUNNING]
        return rows

    @property
    def facts(self) -> dict[str, Any]:
        """Facts about the session, as in a recording's ``meta["real_time"]``."""
        facts: dict[str, Any] = self.recording.meta["real_time"]
        return facts

    @property
    def cause(self) -> str:
        """What ended it: "completed", or a cause of the station."""
        return str(self.recording.meta["station"]["cause"])

    @property
    def state(self) -> str:
        """Name of the last state."""
        return str(self.recording.meta["station"]["state"])

    @property
    def states(self) -> set[str]:
        """Names of all states that were passed through."""
        return {STATES[number] for number in np.unique(self.rows["state"])}

    @property
    def end_reason(self) -> str:
        """What ended it, as a sentence."""
        return str(self.recording.meta["end_reason"])

    @property
    def ended_by_sensor(self) -> bool:
        """Whether a sensor without an actuator ended it."""
        return " of sensor " in self.end_reason

    @property
    def end_in_figures(self) -> str:
        """What ended it, as a sentence with the value reached and the limit, if it has any."""
        station = self.recording.meta["station"]
        value, limit = float(station["cause_value"]), float(station["cause_limit"])
        found = trips.figures(self.cause, value, limit, alone=self.ended_by_sensor)
        return f"{self.end_reason}: {found}" if found else self.end_reason

    @property
    def moved_m(self) -> float:
        """Change of the displacement from beginning to end."""
        return self._at_end("x_meas_m") if self.zeroed else 0.0

    @property
    def change_n(self) -> float:
        """Change of the force from beginning to end."""
        return self._at_end("f_meas_n") if self.zeroed else 0.0

    @property
    def commanded_m(self) -> float:
        """Command at the end, relative to the beginning."""
        return float(self.rows["x_cmd_m"][-1]) if self.zeroed else 0.0

    def noise(self, column: str) -> float:
        """Return the standard deviation of a reading at rest, before the motion."""
        still = self.rows[(self.rows["state"] < RUNNING) & fresh(self.rows)][-self._mean_ticks :]
        return float(still[column].std()) if still.size else 0.0

    def certain(self, column: str) -> float:
        """Return the smallest change between two rests that is significant against the noise."""
        return 6.0 * self.noise(column) * math.sqrt(2.0 / self._mean_ticks) + _FINEST[column]

    def _at_end(self, column: str) -> float:
        rest = self.rows[fresh(self.rows)][-self._mean_ticks :]
        return float(rest[column].mean()) if rest.size else 0.0


_FINEST: Final = {"x_meas_m": 2e-9, "f_meas_n": 2e-3}
"""Twice the resolution of the wire."""


def fresh(rows: Rows) -> NDArray[np.bool_]:
    """Return which rows contain a new reading, (n,)."""
    mask: NDArray[np.bool_] = (rows["flags"] & FLAGS["fresh"]) != 0
    return mask


def command_numbers(rows: Rows, before: int = 0) -> NDArray[np.int64]:
    """Return the number of the newest command at the beginning of every tick, (n,).

    The first command has the number ``before`` + 1: ``commands_before`` of a session's facts.
    From then on every executed tick sends one command, until TRIPPED.
    """
    sent = (rows["flags"] & FLAGS["not_sent"]) == 0
    if not sent.any():
        return np.full(rows.size, before, dtype=np.int64)
    begun = np.arange(rows.size) >= int(np.flatnonzero(sent)[0])
    blind = (rows["flags"] & FLAGS["blind"]) != 0
    silent = (rows["state"] == STATES.index("TRIPPED")) & ~sent
    made = np.cumsum(begun & ~blind & ~silent)
    return before + np.concatenate([[0], made[:-1]])


# ---- paths --------------------------------------------------------------------------------------


def eased(
    distance_m: float, speed_m_per_s: float, acceleration_m_per_s2: float, rate: Rate = STANDARD
) -> Floats:
    """Return a smooth path from 0 to a distance within a speed and an acceleration, (n,)."""
    size = abs(distance_m)
    lasts_s = max(
        _PEAK_SPEED * size / speed_m_per_s,
        math.sqrt(_PEAK_ACCELERATION * size / acceleration_m_per_s2),
    )
    ticks = max(math.ceil(lasts_s * rate.hz), 8)
    u = np.arange(1, ticks + 1) / ticks
    way: Floats = distance_m * (u**3 * (10.0 - 15.0 * u + 6.0 * u**2))
    return way


def with_rests(
    path_m: Floats, before_s: float = 0.25, after_s: float = 0.5, *, rate: Rate = STANDARD
) -> Floats:
    """Return a path with a rest added before and after it."""
    before, after = (round(s * rate.hz) for s in (before_s, after_s))
    return np.concatenate([np.zeros(before), path_m, np.full(after, path_m[-1])])


# ---- what a motion requires ---------------------------------------------------------------------


def station_of(setup: Setup, motion: GuidedMotion) -> core.StationConfig:
    """Return the settings of the station: the rig's limits, except those that the motion replaces.

    The rig's limits count from where the motion begins and, once that position is known, also from
    their own zero; the force limit only if the motion asks for it. Any tare is accepted, because a
    motion is the means to bring back a specimen from where no test may begin.
    """
    base = beside.with_watches(setup, experiment.station_config(setup, real=True))
    watches = dict(base.watches)
    for name in ("position", "force"):
        of_rig = watches.pop(f"rig_{name}", None)
        if of_rig is not None:
            watches.setdefault(name, of_rig)
    limits = {
        name: value
        for name in ("velocity_limit_m_per_s", "acceleration_limit_m_per_s2")
        if (value := getattr(motion, name)) is not None
    }
    return replace(
        base,
        controller=replace(base.controller, **limits),
        watches={**watches, **motion.watches},
        tare_most_m=0.0,
        tare_most_n=0.0,
        # Also limits how fast a command approaches the specimen's position if it begins elsewhere.
        path_velocity_m_per_s=min(base.path_velocity_m_per_s, GENTLE_M_PER_S),
        ramp_in_ticks=setup.rate.ticks(_RAMP_IN_TICKS / core.FS_HZ),
        stay=motion.stay,
    )


def check_limits(rig: RigFile) -> None:
    """Refuse to move a rig whose file limits neither position nor force.

    Raises:
        InputError: names what is missing.
    """
    problems = []
    for key, example in (("command_position_m", '"20 mm"'), ("force_n", '"5 kN"')):
        limit: Limit | None = getattr(rig.limits, key)
        if limit is None or not limit.ends:
            found = "missing" if limit is None else "does not end the motion"
            problems.append(
                Problem(
                    f"limits.{key}",
                    f'{found} in the rig file of "{rig.rig.name}"; nothing is moved without a '
                    f"limit on position and on force that holds, ramps out or trips, such as "
                    f"{key} = {example} in its [limits]",
                )
            )
    if problems:
        raise InputError(problems)


def path_figures(rig: RigFile) -> tuple[float, float]:
    """Return velocity (m/s) and acceleration (m/s^2) that no small motion may exceed."""
    limits = experiment.prescribed(rig, "figures", np.zeros(1)).derived.limits
    return limits.path_velocity_m_per_s, limits.path_acceleration_m_per_s2


def check_distance(rig: RigFile, distance_m: float) -> None:
    """Refuse a distance beyond the rig's position limit.

    Raises:
        RefusedError: states what is allowed.
    """
    limit = rig.limits.command_position_m
    if limit is not None and limit.acts and abs(distance_m) > limit.value:
        raise realtime.RefusedError(
            f"{distance_m * 1e3:g} mm is more than limits.command_position_m = "
            f"{limit.value * 1e3:g} mm allows; choose a smaller distance"
        )


# ---- the motion ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Beginning:
    """What is checked before a motion begins."""

    connection: Connection
    motion: GuidedMotion

    def judge(self, session: realtime.Session) -> None:
        """Check the position and the load of the specimen before anything moves."""
        x_m, f_n = session.run.station.tare
        self._check_reach(x_m)
        watches = self._position_from_zero(session, x_m)
        if self.motion.whole_force:
            watches |= self._force_from_zero(session, f_n)
        if watches:
            config = session.run.config
            wanted = {**config.watches, **watches}
            session.set_parameters(replace(core.Parameters.of(config), watches=wanted))

    def _position_from_zero(self, session: realtime.Session, x_m: float) -> dict[str, core.Watch]:
        """Watch the position from its own zero as well, so that repeated jogs go no farther.

        A specimen beyond the rig's limit may return but go no farther; a margin allows for what the
        reading may change at rest.
        """
        limit = self.connection.rig.limits.command_position_m
        if limit is None or not limit.acts:
            return {}
        stands_m = max(abs(x_m), abs(session.run.station.command_tare_m))
        most_m = max(limit.value, stands_m + session.run.config.rest_spread_m)
        return {"rig_position": core.Watch(most_m, limit.action)}

    def _check_reach(self, x_m: float) -> None:
        reach = self.connection.rig.sensors.displacement.range_m
        path = self.motion.path_m
        ends = (x_m + float(path.min()), x_m + float(path.max()))
        if reach is not None and max(map(abs, ends)) >= reach:
            raise realtime.RefusedError(
                f"the specimen is at {x_m * 1e3:.4g} mm and would move to "
                f"{max(ends, key=abs) * 1e3:.4g} mm, but the displacement sensor reaches only to "
                f"{reach * 1e3:g} mm (sensors.displacement.range_m)"
            )

    def _force_from_zero(self, session: realtime.Session, f_n: float) -> dict[str, core.Watch]:
        limit = session.run.config.watches.get("force")
        if limit is None:
            return {}
        left = limit.value - abs(f_n)
        if left <= 0.0:
            raise realtime.RefusedError(
                f"the load cell reads {f_n:.5g} N at rest, but limits.force_n is {limit.value:g} "
                "N; relieve the specimen, correct the load cell's zero ([calibration] "
                "force.offset_n), or raise the limit for this motion with --set "
                "limits.force_n=..."
            )
        return {"force": core.Watch(left, limit.reaction)}


def carry_out(
    connection: Connection,
    motion: GuidedMotion,
    *,
    operator: realtime.Operator | None = None,
    progress: experiment.Progress | None = None,
) -> MotionResult:
    """Zero, arm, follow the path and come to rest, whatever happens on the way.

    Args:
        connection: the rig.
        motion: the motion.
        operator: asks for a stop, as does `Connection.on_interrupt`.
        progress: called now and then with (ticks done, ticks of the motion).

    Raises:
        RefusedError: the specimen is where the motion cannot begin.
        InputError: no feedback, no rest, or inconsistent settings; nothing has moved.
        RthybError: something else failed; the motion has been stopped.
    """
    setup = experiment.prescribed(connection.rig, motion.name, motion.path_m)
    if motion.with_sensors:
        setup = beside.with_sensors(setup)
    operator = operator or realtime.Operator()
    link = connection.rig.link
    with connection.on_interrupt(operator.stop):
        rec = realtime.run(
            setup,
            connection.opened,
            clock=connection.clock,
            before_tick=connection.before_tick,
            progress=progress,
            operator=operator,
            # There is no report to continue with here.
            hold_s=0.0,
            require_realtime=link is not None and link.require_realtime,
            warn=connection.warn_once,
            station=station_of(setup, motion),
            resets=connection.resets,
            zeroed=_Beginning(connection, motion).judge,
        )
    return MotionResult(rec)


def undisturbed(
    connection: Connection,
    motion: GuidedMotion,
    *,
    progress: experiment.Progress | None = None,
) -> MotionResult:
    """Carry out a motion; if this PC or the link stalled, go back and repeat it.

    Raises:
        StoppedError: the operator ended it.
        TimingError: this PC was late in every attempt.
        LimitError: the link stalled in every attempt.
        RthybError: as in `carry_out`.
    """
    for _ in range(ATTEMPTS):
        moved = carry_out(connection, motion, progress=progress)
        if moved.cause in ("operator", "signal", "none") and "HOLD" not in moved.states:
            raise StoppedError(f"{motion.name}: {moved.end_reason}")
        if moved.cause not in SPOILT:
            return moved
        # The stop came from this program, within a motion that the operator has requested.
        connection = replace(connection, resets=True)
        bring_back(connection, moved)
    raise ended(
        moved,
        f"{motion.name}: {moved.end_reason}, {ATTEMPTS} times; run `rthyb jitter` to see whether "
        "this PC is punctual enough",
    )


def bring_back(connection: Connection, moved: MotionResult, *, with_sensors: bool = True) -> None:
    """Return slowly to where a motion began, if the command ended elsewhere.

    It is the command that is reversed, because the sign of the reading may be the fault.

    Args:
        connection: the rig.
        moved: the motion.
        with_sensors: as in `GuidedMotion`; False if one of the sensors is at fault.

    Raises:
        LimitError: a limit or the drive ended the return.
        TimingError: this PC was late.
        StoppedError: the operator ended the return.
        RthybError: as in `carry_out`.
    """
    velocity, acceleration = path_figures(connection.rig)
    back_m = -moved.commanded_m
    for _ in range(ATTEMPTS):
        if abs(back_m) <= max(moved.certain("x_meas_m"), _HOME_M):
            return
        rate = connection.rig.rate
        way = eased(back_m, min(velocity, GENTLE_M_PER_S), acceleration, rate)
        path = with_rests(way, rate=rate)
        back = GuidedMotion("way-back", path, with_sensors=with_sensors)
        returned = carry_out(connection, back)
        if returned.cause == "completed":
            return
        if returned.cause in ("operator", "signal", "none"):
            raise StoppedError(f"on the way back: {returned.end_reason}")
        back_m -= returned.commanded_m
        if returned.cause not in SPOILT:
            break
    raise ended(returned, f"on the way back: {returned.end_reason}")


def ended(moved: MotionResult, message: str) -> RthybError:
    """Return the error that matches how a motion ended early."""
    late = moved.cause in realtime.TIMING_CAUSES
    return realtime.TimingError(message) if late else LimitError(message)
