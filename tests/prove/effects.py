"""What may be missing: how each effect is drawn, and which parameter sets its size."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from prove import bench, laws, loops, rigs
from prove.laws import Effect

Rng = np.random.Generator

SENSOR = ("bias", "drift", "hum", "time_skew", "crosstalk", "quantisation")
DISP = ("delay", "delay_rate", "act_gain", "oil_column", "rate_limit")
FORCE = tuple(laws.CODES)[:16]
CATALOGUE = FORCE + SENSOR + DISP
UNKNOWN = (*tuple(laws.CODES)[16:], "stroke_ripple")

# Parameters of the format's model of each effect: what a rival costs.
COUNT = dict.fromkeys(CATALOGUE, 1) | {
    "stribeck": 3, "lugre": 2, "stopper": 2, "hysteresis": 2, "pinching": 2, "degradation": 2,
    "maxwell": 2, "second_mode": 2, "hum": 2, "oil_column": 2,
}  # fmt: skip

# Structural laws bend the elastic base itself; they want a linear one.
STRUCTURAL = ("gap", "hysteresis", "pinching", "stiffness", "degradation")

WHERE = {
    "drive": FORCE + SENSOR + DISP,
    "loop": FORCE + SENSOR + DISP,
    "ground": (
        *(n for n in FORCE if n not in ("inertia", "second_mode")),
        "bias", "hum", "crosstalk", "quantisation",
    ),
    "forced": (*FORCE, "bias"),
    "quasi_static": (
        "stiffness", "coulomb", "gap", "cubic", "quadratic", "stopper", "hysteresis", "pinching",
        "degradation", "bias", "drift",
    ),
}  # fmt: skip
FREE_CELL = tuple(n for n in WHERE["ground"] if n not in SENSOR)

# Excitations that bring each family to life; held-out ones come from the last three.
EXCITATIONS = {
    "drive": ("sweep", "random", "earthquake", "cyclic", "multi_amplitude"),
    "loop": ("sweep", "random", "cyclic", "earthquake"),
    "ground": ("sweep", "random", "cyclic", "earthquake"),
    "forced": ("sweep", "random", "multi_amplitude"),
    "quasi_static": ("quasi_static",),
}
HELD_OUT = ("sweep", "random", "cyclic")
# Effects whose state does not outlast a cycle: a sine may start in steady state.
STEADY = (
    "coulomb", "stribeck", "quad_damping", "cubic", "quadratic", "stopper", "bias", "hum",
    "crosstalk", "quantisation",
)  # fmt: skip
DRY = ("coulomb", "stribeck", "lugre")
# Effects that one frequency cannot tell from others.
BROAD = (
    "stiffness", "inertia", "viscous", "time_skew", "maxwell", "second_mode", "oil_column", "delay",
)  # fmt: skip


@dataclass
class Missing:
    """One effect of a case, in the place where it acts: specimen, sensors or actuator."""

    name: str
    params: dict[str, float]
    shape: dict[str, float]
    size: str  # the parameter that is scaled to reach a share
    onset_s: float = laws.NEVER

    @property
    def channel(self) -> str:
        return "disp" if self.name in (*DISP, "stroke_ripple") else "force"

    def scaled(self, factor: float) -> Missing:
        p = dict(self.params)
        if self.name == "hysteresis":
            p["alpha"] = 1 - min((1 - p["alpha"]) * factor, 0.97)
        elif self.name == "act_gain":
            p["gain"] = 1 + (p["gain"] - 1) * factor
        elif self.name == "oil_column":
            away = self.shape["away"] * factor
            return replace(self, params=_oil(self.shape, away), shape={**self.shape, "away": away})
        elif self.name == "rate_limit":
            p["vmax_m_s"] /= factor**0.7
        elif self.name == "stribeck":
            p["Fc_N"] *= factor
            p["Fs_N"] *= factor
        elif self.name == "lugre":
            p["Fc_N"] *= factor
            p["sigma0_N_m"] *= factor
        elif self.name in ("local_bump", "intermittent") and self.size in self.shape:
            return replace(self, shape={**self.shape, self.size: self.shape[self.size] * factor})
        else:
            p[self.size] *= factor
        return replace(self, params=p)


def _oil(shape: dict[str, float], away: float) -> dict[str, float]:
    """Frequency lowered and damping changed by a share `away` of what was drawn."""
    return {
        "f_Hz": shape["f0"] * shape["df"] ** away,
        "zeta": shape["zeta0"] * shape["dz"] ** away,
    }


def install(lab: bench.Lab, missing: list[Missing]) -> bench.Lab:
    """The lab with these effects in its true rig (and none of those it had)."""
    specimen, sensors, actuator = [], loops.Sensors(), lab.believed_actuator
    if actuator is not None:
        actuator = actuator.with_(delay_s=actuator.delay_s + lab.delay_offset_s)
    for m in missing:
        if m.name in laws.CODES:
            specimen.append(Effect(m.name, m.params, m.shape, m.onset_s))
        elif m.name in SENSOR:
            sensors = replace(sensors, **_sensor(m))
        elif actuator is not None:
            actuator = actuator.with_(**_actuator(m, actuator))
    return replace(
        lab, truth=replace(lab.truth, effects=tuple(specimen)), sensors=sensors, actuator=actuator
    )


def _sensor(m: Missing) -> dict[str, Any]:
    p = m.params
    return {
        "bias": lambda: {"bias": p["bias_N"]},
        "drift": lambda: {"drift": p["rate_N_s"]},
        "hum": lambda: {"hum_hz": p["f_Hz"], "hum": p["amp_N"], "hum_phase": m.shape["phase"]},
        "time_skew": lambda: {"skew_s": p["skew_s"]},
        "crosstalk": lambda: {"crosstalk": p["ratio"]},
        "quantisation": lambda: {"lsb": p["lsb_N"]},
    }[m.name]()


def _actuator(m: Missing, now: rigs.Actuator) -> dict[str, Any]:
    p = m.params
    match m.name:
        case "delay":
            return {"delay_s": now.delay_s + p["dtau_s"]}
        case "delay_rate":
            return {"kappa_s2_m": p["kappa_s2_m"]}
        case "act_gain":
            return {"gain": p["gain"]}
        case "oil_column":
            return {"f_hz": p["f_Hz"], "zeta": p["zeta"]}
        case "stroke_ripple":
            return {"ripple_m": p["amp_m"], "pitch_m": p["pitch_m"]}
        case "rate_limit":
            return {"vmax_m_s": p["vmax_m_s"], "limit_at": m.shape["limit_at"]}
        case other:
            raise ValueError(f"no change of an actuator is called {other!r}")


@dataclass
class Scale:
    """How large things are in the test at hand: peak displacement, rms speed, rms force."""

    x: float
    v: float
    f: float
    travel: float
    peak_v: float
    seconds: float
    f_std: float


def draw(name: str, lab: bench.Lab, s: Scale, rng: Rng) -> Missing:
    """An effect of a middling size (share of some per cent) for a test of this scale."""
    u = rng.uniform
    sign = 1.0 if rng.random() < 0.5 else -1.0
    k = lab.truth.k
    f = 0.1 * s.f
    free = lab.family in ("ground", "forced")
    shape: dict[str, float] = {}
    match name:
        case "stiffness":
            p, size = {"dk_ratio": sign * 0.1}, "dk_ratio"
        case "viscous":
            p, size = {"c_Ns_m": (1.0 if free or rng.random() < 0.7 else -1.0) * f / s.v}, "c_Ns_m"
        case "coulomb":
            p, size = {"Fc_N": f}, "Fc_N"
        case "stribeck":
            p = {"Fc_N": f, "Fs_N": f * u(1.6, 2.5), "vs_m_s": s.v * u(0.12, 0.3)}
            size = "Fc_N"
        case "lugre":
            p, size = {"Fc_N": f, "sigma0_N_m": f / (s.x * u(0.05, 0.2))}, "Fc_N"
        case "quad_damping":
            p, size = {"c2_Ns2_m2": f / (1.7 * s.v**2)}, "c2_Ns2_m2"
        case "inertia":
            p, size = {"m_kg": f / (s.v * 2 * math.pi * 2)}, "m_kg"
        case "gap":
            p, size = {"gap_m": f / k}, "gap_m"
            # The force behind a play returns more energy than it takes: a free body would swing up.
            shape = {"play": 1.0 if rng.random() < 0.2 and not free else 0.0}
        case "cubic":
            p, size = {"k3_N_m3": sign * 3 * f / s.x**3}, "k3_N_m3"
        case "quadratic":
            p, size = {"k2_N_m2": sign * 2 * f / s.x**2}, "k2_N_m2"
        case "stopper":
            p, size = {"ks_N_m": k * u(0.5, 3), "xs_m": s.x * u(0.55, 0.8)}, "ks_N_m"
            side = 0.0 if rng.random() < 0.75 else sign
            shape = {"side": side, "loss": u(0.2, 1.0)}
        case "hysteresis":
            p, size = {"xy_m": s.x * u(0.3, 0.55), "alpha": u(0.3, 0.8)}, "alpha"
            shape = {"spread": u(0.35, 0.85)}
        case "pinching":
            p, size = {"depth": u(0.3, 0.6), "width_ratio": u(0.3, 0.6)}, "depth"
        case "degradation":
            p, size = {"loss": u(0.1, 0.3), "travel_m": s.travel * u(0.1, 0.35)}, "loss"
        case "maxwell":
            p, size = {"km_N_m": k * u(0.1, 0.3), "tau_s": 10 ** u(-1.6, -0.7)}, "km_N_m"
        case "second_mode":
            p, size = {"m2_kg": f / (s.v * 12), "f2_Hz": u(2.2, 4.0)}, "m2_kg"
            shape = {"zeta": u(0.02, 0.05)}
        case "bias":
            p, size = {"bias_N": sign * f}, "bias_N"
        case "drift":
            p, size = {"rate_N_s": sign * f / s.seconds}, "rate_N_s"
        case "hum":
            p, size = {"f_Hz": float(rng.choice([16.7, 50.0, 60.0, 100.0])), "amp_N": f}, "amp_N"
            shape = {"phase": u(0, 2 * math.pi)}
        case "time_skew":
            p, size = {"skew_s": 2e-3 if lab.family == "loop" else sign * 2e-3}, "skew_s"
        case "crosstalk":
            p, size = {"ratio": sign * 0.15}, "ratio"
        case "quantisation":
            p, size = {"lsb_N": 2 * f}, "lsb_N"
        case "delay":
            p, size = {"dtau_s": 5e-3}, "dtau_s"
        case "delay_rate":
            p, size = {"kappa_s2_m": 5e-3 / s.v}, "kappa_s2_m"
        case "act_gain":
            p, size = {"gain": 1 + sign * 0.1}, "gain"
        case "oil_column":
            assert lab.believed_actuator is not None
            b = lab.believed_actuator
            shape = {
                "f0": b.f_hz,
                "zeta0": b.zeta,
                "df": u(0.55, 0.8),
                "dz": u(0.6, 1.3),
                "away": 1.0,
            }
            p, size = _oil(shape, 1.0), "f_Hz"
        case "rate_limit":
            p, size = {"vmax_m_s": s.peak_v * u(0.55, 0.75)}, "vmax_m_s"
            shape = {"limit_at": float(rng.integers(0, 2))}
        case "local_bump":
            p = {"x_m": sign * s.x * u(0.3, 0.6), "width_m": s.x * u(0.06, 0.12)}
            shape, size = {"force": 3 * f}, "force"
        case "cross_xv":
            p, size = {"b": sign * 4 * f / (s.x * s.v)}, "b"
        case "one_sided_damping":
            p, size = {"b": 2 * f / s.v}, "b"
        case "parametric_stiffness":
            p, size = {"depth": 0.1, "f_Hz": u(0.15, 0.6)}, "depth"
            shape = {"phase": u(0, 6)}
        case "cogging":
            p, size = {"amp_N": f, "pitch_m": s.x * u(0.15, 0.3)}, "amp_N"
            shape = {"phase": u(0, 6)}
        case "intermittent":
            t1 = u(3, 5)
            t3 = u(7, 9)
            shape = {"t1": t1, "t2": t1 + u(0.8, 1.6), "t3": t3, "t4": t3 + u(0.8, 1.6)}
            shape["pitch_m"] = s.x * u(0.4, 0.8)
            p, size = {"amp_N": 3 * f}, "amp_N"
        case "stroke_ripple":
            p, size = {"amp_m": 0.03 * s.x, "pitch_m": s.x * u(0.25, 0.5)}, "amp_m"
        case "wedge_friction":
            p, size = {"slope_N_m": 2 * f / s.x}, "slope_N_m"
        case "fading_stiffness":
            p, size = {"depth": 0.3, "tau_s": u(0.3, 1.0), "x_m": s.x * u(0.3, 0.6)}, "depth"
        case other:
            raise ValueError(f"no effect is called {other!r}")
    return Missing(name, p, shape, size)


def believable(m: Missing, lab: bench.Lab, s: Scale) -> bool:
    """Whether a sized effect is one that a laboratory could have, outside its stated tolerances."""
    p = m.params
    match m.name:
        case "stiffness":
            return 0.035 < abs(p["dk_ratio"]) < 0.5
        case "viscous":
            return abs(p["c_Ns_m"]) > 0.6 * lab.believed.c
        case "inertia":
            return lab.family != "forced" or p["m_kg"] > 0.035 * lab.believed.mass
        case "gap":
            return p["gap_m"] < 0.35 * s.x
        case "hysteresis":
            return 0.08 < p["alpha"] < 0.95
        case "degradation":
            return 0.03 < p["loss"] < 0.65
        case "pinching":
            return 0.08 < p["depth"] < 0.92
        case "stopper":
            return 0.05 * lab.truth.k < p["ks_N_m"] < 30 * lab.truth.k
        case "time_skew":
            return 4e-4 < abs(p["skew_s"]) < 6e-3
        case "delay":
            return 2.5e-4 < p["dtau_s"] < 1.5e-2
        case "quantisation":
            return p["lsb_N"] > 2 * s.f_std
        case "act_gain":
            return 0.012 < abs(p["gain"] - 1) < 0.4
        case "oil_column":
            return p["f_Hz"] > 6
        case "lugre":
            return True
        case "parametric_stiffness" | "fading_stiffness":
            return p["depth"] < 0.9
        case _:
            return True
