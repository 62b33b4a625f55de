"""The kinds of cases: what is drawn for each, and when it is a fair one."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from prove import bench, effects, laws, rivals
from prove.answers import Case, finish
from prove.effects import Missing, Scale
from prove.excitations import NEXT_KINDS
from prove.prepare import (
    SHARES,
    Prepared,
    Redraw,
    Wanted,
    contribution,
    draw_lab,
    prepare,
    rms,
    scaled_run,
)

Rng = np.random.Generator


def clear(verdicts: rivals.Verdicts) -> None:
    near = verdicts.rivals(rivals.CLEAR)
    if near:
        raise Redraw(f"not to be told from {near[:4]}")


def judge(ready: Prepared) -> None:
    """Refuse a case whose answer its recording does not hold."""
    lab, run = ready.lab, ready.run
    disp = [m.name for m in ready.missing if m.channel == "disp"]
    if disp:
        clear(rivals.judge_disp(run, lab, tuple(disp)))
    parts = zip(ready.missing, ready.parts, strict=True)
    # A grid of levels or a spectral line is like nothing else.
    special = ("quantisation", "hum")
    countable = [(m, y) for m, y in parts if m.channel == "force" and m.name not in special]
    if countable:
        y = np.sum([p for _, p in countable], axis=0)
        clear(rivals.judge_force(y, run, lab, tuple(m.name for m, _ in countable)))


def draws_for(w: Wanted, lab: bench.Lab, rng: Rng) -> list[Callable[[Scale], Missing]]:
    return [lambda s, n=n: effects.draw(n, lab, s, rng) for n in w.names]


def single(w: Wanted, rng: Rng) -> Case:
    lab = draw_lab(w, rng)
    onset = rng.uniform(4.5, 8.0) if "onset" in w.groups else laws.NEVER

    def one(s: Scale) -> Missing:
        return replace(effects.draw(w.names[0], lab, s, rng), onset_s=onset)

    ready = prepare(w, lab, rng, [share_of(w.names[0], w, rng)], [one])
    snr = rms(ready.parts[0]) / rivals.effective_sigma(ready.lab)
    if ready.missing[0].channel == "force" and snr < (0.4 if w.tier == "faint" else 0.7):
        raise Redraw(f"lost in noise: {snr:.2f}")
    judge(ready)
    return finish(w, ready, rng, "explained")


def share_of(name: str, w: Wanted, rng: Rng) -> float:
    """A share of the wished tier.

    A skew is small; near resonance the balance of forces hides mass and spring.
    """
    tier = "late" if name == "time_skew" and w.tier != "faint" else w.tier
    boost = 2.5 if w.family == "forced" and name in ("stiffness", "inertia") else 1.0
    return boost * rng.uniform(*SHARES[tier])


def pair(w: Wanted, rng: Rng) -> Case:
    lab = draw_lab(w, rng)
    tiers = rng.choice(["medium", "strong"], 2)
    shares = [
        share_of(n, replace(w, tier=str(q)), rng) for n, q in zip(w.names, tiers, strict=True)
    ]
    ready = prepare(w, lab, rng, shares, draws_for(w, lab, rng))
    judge(ready)
    return finish(w, ready, rng, "explained")


def opposed(m: Missing, other: str, turn: float, lab: bench.Lab) -> Missing:
    """One of a cancelling pair, its sign such that it works against the other."""
    p = dict(m.params)
    if m.name == "viscous":
        p["c_Ns_m"] = -abs(p["c_Ns_m"])
    elif m.name == "time_skew":
        p["skew_s"] = abs(p["skew_s"])
    elif m.name == "cubic":
        p["k3_N_m3"] = turn * abs(p["k3_N_m3"])
    elif m.name == "stiffness":
        sign = {"cubic": -turn, "stopper": -1.0}.get(other, 1.0)
        p["dk_ratio"] = sign * abs(p["dk_ratio"])
    elif m.name == "oil_column":
        b = lab.believed_actuator
        assert b is not None
        shape = {"f0": b.f_hz, "zeta0": b.zeta, "df": 1.3, "dz": 0.8, "away": 1.0}
        return Missing(m.name, {"f_Hz": b.f_hz * 1.3, "zeta": b.zeta * 0.8}, shape, "f_Hz")
    return replace(m, params=p)


def cancel(w: Wanted, rng: Rng) -> Case:
    """Two effects that nearly cancel: signs opposed, sizes alike."""
    lab = draw_lab(w, rng)
    first = share_of(w.names[0], replace(w, tier="medium"), rng) * rng.uniform(1.0, 1.6)
    turn = -1.0 if rng.random() < 0.5 else 1.0

    def drawn(name: str, other: str) -> Callable[[Scale], Missing]:
        return lambda s: opposed(effects.draw(name, lab, s, rng), other, turn, lab)

    a, b = w.names
    shares = [first, first * rng.uniform(0.6, 1.1)]
    ready = prepare(w, lab, rng, shares, [drawn(a, b), drawn(b, a)])
    judge(ready)
    case = finish(w, ready, rng, "explained")
    if case.answer["cancel_ratio"] > 0.75:
        raise Redraw(f"does not cancel: {case.answer['cancel_ratio']:.2f}")
    return case


def unknown(w: Wanted, rng: Rng) -> Case:
    """A law of no catalogue, which no one or two entries of it come near."""
    lab = draw_lab(w, rng)
    shares = [rng.uniform(*SHARES[str(rng.choice(["medium", "strong"]))])]
    ready = prepare(w, lab, rng, shares, draws_for(w, lab, rng))
    y = ready.parts[0]
    if ready.missing[0].channel == "disp":
        verdicts = rivals.judge_disp(ready.run, ready.lab, ())
        whole = float(np.sum(y**2)) / ready.lab.noise.x**2
    else:
        verdicts = rivals.judge_force(y, ready.run, ready.lab, ())
        whole = verdicts.sets[()]
    least = min((ic, s) for s, ic in verdicts.sets.items())
    if least[0] < max(0.15 * whole, 400.0):
        raise Redraw(f"{least[1]} leaves {least[0] / whole:.2f} of the misfit")
    return finish(w, ready, rng, "unknown")


def dormant(w: Wanted, rng: Rng) -> Case:
    """Present, never reached: the true answer for this recording is that nothing is missing."""
    lab = draw_lab(w, rng)

    def sleeping(s: Scale) -> Missing:
        m = effects.draw(w.names[0], lab, s, rng)
        p, shape = dict(m.params), dict(m.shape)
        beyond = rng.uniform(1.15, 1.5)
        if m.name == "stopper":
            p["xs_m"] = s.x * beyond
        elif m.name == "hysteresis":
            p["xy_m"] = s.x * beyond / (1 - shape["spread"])
        elif m.name == "rate_limit":
            p["vmax_m_s"] = s.peak_v * beyond * 1.3
        elif m.name == "local_bump":
            p["x_m"] = math.copysign(s.x * beyond + 6 * p["width_m"], p["x_m"])
        return replace(m, params=p, shape=shape)

    ready = prepare(w, lab, rng, [0.0], [sleeping])
    whole = rms(ready.run.x) if ready.missing[0].channel == "disp" else rms(ready.run.f)
    if rms(ready.parts[0]) > 1e-3 * whole:
        raise Redraw("it acts")
    ready.parts[0] = np.zeros_like(ready.parts[0])
    return finish(w, ready, rng, "none")


AMBIGUOUS = {
    "spring_or_mass": ("inertia", "stiffness"),
    "damper_or_late_cell": ("time_skew", "viscous"),
    "rate_unknown": ("coulomb", "quad_damping", "viscous"),
}


def ambiguous(w: Wanted, rng: Rng) -> Case:
    """One of several effects that this one frequency, or this one speed, cannot tell apart."""
    group = AMBIGUOUS[w.names[0]]
    name = str(rng.choice(group))
    w = replace(w, names=(name,))
    lab = draw_lab(w, rng)
    ready = prepare(w, lab, rng, [share_of(name, w, rng)], draws_for(w, lab, rng))
    lab, run, y = ready.lab, ready.run, ready.parts[0]
    verdicts = rivals.judge_force(y, run, lab, (name,))
    for rival in group:
        worse = verdicts.sets.get((rival,), verdicts.truth) - verdicts.truth
        if rival != name and worse > rivals.EQUAL:
            raise Redraw(f"{rival} is told from {name} by {worse:.0f}")
    others = [s for s in verdicts.rivals(rivals.PARSIMONY) if not set(s) & set(group)]
    if others:
        raise Redraw(f"{others[:3]} fit as well")
    # Linear effects part by frequency; another amplitude shows nothing new in principle.
    kinds = [k for k in NEXT_KINDS if w.quasi_static or k != "multi_amplitude"]
    tried = {k: another_experiment(ready, group, name, k, rng) for k in kinds}
    best = max(gap for _, gap in tried.values())
    # What parts them only at its edges is not what a laboratory should run.
    separating = {k: r for k, (r, gap) in tried.items() if gap > max(3 * rivals.CLEAR, 0.1 * best)}
    if not {"sweep", "random", "multi_frequency"} <= set(separating):
        raise Redraw(f"only {list(separating)} separate them")
    case = finish(w, ready, rng, "ambiguous", list(group), list(separating))
    case.follow_ups = separating
    return case


def another_experiment(
    ready: Prepared, group: tuple[str, ...], name: str, kind: str, rng: Rng
) -> tuple[bench.Run, float]:
    """Another experiment on the same rig, and the least IC by which it parts the true effect."""
    lab = ready.lab
    test = bench.plan_test(lab, kind, 400.0 if lab.fs < 500 else 16.0, rng)
    peak = float(np.max(np.abs(ready.run.x)))
    test.scale = ready.test.scale
    run = scaled_run(lab, test, peak, int(rng.integers(2**62)), ready.fy_rms)
    y = contribution(lab, run, ready.missing, 0)
    verdicts = rivals.judge_force(y, run, lab, (name,), pairs=False)
    return run, min(verdicts.sets[(r,)] - verdicts.truth for r in group if r != name)


def null(w: Wanted, rng: Rng) -> Case:
    lab = draw_lab(w, rng)
    return finish(w, prepare(w, lab, rng, [], []), rng, "none")


KINDS: dict[str, Callable[[Wanted, Rng], Case]] = {
    "single": single, "null": null, "pair": pair, "cancel": cancel, "unknown": unknown,
    "dormant": dormant, "ambiguous": ambiguous,
}  # fmt: skip
