"""Figures of a test on a rig: period, gains, critical delays."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from rthyb_rt.analysis import margins, numerical_margins
from rthyb_rt.analysis.margins import Lead, SampledLead
from rthyb_rt.lab.experiment import Setup

GAIN: Final = "delay_estimator.gain_per_mm2_per_sample"


@dataclass(frozen=True)
class Figures:
    """Figures of a test on a rig; None where a figure does not apply.

    Attributes:
        critical_delay_samples: longest pure delay at which the structure with an elastic specimen
            is stable without compensation; 0 if there is none.
        alpha0, beta0: initial values of the phase lead; None for a law without one.
        critical_delay_with_lead_samples: the same with the phase lead at its initial values.
        critical_delay_followed_samples: the same with a phase lead whose alpha equals the delay.
        identified_delay_samples: delay of the rig according to `rthyb identify`.
        peak_phi: peak of the estimator's input, from the reference simulation or from one with an
            elastic specimen, whichever is larger.
        estimator_loop_gain: g of the controller ``paper``.
        modes: modes of a structure given by matrices, including the elastic specimen; mass, period
            and damping are then those of the first mode, as seen by the interface.
    """

    samples: int
    duration_s: float
    pga_g: float
    mass_kg: float
    period_s: float
    damping_n_s_per_m: float
    damping_ratio: float
    k_e_n_per_m: float
    window_samples: int
    alpha0: float | None
    beta0: float | None
    lead_first_sample_gain: float | None
    lead_nyquist_gain: float | None
    critical_delay_samples: float
    critical_delay_with_lead_samples: float | None
    critical_delay_followed_samples: int | None
    identified_delay_samples: float | None
    rig_is_lag: bool
    reference_peak_m: float
    reference_peak_m_per_s: float
    reference_peak_n: float
    peak_phi: float | None
    estimator_loop_gain: float | None
    modes: tuple[dict[str, float], ...] = ()


def figures_of(setup: Setup) -> Figures:
    """Return the figures of a test that is ready to run."""
    derived = setup.derived
    lead = margins.lead_of(setup.controller.law, derived.rate.period_s)
    leads, settings, rate = derived.plc_enabled, derived.law_settings, derived.rate
    reference = setup.reference
    survives = _Survival.of(setup, lead if leads else None)
    identified = rate.samples(setup.rig.identified.alpha) if setup.rig.identified else None
    phi = loop_gain = None
    if isinstance(lead, margins.Lead):
        unit_m = settings["delay_estimator.reference_displacement_m"] / rate.pace
        phi = max(
            margins.peak_excitation(x, lead, unit_m)
            for x in (reference["x_ref_m"], survives.elastic_m)
        )
        if GAIN in settings and derived.estimator_enabled:
            delay = lead.alpha if identified is None else identified
            loop_gain = margins.estimator_loop_gain(settings[GAIN] / rate.pace, delay, phi)
    return Figures(
        samples=setup.ticks,
        duration_s=setup.ticks / derived.fs_hz,
        pga_g=setup.motion.pga_g,
        mass_kg=derived.mass_kg,
        period_s=derived.period_s,
        damping_n_s_per_m=derived.damping_n_s_per_m,
        damping_ratio=derived.damping_ratio,
        k_e_n_per_m=derived.k_e_n_per_m,
        window_samples=derived.window_samples,
        alpha0=lead.alpha if isinstance(lead, margins.Lead) else None,
        beta0=lead.beta if isinstance(lead, margins.Lead) else None,
        lead_first_sample_gain=lead.first_sample_gain if leads else None,
        lead_nyquist_gain=lead.nyquist_gain if leads else None,
        critical_delay_samples=survives.alone,
        critical_delay_with_lead_samples=survives.with_lead,
        critical_delay_followed_samples=survives.followed,
        identified_delay_samples=identified,
        rig_is_lag=margins.is_lag(setup.rig),
        reference_peak_m=float(np.abs(reference["x_ref_m"]).max()),
        reference_peak_m_per_s=float(np.abs(reference["v_ref_mps"]).max()),
        reference_peak_n=float(np.abs(reference["f_ref_n"]).max()),
        peak_phi=phi,
        estimator_loop_gain=loop_gain,
        modes=tuple(
            mode.document()
            for mode in (derived.structure.modes() if derived.structure is not None else ())
        ),
    )


@dataclass(frozen=True)
class _Survival:
    """Critical delays of a test's structure, and its motion with an elastic specimen."""

    alone: float
    with_lead: float | None
    followed: int | None
    elastic_m: Any

    @classmethod
    def of(cls, setup: Setup, lead: Lead | SampledLead | None) -> _Survival:
        """Return them; ``lead`` is None if nothing compensates the command."""
        from rthyb_rt.analysis import margins
        from rthyb_rt.config.own_structure import OwnStructure

        matrices, step = setup.derived.structure, max(1, round(setup.derived.rate.pace))
        structure: margins.DelayedStructure = (
            margins.OneDegree(setup.controller.motion)
            if matrices is None or isinstance(matrices, OwnStructure)
            else numerical_margins.ManyDegrees(matrices)
        )
        with_lead = None if lead is None else margins.critical_delay(structure, lead)
        followed = None
        if isinstance(lead, margins.Lead):
            followed = margins.largest_followed_delay(structure, lead, most_delay(setup), step)
        elastic_m = structure.elastic_displacement_m(setup.ag_mps2)
        return cls(margins.critical_delay(structure), with_lead, followed, elastic_m)


def most_delay(setup: Setup) -> int:
    """Return the largest delay that the law of this test can estimate, samples."""
    most = setup.derived.law_settings["delay_estimator.alpha_max"]
    return math.floor(setup.derived.rate.samples(most))
