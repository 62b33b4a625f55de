"""States, limits and faults around the controller: settings, ticks, replay."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.group import (
    AXIS_WATCHES,
    CAUSES,
    GROUP,
    AxisConfig,
    InterfaceConfig,
    SensorWatches,
    Watch,
    bare,
    controller_mapping,
    group_of,
    group_plain,
    station_axes,
    station_interfaces,
    watch_table,
)
from rthyb_rt.core.library import CoreError, RecordArray, check, doubles, reading, words
from rthyb_rt.core.pending import raise_pending
from rthyb_rt.core.rows import (
    COMMAND_BIT,
    STATES,
    as_records,
    copy_records,
    record_dtype,
    records_pointer,
)
from rthyb_rt.core.settings import (
    ControllerConfig,
    DenseConfig,
    LawConfig,
    MotionConfig,
    RfcConfig,
    fill_part,
    struct_of,
)
from rthyb_rt.core.sparse import SparseConfig

if TYPE_CHECKING:
    from rthyb_rt.core.own import OwnClass
    from rthyb_rt.core.own_parts import OwnPartConfig
    from rthyb_rt.core.wire import Codec

Command = Literal["none", "zero", "arm", "start", "hold", "resume", "stop", "reset", "trip"]

# The header has the names. What the type checker knows of them stands above; a test holds the two
# together.
COMMANDS: Final = cast(tuple[Command, ...], tuple(words("rthyb_command", "RTHYB_CMD_")))
BLIND_MAX: Final[int] = lib.RTHYB_BLIND_MAX
LOST_TICKS: Final[int] = lib.RTHYB_LOST_TICKS


@dataclass(frozen=True)
class StationConfig:
    """Settings of the station.

    ``watches`` has a :class:`Watch` by cause: position (m), velocity (m/s), increment (m a tick),
    force (N), tracking (m), indicator (m^2/s), energy (J), sensor_stuck and force_stuck (ticks),
    sensor_jump (m), force_jump (N), rig_position (m) and rig_force (N) before tare, lost_pairs,
    lost_warning, skips and skip_warning (share of the last second's ticks).
    ``tare_most_m``, ``tare_most_n``: ZERO refuses a larger tare; 0 accepts any.
    ``brake_acceleration_m_per_s2``: deceleration of HOLD and at the beginning of RAMP_OUT; 0: that
    of paths. ``stay``: RAMP_OUT ends where it comes to rest instead of at 0. ``law_channel``,
    ``law_channel_count``: first channel and number of channels of a row for the values that the
    first axis' control law reports in addition to alpha and beta; ``part_channel``,
    ``part_channel_count`` for the numerical part's responses; ``axis_channel``,
    ``axis_channel_count`` for the `axis_channels`. ``sensors``: those without an actuator, as many
    as the kinematics has, and ``lone_channel``, ``lone_channel_count`` for their `sensor_channels`.
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
    axis_channel: int = 0
    axis_channel_count: int = 0
    sensors: tuple[SensorWatches, ...] = ()
    lone_channel: int = 0
    lone_channel_count: int = 0

    @property
    def fs_hz(self) -> float:
        """Sample rate."""
        return 1.0 / self.controller.period_s

    def plain(self) -> dict[str, Any]:
        """Return everything as plain values for a recording; `of` restores it."""
        part, law = self.controller.numerical, self.controller.law.own
        own = bare(self.controller)
        plain = dataclasses.asdict(replace(self, controller=replace(own, numerical=None)))
        if part is not None:
            plain["controller"]["numerical"] = (
                dataclasses.asdict(part) if isinstance(part, DenseConfig) else part.plain()
            )
        plain["controller"]["law"].pop("own")
        if law is not None:
            plain["controller"]["law"]["own"] = law.plain()
        for name in GROUP:
            plain["controller"].pop(name)
        plain["controller"] |= group_plain(self.controller)
        if self.controller.axis_count == 1:
            del plain["axis_channel"], plain["axis_channel_count"]
        if not self.sensors:
            del plain["sensors"], plain["lone_channel"], plain["lone_channel_count"]
        return plain

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> StationConfig:
        """Return the settings that `plain` described.

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
            inner |= group_of(inner)
            parts = {"law": LawConfig, "rfc": RfcConfig, "motion": MotionConfig}
            inner |= {name: kind(**inner[name]) for name, kind in parts.items()}
            if inner.get("numerical") is not None:
                inner["numerical"] = _numerical(inner["numerical"])
            watches = {name: Watch(**watch) for name, watch in given.pop("watches").items()}
            given["sensors"] = tuple(SensorWatches.of(one) for one in given.get("sensors", ()))
            return cls(controller=ControllerConfig(**inner), watches=watches, **given)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise CoreError(
                f"station settings: {error}; replay the recording with the version that recorded it"
            ) from error


def _law_of_estimator(controller: dict[str, Any]) -> dict[str, Any]:
    """Return the control law that replaces estimator and phase lead in a controller's settings.

    Old recordings, made when there was no other law, have these two keys. They are removed here.
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
class WireCalibration:
    """Conversion between numbers on the wire and those of the structure; the default is identity.

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
            CoreError: a gain is 0, or a gain or an offset is not finite or implausible.
        """
        struct = struct_of("rthyb_calibration", self)
        if lib.rthyb_calibration_check(struct):
            raise CoreError(
                f"{self}: the magnitude of a gain must be from 1e-9 to 1e9, that of a "
                "displacement offset from 0 to 1e3 m, and that of a force offset from 0 to 1e12 "
                "N"
            )
        return struct


IDENTITY: Final = WireCalibration()


@dataclass(frozen=True)
class AxisReading:
    """Input of one axis for a tick: its newest pair, before tare, or that there is none."""

    x_m: float = 0.0
    f_n: float = 0.0
    lost: bool = False
    link_down: bool = False
    drive_stopped: bool = False
    taken_over_m: float | None = None

    def mapping(self) -> dict[str, Any]:
        """Return the ``rthyb_axis_input`` of the C core."""
        return {
            "x_m": self.x_m,
            "f_n": self.f_n,
            "x_cmd_m": self.taken_over_m or 0.0,
            "lost": lib.RTHYB_LOST if self.lost else 0,
            "link_down": self.link_down,
            "drive_stopped": self.drive_stopped,
        }


@dataclass(frozen=True)
class StationTick:
    """Result of one tick of the station; ``x_cmd_m`` is the first of ``commands_m``."""

    x_cmd_m: float
    sent: bool
    state: str
    refused: bool
    records: RecordArray = field(repr=False)
    commands_m: tuple[float, ...] = ()


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
class AxisParameters:
    """Parameters of one of several axes, and of the interface with the same number.

    ``watches`` of the axis, `AXIS_WATCHES`; ``interface_watches`` as in ``InterfaceConfig``.
    """

    watches: Mapping[str, Watch] = field(default_factory=dict)
    velocity_limit_m_per_s: float = 0.0
    acceleration_limit_m_per_s2: float = 0.0
    interface_watches: Mapping[str, Watch] = field(default_factory=dict)

    def mapping(self) -> dict[str, Any]:
        """Return the ``rthyb_axis_parameters`` of the C core; raises ``CoreError``."""
        return {
            "own": 1,
            "watch": watch_table(self.watches, AXIS_WATCHES),
            "velocity_limit_m_per_s": self.velocity_limit_m_per_s,
            "acceleration_limit_m_per_s2": self.acceleration_limit_m_per_s2,
            "interface": station_interfaces([InterfaceConfig(watches=self.interface_watches)])[0],
        }


@dataclass(frozen=True)
class Parameters:
    """Parameters that may be changed while a test runs, always as a complete set.

    ``watches`` is as in :class:`StationConfig`; quantities that it does not name are not watched.
    A limit of the command of 0 is off. Path limits apply to paths that begin later; if they are
    tighter than before, the current path brakes and begins again. A brake of 0 uses the
    acceleration of paths. With ``adapt`` False, the control law stops learning. ``axes`` has the
    parameters of each of several axes; if it is empty, the set applies to all axes alike and
    interfaces are not watched.
    """

    watches: Mapping[str, Watch] = field(default_factory=dict)
    velocity_limit_m_per_s: float = 0.0
    acceleration_limit_m_per_s2: float = 0.0
    path_velocity_m_per_s: float = 0.02
    path_acceleration_m_per_s2: float = 0.2
    adapt: bool = True
    brake_acceleration_m_per_s2: float = 0.0
    axes: tuple[AxisParameters, ...] = ()

    @classmethod
    def of(cls, config: StationConfig) -> Parameters:
        """Return the initial set of a station, generation 0."""
        controller = config.controller
        return cls(
            watches=config.watches,
            velocity_limit_m_per_s=controller.velocity_limit_m_per_s,
            acceleration_limit_m_per_s2=controller.acceleration_limit_m_per_s2,
            path_velocity_m_per_s=config.path_velocity_m_per_s,
            path_acceleration_m_per_s2=config.path_acceleration_m_per_s2,
            brake_acceleration_m_per_s2=config.brake_acceleration_m_per_s2,
            axes=tuple(
                _axis_parameters(config, axis, interface)
                for axis, interface in zip(controller.axes, controller.interfaces, strict=True)
            ),
        )

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> Parameters:
        """Return the set that `dataclasses.asdict` described, as recordings store it."""
        given = dict(plain) | {"watches": _watches(plain["watches"])}
        given["axes"] = tuple(
            AxisParameters(
                **dict(axis)
                | {name: _watches(axis[name]) for name in ("watches", "interface_watches")}
            )
            for axis in plain.get("axes", ())
        )
        return cls(**given)

    def struct(self, generation: int = 0) -> Any:
        """Return the ``rthyb_parameters`` of the C core.

        Raises:
            CoreError: no watched quantity has a given name.
        """
        own = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        own |= {"watch": watch_table(own.pop("watches")), "generation": generation}
        own["axis"] = [axis.mapping() for axis in own.pop("axes")]
        return ffi.new("rthyb_parameters *", own)


def _watches(plain: Mapping[str, Any]) -> dict[str, Watch]:
    return {name: Watch(**watch) for name, watch in plain.items()}


def _axis_parameters(
    config: StationConfig, axis: AxisConfig, interface: InterfaceConfig
) -> AxisParameters:
    limits = ("velocity_limit_m_per_s", "acceleration_limit_m_per_s2")
    common = {name: watch for name, watch in config.watches.items() if name in AXIS_WATCHES}
    return AxisParameters(
        watches=common if axis.watches is None else axis.watches,
        interface_watches=interface.watches,
        **axis.over(config.controller, limits),
    )


class Station:
    """States, limits and faults around the controller; raises ``CoreError``."""

    def __init__(self, config: StationConfig, ag_mps2: npt.ArrayLike) -> None:
        self.config = config
        struct = ffi.new("rthyb_station_config *", _mapping_of(config))
        self._part = fill_part(struct.controller.numerical, config.controller.numerical)
        tie = config.controller.kinematics
        self._sensors = 0 if tie is None else tie.sensors
        if len(config.sensors) not in (0, self._sensors):
            raise CoreError(
                f"found settings of {len(config.sensors)} sensors without an actuator; the "
                f"kinematics has {self._sensors} of them"
            )
        self._axes, self._dtype = (count := config.controller.axis_count), record_dtype(count)
        self._c = ffi.new("rthyb_station *")
        check(lib.rthyb_station_init(self._c, struct))
        self._ag = doubles(ag_mps2)
        self._in, self._out = ffi.new("rthyb_station_input *"), ffi.new("rthyb_station_output *")
        self._records = ffi.new("rthyb_record[]", BLIND_MAX + 1)

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
        axes: Sequence[AxisReading] = (),
        apart: int | None = None,
        sensors: Sequence[float | None] = (),
    ) -> StationTick:
        """Run one executed tick with the newest pair (before tare), or without one.

        ``taken_over_m``: together with the first valid reading, the command that the drive already
        has. ``axes`` replaces the arguments for a single axis; ``apart``: the axis whose drive's
        sample count differs by more than one from another's. ``sensors``: readings of the sensors
        without an actuator, before tare, m and N; None: there is none in this tick.

        Raises:
            CoreError: the number of readings is not that of the axes or sensors, or
                ``taken_over_m`` is given for some axes only.
        """
        one = AxisReading(x_m, f_n, lost, link_down, drive_stopped, taken_over_m)
        given = tuple(axes) or (one,)
        if len(given) != self._axes:
            raise CoreError(
                f"found {len(given)} readings; there must be one for each of the {self._axes} axes"
            )
        if len(sensors) != self._sensors:
            raise CoreError(
                f"found readings of {len(sensors)} sensors without an actuator; there must be one "
                f"for each of {self._sensors}"
            )
        taken = [a.taken_over_m is not None for a in given]
        if any(taken) and not all(taken):
            raise CoreError(
                f"taken_over_m is missing for axis {taken.index(False) + 1}; give it for all axes "
                "or for none"
            )
        i, out = self._in, self._out
        i.taken_over = any(a.taken_over_m is not None for a in given)
        for k, a in enumerate(given):
            i.axis[k] = a.mapping()
        i.sensors_lost = sum(1 << k for k, value in enumerate(sensors) if value is None)
        for k, value in enumerate(sensors):
            i.sensor[k] = 0.0 if value is None else value
        i.skipped, i.command = skipped, COMMANDS.index(command)
        i.apart = 0 if apart is None else 1 + apart
        i.heartbeat_late = heartbeat_late
        lib.rthyb_station_tick(
            self._c, i, reading(self._ag), self._ag.size, self._records, self._out
        )
        raise_pending()
        commands = tuple(out.axis[k].x_cmd_m for k in range(self._axes))
        return StationTick(
            x_cmd_m=commands[0],
            sent=bool(out.send),
            state=STATES[out.state],
            refused=bool(out.refused),
            records=copy_records(self._records, out.records, self._axes),
            commands_m=commands,
        )

    def replay(
        self,
        rows: RecordArray,
        codec: Codec | Sequence[Codec | None] | None = None,
        calibration: WireCalibration | Sequence[WireCalibration] = IDENTITY,
        parameters: Sequence[tuple[int, Parameters]] = (),
        sensors: npt.ArrayLike | None = None,
    ) -> RecordArray:
        """Return the rows that this station, which must be new, computes from recorded inputs.

        If the station has the settings and the ground motion of the recording, every byte is
        reproduced; the first row that differs, or is missing, is where recording and core diverge.
        Fields from clock and link (times, echo, count, slips) are copied.

        Args:
            rows: every row from the station's first tick on, (n,).
            codec: of the link that sent the commands; None: there was no wire, and commands were
                used as computed. One for each axis, or one for all.
            calibration: of the loop, likewise.
            parameters: every set that was published, with its generation.
            sensors: readings of the sensors without an actuator in every row, before tare, (n,
                sensors); None: there are no such sensors.

        Returns:
            The rows, (n,); fewer if the given rows do not form complete ticks.

        Raises:
            CoreError: the station has already run, or the rows are those of other axes or sensors.
        """
        if self.ticks:
            raise CoreError(
                "only a new station can replay a recording; this one has already run for "
                f"{self.ticks} ticks"
            )
        recorded = as_records(rows)
        out = np.zeros(recorded.size, dtype=self._dtype)
        sets = ffi.new("rthyb_parameters[]", len(parameters))
        for slot, (generation, one) in enumerate(parameters):
            sets[slot] = one.struct(generation)[0]
        source = ffi.new("rthyb_replay *")
        source.rows, source.count = records_pointer(recorded, self._axes), recorded.size
        ag = reading(self._ag)
        source.ag_mps2, source.ag_count = ag, self._ag.size
        codecs = list(codec) if isinstance(codec, Sequence) else [codec] * self._axes
        if isinstance(calibration, WireCalibration):
            calibration = [calibration] * self._axes
        for k in range(self._axes):
            own = codecs[k]
            source.axis[k].codec = ffi.NULL if own is None else own.struct
            source.axis[k].calibration = calibration[k].struct()[0]
        further = doubles(np.empty((recorded.size, 0)) if sensors is None else sensors)
        if further.shape != (recorded.size, self._sensors):
            raise CoreError(
                f"found readings of shape {further.shape} of sensors without an actuator; for "
                f"{recorded.size} rows it must be {(recorded.size, self._sensors)}"
            )
        read = reading(further.reshape(-1))
        source.sensors = read
        source.parameters, source.parameter_count = sets, len(parameters)
        pointer = records_pointer(out, self._axes)
        count = lib.rthyb_station_replay(self._c, source, pointer)
        raise_pending()
        return out[:count]

    @property
    def state(self) -> str:
        """Name of the current state."""
        return STATES[int(self._c.state)]

    @property
    def cause(self) -> str:
        """First cause that interrupted or ended the test, latched."""
        return CAUSES[int(self._c.cause)]

    @property
    def cause_tick(self) -> int:
        """Tick in which that cause occurred; meaningless without a cause."""
        return int(self._c.cause_tick)

    @property
    def cause_axis(self) -> int | None:
        """Axis to which it belongs, or None."""
        return None if self._c.cause_axis < 0 else int(self._c.cause_axis)

    @property
    def cause_interface(self) -> int | None:
        """Interface to which it belongs, or None."""
        return None if self._c.cause_interface < 0 else int(self._c.cause_interface)

    @property
    def cause_sensor(self) -> int | None:
        """Sensor without an actuator to which it belongs, or None."""
        return None if self._c.cause_sensor < 0 else int(self._c.cause_sensor)

    @property
    def cause_value(self) -> float:
        """Value that triggered that cause, in the unit of its watch; 0 if it has no value."""
        return float(self._c.cause_value)

    @property
    def cause_limit(self) -> float:
        """Limit at that time, in the same unit; 0 if the cause has no limit."""
        return float(self._c.cause_limit)

    @property
    def refusal(self) -> tuple[str, float, float]:
        """Watch that refused the last command or tare, with the value and the limit.

        "none" if none did.
        """
        c = self._c
        return CAUSES[int(c.refused_cause)], float(c.refused_value), float(c.refused_limit)

    @property
    def refusal_axis(self) -> int | None:
        """Axis to which that refusal belongs, or None."""
        return None if self._c.refused_axis < 0 else int(self._c.refused_axis)

    @property
    def refusal_interface(self) -> int | None:
        """Interface to which that refusal belongs, or None."""
        return None if self._c.refused_interface < 0 else int(self._c.refused_interface)

    @property
    def refusal_sensor(self) -> int | None:
        """Sensor without an actuator to which that refusal belongs, or None."""
        return None if self._c.refused_sensor < 0 else int(self._c.refused_sensor)

    @property
    def indicated(self) -> list[str]:
        """Causes that occurred and were only indicated."""
        return [name for bit, name in enumerate(CAUSES) if self._c.indicated >> bit & 1]

    @property
    def interrupted(self) -> bool:
        """Whether the test was held."""
        return bool(self._c.interrupted)

    @property
    def zeroing_failed(self) -> bool:
        """Whether the last tare was refused.

        Because of movement, `tare_too_large`, no matching pose, a sensor without an actuator that
        gives no usable reading, or a reading that is frozen. `refusal_axis` or `refusal_sensor` is
        where it is, if it is of one of them.
        """
        return int(self._c.zeroing) in (2, 3, 4, 5, 6)

    @property
    def tare_too_large(self) -> bool:
        """Whether the tare was refused because of its size; `refusal` has the figures."""
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
        """Offsets subtracted from displacement (m) and force (N) of the first axis."""
        return self.tares[0]

    @property
    def tares(self) -> tuple[tuple[float, float], ...]:
        """The same of every axis."""
        axes = self._c.axis[0 : self._axes]
        return tuple((axis.tare_x, axis.tare_f) for axis in axes)

    @property
    def sensor_tares(self) -> tuple[float, ...]:
        """Offsets subtracted from the readings of the sensors without an actuator, m and N."""
        return tuple(one.tare for one in self._c.lone[0 : self._sensors])

    @property
    def sensors_missing(self) -> tuple[int, ...]:
        """Ticks for which each sensor without an actuator has had no usable reading."""
        return tuple(int(n) for n in self._c.controller.sensor_missing[0 : self._sensors])

    @property
    def sensors_without_number(self) -> tuple[bool, ...]:
        """Whether the reading of each sensor without an actuator arrived in the last tick as no
        number.
        """
        return tuple(
            not one.lost and math.isnan(one.reading) for one in self._c.lone[0 : self._sensors]
        )

    @property
    def sensors_at_end(self) -> tuple[float | None, ...]:
        """Reading of each sensor without an actuator that is at the end of its range, or None.

        Of the last tick, m or N, before the tare.
        """
        return tuple(
            float(one.reading) if one.off_scale else None for one in self._c.lone[0 : self._sensors]
        )

    @property
    def command_tare_m(self) -> float:
        """Offset added to a command for the drive: the drive's command at the tare, m.

        For the first axis.
        """
        return float(self._c.axis[0].tare_cmd)


def command_of(flags: int) -> Command:
    """Return the operator's command in a record's flags; "none" if there was none.

    Raises:
        CoreError: no command has that number.
    """
    number = int(flags) >> COMMAND_BIT
    if not 0 <= number < len(COMMANDS):
        raise CoreError(
            f"found flags {int(flags):#x}, which contain command number {number}; no such "
            "command exists"
        )
    return COMMANDS[number]


def command_allowed(state: str, command: Command) -> bool:
    """Return whether an operator may give a command in a state."""
    code = COMMANDS.index(command)
    return bool(lib.rthyb_command_allowed(STATES.index(state), code))


def _mapping_of(config: StationConfig) -> dict[str, Any]:
    own = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    for name in ("rest_spread_m", "tare_most_m", "tare_most_n", "watches", "sensors"):
        del own[name]
    return own | {
        "controller": controller_mapping(config.controller),
        "axis": station_axes(config.controller, config),
        "interface": station_interfaces(config.controller.interfaces),
        "lone": [one.mapping() for one in config.sensors],
        "watch": watch_table(config.watches),
    }
