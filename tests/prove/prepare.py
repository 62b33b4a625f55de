"""A wish made into a test: the laboratory drawn, excitation and effects brought to their sizes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from prove import bench, effects, laws, rigs, rivals
from prove.effects import Missing, Scale

Rng = np.random.Generator

SHARES = {
    "weak": (0.035, 0.07), "medium": (0.08, 0.12), "strong": (0.16, 0.24),
    "faint": (0.003, 0.009), "late": (0.012, 0.05),
}  # fmt: skip
F_NOISE = {"low": (0.003, 0.01), "mid": (0.01, 0.027), "high": (0.04, 0.064)}
X_NOISE = {"low": (0.0003, 0.0012), "mid": (0.001, 0.0027), "high": (0.003, 0.0045)}
PEAKS = {"drive": (0.005, 0.0106), "loop": (0.0035, 0.0085), "ground": (0.004, 0.0085)}
PEAKS |= {"forced": (0.004, 0.009), "quasi_static": (0.005, 0.02)}


class Redraw(Exception):
    """This draw gives no fair case; the next attempt draws again."""


@dataclass
class Wanted:
    """What a case shall be, before anything is drawn."""

    kind: str
    family: str
    names: tuple[str, ...] = ()
    noise: str = "mid"
    tier: str = "medium"
    excitation: str = ""
    groups: tuple[str, ...] = ()
    quasi_static: bool = False


def draw_lab(w: Wanted, rng: Rng) -> bench.Lab:
    """A rig and the model of it, nothing missing yet, parameters off within the tolerances."""
    u = rng.uniform
    family = w.family
    k = 10 ** u(5.48, 6.04)
    period = u(0.42, 0.85)
    mass = k * (period / (2 * math.pi)) ** 2
    c = 2 * u(0.003, 0.03) * math.sqrt(k * mass)
    moving = {"drive": u(20, 80), "loop": u(20, 80), "ground": 0.0, "forced": mass}[family]
    if family == "forced" or family == "ground":
        c = 2 * u(0.02, 0.04) * math.sqrt(k * mass)
    if w.quasi_static:
        c, moving = 0.0, 0.0
    bouc_wen = None
    plain = w.quasi_static or family == "forced" or w.kind in ("ambiguous", "dormant")
    if rng.random() < 0.25 and not plain and not set(w.names) & set(effects.STRUCTURAL):
        bouc_wen = {"alpha": u(0.15, 0.4), "xy": u(0.003, 0.006)}
    off = rng.standard_normal(3).clip(-1.8, 1.8) * (0.005, 0.06, 0.005)
    believed = laws.Specimen(k, c, moving, bouc_wen)
    truth = laws.Specimen(k * (1 + off[0]), c * (1 + off[1]), moving * (1 + off[2]), bouc_wen)
    actuator = None
    if family in ("drive", "loop") and not w.quasi_static:
        actuator = rigs.Actuator(u(0.0031, 0.0084), u(22.0, 38.5), u(0.8, 0.98))
    lab = bench.Lab(
        family, 1024.0 if not w.quasi_static else 16.0, truth, believed,
        mass=mass if family in ("ground", "loop") else 0.0,
        damping=2 * u(0.012, 0.025) * math.sqrt(k * mass) if family == "loop" else 0.0,
        actuator=actuator, believed_actuator=actuator, cell="no_cell" not in w.groups,
        rate=10 ** u(-4.3, -2.3),
    )  # fmt: skip
    if "offset" in w.groups or (w.kind != "ambiguous" and rng.random() < 0.4):
        size = 1e-4 if "offset" in w.groups else u(0, 1e-4)
        signs = rng.choice([-1.0, 1.0], 3)
        lab.f_offset_s, lab.a_offset_s, lab.delay_offset_s = size * signs
    if w.quasi_static:
        lab.f_offset_s = 0.0
    return lab


def scale_of(run: bench.Run, f_std: float) -> Scale:
    f = run.f_true - np.mean(run.f_true)
    return Scale(
        float(np.max(np.abs(run.x))), float(np.std(run.v)), float(np.std(f)),
        float(np.sum(np.abs(np.diff(run.x)))), float(np.max(np.abs(run.v))), float(run.t[-1]),
        f_std,
    )  # fmt: skip


def contribution(lab: bench.Lab, run: bench.Run, missing: list[Missing], i: int) -> np.ndarray:
    """What effect i adds along the true motion, row by row: N, or m for the actuator's."""
    m = missing[i]
    h = lab.dt / rigs.FINE
    if m.name in laws.CODES:
        index = sum(q.name in laws.CODES for q in missing[:i])
        rest = laws.along(lab.truth.without(index), 0.0, h, *run.fine)[:: rigs.FINE]
        if lab.family in ("ground", "forced"):
            return run.f_true - rest
        return laws.along(lab.truth, 0.0, h, *run.fine)[:: rigs.FINE] - rest
    if m.channel == "disp":
        others = effects.install(lab, [q for j, q in enumerate(missing) if j != i]).actuator
        assert others is not None
        assert run.x_cmd is not None
        return run.x - rigs.track(run.x_cmd, lab.dt, others)[0][:: rigs.FINE]
    if m.name == "time_skew":
        late = np.interp(run.t - lab.sensors.skew_s, run.t, run.f_true)
        return late - run.f_true
    if m.name == "quantisation":
        return lab.sensors.rounded(run.f) - run.f
    alone = effects.install(lab, [m]).sensors
    return alone.clean(run.t, np.zeros_like(run.t), run.fy)


def rms(y: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(y))))


@dataclass
class Prepared:
    lab: bench.Lab
    test: bench.Test
    run: bench.Run
    missing: list[Missing]
    parts: list[np.ndarray]
    fy_rms: float


def set_noise(lab: bench.Lab, w: Wanted, run: bench.Run, rng: Rng) -> bench.Lab:
    u = rng.uniform
    f = float(np.std(run.f_true)) * u(*F_NOISE[w.noise])
    if w.family == "forced":
        f = float(np.std(run.f_true)) * 3e-4
    noise = bench.Noise(rms(run.x) * u(*X_NOISE[w.noise]), f, 10 ** u(-2.6, -1.7), u(0.82, 1.18))
    return replace(lab, noise=noise)


def scaled_run(
    lab: bench.Lab, test: bench.Test, peak: float, seed: int, fy_rms: float
) -> bench.Run:
    """The test repeated until its displacement peaks at the wanted value."""
    for _ in range(4):
        run = bench.perform(lab, test, np.random.default_rng(seed), fy_rms)
        reached = float(np.max(np.abs(run.x)))
        if not np.isfinite(reached) or not run.stable:
            test.scale *= 0.5
            continue
        if abs(reached / peak - 1) < 0.06:
            return run
        test.scale *= min(max(peak / max(reached, 1e-9), 0.2), 5.0)
    if not run.stable:
        raise Redraw("unstable")
    return run


def prepare(
    w: Wanted,
    lab: bench.Lab,
    rng: Rng,
    shares: list[float],
    draws: list[Callable[[Scale], Missing]],
) -> Prepared:
    """Excitation and effects scaled until the shares of the wanted tiers are met."""
    seed = int(rng.integers(2**62))
    seconds = 16.0
    kind = w.excitation
    if kind == "sine":
        seconds = 12.0
    elif w.quasi_static:
        seconds = 400.0
    test = bench.plan_test(lab, kind, seconds, rng)
    low, high = PEAKS["quasi_static" if w.quasi_static else w.family]
    peak = rng.uniform(low, high) * (0.5 if kind == "small" else 1.0)
    test.scale = (
        peak if lab.family == "drive" else 0.02 * lab.believed.k * peak / max(lab.mass, 1.0)
    )
    if lab.family == "forced":
        test.scale = 0.3 * lab.believed.k * peak
    run = scaled_run(lab, test, peak, seed, 0.0)
    lab = set_noise(lab, w, run, rng)
    fy_rms = rng.uniform(0.25, 0.55) * float(np.std(run.f_true))
    scale = scale_of(run, lab.noise.f)
    missing = [d(scale) for d in draws]
    if lab.family == "drive":
        missing = size_coarsely(lab, run, missing, shares)
    for _ in range(8):
        fitted = effects.install(lab, missing)
        run = scaled_run(fitted, test, peak, seed, fy_rms)
        if not (rms(run.x) > 0 and rms(run.f) > 0):
            raise Redraw("with these effects nothing moves")
        parts = [contribution(fitted, run, missing, i) for i in range(len(missing))]
        if any(not np.all(np.isfinite(p)) for p in parts):
            raise Redraw("not finite")
        now = [
            rms(p) / (rms(run.x) if m.channel == "disp" else rms(run.f))
            for p, m in zip(parts, missing, strict=True)
        ]
        if all(abs(a / b - 1) < 0.15 for a, b in zip(now, shares, strict=True) if b > 0):
            break
        missing = [
            m.scaled(min(max(b / max(a, 1e-6), 0.3), 3.0)) if b > 0 else m
            for m, a, b in zip(missing, now, shares, strict=True)
        ]
    else:
        raise Redraw(f"sizes {now} instead of {shares}")
    sized = [m for m, b in zip(missing, shares, strict=True) if b > 0]
    if not all(effects.believable(m, fitted, scale) for m in sized):
        raise Redraw("not believable")
    return Prepared(fitted, test, run, missing, parts, fy_rms)


def size_coarsely(
    lab: bench.Lab, run: bench.Run, missing: list[Missing], shares: list[float]
) -> list[Missing]:
    """Laws of the specimen brought near their shares at row steps; they leave this motion alone."""
    bare = rivals.law_force(run, lab, ())
    sized = []
    for m, share in zip(missing, shares, strict=True):
        for _ in range(6):
            if m.name not in laws.CODES or share == 0:
                break
            effect = laws.Effect(m.name, m.params, m.shape, m.onset_s)
            now = rms(rivals.law_force(run, lab, (effect,)) - bare) / rms(run.f_true)
            if abs(now / share - 1) < 0.1:
                break
            m = m.scaled(min(max(share / max(now, 1e-6), 0.3), 3.0))
        sized.append(m)
    return sized


def hold_out(w: Wanted, ready: Prepared, rng: Rng) -> tuple[bench.Run, str]:
    """A second test of another excitation, somewhat larger, on the same rig as new."""
    kinds = [k for k in effects.HELD_OUT if k != w.excitation]
    kind = str(rng.choice(kinds))
    seconds = 16.0
    if w.quasi_static:
        kind, seconds = "quasi_static", 300.0
    lab = ready.lab
    test = bench.plan_test(lab, kind, seconds, rng)
    peak = float(np.max(np.abs(ready.run.x))) * rng.uniform(1.0, 1.12)
    if w.excitation == "small":
        peak *= 2.2
    test.scale = ready.test.scale * (peak / float(np.max(np.abs(ready.run.x))))
    # An onset lies before the second recording.
    early = replace(
        lab, truth=replace(lab.truth, effects=tuple(
            replace(e, onset_s=laws.NEVER) for e in lab.truth.effects))
    )  # fmt: skip
    run = scaled_run(early, test, peak, int(rng.integers(2**62)), ready.fy_rms)
    return run, kind
