"""A laboratory: its true rig, the model it believes in, and the recordings it makes."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from prove import excitations, laws, loops, rigs

Rng = np.random.Generator


@dataclass
class Noise:
    """Standard deviations that are true, and that the data sheet states."""

    x: float
    f: float
    a: float
    sheet: float = 1.0  # what the sheet says over what is true, 0.8 to 1.2


@dataclass
class Lab:
    """True rig and baseline of one case. Offsets are the undocumented shifts between channels."""

    family: str
    fs: float
    truth: laws.Specimen
    believed: laws.Specimen
    mass: float = 0.0
    damping: float = 0.0
    actuator: rigs.Actuator | None = None
    believed_actuator: rigs.Actuator | None = None
    sensors: loops.Sensors = field(default_factory=loops.Sensors)
    noise: Noise = field(default_factory=lambda: Noise(0.0, 0.0, 0.0))
    f_offset_s: float = 0.0
    a_offset_s: float = 0.0
    delay_offset_s: float = 0.0  # between x_cmd and x_meas
    rate: float = 0.0  # adaptive gain of the closed loop
    cell: bool = True

    @property
    def dt(self) -> float:
        return 1.0 / self.fs


@dataclass
class Run:
    """Noise-free signals of one test: rows (n,) and fine motion (16 (n - 1) + 1,) from row 0 on."""

    t: np.ndarray
    x: np.ndarray
    v: np.ndarray
    a: np.ndarray
    a_read: np.ndarray
    f: np.ndarray
    f_true: np.ndarray
    fy: np.ndarray
    fine: np.ndarray
    ag: np.ndarray | None = None
    f_in: np.ndarray | None = None
    x_cmd: np.ndarray | None = None
    x_num: np.ndarray | None = None
    f_meas: np.ndarray | None = None
    x_noise: np.ndarray | None = None
    stable: bool = True


def at_rows(fine: np.ndarray, n: int, shift_steps: float) -> np.ndarray:
    """A fine signal at row instants moved by so many fine steps, straight in between."""
    where = np.arange(n) * rigs.FINE + shift_steps
    return np.interp(where, np.arange(fine.size), fine)


def drive(lab: Lab, signal: np.ndarray, lead: int, fy: np.ndarray, rng: Rng) -> Run:
    """An actuator follows rows of command; the first `lead` rows are before the recording."""
    dt = lab.dt
    if lab.actuator is None:
        fine = quasi_static(signal, dt)
    else:
        fine = rigs.track(signal, dt, lab.actuator)
    f = laws.along(lab.truth, -lead * dt, dt / rigs.FINE, *fine)
    return _cut(lab, signal.size, lead, fine, f, fy, x_cmd=signal)


def quasi_static(x: np.ndarray, dt: float) -> np.ndarray:
    """x, v, a of rows joined by straight lines; the inertia of such a test is nothing."""
    n = rigs.FINE * (x.size - 1) + 1
    fine_x = np.interp(np.arange(n) / rigs.FINE, np.arange(x.size), x)
    v = np.diff(x) / dt
    index = np.minimum((np.arange(n) - 0.5).astype(int).clip(0) // rigs.FINE, v.size - 1)
    return np.array([fine_x, v[index], np.zeros(n)])


def ground(lab: Lab, ag: np.ndarray, lead: int, fy: np.ndarray, rng: Rng) -> Run:
    """The specimen carries the mass and its base moves with ag, from rest."""
    dt = lab.dt
    base = rigs.fine_signal(ag, np.arange(ag.size) * dt, dt)
    x, v, a, f = rigs.free_motion(-lab.mass * base, dt / rigs.FINE, lab.mass, 0.0, lab.truth)
    run = _cut(lab, ag.size, lead, np.array([x, v, a]), f, fy, ag=ag)
    run.a_read = run.a_read + run.ag  # the accelerometer on the specimen feels the base
    return run


def forced(lab: Lab, load: np.ndarray, lead: int, fy: np.ndarray, rng: Rng) -> Run:
    """A known force on the specimen, from rest; what the sensors add is a constant force here."""
    dt = lab.dt
    t = np.arange(load.size) * dt
    net = rigs.fine_signal(load - lab.sensors.bias - lab.sensors.drift * t, t, dt)
    x, v, a, f = rigs.free_motion(net, dt / rigs.FINE, 0.0, 0.0, lab.truth)
    run = _cut(replace(lab, sensors=loops.Sensors()), load.size, lead, np.array([x, v, a]), f, fy)
    run.f_in = load[lead:]
    return run


def loop(lab: Lab, ag: np.ndarray, lead: int, fy: np.ndarray, rng: Rng) -> Run:
    """A closed hybrid test under ag, noise and all."""
    assert lab.believed_actuator is not None
    assert lab.actuator is not None
    dt, n = lab.dt, ag.size
    period = 2 * math.pi * math.sqrt(lab.mass / lab.believed.k)
    control = loops.Controller(
        alpha=lab.believed_actuator.lag_s / dt,
        k_e=lab.believed.k,
        rate=lab.rate,
        samples=max(20, round(0.1 * period / dt)),
        strong_until_s=n * dt * 0.9,
    )
    x_noise = lab.noise.x * rng.standard_normal(n)
    done = loops.closed_test(
        ag, dt, lab.mass, lab.damping, lab.actuator, lab.truth, lab.sensors, control, fy,
        lab.noise.f * rng.standard_normal(n), x_noise,
    )  # fmt: skip
    run = _cut(lab, n, lead, done.fine[:3], done.fine[3], fy, ag=ag, x_cmd=done.x_cmd)
    run.x_num, run.f_meas = done.x_num[lead:], done.f_meas[lead:]
    run.f = done.f_clean[lead:]
    run.x_noise, run.stable = x_noise[lead:], done.finished
    return run


def _cut(
    lab: Lab, n: int, lead: int, fine: np.ndarray, f: np.ndarray, fy: np.ndarray,
    ag: np.ndarray | None = None, x_cmd: np.ndarray | None = None,
) -> Run:  # fmt: skip
    """Rows of a fine motion, the lead taken off; f as the cell reads it at its own instants."""
    h = lab.dt / rigs.FINE
    rows = [at_rows(s, n, 0.0)[lead:] for s in fine]
    f_true = at_rows(f, n, 0.0)[lead:]
    f_late = at_rows(f, n, (lab.f_offset_s - lab.sensors.skew_s) / h)[lead:]
    t = np.arange(n - lead) * lab.dt
    a_read = at_rows(fine[2], n, lab.a_offset_s / h)[lead:]
    return Run(
        t, rows[0], rows[1], rows[2], a_read, lab.sensors.clean(t, f_late, fy[lead:]), f_true,
        fy[lead:], fine[:, lead * rigs.FINE :],
        None if ag is None else ag[lead:], None, None if x_cmd is None else x_cmd[lead:],
    )  # fmt: skip


FAMILIES = {"drive": drive, "ground": ground, "forced": forced, "loop": loop}


@dataclass
class Test:
    """What is asked of the rig: the excitation of peak 1 and its scale, in m, m/s^2 or N."""

    kind: str
    shape: np.ndarray
    fy: np.ndarray
    scale: float = 1.0
    lead: int = 0


def plan_test(lab: Lab, kind: str, seconds: float, rng: Rng) -> Test:
    """Shape of the excitation; a sine gets a lead so that the recording starts in steady state."""
    rows = round(seconds * lab.fs)
    lead = round((3.0 if lab.family == "drive" else 80.0) * lab.fs) if kind == "sine" else 0
    t = np.arange(rows + lead) * lab.dt
    if kind.startswith("quasi_static"):
        shape = excitations.triangle(t, rng, int(rng.integers(4, 8)), kind == "quasi_static")
    elif lab.fs < 500:
        shape = excitations.command(kind, t * (16.0 / t[-1]), rng)  # the same, played slowly
    elif lab.family == "drive":
        shape = excitations.command(kind, t, rng)
    else:
        shape = excitations.load(kind, t, rng)
    slow = np.arange(t.size) / (1024.0 if lab.fs > 500 else 30.0)  # fy keeps its look at any rate
    fy = excitations.band_noise(slow, rng, 0.3, 4.0)
    fy *= excitations.quake_envelope(slow, rng) if lead == 0 else 1.0
    return Test(kind, shape, fy, 1.0, lead)


def perform(lab: Lab, test: Test, rng: Rng, fy_rms: float = 0.0) -> Run:
    """One test on the true rig."""
    fy = test.fy * (fy_rms / max(float(np.std(test.fy)), 1e-12))
    return FAMILIES[lab.family](lab, test.scale * test.shape, test.lead, fy, rng)


def believed_outputs(lab: Lab, run: Run) -> tuple[np.ndarray, np.ndarray]:
    """x (m) and f (N) that the baseline predicts for this test, as the truth file holds them."""
    dt = lab.dt
    if lab.family in ("ground", "forced"):
        assert run.ag is not None or run.f_in is not None
        load = -lab.mass * run.ag if run.ag is not None else run.f_in
        mass = lab.mass if run.ag is not None else 0.0
        fine = rigs.fine_signal(np.asarray(load), run.t, dt)
        x, _, _, f = rigs.free_motion(fine, dt / rigs.FINE, mass, 0.0, lab.believed)
        return x[:: rigs.FINE], f[:: rigs.FINE]
    f = laws.along(lab.believed, 0.0, dt / rigs.FINE, *run.fine)[:: rigs.FINE]
    if lab.believed_actuator is None or run.x_cmd is None:
        return run.x, f
    return rigs.track(run.x_cmd, dt, lab.believed_actuator)[0][:: rigs.FINE], f
