"""What the noise of the sensors alone asks of an actuator, before a test runs.

Noise at rest enters the equation of motion with the force and, through the force compensation, with
the displacement. A step that hardly damps its fastest motions, a small mass, and a law that leads
pass it on to the command. Beyond its limits of velocity and acceleration the command is reduced,
and the axis no longer follows. Here is the command of one axis; that of several is in
`rthyb_rt.analysis.axes_noise`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import loop_roots
from rthyb_rt.config import response

if TYPE_CHECKING:
    from rthyb_rt.analysis.loop_roots import Block, LinearLoop
    from rthyb_rt.core import ControllerConfig
    from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_UNITS: Final = {"acceleration": "m/s²", "velocity": "m/s"}
_POINTS: Final = 1024
"""Number of frequencies, once evenly spaced and once closer together towards half the rate."""
_NEAREST: Final = 1e-6
"""Distance of the nearest one from half the rate, in rad per sample."""
_PER_DECADE: Final = 20
"""Frequencies on each side of a resonance that is narrower than the even ones are apart."""


@dataclass(frozen=True)
class CommandNoise:
    """What noise alone asks of an axis.

    Attributes:
        axis: its name; "" for a rig of one axis.
        quantity: "acceleration" or "velocity".
        deviation: standard deviation of that of the command, m/s^2 or m/s.
        limit: limit of that of the command, in the same unit.
    """

    axis: str
    quantity: str
    deviation: float
    limit: float

    @property
    def limited(self) -> float:
        """Share of normally distributed commands that are beyond the limit."""
        return math.erfc(self.limit / (math.sqrt(2.0) * self.deviation))


def angles(roots: Complexes) -> Floats:
    """Return angles of the upper half of the unit circle at which spectra are sampled, (k,).

    Args:
        roots: of the loop; each resonance gets angles across its own width.
    """
    even = np.linspace(0.0, math.pi, _POINTS + 1)[1:-1]
    parts = [even, math.pi - np.geomspace(_NEAREST, math.pi / 2.0, _POINTS)]
    step = math.pi / _POINTS
    for root in roots[(np.abs(roots) > math.exp(-2.0 * step)) & (roots.imag >= 0.0)]:
        width = -math.log(min(abs(root), 1.0 - 1e-9))
        decades = math.log10(4.0 * step / (0.1 * width))
        near = np.geomspace(0.1 * width, 4.0 * step, math.ceil(_PER_DECADE * decades))
        parts += [np.angle(root) + near, np.angle(root) - near]
    whole = np.unique(np.concatenate(parts))
    return np.asarray(whole[(whole > 0.0) & (whole < math.pi)])


def deviations(commands: Complexes, angle: Floats, h: float) -> dict[str, Floats]:
    """Return the standard deviations of velocity and acceleration, (axes,) each.

    The variance is the mean of the squared response over the unit circle.

    Args:
        commands: response of the commands to each noise of standard deviation 1, (k, axes, noises).
        angle: where, rad per sample, (k,).
        h: sampling period.
    """
    difference = np.abs(1.0 - np.exp(-1j * angle)) ** 2 / h**2
    density = (np.abs(commands) ** 2).sum(axis=2).T
    steps = np.diff(angle)
    found = {}
    for power, quantity in ((1, "velocity"), (2, "acceleration")):
        of = difference**power * density
        variance = (0.5 * (of[:, 1:] + of[:, :-1]) * steps).sum(axis=1) / math.pi
        found[quantity] = np.asarray(np.sqrt(variance))
    return found


def beyond(axis: str, noise: dict[str, float], limits: dict[str, float]) -> list[CommandNoise]:
    """Return velocity and acceleration with their limits, those without one left out.

    Args:
        axis: name of the axis.
        noise: standard deviation of each quantity.
        limits: limit of each; 0: none.
    """
    return [
        CommandNoise(axis, quantity, noise[quantity], limits[quantity])
        for quantity in _UNITS
        if limits[quantity] > 0.0 and noise[quantity] > 0.0
    ]


def of_loop(
    config: ControllerConfig, loop: LinearLoop, lead: Block, noise: tuple[float, float]
) -> dict[str, float]:
    """Return the standard deviations of velocity and acceleration of the command of one axis.

    Noise is taken as independent from sample to sample and of displacement from force.

    Args:
        config: the test's settings.
        loop: its loop, which must be stable.
        lead: the control law from x_c to the command.
        noise: standard deviations of the displacement, m, and of the force, N.
    """
    angle = angles(loop.roots())
    z = np.exp(1j * angle)
    moved = loop.part.response(z)[:, 0]
    back = loop.by_rig.response(z)[:, 0] + loop.beside.response(z)[:, 0]
    closed = lead.response(z)[:, 0] * moved / (1.0 - moved * back)
    k = config.rfc.k_e_n_per_m if config.rfc.enabled else 0.0
    low_pass = loop_roots.low_pass(config.rfc.cutoff_hz, config.period_s).response(z)[:, 0]
    entering = np.stack([noise[1] * np.ones_like(closed), -k * low_pass * noise[0]], axis=1)
    found = deviations((closed[:, None] * entering)[:, None, :], angle, config.period_s)
    return {quantity: float(values[0]) for quantity, values in found.items()}


def judge(setup: Setup) -> CommandNoise | None:
    """Return the limit of one axis that noise reaches first; None: not known, or no limit.

    The worse of the law's initial settings and those to which the rig's response leads it.

    Args:
        setup: a test on one axis, whose loop must be stable.
    """
    config, model = setup.controller, response.plant(setup.rig)
    if model is None or config.motion.integrator == "prescribed":
        return None
    hold = response.hold_of(setup.rig)
    noise = setup.derived.rest_noise_displacement_m, setup.derived.rest_noise_force_n
    limits = {
        "velocity": config.velocity_limit_m_per_s,
        "acceleration": config.acceleration_limit_m_per_s2,
    }
    found = list[CommandNoise]()
    for law in loop_roots.laws(config.law, model, config.period_s, hold):
        lead = law if config.lead_enabled else loop_roots.gain(1.0)
        loop = loop_roots.loop_of(config, model, law, hold)
        found += beyond("", of_loop(config, loop, lead, noise), limits)
    return max(found, key=lambda one: one.limited, default=None)


def remark(found: CommandNoise | None) -> str | None:
    """Return a remark for the user if noise alone exceeds a limit by its standard deviation."""
    if found is None or found.deviation <= found.limit:
        return None
    unit = _UNITS[found.quantity]
    verb = "accelerate by" if found.quantity == "acceleration" else "move at"
    command, follow = ("the command", "the actuator") if not found.axis else (
        f"the command of axis {found.axis}", "the axes")  # fmt: skip
    return (
        f"noise of the sensors alone makes {command} {verb} {found.deviation:.3g} {unit} (standard "
        f"deviation), more than its limit of {found.limit:.3g} {unit} allows: about "
        f"{100.0 * found.limited:.0f} % of the commands will be reduced, and {follow} may not "
        'follow; set controller.rfc.cutoff_hz, or use integrator = "kr-alpha" with a lower rho_inf'
    )
