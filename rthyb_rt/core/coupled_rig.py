"""A virtual rig of several axes at one specimen (``csrc/coupled_rig.c``)."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.coupled_plant import run_rows
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.core.library import CoreError, FloatArray, check, doubles, reading, writing
from rthyb_rt.core.rows import CHANNELS_MAX
from rthyb_rt.core.settings import (
    EXTRAS_MAX,
    ElementConfig,
    ExtraSensorConfig,
    LoadCell,
    SensorConfig,
    ServoConfig,
    fill_extras,
    init_element,
    mapping,
)
from rthyb_rt.core.sizes import ELEMENTS_MAX, PERIOD_S

if TYPE_CHECKING:
    from rthyb_rt.core.station import Station

STATES_MAX: Final = int(lib.RTHYB_PLANT_STATES)
_HALVINGS: Final = 20
_TERMS: Final = 18


@dataclass(frozen=True, eq=False)
class StateSpace:
    """Actuators and specimen as one linear plant, s' = a s + b u, x = c s, with u held.

    Attributes:
        a, b, c: (states, states), (states, axes), (axes, states); time in s, u and x in m.
        stroke_m: largest command in either direction, one per axis.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    stroke_m: tuple[float, ...]

    def mapping(self, period_s: float) -> dict[str, Any]:
        """Return the members of the C struct, with u held over a period, s.

        Raises:
            CoreError: the shapes are inconsistent, there are too many states, or the plant has
                direct feedthrough.
        """
        states, axes = len(self.a), len(self.stroke_m)
        shapes = {"a": (states, states), "b": (states, axes), "c": (axes, states)}
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape or not 1 <= states <= STATES_MAX:
                raise CoreError(
                    f"{name}: found shape {np.shape(getattr(self, name))}; for a plant with "
                    f"{states} states (1 to {STATES_MAX}) and {axes} axes it must be {shape}"
                )
        a, b, c = (np.asarray(v, np.float64) for v in (self.a, self.b, self.c))
        step = held_step(a, b, period_s)
        return {
            "states": states,
            "a": step[:states, :states].tolist(),
            "b": step[:states, states:].tolist(),
            "x_of": c.tolist(),
            "v_of": (c @ a).tolist(),
            "a_of": (c @ a @ a).tolist(),
            "v_by": (c @ b).tolist(),
            "a_by": (c @ a @ b).tolist(),
            "stroke_m": list(self.stroke_m),
        }


def held_step(a: FloatArray, b: FloatArray, period_s: float) -> FloatArray:
    """Return exp of [[a, b], [0, 0]] times a period: the step with a held input; square.

    Raises:
        CoreError: a number in it is not finite.
    """
    n, width = b.shape
    z = np.zeros((n + width, n + width))
    z[:n, :n], z[:n, n:] = a * period_s, b * period_s
    if not np.isfinite(z).all():
        raise CoreError("the matrices of the plant contain a number that is not finite")
    z = z * 0.5**_HALVINGS
    # exp - 1 is squared repeatedly: adding the 1 would lose the digits of a small part.
    less = np.zeros_like(z)
    for term in range(_TERMS, 0, -1):
        less = z @ (np.eye(n + width) + less) / term
    for _ in range(_HALVINGS):
        less = 2.0 * less + less @ less
    if not np.isfinite(less).all():
        raise CoreError(
            "the state of the plant exceeds all bounds within one sample; check the units of "
            "its matrices"
        )
    return np.asarray(np.eye(n + width) + less)


@dataclass(frozen=True, eq=False)
class CoupledRigConfig:
    """A virtual rig of several axes: actuators or a plant, specimen, sensors.

    Attributes:
        kinematics: kinematics of the axes; the settings are copied.
        stiffness, damping, mass: of the specimen along the interface, symmetric, (directions,
            directions); in N/m, N s/m and kg for directions in m, with moments and angles for
            rotations.
        attachment_n_per_m: with more axes than directions: stiffness of each actuator's attachment
            to the specimen, N/m; what an axis deviates from the common pose, times this, is the
            force by which it opposes the others.
        servos: one per axis, of any kind but servo-valve; none if there is a plant.
        plant: replaces the servos.
        elements: elements of the specimen, each with the number of its direction.
        displacement, force: sensors, one per axis.
        load_cell: position of the load cells; a plant has only the specimen's forces.
        seed: seed of the noise.
        period_s: sampling period.
        extras: further sensors of each axis, which measure along it; none: no axis has any.
        sensors: errors of the sensors without an actuator, as many as ``kinematics`` has:
            displacements, then forces; none: without errors.
        through: for each of them the axis and the number of its extra sensor that gives the same
            reading, or None; none: no extra sensor does.
    """

    kinematics: Kinematics
    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    servos: tuple[ServoConfig, ...] = ()
    plant: StateSpace | None = None
    elements: tuple[tuple[int, ElementConfig], ...] = ()
    displacement: tuple[SensorConfig, ...] = field(default_factory=tuple)
    force: tuple[SensorConfig, ...] = field(default_factory=tuple)
    load_cell: LoadCell = "actuator-end"
    seed: int = 0
    period_s: float = PERIOD_S
    attachment_n_per_m: float = 0.0
    extras: tuple[tuple[ExtraSensorConfig, ...], ...] = ()
    sensors: tuple[SensorConfig, ...] = ()
    through: tuple[tuple[int, int] | None, ...] = ()

    @property
    def axes(self) -> int:
        """Number of axes."""
        return self.kinematics.size

    def struct(self) -> Any:
        """Return the C struct; raises ``CoreError`` for inconsistent shapes or counts."""
        n = self.axes
        self._check_counts()
        struct = ffi.new("rthyb_coupled_rig_config *")
        struct.size, struct.period_s, struct.seed = n, self.period_s, self.seed
        struct.attachment_n_per_m = self.attachment_n_per_m
        struct.load_cell = {"actuator-end": lib.RTHYB_ACTUATOR_END}.get(
            self.load_cell, lib.RTHYB_SPECIMEN_END
        )
        struct.kinematics = self.kinematics.struct.cfg
        for name in ("stiffness", "damping", "mass"):
            setattr(struct, name, np.asarray(getattr(self, name), np.float64).tolist())
        for name in ("displacement", "force"):
            given = getattr(self, name) or (SensorConfig(),) * n
            setattr(struct, name, [dataclasses.asdict(one) for one in given])
        if self.plant is not None:
            struct.plant = self.plant.mapping(self.period_s)
        else:
            struct.servo = [mapping(one) for one in self.servos]
        for i, own in enumerate(self.extras):
            struct.extra_count[i] = fill_extras(struct.extras[i], own)
        for k, errors in enumerate(self.sensors):
            struct.sensor[k] = dataclasses.asdict(errors)
        for k, place in enumerate(self.through):
            if place is not None:
                struct.sensor_extra[k] = 1 + place[0] * EXTRAS_MAX + place[1]
        struct.element_count = len(self.elements)
        for i, (along, one) in enumerate(self.elements):
            struct.along[i] = along
            init_element(ffi.addressof(struct.elements, i), one)
        return struct

    def _check_counts(self) -> None:
        n, m = self.axes, self.kinematics.directions
        for name in ("stiffness", "damping", "mass"):
            if np.shape(getattr(self, name)) != (m, m):
                raise CoreError(
                    f"{name}: found shape {np.shape(getattr(self, name))}; for a specimen with {m} "
                    f"directions it must be {(m, m)}"
                )
        sensors = {len(self.displacement), len(self.force)} - {0, n}
        driven = len(self.servos) if self.plant is None else len(self.plant.stroke_m)
        if sensors or driven != n or (self.plant is not None and self.servos):
            raise CoreError(
                f"found {len(self.servos)} actuators, {len(self.displacement)} displacement "
                f"sensors and {len(self.force)} load cells for {n} axes; there must be {n} "
                f"actuators, or one plant with {n} axes instead, and of each kind of sensor one "
                "for each axis or none"
            )
        if len(self.sensors) not in (0, self.kinematics.sensors):
            raise CoreError(
                f"found errors of {len(self.sensors)} sensors without an actuator; the kinematics "
                f"has {self.kinematics.sensors} of them"
            )
        if len(self.extras) not in (0, n):
            raise CoreError(
                f"found extra sensors of {len(self.extras)} axes; there are {n} axes, some of "
                "which may have none"
            )
        if len(self.elements) > ELEMENTS_MAX:
            raise CoreError(
                f"found {len(self.elements)} elements; a specimen has at most {ELEMENTS_MAX}"
            )


class CoupledRig:
    """A virtual rig of several axes, at rest at 0; raises ``CoreError``."""

    def __init__(self, config: CoupledRigConfig) -> None:
        self.config, self.axes = config, config.axes
        self._c = ffi.new("rthyb_coupled_rig *")
        check(lib.rthyb_coupled_rig_init(self._c, config.struct()))

    def step(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray, int]:
        """Latch displacements, m, and forces, N, (axes,) each, then apply commands, (axes,).

        The third value is the status bits.
        """
        given, x, f = doubles(x_p_m), np.empty(self.axes), np.empty(self.axes)
        if given.shape != (self.axes,):
            raise CoreError(
                f"found commands of shape {given.shape}; there must be one for each of the "
                f"{self.axes} axes"
            )
        code = lib.rthyb_coupled_rig_step(self._c, reading(given), writing(x), writing(f))
        return x, f, int(code)

    def run(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return displacements, m, and forces, N, (n, axes) each, along commands, (n, axes)."""
        return run_rows(lib.rthyb_coupled_rig_run, self._c, x_p_m, self.axes, self.axes)

    @property
    def extras(self) -> tuple[tuple[float, ...], ...]:
        """Readings of each axis' extra sensors at the last latch, each in its unit."""
        return tuple(
            tuple(self._c.extra[i][k] for k in range(len(own)))
            for i, own in enumerate(self.config.extras)
        )

    def record_extras(self, station: Station, channel: int) -> None:
        """Write the extra sensors' readings of every sample into a station's row.

        Args:
            station: the station, which is kept alive with this rig.
            channel: channel of the row for the first reading; those of the axes follow in order.

        Raises:
            CoreError: the row has no room for them.
        """
        counts = [len(own) for own in self.config.extras]
        if not 0 <= channel <= CHANNELS_MAX - sum(counts):
            raise CoreError(
                f"found channel {channel} and {sum(counts)} extra sensors; a row has only "
                f"{CHANNELS_MAX} channels"
            )
        self._station = station
        for i, count in enumerate(counts):
            if count:
                self._c.extra_to[i] = ffi.addressof(station._c.channel, channel)
            channel += count

    @property
    def sensors(self) -> tuple[float, ...]:
        """Readings of the sensors without an actuator at the last latch: m, then N."""
        return tuple(self._c.sensor[0 : self.config.kinematics.sensors])

    def reseed(self) -> None:
        """Restart the noise of the sensors from the seed."""
        lib.rthyb_coupled_rig_reseed(self._c)

    @property
    def true_m(self) -> FloatArray:
        """Displacements at the last latch without the sensors' errors, (axes,)."""
        return np.array(list(self._c.x_true_m[0 : self.axes]))

    @property
    def true_n(self) -> FloatArray:
        """Forces at the last latch without the load cells' errors, (axes,)."""
        return np.array(list(self._c.f_true_n[0 : self.axes]))

    @property
    def pose(self) -> FloatArray:
        """Interface coordinates at the last latch, (directions,)."""
        return np.array(list(self._c.pose[0 : self.config.kinematics.directions]))
