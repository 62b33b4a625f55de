"""Several axes at one specimen: settings of each axis, and those that they share."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Literal, cast

import numpy as np

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.kinematics import AXES_MAX, Kinematics
from rthyb_rt.core.library import CoreError, options, words
from rthyb_rt.core.matrix_lead import MatrixInverse, MatrixLeadConfig
from rthyb_rt.core.matrix_rfc import MatrixRfcConfig
from rthyb_rt.core.rows import Channel
from rthyb_rt.core.settings import LawConfig, RfcConfig, mapping

if TYPE_CHECKING:
    from rthyb_rt.core.settings import ControllerConfig

Reaction = Literal["none", "indicate", "hold", "ramp-out", "trip"]

# The header has the names. What the type checker knows of them stands above; a test holds the two
# together.
REACTIONS: Final = cast(tuple[Reaction, ...], tuple(options("rthyb_reaction", "RTHYB_REACT_")))
CAUSES: Final = tuple(words("rthyb_cause", "RTHYB_CAUSE_"))
WATCHABLE: Final = CAUSES[CAUSES.index("skips") : CAUSES.index("apart")]
DISAGREE: Final = ("sensor_disagrees", "force_disagrees")
"""Watches of a displacement and of a force that differ from what the other sensors imply."""
AXIS_WATCHES: Final = (
    *(
        name
        for name in WATCHABLE[WATCHABLE.index("sensor_stuck") :]
        if name not in ("indicator", "energy")
    ),
    *DISAGREE,
)
"""Quantities for which an axis may have limits of its own."""
INTERFACE_WATCHES: Final = ("position", "force")
_CONTROL: Final = (
    *("x_range_m", "f_range_n", "velocity_limit_m_per_s", "acceleration_limit_m_per_s2"),
    "clamp_m",
)
_ALLOWANCES: Final = ("x_allowance", "f_allowance")
_STATION: Final = ("rest_spread_m", "tare_most_m", "tare_most_n")


@dataclass(frozen=True)
class Watch:
    """The action that follows when a watched quantity exceeds ``value``; 0: not watched."""

    value: float
    reaction: Reaction


@dataclass(frozen=True)
class Allowance:
    """By how much a reading may differ from what it measures.

    The larger of ``share`` times the largest value that the other sensors of its kind have implied
    since the tare, and ``least``, m or N. ``grows``: the limit on the disagreement of this reading
    is the value of its watch plus these allowances of it and of those that it is compared with.
    """

    share: float = 0.0
    least: float = 0.0
    grows: bool = False


@dataclass(frozen=True)
class AxisConfig:
    """One of several axes; None: the setting of the controller, or of the station, applies.

    ``watches`` by cause, `AXIS_WATCHES`, replaces all watches of the station that belong to an
    axis, and adds those of `DISAGREE`. ZERO is refused after ``x_frozen_ticks`` equal readings in a
    row of the displacement sensor, or ``f_frozen_ticks`` of the load cell; None: never. The other
    settings are as in ``ControllerConfig`` and ``StationConfig``.
    """

    name: str = ""
    law: LawConfig | None = None
    x_range_m: float | None = None
    f_range_n: float | None = None
    velocity_limit_m_per_s: float | None = None
    acceleration_limit_m_per_s2: float | None = None
    clamp_m: float | None = None
    rest_spread_m: float | None = None
    tare_most_m: float | None = None
    tare_most_n: float | None = None
    x_frozen_ticks: int | None = None
    f_frozen_ticks: int | None = None
    x_allowance: Allowance | None = None
    f_allowance: Allowance | None = None
    watches: Mapping[str, Watch] | None = None

    def over(self, common: Any, names: Sequence[str]) -> dict[str, float]:
        """Return settings by name: the axis' own, or else those of ``common``."""
        own = {name: getattr(self, name) for name in names}
        return {k: getattr(common, k) if v is None else v for k, v in own.items()}


@dataclass(frozen=True)
class InterfaceConfig:
    """One of several directions in which numerical part and axes are connected.

    ``rfc`` None: the controller's. ``watches``: ``position`` of the command, in m or rad, and
    ``force``, in N or N m.
    """

    name: str = ""
    rfc: RfcConfig | None = None
    watches: Mapping[str, Watch] = field(default_factory=dict)


@dataclass(frozen=True)
class SensorWatches:
    """A sensor without an actuator; values before tare, in m or N.

    ``range``: a reading at or beyond it is not used; 0: none. ``stuck``: ticks for which a reading
    may be repeated while the command moves. ``jump``: change from one reading to the next.
    ``disagreement``: difference from what the other sensors of its kind imply, with ``allowance``.
    ZERO is
    refused if the reading varies by more than ``rest_spread``, if the tare exceeds ``tare_most``,
    or after ``frozen_ticks`` equal readings in a row; 0: no limit.
    """

    name: str = ""
    range: float = 0.0
    stuck: Watch | None = None
    jump: Watch | None = None
    rest_spread: float = 0.0
    tare_most: float = 0.0
    frozen_ticks: int = 0
    disagreement: Watch | None = None
    allowance: Allowance = Allowance()

    def mapping(self) -> dict[str, Any]:
        """Return the ``rthyb_lone_config`` of the C core."""
        return {
            "range": self.range,
            "rest_spread": self.rest_spread,
            "tare_most": self.tare_most,
            "frozen_ticks": self.frozen_ticks,
            "allowance": dataclasses.asdict(self.allowance),
            **{
                name: (0.0, 0) if watch is None else _watch(watch)
                for name, watch in ((name, getattr(self, name)) for name in _WATCHES)
            },
        }

    @classmethod
    def of(cls, plain: Mapping[str, Any]) -> SensorWatches:
        """Return the settings from `dataclasses.asdict`."""
        given = dict(plain)
        for name in _WATCHES:
            given[name] = None if given.get(name) is None else Watch(**given[name])
        given["allowance"] = Allowance(**given.get("allowance", {}))
        return cls(**given)


_WATCHES: Final = ("stuck", "jump", "disagreement")


def sensor_channels(sensors: Sequence[tuple[str, str]]) -> tuple[Channel, ...]:
    """Return the channels of sensors without an actuator.

    They are consecutive channels of a row, in this order, from ``StationConfig.lone_channel`` on.

    Args:
        sensors: name and unit of each: displacements, then forces.

    Returns:
        The value used of each, after the tare, measured or predicted; then each as read, before the
        tare, nan if nothing was, with ``_read`` after its name.
    """
    used = [Channel(name, unit) for name, unit in sensors]
    return (*used, *(Channel(f"{name}_read", unit) for name, unit in sensors))


def names_of(given: Sequence[AxisConfig | InterfaceConfig]) -> tuple[str, ...]:
    """Return the names of axes or interfaces; without a name, their number from 1."""
    return tuple(one.name or str(k + 1) for k, one in enumerate(given))


def controller_mapping(config: ControllerConfig) -> dict[str, Any]:
    """Return the ``rthyb_controller_config`` of the C core as a mapping, without numerical part.

    Raises:
        CoreError: axes, interfaces and the parts that they share differ in number.
    """
    axes, interfaces = config.axes or (AxisConfig(),), config.interfaces or (InterfaceConfig(),)
    _require_counts(config, len(axes), len(interfaces))
    plain: dict[str, Any] = {
        "period_s": config.period_s,
        "axis_count": len(axes),
        "interface_count": len(interfaces),
        "lead_enabled": config.lead_enabled,
        "motion": mapping(config.motion),
        "axis": [
            axis.over(config, _CONTROL) | {"law": (axis.law or config.law).mapping()}
            for axis in axes
        ],
        "rfc": [mapping(one.rfc or config.rfc) for one in interfaces],
    }
    if config.kinematics is not None:
        plain["kinematics"] = config.kinematics.struct.cfg
    if config.matrix_lead is not None:
        plain["matrix_lead"] = config.matrix_lead.struct()[0]
    if config.matrix_rfc is not None:
        plain["matrix_rfc"] = config.matrix_rfc.struct()[0]
    return plain


def _require_counts(config: ControllerConfig, axes: int, interfaces: int) -> None:
    tie = config.kinematics
    directions = tie.directions if tie else axes
    parts = {
        "interfaces": (interfaces, directions),
        "kinematics": (tie.size if tie else axes, axes),
        "matrix lead": (config.matrix_lead.size if config.matrix_lead else axes, axes),
        "matrix RFC": (config.matrix_rfc.size if config.matrix_rfc else directions, directions),
    }
    wrong = [f"{name} for {count}" for name, (count, asked) in parts.items() if count != asked]
    if wrong or axes > AXES_MAX:
        raise CoreError(
            f"found {axes} axes, {', '.join(wrong) or 'too many'}; 1 to {AXES_MAX} axes are "
            "allowed, with one interface for each column of the kinematics' matrix (otherwise for "
            "each axis), and everything that they share must have the same size"
        )
    if config.matrix_lead is not None and directions < axes:
        raise CoreError(
            f"found a matrix lead for {axes} axes that hold {directions} directions; the axes of "
            "redundant actuators do not move independently, which leaves its matrices "
            "undetermined: give each axis a law of its own"
        )
    doubled = [
        name
        for given in (names_of(config.axes), names_of(config.interfaces))
        for name in given
        if given.count(name) > 1
    ]
    if doubled:
        raise CoreError(
            f"found two axes or two interfaces with the name {doubled[0]!r}; each needs its own "
            "name"
        )


def station_axes(config: ControllerConfig, common: Any) -> list[dict[str, Any]]:
    """Return the ``rthyb_axis_config`` of each axis; ``common``: the ``StationConfig``.

    Raises:
        CoreError: no watched quantity of an axis has a given name.
    """
    found = []
    for axis in config.axes or (AxisConfig(),):
        watches = watch_table(axis.watches or {}, AXIS_WATCHES)
        found.append(
            axis.over(config, ("x_range_m", "f_range_n"))
            | axis.over(common, _STATION)
            | {"own_watches": axis.watches is not None, "watch": watches}
            | {name: getattr(axis, name) or 0 for name in ("x_frozen_ticks", "f_frozen_ticks")}
            | {name: dataclasses.asdict(getattr(axis, name) or Allowance()) for name in _ALLOWANCES}
        )
    return found


def station_interfaces(interfaces: Sequence[InterfaceConfig]) -> list[dict[str, Any]]:
    """Return the ``rthyb_interface_config`` of each interface.

    Raises:
        CoreError: no watched quantity has a given name.
    """
    found = []
    for one in interfaces:
        watch_table(one.watches, INTERFACE_WATCHES)
        found.append({name: _watch(watch) for name, watch in one.watches.items()})
    return found


def _watch(watch: Watch) -> tuple[float, int]:
    return watch.value, REACTIONS.index(watch.reaction)


def watch_table(
    watches: Mapping[str, Watch], known: Sequence[str] = WATCHABLE
) -> list[tuple[float, int]]:
    """Return the table of watches, by the number of the cause.

    Raises:
        CoreError: no watched quantity has a given name.
    """
    unknown = set(watches) - set(known)
    if unknown:
        raise CoreError(
            f"no quantity to watch is called {', '.join(sorted(unknown))}; allowed are "
            f"{', '.join(CAUSES)}"
        )
    off = (0.0, 0)
    return [_watch(watches[name]) if name in watches else off for name in CAUSES]


def axis_channels(config: ControllerConfig, turns: Sequence[bool] = ()) -> tuple[Channel, ...]:
    """Return the channels for the values of axes and interfaces that the record has no fields for.

    They are consecutive channels of a row, in this order, from ``StationConfig.axis_channel`` on.

    Args:
        config: settings of the controller.
        turns: which interfaces are rotations; empty: none.
    """
    found = []
    for j in range(1, config.interface_count):
        x, k = ("rad", "N m/rad") if turns and turns[j] else ("m", "N/m")
        found += [Channel(f"x_num_m_{j}", x), Channel(f"k_t_n_per_m_{j}", k)]
    for i in range(1, config.axis_count):
        found += [
            Channel(f"x_plc_m_{i}", "m"),
            Channel(f"alpha_{i}", "samples"),
            Channel(f"beta_{i}", "samples^2"),
        ]
    return tuple(found)


# ---- saved and restored --------------------------------------------------------------------------

GROUP: Final = ("axes", "interfaces", "kinematics", "matrix_lead", "matrix_rfc")


def group_plain(config: ControllerConfig) -> dict[str, Any]:
    """Return the settings of several axes as plain values; empty for a controller of one axis."""
    plain: dict[str, Any] = {}
    for name in ("axes", "interfaces"):
        if getattr(config, name):
            plain[name] = [_given(one) for one in getattr(config, name)]
    if config.kinematics is not None:
        plain["kinematics"] = config.kinematics.plain()
    for name in ("matrix_lead", "matrix_rfc"):
        if getattr(config, name) is not None:
            plain[name] = _lists(_shallow(getattr(config, name)))
    return plain


def group_of(plain: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings from `group_plain`; unknown keys raise the dataclasses' errors."""
    found: dict[str, Any] = {}
    if "axes" in plain:
        found["axes"] = tuple(_axis(one) for one in plain["axes"])
    if "interfaces" in plain:
        found["interfaces"] = tuple(_interface(one) for one in plain["interfaces"])
    if "kinematics" in plain:
        found["kinematics"] = Kinematics.of(plain["kinematics"])
    if "matrix_lead" in plain:
        lead = dict(plain["matrix_lead"])
        if lead.get("inverse"):
            inverse = lead["inverse"]
            lead["inverse"] = MatrixInverse(
                tuple(inverse["pole_hz"]), np.array(inverse["coefficients"])
            )
        first = lead.get("first")
        lead["first"] = None if first is None else np.array(first)
        lead["rest_noise_m"] = tuple(lead["rest_noise_m"])
        found["matrix_lead"] = MatrixLeadConfig(**lead)
    if "matrix_rfc" in plain:
        rfc = dict(plain["matrix_rfc"])
        rfc |= {"k_e": np.array(rfc["k_e"]), "rest_noise": tuple(rfc["rest_noise"])}
        found["matrix_rfc"] = MatrixRfcConfig(**rfc)
    return found


def bare(config: ControllerConfig) -> ControllerConfig:
    """Return a controller's settings without those of its individual axes."""
    return replace(
        config, axes=(), interfaces=(), kinematics=None, matrix_lead=None, matrix_rfc=None
    )


def _shallow(config: Any) -> dict[str, Any]:
    return {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}


def _lists(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return value.tolist()
    if dataclasses.is_dataclass(value):
        value = _shallow(value)
    if isinstance(value, dict):
        return {name: _lists(one) for name, one in value.items()}
    return [_lists(one) for one in value] if isinstance(value, (list, tuple)) else value


def _given(one: AxisConfig | InterfaceConfig) -> dict[str, Any]:
    plain = dataclasses.asdict(one)
    return {name: value for name, value in plain.items() if value is not None}


def _watches(plain: dict[str, Any]) -> dict[str, Any]:
    if "watches" in plain:
        plain["watches"] = {name: Watch(**watch) for name, watch in plain["watches"].items()}
    return plain


def _axis(plain: Mapping[str, Any]) -> AxisConfig:
    given = _watches(dict(plain))
    if "law" in given:
        given["law"] = LawConfig(**given["law"])
    for name in _ALLOWANCES:
        if name in given:
            given[name] = Allowance(**given[name])
    return AxisConfig(**given)


def _interface(plain: Mapping[str, Any]) -> InterfaceConfig:
    given = _watches(dict(plain))
    if "rfc" in given:
        given["rfc"] = RfcConfig(**given["rfc"])
    return InterfaceConfig(**given)


def plant_of(rig: Any) -> Any:
    """Return the ``rthyb_plant`` of a virtual rig, which the caller keeps alive."""
    kind = ffi.typeof(rig._c).item.cname
    number = {"rthyb_rig": lib.RTHYB_PLANT_RIG, "rthyb_coupled_rig": lib.RTHYB_PLANT_COUPLED_RIG}
    if kind not in number:
        raise CoreError(f"{type(rig).__name__} is not a virtual rig")
    return ffi.new("rthyb_plant *", (number[kind], rig._c))
