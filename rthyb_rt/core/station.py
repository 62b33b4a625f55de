"""States, limits and faults around the controller: settings, ticks, replay."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.library import (
    CoreError,
    RecordArray,
    check,
    doubles,
    options,
    reading,
    words,
)
from rthyb_rt.core.pending import raise_pending
from rthyb_rt.core.rows import COMMAND_BIT, RECORD_DTYPE, STATES, as_records, records_pointer
from rthyb_rt.core.settings import (
    ControllerConfig,
    DenseConfig,
    LawConfig,
    MotionConfig,
    RfcConfig,
    fill_part,
    mapping,
    struct_of,
)
from rthyb_rt.core.sparse import SparseConfig

if TYPE_CHECKING:
    from rthyb_rt.core.own import OwnClass
    from rthyb_rt.core.own_parts import OwnPartConfig
    from rthyb_rt.core.wire import Codec

Reaction = Literal["none", "indicate", "hold", "ramp-out", "trip"]
Command = Literal["none", "zero", "arm", "start", "hold", "resume", "stop", "reset", "trip"]

# The header has the names. What the type checker knows of them stands above; a test holds the two
# together.
REACTIONS: Final = cast(tuple[Reaction, ...], tuple(options("rthyb_reaction", "RTHYB_REACT_")))
COMMANDS: Final = cast(tuple[Command, ...], tuple(words("rthyb_command", "RTHYB_CMD_")))
CAUSES: Final = tuple(words("rthyb_cause", "RTHYB_CAUSE_"))
WATCHABLE: Final = CAUSES[CAUSES.index("skips") :]
BLIND_MAX: Final[int] = lib.RTHYB_BLIND_MAX
LOST_TICKS: Final[int] = lib.RTHYB_LOST_TICKS


@dataclass(frozen=True)
class Watch:
    """What is done when a watched quantity goes past ``value``; 0 switches the watch off."""

    value: float
    reaction: Reaction


@dataclass(frozen=True)
class StationConfig:
    """Settings of the station.

    ``watches`` has a :class:`Watch` by cause: position (m), velocity (m/s), increment (m a tick),
    force (N), tracking (m), indicator (m^2/s), energy (J), sensor_stuck and force_stuck (ticks),
    sensor_jump (m), force_jump (N), rig_position (m) and rig_force (N) before tare, lost_pairs,
    lost_warning, skips and skip_warning (share of the last second's ticks).
    ``tare_most_m``, ``tare_most_n``: ZERO refuses a larger tare; 0 takes any.
    ``brake_acceleration_m_per_s2``: of HOLD, and where RAMP_OUT begins; 0: as of paths. ``stay``:
    RAMP_OUT ends where it comes to rest, and not at 0. ``law_channel``,
    ``law_channel_count``: which of a row's channels are what the control law reports beside alpha
    and beta; ``part_channel``, ``part_channel_count`` those of the numerical part's responses.
    """

    controller: ControllerConfig
    watches: Mapping[str, Watch] = field(default_factory=dict)
    path_velocity_m_per_s: float = 0.02
    path_acceleration_m_per_s2: float = 0.2
    brake_acceleration_m_per_s2: float = 0.0
    rest_spread_m: float = 1e-4
    tare_most_m: float = 0.0
    tare_most_n: float = 0.0
    tare_ticks: int = 1024
    ramp_in_ticks: int = 2048
    armed_ticks: int = 30720
    stay: bool = False
    law_channel: int = 0
    law_channel_count: int = 0
    part_channel: int = 0
    part_channel_count: int = 0

    @property
    def fs_hz(self) -> float:
        """Sample rate."""
        return 1.0 / self.controller.period_s

    def plain(self) -> dict[str, Any]:
        """Return all of it as plain values, for a recording: `of` takes them back."""
        part, own = self.controller.numerical, self.controller.law.own
        bare = dataclasses.asdict(
            replace(self, controller=replace(self.controller, numerical=None))
        )
        if part is not None:
            bare["controller"]["numerical"] = (
                dataclasses.asdict(part) if isinstance(part, DenseConfig) else part.plain()
            )
        bare["controller"]["law"].pop("own")
        if own is not None:
            bare["controller"]["law"]["own"] = own.plain()
        return bare

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> StationConfig:
        """Return the settings that `plain` has written down.

        Raises:
            CoreError: they are not those of this version.
        """
        try:
            given = dict(plain)
            inner: dict[str, Any] = dict(given.pop("controller"))
            if "estimator" in inner:
                inner |= _law_of_estimator(inner)
            if inner["law"].get("own") is not None:
                inner["law"] = inner["law"] | {"own": _own_class(inner["law"]["own"])}
            parts = {"law": LawConfig, "rfc": RfcConfig, "motion": MotionConfig}
            inner |= {name: kind(**inner[name]) for name, kind in parts.items()}
            if inner.get("numerical") is not None:
                inner["numerical"] = _numerical(inner["numerical"])
            watches = {name: Watch(**watch) for name, watch in given.pop("watches").items()}
            return cls(controller=ControllerConfig(**inner), watches=watches, **given)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CoreError(
                f"station settings: {error}; replay with the version that recorded"
            ) from error


def _law_of_estimator(controller: dict[str, Any]) -> dict[str, Any]:
    """Return what took the place of estimator and phase lead in a controller's plain settings.

    Recordings have them so that were made when there was no other law. They are taken out here.
    """
    old, enabled = controller.pop("estimator"), controller.pop("plc_enabled")
    name, own = {
        "fixed": ("paper", {}),
        "gradient": (
            "paper",
            {"gain_per_mm2_per_sample": old["gain"] / (old["reference_m"] / 1e-3) ** 2},
        ),
        "robust": ("robust", {"rate_per_sample": old["gain"]}),
        "rls": ("alpha-beta", {"memory_s": old["memory_samples"] * old["period_s"]}),
    }[old["law"]]
    own |= {"reference_displacement_m": old["reference_m"]}
    own |= {key: old[key] for key in ("alpha_min", "alpha_max")}
    if name != "paper":
        own |= {key: old[key] for key in ("cutoff_hz", "gate_factor")}
    settings = {key: old[key] for key in ("w1", "w2", "alpha0", "beta0")}
    settings |= {f"delay_estimator.{key}": value for key, value in own.items()}
    law = {
        "name": name,
        "settings": settings,
        "adapts": old["law"] != "fixed",
        "rest_noise_m": old["rest_noise_m"],
    }
    return {"law": law, "lead_enabled": enabled}


@dataclass(frozen=True)
class Calibration:
    """Between the numbers on the wire and the structure's own; as it stands it changes nothing.

    x = ``x_gain`` wire + ``x_offset_m``, f = ``f_gain`` wire + ``f_offset_n``, and the command goes
    out as ``cmd_gain`` x + ``cmd_offset_m``.
    """

    x_gain: float = 1.0
    x_offset_m: float = 0.0
    f_gain: float = 1.0
    f_offset_n: float = 0.0
    cmd_gain: float = 1.0
    cmd_offset_m: float = 0.0

    def struct(self) -> Any:
        """Return the ``rthyb_calibration`` of the C core.

        Raises:
            CoreError: a gain is 0, not finite or senseless, or an offset is.
        """
        struct = struct_of("rthyb_calibration", self)
        if lib.rthyb_calibration_check(struct):
            raise CoreError(
                f"{self}: the size of a gain must lie in 1e-9 ... 1e9, of an offset of "
                "displacement in 0 ... 1e3 m, of force in 0 ... 1e12 N"
            )
        return struct


IDENTITY: Final = Calibration()


@dataclass(frozen=True)
class StationTick:
    """What one tick of the station came to."""

    x_cmd_m: float
    sent: bool
    state: str
    refused: bool
    records: RecordArray = field(repr=False)


def _own_class(plain: Mapping[str, Any]) -> OwnClass:
    from rthyb_rt.core.own import OwnClass

    return OwnClass.of_plain(plain)


def _numerical(plain: Mapping[str, Any]) -> DenseConfig | SparseConfig | OwnPartConfig:
    """Return a part's settings from plain values, lists for tuples."""
    if plain.get("kind") == "sparse":
        return SparseConfig.of_plain(plain)
    if "kind" in plain:
        from rthyb_rt.core.own_parts import of_plain

        return of_plain(plain)

    def frozen(value: Any) -> Any:
        return tuple(frozen(v) for v in value) if isinstance(value, (list, tuple)) else value

    return DenseConfig(**{name: frozen(value) for name, value in plain.items()})


@dataclass(frozen=True)
class Parameters:
    """What may be changed while a test runs; always a whole set.

    ``watches`` as in :class:`StationConfig`, and what it does not name is not watched; limits of
    the command with 0 for off; path limits are for paths that begin from then on, and narrower ones
    have the path that runs brake and begin anew; a brake of 0 is as hard as paths are. ``adapt``
    False: what the control law has learnt stays as it is.
    """

    watches: Mapping[str, Watch] = field(default_factory=dict)
    velocity_limit_m_per_s: float = 0.0
    acceleration_limit_m_per_s2: float = 0.0
    path_velocity_m_per_s: float = 0.02
    path_acceleration_m_per_s2: float = 0.2
    adapt: bool = True
    brake_acceleration_m_per_s2: float = 0.0

    @classmethod
    def of(cls, config: StationConfig) -> Parameters:
        """Return the set that a station begins with, generation 0."""
        return cls(
            watches=config.watches,
            velocity_limit_m_per_s=config.controller.velocity_limit_m_per_s,
            acceleration_limit_m_per_s2=config.controller.acceleration_limit_m_per_s2,
            path_velocity_m_per_s=config.path_velocity_m_per_s,
            path_acceleration_m_per_s2=config.path_acceleration_m_per_s2,
            brake_acceleration_m_per_s2=config.brake_acceleration_m_per_s2,
        )

    def struct(self, generation: int = 0) -> Any:
        """Return the ``rthyb_parameters`` of the C core.

        Raises:
            CoreError: there is nothing to watch under a name.
        """
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        own.pop("watches")
        struct = ffi.new("rthyb_parameters *", own | {"generation": generation})
        _fill_watches(struct.watch, self.watches)
        return struct


class Station:
    """States, limits and faults around the controller; raises ``CoreError``."""

    def __init__(self, config: StationConfig, ag_mps2: npt.ArrayLike) -> None:
        plain = {k: v for k, v in _mapping_of(config).items() if k != "watches"}
        axis = {name: plain.pop(name) for name in ("rest_spread_m", "tare_most_m", "tare_most_n")}
        ranges = {name: plain["controller"][name] for name in ("x_range_m", "f_range_n")}
        plain["axis"] = [axis | ranges]
        struct = ffi.new("rthyb_station_config *", plain)
        self._part = fill_part(struct.controller.numerical, config.controller.numerical)
        _fill_watches(struct.watch, config.watches)
        self._c = ffi.new("rthyb_station *")
        check(lib.rthyb_station_init(self._c, struct))
        self._ag = doubles(ag_mps2)
        self._in, self._out = ffi.new("rthyb_station_input *"), ffi.new("rthyb_station_output *")

    def tick(
        self,
        x_m: float = 0.0,
        f_n: float = 0.0,
        *,
        lost: bool = False,
        command: Command = "none",
        skipped: int = 0,
        link_down: bool = False,
        drive_stopped: bool = False,
        heartbeat_late: bool = False,
        taken_over_m: float | None = None,
    ) -> StationTick:
        """Run one executed tick with the newest pair (before tare), or without one.

        ``taken_over_m``: with the first sound reading, the command that the drive has already.
        """
        i = self._in
        i.taken_over = taken_over_m is not None
        i.axis[0] = {"x_m": x_m, "f_n": f_n, "x_cmd_m": taken_over_m or 0.0}
        i.lost = lib.RTHYB_LOST if lost else 0
        i.skipped, i.command = skipped, COMMANDS.index(command)
        i.link_down, i.drive_stopped, i.heartbeat_late = link_down, drive_stopped, heartbeat_late
        records = np.zeros(BLIND_MAX + 1, dtype=RECORD_DTYPE)
        lib.rthyb_station_tick(
            self._c, i, reading(self._ag), self._ag.size, records_pointer(records), self._out
        )
        raise_pending()
        out = self._out
        return StationTick(
            x_cmd_m=out.axis[0].x_cmd_m,
            sent=bool(out.send),
            state=STATES[out.state],
            refused=bool(out.refused),
            records=records[: out.records],
        )

    def replay(
        self,
        rows: RecordArray,
        codec: Codec | None = None,
        calibration: Calibration = IDENTITY,
        parameters: Sequence[tuple[int, Parameters]] = (),
    ) -> RecordArray:
        """Return the rows that this station, a fresh one, computes from recorded inputs.

        With the station's settings and ground motion those of the recording, every byte is the same
        again; the first row that differs, or is missing, is where the recording and the core part.
        What clock and link added (times, echo, count, slips) is copied.

        Args:
            rows: every row from the station's first tick on, (n,).
            codec: of the link that sent the commands; None: no wire, they left as computed.
            calibration: of the loop.
            parameters: every set that was published, with its generation.

        Returns:
            The rows, (n,); fewer where those given do not make whole ticks.

        Raises:
            CoreError: the station has ticked already.
        """
        if self.ticks:
            raise CoreError(
                f"only a fresh station replays; this one has {self.ticks} ticks behind it"
            )
        recorded = as_records(rows)
        out = np.zeros(recorded.size, dtype=RECORD_DTYPE)
        sets = ffi.new("rthyb_parameters[]", len(parameters))
        for slot, (generation, one) in enumerate(parameters):
            sets[slot] = one.struct(generation)[0]
        source = ffi.new("rthyb_replay *")
        source.rows, source.count = records_pointer(recorded), recorded.size
        ag = reading(self._ag)
        source.ag_mps2, source.ag_count = ag, self._ag.size
        source.codec = ffi.NULL if codec is None else codec.struct
        source.calibration = calibration.struct()[0]
        source.parameters, source.parameter_count = sets, len(parameters)
        count = lib.rthyb_station_replay(self._c, source, records_pointer(out))
        raise_pending()
        return out[:count]

    @property
    def state(self) -> str:
        """Name of the present state."""
        return STATES[int(self._c.state)]

    @property
    def cause(self) -> str:
        """First cause that took the test off its course, latched."""
        return CAUSES[int(self._c.cause)]

    @property
    def cause_tick(self) -> int:
        """Tick in which that cause came up; without one it means nothing."""
        return int(self._c.cause_tick)

    @property
    def cause_value(self) -> float:
        """What was met when that cause came up, in its watch's unit; 0 where it has no number."""
        return float(self._c.cause_value)

    @property
    def cause_limit(self) -> float:
        """What was allowed then, in the same unit; 0 where the cause has no number."""
        return float(self._c.cause_limit)

    @property
    def refusal(self) -> tuple[str, float, float]:
        """Which watch refused the last command or tare, with what was met and what is allowed.

        "none" where none did.
        """
        c = self._c
        return CAUSES[int(c.refused_cause)], float(c.refused_value), float(c.refused_limit)

    @property
    def indicated(self) -> list[str]:
        """Causes that were seen and only indicated."""
        return [name for bit, name in enumerate(CAUSES) if self._c.indicated >> bit & 1]

    @property
    def interrupted(self) -> bool:
        """Whether the test was held."""
        return bool(self._c.interrupted)

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused: the reading moved, or `tare_too_large`."""
        return int(self._c.zeroing) in (2, 3)

    @property
    def tare_too_large(self) -> bool:
        """Whether it was refused for its size; `refusal` has the figures."""
        return bool(self._c.zeroing == 3)

    @property
    def ticks(self) -> int:
        """Ticks so far, executed and skipped."""
        return int(self._c.tick)

    @property
    def skipped(self) -> int:
        """Ticks skipped so far."""
        return int(self._c.skipped)

    @property
    def test_tick(self) -> int:
        """Index of the ground motion's next sample."""
        return int(self._c.test_tick)

    @property
    def tare(self) -> tuple[float, float]:
        """Offsets taken off displacement (m) and force (N)."""
        return self._c.axis[0].tare_x, self._c.axis[0].tare_f

    @property
    def command_tare_m(self) -> float:
        """What is added to a command on its way to the drive: where that stood at the tare, m."""
        return float(self._c.axis[0].tare_cmd)


def command_of(flags: int) -> Command:
    """Return the operator's command in a record's flags; "none" if there was none.

    Raises:
        CoreError: no command has that number.
    """
    number = int(flags) >> COMMAND_BIT
    if not 0 <= number < len(COMMANDS):
        raise CoreError(f"flags {int(flags):#x} hold no command: {number} is beyond the last one")
    return COMMANDS[number]


def command_allowed(state: str, command: Command) -> bool:
    """Return whether an operator may give a command in a state."""
    code = COMMANDS.index(command)
    return bool(lib.rthyb_command_allowed(STATES.index(state), code))


def _fill_watches(slots: Any, watches: Mapping[str, Watch]) -> None:
    unknown = set(watches) - set(WATCHABLE)
    if unknown:
        raise CoreError(f"nothing to watch under the name {', '.join(sorted(unknown))}")
    for name, watch in watches.items():
        slot = slots[CAUSES.index(name)]
        slot.value, slot.reaction = watch.value, REACTIONS.index(watch.reaction)


def _mapping_of(config: StationConfig) -> dict[str, Any]:
    own = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return own | {"controller": mapping(replace(config.controller, numerical=None))}
