"""The rig of a case, what is added to it, and a test performed on it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from validate import laws, motion
from validate.laws import Law
from validate.motion import Actuator, Loop
from validate.signals import Noise, Rng

FARTHEST_M = 0.2
"""No actuator goes farther from a command of 15 mm at most. A servo's loop is not stable on every
oil column that is drawn: beyond, it grows until the numbers end."""


class Redraw(Exception):
    """These numbers make no case."""


@dataclass(frozen=True)
class Effect:
    """Something that the baseline leaves out. Exactly one of law, actuator and sensor is set."""

    name: str
    form: str
    params: dict[str, float]
    channel: str = "force"
    scored: tuple[str, ...] | None = None  # None: all of them
    law: Law | None = None
    plain: Law | None = None  # the law of this name as the public format means it
    actuator: dict[str, Any] = field(default_factory=dict)
    sensor: dict[str, float] = field(default_factory=dict)
    onset_s: float = -1.0


@dataclass(frozen=True)
class Bench:
    """Everything about the laboratory that is not in question."""

    family: str
    fs: float
    k: float
    c: float
    moving: float
    mass: float  # numerical mass (ground, loop)
    damping: float  # numerical damping (loop)
    k_true: float
    c_true: float
    x_noise: Noise
    f_noise: Noise
    a_noise: Noise
    actuator: Actuator | None = None
    believed: Actuator | None = None  # None: the baseline states no actuator
    core: tuple[float, float, float] | None = None  # true k, alpha, xy of a specimen that yields
    f_offset_s: float = 0.0
    a_offset_s: float = 0.0
    ag_shift: int = 0
    cell: bool = True
    rfc: bool = True

    @property
    def dt(self) -> float:
        return 1 / self.fs

    @property
    def sub(self) -> int:
        """Fine steps a row: none longer than 0.1 ms."""
        return math.ceil(10000 / self.fs)

    @property
    def core_laws(self) -> list[Law]:
        if self.core is None:
            return []
        k, alpha, xy = self.core
        return [Law("", "", laws.BOUC_WEN, (k, alpha, xy, 2.0))]

    @property
    def body(self) -> float:
        """The mass that moves freely (ground, forced)."""
        return self.mass + self.moving


@dataclass
class Run:
    """A test: clean signals at rows, noisy ones as recorded, and the motion at fine steps."""

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    f: np.ndarray  # as the cell would read it without noise
    f_true: np.ndarray
    fy: np.ndarray
    fine: np.ndarray
    recorded: dict[str, np.ndarray]
    fine_f: np.ndarray  # force of the specimen at fine steps, from before the recording
    command: np.ndarray  # x_cmd with its lead, else empty
    lead: int = 0
    parts: list[np.ndarray] = field(default_factory=list)  # what each effect adds to its channel


def rows(fine: np.ndarray, n: int, sub: int, late: float) -> np.ndarray:
    """A fine signal at n row instants, read `late` fine steps before."""
    return np.interp(np.arange(n) * sub - late, np.arange(fine.size), fine)


def fine_load(signal: np.ndarray, sub: int) -> np.ndarray:
    """Rows joined by straight lines."""
    n = sub * (signal.size - 1) + 1
    return np.interp(np.arange(n) / sub, np.arange(signal.size), signal)


def added(effects: list[Effect], t: np.ndarray, fy: np.ndarray) -> np.ndarray:
    """What the load cell shows beside the force."""
    y = np.zeros(t.size)
    for e in effects:
        s, on = e.sensor, np.clip((t - e.onset_s) / laws.RAMP, 0, 1) if e.onset_s > 0 else 1.0
        y += on * (s.get("bias", 0.0) + s.get("drift", 0.0) * np.maximum(t, 0.0))
        y += on * s.get("crosstalk", 0.0) * fy
        y += on * s.get("amp", 0.0) * np.sin(2 * np.pi * s.get("f", 0.0) * t + s.get("phase", 0.0))
    return y


def sensor(effects: list[Effect], key: str) -> float:
    return sum(e.sensor.get(key, 0.0) for e in effects)


def _shifted(effects: list[Effect], lead_s: float) -> list[Law]:
    """Laws of the effects with their onsets counted from the start of the simulation."""
    return [
        replace(e.law, onset_s=e.onset_s + lead_s if e.onset_s > 0 else -1.0)
        for e in effects
        if e.law is not None
    ]


def true_actuator(bench: Bench, effects: list[Effect]) -> Actuator:
    assert bench.actuator is not None
    a = bench.actuator
    for e in effects:
        a = replace(a, **e.actuator)
    return a


def _free(
    bench: Bench, signal: np.ndarray, acting: list[Law], lead_s: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fine motion and force of a body on a moving ground or under a known force."""
    mass, k, c = bench.body, bench.k_true, bench.c_true
    extra = sum(a.p[0] for a in acting if a.kind == laws.INERTIA)
    others = [a for a in acting if a.kind != laws.INERTIA]
    load = fine_load(signal, bench.sub) * (-bench.mass if bench.family == "ground" else 1.0)
    h = bench.dt / bench.sub
    x, v, a, _ = motion.free_body(mass + extra, c, k, bench.core_laws + others, load, h)
    if not np.max(np.abs(x)) < 1.0:
        raise Redraw("the body runs away")
    return np.array([x, v, a]), load - bench.mass * a


def _driven(
    bench: Bench, signal: np.ndarray, acting: list[Law], a: Actuator
) -> tuple[np.ndarray, np.ndarray]:
    fine = motion.track(signal, bench.dt, bench.sub, a)
    if not np.max(np.abs(fine[0])) < FARTHEST_M:
        raise Redraw("the actuator runs away")
    f = bench.k_true * fine[0] + bench.c_true * fine[1] + bench.moving * fine[2]
    if bench.core_laws + acting:
        f = f + laws.along(bench.core_laws + acting, bench.dt / bench.sub, *fine).sum(0)
    return fine, f


def _looped(
    bench: Bench, signal: np.ndarray, effects: list[Effect], acting: list[Law], extra: np.ndarray,
    noises: tuple[np.ndarray, np.ndarray],
) -> dict[str, np.ndarray]:  # fmt: skip
    assert bench.believed is not None
    control = Loop(
        bench.mass, bench.damping, bench.k, bench.believed.lag_s * bench.fs, bench.rfc,
        bench.ag_shift, sensor(effects, "skew") + bench.f_offset_s, sensor(effects, "lsb"),
    )  # fmt: skip
    done = motion.closed_loop(
        control, true_actuator(bench, effects), (bench.k_true, bench.c_true, bench.moving),
        bench.core_laws + acting, signal, bench.dt, bench.sub, extra, *noises,
    )  # fmt: skip
    if not np.max(np.abs(done["x_meas"])) < FARTHEST_M:
        raise Redraw("the loop is not stable")
    return done


def perform(
    bench: Bench, effects: list[Effect], signal: np.ndarray, fy: np.ndarray, lead: int, rng: Rng
) -> Run:
    """One test; its first `lead` rows are before the recording."""
    n, sub, h = signal.size, bench.sub, bench.dt / bench.sub
    t = (np.arange(n) - lead) * bench.dt
    acting = _shifted(effects, lead * bench.dt)
    extra = added(effects, t, fy)
    x_noise = bench.x_noise.draw(n, bench.fs, rng)
    f_noise = bench.f_noise.draw(n, bench.fs, rng)
    given: dict[str, np.ndarray]
    skew, lsb = sensor(effects, "skew") + bench.f_offset_s, sensor(effects, "lsb")
    if bench.family == "loop":
        done = _looped(bench, signal, effects, acting, extra, (x_noise, f_noise))
        fine, f_fine, f, f_meas = done["fine"], done["force"], done["f"], done["f_meas"]
        given = {"ag": signal, "x_num": done["x_num"], "x_cmd": done["x_cmd"]}
    else:
        if bench.family == "drive":
            fine, f_fine = _driven(bench, signal, acting, true_actuator(bench, effects))
            given = {"x_cmd": signal}
        else:
            fine, f_fine = _free(bench, signal, acting, lead * bench.dt)
            given = {"ag" if bench.family == "ground" else "f_in": signal}
        f = rows(f_fine, n, sub, skew / h) + extra
        f_meas = f + f_noise
        if lsb > 0:
            f_meas = np.round(f_meas / lsb) * lsb
    x, v, a = (rows(s, n, sub, 0.0) for s in fine)
    felt = rows(fine[2], n, sub, bench.a_offset_s / h)
    if bench.family == "ground":
        felt = felt + signal
    outputs = {
        "x_meas": x + x_noise,
        "f_meas": f_meas,
        "a_meas": felt + bench.a_noise.draw(n, bench.fs, rng),
        "fy_meas": fy + 0.3 * bench.f_noise.std * rng.standard_normal(n),
    }
    recorded = {name: y[lead:] for name, y in (given | outputs).items()}
    run = Run(
        t[lead:], x[lead:], v[lead:], a[lead:], f[lead:], rows(f_fine, n, sub, 0.0)[lead:],
        fy[lead:], fine, recorded, f_fine, (given | outputs).get("x_cmd", np.zeros(0)), lead,
    )  # fmt: skip
    run.parts = [_part(bench, effects, i, run) for i in range(len(effects))]
    return run


def moved(bench: Bench, run: Run, effects: list[Effect]) -> np.ndarray:
    """Displacement at rows of the true actuator with these effects, along the command of a run."""
    a = true_actuator(bench, effects)
    return motion.track(run.command, bench.dt, bench.sub, a)[0][:: bench.sub][run.lead :]


def plain_part(bench: Bench, e: Effect, run: Run, law: Law) -> np.ndarray:
    """Force of a law along the motion of a run, at its rows."""
    moved = replace(law, onset_s=e.onset_s + run.lead * bench.dt if e.onset_s > 0 else -1.0)
    y = laws.along([moved], bench.dt / bench.sub, *run.fine)[0]
    return y[:: bench.sub][run.lead :]


def restoring(bench: Bench, run: Run) -> np.ndarray:
    """Force of the true spring, or of the loop that stands in its place, at the rows of a run."""
    f = bench.k_true * run.fine[0]
    if bench.core_laws:
        f = f + laws.along(bench.core_laws, bench.dt / bench.sub, *run.fine).sum(0)
    return f[:: bench.sub][run.lead :]


def _part(bench: Bench, effects: list[Effect], i: int, run: Run) -> np.ndarray:
    """What one effect adds to the channel that it shows in, the others being there."""
    e = effects[i]
    if e.law is not None:
        return plain_part(bench, e, run, e.law)
    if e.actuator:
        others = effects[:i] + effects[i + 1 :]
        return moved(bench, run, effects) - moved(bench, run, others)
    if "skew" in e.sensor:
        late = e.sensor["skew"] / bench.dt * bench.sub
        n = run.t.size + run.lead
        return rows(run.fine_f, n, bench.sub, late)[run.lead :] - run.f_true
    if "lsb" in e.sensor:
        lsb, y = e.sensor["lsb"], run.f
        return np.round(y / lsb) * lsb - y
    return added([e], run.t, run.fy)


def baseline_run(bench: Bench, run: Run, signal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x and f that the baseline gives for a test from rest: f along the true motion if driven."""
    core = bench.core and (bench.k, *bench.core[1:])
    stated = replace(bench, k_true=bench.k, c_true=bench.c, core=core)
    if bench.family in ("ground", "forced"):
        fine, f = _free(stated, signal, [], 0.0)
        return fine[0][:: bench.sub], f[:: bench.sub]
    f = bench.k * run.fine[0] + bench.c * run.fine[1] + bench.moving * run.fine[2]
    if stated.core_laws:
        f = f + laws.along(stated.core_laws, bench.dt / bench.sub, *run.fine).sum(0)
    x = run.x
    if bench.believed is not None:
        x = motion.track(run.command, bench.dt, bench.sub, bench.believed)[0][:: bench.sub]
    return x, f[:: bench.sub]
