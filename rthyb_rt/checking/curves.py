"""Curves of a check: critical delays of structures, the loop by frequency, predicted tracking."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from rthyb_rt.analysis import loop_roots, margins
from rthyb_rt.config import response
from rthyb_rt.lab.experiment import Setup

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

PERIODS: Final = 33
"""Number of periods on the map, from a quarter to four times that of the test: eight per octave."""
BEGINS_ADAPTED: Final = ("as it begins", "once adapted")
"""Names of the states of a control law, in the order of its settings."""
LINES: Final = 2000
"""Number of frequencies for the loop."""


@dataclass(frozen=True)
class StabilityMap:
    """Critical delays of a test's structure for other periods.

    Attributes:
        periods_s: (k,), s; stiffness and damping ratio are the test's, the mass varies.
        alone_s: `margins.critical_delay` without compensation, (k,), s; inf: any.
        with_lead_s: with the control law at its initial settings, (k,), s; None without a lead.
        period_s, delay_s: of the test, and of its rig if that was identified.
    """

    periods_s: Floats
    alone_s: Floats
    with_lead_s: Floats | None
    period_s: float
    delay_s: float | None


def stability_map(setup: Setup) -> StabilityMap | None:
    """Return the map of a test; None for a structure of many degrees of freedom, or a history."""
    motion, derived = setup.controller.motion, setup.derived
    if derived.structure is not None or motion.integrator == "prescribed":
        return None
    lead = margins.lead_of(setup.controller.law, derived.rate.period_s)
    periods = derived.period_s * np.geomspace(0.25, 4.0, PERIODS)
    stiffness = motion.stiffness_n_per_m + motion.k_e_n_per_m
    alone, led = [], []
    for period_s in periods:
        mass = stiffness * (float(period_s) / (2.0 * math.pi)) ** 2
        own = replace(
            motion,
            mass_kg=mass - motion.added_mass_kg,
            damping_n_s_per_m=2.0 * derived.damping_ratio * math.sqrt(stiffness * mass),
        )
        structure = margins.OneDegree(own)
        alone.append(margins.critical_delay(structure))
        led.append(margins.critical_delay(structure, lead) if derived.plc_enabled else math.nan)
    known = setup.rig.identified
    return StabilityMap(
        periods,
        np.array(alone) / derived.fs_hz,
        np.array(led) / derived.fs_hz if derived.plc_enabled else None,
        derived.period_s,
        None if known is None else derived.rate.samples(known.alpha) / derived.fs_hz,
    )


@dataclass(frozen=True)
class ByFrequency:
    """A curve for each state of the control law, over common frequencies.

    Attributes:
        frequency_hz: (k,), Hz.
        curves: complex values by name: ``as it begins``, ``once adapted``; for the tracking also
            ``not compensated``.
        swept_hz: frequency up to which the rig's response is known.
    """

    frequency_hz: Floats
    curves: dict[str, Complexes]
    swept_hz: float


def nyquist(setup: Setup) -> ByFrequency | None:
    """Return L of 1 + L = 0, the whole loop opened at the rig, up to half the sample rate.

    None if the rig's response is not known, or there is no loop.
    """
    model, laws, hold = _known(setup)
    if model is None or setup.controller.motion.integrator == "prescribed":
        return None
    h = setup.controller.period_s
    # The resonance of the computed part may be narrower than any grid, so its angles are included.
    found = {
        name: loop_roots.loop_of(setup.controller, model, law, hold) for name, law in laws.items()
    }
    theta = angles_near(np.concatenate([loop.roots(0.0) for loop in found.values()]))
    z = np.exp(1j * theta)
    curves = {name: loop.opened(z) for name, loop in found.items()}
    return ByFrequency(theta / (2.0 * math.pi * h), curves, model.swept_hz)


def angles_near(roots: Complexes) -> Floats:
    """Return angles up to half the sample rate that resolve the resonances of roots, (k,), rad."""
    peaks = np.abs(np.angle(roots))
    peaks = peaks[(peaks > 1e-4) & (peaks < math.pi)]
    near = np.concatenate([peaks * (1.0 + by) for by in np.linspace(-0.05, 0.05, 201)])
    theta = np.unique(np.concatenate([np.geomspace(2e-4, math.pi, LINES), near]))
    return np.asarray(theta[theta <= math.pi])


def tracking(setup: Setup) -> ByFrequency | None:
    """Return the predicted ratio of measured displacement to command, from the rig's response.

    None if the response is not known.
    """
    model, laws, hold = _known(setup)
    if model is None:
        return None
    h = setup.controller.period_s
    f = np.geomspace(0.1, min(model.swept_hz, 0.5 / h), 300)
    z = np.exp(2j * np.pi * f * h)
    rig = loop_roots.rig(model, h, hold).response(z)[:, 0]
    curves = {"not compensated": rig}
    curves |= {name: law.response(z)[:, 0] * rig for name, law in laws.items()}
    return ByFrequency(f, curves, model.swept_hz)


def _known(
    setup: Setup,
) -> tuple[response.IdentifiedPlant | None, dict[str, loop_roots.Block], str | None]:
    model, hold = response.plant(setup.rig), response.hold_of(setup.rig)
    if model is None:
        return None, {}, hold
    config = setup.controller
    if not config.lead_enabled:
        return model, {"as it begins": loop_roots.gain(1.0)}, hold
    found = loop_roots.laws(config.law, model, config.period_s, hold)
    return model, dict(zip(BEGINS_ADAPTED, found, strict=False)), hold
