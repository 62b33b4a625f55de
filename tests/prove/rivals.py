"""Can the answer be known? The missing signal regressed on what every catalogue entry could give.

Truth and rivals are compared without noise, against the noise that the recording has: the misfit is
a chi-square of noise-free residuals, nuisances (stiffness, damping and mass inside the tolerances,
a channel offset inside its allowance) are fitted with their priors, and a rival pays log(n) for
each parameter, as in BIC. A case is called explained only if every rival set of one or two effects
is clearly worse, and ambiguous only if the named sets are equal and all others worse.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from prove import bench, effects, laws, rigs
from prove.laws import Effect

CLEAR = 20.0  # IC by which a rival must be worse
PARSIMONY = 8.0  # IC that one more parameter costs, less a little
EQUAL = 6.0  # IC within which sets are equally good
THIN = 2  # of the rows that are simulated, every second one is compared
POSITIVE = {
    "coulomb", "stribeck", "lugre", "quad_damping", "inertia", "gap", "stopper", "hysteresis",
    "pinching", "degradation", "maxwell", "second_mode",
}  # fmt: skip


@dataclass
class Column:
    """What one catalogue entry would add at unit size, with its other parameters held."""

    name: str
    signal: np.ndarray
    detail: str = ""


def law_force(run: bench.Run, lab: bench.Lab, effects_of: tuple[Effect, ...]) -> np.ndarray:
    """Base and laws along the recorded rows, one step a row: no state is at fine steps."""
    specimen = laws.Specimen(lab.truth.k, 0.0, 0.0, lab.truth.bouc_wen, effects_of)
    return laws.along(specimen, 0.0, lab.dt, run.x, run.v, run.a)


def force_columns(run: bench.Run, lab: bench.Lab, names: tuple[str, ...]) -> list[Column]:
    """Every force-side entry along this motion, nonlinear parameters on a grid."""
    k, x = lab.truth.k, run.x
    peak, travel = float(np.max(np.abs(x))), float(np.sum(np.abs(np.diff(x))))
    v_rms = float(np.std(run.v))
    bare = law_force(run, lab, ())
    out: list[Column] = []

    def add(name: str, params: dict[str, float], **shape: float) -> None:
        if name in names:
            detail = " ".join(f"{q}={w:.3g}" for q, w in (params | shape).items())
            signal = law_force(run, lab, (Effect(name, params, shape),)) - bare
            out.append(Column(name, signal, detail))

    add("stiffness", {"dk_ratio": 0.01})
    add("viscous", {"c_Ns_m": 1.0})
    add("coulomb", {"Fc_N": 1.0})
    for ratio, vs in itertools.product((1.5, 2.5), (0.06, 0.12, 0.25, 0.5)):
        add("stribeck", {"Fc_N": 1.0, "Fs_N": ratio, "vs_m_s": vs * v_rms})
    for share in (0.02, 0.05, 0.1, 0.2, 0.4, 0.8):
        add("lugre", {"Fc_N": 1.0, "sigma0_N_m": 1 / (share * peak)})
    add("quad_damping", {"c2_Ns2_m2": 1.0})
    add("inertia", {"m_kg": 1.0})
    for share in (0.01, 0.02, 0.05, 0.1, 0.2):
        add("gap", {"gap_m": share * peak})
        add("gap", {"gap_m": share * peak}, play=1.0)
    add("cubic", {"k3_N_m3": 1.0})
    add("quadratic", {"k2_N_m2": 1.0})
    for at, side in itertools.product((0.3, 0.45, 0.6, 0.7, 0.8, 0.9), (0.0, 1.0, -1.0)):
        add("stopper", {"ks_N_m": k, "xs_m": at * peak}, side=side)
    for xy in (0.15, 0.25, 0.4, 0.55, 0.75):
        add("hysteresis", {"xy_m": xy * peak, "alpha": 0.5})
    for width in (0.2, 0.35, 0.5, 0.7):
        add("pinching", {"depth": 0.5, "width_ratio": width})
    for way in (0.05, 0.15, 0.3, 0.6, 2.0):
        add("degradation", {"loss": 0.1, "travel_m": way * travel})
    for tau in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5):
        add("maxwell", {"km_N_m": 1.0, "tau_s": tau})
    for f in (1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 5.0, 7.0):
        add("second_mode", {"m2_kg": 1.0, "f2_Hz": f}, zeta=0.03)
    if "bias" in names:
        out.append(Column("bias", np.ones_like(x)))
    if "drift" in names:
        out.append(Column("drift", run.t.copy()))
    if "time_skew" in names:
        out.append(Column("time_skew", -np.gradient(run.f_true, lab.dt)))
        # A large one is no straight line in time: as it is, a dashpot may come nearer to it.
        for late in (-0.02, -0.01, -0.005, 0.005, 0.01, 0.02):
            moved = np.interp(run.t - late, run.t, run.f_true) - run.f_true
            out.append(Column("time_skew", moved, f"skew_s={late}"))
    if "crosstalk" in names and np.any(run.fy):
        out.append(Column("crosstalk", run.fy.copy()))
    return out


def nuisances(run: bench.Run, lab: bench.Lab) -> tuple[np.ndarray, np.ndarray]:
    """Columns (n, 4) of what tolerances allow, and the standard deviation of each."""
    elastic = law_force(run, lab, ())
    slope = np.gradient(run.f_true, lab.dt)
    columns = np.array([elastic, lab.truth.c * run.v, lab.truth.mass * run.a, slope]).T
    return columns, np.array([0.01, 0.15, 0.01, 6e-5])


@dataclass
class Verdicts:
    """Information criterion of each set of names, the true one apart: lower is better."""

    truth: float
    sets: dict[tuple[str, ...], float]

    def rivals(self, within: float) -> list[tuple[str, ...]]:
        return sorted(s for s, ic in self.sets.items() if ic - self.truth < within)


def compare(
    y: np.ndarray, columns: list[Column], nuisance: np.ndarray, prior: np.ndarray, sigma: float,
    true_names: tuple[str, ...], pairs: bool = True,
) -> Verdicts:  # fmt: skip
    """IC of the sets of one and two names against the missing signal y (n,), white noise sigma.

    The true set fits y exactly; sets that hold all of it are left out, they only cost more.
    """
    rows = slice(None, None, THIN)
    weight = THIN / sigma**2
    penalty = math.log(y.size)
    c = np.array([q.signal[rows] for q in columns]).T
    scale = np.sqrt(np.mean(c**2, axis=0))
    kept = scale > 0
    names = [q.name for q, keep in zip(columns, kept, strict=True) if keep]
    c = c[:, kept] / scale[kept]
    b = nuisance[rows]
    normal = weight * b.T @ b + np.diag(1 / prior**2)
    everything = np.column_stack((c, y[rows]))
    cross = weight * b.T @ everything
    gram = weight * everything.T @ everything - cross.T @ np.linalg.solve(normal, cross)
    g, q, rest = gram[:-1, :-1], gram[:-1, -1], gram[-1, -1]
    diagonal = np.maximum(np.diag(g), 1e-12)
    truth = set(true_names)
    sets: dict[tuple[str, ...], float] = {(): float(rest)}

    def note(key: tuple[str, ...], chi2: float) -> None:
        if truth and truth <= set(key):
            return
        ic = chi2 + penalty * sum(effects.COUNT[n] for n in key)
        sets[key] = min(sets.get(key, np.inf), float(ic))

    allowed = np.array([n not in POSITIVE for n in names])
    for i, name in enumerate(names):
        gain = q[i] ** 2 / diagonal[i] if allowed[i] or q[i] > 0 else 0.0
        note((name,), rest - gain)
    if pairs:
        d = diagonal[:, None] * diagonal[None, :] - g**2
        d = np.where(d > 1e-9 * diagonal[:, None] * diagonal[None, :], d, np.inf)
        s1 = (q[:, None] * diagonal[None, :] - q[None, :] * g) / d
        s2 = (q[None, :] * diagonal[:, None] - q[:, None] * g) / d
        gain = s1 * q[:, None] + s2 * q[None, :]
        fine = (allowed[:, None] | (s1 > 0)) & (allowed[None, :] | (s2 > 0))
        gain = np.where(fine, gain, 0.0)
        for i, j in itertools.combinations(range(len(names)), 2):
            if names[i] != names[j] and gain[i, j] > 0:
                note(tuple(sorted((names[i], names[j]))), rest - gain[i, j])
    return Verdicts(penalty * sum(effects.COUNT.get(n, 0) for n in true_names), sets)


def effective_sigma(lab: bench.Lab) -> float:
    """Noise of the force residual: cell or accelerometer, and the model along noisy x."""
    f = lab.noise.f if lab.cell else lab.mass * lab.noise.a
    return math.hypot(f, lab.truth.k * lab.noise.x)


def judge_force(
    y: np.ndarray, run: bench.Run, lab: bench.Lab, true_names: tuple[str, ...], pairs: bool = True
) -> Verdicts:
    """Rivals of a missing force y (n,) in the catalogue of this family."""
    where = effects.WHERE["drive" if lab.family in ("drive", "loop") else lab.family]
    if not lab.cell:
        where = effects.FREE_CELL
    names = tuple(n for n in where if n not in effects.DISP)
    if lab.truth.bouc_wen:
        names = tuple(n for n in names if n not in effects.STRUCTURAL or n == "stiffness")
    sigma = effective_sigma(lab)
    if lab.fs > 500:  # half the rows, each worth two, hold the same
        run, lab = _halved(run, lab)
        y, sigma = y[::2], sigma / math.sqrt(2)
    b, prior = nuisances(run, lab)
    return compare(y, force_columns(run, lab, names), b, prior, sigma, true_names, pairs)


def _halved(run: bench.Run, lab: bench.Lab) -> tuple[bench.Run, bench.Lab]:
    rows = {n: getattr(run, n)[::2] for n in ("t", "x", "v", "a", "f_true", "fy")}
    return replace(run, **rows), replace(lab, fs=lab.fs / 2)


def judge_disp(run: bench.Run, lab: bench.Lab, true_names: tuple[str, ...]) -> Verdicts:
    """Rivals of a changed actuator, each fitted to the true displacement by least squares."""
    assert lab.believed_actuator is not None
    assert run.x_cmd is not None
    believed, x_cmd, x_true = lab.believed_actuator, run.x_cmd, run.x
    sigma = lab.noise.x
    peak_v = float(np.max(np.abs(run.v)))
    starts: dict[str, tuple[tuple[str, float], ...]] = {
        "delay": (("delay_s", 2e-3),),
        "act_gain": (("gain", 0.05),),
        "oil_column": (("f_hz", -4.0), ("zeta", 0.1)),
        "delay_rate": (("kappa_s2_m", 2e-3 / max(peak_v, 1e-6)),),
        "rate_limit": (("vmax_m_s", 0.8 * peak_v),),
    }
    rows = slice(None, None, 8)
    sets: dict[tuple[str, ...], float] = {}
    penalty = math.log(x_true.size)
    for count in range(1, max(len(true_names), 1) + 1):
        for key in itertools.combinations(sorted(starts), count):
            if true_names and set(true_names) <= set(key):
                continue
            fields = [item for name in key for item in starts[name]]

            def miss(p: np.ndarray, fields: list[tuple[str, float]] = fields) -> np.ndarray:
                changed = {
                    n: getattr(believed, n) + s * q for (n, s), q in zip(fields, p, strict=True)
                }
                changed["delay_s"] = max(changed.get("delay_s", believed.delay_s), 0.0)
                for n in ("f_hz", "zeta"):
                    if n in changed:
                        changed[n] = max(changed[n], 0.2)
                x = rigs.track(x_cmd, lab.dt, believed.with_(**changed))[0][:: rigs.FINE]
                return (x - x_true)[rows] / sigma * math.sqrt(8)

            fit = least_squares(miss, np.full(len(fields), 0.5), max_nfev=9, diff_step=1e-3)
            sets[key] = 2 * fit.cost + penalty * sum(effects.COUNT[n] for n in key)
    return Verdicts(penalty * sum(effects.COUNT[n] for n in true_names), sets)


# ---- how well each parameter can be known ------------------------------------------------------


def spread_of_parameters(
    run: bench.Run, lab: bench.Lab, missing: list[effects.Missing]
) -> list[dict[str, float]]:
    """Least relative standard deviation of every parameter (Cramer-Rao), nuisances with priors.

    Derivatives by central differences of 2 % along the true motion; hum and rounding are not asked.
    """
    columns, keys = [], []
    disp = any(m.channel == "disp" for m in missing)
    for i, m in enumerate(missing):
        if m.name in ("quantisation", "hum") or (disp and m.channel != "disp"):
            continue
        for name, value in m.params.items():
            lift = 0.02 * (abs(value - 1) if m.name == "act_gain" else abs(value))
            ends = []
            for sign in (1.0, -1.0):
                changed = replace(m, params={**m.params, name: value + sign * lift})
                ends.append(_outcome(run, lab, [*missing[:i], changed, *missing[i + 1 :]], disp))
            columns.append((ends[0] - ends[1]) / (2 * lift / abs(value)))
            keys.append((i, name))
    out: list[dict[str, float]] = [{} for _ in missing]
    if not columns:
        return out
    c = np.array(columns).T
    sigma = lab.noise.x if disp else effective_sigma(lab)
    fisher = c.T @ c / sigma**2
    if not disp:
        b, prior = nuisances(run, lab)
        # A missing stiffness, damping, mass or skew is stated against the model: tolerance and all.
        names = {m.name for m in missing}
        own = [n not in names for n in ("stiffness", "viscous", "inertia", "time_skew")]
        b, prior = b[:, own], prior[own]
        cross = b.T @ c / sigma**2
        fisher -= cross.T @ np.linalg.solve(b.T @ b / sigma**2 + np.diag(1 / prior**2), cross)
    variance = np.diag(np.linalg.pinv(fisher, rcond=1e-13))
    for (i, name), value in zip(keys, variance, strict=True):
        out[i][name] = math.sqrt(max(float(value), 0.0))
    return out


def _outcome(
    run: bench.Run, lab: bench.Lab, missing: list[effects.Missing], disp: bool
) -> np.ndarray:
    """Displacement or force of the rig with these effects, row by row, along the true motion."""
    fitted = effects.install(lab, missing)
    if disp:
        assert fitted.actuator is not None
        assert run.x_cmd is not None
        return rigs.track(run.x_cmd, lab.dt, fitted.actuator)[0][:: rigs.FINE]
    t = run.t
    truth = replace(fitted.truth, c=0.0, mass=0.0)
    f = laws.along(truth, 0.0, lab.dt, run.x, run.v, run.a)
    if fitted.sensors.skew_s:
        f = f - fitted.sensors.skew_s * np.gradient(run.f_true, lab.dt)
    return fitted.sensors.clean(t, f, run.fy)
