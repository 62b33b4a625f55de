"""A station of two axes with a coupled virtual rig, tick by tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from kernels import Floats
from station_courses import Courses

from rthyb_rt import core
from rthyb_rt.core import AxisConfig, AxisReading, InterfaceConfig
from rthyb_rt.core.coupled_rig import CoupledRig, CoupledRigConfig
from rthyb_rt.core.kinematics import Kinematics
from rthyb_rt.core.sparse import SparseConfig, Symmetric

H: Final = core.PERIOD_S
SIDES: Final = np.array([[1.0, 0.2], [1.0, -0.3]])
"""Axes from x (m) and theta (rad)."""
SPECIMEN: Final = np.array([[6.66e5, 2e4], [2e4, 4e4]])
"""Specimen stiffness, N and N m per x and theta."""
MASS: Final = (4220.0, 300.0)
OFFSET_M: Final = (0.0123, -0.004)
"""Sensor readings at the rig's zero."""
OFFSET_N: Final = (45.0, -20.0)
DELAY: Final = 2
FLAGS: Final = core.FLAGS
NAMES: Final = ("left", "right")


def shaking(seconds: float) -> Floats:
    t = np.arange(round(seconds * core.FS_HZ)) * H
    return np.asarray(0.3 * np.sin(2 * np.pi * 1.7 * t) * np.sin(np.pi * t / seconds) ** 2)


def structure(stiffness: Floats = SPECIMEN, **settings: Any) -> SparseConfig:
    """Two degrees of freedom with the specimen's stiffness only; less excitation on the second."""
    n = len(MASS)
    given: dict[str, Any] = {
        "load_kg": np.array([MASS[0], 0.2 * MASS[1]]),
        "interfaces": tuple(((k, 1.0),) for k in range(n)),
        "k_e_n_per_m": tuple(np.diag(stiffness)),
        "k_e_between": ((0.0, stiffness[0, 1]), (stiffness[1, 0], 0.0)),
        "by_mass_per_s": 0.5,
    }
    return SparseConfig(Symmetric.of(np.diag(MASS)), Symmetric.zero(n), **given | settings)


def controller(**changes: Any) -> core.ControllerConfig:
    given: dict[str, Any] = {
        "law": core.LawConfig("paper", {"alpha0": float(DELAY)}, adapts=False),
        "rfc": core.RfcConfig(k_e_n_per_m=SPECIMEN[0, 0], window=51),
        "motion": core.MotionConfig("cr", mass_kg=1.0, k_e_n_per_m=1.0),
        "velocity_limit_m_per_s": 0.5,
        "numerical": structure(),
        "axes": tuple(AxisConfig(name) for name in NAMES),
        "interfaces": (
            InterfaceConfig("x"),
            InterfaceConfig("theta", rfc=core.RfcConfig(k_e_n_per_m=SPECIMEN[1, 1], window=51)),
        ),
        "kinematics": Kinematics(SIDES),
    }
    return core.ControllerConfig(**given | changes)


def config(control: Mapping[str, Any] | None = None, **changes: Any) -> core.StationConfig:
    base: dict[str, Any] = {"tare_ticks": 64, "ramp_in_ticks": 256, "armed_ticks": 500}
    return core.StationConfig(controller=controller(**control or {}), **base | changes)


def rig(kinematics: Kinematics | None = None, **changes: Any) -> CoupledRig:
    given: dict[str, Any] = {
        "kinematics": kinematics or Kinematics(SIDES),
        "stiffness": SPECIMEN,
        "damping": np.zeros((2, 2)),
        "mass": np.zeros((2, 2)),
        "servos": (core.ServoConfig("pure-delay", delay_samples=float(DELAY)),) * 2,
    }
    return CoupledRig(CoupledRigConfig(**given | changes))


def watched(axis: int, name: str, value: float, reaction: core.Reaction) -> dict[str, Any]:
    """A limit on a single axis."""
    own = {name: core.Watch(value, reaction)}
    axes = tuple(AxisConfig(n, watches=own if k == axis else {}) for k, n in enumerate(NAMES))
    return {"axes": axes}


@dataclass
class Bench(Courses):
    """Two axes whose sensors are offset from zero, and a log of what their drives received."""

    settings: core.StationConfig = field(default_factory=config)
    seconds: float = 2.0
    plant: CoupledRig = field(default_factory=rig)
    records: list[np.ndarray] = field(default_factory=list)
    sent: list[tuple[float, ...]] = field(default_factory=list)
    channels: list[Floats] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.station = core.Station(self.settings, shaking(self.seconds))
        self.at_drive = OFFSET_M

    def read(self) -> list[AxisReading]:
        told = np.array([[a - b for a, b in zip(self.at_drive, OFFSET_M, strict=True)]])
        x, f = self.plant.run(told)
        return [
            AxisReading(x[0, k] + OFFSET_M[k], f[0, k] + OFFSET_N[k]) for k in range(len(NAMES))
        ]

    def step(
        self,
        command: core.Command = "none",
        faults: Mapping[int, Mapping[str, Any]] | None = None,
        **common: Any,
    ) -> core.StationTick:
        """One tick; ``faults`` replaces readings, by axis."""
        readings = self.read()
        for axis, other in (faults or {}).items():
            readings[axis] = replace(readings[axis], **other)
        tick = self.station.tick(command=command, axes=readings, **common)
        self.records.append(tick.records.copy())
        if tick.sent:
            self.sent.append(tick.commands_m)
            self.at_drive = tick.commands_m
        return tick

    def commands(self, since: int = 0) -> Floats:
        """Commands to the drives, without tare, (n, axes)."""
        return np.array(self.sent[since:]) - np.array(
            [self.station._c.axis[k].tare_cmd for k in range(len(NAMES))]
        )


def column(rows: np.ndarray, name: str, axis: int) -> Floats:
    return np.asarray(rows[f"{name}.{axis}" if axis else name])


def columns(rows: np.ndarray, name: str, axes: Sequence[int] = (0, 1)) -> Floats:
    return np.stack([column(rows, name, k) for k in axes], axis=1)
