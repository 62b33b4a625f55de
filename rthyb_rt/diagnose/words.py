"""A diagnosis in words that a laboratory uses."""

from __future__ import annotations

from typing import Any

from rthyb_rt.diagnose.engine import Diagnosis, Found

PLAIN: dict[str, str] = {
    "coulomb": "dry friction",
    "viscous": "viscous damping",
    "stribeck": "friction that falls with velocity",
    "lugre": "friction with elastic bristles",
    "quad_damping": "damping with the square of velocity",
    "inertia": "a moving mass",
    "gap": "a gap",
    "cubic": "a cubic spring",
    "quadratic": "a quadratic spring",
    "stopper": "a stop",
    "stiffness": "an error of the stiffness",
    "hysteresis": "yielding",
    "pinching": "pinching",
    "degradation": "degradation",
    "maxwell": "relaxation",
    "second_mode": "a mass that rides along on a spring",
    "bias": "an offset of the load cell",
    "drift": "a drift of the load cell",
    "hum": "hum in the load cell",
    "time_skew": "a time skew of the load cell",
    "crosstalk": "crosstalk from the other direction",
    "quantisation": "a coarse load cell",
    "delay": "a delay of the actuator",
    "delay_rate": "a delay that grows with velocity",
    "act_gain": "a gain error of the actuator",
    "oil_column": "another second-order lag of the actuator",
    "rate_limit": "a velocity limit of the actuator",
}


def value_text(name: str, value: float) -> str:
    """Return a parameter with its unit, as ``Fc = 812 N``."""
    head, _, unit = name.partition("_")
    unit = {
        "N": "N", "m": "m", "kg": "kg", "s": "s", "Hz": "Hz", "N_m": "N/m", "Ns_m": "N s/m",
        "m_s": "m/s", "N_m3": "N/m³", "N_m2": "N/m²", "Ns2_m2": "N s²/m²", "N_s": "N/s",
        "s2_m": "s²/m",
    }.get(unit, "")  # fmt: skip
    return f"{head} = {value:.4g} {unit}".rstrip()


def interval_text(ci: list[float] | None) -> str:
    """Return a 95 % interval in words."""
    return f"95 %: {ci[0]:.4g} to {ci[1]:.4g}" if ci else ""


def named(c: Found) -> str:
    """Return an effect with its parameters."""
    values = ", ".join(value_text(k, v) for k, v in c.params.items())
    return f"{PLAIN.get(c.name, c.name)} ({values})" if values else PLAIN.get(c.name, c.name)


def _when(d: Diagnosis) -> str:
    if not d.windows:
        return ""
    whole = float(d.case.t[-1] - d.case.t[0]) or 1.0
    covered = sum(b - a for a, b in d.windows)
    if covered > 0.9 * whole:
        return "throughout the recording"
    spans = [f"{a:.1f} and {b:.1f} s" for a, b in d.windows[:3]]
    more = f" and {len(d.windows) - 3} more times" if len(d.windows) > 3 else ""
    return "between " + ", between ".join(spans) + more


def sentence(d: Diagnosis, answer: dict[str, Any]) -> str:
    """Return the verdict in one sentence."""
    if d.verdict == "none":
        return (
            "Nothing is missing: model and recording agree inside the stated tolerances and noise."
        )
    sensor = "the actuator's displacement" if d.channel == "disp" else "the force"
    where = _when(d)
    if d.verdict == "unknown":
        return (
            f"{where[:1].upper()}{where[1:]}, for x from {d.x_m[0] * 1e3:.3g} to "
            f"{d.x_m[1] * 1e3:.3g} mm and v from {d.v_m_s[0] * 1e3:.3g} to {d.v_m_s[1] * 1e3:.3g} "
            f"mm/s, {sensor} differs from the model by something that no known effect explains."
        )
    if d.verdict == "ambiguous":
        sets = " or ".join(" with ".join(PLAIN.get(n, n) for n in s) for s in d.ambiguous_with)
        return f"This recording cannot tell apart: {sets}; each explains {sensor} equally well."
    by_name = {c.name: c for c in d.candidates}
    parts = " and ".join(named(by_name[n]) if n in by_name else n for n in d.effects)
    before, after = d.fit.get("nrmse_before", 0.0), d.fit.get("nrmse_after", 0.0)
    share = 100.0 * (1.0 - (after / before) ** 2) if before > 0 else 0.0
    verb = "explain" if len(d.effects) > 1 else "explains"
    return (
        f"{where[:1].upper()}{where[1:]} {sensor} differs from the model: {parts} {verb} "
        f"{min(share, 100.0):.1f} % of it (NRMSE {100 * before:.3g} % before, "
        f"{100 * after:.3g} % after)."
    )
