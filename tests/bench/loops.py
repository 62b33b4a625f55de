"""One hybrid test in three ways: in the C core, as a NumPy-Python loop, and that loop with numba.

The test is that of the paper's Section 4.2: phase lead with the delay estimator of Eqn 2.9, tangent
stiffness of Eqn 3.3 and central difference, on a 10-sample pure delay with a Bouc-Wen specimen.
The loop is written from the equations, as a laboratory would script it, and shares nothing with the
core: it is an independent formulation as well as a reference for speed.
"""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from rthyb_rt import core

FS_HZ = core.FS_HZ
K_E = 4737410.0
PERIOD_S = 0.5
MASS_KG = K_E * (PERIOD_S / (2.0 * math.pi)) ** 2
DAMPING_N_S_PER_M = 2.0 * 0.02 * math.sqrt(K_E * MASS_KG)
DELAY = 10
WINDOW = 51
GAIN_PER_MM2 = 0.005
POST_YIELD_RATIO, A, B, C, ETA = 0.02, 1.0, 300.0, 200.0, 1.5
CEILING_M = (A / (B + C)) ** (1.0 / ETA)

SHAKING_TABLE = core.ServoConfig(
    "servo-hydraulic",
    delay_samples=1,
    kp_per_s=63.5,
    ki_per_s2=6.0,
    valve_time_constant_s=0.0018,
    stall_force_n=16e3,
    flow_limit_m_per_s=1.0,
    oil_stiffness_n_per_m=2e7,
    oil_damping_n_s_per_m=1.2e4,
    moving_mass_kg=45.0,
    friction_n=80.0,
    friction_width_m_per_s=5e-4,
    viscous_n_s_per_m=600.0,
)

Loop = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray, np.ndarray]]


def excitation(duration_s: float) -> np.ndarray:
    """A steady mixture of eight sines that makes the specimen yield, m/s^2."""
    t = np.arange(round(duration_s * FS_HZ)) / FS_HZ
    return sum(0.25 * np.sin(2.0 * np.pi * 0.31 * i * t + i * i) for i in range(1, 9))


def build(compiled: Callable[[Any], Any]) -> Loop:
    """Return the loop processed by ``compiled``; the identity leaves it to Python and NumPy.

    The loop takes ag in m/s^2 and returns x_num_m, x_meas_m and alpha, all (n,).
    """

    @compiled
    def hysteresis_slope(z: float, du: float) -> float:
        toward = 1.0 if du * z >= 0.0 else -1.0
        size = abs(z)
        return A - (B * toward + C) * size * math.sqrt(size)

    @compiled
    def yielded(z: float, du: float) -> float:
        steps = min(max(math.ceil(abs(du) / (0.05 * CEILING_M)), 1), 64)
        h = du / steps
        for _ in range(steps):
            middle = z + 0.5 * h * hysteresis_slope(z, du)
            z += h * hysteresis_slope(middle, du)
            z = min(max(z, -CEILING_M), CEILING_M)
        return z

    @compiled
    def hybrid_test(ag: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        n_total = ag.size
        w1, w2 = 3.0, 2.0
        s = w1 + w2 + 1.0
        h = 1.0 / FS_HZ
        gain = GAIN_PER_MM2 * 1e6
        effective_mass = MASS_KG + 0.5 * h * DAMPING_N_S_PER_M
        x_num = np.zeros(n_total + 1)
        x_cmd = np.zeros(n_total + 1)
        x_meas = np.zeros(n_total)
        alphas = np.zeros(n_total)
        ratios = np.zeros(WINDOW + 1)
        alpha, ratio, z = 0.0, K_E, 0.0
        x_m1 = x_m2 = x_p1 = x_p2 = f1 = 0.0
        for n in range(n_total):
            # the rig: a delay of ten samples, and yielding
            x_m = x_cmd[n - DELAY] if n >= DELAY else 0.0
            z = yielded(z, x_m - x_m1)
            f = POST_YIELD_RATIO * K_E * x_m + (1.0 - POST_YIELD_RATIO) * K_E * z
            # Eqn 2.8, 2.9, 2.11
            x_p = x_cmd[n]
            mu = w1 * (x_p - x_m) + w2 * (x_p1 - x_m1) + (x_p2 - x_m2)
            phi = s * (x_m - x_m1)
            alpha += gain * (mu - alpha * phi) * phi / (1.0 + 1e6 * phi * phi)
            # Eqn 3.2, 3.3
            if x_m != x_m1:
                ratio = (f - f1) / (x_m - x_m1)
            ratios[n % (WINDOW + 1)] = ratio
            k_t = K_E
            if n > 2 * WINDOW:
                k_t = min(max(np.sum(ratios) / WINDOW, 0.0), K_E)
            force = f + k_t * (x_num[n] - x_m)
            # central difference
            back = x_num[n] - x_num[n - 1] if n else 0.0
            push = (MASS_KG - 0.5 * h * DAMPING_N_S_PER_M) * back
            push += h * h * (-MASS_KG * ag[n] - force)
            x_num[n + 1] = x_num[n] + push / effective_mass
            # Eqn 2.5
            lead = alpha * s * (x_num[n + 1] - x_num[n])
            lead -= w2 * (x_cmd[n] - x_num[n])
            if n:
                lead -= x_cmd[n - 1] - x_num[n - 1]
            x_cmd[n + 1] = x_num[n + 1] + lead / w1
            x_meas[n] = x_m
            alphas[n] = alpha
            x_m2, x_m1 = x_m1, x_m
            x_p2, x_p1 = x_p1, x_p
            f1 = f
        return x_num[:n_total], x_meas, alphas

    return hybrid_test


def core_pair(config: core.RigConfig | None = None) -> tuple[core.Controller, core.VirtualRig]:
    """Return the same test's controller and rig for the C core; ``config`` names another rig."""
    key = "delay_estimator.gain_per_mm2_per_sample"
    law = core.LawConfig("paper", {"alpha0": 0.0, key: GAIN_PER_MM2})
    motion = core.MotionConfig(
        "central-difference", mass_kg=MASS_KG, damping_n_s_per_m=DAMPING_N_S_PER_M
    )
    rfc = core.RfcConfig(k_e_n_per_m=K_E, window=WINDOW)
    specimen = core.element(
        "hysteresis", k_n_per_m=K_E, post_yield_ratio=POST_YIELD_RATIO, a=A, b=B, c=C, eta=ETA
    )
    servo = core.ServoConfig("pure-delay", delay_samples=DELAY)
    own = core.RigConfig(servo, (specimen,), load_cell="specimen")
    controller = core.Controller(core.ControllerConfig(law, rfc, motion))
    return controller, core.VirtualRig(config or own)


def in_core(ag: np.ndarray, records: np.ndarray, rig: core.RigConfig | None = None) -> float:
    """Run a test in the C core into ``records``; return the computing time, s."""
    controller, virtual_rig = core_pair(rig)
    start = time.perf_counter()
    done, _ = controller.run_virtual(virtual_rig, ag, records)
    took_s = time.perf_counter() - start
    if done != records.size:
        raise RuntimeError(f"the core ended the test after {done} of {records.size} samples")
    return took_s


@dataclass(frozen=True)
class Comparison:
    """Least computing time of one test each way, s, and the difference of the results.

    ``difference`` is the largest |difference| of x_num, x_meas and alpha between any two of the
    three, relative to the signal's largest value.
    """

    core_s: float
    numpy_s: float
    numba_s: float
    difference: float
    peak_m: float


def timed(call: Callable[[], Any]) -> float:
    """Return the duration of a call, s."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def compare(duration_s: float, repetitions: int = 10) -> Comparison:
    """Run the test in all three ways and compare time and result.

    The least time of each is used: delays due to stalls of the machine are excluded.
    """
    import numba

    ag = excitation(duration_s)
    records = np.zeros(ag.size, core.RECORD_DTYPE)
    in_numpy, in_numba = build(lambda f: f), build(numba.njit)
    in_core(ag, records)
    results = (
        (records["x_num_m"], records["x_meas_m"], records["alpha"]),
        in_numpy(ag),
        in_numba(ag),
    )
    core_s = numba_s = math.inf
    for _ in range(repetitions):  # in turn, so that a slow moment of the machine meets both
        core_s = min(core_s, in_core(ag, records))
        numba_s = min(numba_s, timed(lambda: in_numba(ag)))
    return Comparison(
        core_s=core_s,
        numpy_s=min(timed(lambda: in_numpy(ag)) for _ in range(2)),
        numba_s=numba_s,
        difference=max(_apart(*pair) for pair in itertools.combinations(results, 2)),
        peak_m=float(np.max(np.abs(records["x_meas_m"]))),
    )


def _apart(one: Iterable[np.ndarray], other: Iterable[np.ndarray]) -> float:
    return max(
        float(np.max(np.abs(a - b)) / np.max(np.abs(a))) for a, b in zip(one, other, strict=True)
    )


def counting_ratio(seconds: float = 300.0) -> float:
    """Return the counting speed of a Python thread during a test, relative to its speed alone."""
    ag = excitation(seconds)
    records = np.zeros(ag.size, core.RECORD_DTYPE)
    count, stop = [0], threading.Event()

    def counting() -> None:
        while not stop.is_set():
            count[0] += 1

    thread = threading.Thread(target=counting)
    thread.start()
    try:
        best = 0.0
        for _ in range(10):
            before, start = count[0], time.perf_counter()
            time.sleep(0.05)
            alone = (count[0] - before) / (time.perf_counter() - start)
            controller, rig = core_pair()
            before, start = count[0], time.perf_counter()
            controller.run_virtual(rig, ag, records)
            during = (count[0] - before) / (time.perf_counter() - start)
            best = max(best, during / alone)
    finally:
        stop.set()
        thread.join()
    return best
