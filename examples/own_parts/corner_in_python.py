"""The corner of a frame, which two actuators move sideways and turn, as a class in Python.

The same as corner.c, with the same parameters: the CR algorithm (Chen & Ricles 2008, J. Eng. Mech.
134:8) for M x'' + C x' + K x + force = -M r ag. Python must find this file: start in its folder.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

import rthyb_rt as rt


class Corner(rt.NumericalPart):
    """Displacement (m, N) and rotation (rad, N m) of a corner, in this order."""

    interfaces = 2
    responses: ClassVar[dict[str, str]] = {"corner_velocity": "m/s", "corner_rate": "rad/s"}

    def __init__(
        self,
        mass_kg: float,
        inertia_kg_m2: float,
        damping_n_s_per_m: float,
        damping_n_m_s_per_rad: float,
        stiffness_n_per_m: float,
        stiffness_n_m_per_rad: float,
        coupling_n: float,
    ) -> None:
        self.mass = np.diag([mass_kg, inertia_kg_m2])
        self.damping = np.diag([damping_n_s_per_m, damping_n_m_s_per_rad])
        self.stiffness = np.array(
            [[stiffness_n_per_m, coupling_n], [coupling_n, stiffness_n_m_per_rad]]
        )

    def begin(self, period_s: float, k_e_n_per_m: Any) -> None:
        """Invert S = M + h/2 C + h^2/4 (K + K_e)."""
        self.h = h = period_s
        whole = self.stiffness + k_e_n_per_m
        self.per_step = np.linalg.inv(self.mass + 0.5 * h * self.damping + 0.25 * h * h * whole)
        self.x, self.v, self.q = np.zeros(2), np.zeros(2), np.zeros(2)

    def answer(self, ag_mps2: float, force_n: Any) -> Any:
        """Return x + h v + h^2 q, with q the weighted acceleration."""
        net = -self.mass @ [ag_mps2, 0.0] - self.damping @ self.v - self.stiffness @ self.x
        self.q = self.per_step @ (net - force_n)
        return self.x + self.h * self.v + self.h**2 * self.q

    def advance(self) -> None:
        """Step to t[n+1], once the command was sent."""
        self.x = self.x + self.h * self.v + self.h**2 * self.q
        self.v = self.v + self.h * self.q

    def report(self) -> list[float]:
        """Return the velocities."""
        return [float(v) for v in self.v]
