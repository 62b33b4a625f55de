"""The subject of a diagnosis: a recording's channels and the laboratory's model of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from rthyb_rt import core
from rthyb_rt.core import FLAGS, STATES
from rthyb_rt.core.diagnosis_models import ActuatorModel, Hold

if TYPE_CHECKING:
    from rthyb_rt.config import RigFile
    from rthyb_rt.record.recording import RecordedTest

Floats = NDArray[np.float64]
Family = Literal["drive", "ground", "forced", "loop"]
FAMILIES: tuple[Family, ...] = ("drive", "ground", "forced", "loop")

NO_READING = 1e12
"""A value that no sensor reads in any unit, far beyond the core's own bounds."""
CHANNELS: dict[str, str] = {
    "ag": "m/s^2",
    "x_num": "m",
    "x_cmd": "m",
    "x_meas": "m",
    "f_meas": "N",
    "f_in": "N",
    "a_meas": "m/s^2",
    "fy_meas": "N",
}
"""Unit of each channel that a recording may have."""


@dataclass(frozen=True)
class ModelBoucWen:
    """F = k (alpha x + (1 - alpha) z), z' = v (1 - |z/xy|^n (beta + gamma sgn(v z)))."""

    alpha: float
    xy: float
    n: float = 2.0
    beta: float = 0.5
    gamma: float = 0.5

    def element(self, k: float, share: float = 1.0) -> core.ElementConfig:
        """Return the core's element for a stiffness ``k``; ``share`` scales the whole force."""
        # The core's b multiplies the term in sgn(v z), its c the one without.
        per = self.xy**self.n
        return core.element(
            "hysteresis",
            k_n_per_m=k * share,
            post_yield_ratio=self.alpha,
            a=1.0,
            b=self.gamma / per,
            c=self.beta / per,
            eta=self.n,
        )


@dataclass(frozen=True)
class Model:
    """The laboratory's model: F = k x + c x' + moving_mass x'', and its surroundings.

    ``k_tol`` and ``c_tol`` are relative standard deviations; None: refitted freely. ``rig`` is the
    rig file from which the model was made, ``plc`` the weights W1, W2 of the phase-lead
    compensator, ``rfc`` whether the force was compensated; None if the model does not state it.
    ``notes`` are on values that the rig file omits. ``k_stated`` is the stiffness as stated if
    ``k`` is another one, see `refitted`.
    """

    family: Family
    fs_hz: float
    k: float
    c: float = 0.0
    moving_mass: float = 0.0
    k_tol: float | None = None
    c_tol: float | None = None
    bouc_wen: ModelBoucWen | None = None
    actuator: ActuatorModel | None = None
    mass: float = 0.0
    c_num: float = 0.0
    x_std: float | None = None
    f_std: float | None = None
    a_std: float | None = None
    extra: tuple[core.ElementConfig, ...] = ()
    rig: RigFile | None = None
    plc: tuple[float, float] | None = None
    rfc: bool | None = None
    unused: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    k_stated: float | None = None

    @property
    def hold(self) -> Hold:
        """How a command or a force is interpolated between rows."""
        return self.actuator.hold if self.actuator else "foh"

    @property
    def whole_mass(self) -> float:
        """Mass that moves, kg: of the specimen, and on moving ground of the body on it."""
        return self.moving_mass + (self.mass if self.family == "ground" else 0.0)

    def spring(self, x: Floats) -> Floats:
        """Return the restoring force along displacements of shape (n,), N."""
        if self.bouc_wen is None:
            return self.k * x
        return core.CoreElement(self.bouc_wen.element(self.k)).run(x)

    def further(self, x: Floats, v: Floats, a: Floats) -> Floats:
        """Return the force of elements other than spring, dashpot and mass, N."""
        total = np.zeros_like(x)
        for config in self.extra:
            total += core.CoreElement(config).run(x, v, a, 1.0 / self.fs_hz)
        return total

    def force(self, x: Floats, v: Floats, a: Floats) -> Floats:
        """Return the specimen's force along a motion of shape (n,), N."""
        return self.spring(x) + self.c * v + self.moving_mass * a + self.further(x, v, a)

    def elements(self) -> list[core.ElementConfig]:
        """Return the specimen without its mass as elements of the core."""
        spring = (
            self.bouc_wen.element(self.k)
            if self.bouc_wen
            else core.element("stiffness", k_n_per_m=self.k)
        )
        return [spring, core.element("viscous", c_n_s_per_m=self.c), *self.extra]


def tare_rows(rec: RecordedTest) -> NDArray[np.int64]:
    """Return the indices of the rows over which a recording of this program was zeroed."""
    rows = rec.samples
    zeroed = np.flatnonzero(rows["state"] == STATES.index("ZEROED"))
    before = rows[: zeroed[0]] if zeroed.size else rows[:0]
    fresh = np.flatnonzero(before["flags"] & FLAGS["fresh"])
    values = rec.replay.parameters[0]["values"] if rec.replay.parameters else {}
    ticks = int(values.get("station", {}).get("tare_ticks", 0))
    return fresh[-ticks:]


def error_of_zero(readings: Floats) -> float:
    """Return the standard error of a mean of readings, (n,), in their unit; 0 for too few."""
    return float(readings.std(ddof=1) / np.sqrt(readings.size)) if readings.size > 2 else 0.0


@dataclass(frozen=True)
class Case:
    """A recording ready for diagnosis.

    Attributes:
        t: uniform time, (n,), s.
        channels: each (n,), SI, NaN where nothing was recorded.
        rows: which rows are used, (n,).
        notes: irregularities that were found in the data and handled, in words.
        own: the complete recording, if it is one of this program.
        folder: name of its folder.
        further: columns that are not channels, by their header, each (n,), in a unit of their
            own.
        axis: name of the axis, for a recording of several axes.
        zero_error_n: overrides `tare_error_n`, if known from elsewhere.
    """

    name: str
    model: Model
    t: Floats
    channels: dict[str, Floats]
    rows: NDArray[np.bool_]
    notes: list[str] = field(default_factory=list)
    own: RecordedTest | None = None
    folder: str = ""
    further: dict[str, Floats] = field(default_factory=dict)
    axis: str = ""
    zero_error_n: float | None = None

    @property
    def recorded(self) -> dict[str, Floats]:
        """Everything that was recorded, channels or not, each (n,)."""
        return {**self.further, **self.channels}

    @property
    def fs_hz(self) -> float:
        """Sampling rate, Hz."""
        return self.model.fs_hz

    @property
    def dt(self) -> float:
        """Sampling period, s."""
        return 1.0 / self.model.fs_hz

    @property
    def tare_error_n(self) -> float:
        """Standard error of the force's zero in a recording of this program, N; 0: not known.

        The zero is a mean over rows at rest: its error is not an error of the load cell.
        """
        if self.zero_error_n is not None:
            return self.zero_error_n
        if self.own is None:
            return 0.0
        return error_of_zero(self.own.samples["f_read_n"][tare_rows(self.own)])

    def get(self, name: str) -> Floats | None:
        """Return a channel, or None."""
        return self.channels.get(name)

    def with_model(self, model: Model) -> Case:
        """Return the same recording with another model."""
        return replace(self, model=model)
