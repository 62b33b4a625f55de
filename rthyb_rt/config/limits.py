"""The limits of a test and the actions when they are exceeded: `[limits]` of test and rig."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Final, Literal, get_args

from pydantic import GetJsonSchemaHandler, StrictBool
from pydantic_core import CoreSchema

from rthyb_rt.config.fields import Alternatives, Count, Range, Table
from rthyb_rt.config.rate import STANDARD_HZ
from rthyb_rt.errors import Problem

Action = Literal["none", "indicate", "hold", "ramp-out", "trip"]
ACTIONS: tuple[Action, ...] = get_args(Action)
"""Actions from the weakest to the strongest."""

ENDING: tuple[Action, ...] = ("hold", "ramp-out", "trip")
"""Actions that interrupt a test."""

Source = Literal["test", "rig", "default"]

DEFAULT_PATH_VELOCITY_M_PER_S = 0.02
DEFAULT_PATH_ACCELERATION_M_PER_S2 = 0.2
DEFAULT_RAMP_IN_S = 2.0
DEFAULT_ARMED_TIMEOUT_S = 30.0
DEFAULT_TARE_S = 1.0
DEFAULT_TARE_SHARE_MOST = 0.2
LEAST_REST_SPREAD_M = 1e-4
REST_SPREAD_SIGMAS = 20
"""The noise of one second spans about 6.5 standard deviations; a creeping actuator more."""

BRAKE_MARGIN = 1.25
"""Factor on the peak acceleration of the reference. Stopping with the motion's own acceleration
needs 1; without a step in acceleration, 1.04 is needed near a turning point, and elsewhere the
margin makes up for the 16 ms that the transition takes."""

VELOCITY_MAX_M_PER_S = 100.0
"""Largest value of a limit on the velocity."""
VELOCITY_MARGIN = 2.0
"""Factor on the peak velocity of the compensated reference, the same as is recommended for the
position limit, to allow for the effect of specimen and delay estimate on the motion."""

PATH_SHARE = 0.5
"""Factor on the command's own limits: the phase lead makes the ends of a path faster."""


class Limit(Table):
    """A watched limit; a plain number is short for ``{ value = ..., action = "trip" }``."""

    plain: ClassVar[Action] = "trip"

    value: float
    enable: StrictBool = True
    action: Action = "trip"

    @classmethod
    def expand(cls, data: Any) -> Any:
        """Accept a bare value instead of the table."""
        # Also a list, so that the message explains a limit instead of a table.
        bare = isinstance(data, (int, float, str, list))
        return {"value": data, "action": cls.plain} if bare else data

    @property
    def acts(self) -> bool:
        """Whether exceeding the limit has any effect."""
        return self.enable and self.action != "none"

    @property
    def ends(self) -> bool:
        """Whether exceeding the limit interrupts the test."""
        return self.enable and self.action in ENDING

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe the table, and the bare value that may replace it."""
        given = handler(schema)
        described = handler.resolve_ref_schema(given)
        table = dict(described)
        described.clear()
        described.update({"anyOf": [table["properties"]["value"], table]})
        return given


class DisplacementLimit(Limit):
    """A limit on a displacement."""

    value: Annotated[float, Range("m", 1e-6, 100, "the limit")]


class IncrementLimit(Limit):
    """A limit on the change of a displacement in one sample of 1/1024 s."""

    value: Annotated[float, Range("m", 1e-9, 100, "the limit")]


class VelocityLimit(Limit):
    """A limit on the command's velocity: the command is limited, and the action follows as well."""

    plain: ClassVar[Action] = "none"

    value: Annotated[float, Range("m/s", 1e-6, VELOCITY_MAX_M_PER_S, "the limit")]


class ForceLimit(Limit):
    """A limit on a force."""

    value: Annotated[float, Range("N", 1e-3, 1e10, "the limit")]


class SlopeLimit(Limit):
    """A limit on the slope of the tracking indicator."""

    value: Annotated[float, Range("m^2/s", 1e-12, 1e4, "the limit")]


class EnergyLimit(Limit):
    """A limit on an energy."""

    value: Annotated[float, Range("J", 1e-9, 1e12, "the limit")]


class TimeLimit(Limit):
    """A limit on a time."""

    value: Annotated[float, Range("s", 1e-3, 60, "the limit")]


class SampleLimit(Limit):
    """A time as a number of samples of 1/1024 s."""

    value: Annotated[int, Count(2, 1024 * 60, "the number of samples")]

    def in_seconds(self) -> TimeLimit:
        """Return the same limit in seconds."""
        seconds = self.value / STANDARD_HZ
        return TimeLimit(value=seconds, action=self.action, enable=self.enable)


class StepLimit(Limit):
    """A limit on the change of a force in one sample of 1/1024 s."""

    value: Annotated[float, Range("N", 1e-3, 1e10, "the limit")]


class ShareLimit(Limit):
    """A limit on a share of the ticks of the last second."""

    plain: ClassVar[Action] = "ramp-out"

    value: Annotated[float, Range("", 1 / 1024, 1, "the share of ticks in the last second")]


class WarningLimit(ShareLimit):
    """The share above which a warning is given."""

    plain: ClassVar[Action] = "indicate"


IN_SAMPLES: Final = {
    "sensor_stuck_s": "sensor_stuck_samples",
    "force_stuck_s": "force_stuck_samples",
}
"""Limits on a time, with the deprecated keys that count it in samples of 1/1024 s."""


class Limits(Table):
    """Limits of a test; in a rig file: limits that every test on the rig must keep.

    The command is limited to its velocity and acceleration limits. The keys below them are plain
    figures of ramps, HOLD and zeroing.
    """

    choices: ClassVar[tuple[Alternatives, ...]] = tuple(
        Alternatives((key, old), required=False) for key, old in IN_SAMPLES.items()
    )

    command_position_m: DisplacementLimit | None = None
    command_velocity_m_per_s: VelocityLimit | None = None
    command_acceleration_m_per_s2: (
        Annotated[float, Range("m/s^2", 1e-3, 1e6, "the command's acceleration limit")] | None
    ) = None
    command_increment_m: IncrementLimit | None = None
    force_n: ForceLimit | None = None
    tracking_error_m: DisplacementLimit | None = None
    tracking_indicator_slope_m2_per_s: SlopeLimit | None = None
    energy_error_j: EnergyLimit | None = None
    sensor_stuck_s: TimeLimit | None = None
    sensor_stuck_samples: SampleLimit | None = None
    sensor_jump_m: IncrementLimit | None = None
    force_stuck_s: TimeLimit | None = None
    force_stuck_samples: SampleLimit | None = None
    force_jump_n: StepLimit | None = None
    lost_pairs_share: ShareLimit | None = None
    lost_pairs_warning_share: WarningLimit | None = None
    skipped_ticks_share: ShareLimit | None = None
    skipped_ticks_warning_share: WarningLimit | None = None
    path_velocity_m_per_s: (
        Annotated[float, Range("m/s", 1e-7, 100, "the velocity of ramp-out and resume")] | None
    ) = None
    path_acceleration_m_per_s2: (
        Annotated[float, Range("m/s^2", 1e-4, 1e4, "the acceleration of ramps and resume")] | None
    ) = None
    brake_acceleration_m_per_s2: (
        Annotated[float, Range("m/s^2", 1e-4, 1e4, "the deceleration of HOLD and ramp-out")] | None
    ) = None
    ramp_in_s: Annotated[float, Range("s", 0.01, 600, "the duration of the ramp-in")] | None = None
    armed_timeout_s: Annotated[float, Range("s", 1, 3600, "the timeout of ARMED")] | None = None
    tare_s: Annotated[float, Range("s", 0.01, 60, "the averaging time of zeroing")] | None = None
    rest_spread_m: (
        Annotated[float, Range("m", 1e-9, 10, "the movement at rest that zeroing tolerates")] | None
    ) = None
    tare_share_most: (
        Annotated[float, Range("", 1e-3, 1, "the tare as a share of the rig's limit")] | None
    ) = None

    @functools.cached_property
    def counted(self) -> set[str]:
        """Keys whose time the file counts in samples; files that differ only there are equal."""
        return set()

    def settle(self) -> None:
        """Write times that the file counts in samples in seconds."""
        for key, old in IN_SAMPLES.items():
            given: SampleLimit | None = getattr(self, old)
            if given is not None:
                self.__dict__.update({key: given.in_seconds(), old: None})
                self.counted.add(key)

    def as_written(self, key: str) -> str:
        """Return the key under which the file gives a limit."""
        return IN_SAMPLES[key] if key in self.counted else key

    def deprecated(self) -> list[str]:
        """Return a note on each deprecated key of the file, with its replacement."""
        return [
            f"limits.{old} is deprecated: write {key} = {getattr(self, key).value:.10g}, in s"
            for key, old in IN_SAMPLES.items()
            if self.as_written(key) == old
        ]


WATCHED: tuple[str, ...] = (
    "command_position_m",
    "command_velocity_m_per_s",
    "command_increment_m",
    "force_n",
    "tracking_error_m",
    "tracking_indicator_slope_m2_per_s",
    "energy_error_j",
    "sensor_stuck_s",
    "sensor_jump_m",
    "force_stuck_s",
    "force_jump_n",
    "lost_pairs_share",
    "lost_pairs_warning_share",
    "skipped_ticks_share",
    "skipped_ticks_warning_share",
)
"""The keys whose value is a `Limit`."""

BEFORE_TARE: tuple[str, ...] = ("command_position_m", "force_n")
"""Keys that apply before the tare in a rig file, and after the tare in a test file."""

AT_LEAST: tuple[str, ...] = ("ramp_in_s", "tare_s")
"""Figures that a test may raise above those of its rig, but not lower."""


@dataclass(frozen=True)
class Resolved:
    """The limits that actually apply to a test on a rig.

    Attributes:
        limits: limits of both files combined; the figures of paths and zeroing are always present.
        sources: origin of each key that is present.
        path_velocity_m_per_s ... tare_share_most: those figures.
        brake_acceleration_m_per_s2: deceleration of HOLD and ramp-out; None: no file gives it, and
            there is no reference simulation yet to derive it from.
        derived: limits that no file gives, by key, derived from sensors and test. They take effect
            on a real rig, and only indicate in virtual time.
    """

    limits: Limits
    sources: dict[str, Source]
    path_velocity_m_per_s: float
    path_acceleration_m_per_s2: float
    ramp_in_s: float
    armed_timeout_s: float
    tare_s: float
    rest_spread_m: float
    tare_share_most: float
    brake_acceleration_m_per_s2: float | None = None
    derived: Mapping[str, Limit] = field(default_factory=dict)


def unit_of(key: str) -> str:
    """Return the unit of a key of `Limits`."""
    for suffix, unit in _UNITS.items():
        if key.endswith(suffix):
            return unit
    raise KeyError(key)


_UNITS = {
    "_share": "of 1",
    "_most": "of 1",
    "_m2_per_s": "m^2/s",
    "_m_per_s2": "m/s^2",
    "_m_per_s": "m/s",
    "_m": "m",
    "_n": "N",
    "_j": "J",
    "_s": "s",
}


def resolve(
    test: Limits, rig: Limits, rig_name: str, rest_noise_m: float, problems: list[Problem]
) -> Resolved:
    """Combine the limits of a test with those of its rig, and fill in defaults.

    Args:
        test, rig: the tables of both files.
        rig_name: name of the rig for messages.
        rest_noise_m: noise of the displacement at rest.
        problems: receives every limit of the test that is weaker than the rig's.
    """
    merged: dict[str, Any] = {}
    sources: dict[str, Source] = {}
    for key in Limits.model_fields:
        own, bound = getattr(test, key), getattr(rig, key)
        if own is not None:
            # A limit of the test that repeats the rig's belongs to the rig, as in a resolved test.
            repeated = key in BEFORE_TARE and own == bound
            merged[key], sources[key] = own, "rig" if repeated else "test"
            where = f"limits.{test.as_written(key)}"
            problems += [replace(one, where=where) for one in _weaker(key, own, bound, rig_name)]
        elif bound is not None:
            merged[key], sources[key] = bound, "rig"
    limits = Limits.model_construct(**merged)
    figures: dict[str, Any] = _figures(limits, sources, rest_noise_m, problems)
    for key in figures:
        sources.setdefault(key, "default")
    return Resolved(limits.model_copy(update=figures), sources, **figures)


def looser(given: Limits, bound: Limits) -> list[str]:
    """Return the keys in which limits are missing, or allow more than the others do."""
    found = []
    for key in Limits.model_fields:
        own, theirs = getattr(given, key), getattr(bound, key)
        if own is None:
            lacking = theirs is not None and (not isinstance(theirs, Limit) or _binds(theirs))
        else:
            lacking = any(_weaker(key, own, theirs, ""))
        if lacking:
            found.append(key)
    return found


def _binds(limit: Limit) -> bool:
    """Whether it limits the command, or exceeding it has any effect."""
    return limit.acts or (isinstance(limit, VelocityLimit) and limit.enable)


def _weaker(key: str, own: Any, bound: Any, rig_name: str) -> Iterator[Problem]:
    """Report every way in which a test's limit allows more than its rig's."""
    if isinstance(own, Limit):
        yield from _weaker_limit(key, own, bound, rig_name)
        return
    if bound is None:
        return
    at_least = key in AT_LEAST
    if own < bound if at_least else own > bound:
        unit = unit_of(key)
        yield Problem(
            f"limits.{key}",
            f'found {own:g} {unit}; rig "{rig_name}" has limits.{key} = {bound:g} {unit}, '
            f"{'at least' if at_least else 'at most'}; remove the key from the test to use the "
            "rig's",
        )


def _weaker_limit(key: str, own: Limit, bound: Limit | None, rig_name: str) -> Iterator[Problem]:
    if bound is None or not _binds(bound):
        return
    unit = unit_of(key)
    allowed = f'rig "{rig_name}" has limits.{key} = {bound.value:g} {unit}, action '
    remedy = "remove the key from the test to use the rig's"
    stronger = " or a stronger one" if bound.action != ACTIONS[-1] else ""
    if own.value > bound.value:
        yield Problem(
            f"limits.{key}",
            f'found {own.value:g} {unit}; {allowed}"{bound.action}", and a test may not allow '
            f"more; {remedy}",
        )
    found = f'action "{own.action}"' if own.enable else "enable = false"
    if not own.enable or ACTIONS.index(own.action) < ACTIONS.index(bound.action):
        yield Problem(
            f"limits.{key}",
            f'found {found}; {allowed}"{bound.action}", and a test may not weaken it; use that '
            f"action{stronger}, or {remedy}",
        )


def _figures(
    limits: Limits, sources: dict[str, Source], rest_noise_m: float, problems: list[Problem]
) -> dict[str, Any]:
    """Return the figures of paths and zeroing, and that of the brake if a file gives it."""
    velocity, increment = limits.command_velocity_m_per_s, limits.command_increment_m
    fastest = list[tuple[str, float]]()
    if velocity is not None and velocity.enable:
        name = f"limits.command_velocity_m_per_s = {velocity.value:g} m/s"
        fastest.append((name, velocity.value))
    if increment is not None and increment.acts:
        name = f"limits.command_increment_m = {increment.value:g} m"
        fastest.append((name, increment.value * STANDARD_HZ))
    hardest = _hardest(limits)
    figures = {
        "path_velocity_m_per_s": _path_figure(
            limits,
            "path_velocity_m_per_s",
            DEFAULT_PATH_VELOCITY_M_PER_S,
            fastest,
            sources,
            problems,
        ),
        "path_acceleration_m_per_s2": _path_figure(
            limits,
            "path_acceleration_m_per_s2",
            DEFAULT_PATH_ACCELERATION_M_PER_S2,
            hardest,
            sources,
            problems,
        ),
        "ramp_in_s": _given(limits.ramp_in_s, DEFAULT_RAMP_IN_S),
        "armed_timeout_s": _given(limits.armed_timeout_s, DEFAULT_ARMED_TIMEOUT_S),
        "tare_s": _given(limits.tare_s, DEFAULT_TARE_S),
        "rest_spread_m": _given(
            limits.rest_spread_m, max(LEAST_REST_SPREAD_M, REST_SPREAD_SIGMAS * rest_noise_m)
        ),
        "tare_share_most": _given(limits.tare_share_most, DEFAULT_TARE_SHARE_MOST),
    }
    if limits.brake_acceleration_m_per_s2 is not None:
        key = "brake_acceleration_m_per_s2"
        figures[key] = _path_figure(limits, key, math.inf, hardest, sources, problems)
    return figures


def _hardest(limits: Limits) -> list[tuple[str, float]]:
    """Return the limits that bound the acceleration of a path, by name."""
    acceleration = limits.command_acceleration_m_per_s2
    if acceleration is None:
        return []
    return [(f"limits.command_acceleration_m_per_s2 = {acceleration:g} m/s^2", acceleration)]


def with_reference(resolved: Resolved, peak_m_per_s: float, peak_m_per_s2: float) -> Resolved:
    """Fill in what is derived from the reference simulation and not given in a file.

    Args:
        resolved: the limits of test and rig.
        peak_m_per_s: peak velocity of the reference after the phase lead.
        peak_m_per_s2: peak acceleration of the reference.
    """
    if resolved.brake_acceleration_m_per_s2 is None:
        own = max(BRAKE_MARGIN * peak_m_per_s2, resolved.path_acceleration_m_per_s2)
        brake = min([own, *(PATH_SHARE * bound for _, bound in _hardest(resolved.limits))])
        key = "brake_acceleration_m_per_s2"
        resolved = replace(
            resolved,
            limits=resolved.limits.model_copy(update={key: brake}),
            sources={**resolved.sources, key: "default"},
            brake_acceleration_m_per_s2=brake,
        )
    if resolved.limits.command_velocity_m_per_s is None:
        least = resolved.path_velocity_m_per_s / PATH_SHARE
        limit = VelocityLimit(value=max(VELOCITY_MARGIN * peak_m_per_s, least), action="none")
        derived = {**resolved.derived, "command_velocity_m_per_s": limit}
        resolved = replace(resolved, derived=derived)
    return resolved


def _given(value: float | None, default: float) -> float:
    return default if value is None else value


def _path_figure(
    limits: Limits,
    key: str,
    default: float,
    bounds: list[tuple[str, float]],
    sources: dict[str, Source],
    problems: list[Problem],
) -> float:
    """Return the test's figure, else the rig's, else the default if command limits permit it."""
    value: float | None = getattr(limits, key)
    if sources.get(key) == "test" and value is not None:
        for name, bound in bounds:
            if value > bound:
                unit = unit_of(key)
                problems.append(
                    Problem(
                        f"limits.{key}",
                        f"found {value:g} {unit}; {name} allows the command at most {bound:g} "
                        f"{unit}; lower this limit of the path, or remove it",
                    )
                )
        return value
    return min([_given(value, default), *(PATH_SHARE * bound for _, bound in bounds)])
