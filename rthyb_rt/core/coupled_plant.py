"""A virtual rig of several coupled axes (``csrc/coupled_plant.c``)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from rthyb_rt._core import ffi, lib
from rthyb_rt.core.kinematics import AXES_MAX, Kinematics
from rthyb_rt.core.library import CoreError, FloatArray, check, doubles, reading, writing
from rthyb_rt.core.sizes import PERIOD_S

STATES_MAX: Final = int(lib.RTHYB_PLANT_STATES)


def run_rows(
    run: Callable[..., object], state: Any, x_p_m: npt.ArrayLike, axes: int, forces: int
) -> tuple[FloatArray, FloatArray]:
    """Run a virtual rig of several axes along commands, (n, axes).

    Args:
        run: the core's function of (state, commands, readings, forces, n).

    Returns:
        Readings, (n, axes), and forces, (n, forces).

    Raises:
        CoreError: the commands have the wrong shape.
    """
    given = doubles(x_p_m)
    if given.ndim != 2 or given.shape[1] != axes:
        raise CoreError(
            f"found commands of shape {given.shape}; there must be one column for each of the "
            f"{axes} axes"
        )
    x, f = np.empty_like(given), np.empty((len(given), forces))
    run(
        state,
        reading(given.reshape(-1)),
        writing(x.reshape(-1)),
        writing(f.reshape(-1)),
        len(given),
    )
    return x, f


@dataclass(frozen=True, eq=False)
class CoupledPlantConfig:
    """Plant, sensors and specimen of a `CoupledPlant`.

    Attributes:
        a, b, c: s[n+1] = a s[n] + b u[n], x[n] = c s[n], with u the commands held from t_n on, m;
            (states, states), (states, axes), (axes, states).
        kinematics: kinematics of the axes; the settings are copied.
        stroke_m: largest command in either direction, one per axis.
        noise_m: standard deviation of the white noise of a reading, one per axis.
        stiffness, damping, mass: factors from the measured pose, its velocity and its acceleration,
            both by backward differences, to the specimen's forces, (forces, axes) each.
        seed: seed of the noise.
        period_s: sampling period.
    """

    a: FloatArray
    b: FloatArray
    c: FloatArray
    kinematics: Kinematics
    stroke_m: tuple[float, ...]
    noise_m: tuple[float, ...]
    stiffness: FloatArray
    damping: FloatArray
    mass: FloatArray
    seed: int = 0
    period_s: float = PERIOD_S

    def struct(self) -> Any:
        """Return the C struct; raises ``CoreError`` for inconsistent shapes."""
        axes, states, forces = len(self.noise_m), len(self.a), len(self.stiffness)
        shapes = {
            "a": (states, states),
            "b": (states, axes),
            "c": (axes, states),
            "stiffness": (forces, axes),
            "damping": (forces, axes),
            "mass": (forces, axes),
            "stroke_m": (axes,),
        }
        for name, shape in shapes.items():
            if np.shape(getattr(self, name)) != shape:
                raise CoreError(
                    f"{name}: found shape {np.shape(getattr(self, name))}; for a plant with "
                    f"{states} states, {axes} axes and {forces} forces it must be {shape}"
                )
        if not (1 <= axes <= AXES_MAX and 1 <= states <= STATES_MAX and forces <= AXES_MAX):
            raise CoreError(
                f"found a plant with {axes} axes, {forces} forces and {states} states; at most "
                f"{AXES_MAX} axes and as many forces, and {STATES_MAX} states, are allowed"
            )
        return ffi.new(
            "rthyb_coupled_plant_config *",
            {name: np.asarray(getattr(self, name), np.float64).tolist() for name in shapes}
            | {
                "size": axes,
                "states": states,
                "forces": forces,
                "period_s": self.period_s,
                "noise_m": list(self.noise_m),
                "kinematics": self.kinematics.struct.cfg,
                "seed": self.seed,
            },
        )


class CoupledPlant:
    """A virtual rig of several axes, at rest at 0; raises ``CoreError``."""

    def __init__(self, config: CoupledPlantConfig) -> None:
        self.config = config
        self.axes, self.forces = len(config.noise_m), len(config.stiffness)
        self._c = ffi.new("rthyb_coupled_plant *")
        check(lib.rthyb_coupled_plant_init(self._c, config.struct()))

    def latch(self) -> tuple[FloatArray, FloatArray, int]:
        """Return readings, m, (axes,), forces, (forces,), of this instant and the status bits."""
        x, f = np.empty(self.axes), np.empty(self.forces)
        code = lib.rthyb_coupled_plant_latch(self._c, writing(x), writing(f))
        return x, f, int(code)

    def apply(self, x_p_m: npt.ArrayLike) -> int:
        """Apply commands, (axes,), from this instant on; return the status bits."""
        given = doubles(x_p_m)
        if given.shape != (self.axes,):
            raise CoreError(
                f"found commands of shape {given.shape}; there must be one for each of the "
                f"{self.axes} axes"
            )
        return int(lib.rthyb_coupled_plant_apply(self._c, reading(given)))

    def run(self, x_p_m: npt.ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Return readings, (n, axes), and forces, (n, forces), along commands, (n, axes)."""
        return run_rows(lib.rthyb_coupled_plant_run, self._c, x_p_m, self.axes, self.forces)

    @property
    def true_m(self) -> FloatArray:
        """Displacements at the last latch without sensor noise, (axes,)."""
        return np.array(list(self._c.true_m[0 : self.axes]))

    @property
    def pose(self) -> FloatArray:
        """Interface coordinates computed from the readings at the last latch, (axes,)."""
        return np.array(list(self._c.pose[0 : self.axes]))
