"""Cases of every kind: drawn, performed, judged, and drawn again until the answer can be known."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from validate import drawn, fairness, laws, motion, rig, signals
from validate.drawn import Size
from validate.fairness import Blocks, Scale
from validate.motion import Actuator
from validate.rig import Bench, Effect, Redraw, Run
from validate.signals import Noise, Rng, rms

KINDS = ("single", "pair", "triple", "cancel", "null", "dormant", "ambiguous", "unknown")
FAMILIES = ("drive", "ground", "forced", "loop")
# What they remember when a recording begins in mid-motion cannot be known, and lasts.
HISTORY = (
    "degradation", "pinching", "hysteresis", "second_mode", "sloshing", "fractional_memory",
)  # fmt: skip
RUN_AWAY = 30.0  # times the wanted displacement: a closed loop that grows without bound
LARGEST = 0.5  # of the signal: what is more is another rig, not an effect
FADING = ("viscous", "coulomb", "stiffness", "cubic", "gap", "quad_damping", "bias", "hum")
# Alike at their ends: which of such two it is may be a matter of words.
KIN = ({"coulomb", "stribeck", "lugre", "hysteresis"}, {"pinching", "hysteresis", "degradation"})
CANCELLING = (
    ("coulomb", "viscous"), ("stiffness", "cubic"), ("stiffness", "inertia"),
    ("quad_damping", "viscous"), ("gap", "stiffness"), ("bias", "quadratic"),
    ("stopper", "stiffness"),
)  # fmt: skip


@dataclass
class Case:
    """A case that is fair: what is written, and the truth beside it."""

    kind: str
    level: str
    bench: Bench
    effects: list[Effect]
    run: Run
    held: Run
    held_signal: np.ndarray
    excitation: tuple[str, str]
    verdict: str
    groups: list[str]
    judged: dict[str, Any]
    ambiguous: list[list[str]] = field(default_factory=list)
    next_experiment: list[str] = field(default_factory=list)
    drop: tuple[str, ...] = ()
    nan_rows: tuple[tuple[int, int], ...] = ()


@dataclass
class Plan:
    """What a case is to be, before its numbers are drawn."""

    kind: str
    level: str
    names: tuple[str, ...]
    family: str
    groups: list[str] = field(default_factory=list)
    test: str = ""
    f0: float = 0.0


# ---- the laboratory ----------------------------------------------------------------------------


def _actuator(plan: Plan, k: float, reach: float, rng: Rng) -> Actuator:
    kind = str(rng.choice(["second", "second", "first", "pure", "hydraulic"]))
    if any(n in drawn.ACTUATOR for n in plan.names) or plan.kind == "ambiguous":
        kind = str(rng.choice(["second", "second", "first"]))
    if plan.test == "triangle":  # a fast one, which turns quickly
        return Actuator("second", rng.uniform(0.002, 0.008), rng.uniform(60, 100), 0.8)
    if plan.family == "loop" and kind in ("hydraulic", "pure"):
        kind = "second"
    delay = rng.uniform(0.002, 0.008)
    if kind == "first":  # one slow pole and that of a fast valve: the sheet can say it exactly
        return motion.stated(Actuator("first", delay, rng.uniform(8, 25)))
    if kind == "pure":
        return Actuator("pure", delay, 400.0, 0.7)
    if kind == "hydraulic":
        stall = k * reach * rng.uniform(3, 8)
        f, zeta = rng.uniform(35, 70), rng.uniform(0.15, 0.4)
        return Actuator("hydraulic", delay, f, zeta, stall_n=stall, load_k=k)
    return Actuator("second", delay, rng.uniform(18, 40), rng.uniform(0.55, 1.1))


def _noises(level: str, x: float, f: float, a: float, rng: Rng) -> tuple[Noise, Noise, Noise]:
    """Noise of each channel from its rms, with a sheet that is wrong by up to a fifth."""
    worse = 1.0 if level == "normal" else 2.5

    def one(size: float, low: float, high: float) -> Noise:
        colour = str(rng.choice(signals.COLOURS, p=[0.4, 0.15, 0.15, 0.15, 0.15]))
        std = worse * size * np.exp(rng.uniform(np.log(low), np.log(high)))
        return Noise(float(std), rng.uniform(0.8, 1.2), colour, rng.uniform(25, 120))

    return one(x, 1e-4, 8e-4), one(f, 0.003, 0.012), one(a, 0.005, 0.02)


def _bench(plan: Plan, rng: Rng) -> tuple[Bench, float, float]:
    """A rig with noises still of unit size, the motion's reach and its frequency."""
    k = math.exp(rng.uniform(math.log(2e5), math.log(2e6)))
    f0 = plan.f0 or rng.uniform(0.9, 2.6)
    w = 2 * math.pi * f0
    reach, family = rng.uniform(0.004, 0.015), plan.family
    free = family in ("ground", "forced")
    zeta = rng.uniform(0.02, 0.06)
    whole = k / w**2
    c = 2 * zeta * whole * w * (1.0 if free else rng.uniform(0.1, 0.8))
    moving = {"ground": 0.0, "forced": whole}.get(family, whole * rng.uniform(0.003, 0.05))
    actuator = None if free else _actuator(plan, k, reach, rng)
    if actuator is not None and actuator.kind == "pure":
        moving = 0.0
    core = None
    if "pinching" in plan.names or (family in ("drive", "loop") and rng.random() < 0.12):
        core = (k, rng.uniform(0.1, 0.4), reach * rng.uniform(0.25, 0.45))
    unit = Noise(1.0)
    limited = np.clip(rng.standard_normal(2), -1.5, 1.5)
    k_true = k * (1 + 0.01 * limited[0])
    if core is not None:  # a stiffness that is stated wrong is that of the whole loop
        core = (k_true, *core[1:])
    bench = Bench(
        family, float(rng.choice([512.0, 1000.0, 1024.0, 1024.0])), k, c, moving,
        0.0 if family in ("drive", "forced") else whole,
        2 * rng.uniform(0.02, 0.05) * whole * w if family == "loop" else 0.0,
        k_true, c * (1 + 0.15 * limited[1]), unit, unit, unit,
        actuator, actuator and motion.stated(actuator), core,
        f_offset_s=rng.uniform(-1e-4, 1e-4) if family != "loop" else rng.uniform(0, 1e-4),
        a_offset_s=rng.uniform(-1e-4, 1e-4),
        ag_shift=int(rng.integers(2)) if family == "loop" else 0,
        cell=family != "forced" and "no_cell" not in plan.groups, rfc=bool(rng.random() < 0.8),
    )  # fmt: skip
    return bench, reach, f0


@dataclass
class Test:
    """An excitation scaled to the rig, and the orthogonal force beside it."""

    kind: str
    signal: np.ndarray
    fy: np.ndarray
    lead: int


def _test(
    bench: Bench, kind: str, seconds: float, lead_s: float, reach: float, f0: float, rng: Rng
) -> Test:
    lead = round(lead_s * bench.fs)
    t = np.arange(round(seconds * bench.fs) + lead) * bench.dt
    shape = signals.excitation(kind, t, f0, rng)
    fy = signals.band(t.size, bench.fs, 0.2 * f0, 3.0 * f0, rng) * signals.ramp_in(t)
    if bench.family != "drive":
        linear = replace(bench, core=None)
        mass = bench.mass if bench.family == "ground" else 1.0
        if bench.family == "loop":  # the whole structure, on moving ground
            linear = replace(linear, family="ground", c_true=bench.c_true + bench.damping)
            mass = bench.mass
        moved = rig._free(linear, shape / mass, [], 0.0)[0][0]
        shape = shape / mass * (reach / np.max(np.abs(moved)))
    else:
        shape = shape * reach
    return Test(kind, shape, fy, lead)


def _identified(bench: Bench, command: np.ndarray) -> Bench:
    """The second-order fit that a lab would state for a hydraulic actuator, where one is near.

    Whatever the fit misses would be taken for physics, so a lab whose fit can be told from its rig
    in this very command states no actuator.
    """
    assert bench.actuator is not None
    seen = motion.track(command, bench.dt, bench.sub, bench.actuator)[0][:: bench.sub]
    theta = np.array([bench.actuator.delay_s + 0.004, 16.0, 0.8])

    def simulated(p: np.ndarray) -> np.ndarray:
        a = Actuator("second", *np.maximum(p, [2e-4, 4.0, 0.2]))
        return motion.track(command, bench.dt, bench.sub, a)[0][:: bench.sub]

    for _ in range(12):
        y = simulated(theta)
        steps = theta * 1e-3
        slopes = np.column_stack(
            [(simulated(theta + np.eye(3)[i] * steps) - y) / steps[i] for i in range(3)]
        )
        change = np.linalg.lstsq(slopes, seen - y, rcond=None)[0]
        theta = np.maximum(theta + np.clip(change, -0.3 * theta, 0.3 * theta), [2e-4, 4.0, 0.2])
    miss = float(np.sum((simulated(theta) - seen) ** 2)) / bench.x_noise.std**2
    if miss > fairness.APART:
        return replace(bench, believed=None)
    return replace(bench, believed=Actuator("second", *map(float, theta)))


# ---- performing and judging --------------------------------------------------------------------


def _force_scale(bench: Bench, run: Run, sharpest: bool = False) -> Scale:
    """Weights of a force: seen by the load cell, or by the motion of the body that it acts on.

    `sharpest`: as one sees it who knows the motion from its command and judges every frequency.
    What is to be equal has to be so for him as well.
    """
    n = run.t.size
    f = np.fft.rfftfreq(n, bench.dt)
    keep = (f > 0) & (sharpest | (f < min(0.4 * bench.fs, 150.0)))
    keep[0] = bench.cell
    w = 2 * np.pi * f[keep]
    sx, sf, sa = (
        (noise.std * noise.spectrum(f, bench.fs)[keep]) ** 2
        for noise in (bench.x_noise, bench.f_noise, bench.a_noise)
    )
    nuisance = [0.01 * rig.restoring(bench, run), 0.15 * bench.c * run.v]
    # The mass that the force on the body has to be told from: of a load cell, what rides on it.
    mass = bench.moving if bench.cell else bench.body
    dynamic = (bench.k - w**2 * mass) ** 2 + (w * bench.c) ** 2
    if bench.cell:
        commanded = sharpest and bench.believed is not None
        weight = 1 / (sf + (0.0 if commanded else dynamic * sx))
        nuisance.append(1e-4 * np.gradient(run.f, bench.dt))
    else:
        weight = 1 / (dynamic * sx)
        if bench.family == "ground":  # under a known force the accelerometer may be missing
            weight = weight + np.maximum(w, 0.1) ** 4 / (dynamic * sa)
    return Scale(np.sqrt(weight), keep, np.column_stack(nuisance))  # fmt: skip


def _motion_scale(bench: Bench, run: Run) -> Scale:
    f = np.fft.rfftfreq(run.t.size, bench.dt)
    keep = f < 0.4 * bench.fs
    std = bench.x_noise.std * bench.x_noise.spectrum(f, bench.fs)[keep]
    nuisance = np.column_stack((1e-4 * run.v, 20 * bench.x_noise.std * np.ones(run.t.size)))
    return Scale(1 / std, keep, nuisance)


def _force_library(bench: Bench, run: Run) -> Blocks:
    return fairness.force_library(
        run.x, run.v, run.a, run.f, run.fy if bench.cell else None, bench.fs, bench.core
    )


def _motion_changes(bench: Bench, run: Run) -> dict[str, list[np.ndarray]]:
    """Columns of an oil column and of rate limits: differences of simulations."""
    assert bench.actuator is not None
    a, base = bench.actuator, rig.moved(bench, run, [])

    def change(**other: Any) -> np.ndarray:
        e = Effect("", "", {}, "disp", actuator=other)
        return rig.moved(bench, run, [e]) - base

    columns = [change(f_hz=a.f_hz * 0.97)]
    if a.kind == "second":
        columns += [
            change(zeta=a.zeta * 1.03),
            change(f_hz=a.f_hz * 0.7),
            change(zeta=a.zeta * 0.7),
        ]
    speed = float(np.max(np.abs(run.v)))
    limits = [
        change(vmax=q * speed, limit=form)
        for q in (0.3, 0.5, 0.7, 0.85, 0.95)
        for form in (("slew", "valve") if a.kind == "second" else ("slew",))
    ]
    return {"oil_column": [np.column_stack(columns)], "rate_limit": limits}


def _visible(scale: Scale, name: str, y: np.ndarray, level: str) -> None:
    alone, beyond = fairness.seen(scale, y)
    if alone < fairness.VISIBLE[level]:
        raise Redraw(f"{name} hides in noise")
    if beyond < fairness.BEYOND[level]:
        raise Redraw(f"{name} hides in tolerances")


def _beyond_tolerance(bench: Bench, e: Effect, run: Run, scale: Scale, level: str) -> None:
    """What moves a stated number counts from what is stated, and that is off already."""
    off = {
        "stiffness": (bench.k_true - bench.k) * run.x,
        "viscous": (bench.c_true - bench.c) * run.v,
    }.get(e.name)
    if off is None or bench.core is not None:
        return
    y = rig.plain_part(bench, e, run, e.law) + off if e.law is not None else off
    if fairness.seen(scale, y)[1] < fairness.BEYOND[level]:
        raise Redraw(f"{e.name} is within the tolerance of what is stated")


def _shapes(bench: Bench, e: Effect, run: Run) -> list[np.ndarray]:
    """How the force of a law changes with each of its numbers: what a fit may take up."""
    if e.law is None:
        return []
    found = []
    for i, value in enumerate(e.law.p):
        if value:
            p = (*e.law.p[:i], value * 1.02, *e.law.p[i + 1 :])
            other = rig.plain_part(bench, e, run, replace(e.law, p=p))
            found.append(other - rig.plain_part(bench, e, run, e.law))
    return found


def _judge(bench: Bench, effects: list[Effect], run: Run, level: str) -> dict[str, Any]:
    """Margins of each channel; raises Redraw where the answer cannot be known."""
    told: dict[str, Any] = {}
    for channel in ("force", "disp"):
        here = [i for i, e in enumerate(effects) if e.channel == channel]
        if not here:
            continue
        scale = _force_scale(bench, run) if channel == "force" else _motion_scale(bench, run)
        for i in here:  # before the library is built, which takes longer
            _visible(scale, effects[i].name, run.parts[i], level)
            if channel == "force":
                _beyond_tolerance(bench, effects[i], run, scale, level)
        if channel == "force":
            library = _force_library(bench, run)
        else:
            changes = _motion_changes(bench, run)
            library = fairness.motion_library(run.x, run.v, run.a, bench.fs, changes)
        for i in here:
            e = effects[i]
            y = run.parts[i] if e.plain is None else rig.plain_part(bench, e, run, e.plain)
            library.setdefault(e.name, []).append(y[:, None])
        truth = [(effects[i].name, run.parts[i]) for i in here]
        shapes = [_shapes(bench, effects[i], run) for i in here]
        verdict = fairness.judge_set(scale, library, truth, level, shapes)
        if not verdict.fair:
            raise Redraw(verdict.why)
        told[channel] = {
            "visible_sd": verdict.visible, "margin_sd": verdict.margin, "rival": verdict.rival,
        }  # fmt: skip
    return told


def _beyond_noise(bench: Bench, effects: list[Effect], run: Run, level: str) -> None:
    """Each contribution is several times the noise of its channel, or less where it is hard."""
    least = 3.0 if level == "normal" else 1.0
    for e, y in zip(effects, run.parts, strict=True):
        if rms(y) > LARGEST * rms(run.f if e.channel == "force" else run.x):
            raise Redraw(f"{e.name} is most of what there is")
        if e.channel == "force" and not bench.cell:
            continue  # judged by the motion alone
        noise = bench.f_noise.std if e.channel == "force" else bench.x_noise.std
        if rms(y) < least * noise:
            raise Redraw(f"{e.name} is no {least:g} times the noise")


def _base(plan: Plan, rng: Rng, shares: tuple[float, float]) -> tuple[Bench, Size, Test, float]:
    """A rig with its noise, how it moves without effects, and the test."""
    bench, reach, f0 = _bench(plan, rng)
    seconds = rng.uniform(10, 18) if plan.level == "normal" else rng.uniform(5, 9)
    lead = rng.uniform(2.0, 4.0) if "mid_start" in plan.groups else 0.0
    kind = plan.test or str(rng.choice(["quake", "random", "sweep", "cyclic", "multisine"]))
    if plan.test in ("sine", "triangle"):
        lead = 6.0 / f0 + 3.0
    test = _test(bench, kind, seconds, lead, reach, f0, rng)
    if bench.family == "loop":  # sized on the structure without its loop
        whole = replace(
            bench, family="ground", cell=True, core=None, c_true=bench.c_true + bench.damping
        )
        run = rig.perform(_quiet(whole), [], test.signal, test.fy, test.lead, rng)
    else:
        run = rig.perform(_quiet(bench), [], test.signal, test.fy, test.lead, rng)
    test.fy *= rng.uniform(0.3, 0.8) * rms(run.f) / rms(test.fy)
    x, f, a = _noises(plan.level, rms(run.x), rms(run.f), rms(run.a), rng)
    bench = replace(bench, x_noise=x, f_noise=f, a_noise=a)
    if bench.actuator is not None and bench.actuator.kind == "hydraulic":
        bench = _identified(bench, test.signal)
    share = float(np.exp(rng.uniform(*np.log(shares))))
    reached, speed = float(np.max(np.abs(run.x))), float(np.max(np.abs(run.v)))
    size = Size(bench, run.fine, reached, speed, rms(run.f), rms(test.fy), seconds, f0, share)
    return bench, size, test, reach  # fmt: skip


def _quiet(bench: Bench) -> Bench:
    zero = Noise(0.0)
    return replace(bench, x_noise=zero, f_noise=zero, a_noise=zero)


def _shares(level: str, kind: str) -> tuple[float, float]:
    if kind == "unknown":
        return (0.08, 0.25) if level == "normal" else (0.05, 0.12)
    if kind == "cancel":  # what is left of them has to stand out of the tolerances
        return (0.08, 0.25) if level == "normal" else (0.05, 0.15)
    return (0.05, 0.2) if level == "normal" else (0.02, 0.07)


def _finish(
    plan: Plan, bench: Bench, effects: list[Effect], run: Run, test: Test, size: Size, reach: float,
    rng: Rng, verdict: str, judged: dict[str, Any],
) -> Case:  # fmt: skip
    """The held-out test, and what of the recording goes missing."""
    others = [k for k in ("quake", "random", "sweep", "cyclic", "multisine") if k != test.kind]
    kind = str(rng.choice(others))
    held_test = _test(bench, kind, size.seconds, 0.0, 0.85 * reach, size.f0, rng)
    held_test.fy *= rms(test.fy) / rms(held_test.fy)
    lasting = [replace(e, onset_s=-1.0) for e in effects]
    held = rig.perform(bench, lasting, held_test.signal, held_test.fy, 0, rng)
    # An actuator with a velocity limit stays where it is while its command grows.
    if not rms(held.recorded.get("x_num", held.x)) < RUN_AWAY * reach:
        raise Redraw("with these effects the closed loop of the other test is unstable")
    drop, names = [], [e.name for e in effects]
    if not bench.cell:
        drop += ["f_meas", "fy_meas"]
    if (bench.actuator is not None and bench.actuator.kind == "pure") or (
        rng.random() < 0.25 and bench.family != "ground"
    ):
        drop.append("a_meas")
    if rng.random() < 0.2 and "crosstalk" not in names and plan.kind != "ambiguous":
        drop.append("fy_meas")
    spans: list[tuple[int, int]] = []
    groups = list(plan.groups)
    if rng.random() < 0.15:
        groups.append("nan")
        for _ in range(int(rng.integers(1, 4))):
            at = int(rng.integers(run.t.size // 10, run.t.size * 9 // 10))
            spans.append((at, at + int(rng.integers(2, 25))))
    return Case(
        plan.kind, plan.level, bench, effects, run, held, held_test.signal, (test.kind, kind),
        verdict, groups, judged, drop=tuple(dict.fromkeys(drop)), nan_rows=tuple(spans),
    )  # fmt: skip


def known(plan: Plan, rng: Rng) -> Case:
    """Singles, pairs and triples."""
    bench, size, test, reach = _base(plan, rng, _shares(plan.level, plan.kind))
    effects = []
    for name in plan.names:
        share = size.share * (1.0 if not effects else rng.uniform(0.6, 1.6))
        effects.append(drawn.CATALOGUE[name](replace(size, share=share), rng))
    if "onset" in plan.groups:
        effects = [replace(e, onset_s=size.seconds * rng.uniform(0.3, 0.6)) for e in effects]
    run = rig.perform(bench, effects, test.signal, test.fy, test.lead, rng)
    _beyond_noise(bench, effects, run, plan.level)
    judged = _judge(bench, effects, run, plan.level)
    return _finish(plan, bench, effects, run, test, size, reach, rng, "explained", judged)


def cancelling(plan: Plan, rng: Rng) -> Case:
    """Two effects of which each hides most of the other."""
    bench, size, test, reach = _base(plan, rng, _shares(plan.level, plan.kind))
    first = drawn.CATALOGUE[plan.names[0]](size, rng)
    y = rig.perform(_quiet(bench), [first], test.signal, test.fy, test.lead, rng).parts[0]
    second = drawn.CATALOGUE[plan.names[1]](
        replace(size, share=size.share * rng.uniform(0.7, 1.3)), rng
    )
    second = _turned(second, y, bench, test, rng)
    run = rig.perform(bench, [first, second], test.signal, test.fy, test.lead, rng)
    a, b = run.parts
    ratio = rms(a + b) / math.hypot(rms(a), rms(b))
    if ratio > 0.75:
        raise Redraw("the two do not cancel")
    _beyond_noise(bench, [first, second], run, plan.level)
    judged = _judge(bench, [first, second], run, plan.level) | {"cancel_ratio": ratio}
    return _finish(plan, bench, [first, second], run, test, size, reach, rng, "explained", judged)


def _turned(e: Effect, against: np.ndarray, bench: Bench, test: Test, rng: Rng) -> Effect:
    """The effect with the sign that works against a force, if its law is linear in its size."""
    y = rig.perform(_quiet(bench), [e], test.signal, test.fy, test.lead, rng).parts[0]
    if y @ against < 0:
        return e
    if e.name not in ("viscous", "cubic", "stiffness", "quadratic") or e.law is None:
        raise Redraw("a sign that nature does not have")
    law = replace(e.law, p=(-e.law.p[0], *e.law.p[1:]))
    params = {key: -value for key, value in e.params.items()}
    plain = law if e.plain == e.law else replace(e.plain, p=(-e.plain.p[0], *e.plain.p[1:]))
    return replace(e, law=law, plain=plain, params=params)


def nothing(plan: Plan, rng: Rng) -> Case:
    """The model is right inside its tolerances."""
    bench, size, test, reach = _base(plan, rng, _shares(plan.level, plan.kind))
    run = rig.perform(bench, [], test.signal, test.fy, test.lead, rng)
    return _finish(plan, bench, [], run, test, size, reach, rng, "none", {})


def dormant(plan: Plan, rng: Rng) -> Case:
    """An effect that is there and never acts, or never by as much as anyone could see."""
    bench, size, test, reach = _base(plan, rng, _shares(plan.level, plan.kind))
    name = plan.names[0]
    e = drawn.CATALOGUE[name](size, rng)
    far = size.reach * 1.5
    if name == "stopper":
        k = abs(e.params["ks_N_m"])
        law = drawn.Law("stopper", "hard", drawn.laws.STOP, (k, far))
        e = replace(e, form="hard", params={"ks_N_m": k, "xs_m": far}, law=law)
    elif name == "hysteresis":
        law = drawn.Law("hysteresis", "bilinear", drawn.laws.BILINEAR, (bench.k, 0.3, far))
        e = replace(e, form="bilinear", params={"xy_m": far, "alpha": 0.3}, law=law)
    elif name == "quantisation":
        lsb = 0.4 * bench.f_noise.std
        e = replace(e, params={"lsb_N": lsb}, sensor={"lsb": lsb})
    elif name == "rate_limit":
        vmax = 2.5 * size.speed
        e = replace(e, params={"vmax_m_s": vmax}, actuator={"vmax": vmax, "limit": "slew"})
    run = rig.perform(bench, [e], test.signal, test.fy, test.lead, rng)
    noise = bench.x_noise if e.channel == "disp" else bench.f_noise
    if name != "quantisation" and rms(run.parts[0]) > 0.02 * noise.std:
        raise Redraw("it acts")
    return _finish(plan, bench, [e], run, test, size, reach, rng, "none", {})


def _linear_modes(e: Effect, bench: Bench, run: Run) -> list[np.ndarray]:
    """Columns of a liquid that sloshes too little to soften: a second mode near its frequency."""
    if e.law is None or e.law.kind != laws.SLOSH:
        return []
    f_hz, zeta = e.law.p[1:3]
    # A narrow resonance lies between two frequencies of the library's scan.
    linear = [
        laws.Law("second_mode", "", laws.SECOND_MODE, (1.0, f_hz * part, zeta))
        for part in np.linspace(0.9, 1.0, 21)
    ]
    return [row[:, None] for row in laws.along(linear, 1 / bench.fs, run.x, run.v, run.a)]


def unknown(plan: Plan, rng: Rng) -> Case:
    """A law without a name, of which three laws with a name leave a visible share."""
    bench, size, test, reach = _base(plan, rng, _shares(plan.level, plan.kind))
    e = drawn.stranger(size, rng, plan.names[0])
    run = rig.perform(bench, [e], test.signal, test.fy, test.lead, rng)
    _beyond_noise(bench, [e], run, plan.level)
    scale = _force_scale(bench, run)
    library = _force_library(bench, run)
    library["second_mode"] += _linear_modes(e, bench, run)
    left = fairness.share_left(scale, library, run.parts[0])
    if left[0] < 0.05 or left[2] < 0.04:
        raise Redraw("laws with a name match it")
    # A sheet may be wrong by a fifth: what the three leave has to stand above that doubt.
    if left[2] * rms(run.parts[0]) < 1.2 * bench.f_noise.std:
        raise Redraw("what laws with a name leave is no more than the noise")
    return _finish(plan, bench, [e], run, test, size, reach, rng, "unknown", {"share_left": left})


MAKERS = {
    "single": known, "pair": known, "triple": known, "cancel": cancelling, "null": nothing,
    "dormant": dormant, "unknown": unknown,
}  # fmt: skip
